"""The scripted crane: kinematics against the simulator, Jacobian, finding the sign, grasping."""

import numpy as np
import pytest

import crane_task
from crane_env import CraneVectorEnv
from crane_trials import make_envs, monte_carlo_trials, run_trials
from scripted_crane import (
    DAMPING,
    HYDRAULIC,
    SPEED,
    ScriptedCrane,
    damped_least_squares,
    forward_kinematics,
    grapple_centre,
    plumb,
    plumb_jacobian,
)


def random_joints(cranes):
    rng = np.random.default_rng(0)
    low = [-3, -0.5, -0.5, 0.1, 0, 1, -3, 0.1]
    return rng.uniform(low, [3, 1.2, 1.2, 2, 1.5, 2, 3, 1], size=(cranes, 8))


def test_forward_kinematics_is_the_simulators():
    q = random_joints(50)
    envs = CraneVectorEnv(len(q), env_threads=1)
    envs.reset(seed=0)
    log_pose, diameter = np.tile([20.0, 0, 0], (len(q), 1)), np.full(len(q), 0.5)
    envs.place(np.arange(len(q)), q, log_pose, diameter)
    state, frames = envs.state(), forward_kinematics(q)
    np.testing.assert_allclose(grapple_centre(frames), state.grapple_centre, atol=1e-6)
    np.testing.assert_allclose(frames[-1, :, :3, 0], state.grapple_axis, atol=1e-6)


def test_jacobian_is_the_derivative_of_the_plumb_grapples_pose():
    def pose(q):
        frames = forward_kinematics(plumb(q))
        yaw = np.arctan2(frames[-1, :, 1, 0], frames[-1, :, 0, 0])
        return np.column_stack([grapple_centre(frames), yaw])

    q, step = random_joints(50), 1e-6
    jacobian = plumb_jacobian(forward_kinematics(plumb(q)))
    for column, joint in enumerate([0, 1, 2, 3, 6]):
        change = pose(q + step * np.eye(8)[joint]) - pose(q - step * np.eye(8)[joint])
        change[:, 3] = (change[:, 3] + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(change / (2 * step), jacobian[:, :, column], atol=1e-7)


def test_rates_do_the_task_where_trials_start():
    rng = np.random.default_rng(0)
    q = np.array([crane_task.sample_start(rng)[0] for _ in range(200)])
    jacobian = plumb_jacobian(forward_kinematics(plumb(q))) * SPEED
    task = rng.normal(size=(200, 4))
    error = (jacobian @ damped_least_squares(jacobian, task, DAMPING)[:, :, None])[:, :, 0] - task
    relative_error = np.linalg.norm(error, axis=-1) / np.linalg.norm(task, axis=-1)
    # at most lambda^2 / (sigma^2 + lambda^2), and sigma > 0.85 (see DAMPING)
    assert np.all(relative_error < 0.014)


@pytest.mark.parametrize("angle", [-0.7, -0.3, 0.3, 0.7])
def test_the_unsigned_angle_is_found_by_turning(angle):
    q = np.array([[-np.pi / 2, 0.6, 0.2, 0.5, np.pi / 2 - 0.8, np.pi / 2, 0.0, 0.4]])
    envs = CraneVectorEnv(1, signed_yaw=False, env_threads=1)
    envs.reset(seed=0)
    grapple_axis = forward_kinematics(q)[-1, 0, :3, 0]
    log_yaw = np.arctan2(grapple_axis[1], grapple_axis[0]) + angle - np.pi / 2  # of its own x
    envs.place(np.arange(1), q, np.array([[0.5, -7.0, log_yaw]]), np.array([0.5]))
    obs, _ = envs.observe(envs.state(), np.zeros((1, 6)))
    policy, memory = ScriptedCrane(signed_yaw=False), None
    assert obs[0, 17] == pytest.approx(1 - np.cos(angle), abs=1e-5)
    for _ in range(15):
        actions, memory = policy.predict(obs, memory)
        obs, *_ = envs.advance(actions)
    assert obs[0, 17] < 1 - np.cos(0.2)
    assert obs[0, 6] == pytest.approx(-angle, abs=0.3)  # against yaw, the short way


@pytest.mark.parametrize("signed_yaw", [True, False])
def test_it_grasps_and_lifts(signed_yaw):
    diameters, seeds = monte_carlo_trials(10_000, 2)
    envs = CraneVectorEnv(len(seeds), diameter=diameters, signed_yaw=signed_yaw, env_threads=1)
    obs, _ = envs.reset(seed=seeds)
    policy, memory, alive = ScriptedCrane(signed_yaw), None, np.ones(len(seeds), bool)
    for _ in range(envs.max_decisions):
        actions, memory = policy.predict(obs, memory)
        assert np.all(np.abs(actions) <= 1)
        obs, _, terminated, _, info = envs.advance(actions)
        alive &= ~terminated
    success = alive & info["success"]
    assert success.all(), dict(zip(diameters[~success], info["termination"][~success]))


def test_jaws_that_close_higher_around_thick_logs_do_not_pull_the_crane_down():
    """Without `rise` the tips reach under the log, and the soft drives give way."""
    diameters, seeds = monte_carlo_trials(10_000, 4, [0.7])
    gentle = {}
    for rise in (HYDRAULIC.rise, 0.0):
        envs = make_envs("ForestryCraneHydraulic-v0", len(seeds), 1, diameter=diameters)
        policy = ScriptedCrane(settings=HYDRAULIC._replace(rise=rise))
        results = run_trials(policy, envs, seeds)
        assert results["success"].sum() >= 3
        gentle[rise] = results["gentle"].sum()
    assert gentle[HYDRAULIC.rise] >= 3 and gentle[0.0] <= 1


def test_its_memory_is_that_of_one_batch_of_trials():
    """No state starts new trials, and trials side by side do not see each other's memory."""
    rng, policy = np.random.default_rng(0), ScriptedCrane()
    envs = CraneVectorEnv(2, env_threads=1)
    trial = [envs.reset(seed=seed)[0] for seed in (1, 2, 3)]  # three decisions of two cranes
    alone, memory = [], None
    for obs in trial:
        actions, memory = policy.predict(obs, memory)
        alone.append(actions)
    other, again = policy.predict(rng.normal(size=(5, 18)))[1], None
    for obs, expected in zip(trial, alone):
        actions, again = policy.predict(obs, again)
        np.testing.assert_array_equal(actions, expected)
        other = policy.predict(rng.normal(size=(5, 18)), other)[1]
    assert np.abs(policy.predict(trial[2])[0] - alone[2]).max() > 1e-3  # it remembered
