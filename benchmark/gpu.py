"""mPPO with its networks on a GPU: seconds of a rollout and of an update, beside the CPU.

    python benchmark/gpu.py    # four minutes on 16 cores; leave the machine alone meanwhile

Trains a few updates of mppo_beta_crane.py with the networks on the GPU, and with the networks on
the CPU. The physics has all cores, and so have the updates on the CPU. "physics" are the seconds of
64 decisions of as many cranes under random actions, without any network. A GPU cannot make this
part faster. benchmark/gpu.csv has the results.
"""

import os
import platform
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

import crane_runs
import gymnasium
import torch
import tyro
from scaling import STEPS, times, write
from tqdm import tqdm

HERE = Path(__file__).parent
SCRIPT = HERE.parent / "mppo_beta_crane.py"
TRAININGS = [(64, "cuda"), (64, "cpu"), (1024, "cuda"), (1024, "cpu"), (8192, "cuda")]
UPDATES = {64: 8, 1024: 4, 8192: 3}  # by cranes; the first one is left out


def physics(cranes: int) -> float:
    """Seconds of STEPS decisions under random actions."""
    envs = gymnasium.make_vec("ForestryCrane-v0", cranes)
    envs.reset(seed=1)
    envs.action_space.seed(1)
    actions = [envs.action_space.sample() for _ in range(STEPS)]
    start = time.perf_counter()
    for action in actions:
        envs.step(action)
    return time.perf_counter() - start


def main() -> None:
    if not torch.cuda.is_available():
        raise SystemExit("no CUDA GPU here, or a torch without CUDA")
    cores, rows = os.cpu_count(), []
    machine = f"{cores} cores {platform.machine()}, {torch.cuda.get_device_name()}"
    for cranes, device in tqdm(TRAININGS, unit="training"):
        line = [sys.executable, str(SCRIPT), "--device", device]
        line += ["--torch-threads", str(cores), "--env-threads", str(cores)]
        row = {"machine": machine, "cranes": cranes, "networks": device}
        row |= times(line, cranes, UPDATES[cranes]) | {"physics": physics(cranes)}
        row |= {key: f"{row[key]:.4g}" for key in ("rollout", "update", "SPS", "physics")}
        rows.append(row)
        tqdm.write("  ".join(f"{key} {value}" for key, value in row.items()))
    write(rows, HERE / "gpu.csv")


if __name__ == "__main__":
    crane_runs.one_line_errors()
    tyro.cli(main, description=__doc__)
