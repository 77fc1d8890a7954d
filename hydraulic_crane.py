"""Beyond the paper: the crane with hydraulic drives that imitate measurements, and randomization.

    import gymnasium
    envs = gymnasium.make_vec("crane_env:ForestryCraneHydraulic-v0", num_envs=64)

The task is that of crane_env.py, and this file overrides its hooks: it is also the example of a
task of one's own. A commanded speed passes the lag of a valve, the limit of the pump and a dead
time. The resulting speed moves the rest position of a spring. Its force, limited by the pump's
pressure, drives a damped joint. In `ForestryCraneRandomized-v0` each episode draws drives, a log,
friction and sensor errors. Sources of all numbers: assets/README.md.

With `sensors` the observation has 32 numbers, what the machine measures:

| index  | meaning                                                        | unit  | low, high |
|--------|----------------------------------------------------------------|-------|-----------|
| 0-17   | those of crane_env.py                                          |       |           |
| 18-23  | last command of q1, q2, q3, q4, q7, q8, fraction of its limit  | 1     | -1, 1     |
| 24-25  | velocities of q5, q6                                           | rad/s | -10, 10   |
| 26-31  | force of the oil on the same, fraction of its actuatorfrcrange | 1     | -1, 1     |
"""

from typing import Annotated, Any

import mujoco
import numpy as np
from numpy import ndarray as Array
from pydantic import Field
from pydantic.dataclasses import dataclass

import crane_env
from crane_env import ACTION_OF_SERVO, INTEGRATORS, SERVOS, CraneState, speed_limit

# ---- the drives; six numbers belong to q1, q2, q3, each telescope stage, q7 and q8

STIFFNESS = np.array([2.19e5, 1.50e6, 1.73e6, 1.40e5, 1.23e4, 2.5e4])  # N m/rad, N/m
DAMPING = np.array([1.12e4, 6.63e4, 3.88e4, 9.4e3, 757.0, 3.4e3])  # N m s/rad, N s/m
LAG = np.array([0.007, 0.026, 0.069, 0.008, 0.130, 0.130])  # s, of the valve, first order
DEAD_TIME = np.array([0.117, 0.080, 0.044, 0.060, 0.058, 0.058])  # s
BREAKAWAY = 0.10  # s that the load-holding valve of a resting telescope takes to open
PRESSURE = 25e6  # Pa, the pump's; no cylinder pushes harder than its area times this
MIN_LEVER = 0.05  # m; below q2 = -1.13 rad the boom's computed lever is smaller or negative
# Oil per joint movement at -1 and +1, m^3/rad, m^3/m; of q2 and q3 per metre of their cylinders.
# The oil of the telescope's rod side helps to extend it. q8 moves its cylinder 0.292 m in 3 rad.
OIL = np.array(
    [[12.724e-4, 9.032e-3, 5.026e-3, 2.592e-3, 1.4324e-4, 4.61e-4],
     [12.724e-4, 15.394e-3, 12.724e-3, 1.257e-3, 1.4324e-4, 7.64e-4]]
)  # fmt: skip
FULL_TELESCOPE = 3.849e-3  # m^3/m of the telescope's way out under a load too heavy for that
SERVOS_OF_ACTION = np.bincount(ACTION_OF_SERVO)  # how many share the force of the oil
FIRST_SERVO = [ACTION_OF_SERVO.index(k) for k in range(6)]  # of each command: stage 1, outer jaw
PASSIVE = [4, 5]  # of our q1 ... q8

# What randomize=1 draws at each start: nominal, lowest and highest value. Bands of stiffness and
# damping are wide: their logarithms are uniform. All else is uniform. joint_error: rad, not of q4.
DRAWN = {
    "stiffness": (STIFFNESS, [2.01e5, 1.28e6, 2.89e5, 1.05e5, 2.55e3, 1.25e4],
                  [3.99e5, 2.75e6, 1.73e6, 2.63e6, 1.24e4, 5.0e4]),
    "damping": (DAMPING, [6.32e3, 6.62e4, 3.29e4, 8.03e3, 62.9, 2.7e3],
                [1.65e4, 3.81e5, 7.05e4, 1.61e5, 1596.0, 4.3e3]),
    "extra_delay": (0.0, -0.02, 0.02),  # s, added to the dead time of all joints
    "gain": (np.ones((2, 6)), np.tile([0.98, 0.93, 0.95, 0.90, 1.05, 0.9], (2, 1)),
             np.tile([1.02, 1.15, 1.20, 1.25, 1.20, 1.1], (2, 1))),  # on speed, by direction
    "density": (crane_env.LOG_DENSITY, 450.0, 950.0),  # kg/m^3
    "friction": (1.0, 0.5, 1.5),  # factor on that of all surfaces
    "pose_error": (np.zeros(3), np.full(3, -0.057), np.full(3, 0.057)),  # m, 0.1 m at most
    "yaw_error": (0.0, -0.1745, 0.1745),  # rad
    "joint_error": (np.zeros(8), -0.0087 * (np.arange(8) != 3), 0.0087 * (np.arange(8) != 3)),
    "swing": (np.zeros(2), np.full(2, -0.1745), np.full(2, 0.1745)),  # rad, of q5 and q6
}  # fmt: skip
EMPTY_GRIP = 0.5  # share of r_grapple for closed jaws without a log; a grip earns all


@dataclass(config=crane_env.STRICT)
class Options(crane_env.Options):
    """Options of the hydraulic crane."""

    randomize: Annotated[float, Field(ge=0, le=1)] = 0.0  # width of what each episode draws
    sensors: bool = True  # also observe last command, rates of q5 and q6, oil forces


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


def oil_per_movement(levers: Array, dq: Array, force: Array) -> Array:
    """Oil that each joint takes, m^3/rad and m^3/m, (N, 6), moving as dq (N, 6).

    The same number times a pressure in Pa is the torque or force in that direction, in N m and N.
    force (N, 6) is that of the drives. A telescope that must push harder than PRESSURE allows with
    its rod side's oil fed back runs on its full area, and takes that oil.
    """
    oil = np.where(dq < 0, OIL[0], OIL[1])
    oil[:, 1:3] *= levers.T  # of `cylinder_levers`
    loaded = (dq[:, 3] >= 0) & (force[:, 3] > PRESSURE * OIL[1, 3])
    oil[loaded, 3] = FULL_TELESCOPE
    return oil


def grip_depth(state: CraneState) -> Array:
    """How far the tips of hanging jaws are below the log's centre, in radii of the log, (N,).

    Jaws that pinch a log above its centre squeeze it out.
    """
    pivots = state.grapple_centre[:, 2] + crane_env.PIVOT_HEIGHT
    tips = pivots - crane_env.JAW_LENGTH * np.sin(state.q[:, 7])
    return (state.log_centre[:, 2] - tips) / (state.diameter / 2)


class HydraulicCraneVectorEnv(crane_env.CraneVectorEnv):
    """N cranes with hydraulic drives. With randomize, `info` says in `drawn_...` what was drawn."""

    Options = Options
    REVISION = 8
    COARSE_HITS = 0.7
    PIECE = 0.02  # s between two looks of the valves at the command
    PUMP_FLOW = 0.95 * 1.4e-3  # m^3/s, shared by all joints (assets/README.md)
    GROUND_WEIGHT, GROUND_MOST = 90.0, 3.0

    def __init__(self, num_envs: int = 1, **kwargs: Any):
        super().__init__(num_envs, **kwargs)
        self.GROUND_WEIGHT /= 1 + self.options.randomize  # a more careful crane grips too high
        names = ["actuator_gainprm", "actuator_biasprm", "actuator_delay", "actuator_forcerange"]
        names += ["dof_damping", "geom_friction"]
        self.engine = {name: self.batch.expand(name) for name in names}
        self.drawn = {
            name: np.tile(nominal, (num_envs, *[1] * np.ndim(nominal)))
            for name, (nominal, _, _) in DRAWN.items()
        }
        self.valve_speed = np.zeros((num_envs, 6))  # rad/s, m/s, that the valves let through
        self.telescope_wait = np.zeros(num_envs)  # s since a resting telescope was commanded
        self.levers = np.zeros((2, num_envs))  # m/rad, of boom and arm cylinder

    # ---- the model and the start of an episode

    def make_spec(self) -> mujoco.MjSpec:  # the servos become drives
        spec = super().make_spec()
        for index, action in zip(SERVOS, ACTION_OF_SERVO):
            joint = spec.joints[index]
            spec.actuator(joint.name).gainprm[0] = spec.actuator(joint.name).biasprm[2] = 0
            spring = spec.actuator(f"{joint.name}_integral")
            spring.delay = DEAD_TIME[action]
            longest = DEAD_TIME[action] + DRAWN["extra_delay"][2]
            spring.nsample = int(longest / 1e-3) + 2  # for physics steps of 1 ms or more
            spring.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            spring.forcerange = joint.actfrcrange
        return spec

    def draw_episode(self, i: int) -> tuple[Array, Array, float]:
        """Also draw the machine, the log's density and the sensors' errors, as DRAWN says."""
        q, log_pose, diameter = super().draw_episode(i)
        if self.options.randomize:
            *_, rng = self.rngs[i]
            for name, (nominal, low, high) in DRAWN.items():
                if name in ("stiffness", "damping"):
                    drawn = np.exp(rng.uniform(np.log(low), np.log(high)))
                else:
                    drawn = rng.uniform(low, high)
                drawn = self.starts[i][3].setdefault(name, drawn)  # a repeated start's machine
                self.drawn[name][i] = nominal + self.options.randomize * (drawn - nominal)
        swing = np.zeros(8)
        swing[PASSIVE] = self.drawn["swing"][i]
        return q + swing, log_pose, diameter

    def place(self, ids: Array, q: Array, log_pose: Array, diameter: Array) -> None:
        super().place(ids, q, log_pose, diameter)
        self.valve_speed[ids] = self.telescope_wait[ids] = 0
        self.limit_forces(ids)

    def set_constants(self, ids: Array, radius: Array) -> None:
        """Also give the engine what was drawn."""
        model, engine = self.model, self.engine
        drawn = {name: values[ids] for name, values in self.drawn.items()}
        self.density[ids] = drawn["density"]
        super().set_constants(ids, radius)
        stiffness = drawn["stiffness"][:, ACTION_OF_SERVO]
        self.servo_kp[ids] = stiffness
        engine["actuator_gainprm"][ids, INTEGRATORS, 0] = stiffness
        engine["actuator_biasprm"][ids, INTEGRATORS, 1] = -stiffness
        delay = model.actuator_delay[INTEGRATORS] + drawn["extra_delay"][:, None]
        engine["actuator_delay"][ids, INTEGRATORS] = delay
        engine["dof_damping"][np.ix_(ids, SERVOS)] = drawn["damping"][:, ACTION_OF_SERVO]
        engine["geom_friction"][ids] = model.geom_friction * drawn["friction"][:, None, None]

    # ---- what moves the joints

    def drive(self, ids: Array, seconds: float) -> None:
        """The mean speed that valves and pump give in the next seconds moves the springs."""
        command, gain = self.command[ids], self.drawn["gain"][ids]
        self.limit_forces(ids)
        wanted = np.where(command < 0, gain[:, 0], gain[:, 1]) * command
        self.ctrl[ids, INTEGRATORS] = self.oil_speed(ids, wanted, seconds)[:, ACTION_OF_SERVO]

    def limit_forces(self, ids: Array) -> None:
        """No drive of cranes `ids` pushes harder than PRESSURE allows where its joint is now."""
        levers = cylinder_levers(*self.qpos[ids, 1:3].T)
        ones = np.ones((len(ids), 6))  # an infinite force: the telescope may use its full area
        areas = [oil_per_movement(levers, sign * ones, np.inf * ones) for sign in (-1, 1)]
        most = (PRESSURE * np.array(areas) / SERVOS_OF_ACTION)[:, :, ACTION_OF_SERVO]
        most = np.minimum(most, self.model.jnt_actfrcrange[SERVOS, 1])
        limits = np.stack([-most[0], most[1]])
        self.levers[:, ids], self.force_limit[:, ids] = levers, limits
        self.engine["actuator_forcerange"][ids, INTEGRATORS] = np.moveaxis(limits, 0, -1)

    def spring_force(self) -> Array:
        """Force of the oil on each servo's joint, (N, 8), N m and N."""
        return np.clip(self.servo_kp * (self.act - self.qpos[:, SERVOS]), *self.force_limit)

    def oil_speed(self, ids: Array, command: Array, seconds: float) -> Array:
        """Mean speed (n, 6), rad/s and m/s, that the oil gives cranes `ids` in the next seconds.

        A valve follows its command (n, 6) as a first-order lag. A resting telescope's load-holding
        valve opens late. If the joints together ask for more oil than the pump gives, each gets the
        same share of what it asks for.
        """
        speed, telescope = self.valve_speed[ids], command[:, 3]
        resting = (np.abs(speed[:, 3]) < 1e-3) & (np.abs(telescope) >= 1e-3)
        self.telescope_wait[ids] = np.where(resting, self.telescope_wait[ids] + seconds, 0.0)
        closed = resting & (self.telescope_wait[ids] <= BREAKAWAY)
        target = command.copy()
        target[closed, 3] = 0.0
        decay = np.exp(-seconds / LAG)
        mean = target + (speed - target) * LAG / seconds * (1 - decay)
        self.valve_speed[ids] = target + (speed - target) * decay
        force = self.spring_force()[ids] @ np.eye(6)[ACTION_OF_SERVO]  # of both stages, jaws
        oil = oil_per_movement(self.levers[:, ids], mean, force)
        demand = np.sum(oil * np.abs(mean), axis=-1, keepdims=True)
        return mean * np.minimum(1, self.PUMP_FLOW / np.maximum(demand, 1e-9))

    # ---- what is observed, measured and rewarded

    def observation_limits(self) -> Array:
        limits = super().observation_limits()
        if not self.options.sensors:
            return limits
        bound = np.repeat([1.0, 10.0, 1.0], [6, 2, 6])
        return np.concatenate([limits, [-bound, bound]], axis=-1)

    def observe(self, state: CraneState) -> Array:
        """The observation of the state that faulty sensors report, and more sensors."""
        x, y, z = state.log_axis.T
        cos, sin = np.cos(self.drawn["yaw_error"]), np.sin(self.drawn["yaw_error"])
        reported = state._replace(
            q=state.q + self.drawn["joint_error"],
            log_centre=state.log_centre + self.drawn["pose_error"],
            log_axis=np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1),
        )
        obs = super().observe(reported)
        if not self.options.sensors:
            return obs
        last_command = self.command / speed_limit(self.command)
        rates = self.qvel[:, crane_env.JOINTS][:, PASSIVE]
        force = (self.spring_force() / self.model.jnt_actfrcrange[SERVOS, 1])[:, FIRST_SERVO]
        return np.concatenate([obs, last_command, rates, force], axis=-1)

    def measure(self, state: CraneState) -> dict[str, Array]:
        info = super().measure(state)
        if self.options.randomize:
            info |= {f"drawn_{name}": values.copy() for name, values in self.drawn.items()}
        return info

    def grasp(self, state: CraneState, miss: Array) -> tuple[Array, Array]:
        """Soft drives lose what stiff servos hold, so only a grip earns all of r_grapple.

        It lifts in full where the tips are half a radius below the log's centre or deeper, and pays
        less above: the more so with randomize, whose logs may be slippery.
        """
        closed, grip = super().grasp(state, miss)
        closed = np.where(state.touching.all(axis=-1), 1.0, np.minimum(closed, EMPTY_GRIP))
        depth = grip_depth(state)
        return closed, grip * np.clip(0.5 + depth + self.options.randomize * (depth - 0.5), 0, 1)


class HydraulicCraneEnv(crane_env.CraneEnv):
    """One hydraulic crane."""

    cranes = HydraulicCraneVectorEnv
