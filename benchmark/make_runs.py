"""Make the training runs behind the figures.

    python benchmark/make_runs.py curves      # four algorithms, three seeds; 1.5 to 2 hours
    python benchmark/make_runs.py levels      # the same on the two harder levels; 12 hours
    python benchmark/make_runs.py ablations   # mPPO with one thing changed, two seeds; 2 to 3 hours
    python benchmark/make_runs.py short       # mPPO with half of the decisions, three seeds; 0.5 h
    python benchmark/make_runs.py timed       # mPPO, one at a time: three seeds of the ideal level,
                                              # one of each harder level; 1.5 hours

Two trainings run at a time, with one thread each. The timed runs train alone, with two threads.
The runs of curves, levels and short are then judged in 600 trials of seed 60000: evaluations.csv.

Run the script again to go on. It skips each run that has a CSV file in benchmark/curves/, levels/,
ablations/, short/ or timed/. It resumes an interrupted run from its checkpoint in benchmark/runs/.
To make a run again, delete both. After a change of the task or of a default, delete all of
benchmark/runs/.
"""

import csv
import json
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from subprocess import PIPE
from typing import Literal

sys.path.insert(0, str(Path(__file__).parent.parent))

import tyro
from crane_trials import REPORT_SEED
from export_curve import export
from tqdm import tqdm
from tyro.conf import Positional

HERE = Path(__file__).parent
WRITING = threading.Lock()  # of evaluations.csv
SCRIPTS = ("mppo_beta_crane", "trpo_crane", "ppo_crane", "recurrent_ppo_crane")
LEVELS = {  # flags of each script on the harder levels
    "Hydraulic": {
        "mppo_beta_crane": "--total-timesteps 1536000 --learning-rate 4e-4 --num-envs 128 "
        "--minibatch-size 2048",
        "trpo_crane": "--total-timesteps 1536000 --warm-up 0.6 --num-envs 128 "
        "--minibatch-size 2048 --fisher-samples 2048 --cg-iterations 5 "
        "--env.retry 0.5",
        "ppo_crane": "--total-timesteps 1536000 --num-envs 128 --minibatch-size 2048",
        "recurrent_ppo_crane": "--total-timesteps 1536000 --learning-rate 7e-4 --num-envs 128 "
        "--env.retry 0.5",
    },
    "Randomized": {
        "mppo_beta_crane": "--total-timesteps 4096000 --learning-rate 5e-4 --warm-up 0.2 "
        "--perturbed 0.2 --num-envs 128 --minibatch-size 2048",
        "trpo_crane": "--total-timesteps 4096000 --warm-up 0.2 --num-envs 128 "
        "--minibatch-size 2048 --fisher-samples 2048 --cg-iterations 5 "
        "--env.retry 0.5",
        "ppo_crane": "--total-timesteps 4096000 --learning-rate 5e-4 --warm-up 0.2 --num-envs 128 "
        "--minibatch-size 2048",
        "recurrent_ppo_crane": "--total-timesteps 4096000 --learning-rate 7e-4 --warm-up 0.2 "
        "--num-envs 128 --env.retry 0.5",
    },
}
SHORT = "--total-timesteps 614400 --eval-every 10".split()

# Script and flags by name. At another decision rate the number of simulation steps, updates and
# minibatches stays the same. The CSV files of perturb_rpo, no_bootstrap and curriculum stay: their
# flags are gone.
ABLATIONS = {
    "default": ("mppo_beta_crane", ""),
    "reward_paper": ("mppo_beta_crane", "--env.reward paper"),
    "perturb_none": ("mppo_beta_crane", "--perturbation 0"),
    # to compare with perturb_none: as wide at the start and at the end, all else equal
    "gaussian": ("ppo_crane", "--learning-rate 1e-3 --narrowing 0.83 --env.retry 0.5"),
    "offset_minus": ("mppo_beta_crane", "--env.offset minus"),
    "unsigned_yaw": ("mppo_beta_crane", "--env.no-signed-yaw"),
    "axes_world": ("mppo_beta_crane", "--env.axes world"),
    "warm_up_none": ("mppo_beta_crane", "--warm-up 0"),
    "retry_none": ("mppo_beta_crane", "--env.retry 0"),
    "frame_skip_10": (
        "mppo_beta_crane",
        "--env.frame-skip 10 --num-steps 128 --minibatch-size 2048 --total-timesteps 1228800",
    ),
    "frame_skip_4": (
        "mppo_beta_crane",
        "--env.frame-skip 4 --num-steps 320 --minibatch-size 5120 --total-timesteps 3072000",
    ),
}


def make(folder: str, script: str, name: str, seed: int, flags: list[str], threads: int) -> str:
    """Train or resume a run and export its curve. Returns a line that says what happened."""
    csv_path = HERE / folder / f"{name}_seed{seed}.csv"
    command = [sys.executable, str(HERE.parent / f"{script}.py")]
    command += ["--torch-threads", str(threads), "--env-threads", str(threads)]
    run_name = f"{folder}_{name}"
    begun = sorted(HERE.glob(f"runs/*__{run_name}__{seed}__*/checkpoint.pt"))
    if begun:
        command += ["--resume", str(begun[-1].parent)]
    else:
        command += ["--exp-name", run_name, "--seed", str(seed), *flags]
    with open(HERE / f"{run_name}_seed{seed}.log", "a") as log:
        tqdm.write(f"{'resumed' if begun else 'started'} {run_name}, seed {seed}: {log.name}")
        code = subprocess.run(command, cwd=HERE, stdout=log, stderr=log).returncode
    if code:
        return f"{run_name}, seed {seed}: stopped, see {log.name}"
    Path(log.name).unlink()
    csv_path.parent.mkdir(exist_ok=True)
    run = max(HERE.glob(f"runs/*__{run_name}__{seed}__*"))
    if folder in ("curves", "levels", "short"):
        evaluate(run_name, seed, run)
    export(run, csv_path)
    return f"{csv_path.name} written"


def evaluate(name: str, seed: int, run: Path) -> None:
    """Judge a finished run in 600 trials of seed 60000: its rows of evaluations.csv, in %.

    One row with the exact pose and one with pose errors: a column a diameter, then the means of
    success and of gentle success, and what the trials cost, as eval_crane.py prints it.
    """
    path, rows, new = HERE / "evaluations.csv", {}, {}
    for noise in ("none", "step"):
        command = [sys.executable, str(HERE.parent / "eval_crane.py"), str(run)]
        command += ["--json", "--seed", str(REPORT_SEED), "--pose-noise", noise]
        command += ["--env-threads", "1"]  # another training has the other core
        result = json.loads(subprocess.run(command, stdout=PIPE, check=True).stdout)
        row = {"run": name, "seed": str(seed), "pose_noise": noise, "trial_seed": result["seed"]}
        for cell in result["cells"]:
            row[f"{cell['diameter']} m"] = round(100 * cell["success_rate"], 1)
        for score in ("success", "gentle"):
            row[score] = round(100 * result[f"mean_{score}_rate"], 2)
        row |= {name: cost and float(f"{cost:.4g}") for name, cost in result["costs"].items()}
        new[name, str(seed), noise] = row
    with WRITING:
        if path.exists():
            with open(path, newline="") as file:
                rows = {tuple(row.values())[:3]: row for row in csv.DictReader(file)}
        rows |= new
        part = path.with_suffix(".part")
        with open(part, "w", newline="") as file:
            writer = csv.DictWriter(file, row)
            writer.writeheader()
            writer.writerows(rows[key] for key in sorted(rows))
        part.replace(path)


def level_job(script: str, level: str, seed: int, flags: list[str], threads: int) -> tuple:
    """A training on one of LEVELS, as `make` takes it."""
    flags = [*flags, "--env-id", f"ForestryCrane{level}-v0", *LEVELS[level][script].split()]
    return script, f"{script}_{level.lower()}", seed, flags, threads


def main(what: Positional[Literal["curves", "levels", "ablations", "short", "timed"]]) -> None:
    if what == "curves":
        jobs = [(name, name, seed, [], 1) for seed in (1, 2, 3) for name in SCRIPTS]
    elif what == "levels":
        jobs = [
            level_job(name, level, seed, [], 1)
            for seed in (1, 2, 3)
            for level in LEVELS
            for name in SCRIPTS
        ]
    elif what == "short":
        half = ["--total-timesteps", "512000", "--eval-every", "8"]
        jobs = [(SCRIPTS[0], SCRIPTS[0], seed, half, 1) for seed in (1, 2, 3)]
    elif what == "timed":
        exact = ["--eval-trials", "100"]
        jobs = [(SCRIPTS[0], SCRIPTS[0], seed, exact, 2) for seed in (1, 2, 3)]
        jobs += [level_job(SCRIPTS[0], level, 1, exact, 2) for level in LEVELS]
    else:
        jobs = [
            (script, name, seed, [*SHORT, *flags.split()], 1)
            for seed in (1, 2)
            for name, (script, flags) in ABLATIONS.items()
        ]
    missing = [job for job in jobs if not (HERE / what / f"{job[1]}_seed{job[2]}.csv").exists()]
    done, failed = len(jobs) - len(missing), False
    with ThreadPoolExecutor(1 if what == "timed" else 2) as pool:
        runs = [pool.submit(make, what, *job) for job in missing]
        try:
            for run in tqdm(as_completed(runs), total=len(jobs), initial=done):
                tqdm.write(run.result())
                failed |= "stopped" in run.result()
        finally:  # Ctrl-C and errors start no further run
            pool.shutdown(cancel_futures=True)
    sys.exit(failed)


if __name__ == "__main__":
    try:
        tyro.cli(main, description=__doc__)
    except KeyboardInterrupt:
        sys.exit("interrupted; run it again to go on")
