"""The machine: the crane's model, and drives as measured on the real one (the jaws' are estimated).

A commanded speed passes the lag of a valve, the limit of the pump and a dead time. The resulting
speed moves the rest position of a spring. The force of the spring is limited and drives a damped
joint.
`crane_env` simulates this with actuators="hydraulic". Sources of all numbers: assets/README.md.
"""

from pathlib import Path

import mujoco
import numpy as np
from numpy import ndarray as Array
from numpy.random import Generator

import crane_world
from crane_task import GENTLE_FORCE

MODEL_PATH = Path(__file__).parent / "assets" / "crane.xml"
TIMESTEP = 0.005  # s, one physics step (paper, Sec. V)
SDF_INITPOINTS, SDF_ITERATIONS = 8, 5  # of each search for SDF contacts (assets/README.md)
SPEEDS = {  # lowest and highest of (q1, q2, q3, q4, q7, q8): rad/s, per telescope stage m/s
    "real": np.array(
        [[-0.764, -0.326, -0.344, -0.630, -2.12, -1.8], [0.802, 0.239, 0.326, 0.400, 2.12, 1.8]]
    ),
    "mjcf": np.array([[-1.57, -1.57, -1.57, -2, -3, -3], [1.57, 1.57, 1.57, 2, 3, 3]]),
}
# The engine's joints are q1 q2 q3 q4 q4_stage2 q5 q6 q7 q8 q8_inner, then the log. JOINTS are the
# indices of our q1 ... q8 among them.
JOINTS = [0, 1, 2, 3, 5, 6, 7, 8]
SERVOS = [0, 1, 2, 3, 4, 7, 8, 9]  # the engine's joints that a servo moves
COMMAND_OF_SERVO = [0, 1, 2, 3, 3, 4, 5, 5]
FIRST_SERVO = [0, 1, 2, 3, 5, 6]  # of each command: the first telescope stage, the outer jaw
ACTUATED = [0, 1, 2, 3, 6, 7]  # of our q1 ... q8
PASSIVE = [4, 5]  # of our q1 ... q8

# Six numbers belong to q1, q2, q3, each telescope stage, q7 and q8.
STIFFNESS = np.array([2.19e5, 1.50e6, 1.73e6, 1.40e5, 1.23e4, 2.5e4])  # N m/rad, N/m
DAMPING = np.array([1.12e4, 6.63e4, 3.88e4, 9.4e3, 757.0, 3.4e3])  # N m s/rad, N s/m
LAG = np.array([0.007, 0.026, 0.069, 0.008, 0.130, 0.130])  # s, of the valve, first order
DEAD_TIME = np.array([0.117, 0.080, 0.044, 0.060, 0.058, 0.058])  # s
BREAKAWAY = 0.10  # s that the load-holding valve of a resting telescope takes to open
MAX_DELAY = 32  # physics steps that the engine remembers commands for the dead time
VALVE_STEPS = 4  # physics steps between two looks of the valves at the command
PUMP_FLOW = 0.95 * 1.4e-3  # m^3/s, shared by all joints
MIN_LEVER = 0.05  # m; below q2 = -1.13 rad the boom's computed lever is smaller or negative
# Oil per joint movement at -1 and +1, m^3/rad, m^3/m; of q2 and q3 per metre of their cylinders.
# The oil of the telescope's rod side helps to extend it. q8 moves its cylinder 0.292 m in 3 rad.
OIL = np.array(
    [[12.724e-4, 9.032e-3, 5.026e-3, 2.592e-3, 1.4324e-4, 4.61e-4],
     [12.724e-4, 15.394e-3, 12.724e-3, 1.257e-3, 1.4324e-4, 7.64e-4]]
)  # fmt: skip
LOG_DENSITY = 650.0  # kg/m^3
# What randomize=1 draws at each start: nominal, lowest and highest value. Bands of stiffness and
# damping are wide, so their logarithms are uniform. All else is uniform.
DRAWN = {
    "stiffness": (
        STIFFNESS,
        np.array([2.01e5, 1.28e6, 2.89e5, 1.05e5, 2.55e3, 1.25e4]),
        np.array([3.99e5, 2.75e6, 1.73e6, 2.63e6, 1.24e4, 5.0e4]),
    ),
    "damping": (
        DAMPING,
        np.array([6.32e3, 6.62e4, 3.29e4, 8.03e3, 62.9, 2.7e3]),
        np.array([1.65e4, 3.81e5, 7.05e4, 1.61e5, 1596.0, 4.3e3]),
    ),
    "extra_delay": (0.0, -0.02, 0.02),  # s, added to the dead time of all joints
    "gain": (  # factor on the speed, in the negative and the positive direction
        np.ones((2, 6)),
        np.tile([0.98, 0.93, 0.95, 0.90, 1.05, 0.9], (2, 1)),
        np.tile([1.02, 1.15, 1.20, 1.25, 1.20, 1.1], (2, 1)),
    ),
    "density": (LOG_DENSITY, 450.0, 950.0),  # kg/m^3
    "friction": (1.0, 0.5, 1.5),  # factor on that of all surfaces
    "pose_error": (np.zeros(3), np.full(3, -0.057), np.full(3, 0.057)),  # m, 0.1 m at most
    "yaw_error": (0.0, -0.1745, 0.1745),  # rad
    "joint_error": (np.zeros(8), -0.0087 * (np.arange(8) != 3), 0.0087 * (np.arange(8) != 3)),
    "swing": (np.zeros(2), np.full(2, -0.1745), np.full(2, 0.1745)),  # rad, of q5 and q6
}
OF_DRIVES = {"stiffness", "damping", "extra_delay", "gain"}  # of DRAWN; the ideal crane has none
MOVING = 0.01  # share of its speed limit below which a joint only trembles
COSTS = ["ground_peak", "ground_impulse", "ground_time", "litres", "energy", "work", "swing_peak"]


def load_model(
    contact: str = "primitive",
    integrator: str = "implicitfast",
    solver: str = "Newton",
    actuators: str = "ideal",
    visual: bool = True,
) -> mujoco.MjModel:
    """Compile assets/crane.xml.

    actuators "ideal": PI velocity servos. "hydraulic": the drives identified on the machine.
    contact "primitive": capsule chains for the jaws against a capsule for the log. "sdf": the
    jaws' meshes as signed distance fields against the log's cylinder (paper, Sec. III-B).
    visual False leaves out what is only drawn: the same motion, sooner.
    """
    if not MODEL_PATH.is_file():
        raise FileNotFoundError(f"no {MODEL_PATH}: install with pip install -e, not without -e")
    spec = mujoco.MjSpec.from_file(str(MODEL_PATH))
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    spec.option.solver = getattr(mujoco.mjtSolver, f"mjSOL_{solver.upper()}")
    spec.option.sdf_initpoints, spec.option.sdf_iterations = SDF_INITPOINTS, SDF_ITERATIONS
    if contact == "sdf":
        # Collision bits of crane.xml: 4 is the log's. 8 collides with nothing, but a geom without
        # any bit counts as only drawn.
        spec.geom("log").contype, spec.geom("log_capsule").contype = 4, 8
        for geom in spec.geoms:
            if geom.classname.name == "jaw_mesh":
                geom.type, geom.conaffinity = mujoco.mjtGeom.mjGEOM_SDF, 4
            elif geom.classname.name == "jaw_collision":
                geom.conaffinity &= ~4
    if actuators == "hydraulic":
        install_drives(spec)
    if visual:
        crane_world.decorate(spec)
    spec.compiler.discardvisual = not visual
    return spec.compile()


def install_drives(spec: mujoco.MjSpec) -> None:
    """Turn the servos of assets/crane.xml into drives."""
    spec.sensor("ground_force").nsample = VALVE_STEPS  # crane_env counts costs after so many steps
    for index, command in zip(SERVOS, COMMAND_OF_SERVO):
        joint = spec.joints[index]
        joint.damping[0] = DAMPING[command]
        spec.actuator(joint.name).gainprm[0] = spec.actuator(joint.name).biasprm[2] = 0
        spring = spec.actuator(f"{joint.name}_integral")
        spring.gainprm[0], spring.biasprm[1] = STIFFNESS[command], -STIFFNESS[command]
        spring.delay, spring.nsample = DEAD_TIME[command], MAX_DELAY


def speed_limit(command: Array, speed: Array) -> Array:
    """Speed limit, positive, in the direction of each command (N, 6); speed as in SPEEDS."""
    return np.where(command < 0, -speed[0], speed[1])


def cylinder_levers(q2: Array, q3: Array) -> Array:
    """Metres that boom and arm cylinder lengthen per radian of q2 and q3, (2, N).

    The arm's cylinder pushes the arm itself. The boom's pushes the joint of two bars, 0.57 m to
    the column and 0.124 m to the boom.
    """

    def boom(q: Array) -> Array:
        q = np.maximum(q, -1.18)  # lower, the bars do not reach each other
        x, y = 0.4539 * np.cos(q) + 0.036 * np.sin(q) + 0.12, 0.4539 * np.sin(q) - 0.036 * np.cos(q)
        y = y + 0.07  # from the bars' pivot on the column to that on the boom
        apart = np.hypot(x, y)
        along = (0.57**2 - 0.124**2 + apart**2) / (2 * apart)
        across = np.sqrt(np.maximum(0.57**2 - along**2, 0))
        foot_x, foot_y = 0.553, -1.6982  # of the cylinder, from the same pivot
        knee_x, knee_y = (along * x + across * y) / apart, (along * y - across * x) / apart
        return np.hypot(knee_x - foot_x, knee_y - foot_y)

    def arm(q: Array) -> Array:
        x, y = -0.118 * np.cos(q) + 0.468 * np.sin(q), -0.118 * np.sin(q) - 0.468 * np.cos(q)
        return np.hypot(x + 1.6802, y + 0.0485)

    step = 1e-4
    levers = [(f(q + step) - f(q - step)) / (2 * step) for f, q in ((boom, q2), (arm, q3))]
    return np.maximum(levers, MIN_LEVER)


def oil_per_movement(q: Array, dq: Array) -> Array:
    """Oil that each joint takes, m^3/rad and m^3/m, (N, 6), at q (N, ...), moving as dq (N, 6)."""
    oil = np.where(dq < 0, OIL[0], OIL[1])
    oil[:, 1:3] *= cylinder_levers(q[:, 1], q[:, 2]).T
    return oil


def draw_machine(rng: Generator, share: float) -> dict[str, Array]:
    """A machine, a log and sensors as DRAWN says. share 0 gives the nominal ones."""
    machine = {}
    for name, (nominal, low, high) in DRAWN.items():
        if name in ("stiffness", "damping"):
            drawn = np.exp(rng.uniform(np.log(low), np.log(high)))
        else:
            drawn = rng.uniform(low, high)
        machine[name] = nominal + share * (drawn - nominal)
    return machine


class Valves:
    """Valves and pump of N cranes: from commanded speeds to the speeds that the oil gives."""

    def __init__(self, num_envs: int):
        self.speed = np.zeros((num_envs, 6))  # rad/s, m/s, that the valves let through
        self.telescope_wait = np.zeros(num_envs)  # s since a resting telescope was commanded

    def close(self, ids: Array) -> None:
        """Valves of cranes `ids` as in a crane at rest."""
        self.speed[ids] = self.telescope_wait[ids] = 0

    def mean_speed(self, ids: Array, command: Array, q: Array, seconds: float) -> Array:
        """Mean speed (n, 6), rad/s and m/s, that the oil gives cranes `ids` in the next seconds.

        command (n, 6) in rad/s and m/s, q (n, ...) the joints, rad and m. A valve follows its
        command as a first-order lag. A resting telescope's load-holding valve opens late. If the
        joints together ask for more oil than the pump gives, each gets the same share of what it
        asks for.
        """
        speed, telescope = self.speed[ids], command[:, 3]
        resting = (np.abs(speed[:, 3]) < 1e-3) & (np.abs(telescope) >= 1e-3)
        self.telescope_wait[ids] = np.where(resting, self.telescope_wait[ids] + seconds, 0.0)
        closed = resting & (self.telescope_wait[ids] <= BREAKAWAY)
        target = command.copy()
        target[closed, 3] = 0.0
        decay = np.exp(-seconds / LAG)
        mean = target + (speed - target) * LAG / seconds * (1 - decay)
        self.speed[ids] = target + (speed - target) * decay
        demand = np.sum(oil_per_movement(q, mean) * np.abs(mean), axis=-1, keepdims=True)
        return mean * np.minimum(1, PUMP_FLOW / np.maximum(demand, 1e-9))


class Costs:
    """What the episodes of N cranes have cost so far, and how hard the last decision hit."""

    def __init__(self, num_envs: int):
        self.total = {name: np.zeros(num_envs) for name in COSTS}
        self.impact = np.zeros(num_envs)  # N, largest force on the ground in the last decision

    def clear(self, ids: Array) -> None:
        """New episodes of cranes `ids`."""
        for cost in (self.impact, *self.total.values()):
            cost[ids] = 0.0

    def add(self, ground: Array, q: Array, dq: Array, force: Array, seconds: float) -> None:
        """Add the costs of the last seconds.

        ground (N, k) in N at each of the last k physics steps. All else is of the last one:
        q (N, 8), dq (N, 6) and force (N, 6) of the drives, in rad, m, s, N m and N. The pump gives
        every joint its oil, at the pressure that the hardest of those that move needs. At their
        force limits boom, arm, telescope and jaws can need more than the pump's 25 MPa.
        """
        oil = oil_per_movement(q, dq)
        flow = np.sum(oil * np.abs(dq), axis=-1)
        moving = np.abs(dq) > MOVING * np.minimum(*np.abs(SPEEDS["real"]))
        pressure = np.max(np.maximum(force * np.sign(dq) / oil, 0) * moving, axis=-1)
        swing = np.hypot(q[:, 4] - np.pi / 2 + q[:, 1] + q[:, 2], q[:, 5] - np.pi / 2)
        self.impact = np.maximum(self.impact, ground.max(axis=-1))
        total = self.total
        total["ground_peak"] = np.maximum(total["ground_peak"], self.impact)
        total["ground_impulse"] += ground.mean(axis=-1) * seconds
        total["ground_time"] += (ground > GENTLE_FORCE).mean(axis=-1) * seconds
        total["litres"] += 1000 * flow * seconds
        total["energy"] += flow * pressure * seconds
        total["work"] += np.sum(np.abs(force * dq), axis=-1) * seconds
        total["swing_peak"] = np.maximum(total["swing_peak"], swing)
