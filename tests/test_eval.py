"""Trials, the tables of eval_crane.py, and the policies that it takes."""

import contextlib
import csv
import importlib
import json
import shutil
import sys
from dataclasses import asdict

import mujoco
import numpy as np
import onnxruntime
import pytest
import torch
import toy_tasks
from numpy.random import SeedSequence
from script_runs import ALGORITHMS, ROOT, Recording
from stable_baselines3.common.vec_env import VecMonitor

import eval_crane
from crane_utils import export_onnx, film, runs, trials
from crane_utils.metrics import Metrics
from crane_utils.sb3 import CraneVecEnv
from eval_crane import SHIPPED, wilson_interval

QUICK = "toy_tasks:Quick-v0"  # toy_tasks.Quick says how its trials end
POLICIES = ROOT / "assets" / "policies"


@pytest.fixture
def judge(monkeypatch, capsys):
    """judge(*words) runs eval_crane.py here: what it printed (out, err)."""

    def run(*words):
        words = [word for part in words for word in str(part).split()]
        with contextlib.ExitStack() as stack:
            stack.callback(torch.set_num_threads, torch.get_num_threads())
            monkeypatch.setattr(sys, "argv", ["eval_crane.py", *words])
            monkeypatch.setattr(sys, "path", sys.path[:])
            eval_crane.main()
        return capsys.readouterr()

    return run


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a short run on quick trials, with an option of its own."""
    folder = tmp_path_factory.mktemp("trained")
    line = f"--env-id {QUICK} --num-envs 4 --num-steps 6 --minibatch-size 12 --total-timesteps 24"
    Recording(folder).run("ppo_crane", line, "--final-trials 1 --hidden-sizes 8 --env.axes world")
    return next((folder / "runs").iterdir())


def test_a_resumed_run_keeps_its_options_and_what_it_observes(trained, monkeypatch):
    line = f"ppo_crane.py --resume {trained} --total-timesteps 99 --env.pose-noise step"
    monkeypatch.setattr(sys, "argv", line.split())
    args, _ = runs.parse(importlib.import_module("ppo_crane").Args, "")
    assert (args.env_id, args.env.axes, args.env.pose_noise) == (QUICK, "world", "step")
    monkeypatch.setattr(sys, "argv", f"{line} --env.axes crane".split())
    with pytest.raises(SystemExit, match="^--resume: --env.axes must stay world$"):
        runs.parse(importlib.import_module("ppo_crane").Args, "")


# ---- trials


class Sway:
    """Its state counts the steps, which its actions show."""

    def predict(self, obs, state, deterministic=True):
        steps = 0 if state is None else state
        return np.full((len(obs), 6), 0.1 * steps * (1 if deterministic else -1)), steps + 1


def test_a_trial_is_the_same_beside_any_others(judge, tmp_path, monkeypatch):
    """Of whatever number, diameters and batch, and another with another seed."""

    def rows(*words):
        line = f"scripted --env-id {QUICK} --threads 1 --csv {tmp_path}/trials.csv"
        judge(line, *words)
        with open(tmp_path / "trials.csv", encoding="utf-8") as file:
            return {(row["diameter"], row["trial"]): row for row in csv.DictReader(file)}

    many = rows("--trials 3 --diameters 0.4 0.6 0.7")
    assert len({row["centre_miss"] for row in many.values()}) == len(many) == 9
    monkeypatch.setattr(eval_crane, "CRANES", 2)
    few = rows("--trials 2 --diameters 0.7 0.4")
    assert [*few] == [("0.7", "0"), ("0.7", "1"), ("0.4", "0"), ("0.4", "1")]
    assert all(many[trial] == row for trial, row in few.items())
    other = rows("--trials 1 --diameters 0.4 --seed 3")
    assert other["0.4", "0"]["centre_miss"] != many["0.4", "0"]["centre_miss"]


def test_seeds_of_trials():
    """As docs/compare.md defines them: published scores belong to them."""
    diameters, seeds = trials.monte_carlo_trials(7, 2, [0.3, 0.85])
    assert diameters.tolist() == [0.3, 0.3, 0.85, 0.85]
    for seed, key in zip(seeds, [(300, 0), (300, 1), (850, 0), (850, 1)], strict=True):
        assert (seed.generate_state(9) == SeedSequence(7, spawn_key=key).generate_state(9)).all()
    assert (trials.EVAL_SEED, trials.REPORT_SEED) == (10_000, 60_000)


@pytest.mark.parametrize("deterministic", [True, False])
def test_only_the_first_episode_counts(deterministic):
    """The thin log's trial ends after 2 steps; its crane begins two more episodes."""
    diameter = np.array([0.3, 0.6])
    _, seeds = trials.monte_carlo_trials(1, 1, diameter)
    envs = trials.make_envs(QUICK, 2, 1, diameter=diameter)
    metrics = Metrics(envs.unwrapped)
    results = trials.run_trials(Sway(), envs, seeds, deterministic, metrics)
    assert results["time"] == pytest.approx([0.2, 0.5])
    assert results["failure"].tolist() == ["thinnest", ""]
    assert results["success"].tolist() == results["gentle"].tolist() == [False, True]
    # each crane alone, in a loop of our own
    for i in (0, 1):
        crane = toy_tasks.Quick(1, diameter=diameter[i], env_threads=1, autoreset=False)
        alone, done, total, steps = Metrics(crane), [False], 0.0, 0
        crane.reset(seed=[seeds[i]])
        while not done[0]:
            actions = np.full((1, 6), 0.1 * steps * (1 if deterministic else -1))
            _, reward, terminated, truncated, info = crane.step(actions)
            done, total, steps = terminated | truncated, total + reward[0], steps + 1
        assert results["episodic_return"][i] == pytest.approx(total)
        assert results["d_combine"][i] == pytest.approx(info["d_combine"][0])
        for name, value in alone.values.items():
            if name != "time_up":
                assert results[name][i] == pytest.approx(value[0]), name
    assert results["litres"].min() > 0 and results["time_up"].tolist() == [np.inf, 0.2]


def test_evaluate_judges_the_full_task():
    scores = trials.evaluate(Sway(), QUICK, 2, threads=1, options={"reward": "paper"})
    envs = trials.make_envs(
        QUICK, 12, 1, {"reward": "paper"}, diameter=np.repeat(trials.DIAMETERS, 2)
    )
    _, seeds = trials.monte_carlo_trials(10_000, 2)
    results = trials.run_trials(Sway(), envs, seeds)
    assert scores.pop("episodic_return") == pytest.approx(results["episodic_return"].mean())
    rates = {f"success_rate_{d}m": float(d > 0.55) for d in trials.DIAMETERS}
    assert scores == {"success_rate": 0.5, "gentle_rate": pytest.approx(1 / 6), **rates}


def test_evaluate_other_tasks(monkeypatch, capsys):
    class Zero:
        def predict(self, obs, state, deterministic):
            assert obs.shape == (3, 2) and deterministic
            return np.zeros((3, 1), np.float32), None

    assert trials.evaluate(Zero(), "toy_tasks:Endless-v0", 3) == {"episodic_return": 5.0}
    monkeypatch.setattr(trials, "MAX_STEPS", 40)
    assert trials.evaluate(Zero(), "toy_tasks:NoEnd-v0", 3) == {"episodic_return": 40.0}
    assert capsys.readouterr().err == "3 episodes have no end in 40 steps\n"


# ---- tables


def test_wilson_interval():
    """By hand: p = 0.96, n = 100, z = 1.959964."""
    assert wilson_interval(96, 100) == pytest.approx((0.90163, 0.98434), abs=1e-5)
    assert wilson_interval(0, 10) == pytest.approx((0.0, 0.27754), abs=1e-5)
    assert wilson_interval(10, 10) == pytest.approx((0.72247, 1.0), abs=1e-5)


def cells(printed):
    """Tables by their titles: lines by their names, cells by their headings."""
    tables, head = [], None
    for line in printed.splitlines():
        if not line.startswith("|"):
            head = None
            continue
        row = [cell.strip() for cell in line.split("|")[1:-1]]
        if head is None:
            head = row
            tables.append({})
        elif set(row[-1]) != {"-"}:
            tables[-1][row[0]] = dict(zip(head[1:], row[1:]))
    return tables


def test_table_csv_and_json(judge, tmp_path):
    line = f"scripted --env-id {QUICK} --trials 4 --diameters 0.3 0.5 0.6 0.8 --threads 1"
    printed = judge(line, f"--csv {tmp_path}/trials.csv").out
    with open(tmp_path / "trials.csv", encoding="utf-8") as file:
        rows = [*csv.DictReader(file)]
    assert [row["trial"] for row in rows] == ["0", "1", "2", "3"] * 4
    assert {(row["policy"], row["env_id"]) for row in rows} == {("scripted", QUICK)}
    assert [row["failure"] for row in rows] == ["thinnest"] * 4 + ["thin"] * 4 + [""] * 8
    assert [row["gentle"] for row in rows] == ["False"] * 8 + ["True"] * 4 + ["False"] * 4
    (table,) = cells(printed)
    assert f"on {QUICK}, seed 10000" in printed
    assert [*table] == ["0.3 m", "0.5 m", "0.6 m", "0.8 m", "all"]
    assert table["0.3 m"]["failures"] == "thinnest 4" and table["0.3 m"]["success %"] == "0"
    assert table["0.8 m"]["failures"] == "" and table["0.8 m"]["trials"] == "4"
    low, high = wilson_interval(8, 16)
    total = table["all"]
    assert total["95 % interval"] == f"{100 * low:.1f}-{100 * high:.1f}"
    assert (total["success %"], total["gentle %"]) == ("50", "25") and "paper %" not in total
    assert total["failures"] in ("thinnest 4, thin 4", "thin 4, thinnest 4")
    answer = json.loads(judge(line, "--json").out)
    assert answer["policy"] == "scripted" and answer["env_id"] == QUICK and answer["seed"] == 10_000
    assert answer["revision"] == 3 and answer["options"] == asdict(toy_tasks.Quick.Options())
    assert answer["versions"]["mujoco"] == mujoco.__version__
    for name, named in answer["table"].items():
        for head, value in named.items():
            cell = f"{value:.4g}" if isinstance(value, float) else str(value)
            assert table[name][head] == cell


def test_averages_are_of_successes_and_failures_are_counted():
    """By hand. Three successes have 1, 2 and 6 times the same costs. Peaks are of all trials."""
    costs = {"time_to_reach": 1.0, "centre_miss": 2.0, "time_up": 3.0}
    costs |= {"litres": 4.0, "energy": 5e3, "swing_peak": 6.0}
    row = {"diameter": 0.5, "failure": "", "success": True, "gentle": False}
    rows = [row | {name: times * cost for name, cost in costs.items()} for times in (1, 2, 6)]
    rows[0]["gentle"] = True
    lost = row | dict.fromkeys(costs, 9e9) | {"success": False}
    rows += [lost | {"failure": failure} for failure in ("not_held", "thin", "not_held")]
    for trial, peak in zip(rows, (1e3, 20e3, 10e3, 50e3, 30e3, 40e3)):
        trial["ground_peak"] = peak
    line = eval_crane.summarize(rows, {0.5: 98})
    means = {"reach [s]": 3.0, "miss [m]": 6.0}
    medians = {"up [s]": 6.0, "oil [l]": 8.0, "energy [kJ]": 10.0, "swing [rad]": 12.0}
    shares = {"trials": 6, "success %": 50.0, "gentle %": 100 / 6, "paper %": 98.0}
    expected = means | medians | shares | {"peak [kN]": 25.0}
    assert {head: line[head] for head in expected} == pytest.approx(expected)
    assert line["failures"] == "not_held 2, thin 1"
    assert eval_crane.summarize(rows[3:], {})["reach [s]"] == ""


def test_the_papers_figures_stand_beside_its_task(judge):
    line = "zero --trials 1 --diameters 0.3 0.4"
    (table,) = cells(judge(line).out)
    assert [row["paper %"] for row in table.values()] == ["94", "96", "95"]
    (table,) = cells(judge(line, "--env.pose-noise step").out)
    assert table["all"]["paper %"] == "91"
    (table,) = cells(judge(line, "--env-id ForestryCraneHydraulic-v0").out)
    assert "paper %" not in table["all"]


def test_several_policies_are_compared(judge, trained):
    printed = judge(f"zero {trained} --env-id {QUICK} --trials 1 --diameters 0.4 0.8").out
    zero, ours, both = cells(printed)
    assert [*both] == ["zero (zero)", f"ppo_crane.py ({trained})"]
    assert both["zero (zero)"] == zero["all"] and both[f"ppo_crane.py ({trained})"] == ours["all"]


def test_sampled_actions_follow_the_seed(judge, trained):
    line = f"{trained} --trials 2 --diameters 0.6 --threads 1 --json"
    mean, drawn, again, other = (
        json.loads(judge(line, words).out)["table"]["all"]["swing [rad]"]
        for words in ("--seed 3", *["--seed 3 --stochastic"] * 2, "--seed 4 --stochastic")
    )
    assert drawn == again and len({mean, drawn, other}) == 3


def test_a_film_is_of_the_trial_that_was_asked_for(judge, monkeypatch, trained):
    films = []
    monkeypatch.setattr(film, "film", lambda *args, **kwargs: films.append((args, kwargs)))
    line = f"{trained} --video a.mp4 --seed 60000 --trial 17 --diameters 0.3 --camera side"
    judge(line, "--stochastic --env.offset minus")
    ((_, name, env_id, options, path, diameters), how) = films[0]
    assert (name, env_id, path.name, diameters) == ("ppo_crane.py", QUICK, "a.mp4", (0.3,))
    assert (options["axes"], options["offset"]) == ("world", "minus")
    scene = {"seed": 60000, "trial": 17, "camera": "side", "deterministic": False}
    assert how == scene | {"width": 640}
    monkeypatch.setattr(film, "window", lambda *args, **kwargs: films.append((args, kwargs)))
    judge(line.replace("--video a.mp4", "--viewer"), "--stochastic")
    assert films[1][0][1:3] == ("ppo_crane.py", QUICK) and films[1][0][4] == 0.3
    assert films[1][1] == scene


# ---- policies


def test_a_policy_is_judged_on_the_task_of_its_training(judge, trained, monkeypatch):
    line = f"{trained} --trials 1 --diameters 0.6"
    asked = judge(line)
    assert f"on {QUICK}, axes=world, seed" in asked.out and not asked.err.count("made for")
    asked = judge(line, "--env.axes crane --env.frame-skip 10")
    assert f"on {QUICK}, frame_skip=10, seed" in asked.out
    assert "the policy was made for axes 'world', not 'crane'" in asked.err
    assert "the policy was made for frame_skip 20, not 10" in asked.err
    asked = judge(line, "--env-id ForestryCrane-v0")  # as it is registered
    assert "on ForestryCrane-v0, seed" in asked.out
    assert "the policy was made for axes 'world', not 'crane'" in asked.err
    assert f"the policy was made for the task {QUICK}, not ForestryCrane-v0" in asked.err
    monkeypatch.setattr(toy_tasks.Quick, "REVISION", 4)
    assert "the policy was made for revision 3, not 4" in judge(line).err
    flags = ("--json", "--json --env.axes crane")
    tables = [json.loads(judge(line, flag).out)["table"] for flag in flags]
    assert tables[0] != tables[1]


def test_a_run_is_built_by_the_script_that_made_it(trained, tmp_path):
    """Not by the repository's, and not by that of another run which was loaded before."""
    other = tmp_path / "run"
    shutil.copytree(trained, other)
    text = (other / "ppo_crane.py").read_text(encoding="utf-8")
    (other / "ppo_crane.py").write_text(text.replace("nn.Tanh()", "nn.ReLU()"), encoding="utf-8")
    agents = [runs.load_policy(path)[0] for path in (trained, other, trained / "policy.pt")]
    kinds = [type(agent.actor[1]) for agent in agents]
    assert kinds == [torch.nn.Tanh, torch.nn.ReLU, torch.nn.Tanh]
    extra = "self.encoder = nn.Linear(1, 1)\n        self.actor = "
    wider = text.replace("self.actor = ", extra, 1)
    (other / "ppo_crane.py").write_text(wider, encoding="utf-8")
    with pytest.raises(RuntimeError, match="Missing key.*encoder"):  # weights of another network
        runs.load_policy(other)
    (other / "ppo_crane.py").unlink()  # then the repository's serves
    assert type(runs.load_policy(other)[0].actor[1]) is torch.nn.Tanh
    saved = runs.load(other / "policy.pt")
    torch.save(saved | {"script": "gone.py"}, other / "policy.pt")
    with pytest.raises(SystemExit, match="needs gone.py, whose Agent it holds, beside it"):
        runs.load_policy(other)


def test_an_unfinished_run_and_a_changed_task_are_named(trained, tmp_path, capsys):
    other = tmp_path / "run"
    shutil.copytree(trained, other)
    runs.load_policy(other)
    assert not capsys.readouterr().err
    saved = runs.load(other / "policy.pt")
    saved["args"]["total_timesteps"] = 4_800
    torch.save(saved, other / "policy.pt")
    (other / "toy_tasks.py").write_text("# before", encoding="utf-8")
    runs.load_policy(other)
    changed, unfinished = capsys.readouterr().err.splitlines()
    assert changed.startswith("toy_tasks.py has changed since the training of")
    assert unfinished.endswith(": after 24 of 4,800 steps")


def test_a_run_of_another_revision_is_not_resumed(trained, monkeypatch):
    monkeypatch.setattr(toy_tasks.Quick, "REVISION", 99)
    monkeypatch.setattr(sys, "argv", ["ppo_crane.py", "--resume", str(trained)])
    with pytest.raises(SystemExit, match="^--resume: the task has revision 99, the run 3$"):
        runs.parse(importlib.import_module("ppo_crane").Args, "")


class Harmful:
    def __reduce__(self):
        return print, ("code ran",)


def test_a_policy_that_does_not_fit_is_refused_in_a_line(judge, tmp_path, trained, capsys):
    path = tmp_path / "policy.pt"

    def refused(*words):
        with pytest.raises(SystemExit) as end:
            judge(*words, "--trials 1")
        said = str(end.value)
        assert "\n" not in said
        return said

    ours, theirs = "18 observations and actions", "32 observations and actions"
    said = refused(f"{trained} --env-id ForestryCraneHydraulic-v0")
    assert ours in said and theirs in said and "ForestryCraneHydraulic-v0" in said
    saved = runs.load(trained / "policy.pt")
    weights = saved["weights"]
    torch.save(saved | {"weights": weights | {"action_high": weights["action_high"] * 2}}, path)
    assert "[2.0, 2.0, 2.0, 2.0, 2.0, 2.0]" in refused(path)
    torch.save(saved | {"weights": Harmful()}, path)
    with pytest.raises(Exception, match="[Ww]eights"):  # pickled code is not run
        judge(path)
    assert "code ran" not in capsys.readouterr().out
    assert "Pendulum-v1 is not the crane" in refused(f"{trained} --env-id Pendulum-v1")
    assert "no nowhere.pt: give a run's folder" in refused("nowhere.pt")
    assert "no nowhere" in refused(f"{trained} nowhere")  # before the first trial
    assert "--video films one policy" in refused(f"zero {trained} --video a.mp4")
    for line in ("--diameters 0.2", "--seed -1", "--env.frame-skip 0", "--warp 9"):
        assert refused(f"zero {line}") == "2"  # and a box
    assert capsys.readouterr().out == ""


def test_a_policy_of_the_users_own(judge, tmp_path, monkeypatch):
    code = "import numpy as np\nclass Slew:\n    task = {'env_id': 'toy_tasks:Quick-v0'}\n"
    code += "    def predict(self, obs, state, deterministic):\n"
    code += "        assert obs.shape == (1, 18) and deterministic\n"
    code += "        return np.full((1, 6), 0.5), state\n"
    (tmp_path / "my_policy.py").write_text(code, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    printed = judge("my_policy:Slew --trials 1 --diameters 0.8").out
    assert f"my_policy:Slew (my_policy:Slew) on {QUICK}" in printed


def test_built_in_policies():
    obs = np.zeros((40, 18))
    assert not eval_crane.Zero().predict(obs, None)[0].any()
    actions, _ = eval_crane.Random().predict(obs, None)
    assert actions.shape == (40, 6) and actions.min() < -0.9 and actions.max() > 0.9


@pytest.mark.parametrize("path", sorted(POLICIES.iterdir()), ids=lambda path: path.stem)
def test_shipped_policies_are_of_the_registered_tasks(path):
    agent, task, script = runs.load_policy(path)
    level = path.stem.partition("crane")[2].title().replace("_", "")
    assert task["env_id"] == f"ForestryCrane{level}-v0" and path.stem.startswith(script[:-3])
    assert task["revision"] == trials.crane_class(task["env_id"]).REVISION
    assert task["options"] == asdict(trials.task_options(task["env_id"]))


def test_shipped_policies_do_what_they_are_for(judge):
    line = "--json --trials 3 --diameters 0.4 0.5 0.6 --seed 77 --env.pose-noise step"
    answer = json.loads(judge(line).out)
    assert answer["policy"] == SHIPPED and answer["table"]["all"]["success %"] > 80
    assert answer["options"]["pose_noise"] == "step"
    path = POLICIES / "mppo_beta_crane_hydraulic_loading.pt"  # README's film
    answer = json.loads(judge(path, "--json --trials 3 --diameters 0.6").out)
    assert answer["table"]["all"]["success %"] > 60


# ---- elsewhere


@pytest.mark.parametrize("script", ALGORITHMS)
def test_onnx_acts_as_the_policy(tmp_path, script):
    """In turn, with its memory, for another number of cranes than at the export."""
    path, file = POLICIES / f"{script}.pt", tmp_path / "policy.onnx"
    export_onnx.main(path, file)
    session = onnxruntime.InferenceSession(file)
    names = [i.name for i in session.get_inputs()]
    assert len(names) == (3 if "recurrent" in script else 1) and names[0] == "obs"


def test_a_predict_that_a_trace_cannot_repeat_is_not_exported(tmp_path, trained, monkeypatch):
    shutil.copytree(trained, tmp_path / "run")
    script = tmp_path / "run" / "ppo_crane.py"
    line = "distribution = self.get_distribution(self.normalize(obs))\n"
    text = script.read_text(encoding="utf-8")
    assert line in text
    edited = line + "        obs = distribution.mean if obs.sum() > 0 else -distribution.mean\n"
    edited += "        return self.to_env(obs), None\n"
    script.write_text(text.replace(line, edited), encoding="utf-8")
    with pytest.raises(SystemExit, match="a trace cannot repeat"):
        export_onnx.main(tmp_path / "run", tmp_path / "policy.onnx")
    assert not (tmp_path / "policy.onnx").exists()


def test_stable_baselines_sees_the_same_cranes(monkeypatch):
    """Also over the ends of episodes, where it wants the last observation in `infos`."""
    view, cranes = CraneVecEnv(5, QUICK, env_threads=1), toy_tasks.Quick(5, env_threads=1)
    view.seed(7)
    np.testing.assert_array_equal(view.reset(), cranes.reset(seed=7)[0])
    rng, ends = np.random.default_rng(0), []
    for _ in range(12):
        actions = rng.uniform(-1, 1, (5, 6))
        obs, reward, done, infos = view.step(actions)
        expected, pay, terminated, truncated, info = cranes.step(actions)
        np.testing.assert_array_equal(obs, expected)
        np.testing.assert_allclose(reward, pay, rtol=1e-6)
        assert (done == (terminated | truncated)).all() and reward.dtype == np.float32
        for i, said in enumerate(infos):
            assert bool(said) == done[i]
            if done[i]:
                ends.append(truncated[i])
                np.testing.assert_array_equal(said["terminal_observation"], info["final_obs"][i])
                assert said["TimeLimit.truncated"] == truncated[i]
                assert said["is_success"] == info["success"][i]
                assert said["termination"] == info["termination"][i]
    assert len(ends) > len(set(ends)) == 2
    view.set_attr("difficulty", 0.25)
    assert view.envs.difficulty == 0.25 and view.get_attr("difficulty", [1]) == [0.25]
    assert view.env_is_wrapped(VecMonitor) == [False] * 5
