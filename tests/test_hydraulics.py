"""The machine's drives: measured step responses, oil, pressure, the pump, and what they cost."""

import mujoco
import numpy as np
import pytest
from test_physics import hold, place

import hydraulic_crane as hydraulic
from benchmark.figures import AXES, INSTANTS, response
from crane_env import SERVOS, CraneVectorEnv
from crane_utils.metrics import Metrics
from hydraulic_crane import HydraulicCraneVectorEnv

# how far this model is from the machine's records (assets/README.md, Drives)
FIT = {"slew": 0.16, "boom": 0.09, "arm": 0.13, "telescope": 0.14, "rotator": 0.02}
AREAS = np.array([  # m^3/rad, m^3/m, or m^2 of a cylinder, at -1 and +1
    [12.724e-4, 9.032e-3, 5.026e-3, 2.592e-3, 1.4324e-4, 4.61e-4],
    [12.724e-4, 15.394e-3, 12.724e-3, 3.849e-3, 1.4324e-4, 7.64e-4],
])  # fmt: skip


def standing(q2, q3, q4, q8, n=1, cranes=HydraulicCraneVectorEnv, **options):
    """Plumb cranes with logs out of the way."""
    q = np.array([-1.2, q2, q3, q4, np.pi / 2 - q2 - q3, np.pi / 2, 0.0, q8])
    return place(np.tile(q, (n, 1)), 0.3, cranes=cranes, **options)


@pytest.mark.parametrize("step, worse", [(0.005, 0.005), (0.01, 0.06)])  # the task's, training's
@pytest.mark.parametrize("axis", FIT)
def test_a_step_of_the_command_is_answered_as_the_machine_answers(axis, step, worse):
    """Both ways, as close at every listed instant as documented."""
    measured, *_ = AXES[axis]
    at = np.round(INSTANTS[: len(measured)] / step).astype(int) - 1
    for action in (-0.4, 0.4):
        answer = response(axis, action, step=step)
        assert len(answer) == round(1.25 / step)
        assert np.abs(answer[at] - measured).max() < FIT[axis] + worse


@pytest.mark.parametrize("step", [0.005, 0.001])
def test_nothing_moves_within_the_dead_time(step):
    """A telescope at rest waits for its load-holding valve, too."""

    class Edited(HydraulicCraneVectorEnv):
        def make_spec(self):
            spec = super().make_spec()
            spec.option.timestep = step
            return spec

    envs = standing(0.8, 0.3, 0.5, 0.3, cranes=Edited, frame_skip=round(0.005 / step))
    moved = np.zeros(6)
    before = envs.act[0].copy()
    for k in range(1, 45):
        hold(envs, np.full(6, 0.3), 1)
        started = np.abs(envs.act[0] - before)[[0, 1, 2, 3, 5, 6]] > 1e-9
        moved = np.where((moved == 0) & started, 0.005 * k, moved)
    late = np.array([0.117, 0.080, 0.044, 0.060 + 0.1, 0.058, 0.058])
    assert (moved > late).all() and (moved <= late + 0.03).all()


@pytest.mark.parametrize("step", [0.005, 0.01])
def test_a_longer_dead_time_is_not_cut(step, monkeypatch):
    monkeypatch.setattr(hydraulic, "DEAD_TIME", np.full(6, 0.3))
    envs = standing(0.8, 0.3, 0.5, 0.3, frame_skip=2, physics_step=step)
    before = envs.act[0, 0]
    hold(envs, np.eye(6)[0], 29)
    assert envs.act[0, 0] == pytest.approx(before, abs=1e-9)
    hold(envs, np.eye(6)[0], 4)
    assert envs.act[0, 0] > before + 1e-3


def test_the_pump_shares_its_oil():
    """All joints at full speed ask for more than it gives: each gets the same fraction."""
    envs = HydraulicCraneVectorEnv(1, env_threads=1)
    envs.reset(seed=0)
    full = np.array([[0.802, 0.239, 0.326, 0.400, 2.12, 1.8]])
    envs.valve_speed[:] = full
    given = envs.oil_speed(np.arange(1), full, 0.02)
    oil = hydraulic.oil_per_movement(envs.levers, given, np.zeros((1, 6)))
    assert np.ptp(given / full) < 1e-9 and np.sum(oil * given) == pytest.approx(1.33e-3)


def test_levers_of_the_cylinders():
    """The arm's is that of the drawn cylinder; the boom's never vanishes where it can go."""
    model = CraneVectorEnv(1, render_mode="rgb_array").model
    data, tendon = mujoco.MjData(model), model.tendon("arm_cylinder").id
    for q3 in np.linspace(-0.91, 1.5, 9):
        lengths = []
        for data.joint("q3").qpos in (q3 - 1e-4, q3 + 1e-4):
            mujoco.mj_fwdPosition(model, data)
            lengths.append(data.ten_length[tendon])
        _, (lever,) = hydraulic.cylinder_levers(np.zeros(1), np.array([q3]))
        assert lever == pytest.approx(np.diff(lengths)[0] / 2e-4, rel=1e-3)
    boom, _ = hydraulic.cylinder_levers(np.linspace(-1.25, 1.563, 99), np.zeros(99))
    assert (0.05 <= boom).all() and (boom < 0.5).all() and boom[20:].min() > 0.2


@pytest.mark.parametrize("randomize", [0.0, 1.0])
def test_no_axis_pushes_with_more_than_its_area_times_25_mpa(randomize):
    """At any physics step, whichever machine is drawn and whatever it is told."""
    envs, rng = HydraulicCraneVectorEnv(32, randomize=randomize), np.random.default_rng(0)
    drive_force, shares = envs.batch.bind("qfrc_actuator"), []

    def watch(crane):
        q1, q2, q3, stage_1, stage_2, q7, q8, inner = drive_force[:, SERVOS].T
        force = np.stack([q1, q2, q3, stage_1 + stage_2, q7, q8 + inner], axis=1)
        areas = np.where(force < 0, AREAS[0], AREAS[1])
        areas[:, 1:3] *= hydraulic.cylinder_levers(*crane.qpos[:, 1:3].T).T
        shares.append((np.abs(force) / areas).max(axis=0) / 25e6)

    envs.observers.append(watch)
    envs.reset(seed=0)
    for _ in range(6):
        hold(envs, np.sign(rng.uniform(-1, 1, (32, 6))), 10)
    most = np.max(shares, axis=0)
    assert (most < 1.02).all() and most[[3, 5]].min() > 0.98  # as levers 20 ms ago allowed


# ---- what it costs


def test_oil_and_energy_of_a_lift():
    """A slow boom gains potential energy: that is what the pump gives. Oil fills its cylinder."""
    envs = standing(0.7, 0.3, 0.5, 0.3, cranes=CraneVectorEnv)
    metrics, boom = Metrics(envs), [0.7]

    def potential():
        model, data = envs.batch.get_model(0), envs.batch.get_data(0)
        mujoco.mj_forward(model, data)
        mujoco.mj_energyPos(model, data)
        return data.energy[0]

    before, costs = potential(), metrics.values
    for _ in range(50):
        hold(envs, 0.2 * np.eye(6)[1], 1)
        boom.append(envs.qpos[0, 1])
    lever, _ = hydraulic.cylinder_levers(np.array(boom), np.zeros(51))
    length = np.sum(np.diff(boom) * (lever[1:] + lever[:-1]) / 2)
    assert costs["energy"][0] == pytest.approx(potential() - before, rel=0.05)
    assert costs["litres"][0] == pytest.approx(15.394 * length, rel=0.02)
    assert potential() - before > 5e3 and 0 < costs["swing_peak"][0] < 0.2
