"""Pose, noise, rewards, rules and success against values worked out by hand."""

import numpy as np
import pytest

import crane_task
import machine
from crane_env import CraneVectorEnv
from crane_task import CraneState

JOINT_RANGE = CraneVectorEnv(1).joint_range
REAL = machine.SPEEDS["real"]


def state(**changes):
    """One hanging crane and a 0.4 m log on the ground along y, 3 m ahead and 4 m to the left."""
    values = {
        "q": np.array([0.0, 0.5, 0.2, 0.5, 0.87, np.pi / 2, 0.0, 1.5]),
        "dq": np.zeros(6),
        "grapple_centre": np.array([1.0, 2.0, 1.5]),
        "grapple_axis": np.array([0.6, 0.8, 0.0]),
        "log_centre": np.array([4.0, 6.0, 0.2]),
        "log_axis": np.array([0.0, 1.0, 0.0]),
        "touching": np.array([True, True]),
        "diameter": np.array(0.4),
    }
    values.update({k: np.asarray(v) for k, v in changes.items()})
    return CraneState(**{k: v[None] for k, v in values.items()})


def test_relative_pose():
    # offset (0.8 - 0.4) / 2 = 0.2: target heights 0.2 + 0.2 = 0.4 and 0.2 - 0.2 = 0
    delta_p, delta_psi, _ = crane_task.relative_pose(state())
    np.testing.assert_allclose(delta_p, [[3.0, 4.0, -1.1]])
    np.testing.assert_allclose(delta_psi, [0.2])  # 1 - |0.6 * 0 + 0.8 * 1|
    delta_p, _, _ = crane_task.relative_pose(state(), offset="minus")
    np.testing.assert_allclose(delta_p, [[3.0, 4.0, -1.5]])


def test_angle_is_that_of_a_line_not_of_an_arrow():
    for axis in ([0.0, 1.0, 0.0], [0.0, -1.0, 0.0]):
        _, delta_psi, signed = crane_task.relative_pose(state(log_axis=axis))
        np.testing.assert_allclose(delta_psi, [0.2])
        # the grapple points atan2(0.8, 0.6) = 53.13 degrees, the log 90: 36.87 degrees to the left
        np.testing.assert_allclose(signed, [np.radians(36.8698976)])
    right = np.array([np.cos(0.1), np.sin(0.1), 0.0])
    _, _, signed = crane_task.relative_pose(state(log_axis=right))
    np.testing.assert_allclose(signed, [0.1 - np.arctan2(0.8, 0.6)])


def test_signed_angle_turns_the_grapple_onto_the_log_within_the_rotators_range():
    envs = CraneVectorEnv(300)
    envs.reset(seed=0)
    before = envs.state()
    _, _, signed = crane_task.relative_pose(before)
    assert signed.max() > np.pi / 2 and signed.min() < -np.pi / 2  # the longer turn, both ways
    q, ids = before.q.copy(), np.arange(300)
    q[:, 4], q[:, 5] = np.pi / 2 - q[:, 1] - q[:, 2], np.pi / 2  # plumb
    x, y = before.log_centre[:, :2].T
    log_yaw = np.arctan2(before.log_axis[:, 1], before.log_axis[:, 0]) - np.pi / 2
    log = np.stack([x, y, log_yaw], axis=-1)
    envs.place(ids, q, log, before.diameter)
    _, _, signed = crane_task.relative_pose(envs.state())
    turn = np.arctan2(y, x) - q[:, 0]  # until the crane faces the log
    q[:, 0] += turn
    q[:, 6] += turn - signed  # the grapple's yaw is that of q1 - q7
    envs.place(ids, q, log, before.diameter)
    _, delta_psi, left = crane_task.relative_pose(envs.state())
    np.testing.assert_allclose(delta_psi, 0, atol=1e-6)
    np.testing.assert_allclose(left, 0, atol=1e-3)
    assert np.abs(q[:, 6]).max() < 2.81


def test_yaw_of_a_tilted_log_is_that_of_its_shadow():
    tilted = np.array([0.0, 0.8, 0.6])
    _, delta_psi, _ = crane_task.relative_pose(state(log_axis=tilted))
    np.testing.assert_allclose(delta_psi, [0.2])


def test_noise():
    # s = (|(0, 4.8, 6.4)| / 8)^2 = 1; and s = 0.25 at half the distance
    noisy_p, noisy_psi = crane_task.noisy_pose(
        np.array([[0.0, 4.8, 6.4], [0.0, 2.4, 3.2]]),
        np.array([0.5, 0.5]),
        np.array([[0.1, -0.1], [0.1, -0.1]]),
    )
    np.testing.assert_allclose(noisy_p, [[0.0, 5.28, 7.04], [0.0, 2.46, 3.28]])
    np.testing.assert_allclose(noisy_psi, [0.45, 0.4875])


def test_clearance_and_miss():
    np.testing.assert_allclose(crane_task.log_clearance(state()), [0.0])
    lifted = state(log_centre=[4.0, 6.0, 1.5], log_axis=[0.0, 0.8, 0.6])
    # 1.5 - 1.375 * 0.6 - 0.2 * 0.8
    np.testing.assert_allclose(crane_task.log_clearance(lifted), [0.515])
    upright = state(log_centre=[4.0, 6.0, 2.0], log_axis=[0.0, 0.0, -1.0])
    np.testing.assert_allclose(crane_task.log_clearance(upright), [0.625])
    gripped = state(grapple_centre=[4.3, 6.4, 0.2], log_axis=[0.6, 0.8, 0.0])
    np.testing.assert_allclose(crane_task.centre_miss(gripped), [0.5])


COMMAND = np.array([[0.3, 0.0, 0.4, 0.0, 0.0, 1.2]])  # norm 0.5 without the jaws, 1.3 with them


def terms_of(crane, d_combine, command, ground=None, **kwargs):
    """The terms of the reward of one crane, without r_ground if no force is given."""
    given = [np.array([d_combine]), crane_task.log_clearance(crane), crane_task.centre_miss(crane)]
    given += [command, np.zeros(1) if ground is None else ground]
    terms = crane_task.reward_terms(crane, *given, **kwargs)[:, 0]
    assert ground is not None or terms[4] == 0
    return terms[:4] if ground is None else terms


def test_staged_reward():
    lifted = {"log_centre": [4.0, 6.0, 0.45], "grapple_centre": [4.3, 6.125, 0.8]}
    terms = terms_of(state(**lifted), 0.4, COMMAND)
    r, grasp = np.exp(-0.4), 2 * 0.5 * np.exp(-0.15)  # q8 / 3 = 0.5; 0.05 m farther than 0.35 m
    # 0.125 m off the centre, half of 0.25 m and a quarter of 0.5 m; clearance 0.45 - 0.2 = 0.5^2
    centred, calm = np.exp(-0.25), 1 - np.tanh(0.5)
    lift = 0.5 * centred
    np.testing.assert_allclose(terms, [r, grasp * np.exp(-0.0625), 2 * lift, 3 * calm * lift])
    farther = terms_of(state(**lifted), 0.9, COMMAND)
    assert np.all(farther[:2] < terms[:2])
    np.testing.assert_array_equal(farther[2:], terms[2:])  # a lift is worth as much anywhere
    for height in (0.2, 0.15):  # on the ground, and pressed into it
        down = state(log_centre=[4.0, 6.0, height], grapple_centre=[4.0, 6.0, 0.4])
        terms = terms_of(down, 0.4, COMMAND)
        np.testing.assert_allclose(terms[2:], 0, atol=2e-4)
    lifted["grapple_centre"] = [4.0, 7.0, 0.45]  # 1 m off
    terms = terms_of(state(**lifted), 0.4, COMMAND)
    np.testing.assert_allclose(terms, [r, grasp * np.exp(-4), 0.0, 0.0], atol=1e-6)
    one_jaw = state(log_centre=[4.0, 6.0, 0.45], grapple_centre=[4, 6, 1], touching=[True, False])
    terms = terms_of(one_jaw, 0.4, COMMAND)
    np.testing.assert_allclose(terms, [r, grasp, 2 * 0.5, 0.0])
    for clearance, expected in [(1.0, 2.0), (2.25, 2 / 1.5), (4.0, 1.0)]:  # 1 m is best
        high = state(log_centre=[4, 6, 0.2 + clearance], grapple_centre=[4.0, 6.0, 3.2])
        terms = terms_of(high, 0.34, COMMAND)
        np.testing.assert_allclose(terms[2], expected)
    np.testing.assert_allclose(terms[1], 1.0)  # nearer than 0.35 m is no better for r_grapple


@pytest.mark.parametrize(
    "actuators, touching, q8, share",
    [("ideal", True, 1.8, 0.6), ("ideal", False, 2.4, 0.8), ("hydraulic", True, 1.8, 1.0)]
    + [("hydraulic", False, 0.6, 0.2), ("hydraulic", False, 2.4, 0.5)],
)
def test_with_drives_closed_jaws_pay_less_than_a_grip(actuators, touching, q8, share):
    crane = state(log_centre=[4.0, 6.0, 0.45], grapple_centre=[4, 6, 1], touching=[touching, True])
    crane.q[0, 7] = q8
    terms = terms_of(crane, 0.3, COMMAND, actuators=actuators)
    assert terms[1] == pytest.approx(2 * share)


def test_grip_depth():
    """A log of 0.2 m radius, jaws straight down: tips 0.8566 - 0.5 = 0.3566 m below p_C."""
    for height, depth in [(0.5566, 0.0), (0.4566, 0.5), (0.3566, 1.0), (0.6566, -0.5)]:
        crane = state(log_centre=[4.0, 6.0, 0.2], grapple_centre=[4.0, 6.0, height])
        crane.q[0, 7] = np.pi / 2
        np.testing.assert_allclose(crane_task.grip_depth(crane), [depth], atol=1e-12)
    crane.q[0, 7] = np.pi - 0.5  # turned in, the tips are higher than at pi/2
    tips = 0.6566 + 0.5 - 0.8566 * np.sin(0.5)
    np.testing.assert_allclose(crane_task.grip_depth(crane), [(0.2 - tips) / 0.2])


@pytest.mark.parametrize(
    "actuators, height, share",
    [("hydraulic", 0.5566, 0.5), ("hydraulic", 0.3566, 1.0), ("hydraulic", 0.7566, 0.0)]
    + [("ideal", 0.7566, 1.0)],
)
def test_with_drives_a_lift_pays_for_tips_below_the_logs_centre(actuators, height, share):
    """Tips half a radius above the centre earn nothing, half a radius below it they earn all.

    Carrying the log pays at every depth: it leads to the first lift.
    """
    lifted = state(log_centre=[4.0, 6.0, 0.45], grapple_centre=[4.0, 6.0, 0.25 + height])
    lifted.q[0, 7] = np.pi / 2
    still = np.zeros((1, 6))
    terms = terms_of(lifted._replace(carried=np.ones(1)), 0.3, still, actuators=actuators)
    np.testing.assert_allclose(terms[2:], [share * 2 * 0.5 + 1, share * 3 * 0.5], atol=1e-9)


def test_carrying_the_log_pays_before_it_rises():
    """With both jaws, near the centre: leads to the first lift of a heavy log."""
    down = state(log_centre=[4.0, 6.0, 0.2], grapple_centre=[4.0, 6.0, 0.4], touching=[True, True])
    for share in (0.0, 0.5, 1.0):
        lift = terms_of(down._replace(carried=np.array([share])), 0.4, COMMAND)[2]
        assert lift == pytest.approx(share, abs=1e-3)
    one_jaw = down._replace(carried=np.ones(1), touching=np.array([[True, False]]))
    assert terms_of(one_jaw, 0.4, COMMAND)[2] == pytest.approx(0, abs=1e-3)
    off = down._replace(carried=np.ones(1), grapple_centre=np.array([[4.0, 6.25, 0.4]]))
    assert terms_of(off, 0.4, COMMAND)[2] == pytest.approx(np.exp(-1), abs=1e-3)


def test_hitting_the_ground_costs():
    """From 10 to 20 kN, with hydraulic drives to 40; less in an easy task, nothing on paper."""
    here = state(log_centre=[4.0, 6.0, 0.45], grapple_centre=[4, 6, 1])
    for kN, ideal, hydraulic in [
        (0, 0, 0), (10, 0, 0), (15, -15, -45), (20, -30, -90), (40, -30, -270), (50, -30, -270)
    ]:  # fmt: skip
        force = np.array([1e3 * kN])
        for actuators, expected in [("ideal", ideal), ("hydraulic", hydraulic)]:
            given = {"ground": force, "actuators": actuators}
            terms = terms_of(here, 0.4, COMMAND, **given)
            assert terms[4] == pytest.approx(expected)
            easy = terms_of(here, 0.4, COMMAND, **given, difficulty=0.5)
            assert easy[4] == pytest.approx(expected / 16)
            without = terms_of(here, 0.4, COMMAND, actuators=actuators)
            np.testing.assert_array_equal(terms[:4], without)
        assert terms_of(here, 0.4, COMMAND, ground=force, kind="paper")[4] == 0


def test_paper_reward():
    terms = terms_of(state(log_centre=[4.0, 6.0, 0.7]), 0.25, COMMAND, kind="paper")
    r = np.exp(-0.25)
    grapple = 0.5 * r + 0.5 * (1 - r)
    lift = (1 - np.tanh(0.3)) * (1 - grapple)
    balance = (1 - np.tanh(1.3)) * (1 - lift)
    np.testing.assert_allclose(terms, [r, grapple, lift, balance])


def test_printed_reward_pays_for_standing_still():
    """Why "staged" is the default: open jaws at rest earn the same at any distance."""
    still, open_jaws = np.zeros((1, 6)), np.array([0, 0.5, 0.2, 0.5, 0.87, np.pi / 2, 0, 0.0])
    for d in (0.1, 5.0):
        terms = terms_of(state(q=open_jaws), d, still, kind="paper")
        np.testing.assert_allclose(terms[0] + terms[1], 1.0)
        assert terms[3] > 0.6


def rule(time=1.0, reached=True, diverged=False, **changes):
    name = crane_task.termination_rule(
        state(**changes),
        np.array([time]),
        np.array([reached]),
        np.array([diverged]),
        JOINT_RANGE,
        REAL,
    )
    return str(name[0])


@pytest.mark.parametrize(
    "expected, situation",
    [
        ("none", {}),
        ("none", {"time": 5.99, "reached": False}),
        ("not_reached", {"time": 6.0, "reached": False}),
        ("none", {"time": 8.95}),
        ("time_limit", {"time": 9.0}),
        ("none", {"grapple_centre": [4.0, 6.0, 8.1]}),
        ("log_too_far", {"grapple_centre": [4.0, 6.0, 8.3]}),
        ("none", {"dq": [0, 0.47, 0, 0, 0, 0]}),
        ("overspeed", {"dq": [0, 0.49, 0, 0, 0, 0]}),  # twice 0.239
        ("none", {"dq": [0, -0.64, 0, 0, 0, 0]}),
        ("overspeed", {"dq": [0, -0.66, 0, 0, 0, 0]}),  # twice 0.326
        ("diverged", {"diverged": True, "time": 9.0}),
    ],
)
def test_termination_rule(expected, situation):
    assert rule(**situation) == expected


@pytest.mark.parametrize("joint", range(8))
@pytest.mark.parametrize("end", [0, 1])
def test_joint_limits_end_the_episode_but_not_those_of_the_jaws(joint, end):
    """0.02 rad or m beyond, as far as a soft stop may give (test_physics.py)."""
    q, beyond = state().q[0].copy(), (-1, 1)[end]
    q[joint] = JOINT_RANGE[joint, end] + 0.021 * beyond
    assert rule(q=q) == ("none" if joint == 7 else "joint_limit")
    q[joint] = JOINT_RANGE[joint, end] + 0.019 * beyond
    assert rule(q=q) == "none"


def grip(clearance=0.2, touching=(True, True), miss=0.1):
    values = np.array([clearance]), np.array([touching]), np.array([miss])
    return crane_task.grip_conditions(*values)[:, 0].tolist()


def test_grip_conditions():
    assert grip() == grip(clearance=0.1) == grip(miss=0.3) == [True, True, True]
    assert grip(clearance=0.099) == [False, True, True]
    assert grip(touching=(True, False)) == grip(touching=(False, True)) == [True, False, True]
    assert grip(miss=0.301) == [True, True, False]
    assert grip(clearance=np.nan, miss=np.nan) == [False, True, False]


@pytest.mark.parametrize(
    "failed",
    [
        set(),
        {"not_reached"},
        {"not_lifted"},
        {"not_held"},
        {"off_centre"},
        {"not_lifted", "not_held"},
        {"not_reached", "not_lifted", "not_held", "off_centre"},
    ],
)
def test_success_needs_every_condition(failed, monkeypatch):
    """An idle crane of which we claim all but the failed conditions, from start to end."""
    grip = [name not in failed for name in ("not_lifted", "not_held", "off_centre")]
    monkeypatch.setattr(crane_task, "grip_conditions", lambda *_: np.array(grip)[:, None])
    envs, ended = CraneVectorEnv(1), False
    envs.reset(seed=0)
    while not ended:
        if "not_reached" not in failed:
            envs.reach_time[:] = 5.9
        _, _, terminated, truncated, info = envs.advance(np.zeros((1, 6)))
        ended = terminated[0] or truncated[0]
        assert ended or not info["success"][0]
    assert {name for name in crane_task.CONDITIONS if info[name][0]} == failed
    assert info["success"][0] == (not failed)
    late = "not_reached" in failed
    assert info["termination"][0] == ("not_reached" if late else "time_limit")
    assert info["time_to_reach"][0] == (np.inf if late else 5.9)


def test_the_log_is_reached_by_6_s_or_never(monkeypatch):
    ends = []
    for first in (58, 59, 60):  # decisions 59, 60 and 61: at 5.9, 6.0 and 6.1 s
        envs = CraneVectorEnv(1)
        envs.reset(seed=0)
        with monkeypatch.context() as patch:
            for k in range(61):
                if k == first:
                    patch.setattr(crane_task, "REACH_DISTANCE", 100.0)
                _, _, terminated, _, info = envs.advance(np.zeros((1, 6)))
                if k == 59:
                    ends.append((info["termination"][0], terminated[0]))
        assert info["time_to_reach"][0] == pytest.approx({58: 5.9, 59: 6.0, 60: np.inf}[first])
    assert ends == [("none", False), ("none", False), ("not_reached", True)]


@pytest.mark.parametrize(
    "frame_skip, window, decisions",
    [(1, 101, 1800), (4, 26, 450), (7, 15, 258), (10, 11, 180), (20, 6, 90)],
)
def test_length_of_an_episode_and_of_its_end(frame_skip, window, decisions):
    envs = CraneVectorEnv(1, frame_skip=frame_skip)
    assert envs.hold_decisions == window and envs.max_decisions == decisions


@pytest.mark.parametrize(
    "frame_skip", [20, *(pytest.param(n, marks=pytest.mark.slow) for n in (10, 7))]
)
def test_success_needs_all_of_the_last_half_second(frame_skip, monkeypatch):
    """One decision without a grip spoils success where it lies in the window, and only there."""
    envs = CraneVectorEnv(1, frame_skip=frame_skip)
    window, last = envs.hold_decisions, envs.max_decisions - 1
    slips = np.array([0, last - window - 1, *range(last - window, last + 1)])
    envs = CraneVectorEnv(len(slips), frame_skip=frame_skip)
    kept = np.ones((3, len(slips)), bool)
    monkeypatch.setattr(crane_task, "grip_conditions", lambda *_: kept)
    for which, name in enumerate(["not_lifted", "not_held", "off_centre"]):
        envs.reset(seed=0)
        for k in range(last + 1):
            kept[:], kept[which] = True, slips != k
            envs.reach_time[:] = 1.0  # stand still but claim to have reached the log
            *_, truncated, info = envs.advance(np.zeros((len(slips), 6)))
            assert (truncated == (k == last)).all()
        np.testing.assert_array_equal(info["success"], slips <= last - window)
        for other in ("not_lifted", "not_held", "off_centre"):
            assert (info[other] == (~info["success"] & (other == name))).all()


def test_success_needs_the_whole_episode(monkeypatch):
    """Success comes with the time limit only, and a grip before a start does not count."""
    envs = CraneVectorEnv(1)
    envs.reset(seed=0)
    for k in range(90):
        envs.reach_time[:] = 1.0
        _, _, terminated, truncated, info = envs.advance(np.zeros((1, 6)))
        assert not terminated[0] and truncated[0] == (k == 89) and not info["success"][0]
    assert info["termination"][0] == "time_limit" and info["not_lifted"][0] and info["not_held"][0]

    monkeypatch.setattr(crane_task, "grip_conditions", lambda *_: np.ones((3, 2), bool))
    envs, lifted = CraneVectorEnv(2), []
    envs.reset(seed=0)
    for k in range(14):
        if k == 7:
            envs.start_episodes(np.array([1]))
        lifted.append(~envs.advance(np.zeros((2, 6)))[-1]["not_lifted"])
    first, second = np.array(lifted).T.tolist()
    assert first == [False] * 5 + [True] * 9
    assert second == ([False] * 5 + [True] * 2) * 2


@pytest.mark.parametrize("reward", ["staged", "paper"])
def test_reward_is_the_sum_of_the_reported_terms(reward):
    envs = CraneVectorEnv(4, reward=reward)
    envs.reset(seed=0)
    _, total, _, _, info = envs.advance(np.full((4, 6), 0.5))
    terms = [info[term] for term in crane_task.TERMS]
    np.testing.assert_allclose(total, np.sum(terms, axis=0))
    now = envs.state()
    delta_p, delta_psi, _ = crane_task.relative_pose(now)
    delta_p[:, 2] += 0.1 if reward == "staged" else 0.0  # the reward wants the grapple higher
    distance = np.linalg.norm(delta_p, axis=-1) + delta_psi
    measured = distance, crane_task.log_clearance(now), crane_task.centre_miss(now)
    command = np.tile(0.5 * REAL[1], (4, 1))
    np.testing.assert_allclose(
        terms, crane_task.reward_terms(now, *measured, command, np.zeros(4), 1.0, reward)
    )


def test_time_to_reach_is_the_first_time():
    envs = CraneVectorEnv(1, difficulty=0.0)
    envs.reset(seed=0)
    q = envs.state().q.copy()
    for q4 in np.linspace(q[0, 3], 2.2, 400):  # hang the grapple into its target
        out, up = crane_task.tip_position(q[0, 1], q[0, 2], q4)
        if up < 0.55 + 0.1 + 0.791:
            break
    q[0, 3] = q4
    log = np.array([[out * np.cos(q[0, 0]), out * np.sin(q[0, 0]), q[0, 0] - q[0, 6]]])
    envs.place(np.array([0]), q, log, np.array([0.55]))
    assert np.isinf(envs.reach_time[0])
    for _ in range(3):
        *_, info = envs.advance(np.zeros((1, 6)))
        assert info["d_combine"][0] < 0.35
        assert info["time_to_reach"][0] == pytest.approx(0.1)
