"""What torchrun starts in test_ranks.py: mppo_beta_torchrun.py, and a look at each rank.

    torchrun ... ranks_program.py FOLDER WHEN ARGUMENTS

Each rank leaves FOLDER/rank<r>.pt. The last rank gets a signal at its WHEN-th step, 0 for none. Its
processor seems to round otherwise: without the others' its first weights would be larger.
"""

import os
import signal
import sys
from pathlib import Path

import torch
from script_runs import Recording
from toy_tasks import Toy

folder, when, last = Path(sys.argv[1]), int(sys.argv[2]), os.environ["RANK"] == "1"
step, count = Toy.step, []


def counted_step(self, action):
    count.append(1)
    if last and len(count) == when:
        os.kill(os.getpid(), signal.SIGTERM)
    return step(self, action)


Toy.step, orthogonal = counted_step, torch.nn.init.orthogonal_
torch.nn.init.orthogonal_ = lambda w, gain: orthogonal(w, 1.01 * gain if last else gain)
run = Recording(folder)
try:
    left = run.run("mppo_beta_torchrun", *sys.argv[3:])
finally:
    names = "starts steps permutations samples first updates scalars purge_steps".split()
    kept = {name: getattr(run, name) for name in names}
    if "left" in vars():
        kept |= {"last": left["agent"].state_dict()}
    torch.save(kept, folder / f"rank{os.environ['RANK']}.pt")
