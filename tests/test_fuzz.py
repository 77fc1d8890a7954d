"""Random options and actions, 200,000 decisions: nothing undefined comes out of the environment."""

from typing import get_args

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from hypothesis import given, settings
from hypothesis import strategies as st

import crane_options
import crane_task
from crane_env import CraneVectorEnv
from crane_options import Options

ENDINGS = {"none", *crane_task.TERMINATIONS}


def choices(name):
    annotation = Options.__annotations__[name]
    return st.sampled_from(get_args(annotation) or (False, True))


literals = [
    "actuators",
    "sensors",
    "reward",
    "speed",
    "offset",
    "signed_yaw",
    "axes",
    "pose_noise",
]
engine = ["integrator", "solver"]
shares = {name: st.floats(0, 1) for name in ("difficulty", "retry", "randomize")}
options = st.fixed_dictionaries(
    {},
    optional={name: choices(name) for name in literals + engine}
    | shares
    | {
        "frame_skip": st.integers(1, 12),
        "autoreset_mode": st.sampled_from([AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP]),
        "diameter": st.floats(0.3, 0.8),
    },
)


def run(cranes, decisions, seed, chosen):
    """Bang-bang and uniform actions by turns, each held for a while, beyond the box at times."""
    envs, rng = CraneVectorEnv(cranes, env_threads=2, **chosen), np.random.default_rng(seed)
    obs, _ = envs.reset(seed=seed)
    actions, ends = np.zeros((cranes, 6)), 0
    for _ in range(decisions):
        assert obs in envs.observation_space
        change = rng.random(cranes) < 0.2
        wild = np.sign(rng.uniform(-1, 1, (cranes, 6))) * 1.5
        mild = rng.uniform(-1, 1, (cranes, 6))
        actions = np.where(
            change[:, None], np.where(rng.random((cranes, 1)) < 0.5, wild, mild), actions
        )
        obs, reward, terminated, truncated, info = envs.step(actions)
        assert np.isfinite(reward).all() and not (terminated & truncated).any()
        assert set(info["termination"]) <= ENDINGS - {"diverged"}
        assert ((info["termination"] != "none") == (terminated | truncated)).all()
        for term in ("d_combine", "clearance", "centre_miss", *crane_task.TERMS):
            assert np.isfinite(info[term]).all()
        assert not (info["success"] & ~truncated).any()
        ends += (terminated | truncated).sum()
    assert envs.batch.warning[:, :, 1].sum() == 0
    assert sum(map(len, envs.recent_success)) <= ends


@pytest.mark.slow
@settings(max_examples=125, deadline=None, derandomize=True, database=None)
@given(st.integers(0, 2**32 - 1), options)
def test_capsules(seed, chosen):
    run(16, 100, seed, chosen)


@pytest.mark.slow
@settings(max_examples=10, deadline=None, derandomize=True, database=None)
@given(st.integers(0, 2**32 - 1), options)
def test_signed_distance_fields(seed, chosen):
    run(4, 25, seed, chosen | {"contact": "sdf"})


junk = st.one_of(
    st.none(),
    st.integers(),
    st.floats(),
    st.text(max_size=5),
    st.lists(st.integers(), max_size=2),
)


@settings(max_examples=300, deadline=None, derandomize=True, database=None)
@given(st.sampled_from([*crane_options.DEFAULTS, "num_envs", "width", "camera", "diameter"]), junk)
def test_an_option_is_accepted_or_refused_by_name(name, value):
    """Nothing between: no other error, and no crane with a value that its type does not allow."""
    if name == "num_envs" and isinstance(value, int) and value > 64:
        value += crane_options.Size.__metadata__[0].high  # a thousand cranes would take long
    try:
        envs = gymnasium.make_vec("ForestryCrane-v0", **{"num_envs": 1, name: value})
    except ValueError as error:
        assert name in str(error)
    else:
        crane_options.complete(envs.unwrapped.options)
        assert obs_is_fine(envs)


def obs_is_fine(envs):
    return envs.reset(seed=0)[0] in envs.observation_space
