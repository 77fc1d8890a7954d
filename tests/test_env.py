"""The environment's contract: spaces, seeds, autoreset, starts, errors."""

import copy
import inspect
import os
import pickle
import re
import select
import signal

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import DictInfoToList, NormalizeObservation, NormalizeReward

import crane_env
import crane_options
import crane_policies
import crane_task
import crane_trials
import machine
from crane_env import CraneEnv, CraneVectorEnv
from crane_options import DEFAULTS, Options

NAMES = ["q1", "q2", "q3", "q4", "q5", "q6", "q7", "q8"]


def random_actions(rng, n):
    return rng.uniform(-1, 1, (n, 6))


def needs_opengl():
    try:
        mujoco.Renderer(machine.load_model(), 8, 8).close()
    except Exception as error:
        pytest.skip(f"no OpenGL here: {error}")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("env_id", ["ForestryCrane-v0", "ForestryCranePaper-v0"])
def test_check_env(env_id):
    needs_opengl()
    check_env(gymnasium.make(env_id).unwrapped)


def test_registered_both_ways():
    env = gymnasium.make("ForestryCrane-v0", frame_skip=5)
    assert isinstance(env.unwrapped, CraneEnv) and env.unwrapped.envs.dt == 0.025
    envs = gymnasium.make_vec("ForestryCrane-v0", num_envs=3, reward="paper")
    assert isinstance(envs.unwrapped, CraneVectorEnv) and envs.num_envs == 3
    assert envs.unwrapped.options == {**DEFAULTS, "reward": "paper"}


def test_the_papers_task_is_as_printed():
    env = gymnasium.make("ForestryCranePaper-v0").unwrapped
    assert env.envs.options == {
        "frame_skip": 1,
        "actuators": "ideal",
        "randomize": 0.0,
        "sensors": False,
        "contact": "sdf",
        "reward": "paper",
        "speed": "real",
        "offset": "minus",
        "signed_yaw": False,
        "axes": "world",
        "pose_noise": "none",
        "difficulty": 1.0,
        "retry": 0.0,
        "integrator": "implicit",
        "solver": "CG",
    }
    obs, info = env.reset(seed=0)
    state, command = env.envs.state(), np.zeros((1, 6))
    delta_p, delta_psi, _ = crane_task.relative_pose(state, "minus")
    np.testing.assert_allclose(obs[14:], [*delta_p[0], delta_psi[0]], rtol=1e-6)
    d_combine = np.linalg.norm(delta_p, axis=-1) + delta_psi
    measured = crane_task.log_clearance(state), crane_task.centre_miss(state)
    terms = crane_task.reward_terms(state, d_combine, *measured, command, np.zeros(1), kind="paper")
    np.testing.assert_allclose([info[term] for term in crane_task.TERMS], terms[:, 0])
    assert env.envs.dt == 0.005
    model = env.envs.batch.get_model(0)
    assert (model.geom_type == mujoco.mjtGeom.mjGEOM_SDF).any()
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICIT
    assert model.opt.solver == mujoco.mjtSolver.mjSOL_CG
    capsules = gymnasium.make("ForestryCranePaper-v0", contact="primitive").unwrapped
    assert capsules.envs.options == {**env.envs.options, "contact": "primitive"}


def test_options_say_their_defaults():
    """As (task: ...) at the end of each comment, as --help and the docstring promise."""
    source = inspect.getsource(Options)
    said = dict(re.findall(r"^    (\w+): .*#.* \(task: (\S+)\)$", source, flags=re.M))
    assert said == {name: str(value) for name, value in DEFAULTS.items()}
    assert DEFAULTS.keys() == Options.__annotations__.keys()
    assert CraneVectorEnv(1).options == DEFAULTS


def test_columns_are_the_engines():
    """JOINTS and SERVOS are columns of qpos and of qvel; every servo has two actuators."""
    model = machine.load_model()
    assert [model.joint(i).name for i in machine.JOINTS] == NAMES
    servos = "q1 q2 q3 q4 q4_stage2 q7 q8 q8_inner".split()
    assert [model.joint(i).name for i in machine.SERVOS] == servos
    for columns in (model.jnt_qposadr, model.jnt_dofadr):
        np.testing.assert_array_equal(columns[:10], np.arange(10))
    moved = model.actuator_trnid[:, 0]
    np.testing.assert_array_equal(moved, machine.SERVOS * 2)
    actuated = [NAMES[i] for i in machine.ACTUATED]
    commanded = [actuated[i] for i in machine.COMMAND_OF_SERVO]
    assert commanded == [name.split("_")[0] for name in servos]


def docstring_table(first_column_values):
    rows = re.findall(r"^\| (\d+) +\|(.*)\|$", crane_env.__doc__, flags=re.M)
    tables, current = [], []
    for index, rest in rows:
        if int(index) == 0 and current:
            tables.append(current)
            current = []
        current.append([cell.strip() for cell in rest.split("|")])
    tables.append(current)
    return next(t for t in tables if len(t) == first_column_values)


def test_observation_table_matches_the_space():
    table = docstring_table(32)
    space = CraneVectorEnv(1, sensors=True).single_observation_space
    np.testing.assert_allclose([float(r[2]) for r in table], space.low, atol=1e-4)
    np.testing.assert_allclose([float(r[3]) for r in table], space.high, atol=1e-4)
    assert space.shape == (32,) and space.dtype == np.float32
    short = CraneVectorEnv(1).single_observation_space
    assert short == gymnasium.spaces.Box(space.low[:18], space.high[:18])
    assert [r[0].split()[0] for r in table[:8]] == NAMES
    assert [r[0].split()[0] for r in table[8:14]] == [NAMES[i] for i in machine.ACTUATED]
    commands = [r[0].split(",")[0] for r in table[18:24]]
    assert commands == [f"last command of {NAMES[i]}" for i in machine.ACTUATED]
    assert [r[0] for r in table[24:26]] == ["q5 velocity", "q6 velocity"]
    forces = [r[0].split(",")[0] for r in table[26:]]
    assert forces == [f"force of the oil on {NAMES[i]}" for i in machine.ACTUATED]


def test_action_table_matches_the_space_and_speeds():
    table = docstring_table(6)
    space = CraneVectorEnv(1).single_action_space
    np.testing.assert_allclose([float(r[2]) for r in table], space.low)
    np.testing.assert_allclose([float(r[3]) for r in table], space.high)
    for column, speed in ((4, "real"), (5, "mjcf")):
        documented = [re.findall(r"-?\d+\.?\d*", r[column])[:2] for r in table]
        np.testing.assert_allclose(np.array(documented, float).T, machine.SPEEDS[speed])


@pytest.mark.parametrize("signed_yaw", [True, False])
def test_observation_holds_what_the_table_says(signed_yaw):
    envs = CraneVectorEnv(4, axes="world", signed_yaw=signed_yaw)
    obs, _ = envs.reset(seed=0)
    for _ in range(5):
        obs, *_ = envs.advance(np.full((4, 6), 0.3))
    state = envs.state()
    for k, name in enumerate(NAMES):
        np.testing.assert_allclose(obs[:, k], envs.batch.joint(name).qpos[:, 0], atol=1e-6)
    for k, name in enumerate(["q1", "q2", "q3", "q4", "q7", "q8"]):
        np.testing.assert_allclose(obs[:, 8 + k], envs.batch.joint(name).qvel[:, 0], atol=1e-5)
    delta_p, delta_psi, signed_angle = crane_task.relative_pose(state)
    np.testing.assert_allclose(obs[:, 14:17], delta_p, atol=1e-5)
    assert np.abs(signed_angle - delta_psi).min() > 1e-3
    expected = signed_angle if signed_yaw else delta_psi
    np.testing.assert_allclose(obs[:, 17], expected, atol=1e-5)


def test_axes_of_the_crane_turn_with_it():
    """One pose, seen along the world's axes and along the boom, which points at the grapple."""
    obs = {}
    for axes in ("world", "crane"):
        envs = CraneVectorEnv(8, axes=axes)
        obs[axes] = envs.reset(seed=0)[0]
        assert obs[axes].flags.c_contiguous  # as what rounds by layout, torch's sums, expects
    grapple = envs.state().grapple_centre
    ahead = grapple[:, :2] / np.linalg.norm(grapple[:, :2], axis=-1, keepdims=True)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
    delta_p = obs["world"][:, 14:16]
    for column, axis in ((14, ahead), (15, left)):  # up to the swing of at most 0.05 rad
        np.testing.assert_allclose(obs["crane"][:, column], np.sum(delta_p * axis, -1), atol=0.06)
    np.testing.assert_allclose(
        np.linalg.norm(obs["crane"][:, 14:16], axis=-1), np.linalg.norm(delta_p, axis=-1), rtol=1e-5
    )
    others = [i for i in range(18) if i not in (14, 15)]
    np.testing.assert_array_equal(obs["crane"][:, others], obs["world"][:, others])


def test_observations_stay_in_the_space():
    envs = CraneVectorEnv(32, speed="mjcf", pose_noise="step")
    rng = np.random.default_rng(0)
    obs, _ = envs.reset(seed=0)
    for _ in range(60):
        assert obs in envs.observation_space
        obs, *_ = envs.step(random_actions(rng, 32))


def test_a_crane_is_the_same_for_any_number_of_cranes_and_threads(monkeypatch):
    monkeypatch.setattr(crane_task, "REACH_TIME", 2.0)

    def episode(n, threads):
        envs = CraneVectorEnv(n, env_threads=threads, pose_noise="step")
        rng = np.random.default_rng(1)
        actions, ends = rng.uniform(-1, 1, (50, 6)), 0
        obs = [envs.reset(seed=7)[0][2]]
        for action in actions:
            step = envs.step(np.tile(action, (n, 1)))
            obs.append(np.append(step[0][2], step[1][2]))
            ends += step[2][2]
        assert ends >= 2
        return np.concatenate(obs)

    reference = episode(3, 1)
    for n, threads in [(3, 2), (17, 1), (17, 2)]:
        np.testing.assert_array_equal(reference, episode(n, threads))


def test_one_crane_env_is_the_vector_env():
    env, envs = CraneEnv(), CraneVectorEnv(1)
    a, _ = env.reset(seed=5)
    b, _ = envs.reset(seed=5)
    rng = np.random.default_rng(0)
    for _ in range(20):
        np.testing.assert_array_equal(a, b[0])
        actions = random_actions(rng, 1)
        a, reward_a, terminated, truncated, info = env.step(actions[0])
        b, reward_b, *_ = envs.advance(actions)
        assert reward_a == reward_b[0]
        assert isinstance(info["termination"], str)
        if terminated or truncated:
            break


@pytest.mark.parametrize("frame_skip", [1, 3, 7, 20])
def test_sensors_describe_the_state_after_the_step(frame_skip):
    envs, rng = CraneVectorEnv(2, frame_skip=frame_skip), np.random.default_rng(0)
    envs.reset(seed=0)
    for _ in range(8):
        envs.advance(random_actions(rng, 2))
        for i in range(2):
            model, data = envs.batch.get_model(i), envs.batch.get_data(i)
            mujoco.mj_forward(model, data)
            # forces, which come last, are those at the start of the last physics step
            assert np.array_equal(envs.sensordata[i, :14], data.sensordata[:14])


def test_frame_skip_changes_the_decisions_not_the_physics():
    """Same commands at 10, 20, 40 and 200 Hz: the same motion, also with logs in the jaws."""
    policy, task, _ = crane_policies.load_policy(crane_policies.SHIPPED)
    assert task["frame_skip"] == 20
    commands, ends = [], []
    for frame_skip in (20, 10, 5, 1):
        envs = CraneVectorEnv(8, frame_skip=frame_skip)
        obs, _ = envs.reset(seed=3)
        for k in range(60):
            if frame_skip == 20:
                commands.append(policy.predict(obs)[0])
            for _ in range(20 // frame_skip):
                obs, *_, info = envs.advance(commands[k])
        assert (info["clearance"] > 0.1).sum() > 1
        ends.append(envs.qpos.copy())
    assert all(np.array_equal(ends[0], end) for end in ends)


@pytest.mark.parametrize(
    "frame_skip, period", [(1, 5), (2, 2), (3, 1), (4, 1), (5, 1), (7, 1), (20, 1)]
)
def test_integrators_are_clamped_within_25_ms_from_the_start(frame_skip, period):
    """At zero command nothing else changes them; period in decisions."""
    envs = CraneVectorEnv(2, frame_skip=frame_skip)
    envs.reset(seed=0)
    clamped = []
    for k in range(13):
        if k == 3:
            envs.start_episodes(np.array([1]))  # perhaps between two clamps of the other
        before = envs.qpos[:, machine.SERVOS] + 2 * envs.max_lead
        envs.act[:] = before
        envs.advance(np.zeros((2, 6)))
        clamped.append((envs.act != before).all(axis=1))
    first, second = np.array(clamped).T
    assert (first == (np.arange(13) % period == 0)).all()
    assert (second[3:] == (np.arange(10) % period == 0)).all()


def test_same_step_autoreset():
    envs = CraneVectorEnv(8)
    obs, _ = envs.reset(seed=0)
    twin = CraneVectorEnv(8)
    twin.reset(seed=0)
    action = np.zeros((8, 6))
    action[::2, 0] = 1.0
    envs.reach_time[:] = twin.reach_time[:] = 1.0
    for _ in range(60):  # slewing at full speed ends at a joint limit, if not before
        obs, _, terminated, _, info = envs.step(action)
        twin_obs, _, _, _, twin_info = twin.advance(action)
        if terminated.any():
            break
    assert terminated.any() and not terminated.all()
    assert (info["_final_obs"] == terminated).all() and (info["_final_info"] == terminated).all()
    assert (info["time_to_reach"] == 1.0).all()  # the new starts have not touched it
    assert np.isinf(envs.reach_time[terminated]).all()
    for i in np.flatnonzero(terminated):
        np.testing.assert_array_equal(info["final_obs"][i], twin_obs[i])
        assert info["final_info"]["termination"][i] == twin_info["termination"][i] != "none"
        assert np.abs(obs[i, 8:14]).max() == 0  # the new start is at rest
        assert not np.allclose(obs[i], twin_obs[i])


def test_returned_arrays_are_not_live():
    envs = CraneVectorEnv(2)
    obs, info = envs.reset(seed=0)
    before, clearance = obs.copy(), info["clearance"].copy()
    envs.step(np.ones((2, 6)))
    np.testing.assert_array_equal(obs, before)
    np.testing.assert_array_equal(info["clearance"], clearance)


def test_start_distribution():
    """Ranges and uniformity as fixed for the task."""
    rng = np.random.default_rng(0)
    n = 4000
    starts = [crane_task.sample_start(rng) for _ in range(n)]
    q = np.array([s[0] for s in starts])
    log = np.array([s[1] for s in starts])
    diameter = np.array([s[2] for s in starts])
    hanging = np.pi / 2 - q[:, 1] - q[:, 2]
    uniform = {
        "q1": (q[:, 0], -2 * np.pi / 3, -np.pi / 3),
        "q5": (q[:, 4] - hanging, -0.05, 0.05),
        "q6": (q[:, 5] - np.pi / 2, -0.05, 0.05),
        "q7": (q[:, 6], -np.pi / 2, np.pi / 2),
        "q8": (q[:, 7], 0.05, 0.6),
        "radius": (np.hypot(log[:, 0], log[:, 1]), 5.5, 7.5),
        "azimuth": (np.arctan2(log[:, 1], log[:, 0]), -2 * np.pi / 3, -np.pi / 3),
        "yaw": (log[:, 2], -np.pi / 2, np.pi / 2),
        "diameter": (diameter, 0.3, 0.8),
    }
    for name, (values, low, high) in uniform.items():
        assert low - 1e-9 <= values.min() and values.max() <= high + 1e-9, name
        cdf = (np.sort(values) - low) / (high - low)
        kolmogorov = np.abs(cdf - (np.arange(n) + 0.5) / n).max()
        assert kolmogorov < 1.63 / np.sqrt(n), name  # the 1 % point
    for values, low, high in [(q[:, 1], 0.1, 1.0), (q[:, 2], -0.6, 0.8), (q[:, 3], 0.05, 1.0)]:
        assert low <= values.min() and high - 0.1 < values.max() <= high
    out, up = crane_task.tip_position(*q[:, 1:4].T)
    assert (4.5 <= out).all() and (out <= 8).all() and (2.7 <= up).all() and (up <= 4.2).all()
    assert (q[:, 1] + q[:, 2] > 0.05).all()
    azimuth = np.arctan2(log[:, 1], log[:, 0])
    radius = np.hypot(log[:, 0], log[:, 1])
    drawn = [q[:, 0], q[:, 6], q[:, 7], azimuth, log[:, 2], radius, diameter]
    correlation = np.corrcoef(drawn)
    assert np.abs(correlation - np.eye(7)).max() < 0.06


def test_the_world_starts_as_sampled():
    envs = CraneVectorEnv(6)
    envs.reset(seed=11)
    for i, seed in enumerate(np.random.SeedSequence(11).spawn(6)):
        q, (x, y, yaw), diameter = crane_task.sample_start(np.random.default_rng(seed))
        state = envs.state()
        np.testing.assert_allclose(state.q[i], q)
        np.testing.assert_allclose(state.log_centre[i], [x, y, diameter / 2], atol=1e-12)
        np.testing.assert_allclose(state.log_axis[i], [-np.sin(yaw), np.cos(yaw), 0], atol=1e-12)
        np.testing.assert_allclose(state.diameter[i], diameter)
    assert np.abs(state.dq).max() == 0
    assert not envs.state().touching.any()


def test_pose_noise_leaves_the_starts_alone():
    reference, _ = CraneVectorEnv(4).reset(seed=3)
    for noise in ("step", "episode"):
        envs = CraneVectorEnv(4, pose_noise=noise)
        obs, _ = envs.reset(seed=3)
        np.testing.assert_array_equal(obs[:, :14], reference[:, :14])
        assert np.abs(obs[:, 14:] - reference[:, 14:]).max() > 1e-4


def test_pose_noise_is_kept_or_redrawn():
    for noise, redrawn in [("step", True), ("episode", False)]:
        envs = CraneVectorEnv(1, pose_noise=noise)
        envs.reset(seed=3)
        factors = []
        for _ in range(4):
            obs, *_ = envs.advance(np.zeros((1, 6)))
            delta_p, _, angle = crane_task.relative_pose(envs.state())
            decay = (delta_p**2).sum() / 64
            away = np.linalg.norm(obs[0, 14:16]) / np.linalg.norm(delta_p[0, :2])
            changes = np.array([away, obs[0, 16] / delta_p[0, 2], obs[0, 17] / angle[0]]) - 1
            factors.append(changes / decay)  # of Delta_p twice, and of its angle
        factors = np.array(factors)
        np.testing.assert_allclose(factors[:, 0], factors[:, 1], atol=1e-4)
        assert ((np.ptp(factors, axis=0) > 0.01) == redrawn).all()
        assert np.abs(factors).min() > 1e-4 and np.abs(factors).max() < 0.1 + 1e-3
        assert np.abs(factors[:, 0] - factors[:, 2]).min() > 1e-3  # one draw each


class Remembered(list):
    """A memory of ends that never changes."""

    def append(self, success):
        pass


def test_retry_starts_failures_again(monkeypatch):
    """Every episode fails here. The share of repeats is retry times what a crane remembers."""
    monkeypatch.setattr(crane_task, "REACH_TIME", 0.8)
    for retry, success, low, high in [
        (0.0, 1.0, 0, 0),
        (0.5, 1.0, 0.35, 0.65),
        (1.0, 1.0, 1, 1),
        (1.0, 0.4, 0.3, 0.5),
    ]:
        envs = CraneVectorEnv(32, retry=retry)
        obs, _ = envs.reset(seed=0)
        envs.recent_success = [Remembered([success * (i % 2)]) for i in range(32)]
        seen, repeated = [{o.tobytes()} for o in obs], ([], [])
        for _ in range(60):
            obs, _, terminated, truncated, info = envs.step(np.full((32, 6), [0, -1, 0, 0, 0, 0]))
            assert not info["success"].any()
            for i in np.flatnonzero(terminated | truncated):
                repeated[i % 2].append(obs[i].tobytes() in seen[i])
                seen[i].add(obs[i].tobytes())
        assert not any(repeated[0])  # of cranes that remember no success
        assert len(repeated[1]) > 100 and low <= np.mean(repeated[1]) <= high
        assert max(len(failures) for failures in envs.failures) == 4
    envs.reset(seed=0)
    assert not any(envs.failures) and not any(envs.recent_success)


def test_retry_leaves_successes_alone(monkeypatch):
    """Idle cranes: first every episode counts as a success, then none."""

    def starts(env, episodes):
        seen = set()
        for _ in range(episodes):
            seen.add(env.reset()[0].tobytes())
            while not any(env.step(np.zeros(6))[2:4]):
                pass
        return seen

    env = CraneEnv(retry=1.0)
    env.reset(seed=1)
    with monkeypatch.context() as patch:
        patch.setattr(crane_task, "REACH_DISTANCE", 100.0)
        patch.setattr(crane_task, "grip_conditions", lambda *_: np.ones((3, 1), bool))
        assert len(starts(env, 10)) == 10
    assert len(starts(env, 2)) == 1  # repeated with a chance of nine tenths
    assert env.envs.recent_success[0].count(True) == 8


def test_difficulty():
    envs = CraneVectorEnv(64, difficulty=0.0)
    envs.reset(seed=0)
    state = envs.state()
    delta_p, delta_psi, _ = crane_task.relative_pose(state)
    assert delta_psi.max() < 1e-2  # aligned but for the swing
    easy = np.linalg.norm(delta_p[:, :2], axis=-1)
    np.testing.assert_allclose(state.diameter, 0.55)
    envs.difficulty = 1.0
    envs.reset(seed=0)
    delta_p, _, _ = crane_task.relative_pose(envs.state())
    assert easy.max() < 1.2 and np.linalg.norm(delta_p[:, :2], axis=-1).max() > 3
    start = crane_task.sample_start(np.random.default_rng(9))
    full = crane_task.ease_start(*start, 1.0)
    for eased, drawn in zip(full, start):
        np.testing.assert_allclose(eased, drawn, atol=1e-12)
    np.testing.assert_array_equal(crane_task.ease_start(*start, 0.3)[0], start[0])


def test_a_repeated_start_has_the_difficulty_of_now():
    envs = CraneVectorEnv(8, difficulty=0.0, retry=1.0)
    envs.reset(seed=0)
    for i in range(8):
        envs.failures[i].append(envs.starts[i])
        envs.recent_success[i].append(True)
    ways = []
    for envs.difficulty in (0.0, 1.0):
        envs.start_episodes(np.arange(8))
        ways.append(np.linalg.norm(crane_task.relative_pose(envs.state())[0][:, :2], axis=-1))
    assert ways[0].max() < 1.2 and ways[1].mean() > 1.5


def test_ends_are_recorded_as_they_come():
    """Every end counts once, and only an end."""
    envs = CraneVectorEnv(16)
    envs.reset(seed=0)
    recorded = envs.recent_success
    rng, ends = np.random.default_rng(0), [[] for _ in range(16)]
    for _ in range(70):  # idle cranes last 6 s, others end earlier
        actions = rng.uniform(-1, 1, (16, 1)) * [[1, 0, 0, 0, 0, 0]] * (np.arange(16) % 2)[:, None]
        _, _, terminated, truncated, info = envs.step(np.sign(actions))
        for i in np.flatnonzero(terminated | truncated):
            ends[i].append(info["success"][i])
    assert sum(map(len, ends)) >= 16 and list(map(list, recorded)) == ends
    assert sum(len(failures) for failures in envs.failures) >= 16  # each crane's last four


def test_trials_do_not_depend_on_how_many_there_are():
    few = crane_trials.monte_carlo_trials(5, 2, (0.4,))
    many = crane_trials.monte_carlo_trials(5, 10, (0.3, 0.4))
    starts = []
    for diameters, seeds in (few, many):
        envs = CraneVectorEnv(len(seeds), diameter=diameters)
        starts.append(envs.reset(seed=seeds)[0])
    np.testing.assert_array_equal(starts[0], starts[1][10:12])
    assert len(np.unique(starts[1][:, 0])) == 20


def test_action_is_a_fraction_of_the_speed_limit():
    envs = CraneVectorEnv(2)
    envs.reset(seed=0)
    envs.advance(np.array([[-0.5] * 6, [0.5] * 6]))
    low, high = machine.SPEEDS["real"]
    expected = np.stack([0.5 * low, 0.5 * high])[:, machine.COMMAND_OF_SERVO]
    np.testing.assert_allclose(envs.ctrl[:, :8], expected)
    np.testing.assert_allclose(envs.ctrl[:, 8:], expected)
    envs.advance(np.full((2, 6), 7.0))  # beyond the box: clipped
    np.testing.assert_allclose(envs.ctrl[0], [*high[machine.COMMAND_OF_SERVO]] * 2)


@pytest.mark.parametrize(
    "kwargs, words",
    [
        ({"diameter": 0.29}, "diameter"),
        ({"diameter": [0.5, 0.9]}, "diameter"),
        ({"num_envs": 0}, "num_envs"),
        ({"frame_skip": 0}, "frame_skip"),
        ({"frame_skip": 2.5}, "frame_skip"),
        ({"frame_skip": True}, "frame_skip must be a whole number"),
        ({"frame_skip": "20"}, r"frame_skip must be a whole number in \[1, 1,800\], got '20'"),
        ({"contact": "soft"}, "contact must be one of 'primitive', 'sdf'"),
        ({"reward": "dense"}, "reward"),
        ({"speed": "fast"}, "speed"),
        ({"offset": "none"}, "offset"),
        ({"pose_noise": "much"}, "pose_noise"),
        ({"integrator": "RK45"}, "integrator"),
        ({"integrator": "Euler"}, "integrator"),
        ({"solver": "LU"}, "solver"),
        ({"retry": -0.1}, "retry must be a number in"),
        ({"retry": np.nan}, "retry must be a number in"),
        ({"difficulty": 1.5}, "difficulty"),
        ({"render_mode": "ascii"}, "render_mode"),
        ({"camera": "back"}, "camera"),
        ({"signed_yaw": "yes"}, "signed_yaw must be one of False, True, got 'yes'"),
        ({"axes": "boom"}, "axes must be one of 'crane', 'world'"),
        ({"frame_skp": 5}, "no option 'frame_skp', only .*frame_skip"),
        ({"diametr": 0.5}, "no option 'diametr', only .*diameter"),
        ({"omega2": 1.0}, "no option 'omega2'"),
        ({"diameter": [0.5, 0.5, 0.5]}, "diameter must be one number or 2 numbers"),
        ({"num_envs": 2.5}, r"num_envs must be a whole number in \[1, 16,384\], got 2.5"),
        ({"num_envs": np.nan}, "num_envs must be a whole number"),
        ({"env_threads": -1}, "env_threads must be a whole number"),
        ({"width": 0}, r"width must be a whole number in \[1, 1,920\], got 0"),
        ({"height": 1081}, "height must be a whole number"),
        ({"autoreset_mode": "later"}, "autoreset_mode must be one of 'SameStep', 'NextStep', got"),
        ({"autoreset_mode": AutoresetMode.DISABLED}, "autoreset_mode must be one of 'SameStep',"),
    ],
)
def test_bad_arguments(kwargs, words):
    with pytest.raises(ValueError, match=words):
        CraneVectorEnv(**{"num_envs": 2, **kwargs})


def test_complete_fills_in_the_defaults_and_leaves_its_argument_alone():
    given = {"retry": 0.5, "frame_skip": 1800}
    assert crane_options.complete(given) == {**DEFAULTS, "retry": 0.5, "frame_skip": 1800}
    assert given == {"retry": 0.5, "frame_skip": 1800}
    assert crane_options.complete({}) == DEFAULTS and crane_options.complete({}) is not DEFAULTS
    with pytest.raises(ValueError, match=r"number in \[1, 1,800\], got 1801"):
        crane_options.complete({"frame_skip": 1801})


def test_bad_calls():
    envs = CraneVectorEnv(2)
    with pytest.raises(RuntimeError, match="reset"):
        envs.step(np.zeros((2, 6)))
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(2, 6\)"):
        envs.step(np.zeros((2, 5)))
    with pytest.raises(ValueError, match="NaN"):
        envs.step(np.full((2, 6), np.nan))
    with pytest.raises(ValueError, match="seeds"):
        envs.reset(seed=[1, 2, 3])
    for holder in (envs, CraneEnv()):
        with pytest.raises(ValueError, match="reset takes no options, got {'reset_mask': 0}"):
            holder.reset(options={"reset_mask": 0})
    env = CraneEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"an action must have shape \(6,\), got \(5,\)"):
        env.step(np.zeros(5))
    with pytest.raises(ValueError, match="one crane has no autoreset_mode"):
        CraneEnv(autoreset_mode="SameStep")


def test_difficulty_is_checked_and_set_from_anywhere():
    env = gymnasium.make("ForestryCrane-v0", difficulty=0.5)
    assert env.get_wrapper_attr("difficulty") == env.unwrapped.difficulty == 0.5
    env.set_wrapper_attr("difficulty", 0.0)
    _, info = env.reset(seed=0)
    assert env.unwrapped.envs.difficulty == 0.0 and info["d_combine"] < 1.5
    cranes = gymnasium.make_vec("ForestryCrane-v0", 2, vectorization_mode="sync")
    cranes.set_attr("difficulty", [0.25, 0.75])
    assert cranes.get_attr("difficulty") == (0.25, 0.75)
    cranes = CraneVectorEnv(2)
    for values in (0.25, [0.75, 0.75]):
        cranes.set_attr("difficulty", values)
        assert cranes.get_attr("difficulty") == (cranes.difficulty,) * 2 == (np.max(values),) * 2
    with pytest.raises(ValueError, match="all cranes share difficulty"):
        cranes.set_attr("difficulty", [0.25, 0.75])
    for name in ("dificulty", "frame_skip", "num_envs"):
        with pytest.raises(AttributeError, match=f"only difficulty can be set, not {name}"):
            cranes.set_attr(name, 0.5)
    for holder in (cranes, env.unwrapped):
        for wrong in (-0.1, 1.5, np.nan, "1"):
            with pytest.raises(ValueError, match=r"difficulty must be a number in \[0, 1\]"):
                holder.difficulty = wrong


def test_spec_knows_the_length_of_an_episode():
    for options, steps in [({}, 90), ({"frame_skip": 1}, 1800), ({"frame_skip": 7}, 258)]:
        env = gymnasium.make("ForestryCrane-v0", **options)
        assert env.spec.max_episode_steps == steps == env.unwrapped.spec.max_episode_steps
    assert gymnasium.make("ForestryCranePaper-v0").spec.max_episode_steps == 1800
    assert gymnasium.make(env.spec).unwrapped.envs.frame_skip == 7
    assert gymnasium.make_vec("ForestryCrane-v0", num_envs=2).spec.id == "ForestryCrane-v0"
    assert CraneEnv().spec is None


def test_info_has_masks_and_what_sb3_reads(monkeypatch):
    """Gymnasium's own conversion to one dictionary a crane finds what it looks for."""
    monkeypatch.setattr(crane_task, "REACH_TIME", 0.5)
    envs = DictInfoToList(CraneVectorEnv(3))
    _, infos = envs.reset(seed=0)
    names = {"d_combine", "clearance", "centre_miss", "diameter", "log_mass", *crane_task.TERMS}
    assert all(set(info) == names for info in infos)
    envs.env.reach_time[1] = 0.1
    of_ends = {"success", "is_success", *crane_task.CONDITIONS}
    for _ in range(5):
        _, _, terminated, _, infos = envs.step(np.zeros((3, 6)))
    assert terminated.tolist() == [True, False, True]
    for info, ended in zip(infos, terminated):
        assert names | {"termination", "time_to_reach"} <= set(info)
        assert (of_ends | {"final_obs", "final_info"} <= set(info)) == ended
    env = CraneEnv()
    _, info = env.reset(seed=0)
    assert set(info) == names
    info = env.step(np.zeros(6))[-1]
    of_ends |= {"gentle"}
    costs = {*crane_env.CARE, "termination", "time_to_reach"}
    assert set(info) == names | of_ends | costs


def test_next_step_autoreset():
    """As Gymnasium's SyncVectorEnv does it, from the same starts and with the same actions."""
    ours = CraneVectorEnv(4, autoreset_mode=AutoresetMode.NEXT_STEP)
    assert ours.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    theirs = SyncVectorEnv([CraneEnv] * 4, autoreset_mode=AutoresetMode.NEXT_STEP)
    seeds = np.random.SeedSequence(5).spawn(4)
    obs, _ = ours.reset(seed=seeds)
    for env, seed, crane in zip(theirs.envs, seeds, obs):  # Gymnasium passes whole numbers only
        env.envs.reset(seed=[seed])
        np.testing.assert_array_equal(
            env.envs.observe(env.envs.state(), np.zeros((1, 6)))[0][0], crane
        )
    theirs._autoreset_envs[:] = False  # it has not seen these resets
    theirs.action_space.seed(0)
    rng, ends, rests = np.random.default_rng(0), 0, 0
    for _ in range(150):
        actions = np.sign(rng.uniform(-1, 1, (4, 6))) * [1, 0, 0, 0, 1, 1]
        resting = ours.resting.copy()
        obs, reward, terminated, truncated, info = ours.step(actions)
        expected = theirs.step(actions.astype(np.float32))
        for mine, other in zip((obs, reward, terminated, truncated), expected):
            np.testing.assert_array_equal(mine, other)
        assert (reward[resting] == 0).all() and np.isinf(info["time_to_reach"][resting]).all()
        assert (info["termination"][resting] == "none").all() and "final_obs" not in info
        assert (info["litres"][resting] == 0).all()
        assert np.isinf(info["time_up"][resting]).all() and (info["log_speed"][resting] == 0).all()
        np.testing.assert_array_equal(info["clearance"], expected[4]["clearance"])
        ends, rests = ends + terminated.sum() + truncated.sum(), rests + resting.sum()
    assert ends > 5 and rests == ends - (ours.resting).sum()
    assert sum(map(len, ours.recent_success)) == ends  # an end counts once
    ours.reset(seed=0)
    assert not ours.resting.any()


def test_wrappers_that_need_next_step():
    with pytest.raises(ValueError, match="NEXT_STEP"):
        NormalizeObservation(CraneVectorEnv(2))
    envs = gymnasium.make_vec("ForestryCrane-v0", num_envs=2, autoreset_mode="NextStep")
    envs = NormalizeReward(NormalizeObservation(envs))
    envs.reset(seed=0)
    for _ in range(3):
        obs, *_ = envs.step(np.zeros((2, 6)))
    assert np.isfinite(obs).all()


@pytest.mark.parametrize("copying", [pickle.dumps, copy.copy, copy.deepcopy])
@pytest.mark.parametrize("make", [CraneEnv, CraneVectorEnv])
def test_cranes_say_that_they_cannot_be_copied(make, copying):
    env = make()
    env.reset(seed=0)
    with pytest.raises(TypeError, match="cannot be copied or pickled; make new ones"):
        copying(env)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.filterwarnings("ignore:.*fork")
@pytest.mark.parametrize("threads, expected", [(1, b"stepped"), (2, b"make the cranes after the")])
def test_a_forked_process_does_not_hang(threads, expected):
    envs = CraneVectorEnv(4, env_threads=threads)
    envs.reset(seed=0)
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            envs.step(np.zeros((4, 6)))
            os.write(write, b"stepped")
        except RuntimeError as error:
            os.write(write, str(error).encode())
        del envs  # whose end waits for its threads in any other process
        os.write(write, b" and ended")
        os._exit(0)
    os.close(write)
    said = b""
    while select.select([read], [], [], 30)[0] and (more := os.read(read, 99)):
        said += more
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    assert said.startswith(expected) and said.endswith(b" and ended")
    assert envs.step(np.zeros((4, 6)))[0].shape == (4, 18)  # the parent goes on


def test_divergence_is_reported_and_recovered(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # the engine logs its warning into the current folder
    envs = CraneVectorEnv(3)
    envs.reset(seed=0)
    envs.qvel[1] = np.nan
    obs, reward, terminated, truncated, info = envs.step(np.zeros((3, 6)))
    assert info["termination"].tolist() == ["none", "diverged", "none"]
    assert terminated.tolist() == [False, True, False] and reward[1] == 0
    assert np.isfinite(obs).all() and np.isfinite(info["final_obs"][1]).all()
    assert all(np.isfinite(info[term]).all() for term in crane_task.TERMS)  # reports take the mean
    # the engine puts the crane into its zero position, in the ground: that is no hit and no work
    assert info["ground_peak"][1] == info["r_ground"][1] == info["work"][1] == 0
    _, _, terminated, _, info = envs.step(np.zeros((3, 6)))
    assert not terminated.any() and set(info["termination"]) == {"none"}
    state = envs.state()
    state.q[0], state.dq[1], state.log_centre[2] = np.nan, np.inf, np.nan  # should any get this far
    obs, _ = envs.observe(state, np.zeros((3, 6)))
    assert envs.observation_space.contains(obs)


def test_a_window_needs_a_display(monkeypatch):
    monkeypatch.setattr(crane_env, "HEADLESS", True)
    with pytest.raises(RuntimeError, match="needs a display"):
        CraneVectorEnv(1, render_mode="human")


def test_render():
    needs_opengl()
    env = gymnasium.make("ForestryCrane-v0", render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.shape == (480, 640, 3) and first.dtype == np.uint8
    assert first.std() > 10  # a scene, not a blank
    for _ in range(20):
        env.step(np.array([1, 0, 0, 0, 0, 0], np.float32))
    assert np.abs(env.render().astype(int) - first).max() > 50
    env.close()
