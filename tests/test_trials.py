"""What training and judging share in crane_trials.py: environments, reports, trials."""

from collections import deque
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import recall_env  # noqa: F401  registers Endless-v0 and others
from gymnasium.vector import AutoresetMode

import crane_options
import crane_task
import crane_trials
import eval_crane
from crane_env import CraneVectorEnv
from crane_trials import make_envs, rollout_report, run_trials
from scripted_crane import ScriptedCrane


class OtherCrane(CraneVectorEnv):
    """A subclass, as a user would write one."""


class OtherTask(gymnasium.vector.VectorEnv):
    """No crane, though it has a vectorized form of its own."""


gymnasium.register("OtherCrane-v0", vector_entry_point=OtherCrane)
gymnasium.register("OtherTask-v0", vector_entry_point=OtherTask)


@pytest.mark.parametrize(
    "env_id, expected",
    [
        ("ForestryCrane-v0", True),
        ("crane_env:ForestryCrane-v0", True),
        ("ForestryCranePaper-v0", True),
        ("OtherCrane-v0", True),
        ("OtherTask-v0", False),
        ("Pendulum-v1", False),
        ("CartPole-v1", False),
        ("recall_env:Recall-v0", False),
    ],
)
def test_is_crane(env_id, expected):
    assert crane_trials.is_crane(env_id) is expected


def test_is_crane_of_no_task():
    with pytest.raises(gymnasium.error.Error, match="Nowhere"):
        crane_trials.is_crane("Nowhere-v0")
    with pytest.raises(ImportError, match="no_module"):
        crane_trials.is_crane("no_module:Nowhere-v0")


def test_make_envs_gives_the_crane_its_options():
    diameters = np.array([0.4, 0.7])
    envs = make_envs("OtherCrane-v0", 2, 1, diameter=diameters, frame_skip=10, reward="paper")
    crane = envs.unwrapped
    assert type(crane) is OtherCrane and envs.num_envs == 2
    assert crane.options == crane_options.complete({"frame_skip": 10, "reward": "paper"})
    envs.reset(seed=0)
    np.testing.assert_allclose(crane.state().diameter, diameters)
    with pytest.raises(ValueError, match="no option 'frame_skp'"):
        make_envs("ForestryCrane-v0", 2, frame_skp=10)


def test_make_envs_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match="Pendulum-v1 is not the crane and has no option contact"):
        make_envs("Pendulum-v1", 2, contact="sdf", retry=0.0)
    for env_id in ("CartPole-v1", "FrozenLake-v1"):  # actions, and observations, of another kind
        with pytest.raises(ValueError, match="no flat Box"):
            make_envs(env_id, 2)
    envs = make_envs("Pendulum-v1", 3, retry=0.5)  # mPPO's default
    assert envs.num_envs == 3 and envs.reset(seed=0)[0].shape == (3, 3)


def test_episodes_are_counted_whole():
    """1 a step, cut after 5: also in the second episode, which begins in the step of the cut."""
    envs = make_envs("recall_env:Endless-v0", 2)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    envs.reset(seed=0)
    for k in range(1, 16):
        _, _, terminated, truncated, info = envs.step(np.zeros((2, 1), np.float32))
        assert not terminated.any() and (truncated == (k % 5 == 0)).all()
        assert ("episode" in info) == (k % 5 == 0)
        if k % 5 == 0:
            assert info["episode"]["r"].tolist() == [5, 5] == info["episode"]["l"].tolist()
            assert info["_episode"].all() and info["final_obs"][1].shape == (1,)


def step_info(cranes, ended, **values):
    """`info` of a step of three cranes, two of whose terms are 0."""
    info = {"r_distance": np.zeros(3), "r_balance": np.zeros(3), "r_ground": np.zeros(3)}
    info["termination"] = np.array(cranes)
    if any(ended):
        info["_episode"] = np.array(ended)
    return info | {name: np.zeros(3) + value for name, value in values.items()}


def test_rollout_report_of_cranes():
    envs = make_envs("ForestryCrane-v0", 3, 1)
    crane = envs.unwrapped
    crane.reset(seed=0)
    assert rollout_report(envs, [step_info(["none"] * 3, [False], r_grapple=0, r_lift=0)]) == {
        "schedule/difficulty": 1.0,
        **{f"reward/{name}": 0.0 for name in ("distance", "grapple", "lift", "balance", "ground")},
    }
    crane.difficulty = 0.35
    crane.recent_success[0].extend([True, False])
    crane.recent_success[2].extend([True, True])
    infos = [
        step_info(["none"] * 3, [False], r_grapple=[1, 2, 3], r_lift=[0, 0, 0]),
        step_info(
            ["none", "overspeed", "time_limit"], [False, True, True], r_grapple=0, r_lift=[1, 0, 2]
        ),
        step_info(["time_limit", "none", "none"], [True, False, False], r_grapple=0, r_lift=0),
        step_info(["not_reached", "none", "none"], [True, False, False], r_grapple=0, r_lift=0),
    ]
    # what belongs to no end must not count
    infos[1]["episode"] = {"r": np.array([99.0, 5, 40]), "l": np.array([99, 10, 90])}
    infos[2]["episode"] = {"r": np.array([30.0, 99, 99]), "l": np.array([90, 99, 99])}
    infos[3]["episode"] = {"r": np.array([1.0, 99, 99]), "l": np.array([60, 99, 99])}
    infos[1]["gentle"], infos[2]["gentle"] = np.array([True, False, True]), np.array([False] * 3)
    infos[3]["gentle"] = np.array([False, True, True])
    report = rollout_report(envs, infos)
    expected = {
        "charts/episodic_return": (5 + 40 + 30 + 1) / 4,
        "charts/episodic_length": (10 + 90 + 90 + 60) / 4,
        "charts/success_rate": 0.75,
        "charts/gentle_rate": 0.25,
        "schedule/difficulty": 0.35,
        "reward/distance": 0.0,
        "reward/grapple": (2 + 0 + 0 + 0) / 4,
        "reward/lift": (0 + 1 + 0 + 0) / 4,
        "reward/balance": 0.0,
        "reward/ground": 0.0,
        "termination/diverged": 0.0,
        "termination/joint_limit": 0.0,
        "termination/overspeed": 0.25,
        "termination/log_too_far": 0.0,
        "termination/not_reached": 0.25,
        "termination/time_limit": 0.5,
    }
    assert report == pytest.approx(expected) and report.keys() == expected.keys()


def test_rollout_report_of_other_tasks():
    envs = make_envs("recall_env:Endless-v0", 2)
    assert rollout_report(envs, [{}, {}]) == {}
    end = {"episode": {"r": np.array([4.0, 7.0]), "l": np.array([2, 3])}}
    report = rollout_report(envs, [{}, end | {"_episode": np.array([False, True])}])
    assert report == {"charts/episodic_return": 7.0, "charts/episodic_length": 3.0}


class Script:
    """Two trials that end as written: (ended, return, success) of both in each step."""

    num_envs = 2
    steps = [
        ((False, False), (0, 0), (False, False)),
        ((True, False), (1, 0), (True, False)),
        ((False, False), (0, 0), (True, True)),
        ((True, True), (9, 5), (False, False)),
    ]

    def __init__(self, unwrapped):
        self.unwrapped = unwrapped

    def reset(self, seed):
        self.seed, self.left, self.actions = seed, deque(self.steps), []
        return np.zeros((2, 3)), {}

    def step(self, actions):
        self.actions.append(actions)
        ended, returns, success = map(np.array, self.left.popleft())
        info = {name: 10.0 * len(self.actions) + np.arange(2) for name in crane_trials.RESULTS}
        info |= {"success": success, "d_combine": np.ones(2)}
        info["termination"] = np.where(ended, "time_limit", "none")
        if ended.any():
            info["episode"] = {"r": returns}
        return np.full((2, 3), len(self.actions)), returns, ended, np.zeros(2, bool), info


def test_only_the_first_end_of_a_trial_counts():
    seen = []

    def predict(obs, state, deterministic):
        seen.append((obs[0, 0], state, deterministic))
        return -obs, (state or 0) + 1

    envs = Script(CraneVectorEnv(2))
    results = run_trials(SimpleNamespace(predict=predict), envs, "seeds", deterministic=False)
    assert envs.seed == "seeds" and not envs.left
    results = {name: values.tolist() for name, values in results.items()}
    at_ends = {name: [20, 41] for name in crane_trials.RESULTS}  # steps 2 and 4
    assert results == at_ends | {
        "episodic_return": [1, 5],
        "success": [True, False],
        "termination": ["time_limit", "time_limit"],
    }
    # the policy got every observation, its own memory and whether to sample
    assert seen == [(0, None, False), (1, 1, False), (2, 2, False), (3, 3, False)]
    assert [actions[0, 0] for actions in envs.actions] == [0, -1, -2, -3]
    other = run_trials(SimpleNamespace(predict=predict), Script(OtherTask()), 0)
    assert other.keys() == {"episodic_return"} and other["episodic_return"].tolist() == [1, 5]
    assert seen[4:] == [(k, k or None, True) for k in range(4)]


class SometimesIdle:
    """The scripted crane, which never moves in trials that start with q7 > 0."""

    def predict(self, obs, state=None, deterministic=True):
        memory, idle = state or (None, obs[:, 6] > 0)
        actions, memory = ScriptedCrane().predict(obs, memory)
        return np.where(idle[:, None], 0.0, actions), (memory, idle)


@pytest.mark.slow
def test_training_and_judging_agree():
    """On success per diameter and trial, and with an episode loop that shares no code with them."""
    seed, trials, policy = 10_000, 2, SometimesIdle()
    diameters, seeds = crane_trials.monte_carlo_trials(seed, trials)
    envs = CraneVectorEnv(len(seeds), diameter=diameters)
    obs, _ = envs.reset(seed=seeds)
    idle, state, alive = obs[:, 6] > 0, None, np.ones(len(seeds), bool)
    returns, success = np.zeros(len(seeds)), np.zeros(len(seeds), bool)
    gentle = np.zeros(len(seeds), bool)
    while alive.any():
        actions, state = policy.predict(obs, state)
        obs, reward, terminated, truncated, info = envs.advance(actions)
        returns += reward * alive
        success |= info["success"] & alive
        gentle |= info["success"] & (info["ground_peak"] <= 20e3) & alive
        alive &= ~(terminated | truncated)
    np.testing.assert_array_equal(success, ~idle)
    assert 3 <= success.sum() <= 9

    training = {"retry": 1.0, "difficulty": 0.0}  # an evaluation has none
    scores = crane_trials.evaluate(policy, "ForestryCrane-v0", trials, seed, 1, **training)
    assert scores.pop("episodic_return") == pytest.approx(returns.mean())
    assert scores.pop("success_rate") == pytest.approx(success.mean())
    assert scores.pop("gentle_rate") == pytest.approx(gentle.mean())
    expected = {f"success_rate_{d}m": success[diameters == d].mean() for d in crane_task.DIAMETERS}
    assert scores == pytest.approx(expected) and scores.keys() == expected.keys()

    args = eval_crane.Args(trials=trials, seed=seed, env_threads=1)
    records = list(eval_crane.judge(policy, "ForestryCrane-v0", {}, args))
    assert [r["success"] for r in records] == success.tolist()
    assert [r["diameter"] for r in records] == diameters.tolist()
    assert {r["failure"] for r, lazy in zip(records, idle) if lazy} == {"not_reached"}


def test_evaluation_of_other_tasks():
    class Zero:
        def predict(self, obs, state, deterministic):
            assert obs.shape == (3, 1) and deterministic
            return np.zeros((3, 1), np.float32), None

    scores = crane_trials.evaluate(Zero(), "recall_env:Endless-v0", 3, 0, retry=0.25)
    assert scores == {"episodic_return": 5.0}
    with pytest.raises(ValueError, match="no option contact"):
        crane_trials.evaluate(Zero(), "recall_env:Endless-v0", 3, 0, contact="sdf")
