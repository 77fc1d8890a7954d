"""Draw curves/*.csv and ablations/*.csv into assets/figures, and print what they say.

A run is there with the first evaluation at or above the paper's 96.3 % after which none falls below
95 %; minutes are those of rollouts and updates, without evaluations, as the run was run.

    python benchmark/plot_curves.py
"""

import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402

HERE = Path(__file__).parent
FIGURES = HERE.parent / "assets" / "figures"
Run = dict[str, np.ndarray]  # columns, NaN where nothing was recorded


def read(folder: str) -> dict[str, list[Run]]:
    """Runs by name, one a seed."""
    runs: dict[str, list[Run]] = {}
    for path in sorted((HERE / folder).glob("*_seed*.csv")):
        with open(path) as file:
            rows = list(csv.DictReader(file))
        run = {key: np.array([float(row[key] or "nan") for row in rows]) for key in rows[0]}
        run["seed"] = path.stem.split("_seed")[1]
        run["minutes"] = np.nancumsum(run["rollout_s"] + run["update_s"]) / 60
        runs.setdefault(path.stem.split("_seed")[0], []).append(run)
    return runs


def recorded(run: Run, x: str, y: str) -> tuple[np.ndarray, np.ndarray]:
    there = np.isfinite(run[y])
    return run[x][there], run[y][there]


def first_lasting(run: Run, level: float = 0.963, floor: float = 0.95) -> int | None:
    """Row of the first evaluation at level after which none is below floor."""
    rows = np.flatnonzero(np.isfinite(run["eval_success_rate"]))
    for row in rows:
        success = run["eval_success_rate"][rows[rows >= row]]
        if success[0] >= level and success.min() >= floor:
            return int(row)
    return None


def draw(axis: plt.Axes, runs: list[Run], x: str, y: str, scale: float, **style) -> None:
    """Mean over seeds at the first one's points, their spread shaded."""
    points = [recorded(run, x, y) for run in runs]
    xs = points[0][0][points[0][0] <= min(x[-1] for x, _ in points)]
    ys = np.array([np.interp(xs, *point) for point in points])
    axis.plot(xs * scale, ys.mean(0), **style)
    axis.fill_between(xs * scale, ys.min(0), ys.max(0), color=style["color"], alpha=0.2)


def learning_curves(runs: dict[str, list[Run]]) -> None:
    axes_of = [
        ("decisions", 1e-6, "decisions [million]"),
        ("decisions", 20e-6, "simulation steps [million]"),
        ("updates", 1, "updates"),
        ("minutes", 1, "minutes of training"),
    ]
    rows = [("eval_success_rate", "success of the mean action"), ("episodic_return", "return")]
    figure, axes = plt.subplots(2, 4, figsize=(13, 5.2), sharey="row")
    for color, (name, seeds) in enumerate(runs.items()):
        for line, (y, title) in enumerate(rows):
            for column, (x, scale, unit) in enumerate(axes_of):
                axis = axes[line, column]
                draw(axis, seeds, x, y, scale, color=f"C{color}", label=f"{name} ({len(seeds)})")
                axis.set_xlabel(unit)
                axis.grid(alpha=0.3)
            axes[line, 0].set_ylabel(title)
        for run in seeds:
            row, when = first_lasting(run), "never"
            if row is not None:
                when = f"after {run['decisions'][row] / 1e6:.2f} M, {run['minutes'][row]:.1f} min"
            total = f"{run['minutes'][-1]:.1f} min in all"
            print(f"{name}, seed {run['seed']}: 96.3 % for good {when}; {total}")
    axes[0, 0].legend(fontsize=7, title="(seeds)", title_fontsize=7)
    figure.tight_layout()
    figure.savefig(FIGURES / "learning_curves.png", dpi=80)


def ablations(runs: dict[str, list[Run]]) -> None:
    """Success of every seed's final policy, and the first update whose policy has half of it."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4.2), sharey=True)
    names = sorted(runs, key=lambda name: (name != "default", name))
    print("| ablation | final success %, seeds | half succeed after [updates] |\n|-|-|-|")
    for height, name in enumerate(reversed(names)):
        final = [
            100 * recorded(run, "decisions", "final_success_rate")[1][-1] for run in runs[name]
        ]
        half = []
        for run in runs[name]:
            updates, success = recorded(run, "updates", "eval_success_rate")
            half.append(updates[np.argmax(success >= 0.5)] if success.max() >= 0.5 else np.nan)
        left.plot(final, [height] * len(final), "o")
        right.plot(half, [height] * len(half), "o")
        print(f"| {name} | {', '.join(f'{x:.1f}' for x in final)} | ", end="")
        print(", ".join(f"{x:.0f}" if np.isfinite(x) else "never" for x in half), "|")
    left.set_yticks(range(len(names)), list(reversed(names)))
    left.set_xlabel("success of the final policy [%]")
    right.set_xlabel("updates until the mean action succeeds in half of its trials")
    for axis in (left, right):
        axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(FIGURES / "ablations.png", dpi=100)


def main() -> None:
    learning_curves(read("curves"))
    if (HERE / "ablations").is_dir():
        ablations(read("ablations"))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
