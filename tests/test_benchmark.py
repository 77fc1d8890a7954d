"""The scripts of benchmark/ start, and the plain crane is the crane."""

import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).parent.parent / "benchmark"
sys.path.insert(0, str(BENCHMARK))

import plain_crane  # noqa: E402

import crane_policies  # noqa: E402
import eval_crane  # noqa: E402

# the others need benchmark/requirements.txt, or have no --help
SCRIPTS = (
    "clone_scripted", "export_curve", "gpu", "leaderboard", "levels", "make_pictures", "make_runs",
    "plot_curves", "profiles", "rivals", "scaling", "sdf_search", "soak", "tune_scripted",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_the_scripts_explain_themselves(script, tmp_path):
    command = [sys.executable, str(BENCHMARK / f"{script}.py"), "--help"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert ran.returncode == 0 and ran.stdout.startswith("usage: "), ran.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("frame_skip", [20, 1])
def test_the_plain_crane_is_the_same_task(frame_skip):
    """What throughput.py compares the speed with: to rounding, with contacts and rewards."""
    policy, task, _ = crane_policies.load_policy(crane_policies.SHIPPED)
    _, options = eval_crane.task_of(eval_crane.Args(), task)
    assert max(plain_crane.disagreement(policy, options, frame_skip)) < 1e-3
