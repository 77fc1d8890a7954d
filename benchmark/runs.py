"""Make the trainings behind the figures and tables, and evaluate their policies.

    python benchmark/runs.py                             # all that are missing, days on two cores
    python benchmark/runs.py --only curves/ hydraulic    # those with a part of their name

The run curves/ppo_crane_seed21 gets a row an update in benchmark/results/curves/. If its file is
there, it is not made again. Two trainings run side by side with one thread each, those whose
minutes count alone with two. Ctrl-C (not `kill`) stops them after their update, and the next call
resumes them from benchmark/runs/ with their old flags. After a change of the task or of a run's
flags delete its folder there.

Final policies of curves/, levels/, loading/ and short/ get 600 trials of seed 60000 with exact pose
and 600 with pose errors: benchmark/results/evaluations.csv, without runs whose own file is gone.
"""

import csv
import json
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parent.parent))

import numpy as np
import tyro
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tqdm import tqdm

from crane_utils.runs import load
from crane_utils.trials import REPORT_SEED

HERE = Path(__file__).parent
ROOT = HERE.parent
RESULTS = HERE / "results"
LEVELS = {
    "ideal": "ForestryCrane-v0",
    "hydraulic": "ForestryCraneHydraulic-v0",
    "randomized": "ForestryCraneRandomized-v0",
}
LOADING = {"ideal": "ForestryCraneLoading-v0", "hydraulic": "ForestryCraneHydraulicLoading-v0"}
LABELS = {  # of the scripts, in figures and tables
    "mppo_beta_crane": "mPPO",
    "ppo_crane": "PPO",
    "trpo_crane": "TRPO",
    "recurrent_ppo_crane": "recurrent PPO",
}

# ---- all trainings. Seeds 1 ... 20 are for tuning, those below for reports

MPPO, PPO, TRPO, RECURRENT = LABELS
HYDRAULIC = f"--env-id {LEVELS['hydraulic']} --total-timesteps 2560000 --num-envs 128 "
RANDOMIZED = f"--env-id {LEVELS['randomized']} --total-timesteps 4096000 --num-envs 128 "
RANDOMIZED += "--curriculum 0.25 "
OWN = {  # flags of the scripts on both harder levels; mPPO's differ
    MPPO: "",
    PPO: "",
    TRPO: "--minibatch-size 1024 --target-kl 0.04 --fisher-samples 2048 --cg-iters 5 --retry 0.5",
    RECURRENT: "--learning-rate 7e-4",
}
HARD = {
    level: {script: flags + own for script, own in OWN.items()}
    for level, flags in (("hydraulic", HYDRAULIC), ("randomized", RANDOMIZED))
}
HARD["hydraulic"][MPPO] += "--learning-rate 1e-3"
LARGE = f"--env-id {LEVELS['randomized']} --total-timesteps 7372800 --num-envs 256 "
LARGE += "--curriculum 0.2 "
HARD["randomized"][MPPO] = LARGE + "--minibatch-size 2048 --learning-rate 7e-4"
HARD["randomized"][RECURRENT] = LARGE + "--num-minibatches 8 --log-std-init -1.6 --narrowing 1.5"
CYCLE = "--total-timesteps 8192000 --num-envs 128 --curriculum 0.3 --horizon-growth 1.5 "
CYCLE += "--reward-scale 0.02 --ent-coef 0.003 --eval-every 100 "
CYCLES = {  # mPPO loads on both levels
    MPPO: CYCLE + "--minibatch-size 2048 --learning-rate 1e-3 --env-id ",
    RECURRENT: CYCLE + "--learning-rate 7e-4 --env-id " + LOADING["hydraulic"],
}
PRINTED = "--total-timesteps 25000000 --eval-every 200 --env.reward paper --env.offset minus "
PRINTED += "--env.signed-yaw False --env.axes world"  # 500 million physics steps, as in the paper
ABLATIONS = {  # what it is in the figure, script and flags
    "default": ("mPPO, default", MPPO, ""),
    "exact": ("trained with the task's own physics steps, 5 ms", MPPO, "--physics-step 0"),
    "reward_paper": ("reward as printed in the paper", MPPO, "--env.reward paper"),
    "perturb_none": ("actions not perturbed", MPPO, "--perturbation 0"),
    # to compare with perturb_none: as wide at the start and at the end, all else equal
    "gaussian": ("Gaussian policy, not perturbed", PPO,
                 "--learning-rate 1.4e-3 --narrowing 0.83 --retry 0.5"),
    "offset_minus": ("diameter's offset subtracted", MPPO, "--env.offset minus"),
    "unsigned_yaw": ("angle to the log without its sign", MPPO, "--env.signed-yaw False"),
    "axes_world": ("log's place along the world's axes", MPPO, "--env.axes world"),
    "retry_none": ("failed starts not repeated", MPPO, "--retry 0"),
    "curriculum_none": ("full task from the start", MPPO, "--curriculum 0"),
    # as much time in each rollout, update and minibatch, and as much discount in each second
    "frame_skip_10": ("two steps per 0.1 s", MPPO, "--env.frame-skip 10 --num-steps 128 "
                      "--minibatch-size 2048 --total-timesteps 1228800 --gamma 0.98489 "
                      "--gae-lambda 0.97468 --reward-scale 0.03"),
    "frame_skip_4": ("five steps per 0.1 s", MPPO, "--env.frame-skip 4 --num-steps 320 "
                     "--minibatch-size 5120 --total-timesteps 3072000 --gamma 0.99393 "
                     "--gae-lambda 0.98979 --reward-scale 0.012"),
}  # fmt: skip
SHORT = "--total-timesteps 614400 --eval-every 10 "
HALF = "--total-timesteps 512000 --update-epochs 8 --learning-rate 1e-3 --eval-every 8"
FIVE, THREE = range(21, 26), range(21, 24)
TRAININGS = [  # folder, name, script, flags, seeds
    *[("curves", script, script, "", FIVE) for script in LABELS],
    *[("levels", f"{script}_{level}", script, flags, FIVE if level == "hydraulic" else THREE)
      for level in HARD for script, flags in HARD[level].items()],
    *[("loading", f"{MPPO}_{level}", MPPO, CYCLES[MPPO] + env_id, THREE)
      for level, env_id in LOADING.items()],
    ("loading", f"{RECURRENT}_hydraulic", RECURRENT, CYCLES[RECURRENT], (21,)),
    ("printed", MPPO, MPPO, PRINTED, (21,)),
    ("short", MPPO, MPPO, HALF, FIVE),
    *[("ablations", name, script, SHORT + flags, THREE)
      for name, (_, script, flags) in ABLATIONS.items()],
]  # fmt: skip
METRICS = ("peak [kN]", "oil [l]", "energy [kJ]", "up [s]", "swing [rad]")  # of eval_crane.py
TAGS = ["charts/episodic_return", "charts/success_rate", "charts/SPS"]
TAGS += ["eval/success_rate", "eval/gentle_rate", "eval/episodic_return"]
COLUMNS = {tag: tag.removeprefix("charts/").replace("/", "_") for tag in TAGS}
Curve = dict[str, np.ndarray]  # columns, a value for each evaluation
WRITING = threading.Lock()  # of CSV files


class Run(NamedTuple):
    folder: str
    name: str
    script: str
    flags: str
    seed: int

    def __str__(self) -> str:
        return f"{self.folder}/{self.name}_seed{self.seed}"

    @property
    def alone(self) -> bool:
        """Whether it has two cores for itself, as README's command has: its minutes count."""
        return (self.folder, self.script) == ("curves", MPPO)


RUNS = [Run(*training, seed) for *training, seeds in TRAININGS for seed in seeds]


# ---- files


def read_rows(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file, none if there is no file."""
    if not path.is_file():
        return []
    with open(path, encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def write_rows(path: Path, rows: list[dict]) -> None:
    """Write a CSV file whole or not at all. Its columns are those of all rows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".unfinished")
    with open(unfinished, "w", encoding="utf-8", newline="") as file:
        columns = dict.fromkeys(name for row in rows for name in row)
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    os.replace(unfinished, path)


def export(folder: Path) -> list[dict[str, str]]:
    """The rows of a run's folder: COLUMNS after each update."""
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    rows: dict[int, dict[str, str]] = {}
    for tag in COLUMNS.keys() & set(events.Tags()["scalars"]):
        for event in events.Scalars(tag):
            row = rows.setdefault(event.step, dict.fromkeys(["steps", *COLUMNS.values()], ""))
            row |= {"steps": str(event.step), COLUMNS[tag]: f"{event.value:.7g}"}
    if not rows:
        raise SystemExit(f"{folder} holds no TensorBoard scalars of a run")
    return [rows[step] for step in sorted(rows)]


def curve(rows: list[dict]) -> Curve:
    """A run's rows with an evaluation, and the minutes of rollouts and updates until then."""
    run = {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}
    seconds = np.diff(run["steps"], prepend=0) / run["SPS"]
    seconds[seconds > 10 * np.median(seconds)] = np.median(seconds)  # it was suspended
    run["minutes"] = np.cumsum(seconds) / 60
    return {name: column[np.isfinite(run["eval_success_rate"])] for name, column in run.items()}


def read_curves(folder: str) -> dict[str, dict[int, Curve]]:
    """The runs in a folder of benchmark/results/: curves by name and seed."""
    curves: dict[str, dict[int, Curve]] = {}
    files = [(*path.stem.rsplit("_seed", 1), path) for path in (RESULTS / folder).glob("*.csv")]
    for name, seed, path in sorted(files, key=lambda file: (file[0], int(file[1]))):
        curves.setdefault(name, {})[int(seed)] = curve(read_rows(path))
    return curves


# ---- runs


def evaluate(policy: str, noise: str, *flags: str) -> dict[str, float]:
    """Success of each diameter, means [%] and metrics, by eval_crane.py in trials of seed 60000."""
    command = [sys.executable, str(ROOT / "eval_crane.py"), policy, "--json", "--threads", "1"]
    command += ["--seed", str(REPORT_SEED), "--env.pose-noise", noise, *flags]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    if done.returncode:
        raise SystemExit(f"{policy} could not be evaluated")  # eval_crane.py has said why
    lines = json.loads(done.stdout)["table"]
    whole = lines.pop("all")
    row = {diameter: round(line["success %"], 1) for diameter, line in lines.items()}
    row |= {name: round(whole[f"{name} %"], 2) for name in ("success", "gentle")}
    row["failures"] = whole["failures"]
    return row | {name: whole[name] and float(f"{whole[name]:.4g}") for name in METRICS}


def make(run: Run) -> str:
    """Train or resume a run, evaluate its policy and write its rows. Returns what happened."""
    label, threads = f"{run.folder}_{run.name}", "2" if run.alone else "1"
    folders = f"runs/*__{label}__{run.seed}__*"
    command = [sys.executable, str(ROOT / f"{run.script}.py"), "--threads", threads]
    trained = False  # trained before, but not evaluated
    if begun := sorted(HERE.glob(f"{folders}/checkpoint.pt")):
        command += ["--resume", str(begun[-1].parent)]
        checkpoint = load(begun[-1])
        args, after = checkpoint["args"], checkpoint["iteration"] + 1
        trained = args["total_timesteps"] < after * args["num_envs"] * args["num_steps"]
    else:
        command += ["--exp-name", label, "--seed", str(run.seed), *run.flags.split()]
    log = HERE / f"{label}_seed{run.seed}.log"
    tqdm.write(f"{'resumed' if begun else 'started'}: {run}, see {log}")
    with open(log, "a", encoding="utf-8") as file:
        if not trained and subprocess.run(command, cwd=HERE, stdout=file, stderr=file).returncode:
            return f"stopped: {run}, see {log}"
    log.unlink()
    folder, evaluated = max(HERE.glob(folders)), []
    rows = export(folder)
    if run.folder in ("curves", "levels", "loading", "short"):
        for noise in ("none", "step"):
            key = {"run": label, "seed": run.seed, "pose_noise": noise, "trial_seed": REPORT_SEED}
            try:
                evaluated.append(key | evaluate(str(folder), noise))
            except SystemExit as error:  # the other runs go on
                return f"stopped: {run}, {error}"
    with WRITING:
        if evaluated:
            for row in read_rows(RESULTS / "evaluations.csv"):
                file = f"{row['run'].replace('_', '/', 1)}_seed{row['seed']}.csv"
                evaluated += [row] if (RESULTS / file).exists() else []
            evaluated.sort(key=lambda row: (row["run"], int(row["seed"]), row["pose_noise"]))
            write_rows(RESULTS / "evaluations.csv", evaluated)
        write_rows(RESULTS / f"{run}.csv", rows)  # last: it says that the run is finished
    return f"finished: {run}"


def main(only: tuple[str, ...] = ("",)) -> None:
    """only: parts of names: only runs with one of them."""
    runs = [run for run in RUNS if any(part in str(run) for part in only)]
    missing = [run for run in runs if not (RESULTS / f"{run}.csv").exists()]
    failed = False
    with tqdm(total=len(runs), initial=len(runs) - len(missing), unit="run") as bar:
        for side_by_side, alone in ((2, False), (1, True)):
            pool = ThreadPoolExecutor(side_by_side)
            chosen = [run for run in missing if run.alone == alone]
            futures = [pool.submit(make, run) for run in chosen]
            try:
                for future in as_completed(futures):
                    tqdm.write(future.result())
                    failed |= future.result().startswith("stopped")
                    bar.update()
            finally:  # Ctrl-C and errors start no further run
                pool.shutdown(cancel_futures=True)
    sys.exit(failed)


if __name__ == "__main__":
    try:
        tyro.cli(main, description=__doc__)
    except KeyboardInterrupt:
        sys.exit("interrupted; the same command goes on")
