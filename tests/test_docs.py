"""README and docs: code runs, commands parse, links lead somewhere, tables are of the data."""

import importlib
import os
import re
import runpy
import shlex
import subprocess
import sys

import numpy as np
import pytest
from script_runs import ROOT, Recording
from tyro import cli

import eval_crane
from crane_utils import export_onnx, runs

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES += [ROOT / "benchmark" / "README.md", ROOT / "assets" / "README.md"]
POLICY = ROOT / "assets" / "policies" / "recurrent_ppo_crane.pt"


def name(page):
    return str(page.relative_to(ROOT))


def blocks(page, *languages):
    text = page.read_text(encoding="utf-8")
    found = re.findall(r"^```(\w*)\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    return [code for language, code in found if language in languages]


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_tables_are_those_of_the_data(page):
    """`python benchmark/tables.py` mends a failure."""
    tables = importlib.import_module("benchmark.tables")
    text = page.read_text(encoding="utf-8")
    assert tables.filled(text) == text
    marks = re.findall(r"<!-- (\w+) -->", text)
    assert marks.count("end") * 2 == len(marks)


def anchors(page):
    """The anchors that GitHub gives the headings."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.S | re.M)
    headings = [re.sub(r"[^\w\- ]", "", h.lower()) for h in re.findall(r"^#+ (.+)$", text, re.M)]
    return {heading.strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if re.match(r"https?:|mailto:", target):
            continue
        file, _, anchor = target.partition("#")
        file = page.parent / file if file else page
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), target


def commands():
    """(script, arguments) of each command of ours, in all pages and of our trainings."""
    found = set()
    for page in PAGES:
        for code in blocks(page, "", "bash"):
            ours = r"(?:python3?|torchrun) (?:--\S+ (?:\d+ )?)*(\w+_(?:crane|torchrun)\.py)(.*)"
            for script, rest in re.findall(ours, code.replace("\\\n", " ")):
                found.add((script, " ".join(shlex.split(rest, comments=True))))
    trainings = importlib.import_module("benchmark.runs").TRAININGS
    found |= {(f"{script}.py", flags.strip()) for _, _, script, flags, _ in trainings}
    for name in ("mppo_beta", "ppo", "trpo", "recurrent_ppo"):
        paper = ["bash", str(ROOT / "benchmark" / "paper.sh"), name]
        said = subprocess.run(paper, env=os.environ | {"PYTHON": "echo"}, stdout=subprocess.PIPE)
        found.add(tuple(said.stdout.decode().strip().split(" ", 1)))
    return sorted(found)


@pytest.mark.parametrize("script, line", commands())
def test_commands_parse(script, line, tmp_path, monkeypatch):
    for page in PAGES:  # tasks of the pages' own
        text = page.read_text(encoding="utf-8")
        for code in blocks(page, "python"):
            for task in re.findall(r'register\("(\w+-v\d)"', code):
                module = re.search(rf"(\w+):{task}", text)[1]
                (tmp_path / f"{module}.py").write_text(code, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    if script == "eval_crane.py":
        args, flags = cli(eval_crane.Args, args=line.split(), return_unknown_args=True)
        eval_crane.task_of(eval_crane.Zero(), {}, args, flags)
    else:
        line = re.sub(r"--resume \S+", "", line)  # there is no such run
        monkeypatch.setattr(sys, "argv", [script, *line.split()])
        runs.parse(importlib.import_module(script[:-3]).Args, "")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=name)
def test_code_runs(page, tmp_path, monkeypatch, capsys):
    """Whole files in the page's order, in one folder: tasks train, and policies are judged."""
    monkeypatch.chdir(tmp_path)
    if any("policy.onnx" in code for code in blocks(page, "python")):
        export_onnx.main(POLICY, tmp_path / "policy.onnx")
    for number, code in enumerate(blocks(page, "python")):
        if not re.match(r'import|from|"""', code):
            compile(code, name(page), "exec")  # part of a file
            continue
        module = f"page_{page.stem}_{number}"
        for whole, short in [("1_000_000", "256"), ("Env(64", "Env(4"), ("verbose=1", "verbose=0")]:
            code = code.replace(whole, short)
        (tmp_path / f"{module}.py").write_text(code, encoding="utf-8")
        left = runpy.run_path(f"{module}.py")
        for task in re.findall(r'register\("(\w+-v\d)"', code):
            line = "--num-envs 4 --num-steps 8 --minibatch-size 32 --total-timesteps 32 --threads 1"
            run = Recording(tmp_path)
            run.run(
                "ppo_crane", f"--env-id {module}:{task} --final-trials 1 --hidden-sizes 8", line
            )
            assert run.scalars["eval/success_rate"] == {32: 0.0}
        for policy in re.findall(r"class (\w+):\n(?:(?!class ).*\n)*?    def predict", code):
            check_recipe(left[policy]())
            words = f"{module}:{policy} --env-id toy_tasks:Quick-v0 --trials 1 --diameters 0.8"
            monkeypatch.setattr(sys, "argv", ["eval_crane.py", *words.split()])
            eval_crane.main()
            assert f"{module}:{policy}" in capsys.readouterr().out


def check_recipe(policy):
    """Recipes act as what they load: with its normalizer, and with its memory."""
    obs = np.random.default_rng(0).normal(size=(3, 5, 18)).astype("f4")
    state = agent_state = None
    agent = runs.load_policy(POLICY)[0]
    for batch in obs:
        actions, state = policy.predict(batch, state, True)
        assert np.shape(actions) == (5, 6)
        if hasattr(policy, "session"):
            expected, agent_state = agent.predict(batch, agent_state)
            np.testing.assert_allclose(actions, expected, atol=1e-5)
        if hasattr(policy, "statistics"):
            scaled = policy.statistics.normalize_obs(batch)
            expected, _ = policy.model.predict(scaled, deterministic=True)
            bare, _ = policy.model.predict(batch, deterministic=True)
            np.testing.assert_array_equal(actions, expected)
            assert not np.allclose(actions, bare)
