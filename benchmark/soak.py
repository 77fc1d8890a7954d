"""Long and hostile runs: nothing may hang, leak, diverge, lose work or end in a traceback.

    python benchmark/soak.py steps       # ten million each, one million with sdf; 40 minutes
    python benchmark/soak.py memory      # four simulated hours of one crane; 3 minutes
    python benchmark/soak.py kills       # ten kill -9, each with a resume; 2 minutes
    python benchmark/soak.py arguments   # each argument of each script, absurd values; 15 minutes

Each part prints what it found and puts its rows into benchmark/soak.csv. Needs Linux.
"""

import csv
import os
import random
import resource
import runpy
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Literal

sys.path.insert(0, str(Path(__file__).parent.parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import crane_options
import crane_policies
import crane_runs
import numpy as np
import torch
import tyro
from script_runs import ALGORITHMS, ROOT, command, module, scalars, small
from tqdm import tqdm
from tyro.conf import Positional

import crane_env
import eval_crane
from crane_env import CraneVectorEnv

RESULTS = Path(__file__).parent / "soak.csv"
COLUMNS = ("part", "what", "amount", "unit", "failures", "note")
CRANES = 64
VALUES = ("0", "-1", "1e18", str(10**18), "nan", "inf", "text", "")
LIMIT = 60.0  # s, after which a command hangs

Row = tuple[str, int, str, int, str]  # COLUMNS after the first


def steps() -> list[Row]:
    """Physics steps, each a step of the environment: divergences, warnings, undefined numbers.

    Half of the cranes follow the shipped policy, with noise, so that logs are gripped and swung
    about. The others get random actions, half of them at full speed.
    """
    policy, _, _ = crane_policies.load_policy(crane_policies.SHIPPED)
    rows = []
    for actuators, contact, amount in (
        ("ideal", "primitive", 10_000_000),
        ("hydraulic", "primitive", 10_000_000),
        ("ideal", "sdf", 1_000_000),
    ):
        what = {"actuators": actuators, "contact": contact}
        envs = CraneVectorEnv(CRANES, frame_skip=1, **what)
        rng, failures, lifted = np.random.default_rng(0), 0, 0
        obs, _ = envs.reset(seed=0)
        for k in tqdm(range(amount // CRANES), desc=f"{actuators}, {contact}"):
            if k % 20 == 0:
                actions = rng.uniform(-1, 1, (CRANES, 6))
                actions[::4] = np.sign(actions[::4])
                actions[1::2] = policy.predict(obs[1::2])[0] + 0.2 * actions[1::2]
            obs, reward, terminated, truncated, info = envs.step(actions)
            failures += (info["termination"] == "diverged").sum()
            failures += (obs not in envs.observation_space) + (~np.isfinite(reward)).sum()
            lifted += info["success"].sum()
        failures += envs.batch.warning[:, :, 1].sum()
        rows.append(
            (f"{actuators}, {contact}", amount, "steps", int(failures), f"{lifted} logs lifted")
        )
    return rows


def memory() -> list[Row]:
    """Resident memory of one crane, its first quarter of an hour against the four hours."""

    def resident() -> float:  # MB
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * resource.getpagesize() / 2**20

    env = crane_env.CraneEnv()
    hours, rng = 4, np.random.default_rng(0)
    decisions = round(hours * 3600 / env.envs.dt)
    env.reset(seed=0)
    for k in tqdm(range(decisions)):
        *_, terminated, truncated, _ = env.step(rng.uniform(-1, 1, 6))
        if terminated or truncated:
            env.reset()
        if k == decisions // 16:
            first = resident()
    grown = resident() - first
    note = f"grown by {grown:.1f} MB after the first quarter of an hour"
    return [("one crane", hours, "simulated hours", int(grown > 5), note)]


def kills() -> list[Row]:
    """kill -9 at random moments; then the run goes on, and no update is missing or there twice."""
    random.seed(0)
    rows = []
    for k in tqdm(range(10)):
        algorithm, folder = ALGORITHMS[k % 4], Path(tempfile.mkdtemp())
        task = "--env-id Pendulum-v1 --env.retry 0 --eval-every 7 --total-timesteps 12800"
        line = command(algorithm, *small(algorithm), *task.split())
        quiet = {"cwd": folder, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen(line, **quiet)
        while process.poll() is None and not list(folder.glob("runs/*/checkpoint.pt")):
            time.sleep(0.01)
        time.sleep(random.uniform(0, 2))
        process.kill()
        process.wait()
        (run_dir,) = folder.glob("runs/*")
        at = torch.load(run_dir / "checkpoint.pt", weights_only=True)["iteration"]
        time.sleep(1.1)  # TensorBoard orders files by the second
        status = subprocess.run(command(algorithm, "--resume", run_dir), **quiet).returncode
        values = scalars(run_dir)
        whole = values["time/updates"] == list(range(1, 201))
        whole &= len(values["eval/episodic_return"]) == 200 // 7 + 1
        rows.append((f"{algorithm}, killed", at, "updates saved", int(status or not whole), ""))
        shutil.rmtree(folder)
    return rows


def in_fork(script: Path, arguments: list[str], folder: Path) -> tuple[int, str]:
    """Exit status (-1 for a hang) and output of a script, without the seconds of imports."""
    output = folder / "output"
    child = os.fork()
    if child == 0:
        os.chdir(folder)
        os.setsid()
        file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, 1)
        os.dup2(file, 2)
        sys.argv = [str(script), *arguments]
        status = 0
        try:
            runpy.run_path(str(script), run_name="__main__")
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else int(end.code is not None)
            if isinstance(end.code, str):
                print(end.code)
        except BaseException as error:
            status = 1
            sys.excepthook(type(error), error, error.__traceback__)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    end = time.time() + LIMIT
    while time.time() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status), output.read_text(errors="replace")
        time.sleep(0.01)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return -1, "hangs"


def nan_saved(folder: Path) -> bool:
    for file in folder.glob("runs/*/*.pt"):
        weights = torch.load(file, weights_only=True)["weights"].values()
        if not all(tensor.isfinite().all() for tensor in weights):
            return True
    return False


def flags(args: Any) -> list[str]:
    names = [name for name in vars(args) if name != "env"]
    names += [f"env.{name}" for name in crane_options.DEFAULTS] if hasattr(args, "env") else []
    return ["--" + name.replace("_", "-") for name in names if name != "path"]


def arguments() -> list[Row]:
    """A command line fails here by a traceback, by taking a minute, or by saving NaN."""
    torch.set_num_threads(1)
    tasks: list[tuple[Path, list[str], list[str]]] = []
    for algorithm in ALGORITHMS:
        base = [*small(algorithm), "--total-timesteps", "128", "--eval-every", "2"]
        script = ROOT / f"{algorithm}_crane.py"
        tasks.append((script, base, flags(module(algorithm).Args())))
    base = ["--policy", "zero", "--trials", "1", "--diameters", "0.5", "--env-threads", "1"]
    tasks.append((ROOT / "eval_crane.py", base, ["", *flags(eval_crane.Args())]))
    rows = []
    for script, base, names in tasks:
        failures, refused, lines = [], 0, [(n, v) for n in names for v in VALUES]
        for name, value in tqdm(lines, desc=script.stem):
            folder = Path(tempfile.mkdtemp())
            given = [name, value] if name else [value]
            status, output = in_fork(script, base + given, folder)
            refused += status > 0
            if "Traceback" in output or status < 0 or nan_saved(folder):
                failures.append(f"{name} {value}")
                tqdm.write(f"{script.stem} {name} {value}: {status}\n{output[-1500:]}")
            shutil.rmtree(folder)
        note = f"{refused} refused" + (f"; failed: {', '.join(failures)}" if failures else "")
        rows.append((script.name, len(lines), "command lines", len(failures), note))
    return rows


PARTS = {"steps": steps, "memory": memory, "kills": kills, "arguments": arguments}


def main(part: Positional[Literal["steps", "memory", "kills", "arguments"]]) -> None:
    found = [(part, *row) for row in PARTS[part]()]
    old = list(csv.reader(open(RESULTS)))[1:] if RESULTS.exists() else []
    with open(RESULTS.with_suffix(".tmp"), "w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(
            [COLUMNS, *(row for row in old if row[0] != part), *found]
        )
    os.replace(RESULTS.with_suffix(".tmp"), RESULTS)
    for row in found:
        print(*row, sep=", ")
    sys.exit(int(any(row[4] for row in found)))


if __name__ == "__main__":
    crane_runs.one_line_errors()
    tyro.cli(main, description=__doc__)
