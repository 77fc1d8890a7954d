"""A forestry crane that grasps and lifts a log: the MuJoCo simulator and Gymnasium environment.

    env = gymnasium.make("crane_env:ForestryCrane-v0")                    # one crane: CraneEnv
    envs = gymnasium.make_vec("crane_env:ForestryCrane-v0", num_envs=64)  # many: CraneVectorEnv

The crane slews at q1, lifts at q2 (boom) and q3 (arm) and reaches with q4 (two equal telescope
stages). Two passive joints q5 and q6 let the grapple hang: a rotator q7 with two jaws q8. A log
lies somewhere in front of the crane. Within 6 s the grapple must reach it. At the end of the 9 s
the log must hang in the jaws. Sections and equations are those of Vu et al. (README.md).
assets/README.md has the source of every number, docs/environment.md the task on one page.
A task of your own overrides hooks of `CraneVectorEnv`: loading_crane.py, docs/tutorial.md.

Observation, float32, `Box` of shape (18,):

| index  | meaning                                                | unit       | low, high      |
|--------|--------------------------------------------------------|------------|----------------|
| 0      | q1 slew                                                | rad        | -4.21, 4.21    |
| 1      | q2 boom, positive lifts                                | rad        | -1.7, 2.063    |
| 2      | q3 arm, 0 is square to the boom                        | rad        | -1.41, 2.0     |
| 3      | q4 length of each telescope stage                      | m          | -0.5, 2.736    |
| 4      | q5 passive, hangs at pi/2 - q2 - q3                    | rad        | -2.071, 2.071  |
| 5      | q6 passive, hangs at pi/2                              | rad        | 0.285, 2.856   |
| 6      | q7 rotator                                             | rad        | -3.642, 3.642  |
| 7      | q8 jaws, 0 is open                                     | rad        | -0.5, 3.5      |
| 8-13   | velocities of q1, q2, q3, q4, q7, q8                   | rad/s, m/s | -10, 10        |
| 14-16  | Delta_p, grapple centre to log: ahead, left, up        | m          | -20, 20        |
| 17     | signed angle from the grapple to the log, 0 is aligned | rad        | -4.712, 4.712  |

Action, float32, `Box` of shape (6,): each joint's commanded velocity as a fraction of its limit in
that direction. 0 stops the joint. Values outside the box are clipped.

| index | joint                  | low, high | speed at -1 and +1    |
|-------|------------------------|-----------|-----------------------|
| 0     | q1 slew                | -1, 1     | -0.764, 0.802 rad/s   |
| 1     | q2 boom                | -1, 1     | -0.326, 0.239 rad/s   |
| 2     | q3 arm                 | -1, 1     | -0.344, 0.326 rad/s   |
| 3     | q4 each stage          | -1, 1     | -0.630, 0.400 m/s     |
| 4     | q7 rotator             | -1, 1     | -2.12, 2.12 rad/s     |
| 5     | q8 jaws, + closes      | -1, 1     | -1.8, 1.8 rad/s       |
"""

import os
import sys
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
    os.environ.setdefault("MUJOCO_GL", "egl")  # mujoco chooses its OpenGL when it is imported

import gymnasium
import mujoco
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from mujoco.batch import Batch, SimulationError
from numpy import ndarray as Array
from numpy.random import Generator, SeedSequence, default_rng
from pydantic import Field
from pydantic.dataclasses import dataclass

# ---- the machine

MODEL_PATH = Path(__file__).parent / "assets" / "crane.xml"
VEL = mujoco.mjtStage.mjSTAGE_VEL  # makes positions, velocities and contacts current, not forces
SPEED_LIMITS = np.array(  # lowest and highest of q1, q2, q3, q4, q7, q8: rad/s, per stage m/s
    [[-0.764, -0.326, -0.344, -0.630, -2.12, -1.8], [0.802, 0.239, 0.326, 0.400, 2.12, 1.8]]
)
PIVOT_HEIGHT, JAW_LENGTH = 0.5, 0.8566  # m, from p_C up to the jaws' pivots, from there to a tip
Q8_MAX = 3.0  # rad
ROTATOR_MAX = 2.8  # rad, 0.34 short of its end stop: as far as the signed angle sends it
# The engine's joints, before the seven numbers of the log's pose, and our lists of them:
#             index:  0   1   2   3   4          5   6   7   8   9
#             joint:  q1  q2  q3  q4  q4_stage2  q5  q6  q7  q8  q8_inner
JOINTS = [0, 1, 2, 3, 5, 6, 7, 8]  # our q1 ... q8
SERVOS = [0, 1, 2, 3, 4, 7, 8, 9]  # the eight that have a servo
ACTION_OF_SERVO = [0, 1, 2, 3, 3, 4, 5, 5]  # which of the six actions moves each servo
INTEGRATORS = slice(8, 16)  # of the engine's actuators, behind the servos; your own come last
ACTUATED = [0, 1, 2, 3, 6, 7]  # the six of our q1 ... q8 that an action moves

# ---- the task

LOG_LENGTH = 2.75  # m (paper)
LOG_DENSITY = 650.0  # kg/m^3, the low end of green spruce; the paper does not give it
D_MIN, D_MAX, R_MIN, R_MAX = 0.3, 0.8, 5.5, 7.5  # m, log diameter (paper), way from slew axis
REACH_DISTANCE = 0.35  # m, epsilon of d_combine, not published (docs/learned.md, Reward)
LOG_RANGE = 8.0  # m, largest distance between grapple centre and log centre (paper)
MIN_CLEARANCE = 0.1  # m of air under the log's lowest point
MAX_MISS = 0.3  # m along the log, between grapple centre and log centre
GENTLE_FORCE = 20e3  # N, of the crane on the ground; its moving parts weigh 19.5 kN
POSE_RANGE = 8.0  # m, d_max of the pose noise's decay s(Delta_p)
POSE_NOISE = 0.1  # bound of epsilon_p and epsilon_o (paper, Sec. V-D)

# ---- the reward

OMEGA2 = 1.0  # 1/m, sharpness of r_distance; the paper does not give it
DESIRED_HEIGHT = 1.0  # m, z_l,d of the printed reward, unpublished; also of the loading crane
GRAPPLE_WEIGHT = 2.0  # largest staged r_grapple; with 1 some seeds never closed the jaws
LIFT_WEIGHT = 2.0  # largest part of staged r_lift that height earns; CARRY_WEIGHT adds to it
BALANCE_WEIGHT = 3.0  # largest staged r_balance: a log that hangs still pays most
CLOSING_HEIGHT = 0.1  # m above Delta_p = 0: closing jaws pull the grapple down, onto the ground
NEAR_SHARPNESS = 3.0  # 1/m, how fast r_grapple falls beyond REACH_DISTANCE
GRAPPLE_MISS = 0.5  # m off the log's centre at which r_grapple falls to 1/e
LIFT_MISS = 0.25  # m off the log's centre at which r_lift falls to 1/e
CARRY_WEIGHT = 1.0  # part of r_lift where the jaws carry the whole log: leads to the first lift

# of pydantic: no unknown names, no "3" for 3, no 1 for True
STRICT = {"extra": "forbid", "strict": True, "allow_inf_nan": False}


@dataclass(config=STRICT)
class Options:
    """What can be changed of the task: keywords of `gymnasium.make`, `--env.*` of the scripts."""

    frame_skip: Annotated[int, Field(ge=1, le=1200)] = 20  # physics steps per step; the paper: 1
    contact: Literal["primitive", "sdf"] = "primitive"  # sdf: jaw meshes, the paper's solver
    reward: Literal["staged", "paper"] = "staged"  # staged, or Sec. IV-B2 as printed
    offset: Literal["plus", "minus"] = "plus"  # sign of the diameter's part in Delta_p,z
    signed_yaw: bool = True  # observe the signed angle to the log, not the paper's Delta_psi
    axes: Literal["crane", "world"] = "crane"  # of Delta_p; crane: ahead, left, up
    pose_noise: Literal["none", "step", "episode"] = "none"  # how often the pose error is drawn


# ---- starts


def tip_position(q2: Array, q3: Array, q4: Array) -> tuple[Array, Array]:
    """Distance of the tip joint from the slew axis and its height, both in m (DH parameters)."""
    arm = 3.157 + 2 * q4
    out = -0.18 + 3.49288 * np.cos(q2) - 0.3925 * np.cos(q2 + q3) + arm * np.sin(q2 + q3)
    up = 3.5657 + 3.49288 * np.sin(q2) - 0.3925 * np.sin(q2 + q3) - arm * np.cos(q2 + q3)
    return out, up


def sample_start(rng: Generator) -> tuple[Array, Array, float]:
    """Draw one start of the full task: q (8,), log pose (x, y, yaw) in m and rad, diameter in m."""
    good = np.zeros(1, bool)
    while not good.any():
        q2, q3, q4 = rng.uniform([0.1, -0.6, 0.05], [1.0, 0.8, 1.0], size=(32, 3)).T
        out, up = tip_position(q2, q3, q4)
        good = (4.5 <= out) & (out <= 8) & (2.7 <= up) & (up <= 4.2) & (q2 + q3 > 0.05)
    q2, q3, q4 = np.stack([q2, q3, q4])[:, np.argmax(good)]
    q1, azimuth = rng.uniform(-2 * np.pi / 3, -np.pi / 3, size=2)
    swing5, swing6 = rng.uniform(-0.05, 0.05, size=2)
    q7, yaw = rng.uniform(-np.pi / 2, np.pi / 2, size=2)
    q8, radius, diameter = rng.uniform([0.05, R_MIN, D_MIN], [0.6, R_MAX, D_MAX])
    q = np.array([q1, q2, q3, q4, np.pi / 2 - q2 - q3 + swing5, np.pi / 2 + swing6, q7, q8])
    return q, np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), yaw]), diameter


def ease_start(
    q: Array, log_pose: Array, diameter: float, difficulty: float
) -> tuple[Array, Array, float]:
    """A start of `sample_start`, its log moved towards an easy place, which difficulty 0 has: under
    the boom's tip, or as near to it as logs may lie, with the grapple's yaw and the mean diameter.
    """
    q1, q7, (x, y, yaw) = q[0], q[6], log_pose
    out, _ = tip_position(*q[1:4])
    easiest = np.array([np.clip(out, R_MIN, R_MAX), q1, q1 - q7, (D_MIN + D_MAX) / 2])
    way = np.array([np.hypot(x, y), np.arctan2(y, x), yaw, diameter]) - easiest
    way[2] = (way[2] + np.pi / 2) % np.pi - np.pi / 2  # a log is the same after half a turn
    radius, azimuth, yaw, diameter = easiest + difficulty * way
    yaw = (yaw + np.pi / 2) % np.pi - np.pi / 2
    return q, np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), yaw]), diameter


# ---- geometry


class CraneState(NamedTuple):
    """What observation, reward and rules are computed from, for N cranes."""

    q: Array  # (N, 8) joint positions, rad and m
    dq: Array  # (N, 6) velocities of the actuated joints
    grapple_centre: Array  # (N, 3) p_C, m
    grapple_axis: Array  # (N, 3) e_C,x, unit
    log_centre: Array  # (N, 3) p_l, m
    log_axis: Array  # (N, 3) along the log, unit
    touching: Array  # (N, 2) bool, outer and inner jaw on the log
    diameter: Array  # (N,) m
    carried: Array  # (N,) 1 - (force of log and crane on the ground) / (log's weight); 1 at a start


def relative_pose(state: CraneState, offset: str = "plus") -> tuple[Array, Array]:
    """Delta_p (N, 3) in m and Delta_psi (N,) in [0, 1], Eqs. (4) and (8). offset "plus" adds
    d_off = (d_max - d) / 2 of the log's diameter d, "minus" subtracts it.
    """
    delta_p = state.log_centre - state.grapple_centre
    delta_p[:, 2] += (1.0 if offset == "plus" else -1.0) * (D_MAX - state.diameter) / 2
    cos, _ = turn_seen_from_above(state)
    return delta_p, 1.0 - np.minimum(np.abs(cos), 1.0)


def turn_seen_from_above(state: CraneState) -> tuple[Array, Array]:
    """Cosine and sine of the angle from the grapple's axis to the log's, (N,) each."""
    (grapple_x, grapple_y, _), (log_x, log_y, _) = state.grapple_axis.T, state.log_axis.T
    shadow = np.maximum(np.sqrt(log_x**2 + log_y**2), 1e-9)  # its length on the ground
    log_x, log_y = log_x / shadow, log_y / shadow
    return grapple_x * log_x + grapple_y * log_y, grapple_x * log_y - grapple_y * log_x


def signed_angle(state: CraneState) -> Array:
    """The turn of the grapple's axis to the log's, (N,) in rad. A log has no front: this is the
    shorter turn, or the longer where the shorter takes the rotator beyond ROTATOR_MAX.
    """
    cos, sin = turn_seen_from_above(state)
    angle = (np.arctan2(sin, cos) + np.pi / 2) % np.pi - np.pi / 2
    slew = np.arctan2(state.log_centre[:, 1], state.log_centre[:, 0]) - state.q[:, 0]
    slew = (slew + np.pi) % (2 * np.pi) - np.pi
    # q7 once the crane faces the log and the grapple is aligned; a hanging grapple's yaw is q1 - q7
    rotator = state.q[:, 6] + slew - angle
    return angle + np.pi * np.sign(rotator) * (np.abs(rotator) > ROTATOR_MAX)


def noisy_pose(delta_p: Array, angle: Array, epsilon: Array) -> tuple[Array, Array]:
    """Pose measurement errors of Sec. V-D; epsilon (N, 2) holds epsilon_p and epsilon_o."""
    decay = np.sum(delta_p**2, axis=-1, keepdims=True) / POSE_RANGE**2  # s(Delta_p)
    factor = 1 + epsilon * decay
    return delta_p * factor[:, :1], angle * factor[:, 1]


def log_clearance(state: CraneState) -> Array:
    """Height of the lowest point of the log above the ground, (N,) in m."""
    up = np.minimum(np.abs(state.log_axis[:, 2]), 1.0)
    below_centre = LOG_LENGTH / 2 * up + state.diameter / 2 * np.sqrt(1 - up**2)
    return state.log_centre[:, 2] - below_centre


def centre_miss(state: CraneState) -> Array:
    """Distance from the log's centre to p_C, measured along the log, (N,) in m."""
    return np.abs(np.sum((state.grapple_centre - state.log_centre) * state.log_axis, axis=-1))


def speed_limit(command: Array) -> Array:
    """Speed limit, positive, in the direction of each command (N, 6), rad/s and m/s."""
    return np.where(command < 0, -SPEED_LIMITS[0], SPEED_LIMITS[1])


# ---- reward


def paper_terms(state: CraneState, d_combine: Array, command: Array) -> dict[str, Array]:
    """The reward as printed in Sec. IV-B2, (N,) each.

    With open jaws r_distance + r_grapple is 1 at any distance, and a crane at rest earns r_balance:
    a policy learns to stand still. That is why `staged_terms` is the default.
    """
    r_distance = np.exp(-OMEGA2 * d_combine)
    closed = state.q[:, 7] / Q8_MAX
    r_grapple = r_distance * closed + (1 - closed) * (1 - r_distance)
    height_error = np.abs(state.log_centre[:, 2] - DESIRED_HEIGHT)
    r_lift = (1 - np.tanh(height_error)) * (1 - r_grapple)
    r_balance = (1 - np.tanh(np.linalg.norm(command, axis=-1))) * (1 - r_lift)
    return dict(r_distance=r_distance, r_grapple=r_grapple, r_lift=r_lift, r_balance=r_balance)


def staged_terms(
    state: CraneState, distance: Array, clearance: Array, miss: Array, command: Array,
    closed: Array, grip: Array,
) -> dict[str, Array]:  # fmt: skip
    """r_distance pays for coming near, r_grapple for closing the jaws near the log's centre, r_lift
    for lifting it there, r_balance for holding still while both jaws hold it up, (N,) each.

    distance (N,) in m is ||Delta_p|| + 1 m Delta_psi, to a point CLOSING_HEIGHT above that of
    Delta_p = 0. clearance and miss (N,) in m are `log_clearance` and `centre_miss`,
    command (N, 6) the commanded velocities in rad/s and m/s. closed and grip (N,) in [0, 1] say how
    far the jaws are closed and how well they would lift.
    """
    near = np.minimum(1, np.exp(-NEAR_SHARPNESS * (distance - REACH_DISTANCE)))
    held = state.touching.all(axis=-1)
    clearance = np.maximum(clearance, 1e-9)  # 0 on the ground
    height = np.sqrt(np.minimum(clearance, 1 / clearance))  # 1 at 1 m, less below and above
    calm = 1 - np.tanh(np.linalg.norm(command[:, :5], axis=-1))  # the jaws may squeeze
    lift, carry = grip * height, CARRY_WEIGHT * centred(miss) * held * state.carried
    return dict(
        r_distance=np.exp(-OMEGA2 * distance),
        r_grapple=GRAPPLE_WEIGHT * near * np.exp(-((miss / GRAPPLE_MISS) ** 2)) * closed,
        r_lift=LIFT_WEIGHT * lift + carry,
        r_balance=BALANCE_WEIGHT * calm * held * lift,
    )


def centred(miss: Array) -> Array:
    """1 for a grip at the log's centre, 1/e for one that is LIFT_MISS off."""
    return np.exp(-((miss / LIFT_MISS) ** 2))


# ---- environments


def first(tests: dict[str, Array], otherwise: str) -> Array:
    """The name of each crane's first true test, `otherwise` where none is true, (N,) strings."""
    names, values = np.array([*tests, otherwise]), [*tests.values()]
    return names[np.argmax([*values, np.ones_like(values[0])], axis=0)]


class CraneVectorEnv(gymnasium.vector.VectorEnv):
    """N cranes stepped together on one `mujoco.batch.Batch`.

    Crane i's starts depend on the seed, on i and, with retry, on how its episodes ended, but not on
    the threads or on N (except easy ones of loading_crane.py).

    `info` describes the step just made, for every crane, also one whose episode just ended: the
    reward's terms, `time` (s), `d_combine`, `clearance`, `centre_miss`, `diameter` (m), `log_mass`
    (kg), `time_to_reach` (s, inf before), `ground_peak` (N, largest force of the crane on the
    ground in this episode), `diverged`, `safe` (all `conditions` have held for HOLD_TIME) and
    `termination`: the rule that ended the episode, "time_limit" or "none". At an end there are
    `success` (for Stable-Baselines3 `is_success`), `gentle` (success with at most GENTLE_FORCE on
    the ground) and `failure`: the rule or the first of `conditions` that failed. The mask `_key`
    says where `key` means something. After an end `obs` is the next start's, `final_obs` and
    `final_info` are the end's (SAME_STEP autoreset).

    `difficulty` eases starts and hits, 1 is the full task. `retry` is the largest share of episodes
    that repeat a failed start. Both, in [0, 1], may be set at any time. Each of `observers` is
    called as observer(envs) after each physics step.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "autoreset_mode": AutoresetMode.SAME_STEP}
    Options = Options
    REVISION = 7  # of the task; raise it when a change makes trained policies worse
    TIME_LIMIT = 9.0  # s, of an episode (paper, Tables I and II)
    REACH_TIME = 6.0  # s, by which the log must have been reached (paper)
    HOLD_TIME = 0.5  # s at the end of an episode in which `conditions` must hold
    LIMIT_TOLERANCE = 0.02  # rad, m; at full servo force a soft stop gives 0.005 rad or 0.012 m
    GOALS: tuple[str, ...] = ()  # names of `rules` that end an episode well where it is `safe`
    COARSE_HITS = 0.5  # hits count times (physics step / crane.xml's)^this (docs/training.md)
    PIECE = 0.025  # s between two clamps of the integrators (assets/README.md)
    # In the full task r_ground falls linearly from 0 at half of GENTLE_FORCE to -GROUND_WEIGHT at
    # GENTLE_FORCE, never below GROUND_MOST times that. Stiff servos hit hard or not at all.
    GROUND_WEIGHT, GROUND_MOST = 30.0, 1.0
    FULL_STARTS = 1.0  # from this difficulty on starts are those of the task

    def __init__(
        self,
        num_envs: int = 1,  # N
        diameter: float | Array | None = None,  # one or (N,), m; None draws it
        difficulty: float = 1.0,
        retry: float = 0.0,
        physics_step: float = 0.0,  # s; ignored up to crane.xml's 0.005, above a step, and for sdf
        env_threads: int = 0,  # physics threads, 0 for all cores
        render_mode: Literal["human", "rgb_array"] | None = None,
        camera: Literal["overview", "side", "grapple"] = "overview",
        width: int = 640,
        height: int = 480,
        decorate: Callable[[mujoco.MjSpec], None] | None = None,  # adds what is only seen
        autoreset: bool = True,  # False: the caller resets
        **options: Any,  # `Options`
    ):
        self.options = self.Options(**options)
        self.num_envs, self.difficulty, self.retry = num_envs, difficulty, retry
        self.render_mode, self.camera, self.frame_size = render_mode, camera, (height, width)
        self.viewer, self.autoreset, self.observers = None, autoreset, []
        if diameter is not None:
            diameter = np.broadcast_to(np.asarray(diameter, float), num_envs)
            if not np.all((D_MIN <= diameter) & (diameter <= D_MAX)):
                raise ValueError(f"diameter must be in [{D_MIN}, {D_MAX}] m, got {diameter}")
        self.fixed_diameter = diameter

        spec = self.make_spec()
        if decorate:
            decorate(spec)
        spec.compiler.discardvisual = render_mode is None  # the same motion, sooner
        self.dt = self.options.frame_skip * spec.option.timestep  # s, one step
        self.physics_steps = self.options.frame_skip  # in a step
        if self.options.contact == "primitive" and spec.option.timestep < physics_step <= self.dt:
            self.physics_steps = int(np.ceil(self.dt / physics_step - 1e-9))
            spec.option.timestep = self.dt / self.physics_steps
        self.coarse = self.options.frame_skip / self.physics_steps  # how many times as long
        self.piece = int(np.ceil(self.PIECE / spec.option.timestep - 1e-9))  # physics steps
        spec.sensor("ground_force").nsample = self.piece
        self.model = model = spec.compile()
        # kv: a servo at its force limit overshoots more in a longer step, and would chatter
        model.actuator_gainprm[:8, 0] /= self.coarse
        model.actuator_biasprm[:8, 2] /= self.coarse
        self.max_steps = int(np.ceil(self.TIME_LIMIT / self.dt - 1e-9))
        self.hold_steps = int(np.floor(self.HOLD_TIME / self.dt + 1e-9)) + 1  # both ends count
        fps, mode = max(1, round(1 / self.dt)), "SameStep" if autoreset else "Disabled"
        self.metadata = self.metadata | {"render_fps": fps, "autoreset_mode": AutoresetMode(mode)}

        self.batch = batch = Batch(model, num_envs, env_threads, persistent=True)
        # live views of the engine's arrays, one row a crane. Each has a log of its own
        sizes, masses, _ = map(batch.expand, ("geom_size", "body_mass", "body_inertia"))
        self.log_mass = masses[:, model.body("log").id]
        self.log_radius = sizes[:, model.geom("log").id, 0]
        self.qpos, self.qvel, self.ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
        self.act, self.qfrc_bias = batch.bind("act")[:, :8], batch.bind("qfrc_bias")
        self.sensordata, self.warnings = batch.bind("sensordata"), batch.warning[:, :, 1]  # counts
        self.ground_force = self.history("ground_force")
        self.gravity = np.linalg.norm(model.opt.gravity)  # m/s^2
        self.joint_range = model.jnt_range[JOINTS]  # (8, 2), rad and m
        self.servo_kp = np.tile(model.actuator_gainprm[INTEGRATORS, 0], (num_envs, 1))
        # N m and N, lowest and highest that each servo may push with, (2, N, 8)
        self.force_limit = np.tile(model.jnt_actfrcrange[SERVOS].T[:, None], (1, num_envs, 1))

        self.rngs: list[tuple[Generator, Generator, Generator]] | None = None
        self.starts: list[tuple] = [()] * num_envs
        self.density = np.full(num_envs, LOG_DENSITY)  # kg/m^3
        self.command = np.zeros((num_envs, 6))  # rad/s, m/s
        self.steps = np.zeros(num_envs, int)  # since the start of each episode
        self.reach_time = np.full(num_envs, np.inf)  # s
        self.streaks: dict[str, Array] = {}  # for how many steps each of `conditions` has held
        self.impact, self.ground_peak = np.zeros((2, num_envs))  # N, on ground: step, episode
        draws = self.max_steps + 1 if self.options.pose_noise == "step" else 1
        self.noise = np.zeros((num_envs, draws, 2))  # epsilon_p, epsilon_o

        self.single_observation_space = gymnasium.spaces.Box(*np.float32(self.observation_limits()))
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (6,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def history(self, name: str) -> Array:
        """A sensor's values at its last `nsample` physics steps, live, unordered, (N, all)."""
        i = self.model.sensor(name).id
        n = self.model.sensor_history[i, 0]
        start = self.model.sensor_historyadr[i] + 2 + n  # behind the times of the samples
        return self.batch.bind("history")[:, start : start + n * self.model.sensor_dim[i]]

    @property
    def task(self) -> dict[str, Any]:
        """What a trained policy knows of its task."""
        return {"revision": self.REVISION, "options": asdict(self.options)}

    # ---- one step

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Advance every crane by one step, actions (N, 6), and start anew after an end.

        RuntimeError before `reset`, ValueError for actions of another shape or not finite.
        """
        actions = np.asarray(actions, dtype=np.float64)
        if self.rngs is None:
            raise RuntimeError("call reset() before step()")
        if actions.shape != (self.num_envs, 6) or not np.isfinite(actions).all():
            raise ValueError(f"actions must be finite, ({self.num_envs}, 6), got {actions}")
        self.command = np.clip(actions, -1, 1) * speed_limit(actions)
        diverged = self.simulate()
        self.steps += 1
        state, time = self.state(), self.steps * self.dt
        obs = self.bounded_observation(state, diverged)
        info = self.measure(state) | {"time": time, "diverged": diverged}
        reached = self.reached(info) & (time < self.REACH_TIME + 1e-9)
        self.reach_time = np.minimum(self.reach_time, np.where(reached, time, np.inf))
        info["time_to_reach"] = self.reach_time.copy()

        # success: each condition held at every step of the last HOLD_TIME
        holds = self.checked(self.conditions(state, info))
        self.streaks = {name: (self.streaks.get(name, 0) + 1) * ok for name, ok in holds.items()}
        missing = first({name: n < self.hold_steps for name, n in self.streaks.items()}, "")
        info["safe"] = missing == ""

        rules = self.checked(self.rules(state, info))
        ending = first(rules | {"time_limit": time > self.TIME_LIMIT - 1e-9}, "none")
        done, truncated = ending != "none", ending == "time_limit"
        terminated = done & ~truncated
        success = info["safe"] & (truncated | np.isin(ending, self.GOALS))
        gentle = success & (self.ground_peak <= GENTLE_FORCE)
        failure = np.where(done & ~success, np.where(terminated, ending, missing), "")
        ends = {"success": success, "is_success": success, "gentle": gentle, "failure": failure}
        info |= ends | {"termination": ending}

        # reward
        terms = self.checked(self.reward_terms(state, info))
        if taken := terms.keys() & info.keys():
            raise ValueError(f"reward_terms must have other names than info's {taken}")
        info |= {name: np.where(diverged, 0.0, term) for name, term in terms.items()}
        reward = sum(info[name] for name in terms)

        # autoreset
        for i in np.flatnonzero(done):
            self.recent_success[i].append(bool(success[i]))
            if not success[i]:
                self.failures[i].append(self.starts[i])
        always = np.ones_like(done)
        info |= {f"_{key}": done if key in ends else always for key in info}
        if self.autoreset and done.any():
            info["final_info"] = info.copy()
            info["final_obs"] = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(done):
                info["final_obs"][i] = obs[i].copy()
            info["_final_obs"] = info["_final_info"] = done
            self.start_episodes(np.flatnonzero(done))
            obs[done] = self.bounded_observation(self.state())[done]
        if self.render_mode == "human":
            self.render()
        return obs, reward, terminated, truncated, info

    def checked(self, values: dict[str, Array]) -> dict[str, Array]:
        """What a hook returned. ValueError names one that NumPy would broadcast."""
        for name, value in values.items():
            if np.shape(value) != self.steps.shape:
                raise ValueError(f"{name} must be {self.steps.shape}, not {np.shape(value)}")
        return values

    def reset(self, *, seed: int | Sequence | None = None, options=None) -> tuple[Array, dict]:
        """New episodes of all cranes or of options["reset_mask"] (N,). Seeds go to all cranes."""
        if seed is not None or self.rngs is None:
            if np.ndim(seed) == 0:  # one, or None: crane i draws from its i-th child
                seed = SeedSequence(seed).spawn(self.num_envs)
            seeds = [s if isinstance(s, SeedSequence) else SeedSequence(s) for s in seed]
            if len(seeds) != self.num_envs:
                raise ValueError(f"{len(seeds)} seeds for {self.num_envs} cranes")
            # Starts, pose noise and what a subclass draws have streams of their own. Not by
            # s.spawn(3): it counts its calls, and a seed given twice would start other episodes.
            streams = [(s, s.generate_state(4), s.generate_state(8)[4:]) for s in seeds]
            self.rngs = [tuple(map(default_rng, stream)) for stream in streams]
            self.failures = [deque(maxlen=4) for _ in seeds]  # starts of failed episodes
            self.recent_success = [deque(maxlen=10) for _ in seeds]  # a crane's last episodes
        everyone = np.ones(self.num_envs, bool)
        self.start_episodes(np.flatnonzero((options or {}).get("reset_mask", everyone)))
        info = self.measure(state := self.state())
        return self.bounded_observation(state), info | {f"_{key}": everyone for key in info}

    # ---- hooks: the model, the start of an episode

    def make_spec(self) -> mujoco.MjSpec:
        """The model: assets/crane.xml with the contacts that the options ask for."""
        spec = mujoco.MjSpec.from_file(str(MODEL_PATH))
        spec.geom("log").size[1] = LOG_LENGTH / 2
        if self.options.contact == "sdf":  # the paper's contacts, integrator and solver
            spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICIT
            spec.option.solver = mujoco.mjtSolver.mjSOL_CG
            # half of these points miss three times as many touches (assets/README.md)
            spec.option.sdf_initpoints, spec.option.sdf_iterations = 8, 5
            # Collision bits of crane.xml: 4 is the log's. 8 collides with nothing, but a geom
            # without any bit counts as only drawn.
            spec.geom("log").contype, spec.geom("log_capsule").contype = 4, 8
            for geom in spec.geoms:
                if geom.classname.name == "jaw_mesh":
                    geom.type, geom.conaffinity = mujoco.mjtGeom.mjGEOM_SDF, 4
                elif geom.classname.name == "jaw_collision":
                    geom.conaffinity &= ~4
        return spec

    def start_episodes(self, ids: Array) -> None:
        """New episodes in cranes `ids`."""
        for i in ids:
            self.noise[i] = self.rngs[i][1].uniform(-POSE_NOISE, POSE_NOISE, self.noise[i].shape)
        q, log_pose, diameter = map(np.array, zip(*map(self.draw_episode, ids)))
        if self.fixed_diameter is not None:
            diameter = self.fixed_diameter[ids]
        self.place(ids, q, log_pose, diameter)

    def draw_episode(self, i: int) -> tuple[Array, Array, float]:
        """Draw crane i's next start, as `sample_start` gives it."""
        (start_rng, *_), failures = self.rngs[i], self.failures[i]
        share = self.retry * np.mean(self.recent_success[i] or 0.0)  # 0 at first
        if share and failures and start_rng.random() < share:
            self.starts[i] = failures[start_rng.integers(len(failures))]
        else:
            self.starts[i] = *sample_start(start_rng), {}  # {}: what a subclass draws with it
        start = tuple(np.copy(part) for part in self.starts[i][:3])  # hooks may change it in place
        full = self.difficulty >= self.FULL_STARTS
        return start if full else ease_start(*start, self.difficulty / self.FULL_STARTS)

    def place(self, ids: Array, q: Array, log_pose: Array, diameter: Array) -> None:
        """Start episodes at rest in cranes `ids`: q (n, 8), log (x, y, yaw) (n, 3), m and rad."""
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        radius, (x, y, yaw) = diameter / 2, log_pose.T
        # the log's z axis lies along (-sin yaw, cos yaw, 0): -pi/2 about x, then yaw about z
        cos, sin = np.cos(yaw / 2) / np.sqrt(2), np.sin(yaw / 2) / np.sqrt(2)
        self.batch.joint("log").qpos[ids] = np.stack([x, y, radius, cos, -cos, -sin, sin], axis=-1)
        self.qpos[np.ix_(ids, JOINTS)] = q
        self.qpos[np.ix_(ids, SERVOS)] = q[:, ACTUATED][:, ACTION_OF_SERVO]
        self.set_constants(ids, radius)
        self.batch.set_const(ids)  # bounding volumes and inverse weights follow
        self.batch.forward(ids, stage=VEL)

        # the integrators start with the static load, so that an idle crane neither sags nor swings
        load = self.qfrc_bias[np.ix_(ids, SERVOS)]
        self.act[ids] = self.qpos[np.ix_(ids, SERVOS)] + load / self.servo_kp[ids]
        self.steps[ids] = self.command[ids] = self.impact[ids] = self.ground_peak[ids] = 0
        self.reach_time[ids] = np.inf
        for streak in self.streaks.values():
            streak[ids] = 0

    def set_constants(self, ids: Array, radius: Array) -> None:
        """Write to the engine what differs between episodes: radius (n,) in m, your own bodies."""
        mass = self.log_mass[ids] = self.density[ids] * np.pi * radius**2 * LOG_LENGTH
        across, along = mass * (3 * radius**2 + LOG_LENGTH**2) / 12, mass * radius**2 / 2
        capsule = self.batch.geom("log_capsule")
        self.log_radius[ids] = capsule.size[ids, 0] = radius
        capsule.size[ids, 1] = LOG_LENGTH / 2 - radius
        self.batch.body("log").inertia[ids] = np.stack([across, across, along], axis=-1)

    # ---- hooks: what moves the joints

    def simulate(self) -> Array:
        """The physics steps of one step under `command`; which cranes diverged, (N,)."""
        failed = np.zeros(self.num_envs, bool)
        self.impact[:] = 0.0
        # A piece may span several short steps: only the first of them drives and clamps.
        steps_per_piece = max(1, self.piece // self.physics_steps)
        due = self.steps % steps_per_piece == 0
        for left in range(self.physics_steps, 0, -self.piece):  # physics steps
            nstep = min(self.piece, left)
            self.drive(np.flatnonzero(due), nstep * steps_per_piece * self.model.opt.timestep)
            # Anti-windup: an integrator leads its joint by no more than the force limit can use.
            # This lead keeps squeezing the log at zero command, as a check valve does.
            low, high = self.qpos[:, SERVOS] + self.force_limit / self.servo_kp
            np.clip(self.act, low, high, out=self.act, where=due[:, None])
            self.ground_force[:] = 0.0  # a hit of an earlier piece is not this one's
            size = 1 if self.observers else nstep
            # Sensors are read after the last physics step, and by observers after each.
            stage = VEL if self.observers or left == nstep else mujoco.mjtStage.mjSTAGE_NONE
            for _ in range(nstep // size):
                try:
                    self.batch.step(nstep=size, stage=stage)
                except SimulationError as error:
                    failed[error.ids] = True
                for observer in self.observers:
                    observer(self)
            ground = np.linalg.norm(self.ground_force.reshape(self.num_envs, -1, 3), axis=-1)
            warned = self.warnings.any(axis=-1)
            ground[warned] = 0.0  # the engine has reset them
            self.impact = np.maximum(self.impact, self.coarse**self.COARSE_HITS * ground.max(-1))
            self.ground_peak = np.maximum(self.ground_peak, self.impact)
        finite = np.isfinite(self.qpos).all(axis=-1) & np.isfinite(self.qvel).all(axis=-1)
        return failed | warned | ~finite

    def drive(self, ids: Array, seconds: float) -> None:
        """Set `ctrl` of cranes `ids`, in which a piece begins, for the next seconds."""
        # of all cranes: ideal servos and their integrators answer at every step
        self.ctrl[:, :8] = self.ctrl[:, INTEGRATORS] = self.command[:, ACTION_OF_SERVO]

    # ---- hooks: what is observed and measured, what ends an episode, the reward

    def state(self) -> CraneState:
        """A copy of the state of all cranes."""
        q, dq = self.qpos[:, JOINTS], self.qvel[:, JOINTS][:, ACTUATED]
        sensors = self.sensordata.copy()  # as in crane.xml; sensors of your own go behind them
        poses = [sensors[:, i : i + 3] for i in (0, 3, 6, 9)]
        on_ground = [np.linalg.norm(sensors[:, i : i + 3], axis=-1) for i in (14, 17)]
        carried = np.clip(1 - sum(on_ground) / (self.gravity * self.log_mass), 0, 1)
        return CraneState(q, dq, *poses, sensors[:, 12:14] > 0, 2 * self.log_radius, carried)

    def bounded_observation(self, state: CraneState, diverged: Array | bool = False) -> Array:
        """`observe` as float32 (N, n): zeros for diverged cranes, all clipped to the space."""
        space, obs = self.observation_space, self.observe(state)
        if obs.shape != space.shape:
            raise ValueError(f"observe gives {obs.shape}, observation_limits {space.shape}")
        obs = np.where(np.reshape(diverged, (-1, 1)), 0.0, obs)
        return np.clip(obs, space.low, space.high).astype(np.float32, order="C")

    def observation_limits(self) -> Array:
        """Lowest and highest value of each number of `observe`, (2, n)."""
        low, high = self.joint_range.T + np.array([[-0.5], [0.5]])
        bound = np.repeat([10.0, 20.0, 1.5 * np.pi], [6, 3, 1])  # dq, Delta_p, its angle
        return np.array([[*low, *-bound], [*high, *bound]])

    def observe(self, state: CraneState) -> Array:
        """Observations (N, n). A subclass adds columns, and their limits to observation_limits."""
        delta_p, delta_psi = relative_pose(state, self.options.offset)
        angle = signed_angle(state) if self.options.signed_yaw else delta_psi
        if self.options.pose_noise != "none":
            now = np.minimum(self.steps, self.noise.shape[1] - 1)
            delta_p, angle = noisy_pose(delta_p, angle, self.noise[np.arange(len(now)), now])
        if self.options.axes == "crane":
            cos, sin, (x, y, z) = np.cos(state.q[:, 0]), np.sin(state.q[:, 0]), delta_p.T
            delta_p = np.array([cos * x + sin * y, cos * y - sin * x, z]).T
        return np.concatenate([state.q, state.dq, delta_p, angle[:, None]], axis=-1)

    def measure(self, state: CraneState) -> dict[str, Array]:
        """What `info` says of all cranes."""
        delta_p, delta_psi = relative_pose(state, self.options.offset)
        return {
            "d_combine": np.linalg.norm(delta_p, axis=-1) + delta_psi,
            "clearance": log_clearance(state),
            "centre_miss": centre_miss(state),
            "diameter": state.diameter,
            "log_mass": self.log_mass.copy(),
            "ground_peak": self.ground_peak.copy(),
        }

    def reached(self, info: dict[str, Array]) -> Array:
        """Whether the log is reached now, (N,) bool. `rules` end an episode that is late for it."""
        return info["d_combine"] < REACH_DISTANCE

    def conditions(self, state: CraneState, info: dict[str, Array]) -> dict[str, Array]:
        """What must hold throughout the last HOLD_TIME, (N,) bool each, named by its failure."""
        return {
            "not_lifted": info["clearance"] >= MIN_CLEARANCE,
            "not_held": state.touching.all(axis=-1),
            "off_centre": info["centre_miss"] <= MAX_MISS,
        }

    def rules(self, state: CraneState, info: dict[str, Array]) -> dict[str, Array]:
        """What ends an episode early (Sec. IV-B3), (N,) bool each, by name. The first counts."""
        q, (low, high) = state.q, self.joint_range.T
        beyond = (q < low - self.LIMIT_TOLERANCE) | (q > high + self.LIMIT_TOLERANCE)
        away = np.linalg.norm(state.log_centre - state.grapple_centre, axis=-1)
        return {
            "diverged": info["diverged"],
            **{f"joint_limit_q{k + 1}": beyond[:, k] for k in range(7)},  # jaws may use their stops
            "overspeed": (np.abs(state.dq) > 2 * speed_limit(state.dq)).any(axis=-1),
            "log_too_far": away > LOG_RANGE,
            "not_reached": (info["time"] > self.REACH_TIME - 1e-9) & np.isinf(self.reach_time),
        }

    def reward_terms(self, state: CraneState, info: dict[str, Array]) -> dict[str, Array]:
        """Terms of the reward, their sum, (N,) each, by name. info has `termination`, too."""
        if self.options.reward == "paper":
            return paper_terms(state, info["d_combine"], self.command)
        delta_p, delta_psi = relative_pose(state, self.options.offset)
        distance = np.linalg.norm(delta_p + [0, 0, CLOSING_HEIGHT], axis=-1) + delta_psi
        clearance, miss = info["clearance"], info["centre_miss"]
        grasp = self.grasp(state, miss)
        terms = staged_terms(state, distance, clearance, miss, self.command, *grasp)
        hardness = np.clip(2 * self.impact / GENTLE_FORCE - 1, 0, self.GROUND_MOST)
        # An easy task forgives hits: a crane that does not lift yet would learn to stay away.
        return terms | {"r_ground": -self.GROUND_WEIGHT * self.difficulty**4 * hardness}

    def grasp(self, state: CraneState, miss: Array) -> tuple[Array, Array]:
        """closed and grip of `staged_terms`."""
        return state.q[:, 7] / Q8_MAX, centred(miss)

    # ---- pictures

    def render(self) -> tuple[Array, ...] | None:
        """RGB frames (height, width, 3), uint8, one a crane; "human" shows crane 0 in a window."""
        if self.render_mode is not None and self.viewer is None:
            self.scene = self.batch.get_model(0), self.batch.get_data(0)
            if self.render_mode == "human":
                from mujoco.viewer import launch_passive  # needs a display

                self.viewer = launch_passive(*self.scene)
            else:
                self.viewer = mujoco.Renderer(self.scene[0], *self.frame_size)
        if self.render_mode == "rgb_array":
            return tuple(self.picture(i, self.camera) for i in range(self.num_envs))
        if self.render_mode == "human":
            with self.viewer.lock():
                self.batch.get_model(0, self.scene[0])
                self.batch.get_data(0, self.scene[1])
            self.viewer.sync()

    def picture(self, i: int, camera: str) -> Array:
        """What a camera sees of crane i, (height, width, 3), uint8."""
        self.batch.get_model(i, self.viewer.model)
        self.viewer.update_scene(self.batch.get_data(i), camera)
        return self.viewer.render()

    def close_extras(self, **kwargs: Any) -> None:
        if self.viewer is not None:
            self.viewer.close()
        self.viewer = None


class CraneEnv(gymnasium.Env):
    """One crane of `cranes`, a `CraneVectorEnv`. A new `difficulty` counts from the next reset.

    A task of your own has one crane too: class MyCraneEnv(CraneEnv): cranes = MyCranes.
    """

    metadata = {"render_modes": CraneVectorEnv.metadata["render_modes"]}
    cranes = CraneVectorEnv

    def __init__(self, **kwargs: Any):
        self.envs = self.cranes(num_envs=1, autoreset=False, **{"env_threads": 1, **kwargs})
        self.metadata = {**self.metadata, "render_fps": self.envs.metadata["render_fps"]}
        self.render_mode, self.difficulty = self.envs.render_mode, self.envs.difficulty
        self.observation_space = self.envs.single_observation_space
        self.action_space = self.envs.single_action_space

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Array, dict]:
        super().reset(seed=seed)
        self.envs.difficulty = self.difficulty
        obs, info = self.envs.reset(seed=seed)
        return obs[0], self.first_crane(info)

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """`CraneVectorEnv.step` without autoreset. action (6,)."""
        obs, reward, terminated, truncated, info = self.envs.step(np.asarray(action)[None])
        return obs[0], reward.item(), terminated.item(), truncated.item(), self.first_crane(info)

    def first_crane(self, info: dict[str, Array]) -> dict[str, Any]:
        """The one crane's info, in Python's numbers, bools and strings."""
        one = {key: value[0] for key, value in info.items() if key[0] != "_"}
        return {key: value.item() if np.ndim(value) == 0 else value for key, value in one.items()}

    def render(self) -> Array | None:
        frames = self.envs.render()
        return frames[0] if frames else None

    def close(self) -> None:
        self.envs.close()


PAPER_OPTIONS = {"frame_skip": 1, "contact": "sdf", "reward": "paper", "offset": "minus"}
PAPER_OPTIONS |= {"signed_yaw": False, "axes": "world"}
for env, kind, own in [
    ("ForestryCrane", "crane_env:Crane", {}),
    ("ForestryCranePaper", "crane_env:Crane", PAPER_OPTIONS),
    ("ForestryCraneHydraulic", "hydraulic_crane:HydraulicCrane", {}),  # beyond the paper from here
    ("ForestryCraneRandomized", "hydraulic_crane:HydraulicCrane", {"randomize": 1.0}),
    ("ForestryCraneLoading", "loading_crane:LoadingCrane", {}),
    ("ForestryCraneHydraulicLoading", "loading_crane:HydraulicLoadingCrane", {}),
]:
    gymnasium.register(f"{env}-v0", f"{kind}Env", vector_entry_point=f"{kind}VectorEnv", kwargs=own)
