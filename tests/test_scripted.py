"""The scripted crane: kinematics, Jacobian, grasping, and a frozen trial of each task."""

from dataclasses import replace

import numpy as np
import pytest

import scripted_crane as scripted
from crane_env import CraneVectorEnv
from crane_utils.metrics import Metrics
from crane_utils.trials import make_envs, monte_carlo_trials, run_trials
from eval_crane import load_policy
from scripted_crane import HYDRAULIC, ScriptedCrane


def plumb_pose(q):
    """x, y, z, yaw of the grapple (N, 4) of plumb cranes."""
    frames = scripted.forward_kinematics(scripted.plumb(q))
    yaw = np.arctan2(frames[-1, :, 1, 0], frames[-1, :, 0, 0])
    return np.column_stack([scripted.grapple_centre(frames), yaw])


def test_kinematics_are_the_simulators_and_the_jacobian_their_derivative():
    low, high = [-3, -0.5, -0.5, 0.1, 0, 1, -3, 0.1], [3, 1.2, 1.2, 2, 1.5, 2, 3, 1]
    q, step = np.random.default_rng(0).uniform(low, high, size=(50, 8)), 1e-6
    envs = CraneVectorEnv(50, env_threads=1)
    envs.reset(seed=0)
    envs.place(np.arange(50), q, np.tile([20.0, 0, 0], (50, 1)), np.full(50, 0.5))
    state, frames = envs.state(), scripted.forward_kinematics(q)
    centre = scripted.grapple_centre(frames)
    np.testing.assert_allclose(centre, state.grapple_centre, atol=1e-6)
    np.testing.assert_allclose(frames[-1, :, :3, 0], state.grapple_axis, atol=1e-6)
    jacobian = scripted.plumb_jacobian(scripted.forward_kinematics(scripted.plumb(q)))
    for column, joint in enumerate([0, 1, 2, 3, 6]):
        change = plumb_pose(q + step * np.eye(8)[joint]) - plumb_pose(q - step * np.eye(8)[joint])
        change[:, 3] = (change[:, 3] + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(change / (2 * step), jacobian[:, :, column], atol=1e-7)


def test_it_grasps_and_lifts():
    """Two trials at each diameter."""
    diameters, seeds = monte_carlo_trials(10_000, 2)
    envs = make_envs("ForestryCrane-v0", 12, 1, {"diameter": diameters})
    results = run_trials(ScriptedCrane(), envs, seeds)
    assert results["success"].all() and results["gentle"].all(), results


@pytest.mark.parametrize("task", ["ForestryCraneHydraulic-v0", "ForestryCraneHydraulicLoading-v0"])
def test_numbers_that_a_task_appends_change_nothing(task):
    obs, _ = make_envs(task, 6).reset(seed=0)
    policy, *_ = load_policy("scripted", task)
    forces = obs[:, policy.SLEW_FORCE : policy.SLEW_FORCE + 6]
    assert forces.shape[1] == 6 and np.abs(forces[:, 0]).max() < 1.0  # of its limit
    obs[:, policy.SLEW_FORCE] = 0.5
    more = np.column_stack([obs, np.full((6, 3), 0.9)])
    actions, memory = policy.predict(more)
    np.testing.assert_array_equal(actions, policy.predict(obs)[0])
    assert memory.settings is policy.drives[1]  # those of hydraulic drives
    obs[:, policy.SLEW_FORCE] = -0.5
    assert (policy.predict(more)[0][:, 0] != policy.predict(obs)[0][:, 0]).all()


def test_a_slew_that_yields_to_the_force_of_its_oil_does_not_swing_on():
    """Without `relief` the grapple swings past the log's centre while the jaws close."""
    _, seeds = monte_carlo_trials(10_000, 15, [0.5])
    misses = []  # m
    for relief in (HYDRAULIC.relief, 0.0):
        envs = make_envs("ForestryCraneHydraulic-v0", 15, 1, diameter=0.5)
        results = run_trials(ScriptedCrane(replace(HYDRAULIC, relief=relief)), envs, seeds)
        misses.append(np.median(results["centre_miss"]))
    assert misses[0] < 0.05 < 0.07 < misses[1], misses


def test_a_crane_that_lifts_does_not_turn_the_log():
    """A slip in the jaws shows as an angle to the log; turning after it would shake it out."""
    turns = []
    for phase in (scripted.APPROACH, scripted.LIFT):
        policy = ScriptedCrane(scripted.IDEAL)
        policy.start(1)
        policy.phase[:] = phase
        obs = np.zeros((1, 18))
        obs[0, [0, 1, 2, 3, 7, 14, 17]] = -1.5, 0.6, 0.3, 0.3, 2.0, 3.0, 0.4
        obs[:, :8] = scripted.plumb(obs[:, :8])
        turns.append(policy.act(obs)[0, 4])
    assert abs(turns[0]) > 0.1 and abs(turns[1]) < 1e-9


def test_its_memory_is_that_of_one_batch_of_trials():
    """No state starts new trials, and trials side by side do not see each other's memory."""
    policy, trial = ScriptedCrane(), np.random.default_rng(0).normal(0, 2, size=(9, 2, 18))
    alone, memory, again, other = [], None, None, None
    for obs in trial:
        actions, memory = policy.predict(obs, memory)
        alone.append(actions)
    for obs, expected in zip(trial, alone):
        other = policy.predict(np.ones((5, 18)), other)[1]
        actions, again = policy.predict(obs, again)
        np.testing.assert_array_equal(actions, expected)
        assert np.abs(again.q7_goal).max() <= scripted.Q7_MAX  # of two, the one in its range
    assert np.abs(policy.predict(trial[8])[0] - alone[8]).max() > 1e-3  # it remembered


FROZEN = {  # revision; q1 ... q8 after 1.5 s, far from the log [rad, m]; after 9 s
    "ForestryCrane-v0": (
        7, [-1.58452663, 0.49231537, 0.44806273, 0.37157483, 0.62074466, 1.58964727, 1.08531511,
            0.40000247],
        {"success": True, "time_to_reach": 3.6, "time_up": 6.0, "clearance": 1.0890,
         "centre_miss": 0.0393, "swing_peak": 0.3604, "litres": 8.1715, "energy": 50433},
    ),
    "ForestryCraneHydraulic-v0": (
        8, [-1.45993037, 0.52197125, 0.38237374, 0.24027214, 0.66186458, 1.54132537, 0.9404421,
            0.12460225],
        {"success": True, "time_to_reach": 4.0, "time_up": 7.5, "clearance": 0.8138,
         "centre_miss": 0.0313, "swing_peak": 0.3402, "litres": 7.6240, "energy": 56698},
    ),
    "ForestryCraneLoading-v0": (
        1, [-1.61783454, 0.48151521, 0.46874542, 0.41609236, 0.60693124, 1.61619903, 1.05597563,
            0.40002083],
        {"time_to_reach": 2.7, "clearance": 3.345, "centre_miss": 0.0359, "swing_peak": 0.4227,
         "litres": 15.0381, "energy": 151967, "r_swing": 2.0821},
    ),
    "ForestryCraneHydraulicLoading-v0": (
        1, [-1.46270955, 0.5185321, 0.38514256, 0.24816718, 0.6554826, 1.6823875, 0.96020822,
            0.11099581],
        {"time_to_reach": 4.0, "clearance": 1.4258, "centre_miss": 0.1481, "swing_peak": 0.3873,
         "litres": 9.5617, "energy": 85412, "r_swing": 0.1659},
    ),
}  # fmt: skip


@pytest.mark.parametrize("env_id", FROZEN)
def test_the_task_of_this_revision(env_id):
    """A change that moves these numbers makes another task: raise its REVISION then."""
    revision, joints, end = FROZEN[env_id]
    envs, memory = make_envs(env_id, 1, 1, diameter=0.5).unwrapped, None
    policy, metrics = load_policy("scripted", env_id)[0], Metrics(envs)
    obs, _ = envs.reset(seed=monte_carlo_trials(10_000, 1, [0.5])[1])
    for step in range(90):
        actions, memory = policy.predict(obs, memory)
        obs, *_, info = envs.step(actions)
        info |= metrics.after_step(info)
        if step == 14:
            assert envs.state().q[0] == pytest.approx(joints, abs=1e-6)
    assert envs.REVISION == revision
    # contacts multiply what the rounding of another processor changes
    assert {name: info[name][0] for name in end} == pytest.approx(end, rel=0.005)
