"""Loading: what lies in the bunk, what is lost, what is gentle, the reward's order."""

import numpy as np
import pytest

import loading_crane
from crane_env import GENTLE_FORCE, CraneState, CraneVectorEnv
from crane_utils.scripted_loading import ScriptedLoadingCrane
from crane_utils.trials import make_envs, monte_carlo_trials, run_trials
from loading_crane import HydraulicLoadingCraneVectorEnv, LoadingCraneVectorEnv

IDLE = np.zeros((1, 6))


def lying(x, y, z, yaw=0.0, tilt=0.0, diameter=0.4):
    """The state of a log whose axis is turned by yaw from the truck's and by tilt from level."""
    axis = [np.cos(tilt) * np.cos(yaw), np.cos(tilt) * np.sin(yaw), np.sin(tilt)]
    none = np.zeros((1, 3))
    return CraneState(
        np.zeros((1, 8)), np.zeros((1, 6)), none, none, np.array([[x, y, z]]), np.array([axis]),
        np.zeros((1, 2), bool), np.array([diameter]), np.zeros(1),
    )  # fmt: skip


def put(envs, x, y, z, diameter=0.4):
    """Cranes far from their logs, which lie along the truck at (x, y) with the centre at z."""
    envs.reset(seed=0)
    q, ids = envs.starts[0][0], np.arange(envs.num_envs)
    q[7] = 0.5
    logs = np.tile([x, y, np.pi / 2], (len(ids), 1))
    envs.place(ids, np.tile(q, (len(ids), 1)), logs, np.full(len(ids), diameter))
    envs.batch.joint("log").qpos[:, 2] = z
    envs.batch.forward(ids, stage=loading_crane.crane_env.VEL)


@pytest.mark.parametrize(
    "pose, inside",
    [
        ((-4.1, 0, 1.4), True),  # on the bed
        ((-4.1, 0, 1.34), False),  # in it
        ((-4.1, 0, 2.89), True),  # its lowest point 1 cm below the stakes' tops
        ((-4.1, 0, 2.91), False),
        ((-4.1, 0.99, 1.4), True),  # its side 1 cm from the stakes' line
        ((-4.1, -1.01, 1.4), False),
        ((-5.12, 0, 1.4), True),  # ends at -6.495 and -3.745
        ((-5.13, 0, 1.4), False),
        ((-2.54, 0, 1.4), True),  # ends at -1.165, before the headboard
        ((-2.52, 0, 1.4), False),
        ((-4.1, 0, 1.4, np.pi), True),
        ((-4.1, 0, 1.7, 0, 0.3), False),  # one end 0.1 m deep in the bed
        ((-4.1, 0, 1.85, 0, 0.3), True),
        ((-4.1, 0.91, 1.4, 0.1), True),  # it leans on a stake, and one end reaches 1.25 m aside
        ((-4.1, 0.93, 1.4, 0.1), False),
    ],
)
def test_in_bunk(pose, inside):
    assert loading_crane.in_bunk(lying(*pose)) == inside


def test_the_bunk_is_that_of_the_model():
    """All of it collides: the model has no geoms that are only seen."""
    geom, bunk = LoadingCraneVectorEnv(1, env_threads=1).model.geom, loading_crane
    assert geom("bed").pos[2] + geom("bed").size[2] == pytest.approx(bunk.BED)
    assert geom("headboard").pos[0] - geom("headboard").size[0] == pytest.approx(bunk.BUNK_X[1])
    middle, half = bunk.PLACE_X, bunk.STAKE_GAP / 2
    for k, x in enumerate([-1.6, middle + half, middle - half, bunk.BUNK_X[0]]):
        for side, y in (("right", -bunk.STAKE_Y), ("left", bunk.STAKE_Y)):
            stake = geom(f"stake_{side}_{k + 1}")
            assert stake.pos == pytest.approx([x, y, bunk.STAKE_TOP - stake.size[1]])


@pytest.mark.parametrize(
    "yaw, speed, turning, q8, failed",  # degrees, m/s, rad/s, rad
    [
        (14.9, 0.03, 0.014, 1.19, []),
        (15.1, 0, 0, 0, ["not_along"]),
        (0, 0.051, 0, 0, ["moving"]),
        (0, 0.03, 0.016, 0, ["moving"]),  # its ends move by 0.022 m/s more
        (0, 0, 0, 1.21, ["not_released"]),
    ],
)
def test_conditions(yaw, speed, turning, q8, failed):
    envs = LoadingCraneVectorEnv(1, env_threads=1)
    put(envs, -4.1, 0, 1.4)
    state = lying(-4.1, 0, 1.4, np.radians(yaw))
    state.q[:, 7], envs.qvel[:, 10], envs.qvel[:, 14] = q8, speed, turning
    assert [name for name, ok in envs.conditions(state, {}).items() if not ok] == failed


# 1.1 rad round the slew axis to go, 2.5 m too far out, half as high as it must be, 45 degrees askew
ON_THE_WAY = (-6.6 * np.cos(1.1), -6.6 * np.sin(1.1), 1.625, np.pi / 4)


@pytest.mark.parametrize(
    "pose, held, expected",
    [
        (ON_THE_WAY, True, dict(height=1, swing=0.75 / np.e, along=0.25 / np.e)),
        (ON_THE_WAY, False, {}),
        ((5.0, -3, 6), True, dict(height=1)),  # too high, over the ground in front
        ((-4.1, 0, 0.6), True, dict(lift=2 * 0.4**0.5, height=0.8 / 2.85, swing=1.2 / 2.85,
                                    along=0.8 / 2.85)),  # under the bed
        ((-4.1, 0, 2.6), True, dict(height=2, swing=3, along=2, middle=1.5, lower=2)),
        ((-4.1, 0, 1.4, np.pi / 4), True, dict(height=2, swing=3, along=1, middle=1.5, lower=2)),
        ((-4.1, 0, 1.4, np.pi / 8), True, dict(height=2, swing=3, along=2, middle=1.5, lower=4,
                                               let_go=6, release=4.5)),
        ((-4.1, 0.6, 1.4), False, dict(height=2, swing=3, along=2, middle=1.5 / np.e, lower=4,
                                       let_go=12, release=9)),  # it rolled out of the jaws
    ],
)  # fmt: skip
def test_reward(pose, held, expected):
    """By docs/environment.md. The jaws are open, and the hardest hit was twice a gentle one."""
    envs = LoadingCraneVectorEnv(1, env_threads=1, autoreset=False)
    put(envs, 0.0, -6.0, 0.2)
    envs.ground_peak[:] = 2 * GENTLE_FORCE
    state = lying(*pose)._replace(touching=np.array([[True, held]]))
    state = state._replace(grapple_centre=state.log_centre)
    state.q[:, 7] = 0.5
    info = envs.measure(state) | {"termination": np.array(["none"])}
    terms = envs.reward_terms(state, info)
    names = "lift height swing along middle lower let_go release loaded balance".split()
    ours = {name: terms[f"r_{name}"][0] for name in names if terms.get(f"r_{name}", 0)}
    assert ours == pytest.approx({"lift": 2} | expected)


def test_the_place_is_observed_along_the_cranes_axes():
    """A log 1 m short of its place, 0.5 m aside, 0.3 m too high, turned, tilted; q1 = -pi/2."""
    envs = LoadingCraneVectorEnv(1, env_threads=1)
    state = lying(-3.1, 0.5, 1.7, yaw=-0.2, tilt=0.3)
    state.q[:, 0] = -np.pi / 2  # ahead is -y, left is +x
    assert envs.observe(state)[0, 18:] == pytest.approx([0.5, -1, -0.3, 0.2, 0.3], abs=1e-9)
    limits = HydraulicLoadingCraneVectorEnv(1, env_threads=1).observation_limits()
    assert limits.shape == (2, 37) and limits[1, 21] == np.pi / 2 and limits[1, 36] == 1


@pytest.mark.parametrize("height, gentle", [(0.02, True), (0.1, False)])
def test_a_released_log_is_loaded_and_gentle_if_it_did_not_fall(height, gentle):
    """A log that falls by h meets the bed at sqrt(2 g h): 0.63 and 1.4 m/s."""
    envs = LoadingCraneVectorEnv(1, env_threads=1, autoreset=False)
    put(envs, -4.1, 0, 1.4 + height)
    for _ in range(20):
        _, _, terminated, _, info = envs.step(IDLE)
        if terminated:
            break
    assert info["termination"] == "loaded" and info["success"] and info["gentle"] == gentle
    assert envs.bed_speed == pytest.approx(np.sqrt(2 * 9.81 * height), rel=0.1)
    bonus = loading_crane.GENTLE_BONUS / max(1, envs.bed_speed[0])  # 1 m/s is gentle
    assert info["r_loaded"] == pytest.approx(loading_crane.LOADED_PAY * (1 + bonus))
    assert 0.5 < info["time"] < 1.5


def test_a_load_pays_like_60_s_of_the_best_step():
    stages = "HEIGHT SWING MIDDLE ALONG LOWER LET_GO RELEASE OFF".split()
    names = ["LIFTED_PAY", *(f"{stage}_WEIGHT" for stage in stages)]
    best = sum(getattr(loading_crane, name) for name in names)
    assert loading_crane.LOADED_PAY == pytest.approx(60 * best)


def test_a_fall_is_not_remembered_in_the_next_episode():
    envs = LoadingCraneVectorEnv(1, env_threads=1, autoreset=False)
    put(envs, -4.1, 0, 1.5)
    for _ in range(3):
        envs.step(IDLE)
    assert envs.bed_speed > 1
    put(envs, -4.1, 0, 1.4)
    assert envs.step(IDLE)[-1]["ground_peak"] < GENTLE_FORCE


def test_a_hit_is_seen_in_every_physics_step():
    envs = LoadingCraneVectorEnv(20, env_threads=1, autoreset=False)
    heights = 0.08 + 0.0063 * np.arange(20)  # m; each log falls a physics step longer
    put(envs, -4.1, 0, 1.4 + heights)
    for _ in range(4):
        envs.step(np.tile(IDLE, (20, 1)))
    assert envs.bed_speed == pytest.approx(np.sqrt(2 * 9.81 * heights), rel=0.1)


def test_low_in_the_bunk_squeezing_less_pays():
    envs, pay = LoadingCraneVectorEnv(1, env_threads=1, autoreset=False), []
    for squeeze, command in [(1.0, 0.9), (0.0, 0.0)]:
        put(envs, -4.1, 0, 1.4)
        envs.qpos[:, 8:10] = 2.0  # rad, half open
        lead = envs.force_limit[1, :, 6:] / envs.servo_kp[:, 6:]  # rad, at full force
        envs.act[:, 6:] = envs.qpos[:, 8:10] + squeeze * lead
        envs.command[:, 5] = command  # rad/s, half of the jaws' speed limit
        info = envs.measure(state := envs.state()) | {"termination": np.array(["none"])}
        pay.append(envs.reward_terms(state, info)["r_let_go"][0])
    shares = [(1 - 1 / 2) / 4, (2 - 0) / 4]
    assert pay == pytest.approx(np.multiply(loading_crane.LET_GO_WEIGHT, shares))


def test_force_on_the_truck_counts():
    """Jaws that are driven onto the bed."""
    envs = LoadingCraneVectorEnv(1, env_threads=1, autoreset=False)
    put(envs, 8, 8, 0.2)
    q = np.array([[-np.pi, 0.66, -0.08, 0, np.pi / 2 - 0.58, np.pi / 2, np.pi / 2, np.pi / 2]])
    envs.place(np.arange(1), q, np.array([[8.0, 8.0, 0]]), np.array([0.4]))
    assert 1.5 < envs.state().grapple_centre[0, 2] < 2.5
    for _ in range(15):
        info = envs.step(np.array([[0, -1.0, 0, 0, 0, 0]]))[-1]
    assert info["ground_peak"] > GENTLE_FORCE


@pytest.mark.parametrize("beyond, ends", [(0.029, False), (0.031, True)])
def test_a_stop_that_gives_under_the_log_ends_nothing(beyond, ends):
    """A telescope inside its stop, where a log in the jaws may push it, m."""
    envs = LoadingCraneVectorEnv(1, env_threads=1)
    envs.reset(seed=0)
    state = envs.state()
    state.q[0, 3] = -beyond
    info = envs.measure(state) | dict.fromkeys(("time", "diverged", "safe"), np.zeros(1))
    assert envs.rules(state, info)["joint_limit_q4"] == ends


def test_the_bed_bears_a_log_that_lies_on_it():
    envs = LoadingCraneVectorEnv(1, env_threads=1, autoreset=False)
    put(envs, -4.1, 0, 1.4)
    for _ in range(8):
        envs.step(IDLE)
    assert envs.state().carried == pytest.approx(0, abs=0.02)


def test_a_crane_that_stands_on_the_log_has_not_let_go():
    envs = LoadingCraneVectorEnv(1, env_threads=1, autoreset=False)
    put(envs, -4.1, 0, 1.6, 0.8)
    q = np.array([[-np.pi, 0.8, 0.0, 0, np.pi / 2 - 0.8, np.pi / 2, np.pi / 2, 0.5]])
    envs.place(np.arange(1), q, np.array([[-4.1, 0, np.pi / 2]]), np.array([0.8]))
    envs.batch.joint("log").qpos[0, 2] = 1.6
    touched = []
    for step in range(24):
        lower = -1.0 if step < 8 else 0.0
        info = envs.step(np.array([[0, lower, 0, 0, 0, 0]]))[-1]
        touched.append(envs.on_log[0] > 0 and not envs.state().touching.any())
        assert info["termination"] == "none"
    assert all(touched[-8:]) and envs.state().q[0, 7] < 1.2


def test_log_lost():
    """A lifted log on the ground is lost, one that was never lifted is not, nor one in the bunk."""
    envs = LoadingCraneVectorEnv(1, env_threads=1, autoreset=False)
    for lifted, place, ending in [
        (True, (0.0, -6.0, 0.2), "log_lost"),
        (False, (0.0, -6.0, 0.2), "none"),
        (True, (-4.1, 0.0, 1.4), "none"),
    ]:
        put(envs, *place)
        envs.lifted[:] = lifted
        assert envs.step(IDLE)[-1]["termination"] == ending
    put(envs, 0.0, -6.0, 2.5)  # in the air, but no jaw touches it
    envs.lifted[:] = True
    endings = [envs.step(IDLE)[-1]["termination"][0] for _ in range(6)]
    assert endings[:5] == ["none"] * 5 and endings[5] == "log_lost"
    put(envs, 2.15, 0.0, 3.2)  # on the cab
    envs.lifted[:] = True
    assert [envs.step(IDLE)[-1]["termination"][0] for _ in range(6)][5] == "log_lost"
    put(envs, 0.0, -6.0, 2.5)
    envs.lifted[:] = False
    envs.step(IDLE)
    assert not envs.lifted  # no jaw holds it up


@pytest.mark.parametrize("difficulty", [0.3, 1.0])
def test_full_starts_are_those_of_the_lifting_task(difficulty):
    """They are full from difficulty 0.3 on. Of four cranes none starts on the way there."""
    ours = LoadingCraneVectorEnv(4, env_threads=1, difficulty=difficulty)
    theirs = CraneVectorEnv(4, env_threads=1)
    np.testing.assert_array_equal(ours.reset(seed=5)[0][:, :18], theirs.reset(seed=5)[0])


@pytest.mark.parametrize("cranes", [LoadingCraneVectorEnv, HydraulicLoadingCraneVectorEnv])
def test_easy_starts_of_the_first_cranes_hold_the_log(cranes):
    """15 % of the cranes at difficulty 0, fewer at 0.5, none at 1. Nothing slips or is repeated."""
    diameter = np.resize(np.linspace(0.3, 0.8, 4), 54)
    envs = cranes(54, env_threads=1, retry=1.0, diameter=diameter)
    for difficulty, held in [(1.0, 0), (0.5, 4), (0.0, 8)]:
        envs.difficulty = difficulty
        envs.reset(seed=7)
        high = envs.state().log_centre[:, 2] > 2.5
        np.testing.assert_array_equal(high, np.arange(54) < held)
    for step in range(65):  # longer than a log may take to be reached
        ends = envs.step(np.zeros((54, 6)))[-1]["termination"]
        assert (ends[:8] == "none").all(), ends
        assert step or (np.linalg.norm(envs.qvel[:8, 10:13], axis=-1) < 1).all()
    state = envs.state()
    assert state.touching[:8].all() and (state.log_centre[:8, 2] > 2.0).all()


def test_half_of_the_held_logs_start_near_the_bunk():
    """Half have less than an eighth of the way to go, by the slew's angle."""
    envs, shares = LoadingCraneVectorEnv(8, env_threads=1, difficulty=0.0), []
    envs.reset(seed=7)
    for _ in range(1000):
        q, *_ = envs.draw_episode(0)
        shares.append((q[0] + np.pi) / (envs.starts[0][0][0] + np.pi))  # of the lift's start
    assert max(shares) < 1 and np.mean(np.less(shares, 1 / 8)) == pytest.approx(0.5, abs=0.05)


def test_a_held_log_that_is_dropped_is_lost_and_its_start_is_not_repeated():
    envs = LoadingCraneVectorEnv(4, env_threads=1, retry=1.0, difficulty=0.0)
    envs.reset(seed=7)
    endings = []
    for _ in range(20):  # opening jaws
        endings += [envs.step(np.tile([0, 0, 0, 0, 0, -1.0], (4, 1)))[-1]["termination"][0]]
    assert "log_lost" in endings and not envs.failures[0]


def test_a_lifted_log_has_been_reached():
    """Both logs lie away from the grapple. The second was lifted, wherever the jaws held it."""
    envs = LoadingCraneVectorEnv(2, env_threads=1, autoreset=False)
    envs.reset(seed=0)
    envs.lifted[:] = [False, True]
    info = envs.step(np.zeros((2, 6)))[-1]
    assert (info["d_combine"] > 0.35).all() and [*info["time_to_reach"]] == [np.inf, 0.1]


def test_a_log_must_be_lifted_within_12_s():
    """Crane 0 has reached its log and not lifted it; crane 1 had lifted the log that lies there."""
    envs = LoadingCraneVectorEnv(2, env_threads=1, autoreset=False)
    put(envs, 0.0, -6.0, 0.2)
    envs.reach_time[:] = 0.0
    envs.steps[:] = 119
    envs.lifted[:] = [False, True]
    assert list(envs.step(np.zeros((2, 6)))[-1]["termination"]) == ["none", "log_lost"]
    assert envs.step(np.zeros((2, 6)))[-1]["termination"][0] == "not_lifted"


def test_the_scripted_crane_loads_and_later_stages_pay_more():
    diameters, seeds = monte_carlo_trials(10_000, 1)
    envs = make_envs("ForestryCraneLoading-v0", 6, 1, diameter=diameters)
    results = run_trials(ScriptedLoadingCrane(), envs, seeds)
    assert results["success"].all() and (results["termination"] == "loaded").all(), results
    one = make_envs("ForestryCraneLoading-v0", 1, 1, diameter=diameters[:1])
    obs, _ = one.reset(seed=seeds[:1])
    policy, memory, pay = ScriptedLoadingCrane(), None, {}
    for _ in range(250):
        actions, memory = policy.predict(obs, memory)
        obs, reward, terminated, _, info = one.step(actions)
        if terminated[0]:
            break
        pay.setdefault(memory.phase[0], []).append((reward - info["r_ground"])[0])
    stages = [np.mean(pay[phase]) for phase in sorted(pay)]
    assert len(stages) >= 7 and (np.diff(stages) > 0).all(), stages
    assert reward[0] > 50 * max(map(max, pay.values()))  # 1 / (1 - gamma) at the end of a training
