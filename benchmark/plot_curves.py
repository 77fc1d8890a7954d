"""Draw curves/*.csv and ablations/*.csv into assets/figures. Print what they and timed/*.csv say.

A run has reached the paper's 96.3 % for good at the first evaluation with 96.3 % or more that is
not the last one, if no later evaluation is below 95 %. Minutes are those of rollouts and updates,
without evaluations, on the machine of the run.

    python benchmark/plot_curves.py
"""

import csv
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402
from PIL import Image  # noqa: E402

HERE = Path(__file__).parent
FIGURES = HERE.parent / "assets" / "figures"
Run = dict[str, np.ndarray]  # columns, NaN where nothing was recorded; and the seed

# Titles and runs of the ablations. Commit c228fe1 is the last one with the flags of perturb_rpo and
# no_bootstrap. Their CSV files stay.
PANELS = {
    "reward": ("default", "reward_paper"),
    "perturbation of actions": ("default", "perturb_none", "perturb_rpo"),
    "policy, without perturbation": ("perturb_none", "gaussian"),
    "sign of the diameter's offset": ("default", "offset_minus"),
    "observed angle to the log": ("default", "unsigned_yaw"),
    "axes of the observed position": ("default", "axes_world"),
    "starts that failed before": ("default", "retry_none"),
    "start of the training": ("default", "warm_up_none"),
    "end by the time limit": ("default", "no_bootstrap"),
    "physics steps per decision": ("default", "frame_skip_10", "frame_skip_4"),
}
LABELS = {  # names of the runs in the figures
    "mppo_beta_crane": "mPPO",
    "ppo_crane": "PPO",
    "trpo_crane": "TRPO",
    "recurrent_ppo_crane": "recurrent PPO",
    "default": "mPPO, default",
    "reward_paper": "as printed in the paper",
    "perturb_none": "mPPO, not perturbed",
    "perturb_rpo": "perturbed mean (RPO)",
    "gaussian": "Gaussian PPO",
    "offset_minus": "subtracted",
    "unsigned_yaw": "without its sign",
    "axes_world": "of the world",
    "retry_none": "not repeated",
    "warm_up_none": "no easy task first",
    "no_bootstrap": "no bootstrapping",
    "frame_skip_10": "10 steps",
    "frame_skip_4": "4 steps",
}
COLORS = {"default": "C0", "perturb_rpo": "C2", "gaussian": "C2", "frame_skip_4": "C2"}
FRAME_SKIP = {"frame_skip_10": 10, "frame_skip_4": 4}  # of runs that do not have 20


def read(folder: str) -> dict[str, list[Run]]:
    """Runs by name, one a seed."""
    runs: dict[str, list[Run]] = {}
    for path in sorted((HERE / folder).glob("*_seed*.csv")):
        with open(path) as file:
            rows = list(csv.DictReader(file))
        name, seed = path.stem.split("_seed")
        run = {key: np.array([float(row[key] or "nan") for row in rows]) for key in rows[0]}
        run["seed"] = seed
        run["simulation_steps"] = run["decisions"] * FRAME_SKIP.get(name, 20)
        run["minutes"] = np.nancumsum(run["rollout_s"] + run["update_s"]) / 60
        runs.setdefault(name, []).append(run)
    return runs


def recorded(run: Run, x: str, y: str) -> tuple[np.ndarray, np.ndarray]:
    there = np.isfinite(run[y])
    return run[x][there], run[y][there]


def first_lasting(run: Run, level: float = 0.963, floor: float = 0.95) -> int | None:
    """Row of the first evaluation at level after which none is below floor."""
    rows = np.flatnonzero(np.isfinite(run["eval_success_rate"]))
    for row in rows:
        success = run["eval_success_rate"][rows[rows >= row]]
        if len(success) > 1 and success[0] >= level and success.min() >= floor:
            return int(row)
    return None


def draw(axis: plt.Axes, runs: list[Run], x: str, y: str, scale: float, **style) -> None:
    """Mean over the seeds at the points of the first seed, with their range shaded."""
    points = [recorded(run, x, y) for run in runs]
    end = min(x[-1] for x, _ in points)
    xs = np.append(points[0][0][points[0][0] < end], end)
    ys = np.array([np.interp(xs, *point) for point in points])
    axis.plot(xs * scale, ys.mean(0), **style)
    axis.fill_between(xs * scale, ys.min(0), ys.max(0), color=style["color"], alpha=0.2)


def save(figure: plt.Figure, name: str) -> None:
    figure.tight_layout()
    figure.savefig(FIGURES / name, dpi=80)
    Image.open(FIGURES / name).quantize(64).save(FIGURES / name, optimize=True)  # a third in size


def learning_curves(runs: dict[str, list[Run]]) -> None:
    columns = [("decisions", 1e-6, "decisions [million]"), ("minutes", 1, "minutes of training")]
    rows = [
        ("eval_success_rate", "success of the mean action"),
        ("eval_episodic_return", "return of the mean action"),
        ("episodic_return", "return in training"),
    ]
    figure, axes = plt.subplots(3, 2, figsize=(10, 8), sharex="col", sharey="row")
    for color, (name, seeds) in enumerate(runs.items()):
        for line, (y, title) in enumerate(rows):
            for column, (x, scale, _) in enumerate(columns):
                style = {"color": f"C{color}", "label": f"{LABELS.get(name, name)} ({len(seeds)})"}
                draw(axes[line, column], seeds, x, y, scale, **style)
                axes[line, column].grid(alpha=0.3)
            axes[line, 0].set_ylabel(title)
    for axis, (_, _, unit) in zip(axes[-1], columns):
        axis.set_xlabel(unit)
    for height, factor, unit in [
        (1.0, 1e6 / 4096, "updates"),
        (1.25, 20, "simulation steps [million]"),
    ]:
        scales = (lambda x, k=factor: k * x, lambda x, k=factor: x / k)
        axes[0, 0].secondary_xaxis(height, functions=scales).set_xlabel(unit)
    axes[0, 0].legend(fontsize=8, title="(seeds)", title_fontsize=8)
    save(figure, "learning_curves.png")


def crossing(run: Run, x: str, level: float) -> float:
    """x in millions, between two evaluations, where success first reaches level, or NaN."""
    xs, success = recorded(run, x, "eval_success_rate")
    row = np.argmax(success >= level)
    if success[row] < level:
        return np.nan
    return np.interp(level, success[: row + 1][-2:], xs[: row + 1][-2:]) / 1e6


def print_times(folder: str, runs: dict[str, list[Run]]) -> None:
    """Return: of the mean action, in the last evaluation."""
    print(
        f"\n| {folder}, seed | 50 % after [M decisions] | 90 % | 96.3 % for good | minutes ", end=""
    )
    print("| all minutes | 600 trials of seed 10000 % | return |\n|-|-|-|-|-|-|-|-|")
    for name, seeds in runs.items():
        for run in seeds:
            row, good = first_lasting(run), ["never", "never"]
            if row is not None:
                good = [f"{run['decisions'][row] / 1e6:.2f}", f"{run['minutes'][row]:.1f}"]
            cells = [f"{crossing(run, 'decisions', level):.2f}" for level in (0.5, 0.9)]
            cells += [
                *good,
                f"{run['minutes'][-1]:.1f}",
                f"{100 * run['final_success_rate'][-1]:.1f}",
            ]
            returns = recorded(run, "decisions", "eval_episodic_return")[1]
            cells.append(f"{returns[-1]:.0f}")
            print(f"| {name}, {run['seed']} | {' | '.join(cells)} |")


def ablations(runs: dict[str, list[Run]]) -> None:
    """One panel per ingredient, and a table."""
    if not runs:
        return
    figure, axes = plt.subplots(2, 5, figsize=(13, 5.2), sharex=True, sharey=True)
    for axis, (title, names) in zip(axes.flat, PANELS.items()):
        for name in names:
            color = COLORS.get(name, "C1")
            for run in runs.get(name, []):  # a line each: two seeds have no spread
                xs, success = recorded(run, "simulation_steps", "eval_success_rate")
                style, label = ("-", LABELS.get(name, name)) if run["seed"] == "1" else ("--", None)
                axis.plot(xs / 1e6, success, style, color=color, lw=1.2, label=label)
        axis.set_title(title, fontsize=9)
        if axis.lines:
            axis.legend(fontsize=7, framealpha=0.4)
        axis.grid(alpha=0.3)
    figure.supxlabel("simulation steps [million]", fontsize=10)
    figure.supylabel("success of the mean action", fontsize=10)
    save(figure, "ablations.png")

    print("\n| run, seed | 50 % after [M steps] | 90 % | 600 trials of seed 10000 % ", end="")
    print("| sampled actions in the end % | return |\n|-|-|-|-|-|-|")
    for name in dict.fromkeys(name for names in PANELS.values() for name in names):
        for run in runs.get(name, []):
            cells = [f"{crossing(run, 'simulation_steps', level):.1f}" for level in (0.5, 0.9)]
            for key in ("final_success_rate", "training_success_rate"):
                cells.append(f"{100 * run[key][-1]:.1f}")
            returns = recorded(run, "decisions", "eval_episodic_return")[1]
            line = " | ".join([f"{name}, {run['seed']}", *cells, f"{returns[-1]:.0f}"])
            print(f"| {line.replace('nan', 'never')} |")


def main() -> None:
    curves = read("curves")
    if not curves:
        sys.exit("benchmark/curves has no CSV: benchmark/make_runs.py curves makes them")
    learning_curves(curves)
    print_times("curves", curves)
    print_times("timed", read("timed"))
    ablations(read("ablations"))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
