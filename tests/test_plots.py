"""benchmark/plot_curves.py: the runs that a user names."""

import sys
from pathlib import Path

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


def test_runs_of_one_name_are_its_seeds(tmp_path):
    folders = [
        run_folder(tmp_path / f"Task-v0__mine__{seed}__0_{seed}", [0.25, 0.5 * seed])
        for seed in (1, 2)
    ]
    ours = ROOT / "benchmark" / "curves" / "ppo_crane_seed1.csv"
    runs = plot_curves.read_paths((*folders, ours))
    assert {name: len(seeds) for name, seeds in runs.items()} == {"mine": 2, "ppo_crane": 1}
    first, second = runs["mine"]
    assert list(first["minutes"]) == [1, 2] and list(second["eval_success_rate"]) == [0.25, 1]
    plot_curves.main((*folders, ours), tmp_path / "mine.svg")
    drawn = (tmp_path / "mine.svg").read_text()
    assert "<!-- mine, 2 seeds -->" in drawn and "<!-- PPO, 1 seed -->" in drawn


def test_what_cannot_be_drawn_is_said_in_a_line(tmp_path):
    (tmp_path / "empty").mkdir()
    run_folder(tmp_path / "new", [])
    SummaryWriter(tmp_path / "blind").add_scalar("time/rollout", 1.0, 1)
    cases = {
        "nowhere": "no run and no CSV file",
        "empty": "holds no TensorBoard scalars",
        "new": "holds no TensorBoard scalars",
        "blind": "has no evaluation yet",
    }
    for name, said in cases.items():
        with pytest.raises(SystemExit, match=said):
            plot_curves.main((tmp_path / name,), tmp_path / "mine.svg")
    with pytest.raises(SystemExit, match="is no curve"):
        plot_curves.main((ROOT / "benchmark" / "evaluations.csv",), tmp_path / "mine.svg")
    with pytest.raises(SystemExit, match="must end in .svg"):
        plot_curves.main((tmp_path,), tmp_path / "mine.txt")
    assert not (tmp_path / "mine.svg").exists()
