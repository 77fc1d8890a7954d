"""The environment's contract: spaces, seeds, starts, info, hooks, errors."""

import re

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers.vector import DictInfoToList
from reference_crane import FASTEST, RANGES, SLOWEST

import crane_env
from crane_env import ACTUATED, GENTLE_FORCE, CraneEnv, CraneVectorEnv
from hydraulic_crane import HydraulicCraneEnv, HydraulicCraneVectorEnv
from loading_crane import (
    HydraulicLoadingCraneEnv,
    HydraulicLoadingCraneVectorEnv,
    LoadingCraneEnv,
    LoadingCraneVectorEnv,
)

IDEAL, HYDRAULIC = (CraneEnv, CraneVectorEnv), (HydraulicCraneEnv, HydraulicCraneVectorEnv)
LOADING = LoadingCraneEnv, LoadingCraneVectorEnv
HYDRAULIC_LOADING = HydraulicLoadingCraneEnv, HydraulicLoadingCraneVectorEnv
DRIVES = {"sensors": True, "randomize": 0.0}
PRINTED = {"frame_skip": 1, "contact": "sdf", "reward": "paper", "offset": "minus"}
LEVELS = {  # classes of one crane and of many, revision, options
    "ForestryCrane-v0": (*IDEAL, 7, {}),
    "ForestryCranePaper-v0": (*IDEAL, 7, PRINTED | {"signed_yaw": False, "axes": "world"}),
    "ForestryCraneHydraulic-v0": (*HYDRAULIC, 8, DRIVES),
    "ForestryCraneRandomized-v0": (*HYDRAULIC, 8, DRIVES | {"randomize": 1.0}),
    "ForestryCraneLoading-v0": (*LOADING, 1, {}),
    "ForestryCraneHydraulicLoading-v0": (*HYDRAULIC_LOADING, 1, DRIVES),
}
MEASURED = {"d_combine", "clearance", "centre_miss", "diameter", "log_mass", "ground_peak"}
TERMS = {"r_distance", "r_grapple", "r_lift", "r_balance", "r_ground"}
OF_STEPS = TERMS | {"time", "time_to_reach", "safe", "termination", "diverged"}
OF_ENDS = {"success", "is_success", "gentle", "failure"}


def cranes(n=1, **options):
    envs = CraneVectorEnv(n, env_threads=1, **options)
    envs.reset(seed=0)
    return envs


# ---- Gymnasium's contract


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("env_id", LEVELS)
def test_levels(env_id):
    """What each id stands for, made as one crane and as many."""
    one, many, revision, options = LEVELS[env_id]
    env = gymnasium.make(f"crane_env:{env_id}").unwrapped
    envs = gymnasium.make_vec(f"crane_env:{env_id}", 2).unwrapped
    assert type(env) is one and type(envs) is type(env.envs) is many
    default = {"frame_skip": 20, "contact": "primitive", "reward": "staged", "offset": "plus"}
    default |= {"signed_yaw": True, "axes": "crane", "pose_noise": "none"}
    assert envs.task == env.envs.task == {"revision": revision, "options": default | options}
    check_env(env, skip_render_check=True)  # which would open a window


def test_spaces():
    low = [*np.array(RANGES)[:, 0] - 0.5, *[-10] * 6, *[-20] * 3, -1.5 * np.pi]
    high = [*np.array(RANGES)[:, 1] + 0.5, *[10] * 6, *[20] * 3, 1.5 * np.pi]
    sensors = [1] * 6 + [10] * 2 + [1] * 6
    short = HydraulicCraneVectorEnv(3, sensors=False)
    for envs, more in [(cranes(3), []), (short, []), (HydraulicCraneVectorEnv(3), sensors)]:
        bounds = np.float32([*low, *np.negative(more)]), np.float32(high + more)
        assert envs.single_observation_space == gymnasium.spaces.Box(*bounds)
        assert envs.single_action_space == gymnasium.spaces.Box(-1, 1, (6,), np.float32)
        obs, _ = envs.reset(seed=0)
        assert obs in envs.observation_space and obs.flags.c_contiguous


def test_a_crane_is_the_same_for_any_number_of_cranes_and_threads():
    """Over several short episodes, with noise and repeated starts."""
    options = {"pose_noise": "step", "retry": 0.8, "randomize": 1.0}
    short = {"TIME_LIMIT": 0.7, "HOLD_TIME": 0.1}  # s
    short["conditions"] = lambda self, state, info: {"not_turned": state.q[:, 6] > 0}
    short = type("Short", (HydraulicCraneVectorEnv,), short)

    def crane(n, threads, i):
        envs, rng = short(n, env_threads=threads, **options), np.random.default_rng(1)
        seen = [envs.reset(seed=np.random.SeedSequence(7).spawn(5)[:n] if n < 5 else 7)[0][i]]
        for _ in range(30):
            obs, reward, *_ = envs.step(np.tile(rng.uniform(-1, 1, 6), (n, 1)))
            seen += [obs[i], reward[i]]
        assert n == 1 or any(map(len, envs.failures)) and any(map(any, envs.recent_success))
        return np.hstack(seen)

    reference = crane(5, 1, 0)
    np.testing.assert_array_equal(reference, crane(1, 1, 0))
    np.testing.assert_array_equal(reference, crane(5, 2, 0))
    assert np.abs(reference - crane(5, 1, 3)).max() > 0.1


def test_some_cranes_can_be_reset():
    """Also below Gymnasium's wrappers, which read in `metadata` who resets."""
    envs = CraneVectorEnv(3, autoreset=False)
    envs = gymnasium.wrappers.vector.TransformObservation(envs, lambda obs: 2 * obs)
    envs.reset(seed=0)
    for _ in range(5):
        before, *_ = envs.step(np.ones((3, 6)))
    mask = np.array([True, False, False])
    after, _ = envs.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(envs.unwrapped.steps, [0, 5, 5])
    np.testing.assert_array_equal((after != before).any(axis=1), mask)


def test_seeds():
    """A seed starts anew, no seed goes on, and none at all is another one each time."""
    envs = cranes(2)
    obs = [envs.reset(seed=seed)[0].tobytes() for seed in (3, None, 3, None, 4, [5, 6])]
    obs += [CraneVectorEnv(2).reset()[0].tobytes() for _ in range(2)]
    assert obs[0] == obs[2] and obs[1] == obs[3] and len(set(obs)) == 6
    envs.recent_success[0].append(True)
    envs.failures[0].append(envs.starts[0])
    envs.reset(seed=1)
    assert not envs.recent_success[0] and not envs.failures[0]


@pytest.mark.parametrize("difficulty", [1.0, 0.4])
def test_a_hook_may_change_a_start_in_place(difficulty):
    """The repeated start is still the one that failed."""

    class Nearer(CraneVectorEnv):
        def draw_episode(self, i):
            q, log_pose, diameter = super().draw_episode(i)
            q[0] += 0.1
            log_pose[:2] *= 0.9
            return q, log_pose, diameter

    envs = Nearer(1, env_threads=1, difficulty=difficulty, retry=1.0)
    obs = [envs.reset(seed=5)[0]]
    envs.recent_success[0].append(True)
    envs.failures[0].append(envs.starts[0])
    obs += [envs.reset()[0] for _ in range(2)]
    np.testing.assert_array_equal(obs[1], obs[0])
    np.testing.assert_array_equal(obs[2], obs[0])


def test_a_start_of_ones_own_still_has_pose_errors():
    class Own(CraneVectorEnv):
        def draw_episode(self, i):
            return crane_env.sample_start(self.rngs[i][2])

    envs = Own(2, env_threads=1, pose_noise="step")
    envs.reset(seed=0)
    assert (0 < np.abs(envs.noise).max(axis=(1, 2))).all()


def test_difficulty_of_single_cranes():
    """From the next reset on. At 0 the log has the grapple's yaw."""
    envs = gymnasium.vector.SyncVectorEnv([CraneEnv] * 3)
    assert np.abs(envs.reset(seed=0)[0][:, 17]).max() > 0.5
    envs.set_attr("difficulty", 0.0)
    np.testing.assert_allclose(envs.reset(seed=0)[0][:, 17], 0, atol=0.06)  # q5 and q6 swing


def test_one_crane_is_a_view_of_many():
    """The same numbers in Python's own types, also at the end; and no autoreset."""
    kwargs = {"difficulty": 0.5, "randomize": 1.0}
    env, envs = HydraulicCraneEnv(**kwargs), HydraulicCraneVectorEnv(1, **kwargs)
    env.envs.REACH_TIME = envs.REACH_TIME = 0.3
    obs, info = env.reset(seed=5)
    np.testing.assert_array_equal(obs, envs.reset(seed=5)[0][0])
    drawn = {name for name in info if name.startswith("drawn_")}
    assert set(info) == MEASURED | drawn and len(drawn) == 10
    for k in range(3):
        action = np.linspace(-1, 1, 6)
        obs, *numbers, info = env.step(action)
        obs_of_many, *many, infos = envs.step(action[None])
        np.testing.assert_array_equal(obs, infos["final_obs"][0] if k == 2 else obs_of_many[0])
        assert numbers == [x[0] for x in many] and [*map(type, numbers)] == [float, bool, bool]
        assert set(info) == MEASURED | OF_STEPS | OF_ENDS | drawn
        for name, value in info.items():
            assert type(value) in (float, bool, str) or name in drawn and value.ndim, name
            np.testing.assert_array_equal(value, infos[name][0])
    assert numbers[1] and info["termination"] == info["failure"] == "not_reached"


def test_wrappers_find_what_they_look_for():
    """Masks of info for Gymnasium's conversions."""
    envs = DictInfoToList(cranes(3))
    envs.unwrapped.REACH_TIME = 0.1
    _, infos = envs.reset(seed=0)
    assert all(set(info) == MEASURED for info in infos)
    envs.unwrapped.reach_time[1] = 0.1
    *_, terminated, _, infos = envs.step(np.zeros((3, 6)))
    assert terminated.tolist() == [True, False, True]
    for info, ended in zip(infos, terminated):
        others = OF_ENDS | {"final_obs", "final_info"} if ended else set()
        assert set(info) == MEASURED | OF_STEPS | others


def test_observers_see_the_sensors_after_every_physics_step():
    coarse, fine, seen = cranes(), cranes(frame_skip=1), []
    coarse.observers.append(lambda envs: seen.append(envs.state().grapple_centre[0]))
    actions = np.full((1, 6), 0.5)
    coarse.step(actions)
    for k in range(20):
        fine.step(actions)
        np.testing.assert_array_equal(seen[k], fine.state().grapple_centre[0])


def test_returned_arrays_are_not_live():
    envs = HydraulicCraneVectorEnv(2, randomize=1.0)
    envs.TIME_LIMIT = 0.3
    returned = [*envs.reset(seed=0), *envs.step(np.ones((2, 6)))]
    returned = [x if isinstance(x, dict) else {"": x} for x in returned]
    before = [{name: np.copy(x) for name, x in part.items()} for part in returned]
    for _ in range(5):
        envs.step(-np.ones((2, 6)))
    for part, copied in zip(returned, before):
        for name, value in part.items():
            np.testing.assert_array_equal(value, copied[name], name)


def test_render(opengl):
    envs = cranes(2, render_mode="rgb_array", width=320, height=240, camera="side")
    first = envs.render()
    assert first[0].shape == (240, 320, 3) and first[0].dtype == np.uint8 and first[0].std() > 10
    assert np.abs(envs.picture(0, "overview").astype(int) - first[0]).max() > 50
    assert cranes().model.ngeom < envs.model.ngeom  # what is only drawn is left out
    for _ in range(10):
        envs.step([[0, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0]])
    still, moved = (np.abs(a.astype(int) - b).max() for a, b in zip(envs.render(), first))
    assert still < moved > 50 and envs.metadata["render_fps"] == 10
    env = CraneEnv(render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (480, 640, 3)


# ---- starts


def test_start_distribution():
    """Ranges and uniformity as fixed for the task."""
    rng, n = np.random.default_rng(0), 4000
    q, log, diameter = map(np.array, zip(*[crane_env.sample_start(rng) for _ in range(n)]))
    hanging = np.pi / 2 - q[:, 1] - q[:, 2]
    radius, azimuth = np.hypot(log[:, 0], log[:, 1]), np.arctan2(log[:, 1], log[:, 0])
    for name, values, low, high in [
        ("q1", q[:, 0], -2 * np.pi / 3, -np.pi / 3),
        ("q5", q[:, 4] - hanging, -0.05, 0.05),
        ("q6", q[:, 5] - np.pi / 2, -0.05, 0.05),
        ("q7", q[:, 6], -np.pi / 2, np.pi / 2),
        ("q8", q[:, 7], 0.05, 0.6),
        ("radius", radius, 5.5, 7.5),
        ("azimuth", azimuth, -2 * np.pi / 3, -np.pi / 3),
        ("yaw", log[:, 2], -np.pi / 2, np.pi / 2),
        ("diameter", diameter, 0.3, 0.8),
    ]:
        assert low - 1e-9 <= values.min() and values.max() <= high + 1e-9, name
        cdf = (np.sort(values) - low) / (high - low)
        kolmogorov = np.abs(cdf - (np.arange(n) + 0.5) / n).max()
        assert kolmogorov < 1.63 / np.sqrt(n), name  # the 1 % point
    for values, low, high in [(q[:, 1], 0.1, 1.0), (q[:, 2], -0.6, 0.8), (q[:, 3], 0.05, 1.0)]:
        assert low <= values.min() and high - 0.1 < values.max() <= high
    out, up = crane_env.tip_position(*q[:, 1:4].T)
    assert (4.5 <= out).all() and (out <= 8).all() and (2.7 <= up).all() and (up <= 4.2).all()
    assert (q[:, 1] + q[:, 2] > 0.05).all()
    drawn = [q[:, 0], q[:, 6], q[:, 7], azimuth, log[:, 2], radius, diameter]
    assert np.abs(np.corrcoef(drawn) - np.eye(7)).max() < 0.06


def test_a_whole_turn_of_the_slew_changes_no_angle():
    """Also where the longer turn to the log is the better one."""
    state = cranes(200).state()
    angle = crane_env.signed_angle(state)
    assert angle.min() < -np.pi / 2 and angle.max() > np.pi / 2
    for turn in (-2 * np.pi, 2 * np.pi):
        turned = state._replace(q=state.q + turn * np.eye(8)[0])
        np.testing.assert_allclose(crane_env.signed_angle(turned), angle, atol=1e-9)


# ---- rules and success


def test_rules():
    """One crane for each situation, and the name of its ending."""
    envs, expected = cranes(50), []
    hanging = np.array([-1.5, 0.5, 0.2, 0.5, 0.87, np.pi / 2, 0.0, 1.5])
    state = envs.state()._replace(q=np.tile(hanging, (50, 1)), dq=np.zeros((50, 6)))
    state.grapple_centre[:], state.log_centre[:] = [0, -6, 1], [0, -6, 0.2]
    info = {"time": np.full(50, 1.0), "diverged": np.zeros(50, bool)}
    envs.reach_time[:] = 1.0

    def situation(ending, array, column, value):
        array[(len(expected), column)[: array.ndim]] = value
        expected.append(ending)

    for joint, (low, high) in enumerate(RANGES):
        # the jaws' stops are part of grasping
        ending = f"joint_limit_q{joint + 1}" if joint < 7 else "none"
        situation(ending, state.q, joint, low - 0.021)
        situation(ending, state.q, joint, high + 0.021)
        situation("none", state.q, joint, high + 0.019)
    for joint in (1, 3):
        situation("overspeed", state.dq, joint, 2.01 * SLOWEST[joint])
        situation("overspeed", state.dq, joint, 2.01 * FASTEST[joint])
        situation("none", state.dq, joint, 1.99 * SLOWEST[joint])
        situation("none", state.dq, joint, 1.99 * FASTEST[joint])
    situation("none", state.grapple_centre, 2, 8.1)
    situation("log_too_far", state.grapple_centre, 2, 8.3)
    never = np.inf
    for time, reached, ending in [(5.9, never, "none"), (6, 6, "none"), (6, never, "not_reached")]:
        info["time"][len(expected)] = time
        situation(ending, envs.reach_time, 0, reached)
    state.q[len(expected), 0] = 9.0  # the first rule counts
    situation("diverged", info["diverged"], 0, True)
    rules = envs.rules(state, info)
    for i, ending in enumerate(expected):
        assert next((name for name, holds in rules.items() if holds[i]), "none") == ending, i


def test_conditions():
    envs, miss = cranes(4), np.array([0.3, 0.1, 0.1, 0.301])
    state, info = envs.state(), {"clearance": np.array([0.1, 0.099, 0.2, 0.2]), "centre_miss": miss}
    state.touching[:] = [[True, True], [True, True], [True, False], [True, True]]
    conditions = envs.conditions(state, info).items()
    failed = {name: np.flatnonzero(~ok).tolist() for name, ok in conditions}
    assert failed == {"not_lifted": [1], "not_held": [2], "off_centre": [3]}


@pytest.mark.parametrize("frame_skip, window, length", [(20, 6, 90), (7, 15, 258)])
def test_success_needs_all_of_the_last_half_second(frame_skip, window, length):
    """One step without a grip spoils success within the window, and only there."""
    slips = np.array([0, length - window - 1, length - window, length - 3, length - 1, -1])

    class Slipping(CraneVectorEnv):
        def reached(self, info):
            return info["time"] > 6.01  # too late to count

        def rules(self, state, info):
            return {}

        def conditions(self, state, info):
            held = self.steps - 1 != slips
            return {"slipped": held, "named second": held}

    envs = Slipping(6, frame_skip=frame_skip)
    envs.reset(seed=0)
    for k in range(length):
        envs.ground_peak[0], envs.ground_peak[1] = 20.1e3, 19.9e3
        *_, terminated, truncated, info = envs.step(np.zeros((6, 6)))
        assert (truncated == (k + 1 == length)).all() and not terminated.any()
        assert info["safe"][5] == (k + 1 >= window)
    kept = slips < length - window
    np.testing.assert_array_equal(info["success"], kept)
    assert np.isinf(info["time_to_reach"]).all()
    assert info["gentle"].tolist() == [False, True, False, False, False, True]
    assert info["failure"].tolist() == [["slipped", ""][int(ok)] for ok in kept]
    assert [list(outcomes) for outcomes in envs.recent_success] == [[ok] for ok in kept]
    assert [len(failures) for failures in envs.failures] == [int(not ok) for ok in kept]


def test_divergence_is_reported_and_recovered(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # the engine logs its warning into the current folder
    envs = cranes(3)
    envs.qvel[1] = np.nan
    obs, reward, terminated, _, info = envs.step(np.zeros((3, 6)))
    assert info["termination"].tolist() == ["none", "diverged", "none"]
    assert terminated.tolist() == [False, True, False] and reward[1] == 0
    assert obs in envs.observation_space and info["final_obs"][1] in envs.single_observation_space
    assert all(np.isfinite(info[term]).all() for term in TERMS)
    # the engine puts the crane into its zero position, in the ground: that is no hit
    assert info["ground_peak"][1] == info["r_ground"][1] == 0
    assert set(envs.step(np.zeros((3, 6)))[-1]["termination"]) == {"none"}


# ---- a task of one's own


class Carry(CraneVectorEnv):
    """An observation, a reward, a rule, a goal, a condition and a drive of one's own."""

    TIME_LIMIT, REACH_TIME, HOLD_TIME, GOALS = 1.0, 0.4, 0.2, ("turned",)

    def observation_limits(self):
        return np.append(super().observation_limits(), [[-10], [10]], axis=1)

    def observe(self, state):
        return np.append(super().observe(state), state.log_centre[:, :1], axis=1)

    def reward_terms(self, state, info):
        return super().reward_terms(state, info) | {"r_effort": -np.abs(self.command).sum(axis=-1)}

    def rules(self, state, info):
        return super().rules(state, info) | {"turned": state.q[:, 6] > 1.2}

    def conditions(self, state, info):
        return {"not_left": state.q[:, 0] > -1.5}

    def drive(self, ids, seconds):
        self.command[:, 5] = 0.0  # jaws that do not move
        super().drive(ids, seconds)


def test_hooks_make_a_task():
    gymnasium.register("Carry-v0", vector_entry_point=Carry)
    envs, ends = gymnasium.make_vec("Carry-v0", 32).unwrapped, set()
    obs, _ = envs.reset(seed=0)
    assert obs.shape == (32, 19) and envs.single_observation_space.high[18] == 10
    for _ in range(10):
        envs.reach_time[:16] = 0.1
        obs, reward, *_, info = envs.step(np.full((32, 6), 0.5))
        assert obs in envs.observation_space
        np.testing.assert_allclose(reward, sum(info[name] for name in {*TERMS, "r_effort"}))
        np.testing.assert_allclose(info["r_effort"], -0.5 * (0.802 + 0.239 + 0.326 + 0.4 + 2.12))
        ended = info["termination"] != "none"
        ends |= {*zip(info["termination"][ended], info["failure"][ended], info["success"][ended])}
    assert {("turned", "turned", False), ("turned", "", True), ("time_limit", "", True)} <= ends
    assert {("not_reached", "not_reached", False), ("time_limit", "not_left", False)} <= ends
    assert np.ptp(obs[:, 7]) < 0.6 and np.abs(obs[:, 13]).max() < 0.05
    np.testing.assert_allclose(obs[:, 18], envs.state().log_centre[:, 0], rtol=1e-6)


def test_what_an_edited_model_says_counts():
    """Time step and gravity: length of a step, of an episode, weight of a log."""

    class Edited(CraneVectorEnv):
        def make_spec(self):
            spec = super().make_spec()
            spec.option.timestep, spec.option.gravity = 0.002, [0, 0, -5]
            return spec

    envs = Edited(2, env_threads=1)
    envs.reset(seed=0)
    assert envs.dt == pytest.approx(0.04) and envs.max_steps == 225 and envs.hold_steps == 13
    for _ in range(150):
        *_, terminated, _, info = envs.step(np.zeros((2, 6)))
    assert info["time"][0] == pytest.approx(6.0) and terminated.all()  # REACH_TIME, in steps
    for _ in range(20):
        envs.step(np.zeros((2, 6)))
    np.testing.assert_allclose(envs.state().carried, 0, atol=0.02)  # logs lie on the ground


@pytest.mark.parametrize("skip, physics_step, steps", [(20, 0.01, 10), (3, 0.01, 2), (1, 0.01, 1)])
def test_coarser_physics_is_the_same_task(skip, physics_step, steps):
    """Steps, limits and free motion are those of the exact physics, within 1 cm and 0.01 rad."""
    kinds = [CraneVectorEnv(4, frame_skip=skip, physics_step=p) for p in (0.0, physics_step)]
    fine, coarse = kinds
    assert (fine.dt, fine.max_steps, fine.hold_steps) == (
        coarse.dt, coarse.max_steps, coarse.hold_steps
    )  # fmt: skip
    assert (fine.physics_steps, coarse.physics_steps) == (skip, steps)
    assert coarse.model.opt.timestep == pytest.approx(fine.dt / steps)
    for envs in kinds:
        envs.reset(seed=5)
        for _ in range(round(1 / envs.dt)):
            envs.step(np.tile([0.4, 0.5, 0.2, 0.3, 0.3, 0.2], (4, 1)))
    moved = np.abs(fine.state().q - coarse.state().q)[:, ACTUATED]
    assert moved.max() < 0.01 and (moved.max() == 0) == (steps == skip)


@pytest.mark.parametrize("cranes", [CraneVectorEnv, HydraulicCraneVectorEnv])
def test_coarser_physics_feels_hits_as_hard(cranes):
    """The boom drives 32 grapples onto the ground: medians of the largest force, within a fifth."""
    fine, coarse = (cranes(32, physics_step=p, autoreset=False) for p in (0.0, 0.01))
    for envs in (fine, coarse):
        envs.reset(seed=1)
        for _ in range(40):
            envs.step(np.tile([0, -0.5, 0, 0, 0, 0], (32, 1)))
    ratio = np.median(fine.ground_peak) / np.median(coarse.ground_peak)
    assert 0.8 < ratio < 1.2 and np.median(fine.ground_peak) > GENTLE_FORCE


def test_coarser_physics_does_not_chatter():
    """A stiff servo at its force limit overshoots, back and forth, when commands change."""
    envs, fast = CraneVectorEnv(16, env_threads=1, physics_step=0.01), []

    def watch(envs):
        speed = envs.state().dq
        fast.append(np.abs(speed) > 2 * crane_env.speed_limit(speed))

    envs.observers.append(watch)
    envs.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(15):
        envs.step(rng.uniform(-0.6, 0.6, (16, 6)))
    assert np.mean(fast) < 0.003


def test_sdf_contacts_keep_their_physics_step():
    envs = CraneVectorEnv(1, contact="sdf", physics_step=0.01)
    assert envs.physics_steps == 20 and envs.model.opt.timestep == 0.005


WRONG = [
    ({"diameter": 0.29}, r"diameter must be in \[0.3, 0.8\] m, got"),
    ({"frame_skip": 0}, "frame_skip\n.*greater than or equal to 1"),
    ({"contact": "soft"}, "contact\n.*'primitive' or 'sdf'"),
    ({"signed_yaw": 1}, "signed_yaw\n.*boolean"),
    ({"frame_skp": 5}, "frame_skp\n.*[Uu]nexpected"),
    ({"randomize": 0.5}, "randomize\n.*[Uu]nexpected"),  # an option of hydraulic cranes
]


@pytest.mark.parametrize("options, words", WRONG)
def test_wrong_arguments(options, words):
    with pytest.raises(ValueError, match=words):
        CraneVectorEnv(2, **options).reset(seed=0)


@pytest.mark.parametrize(
    "hook, answer, words",
    [
        ("observe", np.zeros((2, 1)), "observe gives (2, 1), observation_limits (2, 18)"),
        ("reward_terms", {"r_wind": 0.5}, "r_wind must be (2,), not ()"),
        ("reward_terms", {"clearance": np.zeros(2)}, "other names than info's {'clearance'}"),
        ("rules", {"fell": np.array([True])}, "fell must be (2,), not (1,)"),
        ("conditions", {"late": True}, "late must be (2,), not ()"),
    ],
)
def test_a_hook_that_does_not_answer_for_each_crane(hook, answer, words, monkeypatch):
    envs = CraneVectorEnv(2)
    envs.reset(seed=0)
    monkeypatch.setattr(envs, hook, lambda *_: answer)
    with pytest.raises(ValueError, match=re.escape(words)):
        envs.step(np.zeros((2, 6)))


def test_wrong_calls():
    envs = CraneVectorEnv(2)
    with pytest.raises(RuntimeError, match=re.escape("call reset() before step()")):
        envs.step(np.zeros((2, 6)))
    envs.reset(seed=0)
    for actions in (np.zeros((2, 5)), np.zeros(6), np.full((2, 6), np.nan)):
        with pytest.raises(ValueError, match=re.escape("actions must be finite, (2, 6), got")):
            envs.step(actions)
    with pytest.raises(ValueError, match="3 seeds for 2 cranes"):
        envs.reset(seed=[1, 2, 3])
