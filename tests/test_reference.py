"""The environment against the slow crane of reference_crane.py, over episodes and the one after.

Three cranes do three things. The first drives as the scripted crane and lifts its log. The second
strikes the ground, waits, and lunges just before it is too late to reach the log. The third turns
its rotator into the end stop, and begins anew at full speed. All that `step` returns is compared,
and the metrics, and the engine's state.
"""

from collections import Counter
from dataclasses import asdict
from functools import partial

import gymnasium
import numpy as np
import pytest
from reference_crane import ReferenceCrane

from crane_utils.metrics import Metrics
from crane_utils.trials import crane_class
from hydraulic_crane import HydraulicCraneVectorEnv
from scripted_crane import HYDRAULIC, IDEAL, ScriptedCrane

PLAIN = {"offset": "plus", "signed_yaw": True, "axes": "crane", "pose_noise": "none"}


class Drivers:
    """What the three cranes do. Every 0.1 s they choose anew, whatever the step's length."""

    def __init__(self, hydraulic):
        self.scripted = ScriptedCrane(HYDRAULIC if hydraulic else IDEAL)
        self.memory, self.episodes, self.chosen = {}, Counter(), {}

    def begin(self, i):
        self.memory[i], self.chosen[i] = None, (-1, None)
        self.episodes[i] += 1

    def act(self, i, crane):
        now = int(crane.steps * crane.dt / 0.1 + 1e-9)
        if self.chosen[i][0] != now:
            self.chosen[i] = now, self.choose(i, crane, now / 10)
        return self.chosen[i][1]

    def choose(self, i, crane, time):
        if i == 1 and self.episodes[i] == 1:
            if time < min(3.0, crane.reach_time - 0.3):
                return [0.0, -1.0, 0.3, 0.0, 0.0, 0.3]
            late = time > crane.reach_time - 0.15
            return [0.9, -0.5, 0.8, 1.5, -0.7, 1.0] if late else [0.0] * 6
        if i == 2 and self.episodes[i] == 1:
            return [-1.5, 0.1, 0.0, 0.0, np.copysign(1.5, crane.drawn_start[0][6]), 0.2]
        if i == 2 and self.episodes[i] == 2 and time < 0.5:
            return [1.0] * 6
        obs = np.array([crane.observe(**PLAIN)[:18]])
        actions, self.memory[i] = self.scripted.predict(obs, self.memory[i])
        return actions[0].tolist()


def compare(ours, reference, what, tolerance=1e-5):
    ours, reference = np.ravel(ours), np.ravel(reference)
    if reference.dtype.kind in "bU":
        assert ours.tolist() == reference.tolist(), what
    else:
        np.testing.assert_allclose(ours, reference, tolerance, tolerance, err_msg=str(what))


def same_model(envs, i, crane):
    """What an episode writes into the engine's model."""
    ours, reference = envs.batch.get_model(i), crane.model
    names = "body_mass body_inertia body_invweight0 dof_damping dof_invweight0 actuator_delay"
    for name in [*names.split(), "actuator_gainprm", "actuator_biasprm"]:
        compare(getattr(ours, name), getattr(reference, name), f"crane {i}, {name}")
    for geom in ("log", "log_capsule", "ground"):
        for name in ("size", "friction", "rbound"):
            values = getattr(ours.geom(geom), name), getattr(reference.geom(geom), name)
            compare(*values, f"crane {i}, {name} of {geom}")


def replay(envs, seconds, drivers=None, difficulties=(), **task):
    """Step envs and three slow cranes side by side; how episodes ended, and what was seen."""
    hydraulic = isinstance(envs, HydraulicCraneVectorEnv)
    options, drivers = asdict(envs.options), drivers or Drivers(hydraulic)
    seeds = np.random.SeedSequence(5).spawn(envs.num_envs)
    diameters = envs.fixed_diameter if envs.fixed_diameter is not None else [None] * len(seeds)
    task |= {"difficulty": envs.difficulty, "retry": envs.retry}
    cranes = [ReferenceCrane(s, options, hydraulic, d, **task) for s, d in zip(seeds, diameters)]
    # The paper's solver stops early, and within a step its errors add up.
    rough = options["contact"] == "sdf" and options["frame_skip"] > 1
    same = partial(compare, tolerance=2e-3 if rough else 1e-5)
    # an observer looks after each physics step, and must not change what the crane does
    metrics, seen = Metrics(envs) if envs.physics_steps > 3 else None, Counter()
    obs, info = envs.reset(seed=5)
    for i, crane in enumerate(cranes):
        same(obs[i], crane.start(), (i, "start"))
        same_model(envs, i, crane)
        drivers.begin(i)
        for name, value in crane.measure().items():
            same(info[name][i], value, (i, name, "start"))
    for step in range(round(seconds / envs.dt)):
        envs.difficulty = dict(difficulties).get(step, envs.difficulty)
        actions = np.array([drivers.act(i, crane) for i, crane in enumerate(cranes)])
        obs, reward, terminated, truncated, info = envs.step(actions)
        costs, carried = metrics.after_step(info) if metrics else {}, envs.state().carried
        for i, crane in enumerate(cranes):
            here = f"crane {i}, step {step}: "
            crane.difficulty = envs.difficulty
            expected, total, said = crane.step(actions[i])
            ending = said["termination"]
            ended, cut = ending != "none", ending == "time_limit"
            assert (terminated[i], truncated[i]) == (ended and not cut, cut)
            same(info["final_obs"][i] if ended else obs[i], expected, here + "observation")
            for name, value in said.items():  # a term of the reward: mend reference_crane.py, too
                same(info[name][i], value, here + name)
                assert info[f"_{name}"][i], here + name
                if ended:
                    same(info["final_info"][name][i], value, here + name)
            same(reward[i], total, here + "reward")
            for name in ("success", "is_success", "gentle", "failure"):
                assert info[f"_{name}"][i] == ended, here + name
            for name, value in costs.items():
                same(value[i], crane.costs[name], here + name)
            same(carried[i], 1 if ended else crane.carried, here + "carried")
            seen["hit"] += said.get("r_ground", 0) < 0
            seen["lifted"] += said["clearance"] > 0.3 and all(crane.touching())
            seen["ends"] += ended
            seen[said.get("failure", "")] += ended
            if ended:
                same(obs[i], crane.start(), here + "start")
                same_model(envs, i, crane)
                seen["repeated"] += crane.repeated
                drivers.begin(i)
            state = {name: getattr(envs.batch, name)[i] for name in ("qpos", "qvel", "act")}
            for name, value in state.items():
                same(value, getattr(crane.data, name), here + name)
            crane.follow(**state, qacc_warmstart=envs.batch.qacc_warmstart[i])
        seen["out of step"] += len({crane.steps % crane.piece for crane in cranes}) > 1
    envs.close()
    return seen


IDEAL_ID, HYDRAULIC_ID = "ForestryCrane-v0", "ForestryCraneHydraulic-v0"
RANDOMIZED_ID, PAPER_ID = "ForestryCraneRandomized-v0", "ForestryCranePaper-v0"
SHORT = {"TIME_LIMIT": 4.0, "REACH_TIME": 3.0}
LIFTED, HIT, APART = {"lifted"}, {"hit"}, {"out of step"}
RUNS = {  # task, seconds, options, attributes of a subclass, what must be seen
    "ideal": (IDEAL_ID, 18, {}, {}, LIFTED | HIT),
    "hydraulic": (HYDRAULIC_ID, 18, {}, {}, LIFTED | HIT),
    "randomized": (RANDOMIZED_ID, 18, {"pose_noise": "episode"}, {}, LIFTED | HIT),
    "half randomized": (RANDOMIZED_ID, 12, {"randomize": 0.5, "frame_skip": 7}, {}, HIT),
    "sizes": (IDEAL_ID, 11, {"diameter": [0.35, 0.5, 0.75], "pose_noise": "step"}, {}, LIFTED),
    "printed": (IDEAL_ID, 10, {"reward": "paper", "offset": "minus", "axes": "world"}, {}, LIFTED),
    "eased": (IDEAL_ID, 11, {"difficulty": 0.4, "frame_skip": 3}, {}, LIFTED | HIT),
    "1 physics step": (IDEAL_ID, 3.5, {"frame_skip": 1, "signed_yaw": False}, SHORT, HIT | APART),
    "randomized, 1": (RANDOMIZED_ID, 3.5, {"frame_skip": 1}, SHORT, HIT | APART),
    "hydraulic, 3": (HYDRAULIC_ID, 4.5, {"frame_skip": 3, "sensors": False}, SHORT, HIT),
    "paper": (PAPER_ID, 2.2, {}, {"REACH_TIME": 2.0}, set()),
    "paper, lifts": (PAPER_ID, 7, {"frame_skip": 20}, {}, LIFTED),
}


def make(env_id, options, attributes):
    cranes = type("Task", (crane_class(f"crane_env:{env_id}"),), attributes)
    return cranes(3, env_threads=1, **gymnasium.spec(env_id).kwargs | options)


class Wander(Drivers):
    """A command for each episode."""

    def choose(self, i, crane, time):
        return np.cos([i + 3 * self.episodes[i] + j * j for j in range(6)]).tolist()


@pytest.mark.parametrize("env_id", [IDEAL_ID, RANDOMIZED_ID])
def test_failed_starts_are_repeated(env_id):
    """Sixty short episodes. A crane succeeds if its rotator ends on the right."""
    turned = {"not_turned": lambda crane: crane.joint("q7") > 0}

    def conditions(self, state, info):
        return {"not_turned": state.q[:, 6] > 0}

    attributes = {"TIME_LIMIT": 0.3, "HOLD_TIME": 0.1, "conditions": conditions}
    envs = make(env_id, {"retry": 0.9, "difficulty": 0.5, "pose_noise": "episode"}, attributes)
    changes = {30: 0.8, 45: 1.0}  # of the difficulty
    seen = replay(envs, 6, Wander(0), changes, time_limit=0.3, hold_time=0.1, met=turned)
    assert seen["ends"] == 60 and 10 < seen["not_turned"] < 50 and seen["repeated"] > 5, seen


@pytest.mark.parametrize("run", RUNS)
def test_two_episodes(run):
    env_id, seconds, options, attributes, expected = RUNS[run]
    task = {name.lower(): value for name, value in attributes.items()}
    seen = replay(make(env_id, options, attributes), seconds, **task)
    missing = {"ends", "not_reached", *expected} - {name for name, count in seen.items() if count}
    early = [name for name in seen if name.startswith("joint_limit") and seen[name]]
    assert not missing and early, seen
