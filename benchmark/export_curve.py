"""Turn a run's TensorBoard events into a CSV file, one row an update.

python benchmark/export_curve.py runs/<run> benchmark/curves/<name>.csv
"""

import csv
from pathlib import Path

import tyro
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tyro.conf import Positional

COLUMNS = {
    "time/updates": "updates",
    "charts/episodic_return": "episodic_return",
    "charts/episodic_length": "episodic_length",
    "charts/success_rate": "training_success_rate",
    "time/SPS": "decisions_per_second",
    "time/rollout": "rollout_s",
    "time/update": "update_s",
    "losses/approx_kl": "approx_kl",
    "trpo/kl": "approx_kl",
    "eval/success_rate": "eval_success_rate",
    "eval/gentle_rate": "eval_gentle_rate",
    "eval/episodic_return": "eval_episodic_return",
    "final/success_rate": "final_success_rate",
    "final/gentle_rate": "final_gentle_rate",
}


def export(run_dir: Positional[Path], csv_path: Positional[Path]) -> None:
    """One row per number of decisions. wall_time_s counts from the end of the first update."""
    if not run_dir.is_dir():
        raise SystemExit(f"{run_dir} is not the folder of a run")
    events = EventAccumulator(str(run_dir), size_guidance={"scalars": 0})
    events.Reload()
    rows: dict[int, dict] = {}
    for tag, column in COLUMNS.items():
        if tag in events.Tags()["scalars"]:
            for event in events.Scalars(tag):
                row = rows.setdefault(event.step, {"decisions": event.step})
                row[column] = round(event.value, 5)
                row["wall_time"] = max(row.get("wall_time", 0.0), event.wall_time)
    if not rows:
        raise SystemExit(f"{run_dir} holds no TensorBoard scalars")
    start = min(row["wall_time"] for row in rows.values())
    for row in rows.values():
        row["wall_time_s"] = round(row.pop("wall_time") - start, 1)
    csv_path.parent.mkdir(parents=True, exist_ok=True)
    part = csv_path.with_suffix(".part")  # a CSV file says that the run is finished
    with open(part, "w", newline="") as file:
        writer = csv.DictWriter(
            file, ["decisions", "wall_time_s", *dict.fromkeys(COLUMNS.values())]
        )
        writer.writeheader()
        writer.writerows(rows[step] for step in sorted(rows))
    part.replace(csv_path)


if __name__ == "__main__":
    tyro.cli(export, description=__doc__)
