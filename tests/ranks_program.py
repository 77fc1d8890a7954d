"""What torchrun starts in test_torchrun.py: mppo_beta_torchrun.py, and a look at each rank.

    torchrun ... ranks_program.py FOLDER exact|sampled ARGUMENTS

Each rank leaves FOLDER/rank<r>.pt: its weights and the gradient of each step. "exact" computes in
float64, takes the mean of each distribution for a sample, and does not shuffle.
"""

import os
import runpy
import sys
from pathlib import Path

import torch
from torch.distributions import Beta
from torch.nn.utils import parameters_to_vector

folder, how = Path(sys.argv[1]), sys.argv[2]
script = str(Path(__file__).parent.parent / "mppo_beta_torchrun.py")
sys.path.insert(0, str(Path(script).parent))
sys.argv[:3] = [script]
gradients, step = [], torch.optim.Adam.step


def recording_step(self, *args, **kwargs):
    gradients.append(parameters_to_vector(p.grad for p in self.param_groups[0]["params"]))
    return step(self, *args, **kwargs)


torch.optim.Adam.step = recording_step
if how == "exact":
    torch.set_default_dtype(torch.float64)
    torch.float32, torch.Tensor.float = torch.float64, torch.Tensor.double
    Beta.sample = lambda self, shape=(): self.mean.detach()
    torch.randperm = lambda n, **kwargs: torch.arange(n)
left = runpy.run_path(script, run_name="__main__")
weights = left["agent"].state_dict()
torch.save({"weights": weights, "gradients": gradients}, folder / f"rank{os.environ['RANK']}.pt")
