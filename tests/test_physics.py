"""The crane against closed forms: kinematics, masses, pendulum, servos, gripping, contacts."""

import importlib.util
import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest

import crane_task
import machine
from crane_env import CraneVectorEnv
from machine import COMMAND_OF_SERVO, JOINTS, SERVOS

# theta, a, d, alpha of the Denavit-Hartenberg table in assets/README.md; q4 twice
DH = [
    ("q1", -0.18, 2.425, np.pi / 2),
    ("q2", 3.49288, 0.0, 0.0),
    ("q3", -0.3925, 0.0, np.pi / 2),
    ("q4", 0.0, 3.157, 0.0),
    ("q4_stage2", 0.0, 0.0, -np.pi / 2),
    ("q5", -0.213, 0.0, -np.pi / 2),
    ("q6", 0.0, 0.0, -np.pi / 2),
    ("q7", 0.0, 0.578, 0.0),
]
HANGING = np.array([-np.pi / 2, 0.5, 0.2, 0.5, np.pi / 2 - 0.7, np.pi / 2, 0.0, 1.0])


def dh_matrix(theta, a, d, alpha):
    ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array(
        [
            [ct, -st * ca, st * sa, a * ct],
            [st, ct * ca, -ct * sa, a * st],
            [0, sa, ca, d],
            [0, 0, 0, 1],
        ]
    )


def place(q, diameter=0.55, log_pose=(5.0, -6.0, 0.0), **kwargs):
    """Vector environment of one crane a row of q (N, 8), logs out of the way unless said."""
    q = np.atleast_2d(q)
    n = len(q)
    envs = CraneVectorEnv(n, **kwargs)
    envs.reset(seed=0)
    log_pose = np.broadcast_to(np.asarray(log_pose, float), (n, 3))
    envs.place(np.arange(n), q, log_pose, np.broadcast_to(np.asarray(diameter, float), (n,)))
    return envs


def grasp_start():
    """q and log pose with the open grapple hanging square over a log, just able to close."""
    q = HANGING.copy()
    q[7] = 0.05
    wanted = 0.9 + 0.578 + 0.213  # m, height of the tip joint
    for q4 in np.linspace(0.05, 2.2, 4000):
        out, up = crane_task.tip_position(q[1], q[2], q4)
        if up <= wanted:
            break
    q[3] = q4
    return q, (0.0, -out, q[0] - q[6])


def test_forward_kinematics_is_the_dh_product():
    model = machine.load_model()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    worst = 0.0
    for _ in range(1000):
        frame = np.eye(4)
        frame[2, 3] = 1.1407
        q4 = rng.uniform(0, 2.236)
        for name, *_ in DH:
            low, high = model.joint(name).range
            data.joint(name).qpos = q4 if name.startswith("q4") else rng.uniform(low, high)
        mujoco.mj_kinematics(model, data)
        for (name, a, d, alpha), body in zip(DH, range(1, 9)):
            q = data.joint(name).qpos[0]
            slide = name.startswith("q4")
            frame = frame @ dh_matrix(0 if slide else q, a, d + q if slide else d, alpha)
            worst = max(worst, np.abs(data.body(f"K{body}").xpos - frame[:3, 3]).max())
            rotation = data.body(f"K{body}").xmat.reshape(3, 3)
            worst = max(worst, np.abs(rotation - frame[:3, :3]).max())
        grapple_centre = frame @ [0, 0, 0.5, 1]
        worst = max(worst, np.abs(data.site("grapple_centre").xpos - grapple_centre[:3]).max())
    assert worst < 1e-9


def test_known_pose_hangs_almost_straight():
    """A pose of the real crane: its passive joints hang within 4 degrees of straight down."""
    model = machine.load_model()
    data = mujoco.MjData(model)
    pose = dict(q1=-0.48, q2=0.736, q3=-0.303, q4=0.428, q4_stage2=0.428, q5=1.179, q6=1.525)
    for name, value in pose.items():
        data.joint(name).qpos = value
    mujoco.mj_kinematics(model, data)
    down = -data.body("K8").xmat.reshape(3, 3)[2, 2]
    assert np.degrees(np.arccos(down)) < 4


def test_tip_position_matches_the_model():
    model = machine.load_model()
    data = mujoco.MjData(model)
    for q2, q3, q4 in [(0.5, 0.2, 0.5), (-0.3, 1.1, 2.0), (1.2, -0.8, 0.0)]:
        for name, value in dict(q2=q2, q3=q3, q4=q4, q4_stage2=q4).items():
            data.joint(name).qpos = value
        mujoco.mj_kinematics(model, data)
        x, y, z = data.site("tip").xpos
        np.testing.assert_allclose(crane_task.tip_position(q2, q3, q4), [x, z], atol=1e-9)
        assert abs(y) < 1e-9


def test_jaw_geometry():
    """Tips level and 2.38 m apart when open, straight down at pi/2, meeting at 1.97 rad."""
    model = machine.load_model()
    data = mujoco.MjData(model)

    def tips(q8):
        data.joint("q8").qpos = data.joint("q8_inner").qpos = q8
        mujoco.mj_kinematics(model, data)
        k8 = data.body("K8")
        points = []
        for jaw in ("jaw_outer", "jaw_inner"):
            body = data.body(jaw)
            world = body.xpos + body.xmat.reshape(3, 3) @ [0.8566, 0, 0]
            points.append(k8.xmat.reshape(3, 3).T @ (world - k8.xpos))
        return np.array(points)

    np.testing.assert_allclose(tips(0.0)[:, 2], 0, atol=1e-9)
    assert abs(np.diff(tips(0.0)[:, 1])[0] - 2.378) < 1e-3
    np.testing.assert_allclose(tips(np.pi / 2)[:, 2], 0.8566, atol=1e-9)
    assert abs(np.diff(tips(np.pi / 2)[:, 1])[0] - 0.665) < 1e-3
    assert abs(np.diff(tips(1.97)[:, 1])[0]) < 0.01
    assert model.site("grapple_centre").pos[2] == crane_task.PIVOT_HEIGHT
    for q8 in (0.4, 1.5, 2.5):
        np.testing.assert_allclose(tips(q8)[:, 2], crane_task.JAW_LENGTH * np.sin(q8), atol=1e-9)


def test_moving_mass():
    model = machine.load_model()
    mass = model.body_subtreemass[model.body("base").id]
    assert abs(mass - 1985.28) < 0.01
    assert abs(mass / 1981 - 1) < 0.005  # the paper's "approximately 1981 kg"


@pytest.mark.slow
@pytest.mark.parametrize("joint", ["q5", "q6"])
def test_small_swing_is_that_of_a_damped_compound_pendulum(joint, monkeypatch):
    """Its Coulomb friction aside, which holds it within friction / stiffness of its rest."""
    load_model = machine.load_model

    def without_friction(*args, **kwargs):
        model = load_model(*args, **kwargs)
        model.dof_frictionloss[:] = 0
        return model

    monkeypatch.setattr(machine, "load_model", without_friction)
    envs = place(HANGING, frame_skip=1)
    for _ in range(12_000):  # a minute, until it hangs still
        envs.advance(np.zeros((1, 6)))
    index = {"q5": 4, "q6": 5}[joint]
    q = envs.state().q.copy()
    rest = q[0, index]

    model, data = envs.batch.get_model(0), envs.batch.get_data(0)
    mujoco.mj_forward(model, data)
    axis, anchor = data.joint(joint).xaxis, data.joint(joint).xanchor
    first = model.joint(joint).bodyid[0]
    inertia, torque_arm, mass = 0.0, np.zeros(3), 0.0
    for body in range(model.nbody):
        ancestor = body
        while ancestor not in (0, first):
            ancestor = model.body_parentid[ancestor]
        if ancestor != first:
            continue
        arm = data.xipos[body] - anchor
        local = data.ximat[body].reshape(3, 3).T @ axis
        inertia += model.body_mass[body] * np.sum(np.cross(axis, arm) ** 2)
        inertia += local @ (model.body_inertia[body] * local)
        torque_arm += model.body_mass[body] * arm
        mass += model.body_mass[body]
    stiffness = 9.81 * np.linalg.norm(np.cross(axis, torque_arm))
    decay = model.dof_damping[model.joint(joint).dofadr[0]] / (2 * inertia)
    expected = 2 * np.pi / np.sqrt(stiffness / inertia - decay**2)

    q[0, index] += 0.05
    envs.place(np.array([0]), q, np.array([[5.0, -6.0, 0.0]]), np.array([0.55]))
    angles = []
    for _ in range(1200):
        envs.advance(np.zeros((1, 6)))
        angles.append(envs.state().q[0, index] - rest)
    angles = np.array(angles)
    k = np.flatnonzero((angles[:-1] > 0) != (angles[1:] > 0))[:4]
    crossings = 0.005 * (k + angles[k] / (angles[k] - angles[k + 1]))
    period = 2 * np.mean(np.diff(crossings))
    assert mass > 200
    assert abs(period / expected - 1) < 0.02

    monkeypatch.setattr(machine, "load_model", load_model)
    envs = place(HANGING, frame_skip=1)
    friction = envs.model.dof_frictionloss[model.joint(joint).dofadr[0]] / stiffness
    assert 0.001 < friction < 0.01
    for share, stays in ((0.5, True), (3.0, False)):
        q[0, index] = rest + share * friction
        envs.place(np.array([0]), q, np.array([[5.0, -6.0, 0.0]]), np.array([0.55]))
        for _ in range(200):
            envs.advance(np.zeros((1, 6)))
        moved = abs(envs.state().q[0, index] - q[0, index])
        assert (moved < 0.2 * friction) == stays


def test_each_servo_settles_on_its_command():
    """Within 2 % of its limit, both directions, both stages and jaws."""
    q = np.tile(HANGING, (12, 1))
    q[:, 1], q[:, 4] = 0.9, np.pi / 2 - 1.1  # high above the ground
    envs = place(q)
    actions = np.zeros((12, 6))
    for i in range(6):
        actions[2 * i, i], actions[2 * i + 1, i] = 1.0, -1.0
    low, high = machine.SPEEDS["real"]
    command = np.where(actions < 0, -actions * low, actions * high)[:, COMMAND_OF_SERVO]
    for _ in range(5):
        envs.advance(actions)
    velocity = envs.qvel[:, SERVOS]
    error = np.abs(velocity - command) / high[COMMAND_OF_SERVO]
    assert error.max() < 0.02


RESTING = {  # joint, end of its range, start before it; other joints where nothing is in the way
    "q1_right": (0, 0, 0.03, {}),
    "q1_left": (0, 1, 0.03, {}),
    "q2_up": (1, 1, 0.1, {2: -0.4}),
    "q3_up": (2, 1, 0.1, {1: 0.05}),
    "q4_in": (3, 0, 0.1, {1: 0.9, 2: 0.6}),
    "q4_out": (3, 1, 0.1, {1: 0.9, 2: 0.6}),
}


def test_resting_in_an_end_stop_ends_no_episode():
    """Five seconds of full command into soft stops: they give, but less than the rules allow."""
    n = len(RESTING)
    q, actions = np.tile(HANGING, (n, 1)), np.zeros((n, 6))
    which, ends, starts, others = zip(*RESTING.values())
    joint, end, each = list(which), list(ends), np.arange(n)
    outward = np.array([-1.0, 1.0])[end]
    stop = CraneVectorEnv(1).joint_range[joint, end]
    q[each, joint] = stop - outward * starts
    actions[each, joint] = outward
    for i, changes in enumerate(others):
        for j, value in changes.items():
            q[i, j] = value
    q[:, 4] = np.pi / 2 - q[:, 1] - q[:, 2]
    out, _ = crane_task.tip_position(*q[:, 1:4].T)  # logs below the grapples, within reach
    envs = place(q, log_pose=np.stack([out * np.cos(q[:, 0]), out * np.sin(q[:, 0]), 0 * out], 1))
    beyond = []
    for _ in range(50):
        info = envs.advance(actions)[-1]
        assert (info["termination"] == "none").all(), dict(zip(RESTING, info["termination"]))
        beyond.append(outward * (envs.state().q[each, joint] - stop))
    assert (np.min(beyond[-20:], axis=0) > 0).all()  # in the stop, not on the way to it
    assert 0.012 < np.max(beyond) < crane_task.LIMIT_TOLERANCE


def test_a_servo_in_its_stop_winds_up_to_its_force_and_no_further():
    """Slew and boom, five seconds: each integrator's own force is the limit in crane.xml."""
    q = np.tile(HANGING, (2, 1))
    q[0, 0], q[1, 1], q[1, 2] = 3.68, 1.46, -0.4
    q[:, 4] = np.pi / 2 - q[:, 1] - q[:, 2]
    envs = place(q)
    for _ in range(50):
        envs.advance(np.eye(6)[:2])
    limits = [200_000, 400_000]  # N m, of q1 and q2
    for crane, limit in enumerate(limits):
        lead = envs.act[crane, crane] - envs.qpos[crane, crane]
        stiffness = envs.model.actuator_gainprm[8 + crane, 0]
        within_25_ms = machine.SPEEDS["real"][1, crane] * 0.025  # between two clamps
        assert 0.98 * limit < stiffness * lead < limit + 1.02 * stiffness * within_25_ms


def test_synchronised_pairs_stay_together():
    """Within 2 cm and 0.05 rad, through reversals at full speed."""
    envs = place(HANGING)
    for k in range(40):
        envs.advance(np.array([[0.3, 0.2, 0.1, 1.0 if k < 20 else -1.0, 0.0, np.sin(k)]]))
        for a, b, bound in (("q4", "q4_stage2", 2e-2), ("q8", "q8_inner", 5e-2)):
            qa, qb = envs.batch.joint(a).qpos, envs.batch.joint(b).qpos
            assert np.abs(qa - qb).max() < bound


def test_idle_crane_stays():
    """Actuated joints hold from any start; all of it holds once the grapple hangs still."""
    envs = CraneVectorEnv(16)
    envs.reset(seed=3)
    before = envs.state().q.copy()
    for _ in range(90):
        envs.advance(np.zeros((16, 6)))
    drift = np.abs(envs.state().q - before)[:, machine.ACTUATED]
    tips = [np.stack(crane_task.tip_position(*q[:, 1:4].T)) for q in (before, envs.state().q)]
    assert np.abs(tips[0] - tips[1]).max() < 5e-3
    assert drift.max() < 2e-4

    envs = place(HANGING)
    for _ in range(600):
        envs.advance(np.zeros((1, 6)))
    q = envs.state().q.copy()
    envs.place(np.array([0]), q, np.array([[5.0, -6.0, 0.0]]), np.array([0.55]))
    start = envs.state().grapple_centre.copy()
    for _ in range(90):
        envs.advance(np.zeros((1, 6)))
        assert np.linalg.norm(envs.state().grapple_centre - start) < 5e-3


def lift(diameter, **kwargs):
    """A crane that has gripped a log and holds it in the air at zero command."""
    q, log_pose = grasp_start()
    envs = place(q, diameter, log_pose, **kwargs)
    for seconds, joint, action in [(1.6, 5, 1.0), (3.0, 1, 1.0), (4.0, 1, 0.0)]:
        for _ in range(round(seconds / envs.dt)):
            actions = np.zeros((1, 6))
            actions[0, joint] = action
            envs.advance(actions)
    return envs


@pytest.mark.slow
@pytest.mark.parametrize("diameter", [0.3, 0.5, 0.8])
def test_held_log_does_not_sag(diameter):
    """Less than 2 cm in 20 s at zero command."""
    envs = lift(diameter)
    start = envs.state().log_centre.copy()
    assert crane_task.log_clearance(envs.state())[0] > 0.3
    for _ in range(200):
        envs.advance(np.zeros((1, 6)))
    sag = start[0, 2] - envs.state().log_centre[0, 2]
    assert abs(sag) < 0.02
    assert envs.state().touching.all()


def test_log_mass_and_inertia_follow_the_diameter():
    envs = CraneVectorEnv(2, diameter=np.array([0.3, 0.8]))
    envs.reset(seed=0)
    for i, d in enumerate([0.3, 0.8]):
        body = envs.batch.get_model(i).body("log")
        mass = 650 * np.pi * d**2 / 4 * 2.75
        across = mass * (3 * (d / 2) ** 2 + 2.75**2) / 12
        np.testing.assert_allclose(body.mass, mass)
        np.testing.assert_allclose(body.inertia, [across, across, mass * d**2 / 8])
    np.testing.assert_allclose(envs.batch.get_model(0).body("log").mass, 126.4, atol=0.1)
    np.testing.assert_allclose(envs.batch.get_model(1).body("log").mass, 898.5, atol=0.5)


def closing_at_first_touch(diameter, contact):
    """q8 at which a jaw first touches a log fixed in the air 0.15 m below the grapple frame."""
    model = machine.load_model(contact)
    data = mujoco.MjData(model)
    model.geom("log").size[0] = model.geom("log_capsule").size[0] = diameter / 2
    model.geom("log_capsule").size[1] = 2.75 / 2 - diameter / 2
    mujoco.mj_setConst(model, data)
    data.qpos[JOINTS] = HANGING
    data.joint("q4_stage2").qpos = HANGING[3]
    mujoco.mj_kinematics(model, data)
    frame = data.body("K8").xmat.reshape(3, 3)
    log = data.joint("log").qpos
    log[:3] = data.body("K8").xpos + frame @ [0, 0, 0.15 + diameter / 2]
    mujoco.mju_mat2Quat(log[3:], np.stack([frame[:, 1], frame[:, 2], frame[:, 0]], axis=1).ravel())
    for q8 in np.arange(0.5, 3.0, 0.002):
        data.joint("q8").qpos = data.joint("q8_inner").qpos = q8
        mujoco.mj_forward(model, data)
        if data.sensor("outer_touch").data[0] or data.sensor("inner_touch").data[0]:
            return q8
    return np.inf


def test_thick_log_is_touched_where_a_thin_one_is_not():
    envs = place(np.tile(HANGING, (2, 1)), diameter=[0.3, 0.8])
    assert closing_at_first_touch(0.8, "primitive") + 0.5 < closing_at_first_touch(0.3, "primitive")
    # and in the batch, where sizes are per crane: same pose, the jaws just wide of a thin log
    q, log_pose = grasp_start()
    q = np.tile(q, (2, 1))
    q[:, 7] = 1.75
    envs.place(np.arange(2), q, np.tile(log_pose, (2, 1)), np.array([0.3, 0.8]))
    assert envs.state().touching.any(axis=-1).tolist() == [False, True]


@pytest.mark.parametrize("diameter", [0.3, 0.55, 0.8])
def test_primitive_and_sdf_jaws_touch_alike(diameter):
    """Contact starts within 2 cm of closing, measured at the tips."""
    angle = closing_at_first_touch(diameter, "primitive") - closing_at_first_touch(diameter, "sdf")
    assert abs(angle) * 0.8566 < 0.02


def fuzz(envs, steps, seed, autoreset):
    """Random, bang-bang and gripping actions in turn; returns physics steps made."""
    rng = np.random.default_rng(seed)
    n = envs.num_envs
    envs.reset(seed=seed)
    bang = np.ones((n, 6))
    q, log_pose = grasp_start()
    diameter = rng.uniform(0.3, 0.8, n)
    diverged, held = 0, np.zeros(n, bool)
    decisions = steps // (n * envs.frame_skip)
    for k in range(decisions):
        if k % 60 == 0:  # a third of the cranes start over a log and grip it
            gripping = rng.random(n) < 1 / 3
            ids = np.flatnonzero(gripping)
            envs.place(
                ids, np.tile(q, (len(ids), 1)), np.tile(log_pose, (len(ids), 1)), diameter[ids]
            )
        bang = np.where(rng.random((n, 6)) < 0.1, -bang, bang)
        actions = np.where(rng.random((n, 1)) < 0.5, bang, rng.uniform(-1, 1, (n, 6)))
        actions[gripping, 5] = 1.0
        if k % 60 <= 20:
            actions[gripping, :5] = 0.0
        else:  # then it swings the log about
            actions[gripping, 1] = np.abs(actions[gripping, 1])
        info = (envs.step if autoreset else envs.advance)(actions)[-1]
        diverged += (info["termination"] == "diverged").sum()
        held |= (info["clearance"] > 0.1) & ~info["not_lifted"]
    assert np.isfinite(envs.qpos).all() and held.any()
    return diverged, envs.batch.warning[:, :, 1].sum(), decisions * n * envs.frame_skip


@pytest.mark.slow
@pytest.mark.parametrize("speed", ["real", "mjcf"])
@pytest.mark.parametrize("autoreset", [True, False], ids=["episodes", "no_rules"])
def test_fuzz_primitive(speed, autoreset):
    """No warning and no divergence, with the episode rules and past them."""
    steps = int(os.environ.get("FUZZ_STEPS", 250_000))
    diverged, warnings, done = fuzz(CraneVectorEnv(64, speed=speed), steps, 5, autoreset)
    assert done > 0.9 * steps
    assert diverged == 0 and warnings == 0


@pytest.mark.slow
@pytest.mark.parametrize("integrator, solver", [("implicit", "CG"), ("discrete", "Newton")])
def test_fuzz_other_integrators(integrator, solver):
    envs = CraneVectorEnv(64, integrator=integrator, solver=solver)
    diverged, warnings, _ = fuzz(envs, 100_000, 7, True)
    assert diverged == 0 and warnings == 0


@pytest.mark.slow
def test_fuzz_sdf():
    diverged, warnings, done = fuzz(CraneVectorEnv(16, contact="sdf"), 50_000, 6, True)
    assert done > 45_000
    assert diverged == 0 and warnings == 0


def deepest_contact(envs):
    """Smallest contact distance (m) of crane links with ground or truck, and which of the two."""
    model, data = envs.batch.get_model(0), envs.batch.get_data(0)
    mujoco.mj_forward(model, data)
    touched, depth = set(), 0.0
    for contact in data.contact:
        bits = {int(model.geom_contype[g]) for g in (contact.geom1, contact.geom2)}
        if 0 in bits and bits & {1, 2} and model.geom("log").id not in contact.geom:
            touched |= bits & {1, 2}
            depth = min(depth, contact.dist)
    return depth, touched


@pytest.mark.parametrize("q8", [0.0, 1.6])
def test_crane_does_not_pass_through_the_ground(q8):
    q = HANGING.copy()
    q[7] = q8
    envs = place(q)
    touched = set()
    for _ in range(60):
        envs.advance(np.array([[0.0, -1.0, 0.0, 1.0, 0.0, 0.0]]))
        depth, now = deepest_contact(envs)
        touched |= now
        assert depth > -0.05
    assert touched == {1}


def test_crane_does_not_pass_through_the_truck():
    q = HANGING.copy()
    q[1:5] = [0.5, -0.9, 0.1, np.pi / 2 + 0.4 - 0.01]  # folded: the grapple hangs at 1.2 m
    q[4] = np.clip(q[4], -np.pi / 2, np.pi / 2)
    envs = place(q)
    touched = set()
    for _ in range(40):  # towards the cab
        envs.advance(np.array([[1.0, 0.0, 0.0, 0.0, 0.0, 0.0]]))
        depth, now = deepest_contact(envs)
        touched |= now
        assert depth > -0.08
    assert 2 in touched


@pytest.mark.parametrize("integrator", ["implicitfast", "implicit", "discrete"])
@pytest.mark.parametrize("solver", ["Newton", "CG"])
def test_integrators_and_solvers_are_passed_on(integrator, solver):
    model = CraneVectorEnv(1, integrator=integrator, solver=solver).batch.get_model(0)
    assert mujoco.mjtIntegrator(model.opt.integrator).name == f"mjINT_{integrator.upper()}"
    assert mujoco.mjtSolver(model.opt.solver).name == f"mjSOL_{solver.upper()}"


def test_both_contact_models_have_one_inertia_and_one_friction():
    frictions = []
    for contact, log in [("primitive", "log_capsule"), ("sdf", "log")]:
        model = machine.load_model(contact)
        reference = machine.load_model("primitive")
        np.testing.assert_array_equal(model.body_mass, reference.body_mass)
        np.testing.assert_array_equal(model.body_inertia, reference.body_inertia)
        for jaw in ("jaw_outer", "jaw_inner"):
            touches = model.geom_conaffinity & model.geom(log).contype > 0
            parts = touches & (model.geom_bodyid == model.body(jaw).id)
            friction, number = np.unique(model.geom_friction[parts], axis=0, return_counts=True)
            assert number == {"primitive": 10, "sdf": 6 if jaw == "jaw_outer" else 3}[contact]
            frictions.append(np.maximum(friction[0], model.geom(log).friction))
        assert model.geom(log).condim[0] == 6
    assert len(np.unique(frictions, axis=0)) == 1


def test_bands_lie_side_by_side():
    """Along the hinge: outer bands from 0.105 to 0.19 m on either side, the inner one between."""
    model = machine.load_model("sdf")
    for jaw, bands in (("jaw_outer", {(-190, -105), (105, 190)}), ("jaw_inner", {(-100, 100)})):
        found = []
        for i in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_SDF):
            if model.geom_bodyid[i] == model.body(jaw).id:
                rotation = np.zeros(9)
                mujoco.mju_quat2Mat(rotation, model.geom_quat[i])
                along = rotation[6:]  # the body's z in the geom's frame
                centre = model.geom_pos[i, 2] + along @ model.geom_aabb[i, :3]
                half = np.abs(along) @ model.geom_aabb[i, 3:]
                found.append((round(1000 * (centre - half)), round(1000 * (centre + half))))
        assert set(found) == bands and len(found) == 3 * len(bands)


@pytest.mark.parametrize("contact", ["primitive", pytest.param("sdf", marks=pytest.mark.slow)])
def test_what_is_only_drawn_changes_no_motion(contact):
    """A grip and a lift are bit for bit the same in a model made to be rendered."""
    q, log_pose = grasp_start()
    moved, models = [], []
    for render_mode in (None, "rgb_array"):
        envs = place(q, 0.55, log_pose, contact=contact, render_mode=render_mode)
        moved.append([])
        for decision in range(30):
            envs.step([[0, decision >= 18, 0, 0, 0, 1]])
            moved[-1].append([*envs.qpos[0], *envs.qvel[0]])
        assert envs.state().touching.all() and crane_task.log_clearance(envs.state()) > 0.05
        models.append(envs.model)
    collides = [(model.geom_contype | model.geom_conaffinity) > 0 for model in models]
    assert collides[0].all() and not collides[1].all() and not models[0].ntex
    np.testing.assert_array_equal(*moved)


def test_committed_meshes_are_what_the_script_writes():
    path = machine.MODEL_PATH.parent / "make_meshes.py"
    spec = importlib.util.spec_from_file_location("make_meshes", path)
    make_meshes = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make_meshes)
    for name, sections in make_meshes.PIECES.items():
        assert make_meshes.piece(*sections) == (path.parent / f"jaw_{name}.obj").read_text()


def test_import_without_opengl():
    """Training needs no graphics: the module must load where EGL is missing."""
    code = "import ctypes.util; ctypes.util.find_library = lambda name: None; import crane_env"
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "MUJOCO_GL")}
    command = [sys.executable, "-c", code + "; crane_env.CraneEnv().reset(seed=0)"]
    root = machine.MODEL_PATH.parent.parent
    subprocess.run(command, cwd=root, env=environment, check=True)
