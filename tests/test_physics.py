"""The crane against closed forms: kinematics, masses, pendulum, servos, gripping, contacts."""

import importlib.util
import subprocess
import sys
from itertools import pairwise

import mujoco
import numpy as np
import pytest

import crane_env
from crane_env import ACTUATED, JOINTS, CraneVectorEnv, log_clearance
from hydraulic_crane import HydraulicCraneVectorEnv

DH = {  # a, d, alpha of the Denavit-Hartenberg table in assets/README.md; q4 twice
    "q1": (-0.18, 2.425, np.pi / 2), "q2": (3.49288, 0, 0), "q3": (-0.3925, 0, np.pi / 2),
    "q4": (0, 3.157, 0), "q4_stage2": (0, 0, -np.pi / 2), "q5": (-0.213, 0, -np.pi / 2),
    "q6": (0, 0, -np.pi / 2), "q7": (0, 0.578, 0),
}  # fmt: skip
HANGING = np.array([-np.pi / 2, 0.5, 0.2, 0.5, np.pi / 2 - 0.7, np.pi / 2, 0.0, 1.0])
AWAY = (5.0, -6.0, 0.0)  # a log that is in nobody's way


def place(q, diameter=0.55, log_pose=AWAY, cranes=CraneVectorEnv, **options):
    """One crane a row of q (N, 8). No rule ends an episode."""
    envs = cranes(len(q), env_threads=1, autoreset=False, **options)
    envs.reset(seed=0)
    put(envs, q, diameter, log_pose)
    return envs


def put(envs, q, diameter=0.55, log_pose=AWAY):
    n = len(q)
    log_pose = np.array(np.broadcast_to(log_pose, (n, 3)), float)
    envs.place(np.arange(n), q, log_pose, np.array(np.broadcast_to(diameter, n), float))


def hold(envs, actions, steps):
    for _ in range(steps):
        info = envs.step(np.broadcast_to(actions, (envs.num_envs, 6)))[-1]
    return info


def grasp_start():
    """q and log pose with the open grapple hanging square over a log, just able to close."""
    q, lengths = HANGING.copy(), np.linspace(0.05, 2.2, 4000)
    out, up = crane_env.tip_position(q[1], q[2], lengths)
    k = np.argmax(up <= 0.9 + 0.578 + 0.213)
    q[3], q[7] = lengths[k], 0.05
    return q, (0.0, -out[k], q[0] - q[6])


def test_forward_kinematics_is_the_dh_product():
    model = CraneVectorEnv(1).model
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(300):
        frame, q4 = np.eye(4), rng.uniform(0, 2.236)
        frame[2, 3] = 1.1407
        for name in DH:
            data.joint(name).qpos = q4 if "q4" in name else rng.uniform(*model.joint(name).range)
        mujoco.mj_kinematics(model, data)
        for k, (name, (a, d, alpha)) in enumerate(DH.items()):
            q = data.joint(name).qpos[0]
            theta, d = (0, d + q) if "q4" in name else (q, d)
            ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
            rows = [ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st]
            frame = frame @ [*rows, [0, sa, ca, d], [0, 0, 0, 1]]
            body = data.body(f"K{k + 1}")
            np.testing.assert_allclose(body.xpos, frame[:3, 3], atol=1e-9)
            np.testing.assert_allclose(body.xmat.reshape(3, 3), frame[:3, :3], atol=1e-9)
        centre = frame @ [0, 0, 0.5, 1]
        np.testing.assert_allclose(data.site("grapple_centre").xpos, centre[:3], atol=1e-9)
        q1, q2, q3 = data.qpos[:3]
        out, up = crane_env.tip_position(q2, q3, q4)
        tip = [out * np.cos(q1), out * np.sin(q1), up]
        np.testing.assert_allclose(data.site("tip").xpos, tip, atol=1e-9)


def test_poses_of_the_real_crane_and_its_jaws():
    """One hangs within 4 degrees. Jaws: tips 2.38 m apart when open, meeting at 1.97 rad."""
    model = CraneVectorEnv(1).model
    mass = model.body_subtreemass[model.body("base").id]
    assert mass == pytest.approx(1985.28, abs=0.01)  # the paper: "approximately 1981 kg"
    data = mujoco.MjData(model)
    data.qpos[:7] = -0.48, 0.736, -0.303, 0.428, 0.428, 1.179, 1.525
    mujoco.mj_kinematics(model, data)
    k8 = data.body("K8")
    assert np.degrees(np.arccos(-k8.xmat[8])) < 4
    for q8, width in [(0.0, 2.378), (np.pi / 2, 0.665), (1.97, 0.0)]:
        data.joint("q8").qpos = data.joint("q8_inner").qpos = q8
        mujoco.mj_kinematics(model, data)
        tips = [jaw.xpos + jaw.xmat.reshape(3, 3) @ [0.8566, 0, 0]
                for jaw in (data.body("jaw_outer"), data.body("jaw_inner"))]  # fmt: skip
        (_, left, depth), (_, right, same) = (tips - k8.xpos) @ k8.xmat.reshape(3, 3)
        assert abs(right - left - width) < 0.01
        assert depth == pytest.approx(0.8566 * np.sin(q8)) and depth == pytest.approx(same)


@pytest.mark.parametrize("index, joint, damping, friction", [(4, "q5", 15, 10), (5, "q6", 20, 5)])
def test_small_swing_is_that_of_a_damped_compound_pendulum(index, joint, damping, friction):
    """Its Coulomb friction aside, which holds it within friction / stiffness of its rest."""

    class Frictionless(CraneVectorEnv):
        def make_spec(self):
            spec = super().make_spec()
            spec.joint("q5").frictionloss = spec.joint("q6").frictionloss = 0
            return spec

    envs = place(HANGING[None], cranes=Frictionless)
    hold(envs, np.zeros(6), 600)  # a minute, until it hangs still
    model, data, rest = envs.batch.get_model(0), envs.batch.get_data(0), envs.state().q
    mujoco.mj_forward(model, data)
    axis, anchor = data.joint(joint).xaxis, data.joint(joint).xanchor
    inertia, torque_arm, moving = 0.0, np.zeros(3), {model.joint(joint).bodyid[0]}
    for body in range(model.nbody):
        if body in moving or model.body_parentid[body] in moving:
            moving.add(body)
            arm, mass = data.xipos[body] - anchor, model.body_mass[body]
            local = data.ximat[body].reshape(3, 3).T @ axis
            inertia += mass * np.sum(np.cross(axis, arm) ** 2)
            inertia += local @ (model.body_inertia[body] * local)
            torque_arm += mass * arm
    stiffness = 9.81 * np.linalg.norm(np.cross(axis, torque_arm))
    period = 2 * np.pi / np.sqrt(stiffness / inertia - (damping / (2 * inertia)) ** 2)

    off = np.eye(8)[index : index + 1]
    fine = place(rest + 0.05 * off, cranes=Frictionless, frame_skip=1)
    angles = [fine.step(np.zeros((1, 6)))[0][0, index] for _ in range(1200)] - rest[0, index]
    k = np.flatnonzero((angles[:-1] > 0) != (angles[1:] > 0))[:4]
    crossings = 0.005 * (k + angles[k] / (angles[k] - angles[k + 1]))
    assert 2 * np.mean(np.diff(crossings)) == pytest.approx(period, rel=0.02)
    first, *_, last = (np.abs(angles[a:b]).max() for a, b in pairwise(k))  # a period apart
    assert last / first == pytest.approx(np.exp(-damping * period / (2 * inertia)), abs=0.01)

    starts = rest + friction / stiffness * np.array([[0.5], [3.0]]) * off
    held = place(starts)
    hold(held, np.zeros(6), 10)
    moved = np.abs(held.state().q - starts)[:, index]
    assert moved[0] < 0.2 * friction / stiffness < moved[1]


def test_each_servo_settles_on_its_command():
    """Within 2 % of its limit, in both directions; both stages and both jaws, through reversals."""
    q = np.tile(HANGING, (12, 1))
    q[:, 1], q[:, 4] = 0.9, np.pi / 2 - 1.1  # high above the ground
    envs, actions = place(q), np.repeat(np.eye(6), 2, axis=0) * np.tile([[1], [-1]], (6, 1))
    fast = [[0.802, 0.239, 0.326, 0.4, 2.12, 1.8], [0.764, 0.326, 0.344, 0.63, 2.12, 1.8]]
    expected = actions * np.tile(fast, (6, 1))
    for sign, joints in ((1, range(12)), (-1, [4, 5, 6, 7])):
        hold(envs, sign * actions, 5)
        error = np.abs(envs.state().dq - expected) / fast[0]
        assert sign < 0 or error.max() < 0.02
        assert np.abs(envs.qpos[:, 3] - envs.qpos[:, 4]).max() < 0.02
        assert np.abs(envs.qpos[joints, 8] - envs.qpos[joints, 9]).max() < 0.05


def test_resting_in_an_end_stop_ends_no_episode():
    """Five seconds of full command into soft stops: they give, but less than the rules allow."""
    each, joint, end = np.arange(6), np.array([0, 0, 1, 2, 3, 3]), np.array([0, 1, 1, 1, 0, 1])
    q, outward = np.tile(HANGING, (6, 1)), 2.0 * end - 1
    stop = CraneVectorEnv(1).joint_range[joint, end]
    q[each, joint] = stop - outward * [0.03, 0.03, 0.1, 0.1, 0.1, 0.1]
    q[2, 2], q[3, 1], q[4:, 1:3] = -0.4, 0.05, [0.9, 0.6]  # other joints, out of the way
    q[:, 4] = np.pi / 2 - q[:, 1] - q[:, 2]
    out, _ = crane_env.tip_position(*q[:, 1:4].T)  # logs below the grapples, within reach
    envs = place(q, log_pose=np.stack([out * np.cos(q[:, 0]), out * np.sin(q[:, 0]), 0 * out], 1))
    beyond = []
    for _ in range(50):
        info = hold(envs, outward[:, None] * np.eye(6)[joint], 1)
        assert (info["termination"] == "none").all()
        beyond.append(outward * (envs.state().q[each, joint] - stop))
    assert np.min(beyond[-20:]) > 0  # in the stop, not on the way to it
    assert 0.012 < np.max(beyond) < envs.LIMIT_TOLERANCE


@pytest.mark.parametrize("cranes, drift", [(CraneVectorEnv, 2e-4), (HydraulicCraneVectorEnv, 0.02)])
def test_an_idle_crane_stays(cranes, drift):
    """Its integrators start with the static load."""
    envs = cranes(16, autoreset=False, env_threads=1)
    envs.reset(seed=3)
    before = envs.state().q[:, ACTUATED]
    hold(envs, np.zeros(6), 90)
    assert np.abs(envs.state().q[:, ACTUATED] - before).max() < drift


def test_a_held_log_does_not_sag():
    """Less than 2 cm in 20 s at zero command."""
    q, log_pose = grasp_start()
    envs = place(np.tile(q, (3, 1)), [0.3, 0.5, 0.8], log_pose)
    for count, joint, action in [(16, 5, 1.0), (30, 1, 1.0), (40, 1, 0.0)]:
        hold(envs, action * np.eye(6)[joint], count)
    height = envs.state().log_centre[:, 2]
    assert log_clearance(envs.state()).min() > 0.3
    hold(envs, np.zeros(6), 200)
    assert np.abs(envs.state().log_centre[:, 2] - height).max() < 0.02
    assert envs.state().touching.all()


def test_capsules_and_signed_distance_fields_touch_alike():
    """Contact starts within 2 cm of closing, at the tips; thick logs are touched sooner."""
    touched = {}
    for contact in ("primitive", "sdf"):
        model = CraneVectorEnv(1, contact=contact).model
        for diameter in (0.3, 0.55, 0.8):
            log, capsule = model.geom("log"), model.geom("log_capsule")
            log.size[0] = capsule.size[0] = diameter / 2
            capsule.size[1] = 2.75 / 2 - diameter / 2
            data = mujoco.MjData(model)
            mujoco.mj_setConst(model, data)
            data.qpos[JOINTS], data.joint("q4_stage2").qpos = HANGING, HANGING[3]
            mujoco.mj_kinematics(model, data)
            frame, pose = data.body("K8").xmat.reshape(3, 3), data.joint("log").qpos
            pose[:3] = data.body("K8").xpos + frame @ [0, 0, 0.15 + diameter / 2]
            mujoco.mju_mat2Quat(pose[3:], frame[:, [1, 2, 0]].ravel())
            q8, touches = 1.2, [False]
            while not any(touches):
                data.joint("q8").qpos = data.joint("q8_inner").qpos = q8 = q8 + 0.002
                mujoco.mj_forward(model, data)
                touches = [data.sensor(name).data[0] for name in ("outer_touch", "inner_touch")]
            touched[contact, diameter] = q8
    for diameter in (0.3, 0.55, 0.8):
        angle = touched["primitive", diameter] - touched["sdf", diameter]
        assert abs(angle) * 0.8566 < 0.02
    assert touched["sdf", 0.8] + 0.2 < touched["sdf", 0.3]


@pytest.mark.parametrize("where, bit, deepest", [("ground", 1, 0.05), ("truck", 2, 0.08)])
def test_the_crane_passes_through_nothing(where, bit, deepest):
    q, actions, touched = HANGING[None].copy(), [0.0, -1.0, 0.0, 1.0, 0.0, 0.0], set()
    if where == "truck":  # folded: the grapple hangs at 1.2 m, and turns towards the cab
        q[:, 1:5], actions = [0.5, -0.9, 0.1, np.pi / 2], np.eye(6)[0]
    envs = place(q)
    for _ in range(50):
        hold(envs, actions, 1)
        model, data = envs.batch.get_model(0), envs.batch.get_data(0)
        mujoco.mj_forward(model, data)
        for contact in data.contact:
            bits = {int(model.geom_contype[geom]) for geom in contact.geom}
            if 0 in bits and model.geom("log").id not in contact.geom:  # of the crane
                touched |= bits
                assert contact.dist > -deepest
    assert bit in touched


WILD = [
    (CraneVectorEnv, 32, 120, {"pose_noise": "step"}),
    (HydraulicCraneVectorEnv, 32, 120, {"randomize": 1.0}),
    (CraneVectorEnv, 8, 40, {"contact": "sdf"}),
]


@pytest.mark.parametrize("cranes, n, steps, options", WILD)
def test_nothing_diverges(cranes, n, steps, options):
    """Bang-bang actions, past all rules; a third of the cranes grip a log and swing it about."""
    envs, rng = cranes(n, autoreset=False, **options), np.random.default_rng(5)
    envs.reset(seed=5)
    q, log_pose = grasp_start()
    bang, held = np.ones((n, 6)), np.zeros(n, bool)
    for k in range(steps):
        if k % 40 == 0:
            grip = np.flatnonzero(rng.random(n) < 1 / 3)
            starts = np.tile(q, (len(grip), 1)), np.tile(log_pose, (len(grip), 1))
            envs.place(grip, *starts, rng.uniform(0.3, 0.8, len(grip)))
        bang = np.where(rng.random((n, 6)) < 0.1, -bang, bang)
        actions = np.where(rng.random((n, 1)) < 0.5, 1.5 * bang, rng.uniform(-1, 1, (n, 6)))
        actions[grip, :5] *= k % 40 > 15
        actions[grip, 1], actions[grip, 5] = np.abs(actions[grip, 1]), 1.0
        obs, reward, *_, info = envs.step(actions)
        assert obs in envs.observation_space and np.isfinite(reward).all()
        assert not info["diverged"].any() and not envs.batch.warning[:, :, 1].any()
        held |= (info["clearance"] > 0.1) & envs.state().touching.all(axis=-1)
    assert held.sum() > n / 8


def test_committed_meshes_are_what_the_script_writes():
    path = crane_env.MODEL_PATH.parent / "make_meshes.py"
    spec = importlib.util.spec_from_file_location("make_meshes", path)
    make_meshes = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make_meshes)
    for name, sections in make_meshes.PIECES.items():
        written = (path.parent / f"jaw_{name}.obj").read_text(encoding="utf-8")
        assert make_meshes.piece(*sections) == written


def test_import_without_opengl():
    """Training needs no graphics: the module must load where EGL is missing."""
    code = "import ctypes.util; ctypes.util.find_library = lambda name: None; import crane_env"
    command = [sys.executable, "-c", code + "; crane_env.CraneEnv().reset(seed=0)"]
    subprocess.run(command, cwd=crane_env.MODEL_PATH.parents[1], env={}, check=True)
