"""What the documents say: their tables, their recipes, the installation."""

import csv
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import nbclient
import nbformat
import numpy as np
import pytest

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "benchmark"))

import fill_docs  # noqa: E402
import leaderboard  # noqa: E402
import make_notebook  # noqa: E402

import crane_env  # noqa: E402
import crane_policies  # noqa: E402

COMPARE = (ROOT / "docs" / "compare.md").read_text()


@pytest.mark.parametrize("path", fill_docs.DOCUMENTS, ids=lambda path: path.name)
def test_tables_are_those_of_the_csv_files(path):
    """`python benchmark/fill_docs.py` mends a failure."""
    assert fill_docs.filled(path.read_text()) == path.read_text()


def test_each_table_stands_in_one_document():
    text = "".join(path.read_text() for path in fill_docs.DOCUMENTS)
    assert all(text.count(f"<!-- {name} -->") == 1 for name in fill_docs.TABLES)
    with pytest.raises(ValueError, match="seeds has no"):
        fill_docs.filled("<!-- seeds -->\n<!-- matrix -->\n<!-- end -->")


def test_a_changed_number_is_noticed(monkeypatch):
    text = (ROOT / "README.md").read_text()
    tables = {name: fill_docs.rows_of(name) for name in ("evaluations.csv", "leaderboard.csv")}
    scores = [row for row in tables["evaluations.csv"] if row["run"] == "curves_ppo_crane"]
    for row, success in zip([r for r in scores if r["pose_noise"] == "none"], "12", strict=False):
        row["success"] = success
    monkeypatch.setattr(fill_docs, "rows_of", tables.get)
    assert fill_docs.filled(text) != text and "(1.0–" in fill_docs.filled(text)


def test_returns_outside_the_crane(monkeypatch):
    """Mean, sample deviation and worst of the seeds; of a curve, its last row."""
    run = {"task": "Echo-v0", "algorithm": "ppo", "seed": "1"}
    ours, theirs = run | {"library": "ours"}, run | {"library": "sb3"}
    tables = {
        "compare_sb3.csv": [ours | {"mean_return": r} for r in ("-5", "-1", "3")],
        "pendulum_30_seeds.csv": [r | {"mean_return": "7"} for r in (ours, ours, theirs, theirs)],
        "masked_pendulum.csv": [run | {"mean_return": r} for r in ("-9.4", "-2.4")],
    }
    tables["masked_pendulum.csv"].append(run | {"seed": "2", "mean_return": "-3.6"})
    monkeypatch.setattr(fill_docs, "rows_of", tables.get)
    assert fill_docs.outside().splitlines()[2:] == [
        "| Echo-v0 | PPO | 3 | -1 ± 4 | -5 |  |  |",
        "| Echo-v0 | PPO | 2 | 7 ± 0 | 7 | 7 ± 0 | 7 |",
    ]
    assert fill_docs.memory().splitlines()[2:] == ["| PPO | -2, -4 |"]


def run_of(success: list[float]) -> dict[str, np.ndarray]:
    """Evaluations after 1, 2 ... minutes and million decisions, with updates between them."""
    times = np.arange(2.0, 2 * len(success) + 2) / 2
    rates = np.full(len(times), np.nan)
    rates[::2] = success
    return {"minutes": times, "decisions": 1e6 * times, "eval_success_rate": rates}


@pytest.mark.parametrize(
    "success, minutes",
    [
        ([0.5, 0.97, 0.94, 0.963, 0.95, 1.0], 4),  # the first 97 % is lost again
        ([0.97, 0.962], 1),
        ([0.5, 1.0], np.nan),  # the last one keeps nothing
        ([0.962, 0.962, 0.962], np.nan),
    ],
)
def test_when_a_run_keeps_the_papers_success(success, minutes):
    np.testing.assert_equal(fill_docs.kept_after(run_of(success)), minutes)


def test_crossing_lies_between_two_evaluations():
    run = run_of([0.2, 0.8, 0.1, 0.9])
    assert fill_docs.crossing(run, "decisions", 0.5) == pytest.approx(1.5)
    assert fill_docs.crossing(run, "decisions", 0.2) == pytest.approx(1.0)
    assert np.isnan(fill_docs.crossing(run, "decisions", 0.95))


def test_all_modules_are_installed():
    installed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    modules, here = set(installed["py-modules"]), {path.stem for path in ROOT.glob("*.py")}
    assert modules <= here  # a file of the user's own may lie beside them
    for name in modules:
        text = (ROOT / f"{name}.py").read_text()
        imported = re.findall(r"^\s*(?:import|from) (\w+)", text, re.MULTILINE)
        assert here & set(imported) <= modules
    named = set(re.findall(r"`(\w+)\.py`", (ROOT / "README.md").read_text()))
    assert here & named <= modules


def recipe(number: int) -> tuple[str, list[list[str]]]:
    """Python code and command lines of a recipe in docs/compare.md."""
    text = re.split(r"## Recipe \d.*\n", COMPARE)[number].partition("\n## ")[0]
    code = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    commands = re.findall(r"```\n(.*?)```", re.sub(r"```python.*?```", "", text, flags=re.S), re.S)
    lines = [shlex.split(line) for block in commands for line in block.splitlines()]
    assert len(lines) + sum(len(block.splitlines()) for block in code) <= 15
    return "".join(code), lines


def run(folder: Path, words: list[str], *more: str) -> str:
    words = [sys.executable, str(ROOT / words[1]), *words[2:], *more]
    ran = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


QUICK = ("--trials", "1", "--diameters", "0.5", "--pose-noise", "none")


@pytest.mark.slow
def test_recipe_of_a_controller(tmp_path):
    code, (judge,) = recipe(1)
    (tmp_path / "my_controller.py").write_text(code)
    assert "mine (my_controller:Follow) on ForestryCraneHydraulic-v0" in run(
        tmp_path, judge, *QUICK
    )


@pytest.mark.slow
def test_recipe_of_stable_baselines3(tmp_path):
    code, (judge,) = recipe(2)
    (tmp_path / "train.py").write_text(code.replace("1_000_000", "4_096"))
    environment = {"PYTHONPATH": str(ROOT), "PATH": ""}
    command = [sys.executable, "train.py"]
    ran = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert "Stable-Baselines3 (sb3_ppo.zip)" in run(tmp_path, judge, *QUICK)


def test_recipe_of_a_normalized_model(tmp_path, monkeypatch, capsys):
    """The recipe acts as in the training. The bare .zip does not, and the judge warns of it."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    from sb3_crane import CraneVecEnv

    cranes = VecNormalize(CraneVecEnv(4))
    model = PPO("MlpPolicy", cranes, n_steps=16, batch_size=64, device="cpu")
    model.learn(64)
    monkeypatch.chdir(tmp_path)
    model.save("sb3_ppo")
    cranes.save("statistics.pkl")
    code, _ = recipe(4)
    (tmp_path / "my_normalized.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    obs = cranes.get_original_obs()
    expected = model.predict(cranes.normalize_obs(obs), deterministic=True)[0]
    actions = crane_policies.OwnPolicy("my_normalized:Normalized").predict(obs, None)[0]
    np.testing.assert_array_equal(actions, expected)
    bare = crane_policies.load_policy(tmp_path / "sb3_ppo.zip")[0]
    assert "was trained with VecNormalize" in capsys.readouterr().err
    assert not np.allclose(bare.predict(obs, deterministic=True)[0], expected)


@pytest.mark.slow
def test_recipe_of_an_edited_script(tmp_path):
    """With a network that the original script does not have."""
    _, (copy, train, judge) = recipe(3)
    assert copy[0] == "cp"
    edited = (ROOT / copy[1]).read_text().replace("nn.Tanh()", "nn.ELU()")
    (tmp_path / copy[2]).write_text(edited)
    words = [sys.executable, *train[1:], "--total-timesteps", "64", "--num-envs", "4"]
    words += ["--num-steps", "16", "--minibatch-size", "64", "--final-trials", "0"]
    words += ["--eval-every", "0"]
    environment = {"PYTHONPATH": str(ROOT), "PATH": ""}
    ran = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    (folder,) = (tmp_path / "runs").iterdir()
    judge[2] = str(folder)
    assert "my_mppo.py (" in run(tmp_path, judge, *QUICK)


def test_leaderboard_judges_again(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(leaderboard, "score", lambda policy, level: dict(SCORES))
    board = tmp_path / "board.csv"

    def call(*words):
        monkeypatch.setattr(sys, "argv", ["leaderboard.py", *words, "--board", str(board)])
        leaderboard.main()

    call("add", "--method", "mine", "--policy", "model.zip", "--level", "hydraulic")
    assert "replaced" not in capsys.readouterr().out
    call("add", "--method", "mine", "--policy", "better.zip", "--level", "hydraulic")
    replaced, *_ = capsys.readouterr().out.splitlines()
    assert replaced.startswith("replaced: ") and "'policy': 'model.zip'" in replaced
    call("add", "--method", "mine", "--policy", "model.zip", "--level", "ideal")
    seed_2 = ("--training-seed", "2")
    call("add", "--method", "mine", "--policy", "second.zip", "--level", "ideal", *seed_2)
    assert "replaced" not in capsys.readouterr().out
    with pytest.raises(SystemExit, match="add needs --method, --level and --policy"):
        call("add", "--method", "mine", "--policy", "model.zip")
    rows = list(csv.DictReader(board.open()))
    assert [(row["level"], row["training_seed"], row["policy"]) for row in rows] == [
        ("hydraulic", "1", "better.zip"),
        ("ideal", "1", "model.zip"),
        ("ideal", "2", "second.zip"),
    ]
    with pytest.raises(SystemExit) as good:
        call("check", "--method", "mine")
    assert good.value.code == 0
    with pytest.raises(SystemExit, match="no method 'yours'"):
        call("check", "--method", "yours")
    with pytest.raises(SystemExit, match="no method 'mine' on randomized"):
        call("check", "--method", "mine", "--level", "randomized")
    with pytest.raises(SystemExit, match="--policy is for add"):
        call("check", "--policy", "model.zip")
    theirs = ("--level", "ideal", "--author", "somebody else")
    with pytest.raises(SystemExit, match="mine on ideal is a row of ''"):
        call("add", "--method", "mine", "--policy", "other.zip", *theirs)
    board.write_text(board.read_text().replace("93.5", "95.0"))
    capsys.readouterr()
    with pytest.raises(SystemExit, match="3 differences"):
        call("check")
    assert "gentle_exact is 93.5 %, the row says 95.0 %" in capsys.readouterr().out


def test_leaderboard_goes_on_after_a_row_that_fails(tmp_path, monkeypatch, capsys):
    def score(policy: str, level: str) -> dict[str, float]:
        if policy == "gone.zip":
            raise SystemExit("gone.zip could not be judged")
        if policy == "slow.zip":  # somebody adds a row meanwhile
            others.append(dict(others[0], method="quick"))
            write()
        return dict(SCORES)

    def write():
        with board.open("w", newline="") as file:
            writer = csv.DictWriter(file, others[0])
            writer.writeheader()
            writer.writerows(others)

    def call(*words):
        monkeypatch.setattr(sys, "argv", ["leaderboard.py", *words, "--board", str(board)])
        leaderboard.main()

    monkeypatch.setattr(leaderboard, "score", score)
    board = tmp_path / "board.csv"
    row = dict.fromkeys([*leaderboard.COLUMNS, *leaderboard.SCORES], "")
    row |= {"method": "mine", "level": "ideal", "training_seed": "1", "policy": "gone.zip"}
    row["revision"] = "1"
    others = [row | {name: str(number) for name, number in SCORES.items()}]
    write()
    call("add", "--method", "slow", "--policy", "slow.zip", "--level", "ideal")
    methods = [row["method"] for row in csv.DictReader(board.open())]
    assert methods == ["mine", "quick", "slow"]
    with pytest.raises(SystemExit, match="4 differences"):
        call("check")
    said = capsys.readouterr().out
    assert "mine on ideal, seed 1: gone.zip could not be judged" in said
    assert "quick on ideal, seed 1: revision 1, the task has" in said


SCORES = {
    "success_exact": 97.0,
    "gentle_exact": 93.5,
    "success_pose_errors": 96.0,
    "gentle_pose_errors": 92.0,
}


@pytest.mark.parametrize("odd", ["mood", "method"])
def test_leaderboard_wants_its_columns(tmp_path, monkeypatch, odd):
    """One too many, and one that is missing."""
    board = tmp_path / "board.csv"
    columns = ",".join({*leaderboard.COLUMNS, *leaderboard.SCORES} ^ {odd})
    board.write_text(f"{columns}\n{columns}\n")
    monkeypatch.setattr(sys, "argv", ["leaderboard.py", "check", "--board", str(board)])
    with pytest.raises(SystemExit, match=rf"is no leaderboard: columns \['{odd}'\] differ"):
        leaderboard.main()


def test_leaderboard_shows_means_over_training_seeds(monkeypatch):
    row = {"level": "hydraulic", "method": "two", "training_seed": "1", "training": "an hour"}
    row["revision"] = str(crane_env.REVISION)
    row |= {name: str(number) for name, number in SCORES.items()}
    one = row | {"level": "hydraulic", "method": "one", "gentle_exact": "95.0"}
    rows = [
        row,
        one,
        row | {"training_seed": "2", "gentle_exact": "95.5"},
        row | {"level": "ideal"},
    ]
    rows.append(row | {"revision": "1", "gentle_exact": "1.0"})  # of another task
    monkeypatch.setattr(fill_docs, "rows_of", lambda name: rows)
    assert fill_docs.leaderboard().splitlines()[2:] == [
        "| ideal | two | 93.5 | 97.0 | 92.0 | 96.0 | 1 | an hour |",
        "| hydraulic | one | 95.0 | 97.0 | 92.0 | 96.0 | 1 | an hour |",
        "| hydraulic | two | 94.5 | 97.0 | 92.0 | 96.0 | 2 | an hour |",
    ]


def test_leaderboard_takes_no_policy_that_sees_more(monkeypatch):
    def judge(command, **kwargs):
        sensors = "true" if "more.pt" in command else "false"
        answer = f'{{"changed": {{"sensors": {sensors}}}, "mean_success_rate": 1, '
        return subprocess.CompletedProcess([], 0, stdout=answer + '"mean_gentle_rate": 1}')

    monkeypatch.setattr(subprocess, "run", judge)
    with pytest.raises(SystemExit, match="more.pt needs sensors, which ideal does not have"):
        leaderboard.score("more.pt", "ideal")
    assert leaderboard.score("fewer.pt", "hydraulic")["success_exact"] == 100.0


def test_leaderboard_scores_are_the_judges(monkeypatch):
    answers = {"none": (0.912, 0.456), "step": (0.834, 0.278)}  # success, gentle

    def judge(command, **kwargs):
        assert command[command.index("--env-id") + 1] == "ForestryCraneHydraulic-v0"
        assert command[command.index("--seed") + 1] == "60000"
        success, gentle = answers[command[command.index("--pose-noise") + 1]]
        answer = {"changed": {}, "mean_success_rate": success, "mean_gentle_rate": gentle}
        return subprocess.CompletedProcess(command, 0, json.dumps(answer))

    monkeypatch.setattr(subprocess, "run", judge)
    expected = {"success_exact": 91.2, "gentle_exact": 45.6}
    expected |= {"success_pose_errors": 83.4, "gentle_pose_errors": 27.8}
    assert leaderboard.score("scripted", "hydraulic") == expected


def test_the_notebook_is_the_tutorial():
    """`python benchmark/make_notebook.py` mends a failure."""
    docs = ROOT / "docs"
    cells = make_notebook.notebook((docs / "tutorial.md").read_text()).cells
    assert nbformat.read(docs / "tutorial.ipynb", 4).cells == cells


@pytest.mark.slow
def test_the_notebook_runs(tmp_path, monkeypatch):
    """From top to bottom, with shorter trainings, fewer trials and no film."""
    for name in ("assets", "docs"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=lambda *_: {"play", "figures"})
    for path in ROOT.glob("*.py"):
        shutil.copy(path, tmp_path)
    text = (tmp_path / "docs" / "tutorial.md").read_text()
    for whole, short in [
        ("300000", "2048 --eval-every 1 --eval-trials 1 --final-trials 0"),
        ("--pose-noise none", "--pose-noise none --trials 1"),
        ("--video first.mp4 --diameters 0.5", "--trials 1 --json"),  # test_eval.py makes films
    ]:
        assert whole in text
        text = text.replace(whole, short)
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    notebook = make_notebook.notebook(text)
    resources = {"metadata": {"path": str(tmp_path / "docs")}}
    nbclient.NotebookClient(notebook, timeout=300, resources=resources).execute()
    printed = "".join(out.get("text", "") for c in notebook.cells for out in c.get("outputs", []))
    for wanted in (
        "policy saved to",
        "2048 decisions: 0 %",
        "runs/ForestryCrane-v0__no_ground",
        "runs/ForestryCrane-v0__silu",
        "on delayed_crane:DelayedCrane-v0",
        "on ForestryCraneHydraulic-v0",
        "0.8 Counter({",
    ):
        assert wanted in printed, printed
    assert "Error" not in printed and "Traceback" not in printed
    silu = next((tmp_path / "runs").glob("*__silu__*"))
    policy, _, _ = make_policy(tmp_path, silu)
    assert "SiLU" in str(policy)


def make_policy(folder: Path, run_folder: Path):
    """The policy of a run, by the scripts in folder."""
    here = os.getcwd()
    os.chdir(folder)
    try:
        import crane_policies

        return crane_policies.load_policy(run_folder)
    finally:
        os.chdir(here)
