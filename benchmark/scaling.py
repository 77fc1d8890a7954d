"""How mPPO's training scales with processes: measured on this machine, and a model for larger ones.

    python benchmark/scaling.py    # some minutes; leave the machine alone meanwhile

Trains a few updates of mppo_beta_torchrun.py with one rank and with 2, 4, 8, ... ranks, up to one
on each core. Times the all-reduces between two ranks. One update of R ranks with n cranes each
takes

    t = T (a + b n) + M (c + d B / R) + M (t_gradient(R) + 2 t_scalar(R))

with T decisions per crane, M gradient steps, B decisions in a minibatch, and an all-reduce of s
bytes in a ring of R ranks, which takes

    2 (R - 1) latency + 2 (R - 1) / R * s / bandwidth

a, b, c, d are measured with one rank at two sizes. More ranks are then predicted and compared with
what they take. For 8, 64 and 512 ranks a common network is assumed. The rows go to
benchmark/scaling.csv, where they replace those of a machine with as many cores.
"""

import csv
import os
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

import crane_runs
import numpy as np
import tyro
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tqdm import tqdm

from mppo_beta_crane import Agent, Args

HERE = Path(__file__).parent
SCRIPT = HERE.parent / "mppo_beta_torchrun.py"
STEPS, EPOCHS, MINIBATCHES = 64, 8, 4  # of the default training
UPDATES = 8  # of each measurement; the first one is left out
NETWORK = {"latency": 50e-6, "bandwidth": 1.25e9}  # s, bytes/s: assumed for 10 Gbit/s Ethernet
ALL_REDUCE = """
import time, torch, torch.distributed as dist
dist.init_process_group("gloo")
for size in (1, {parameters}):
    x, times = torch.zeros(size), []
    for _ in range(200):
        start = time.perf_counter()
        dist.all_reduce(x)
        times.append(time.perf_counter() - start)
    if dist.get_rank() == 0:
        print(sorted(times)[100])
dist.destroy_process_group()
"""


def times(line: list[str], cranes: int, updates: int = UPDATES) -> dict[str, float]:
    """Median seconds of a rollout and of an update of a training started by `line`."""
    batch = cranes * STEPS
    flags = f"--num-envs {cranes} --minibatch-size {batch // MINIBATCHES}".split()
    flags += f"--total-timesteps {batch * updates} --eval-every 0 --final-trials 0".split()
    # without an early stop all updates have the same length
    flags += ["--target-kl", "1000", "--exp-name", "speed"]
    with tempfile.TemporaryDirectory() as folder:
        run([*line, *flags], folder)
        events = EventAccumulator(str(next(Path(folder, "runs").iterdir())))
        events.Reload()
    seconds = {
        key: float(np.median([event.value for event in events.Scalars(f"time/{key}")[1:]]))
        for key in ("rollout", "update")
    }
    return {**seconds, "SPS": batch / sum(seconds.values())}


def run(line: list[str], folder: str | None = None) -> str:
    return subprocess.run(line, cwd=folder, stdout=subprocess.PIPE, text=True, check=True).stdout


def torchrun(ranks: int, script: str) -> list[str]:
    line = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    return [*line, "--nproc-per-node", str(ranks), script]


def write(rows: list[dict], path: Path) -> None:
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


def ring(ranks: int, size: float, latency: float, bandwidth: float) -> float:
    """Seconds of an all-reduce of size bytes."""
    return 2 * (ranks - 1) * latency + 2 * (ranks - 1) / ranks * size / bandwidth


def main() -> None:
    agent = Agent(18, -np.ones(6), np.ones(6), Args())
    parameters = sum(parameter.numel() for parameter in agent.parameters())
    cores = os.cpu_count() or 1
    sizes = [(1, 64), (1, 16)]
    sizes += [(2**k, cranes) for k in range(1, cores.bit_length()) for cranes in (8, 32)]
    runs = []
    for ranks, cranes in tqdm(sizes, unit="training"):
        seconds = times(torchrun(ranks, str(SCRIPT)), ranks * cranes)
        runs.append({"ranks": ranks, "cranes": cranes, **seconds})
    one, small = runs[0], runs[1]
    b = (one["rollout"] - small["rollout"]) / STEPS / (64 - 16)
    a = one["rollout"] / STEPS - b * 64
    gradient_steps = EPOCHS * MINIBATCHES
    d = (one["update"] - small["update"]) / gradient_steps / ((64 - 16) * STEPS / MINIBATCHES)
    c = one["update"] / gradient_steps - d * 64 * STEPS / MINIBATCHES
    with tempfile.NamedTemporaryFile("w", suffix=".py") as file:
        file.write(ALL_REDUCE.format(parameters=parameters))
        file.flush()
        scalar, gradient = map(float, run(torchrun(2, file.name)).split())
    here = {"latency": scalar / 2, "bandwidth": 4 * parameters / (gradient - scalar)}

    def predict(ranks: int, cranes: int, network: dict[str, float]) -> dict[str, float]:
        share = cranes * STEPS / MINIBATCHES
        rollout = STEPS * (a + b * cranes)
        reduce = ring(ranks, 4 * parameters, **network) + 2 * ring(ranks, 4, **network)
        update = gradient_steps * (c + d * share + reduce)
        sps = ranks * cranes * STEPS / (rollout + update)
        return {"ranks": ranks, "cranes": cranes, "rollout": rollout, "update": update, "SPS": sps}

    rows = [{"what": "measured", **run} for run in runs]
    rows += [{"what": "model, this machine", **predict(*size, here)} for size in sizes[2:]]
    rows += [
        {"what": "model, 10 Gbit/s", **predict(ranks, n, NETWORK)}
        for ranks in (8, 64, 512)
        for n in (8, 32)
    ]
    for row in rows:
        row |= {key: f"{row[key]:.4g}" for key in ("rollout", "update", "SPS")}
        print("  ".join(f"{key} {value}" for key, value in row.items()))
    print(f"seconds: a {a:.2e}, b {b:.2e}, c {c:.2e}, d {d:.2e}")
    print(f"{4 * parameters} bytes of gradient; all-reduce {gradient:.2e} s, a number {scalar:.2e}")
    path = HERE / "scaling.csv"
    others: list[dict[str, str]] = []
    if path.exists():
        with open(path, newline="") as file:
            others = [row for row in csv.DictReader(file) if row["cores"] != str(cores)]
    rows = others + [{"cores": cores, **row} for row in rows]
    write(rows, path)


if __name__ == "__main__":
    crane_runs.one_line_errors()
    tyro.cli(main, description=__doc__)
