"""Draw learning curves: those of the repository, or those of the runs that you name.

Minutes are those of rollouts and updates, without evaluations, on the machine of the run.

    python benchmark/plot_curves.py  # curves/, levels/ and ablations/ into assets/figures
    python benchmark/plot_curves.py runs/*__my_mppo__*/ benchmark/curves/mppo_beta_crane_seed*.csv
"""

import csv
import sys
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
matplotlib.rcParams["svg.hashsalt"] = "curves"  # the same curves give the same file
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402
from export_curve import export  # noqa: E402
from tyro.conf import Positional  # noqa: E402

HERE = Path(__file__).parent
FIGURES = HERE.parent / "assets" / "figures"
Run = dict[str, np.ndarray]  # columns, NaN where nothing was recorded; and the seed

PAPER = {"Table I": 0.963, "Table II": 0.918}  # mPPO in the paper, exact pose and with errors
LABELS = {  # names of the runs in the figures
    "mppo_beta_crane": "mPPO",
    "ppo_crane": "PPO",
    "trpo_crane": "TRPO",
    "recurrent_ppo_crane": "recurrent PPO",
}
ABLATIONS = {  # what they change
    "default": "mPPO, default",
    "reward_paper": "reward as printed in the paper",
    "perturb_none": "actions not perturbed",
    "gaussian": "Gaussian policy, not perturbed",
    "offset_minus": "diameter's offset subtracted",
    "unsigned_yaw": "angle to the log without its sign",
    "axes_world": "log's place along the world's axes",
    "retry_none": "failed starts not repeated",
    "warm_up_none": "full task from the start",
    "frame_skip_10": "two decisions per 0.1 s",
    "frame_skip_4": "five decisions per 0.1 s",
    # *: earlier settings, without r_ground and with other drives; their flags are gone
    "perturb_rpo": "mean perturbed instead (RPO) *",
    "no_bootstrap": "no bootstrapping at the time limit *",
    "curriculum": "difficulty rises with success *",
}
FRAME_SKIP = {"frame_skip_10": 10, "frame_skip_4": 4}  # of runs that do not have 20


def read_csv(path: Path) -> Run:
    """The columns of a CSV file of export_curve.py, its simulation steps and minutes.

    An update that took ten times as long as the median counts as the median: the machine was
    suspended meanwhile.
    """
    rows = []
    if path.suffix == ".csv":
        with open(path) as file:
            rows = list(csv.DictReader(file))
    if not rows or not rows[0].keys() >= {"decisions", "rollout_s", "update_s"}:
        raise SystemExit(f"{path} is no curve; benchmark/export_curve.py makes one from a run")
    run = {key: np.array([float(row[key] or "nan") for row in rows]) for key in rows[0]}
    name = path.stem.partition("_seed")[0]
    run["simulation_steps"] = run["decisions"] * FRAME_SKIP.get(name, 20)
    seconds = np.nan_to_num(run["rollout_s"] + run["update_s"])
    seconds[seconds > 10 * np.median(seconds)] = np.median(seconds)
    run["minutes"] = np.cumsum(seconds) / 60
    return run


def read(folder: str) -> dict[str, list[Run]]:
    """Runs by name, one a seed."""
    runs: dict[str, list[Run]] = {}
    for path in sorted((HERE / folder).glob("*_seed*.csv")):
        name, seed = path.stem.split("_seed")
        runs.setdefault(name, []).append(read_csv(path) | {"seed": seed})
    return runs


def read_paths(paths: tuple[Path, ...]) -> dict[str, list[Run]]:
    """Runs by name and task, from folders of runs and from CSV files of export_curve.py."""
    runs: dict[str, list[Run]] = {}
    for path in paths:
        if path.is_dir():
            task, *name = path.resolve().name.split("__")  # <task>__<name>__<seed>__<time>
            name = f"{name[0]} ({task})" if name else task
            with tempfile.TemporaryDirectory() as folder:
                export(path, Path(folder) / "curve.csv")
                run = read_csv(Path(folder) / "curve.csv")
        elif path.is_file():
            name, run = path.stem.partition("_seed")[0], read_csv(path)
        else:
            raise SystemExit(f"no run and no CSV file {path}")
        if not np.isfinite(run.get("eval_success_rate", np.nan)).any():
            raise SystemExit(f"{path} has no evaluation on the crane yet (--eval-every)")
        runs.setdefault(name, []).append(run)
    return runs


def recorded(run: Run, x: str, y: str) -> tuple[np.ndarray, np.ndarray]:
    there = np.isfinite(run[y])
    return run[x][there], run[y][there]


def draw(axis: plt.Axes, runs: list[Run], x: str, y: str, scale: float, **style) -> None:
    """Means of x and y over the seeds at the decisions of the first seed; the range of y shaded."""
    points = [recorded(run, "decisions", y) for run in runs]
    end = min(decisions[-1] for decisions, _ in points)
    decisions = np.append(points[0][0][points[0][0] < end], end)
    ys = np.array([np.interp(decisions, *point) for point in points])
    xs = np.mean([np.interp(decisions, run["decisions"], run[x]) for run in runs], axis=0)
    axis.plot(xs * scale, ys.mean(0), **style)
    axis.fill_between(xs * scale, ys.min(0), ys.max(0), color=style["color"], alpha=0.2)


def save(figure: plt.Figure, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=200, metadata={"Date": None} if path.suffix == ".svg" else None)
    plt.close(figure)


def learning_curves(runs: dict[str, list[Run]], path: Path) -> None:
    columns = [("decisions", 1e-6, "decisions [million]"), ("minutes", 1, "minutes of training")]
    rows = [
        ("eval_success_rate", "success of the mean action"),
        ("eval_episodic_return", "return of the mean action"),
    ]
    figure, axes = plt.subplots(2, 2, figsize=(10, 6.4), sharex="col", sharey="row")
    for color, (name, seeds) in enumerate(runs.items()):
        for line, (y, title) in enumerate(rows):
            for column, (x, scale, _) in enumerate(columns):
                count = f"{len(seeds)} run{'s' if len(seeds) > 1 else ''}"
                label = f"{LABELS.get(name, name)}, {count}"
                draw(axes[line, column], seeds, x, y, scale, color=f"C{color}", label=label)
                axes[line, column].grid(alpha=0.3)
            axes[line, 0].set_ylabel(title)
    for axis, (_, _, unit) in zip(axes[-1], columns):
        axis.set_xlabel(unit)
    for axis in axes[0]:
        axis.axhline(PAPER["Table I"], color="black", ls="--", lw=1, label="paper, mPPO, Table I")
    axes[0, 0].legend(fontsize=8)
    save(figure, path)


def level_curves(runs: dict[str, list[Run]], path: Path) -> None:
    """Success and gentle success on the harder levels."""
    rows = [("eval_success_rate", "success"), ("eval_gentle_rate", "gentle success")]
    figure, axes = plt.subplots(2, 2, figsize=(10, 6.4), sharex="col", sharey=True)
    for column, level in enumerate(("hydraulic", "randomized")):
        for line, (y, title) in enumerate(rows):
            axis = axes[line, column]
            for color, (script, label) in enumerate(LABELS.items()):
                if seeds := runs.get(f"{script}_{level}"):
                    draw(axis, seeds, "decisions", y, 1e-6, color=f"C{color}", label=label)
            axis.grid(alpha=0.3)
            axes[line, 0].set_ylabel(f"{title} of the mean action")
        axes[0, column].set_title(f"{level} level")
        axes[1, column].set_xlabel("decisions [million]")
    axes[0, 0].legend(fontsize=8)
    save(figure, path)


def ablations(runs: dict[str, list[Run]], path: Path) -> None:
    """One line per change with a dot per seed."""
    shown = {name: label for name, label in ABLATIONS.items() if name in runs}
    if not shown:
        return
    figure, axis = plt.subplots(figsize=(8, 0.36 * len(shown) + 1))
    for row, name in enumerate(reversed(shown)):
        for run in runs[name]:
            color = f"C{int(run['seed']) - 1}"
            axis.plot(100 * run["final_success_rate"][-1], row, "o", color=color, alpha=0.8)
    for seed in (1, 2):
        axis.plot([], [], "o", color=f"C{seed - 1}", label=f"training seed {seed}")
    axis.axvline(100 * PAPER["Table I"], color="black", ls="--", lw=1, label="paper, mPPO, Table I")
    axis.set_yticks(range(len(shown)), list(reversed(shown.values())))
    axis.set_xlabel("success at the end of 12.3 million simulation steps [%]")
    axis.set_xlim(-2, 102)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(0.15, 0.5))
    save(figure, path)


def main(runs: Positional[tuple[Path, ...]] = (), figure: Path = Path("curves.svg")) -> None:
    """Draw.

    Args:
        runs: folders of runs, or CSV files of export_curve.py. Runs with the same name and task
            are one curve, which ends where the shortest of them ends
        figure: file for the curves of these runs, .svg, .png or .pdf
    """
    if runs:
        if figure.suffix.lower() not in (".svg", ".png", ".pdf"):
            sys.exit(f"{figure} must end in .svg, .png or .pdf")
        if not figure.absolute().parent.is_dir():
            sys.exit(f"no folder {figure.absolute().parent}; make it first")
        learning_curves(read_paths(runs), figure)
        print(f"written to {figure}")
        return
    if not (curves := read("curves")):
        sys.exit("benchmark/curves has no CSV: benchmark/make_runs.py curves makes them")
    curves = {name: curves[name] for name in LABELS if name in curves}  # colours as in levels
    learning_curves(curves, FIGURES / "learning_curves.svg")
    level_curves(read("levels"), FIGURES / "level_curves.svg")
    ablations(read("ablations"), FIGURES / "ablations.svg")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
