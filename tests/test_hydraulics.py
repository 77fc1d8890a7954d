"""The machine's drives: its measured step responses, valves, pump, what the policy sees of them."""

import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

import crane_task
import machine
from crane_env import CraneVectorEnv
from machine import ACTUATED, JOINTS, Valves

# Geryyy/crane_model, test/step_response_fixture.json: (speed - before) / (settled - before) after
# a step of the velocity command at 0, mean over the edges of a recording
TIMES = np.array([0.06, 0.10, 0.15, 0.20, 0.30, 0.45, 0.60, 0.90, 1.20])  # s
MEASURED = {
    "slew": [0.01, 0.02, 0.13, 0.33, 0.87, 1.42, 1.33, 0.75, 1.04],
    "boom": [0.05, 0.01, 0.35, 0.70, 1.19, 0.90, 0.93],
    "arm": [0.03, 0.08, 0.70, 1.04, 0.87, 0.88, 0.89],
    "telescope": [0.01, 0.01, -0.01, 0.08, 0.84, 1.22, 1.05],
    "rotator": [0.02, 0.02, 0.12, 0.33, 0.76, 0.95, 0.98],
}
INERTIA = {"slew": 4251, "boom": 4855, "arm": 5923, "telescope": 1690, "rotator": 49.6}
LABS_FIT = {"slew": 0.23, "boom": 0.23, "arm": 0.40, "telescope": 0.79, "rotator": 0.09}
AXES = list(MEASURED)
POSES = {  # q2, q3, q4, q8, with the grapple off the ground and clear of the truck
    "slew": (1.2, -0.5, 0.0, 0.3),
    "boom": (0.38, 0.5, 0.0, 0.3),
    "arm": (0.51, 0.03, 0.0, 0.3),
    "telescope": (0.51, 1.0, 1.16, 0.3),
    "rotator": (0.52, 1.04, 0.09, 1.35),
}
FAR_LOG = np.array([[-20.0, 0.0, 0.0]])


def hydraulic(n=1, **options):
    envs = CraneVectorEnv(
        n, env_threads=1, **{"actuators": "hydraulic", "sensors": True, **options}
    )
    envs.reset(seed=0)
    return envs


def speeds(envs):
    return envs.qvel[:, JOINTS][:, ACTUATED]


def settled(axis):
    """One crane, a decision every 5 ms, at rest in the pose of an axis, with its inertia."""
    envs = hydraulic(frame_skip=1)
    q2, q3, q4, q8 = POSES[axis]
    q = np.array([[-1.2, q2, q3, q4, np.pi / 2 - q2 - q3, np.pi / 2, 0, q8]])
    here = (np.zeros(1, int), q, FAR_LOG, np.array([0.3]))
    envs.place(*here)
    model, data = envs.batch.get_model(0), envs.batch.get_data(0)
    mujoco.mj_forward(model, data)
    moving, momentum = np.zeros(model.nv), np.zeros(model.nv)
    moving[{"telescope": [3, 4], "rotator": [7]}.get(axis, [AXES.index(axis)])] = 1
    mujoco.mj_mulM(model, data, momentum, moving)
    scale = INERTIA[axis] / (moving @ momentum)  # of all masses: equal inertia about this axis
    for body in range(1, model.nbody - 1):
        view = envs.batch.body(model.body(body).name)
        view.mass[:] *= scale
        view.inertia[:] *= scale
    envs.place(*here)
    for _ in range(40):
        envs.advance(np.zeros((1, 6)))
    return envs


def response(axis, action):
    """Speed over commanded speed after each of 250 physics steps."""
    envs, i = settled(axis), AXES.index(axis)
    before, actions = speeds(envs)[0, i], np.zeros((1, 6))
    actions[0, i] = action
    low, high = envs.speed[:, i]
    target = action * (high if action > 0 else -low)
    curve = []
    for _ in range(250 if axis == "slew" else 125):
        envs.advance(actions)
        curve.append((speeds(envs)[0, i] - before) / target)
    return np.array(curve)


@pytest.mark.parametrize("action", [0.4, -0.4])
@pytest.mark.parametrize("axis", AXES)
def test_a_step_of_the_command_is_answered_as_the_machine_answers(axis, action):
    """Closer at every listed instant than the identified model of the lab that measured it."""
    measured = np.array(MEASURED[axis])
    steps = np.round(TIMES[: len(measured)] / machine.TIMESTEP).astype(int) - 1
    worst = np.abs(response(axis, action)[steps] - measured).max()
    assert worst < LABS_FIT[axis]


def test_drives_lie_within_the_identified_bands():
    """Stiffness and damping relative to the lab's own numbers; per stage of the telescope half."""
    stiffness = np.array([3.191e5, 1.834e6, 5.78e5, 3.5e6 / 2, 7296])
    damping = np.array([7520, 1.656e5, 4.70e4, 1.339e5 / 2, 483.7])
    bands = [(0.63, 1.25), (0.70, 1.50), (0.5, 3), (0.06, 1.5), (0.35, 1.7)]
    for ratio, (low, high) in zip(machine.STIFFNESS[:5] / stiffness, bands):
        assert low <= ratio <= high
    bands = [(0.84, 2.2), (0.4, 2.3), (0.7, 1.5), (0.12, 2.4), (0.13, 3.3)]
    for ratio, (low, high) in zip(machine.DAMPING[:5] / damping, bands):
        assert low <= ratio <= high
    assert (machine.DEAD_TIME >= 0.04).all() and (machine.DEAD_TIME <= 0.15).all()


def test_the_same_motion_at_any_frame_skip():
    """One command every 0.1 s, held for 1, 5 and 20 decisions of 20, 4 and 1 physics steps."""
    rng, ends = np.random.default_rng(0), {}
    actions = rng.uniform(-1, 1, (25, 6, 6))
    for frame_skip in (20, 4, 1):
        envs = hydraulic(6, frame_skip=frame_skip)
        for action in actions:
            for _ in range(20 // frame_skip):
                envs.advance(action)
        ends[frame_skip] = envs.qpos.copy()
    np.testing.assert_array_equal(ends[20], ends[4])
    np.testing.assert_array_equal(ends[20], ends[1])
    assert np.abs(envs.qvel).max() > 0.1


def test_nothing_moves_within_the_dead_time():
    envs = hydraulic(frame_skip=1)
    before = envs.act[0].copy()
    moved = np.zeros(6)
    for k in range(1, 40):
        envs.advance(np.full((1, 6), 0.5))
        servos = np.abs(envs.act[0] - before)[[0, 1, 2, 3, 5, 6]] > 1e-9
        moved = np.where((moved == 0) & servos, k * machine.TIMESTEP, moved)
    late = np.array(machine.DEAD_TIME)
    late[3] += machine.BREAKAWAY
    assert (moved > late).all() and (moved <= late + 0.03).all()


def test_a_moving_telescope_needs_no_breakaway():
    """Its valve opens late from rest only, and closes again at rest."""
    valves, ids, q = Valves(1), np.array([0]), np.zeros((1, 3))
    action = np.array([[0, 0, 0, 0.5, 0, 0]])
    first = [valves.mean_speed(ids, action, q, 0.02)[0, 3] for _ in range(8)]
    assert first[:5] == [0] * 5 and first[5] > 0 and first[7] == pytest.approx(0.5, rel=0.01)
    assert valves.mean_speed(ids, -action, q, 0.02)[0, 3] < 0  # straight through zero
    for _ in range(10):
        valves.mean_speed(ids, 0 * action, q, 0.02)
    assert valves.mean_speed(ids, action, q, 0.02)[0, 3] == pytest.approx(0, abs=1e-9)


def test_a_trickle_does_not_open_the_valve_of_a_resting_telescope():
    valves, ids, q = Valves(1), np.array([0]), np.zeros((1, 3))
    full, trickle = np.array([[0, 0, 0, 0.4, 0, 0]]), np.array([[0, 0, 0, 1e-4, 0, 0]])
    for _ in range(20):
        valves.mean_speed(ids, trickle, q, 0.02)
    assert valves.mean_speed(ids, full, q, 0.02)[0, 3] < 1e-3


def test_the_lag_of_a_valve_is_exact_over_any_step():
    """Ten steps of 2 ms let through what one of 20 ms does."""
    command = np.array([[0.1, -0.05, 0.08, 0.0, 0.3, -0.2]])
    once, often, ids, q = Valves(1), Valves(1), np.array([0]), np.zeros((1, 3))
    mean = once.mean_speed(ids, command, q, 0.02)
    each = [often.mean_speed(ids, command, q, 0.002) for _ in range(10)]
    np.testing.assert_allclose(np.mean(each, axis=0), mean, atol=1e-12)
    np.testing.assert_allclose(often.speed, once.speed, atol=1e-12)


def test_all_joints_share_the_pump():
    """Full speed everywhere asks for several times its flow; little asks get all they want."""
    envs, valves = hydraulic(), Valves(1)
    ids, (low, high) = np.array([0]), envs.speed
    for _ in range(100):
        full = valves.mean_speed(ids, high[None], envs.qpos, 0.02)
    fast = valves.speed
    np.testing.assert_allclose(full / fast, (full / fast)[0, 0])  # one share for all
    q2, q3 = envs.qpos[0, 1:3]
    lever = np.ones(6)
    lever[1:3] = machine.cylinder_levers(np.array([q2]), np.array([q3]))[:, 0]
    flow = np.sum(machine.OIL[1] * lever * full[0])
    assert flow == pytest.approx(0.95 * 1.4e-3) and full[0, 0] < 0.5 * high[0]
    for _ in range(100):
        little = valves.mean_speed(ids, 0.1 * low[None], envs.qpos, 0.02)
    np.testing.assert_allclose(little, 0.1 * low[None], rtol=1e-5)


def test_levers_of_the_cylinders():
    """Against their lengths, and never zero, so that oil always moves the joint."""
    q2, q3 = np.linspace(-1.1, 1.563, 40), np.linspace(-0.91, 1.5, 40)
    boom, arm = machine.cylinder_levers(q2, q3)
    assert (0.05 < boom).all() and (boom < 0.5).all()
    beyond, _ = machine.cylinder_levers(np.linspace(-1.25, -1.1, 40), np.zeros(40))
    assert (0.05 <= beyond).all() and (beyond < 0.5).all()  # where the bars do not reach
    assert (0.1 < arm).all() and (arm < 0.5).all() and 0.3 < arm.mean() < 0.4
    # the arm's cylinder at q3 = 0, by hand: from (-1.6802, -0.0485) to (-0.118, -0.468)
    x, y = -0.118 + 1.6802, -0.468 + 0.0485
    expected = abs(-0.118 * y - -0.468 * x) / np.hypot(x, y)
    _, (lever,) = machine.cylinder_levers(np.zeros(1), np.zeros(1))
    assert lever == pytest.approx(expected, abs=1e-4)


def test_passive_joints_and_force_limits_are_the_machines():
    model = hydraulic().model
    for name, damping, friction in (("q5", 15, 10), ("q6", 20, 5)):
        dof = model.joint(name).dofadr[0]
        assert model.dof_damping[dof] == damping and model.dof_frictionloss[dof] == friction
    limits = [3.181e4, 2e5, 1e5, 5e4, 5e4, 2.2e3, 1.2e4, 1.2e4]
    np.testing.assert_allclose(model.jnt_actfrcrange[machine.SERVOS, 1], limits)
    assert (model.actuator_gainprm[:8, 0] == 0).all()  # no velocity servo is left


def test_the_policy_sees_its_last_command_the_swing_and_the_forces():
    envs = hydraulic(4)
    rng = np.random.default_rng(0)
    obs, _ = envs.reset(seed=0)
    assert obs.shape == (4, 32) and not obs[:, 18:26].any()
    driven = [0, 1, 2, 3, 7, 8]
    static = envs.qfrc_bias[:, driven] / envs.model.jnt_actfrcrange[driven, 1]
    np.testing.assert_allclose(obs[:, 26:], static, atol=1e-5)  # a crane at rest
    for _ in range(5):
        actions = rng.uniform(-1.5, 1.5, (4, 6))
        obs, *_ = envs.advance(actions)
        np.testing.assert_allclose(obs[:, 18:24], np.clip(actions, -1, 1), atol=1e-6)
        np.testing.assert_allclose(obs[:, 24:26], envs.qvel[:, [5, 6]], atol=1e-5)
    assert np.abs(obs[:, 24:26]).max() > 0.01 and np.ptp(obs[:, 26:], axis=0).min() > 0.01


@pytest.mark.parametrize("options", [{}, {"randomize": 1.0}, {"actuators": "ideal"}])
def test_the_observed_forces_are_those_of_the_engine(options):
    """Of the state at the decision's end. Joint damping is no force of the oil."""
    envs = hydraulic(4, **options)
    envs.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(6):
        obs, *_ = envs.advance(rng.uniform(-1, 1, (4, 6)))
        for i in range(4):
            model, data = envs.batch.get_model(i), envs.batch.get_data(i)
            data.ctrl[:] = 0  # of the integrators it is no force, and it comes late
            data.ctrl[:8] = envs.ctrl[i, :8]
            mujoco.mj_forward(model, data)
            driven = [0, 1, 2, 3, 7, 8]
            engine = data.qfrc_actuator[driven] / model.jnt_actfrcrange[driven, 1]
            np.testing.assert_allclose(obs[i, 26:], engine, atol=1e-4)


def test_an_idle_hydraulic_crane_stays():
    """It neither sags nor drifts in ten seconds, at the starts of the task."""
    envs = hydraulic(16)
    before = envs.qpos[:, machine.SERVOS].copy()
    for _ in range(100):
        envs.advance(np.zeros((16, 6)))
    assert np.abs(envs.qpos[:, machine.SERVOS] - before).max() < 0.02


@pytest.mark.slow
def test_fuzz_hydraulic():
    from test_physics import fuzz

    diverged, warnings, done = fuzz(hydraulic(32), 200_000, 5, True)
    assert done > 180_000 and diverged == 0 and warnings == 0


# ---- what is counted


def test_force_on_the_ground_is_that_of_the_contacts():
    """A crane that is driven into the ground: peak, impulse and time from each physics step."""
    envs = CraneVectorEnv(1, frame_skip=1)
    envs.reset(seed=0)
    q2, q3, q4 = 0.3, 0.3, 0.5
    q = np.array([[-1.2, q2, q3, q4, np.pi / 2 - q2 - q3, np.pi / 2, 0, 0.3]])
    envs.place(np.zeros(1, int), q, FAR_LOG, np.array([0.3]))
    forces = []
    for _ in range(800):
        model, data = envs.batch.get_model(0), envs.batch.get_data(0)
        _, _, _, _, info = envs.advance(np.array([[0, -0.5, 0, 0, 0, 0]]))
        data.ctrl[:] = envs.ctrl[0]
        data.act[:] = envs.act[0] - machine.TIMESTEP * envs.ctrl[0, 8:]
        mujoco.mj_forward(model, data)  # what the step began with
        total, force = np.zeros(3), np.zeros(6)
        ground, log = model.geom("ground").id, model.body("log").id
        for k, contact in enumerate(data.contact):
            bodies = {model.geom_bodyid[g] for g in contact.geom}
            if ground in contact.geom and log not in bodies:
                mujoco.mj_contactForce(model, data, k, force)
                total += contact.frame.reshape(3, 3).T @ force[:3]
        forces.append(np.linalg.norm(total))
    assert max(forces) > 10e3
    assert info["ground_peak"][0] == pytest.approx(max(forces), rel=0.02)
    assert info["ground_impulse"][0] == pytest.approx(0.005 * np.sum(forces), rel=0.02)
    above = 0.005 * np.sum(np.array(forces) > crane_task.GENTLE_FORCE)
    assert info["ground_time"][0] == pytest.approx(above, abs=0.02)


def test_a_log_on_jaws_that_stand_on_the_ground_is_not_carried():
    """Nor is one on the ground; one in the air is, by all its weight."""
    envs = CraneVectorEnv(3)
    envs.reset(seed=0)
    q = [[-1.2, q2, 0.3, 0.5, np.pi / 2 - q2 - 0.3, np.pi / 2, 0, 0.3] for q2 in (0.8, 0.8, 0.3)]
    envs.place(np.arange(3), np.array(q), np.repeat(FAR_LOG, 3, axis=0), np.full(3, 0.8))
    envs.qpos[[0, 2], -5] = 2.0  # m, height of two logs, which fall for 0.1 s
    envs.advance(np.zeros((3, 6)))
    assert envs.costs.impact[0] == envs.costs.impact[1] == 0 and envs.costs.impact[2] > 10e3
    np.testing.assert_allclose(envs.state().carried, [1, 0, 0], atol=0.05)


def test_oil_of_a_steady_slew():
    """Two cylinders of 6.362e-3 m^2 on a rack of 0.1 m."""
    envs = CraneVectorEnv(1)
    envs.reset(seed=0)
    before = envs.qpos[0, 0]
    for _ in range(20):
        _, _, _, _, info = envs.advance(np.array([[0.2, 0, 0, 0, 0, 0]]))
    litres = 1000 * 12.724e-4 * abs(envs.qpos[0, 0] - before)
    assert info["litres"][0] == pytest.approx(litres, rel=0.05)


def test_work_of_lifting_is_the_gained_energy():
    """A slow boom: what the drives give is potential energy; the pump gives no less."""
    envs = CraneVectorEnv(1)
    envs.reset(seed=1)

    def potential():
        model, data = envs.batch.get_model(0), envs.batch.get_data(0)
        mujoco.mj_forward(model, data)
        mujoco.mj_energyPos(model, data)
        return data.energy[0]

    before = potential()
    for _ in range(50):
        _, _, _, _, info = envs.advance(np.array([[0, 0.2, 0, 0, 0, 0]]))
    gained = potential() - before
    assert gained > 5e3 and info["work"][0] == pytest.approx(gained, rel=0.1)
    assert info["energy"][0] == pytest.approx(info["work"][0], rel=0.05)  # one joint, one pressure


def test_costs_start_anew_with_an_episode_and_gentle_needs_both(monkeypatch):
    monkeypatch.setattr(crane_task, "TIME_LIMIT", 0.3)
    monkeypatch.setattr(crane_task, "REACH_DISTANCE", 100.0)
    monkeypatch.setattr(crane_task, "HOLD_TIME", 0.1)
    monkeypatch.setattr(crane_task, "grip_conditions", lambda *_: np.ones((3, 2), bool))
    envs = CraneVectorEnv(2)
    envs.reset(seed=0)
    for _ in range(3):
        envs.costs.total["ground_peak"][1] = 20.1e3
        _, _, _, _, info = envs.step(np.ones((2, 6)))
    assert info["success"].all() and info["gentle"].tolist() == [True, False]
    assert (info["litres"] > 0.1).all() and np.max([*envs.costs.total.values()]) == 0
    assert info["time_up"].tolist() == [0.2, 0.2] and np.isinf(envs.time_up).all()


def test_torque_limit_of_the_slew_is_that_of_its_cylinders():
    """Work of the oil at 25 MPa equals work of the torque: both cylinders take oil and push."""
    model = machine.load_model(actuators="hydraulic")
    limit = model.jnt_actfrcrange[machine.SERVOS[0], 1]
    assert limit == pytest.approx(25e6 * machine.OIL[1, 0], rel=1e-3)


def test_a_pushing_rod_side_gives_no_less_energy_than_work():
    """A boom that pushes down as hard as it can, 1 rad/s for 1 s at its force limit."""
    costs, limit = machine.Costs(1), 3.5e5
    force, dq = np.zeros((1, 6)), np.zeros((1, 6))
    force[0, 1], dq[0, 1] = -limit, -1.0
    costs.add(np.zeros((1, 5)), np.zeros((1, 8)), dq, force, 1.0)
    assert costs.total["work"][0] == costs.total["energy"][0] == pytest.approx(limit)


def test_a_joint_that_only_trembles_sets_no_pressure():
    """A boom held at its force limit beside a slew that turns at its own, lower pressure."""
    for tremble, boom in [(1e-5, 0.0), (0.1, 3.5e5)]:  # of 0.239 rad/s, the boom's limit
        costs = machine.Costs(1)
        force, dq = np.zeros((1, 6)), np.zeros((1, 6))
        force[0, :2], dq[0, :2] = (1e4, 3.5e5), (0.5, tremble)
        costs.add(np.zeros((1, 5)), np.zeros((1, 8)), dq, force, 1.0)
        oil = machine.oil_per_movement(np.zeros((1, 8)), dq)[0]
        pressure = max(1e4 / oil[0], boom / oil[1])
        flow = 0.5 * oil[0] + tremble * oil[1]
        assert costs.total["energy"][0] == pytest.approx(flow * pressure)


@pytest.mark.parametrize("actuators, steps", [("ideal", 5), ("hydraulic", 4)])
def test_force_on_the_ground_is_that_of_the_piece_just_made(actuators, steps):
    """Costs are added after each piece of a decision: as many forces as the piece has steps."""
    envs = CraneVectorEnv(2, actuators=actuators)
    envs.reset(seed=0)
    seen = []
    envs.costs.add = lambda ground, *_: seen.append(ground.shape)
    envs.advance(np.zeros((2, 6)))
    assert seen == [(2, steps)] * (20 // steps)


# ---- randomize


def test_randomize_draws_from_the_bands():
    """Anew at each start, scaled by the share; and says in info what it drew."""
    for share in (1.0, 0.25):
        envs = hydraulic(256, randomize=share)
        _, info = envs.reset(seed=1)
        for name, (nominal, low, high) in machine.DRAWN.items():
            drawn = info[f"drawn_{name}"]
            if name in ("stiffness", "damping"):  # their logarithms are uniform
                drawn = np.log(nominal + (drawn - nominal) / share)
                low, high = np.log(low), np.log(high)
            else:
                low, high = (nominal + share * (bound - nominal) for bound in (low, high))
            assert (drawn >= low - 1e-9).all() and (drawn <= high + 1e-9).all(), name
            wide = high > low
            middle, width = (low + high) / 2, high - low
            spread = np.abs(drawn.mean(axis=0) - middle) / np.where(wide, width, 1)
            assert (spread[np.broadcast_to(wide, spread.shape)] < 0.09).all(), name  # 5 sigma
            assert np.array_equal(info[f"drawn_{name}"], envs.drawn[name])
        again = envs.reset()[1]
        assert np.abs(again["drawn_density"] - info["drawn_density"]).max() > 1
        assert np.array_equal(
            info["drawn_density"], hydraulic(256, randomize=share).reset(seed=1)[1]["drawn_density"]
        )
    assert not any(key.startswith("drawn") for key in hydraulic().reset(seed=0)[1])


def test_what_is_drawn_reaches_the_engine():
    envs = hydraulic(8, randomize=1.0)
    _, info = envs.reset(seed=2)
    servos = machine.COMMAND_OF_SERVO
    for i in range(8):
        model = envs.batch.get_model(i)
        np.testing.assert_allclose(
            model.actuator_gainprm[8:, 0], info["drawn_stiffness"][i, servos]
        )
        np.testing.assert_allclose(model.actuator_biasprm[8:, 1], -model.actuator_gainprm[8:, 0])
        damping = model.dof_damping[machine.SERVOS]
        np.testing.assert_allclose(damping, info["drawn_damping"][i, servos])
        late = model.actuator_delay[8:] - machine.DEAD_TIME[servos]
        np.testing.assert_allclose(late, info["drawn_extra_delay"][i], atol=1e-9)
        assert (model.actuator_delay[8:] <= machine.MAX_DELAY * machine.TIMESTEP).all()
        assert (model.actuator_delay[8:] >= machine.TIMESTEP).all()
        radius = envs.state().diameter[i] / 2
        density = model.body("log").mass[0] / (np.pi * radius**2 * crane_task.LOG_LENGTH)
        assert density == pytest.approx(info["drawn_density"][i])
        factor = model.geom_friction / envs.model.geom_friction
        np.testing.assert_allclose(factor, info["drawn_friction"][i])
        lead = envs.max_lead[i] * model.actuator_gainprm[8:, 0]
        np.testing.assert_allclose(lead, model.jnt_actfrcrange[machine.SERVOS, 1])
    assert np.abs(envs.qvel).max() == 0


def test_what_is_drawn_reaches_the_observation_and_not_the_reward():
    plain, random = hydraulic(8), hydraulic(8, randomize=1.0)
    reference, before = plain.reset(seed=3)
    obs, info = random.reset(seed=3)
    swung = [4, 5]  # q5 and q6 start elsewhere, and with them the grapple
    joints = [i for i in range(8) if i not in swung]
    errors = info["drawn_joint_error"][:, joints]
    np.testing.assert_allclose(obs[:, joints] - reference[:, joints], errors, atol=1e-5)
    swing = random.state().q[:, swung] - plain.state().q[:, swung]
    np.testing.assert_allclose(swing, info["drawn_swing"], atol=1e-6)
    assert np.abs(errors).max() > 1e-3 and not info["drawn_joint_error"][:, 3].any()
    delta_p, _, angle = crane_task.relative_pose(random.state())
    cos, sin = np.cos(random.state().q[:, 0]), np.sin(random.state().q[:, 0])
    x, y, z = (delta_p + info["drawn_pose_error"]).T
    np.testing.assert_allclose(
        obs[:, 14:17].T, [cos * x + sin * y, cos * y - sin * x, z], atol=1e-5
    )
    np.testing.assert_allclose(obs[:, 17], angle + info["drawn_yaw_error"], atol=1e-5)
    true = np.linalg.norm(delta_p, axis=1) + crane_task.relative_pose(random.state())[1]
    np.testing.assert_allclose(info["d_combine"], true)


def test_the_speed_gain_is_that_of_the_direction():
    envs = hydraulic(2, randomize=1.0)
    envs.reset(seed=0)
    envs.drawn["gain"][:] = np.array([np.full(6, 0.9), np.full(6, 1.2)])
    for _ in range(10):
        envs.advance(np.array([[-0.1] * 6, [0.1] * 6]))
    speed = envs.valves.speed / (0.1 * envs.speed)
    np.testing.assert_allclose(speed, [[0.9] * 6, [1.2] * 6], rtol=1e-3)


def test_randomize_without_hydraulics():
    """Log and sensors vary, the ideal servos do not."""
    envs = CraneVectorEnv(4, randomize=1.0)
    _, info = envs.reset(seed=0)
    model = envs.batch.get_model(0)
    np.testing.assert_array_equal(model.actuator_gainprm, envs.model.actuator_gainprm)
    assert np.ptp(info["drawn_density"]) > 10
    for _ in range(30):
        obs, *_ = envs.step(np.ones((4, 6)))
    assert obs in envs.observation_space


# ---- benchmark/levels.py


def test_a_sweep_changes_one_thing_and_puts_it_back():
    sys.path.insert(0, str(Path(__file__).parent.parent / "benchmark"))
    import levels

    def measured():
        envs = hydraulic(2)
        envs.reset(seed=0)
        model, q = envs.model, np.zeros((1, 3))
        valves, fast = Valves(1), np.array([[0.8, 0.2, 0.3, 0.4, 2.0, 1.8]])
        speed = [valves.mean_speed(np.array([0]), fast, q, 0.02) for _ in range(100)][-1]
        return {
            "more dead time [s]": model.actuator_delay[8],
            "constant pose error [m]": np.linalg.norm(envs.drawn["pose_error"], axis=-1).max(),
            "passive damping, times": model.dof_damping[model.joint("q5").dofadr[0]],
            "pump, times": speed[0, 0],
            "force limits, times": model.jnt_actfrcrange[0, 1],
        }

    before = measured()
    for what, value in zip(before, [0.12, 0.2, 3.0, 0.5, 0.5]):
        with levels.changed(what, value):
            now = measured()
        wanted = before[what] * value if "times" in what else before[what] + value
        assert now.pop(what) == pytest.approx(wanted)
        assert all(now[other] == pytest.approx(before[other]) for other in now)
    assert measured() == before and set(before) == set(levels.SWEEPS)
