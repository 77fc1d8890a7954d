"""benchmark/plot_curves.py: the runs that a user names."""

import sys
from pathlib import Path

import numpy as np
import pytest
from script_runs import ROOT
from torch.utils.tensorboard import SummaryWriter

sys.path.insert(0, str(ROOT / "benchmark"))
import plot_curves


def run_folder(folder: Path, success: list[float]) -> Path:
    """What a run with an evaluation each 100 decisions leaves."""
    with SummaryWriter(folder) as writer:
        for k, share in enumerate(success, 1):
            writer.add_scalar("time/rollout", 40.0, 100 * k)
            writer.add_scalar("time/update", 20.0, 100 * k)
            writer.add_scalar("eval/success_rate", share, 100 * k)
            writer.add_scalar("eval/episodic_return", 10 * share, 100 * k)
    return folder


def test_runs_of_one_name_and_task_are_one_curve(tmp_path):
    folders = [
        run_folder(tmp_path / f"Task-v0__mine__{seed}__0_{seed}", [0.25, 0.5 * seed])
        for seed in (1, 2)
    ]
    ours = ROOT / "benchmark" / "curves" / "ppo_crane_seed1.csv"
    runs = plot_curves.read_paths((*folders, ours))
    counts = {name: len(seeds) for name, seeds in runs.items()}
    assert counts == {"mine (Task-v0)": 2, "ppo_crane": 1}
    first, second = runs["mine (Task-v0)"]
    assert list(first["minutes"]) == [1, 2] and list(second["eval_success_rate"]) == [0.25, 1]
    plot_curves.main((*folders, ours), tmp_path / "mine.svg")
    drawn = (tmp_path / "mine.svg").read_text()
    assert "<!-- mine (Task-v0), 2 runs -->" in drawn and "<!-- PPO, 1 run -->" in drawn


def test_a_curve_has_the_mean_minutes_of_its_seeds():
    """A slow seed counts to its end: the mean does not stop where the fastest seed ends."""
    decisions, success = np.array([100.0, 200.0]), {1: [0.0, 1.0], 3: [0.0, 0.5]}
    runs = [
        {"decisions": decisions, "minutes": k * np.array([1.0, 2.0]), "success": np.array(y)}
        for k, y in success.items()
    ]
    axis = plot_curves.plt.figure().add_subplot()
    plot_curves.draw(axis, runs, "minutes", "success", 1.0, color="C0")
    assert axis.lines[0].get_xdata().tolist() == [2, 4]
    assert axis.lines[0].get_ydata().tolist() == [0, 0.75]


def test_a_pause_is_no_training(tmp_path):
    """An update of ten minutes among updates of a minute counts as a minute."""
    rows = [f"{100 * k},{580.0 if k == 3 else 40.0},20.0" for k in range(1, 6)]
    path = tmp_path / "mine_seed1.csv"
    path.write_text("\n".join(["decisions,rollout_s,update_s", *rows]))
    assert plot_curves.read_csv(path)["minutes"].tolist() == [1, 2, 12, 13, 14]
    path.write_text(path.read_text().replace("580.0", "581.0"))
    assert plot_curves.read_csv(path)["minutes"].tolist() == [1, 2, 3, 4, 5]


def test_what_cannot_be_drawn_is_said_in_a_line(tmp_path):
    (tmp_path / "empty").mkdir()
    run_folder(tmp_path / "new", [])
    SummaryWriter(tmp_path / "blind").add_scalar("time/rollout", 1.0, 1)
    cases = {
        "nowhere": "no run and no CSV file",
        "empty": "holds no TensorBoard scalars",
        "new": "holds no TensorBoard scalars",
        "blind": "has no evaluation on the crane yet",
    }
    for name, said in cases.items():
        with pytest.raises(SystemExit, match=said):
            plot_curves.main((tmp_path / name,), tmp_path / "mine.svg")
    for path in ("benchmark/evaluations.csv", "assets/policies/ppo_crane.pt"):
        with pytest.raises(SystemExit, match="is no curve"):
            plot_curves.main((ROOT / path,), tmp_path / "mine.svg")
    with pytest.raises(SystemExit, match="must end in .svg"):
        plot_curves.main((tmp_path,), tmp_path / "mine.txt")
    assert not (tmp_path / "mine.svg").exists()


def test_level_curves_leave_out_what_is_missing(tmp_path):
    runs = plot_curves.read("levels")
    del runs["trpo_crane_randomized"]
    plot_curves.level_curves(runs, tmp_path / "levels.svg")
    first = (tmp_path / "levels.svg").read_bytes()
    plot_curves.level_curves(runs, tmp_path / "levels.svg")
    assert (tmp_path / "levels.svg").read_bytes() == first
    plot_curves.level_curves(plot_curves.read("levels"), tmp_path / "levels.svg")
    assert (tmp_path / "levels.svg").read_bytes() != first
