"""Draw benchmark/curves/*.csv into assets/figures/learning_curves.png; say when each run got there.

A run is there with the first evaluation at or above the paper's 96.3 % after which none falls below
95 %; minutes are those of rollouts and updates, without evaluations, as the run was run.

    python benchmark/plot_curves.py
"""

import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import tyro  # noqa: E402

HERE = Path(__file__).parent


def column(rows: list[dict], x: str, y: str, scale: float) -> tuple[list[float], list[float]]:
    """Points of the rows in which y was recorded."""
    rows = [row for row in rows if row[y]]
    return [float(row[x]) * scale for row in rows], [100 * float(row[y]) for row in rows]


def first_lasting(rows: list[dict], level: float = 0.963, floor: float = 0.95) -> dict | None:
    """Row of the first evaluation at level after which none is below floor."""
    judged = [row for row in rows if row["eval_success_rate"]]
    for i, row in enumerate(judged):
        later = min(float(other["eval_success_rate"]) for other in judged[i:])
        if float(row["eval_success_rate"]) >= level and later >= floor:
            return row
    return None


def main() -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True)
    scripts: list[str] = []  # one colour each, whatever the seed
    for path in sorted((HERE / "curves").glob("*_seed*.csv")):
        with open(path) as file:
            rows = list(csv.DictReader(file))
        there = first_lasting(rows)
        if there is not None:
            decisions = int(there["decisions"])
            until = [row for row in rows if int(row["decisions"]) <= decisions]
            seconds = sum(float(row["rollout_s"]) + float(row["update_s"]) for row in until)
            print(f"{path.stem}: {decisions / 1e6:.2f} M decisions, {seconds / 60:.1f} min")
        script = path.stem.split("_seed")[0]
        label = script if script not in scripts else None
        scripts += [script] if label else []
        color = f"C{scripts.index(script)}"
        for axis, x, scale in ((left, "decisions", 1e-6), (right, "wall_time_s", 1 / 60)):
            training = column(rows, x, "training_success_rate", scale)
            axis.plot(*training, color=color, alpha=0.35, linewidth=1)
            axis.plot(*column(rows, x, "eval_success_rate", scale), ".-", color=color, label=label)
    left.set_xlabel("decisions [million]")
    right.set_xlabel("wall clock [min]")
    left.set_ylabel("success [%]")
    left.legend(
        fontsize=7, loc="lower right", title="thick: mean action, thin: training", title_fontsize=7
    )
    for axis in (left, right):
        axis.grid(alpha=0.3)
        axis.set_ylim(0, 100)
    figure.tight_layout()
    figure.savefig(HERE.parent / "assets" / "figures" / "learning_curves.png", dpi=130)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
