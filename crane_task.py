"""The task: starts, relative pose, reward and rules of N cranes, without the simulator.

Section and equation names refer to Vu et al., "Towards Autonomous Wood-Log Grasping with a Forestry
Crane: Simulator and Benchmarking". `CraneVectorEnv` in crane_env.py applies what stands here.
"""

from typing import NamedTuple

import numpy as np
from numpy import ndarray as Array
from numpy.random import Generator

# ---- constants

LOG_LENGTH = 2.75  # m
D_MIN, D_MAX = 0.3, 0.8  # m, log diameter
DIAMETERS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8)  # m, of the paper's tables
POSE_RANGE = 8.0  # m, d_max of the pose noise's decay s(Delta_p)
POSE_NOISE = 0.1  # bound of epsilon_p and epsilon_o
ROTATOR_MAX = 2.8  # rad, 0.34 short of its end stop: as far as the signed angle sends it
Q8_MAX = 3.0  # rad
JAW_LENGTH = 0.8566  # m, from a jaw's pivot to its tip
PIVOT_HEIGHT = 0.5  # m, from p_C up to the pivots

TIME_LIMIT = 9.0  # s, of an episode
REACH_TIME = 6.0  # s, by which the log must have been reached
REACH_DISTANCE = 0.35  # m, d_combine = ||Delta_p|| + 1 m Delta_psi below which the log is reached
LOG_RANGE = 8.0  # m, largest distance between grapple centre and log centre
LIMIT_TOLERANCE = 0.02  # rad or m; under full servo force a soft stop gives 0.005 rad or 0.012 m
HOLD_TIME = 0.5  # s at the end of an episode in which the log must be held
MIN_CLEARANCE = 0.1  # m of air under the log's lowest point
MAX_MISS = 0.3  # m along the log, between grapple centre and log centre
GENTLE_FORCE = 20e3  # N, of the crane on the ground; its moving parts weigh 19.5 kN

OMEGA2 = 1.0  # 1/m, sharpness of r_distance; the paper does not give it
DESIRED_HEIGHT = 1.0  # m, z_l,d of the printed reward; the paper does not give it
GRAPPLE_WEIGHT = 2.0  # largest staged r_grapple; with 1 some seeds never closed the jaws
LIFT_WEIGHT = 2.0  # largest part of staged r_lift that height earns; CARRY_WEIGHT adds to it
BALANCE_WEIGHT = 3.0  # largest staged r_balance: a log that hangs still pays most
CLOSING_HEIGHT = 0.1  # m above Delta_p = 0: closing jaws pull the grapple down, onto the ground
EMPTY_GRIP = 0.5  # hydraulic: share of r_grapple for closed jaws without a log; a grip earns all
NEAR_SHARPNESS = 3.0  # 1/m, how fast r_grapple falls beyond REACH_DISTANCE
GRAPPLE_MISS = 0.5  # m off the log's centre at which r_grapple falls to 1/e
LIFT_MISS = 0.25  # m off the log's centre at which r_lift falls to 1/e
CARRY_WEIGHT = 1.0  # part of r_lift where the jaws carry the whole log: leads to the first lift
# r_ground is 0 up to half of GENTLE_FORCE and falls linearly, to minus this weight at GENTLE_FORCE.
GROUND_WEIGHT = {"ideal": 30.0, "hydraulic": 90.0}
# r_ground never falls below minus this many GROUND_WEIGHTs: stiff servos hit hard or not at all.
GROUND_MOST = {"ideal": 1.0, "hydraulic": 3.0}

LIMITED = slice(0, 7)  # of our q1 ... q8: the jaws' end stops are part of grasping
TERMS = ["r_distance", "r_grapple", "r_lift", "r_balance", "r_ground"]
TERMINATIONS = ["diverged", "joint_limit", "overspeed", "log_too_far", "not_reached", "time_limit"]
CONDITIONS = ["not_reached", "not_lifted", "not_held", "off_centre"]


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
    q8, radius, diameter = rng.uniform([0.05, 5.5, D_MIN], [0.6, 7.5, D_MAX])
    q = np.array([q1, q2, q3, q4, np.pi / 2 - q2 - q3 + swing5, np.pi / 2 + swing6, q7, q8])
    return q, np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), yaw]), diameter


def ease_start(
    q: Array, log_pose: Array, diameter: float, difficulty: float
) -> tuple[Array, Array, float]:
    """A start of `sample_start` with its log moved towards an easy place, which difficulty 0 has.

    The easy place is under the boom's tip, or as near to it as logs may lie. It has the grapple's
    yaw and the mean diameter.
    """
    q1, q7, (x, y, yaw) = q[0], q[6], log_pose
    out, _ = tip_position(*q[1:4])
    easiest = np.array([np.clip(out, 5.5, 7.5), q1, q1 - q7, (D_MIN + D_MAX) / 2])
    way = np.array([np.hypot(x, y), np.arctan2(y, x), yaw, diameter]) - easiest
    way[2] = (way[2] + np.pi / 2) % np.pi - np.pi / 2  # a log is the same after half a turn
    radius, azimuth, yaw, diameter = easiest + difficulty * way
    yaw = (yaw + np.pi / 2) % np.pi - np.pi / 2
    return q, np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), yaw]), diameter


# ---- relative pose, reward and rules


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
    # (N,) 1 - (force of log and crane on the ground) / (weight of the log), clipped to [0, 1]
    carried: Array | float = 0.0


def relative_pose(state: CraneState, offset: str = "plus") -> tuple[Array, Array, Array]:
    """Delta_p (N, 3) in m, Delta_psi (N,) in [0, 1], its signed angle (N,) in rad.

    Paper: Eqs. (relative distance) and (angle distance). offset "plus" adds d_off = (d_max - d) / 2
    of the log's diameter d, "minus" subtracts it. The signed angle turns the grapple's axis into
    the log's. A log looks the same after half a turn, so this is the shorter turn, or the longer
    one where the shorter would take the rotator beyond ROTATOR_MAX.
    """
    delta_p = state.log_centre - state.grapple_centre
    delta_p[:, 2] += (1.0 if offset == "plus" else -1.0) * (D_MAX - state.diameter) / 2
    (grapple_x, grapple_y, _), (log_x, log_y, _) = state.grapple_axis.T, state.log_axis.T
    shadow = np.maximum(np.sqrt(log_x**2 + log_y**2), 1e-9)  # its length on the ground
    log_x, log_y = log_x / shadow, log_y / shadow
    dot = grapple_x * log_x + grapple_y * log_y
    cross = grapple_x * log_y - grapple_y * log_x
    signed_angle = (np.arctan2(cross, dot) + np.pi / 2) % np.pi - np.pi / 2
    slew = np.arctan2(state.log_centre[:, 1], state.log_centre[:, 0]) - state.q[:, 0]
    slew = (slew + np.pi) % (2 * np.pi) - np.pi
    # q7 once the crane faces the log and the grapple is aligned; a hanging grapple's yaw is q1 - q7
    rotator = state.q[:, 6] + slew - signed_angle
    signed_angle += np.pi * np.sign(rotator) * (np.abs(rotator) > ROTATOR_MAX)
    return delta_p, 1.0 - np.minimum(np.abs(dot), 1.0), signed_angle


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


def grip_depth(state: CraneState) -> Array:
    """How far the tips of hanging jaws are below the log's centre, in radii of the log, (N,).

    Jaws that pinch a log above its centre squeeze it out.
    """
    tips = state.grapple_centre[:, 2] + PIVOT_HEIGHT - JAW_LENGTH * np.sin(state.q[:, 7])
    return (state.log_centre[:, 2] - tips) / (state.diameter / 2)


def reward_terms(
    state: CraneState,
    distance: Array,
    clearance: Array,
    miss: Array,
    command: Array,
    ground: Array,
    difficulty: float = 1.0,
    kind: str = "staged",
    actuators: str = "ideal",
) -> Array:
    """The TERMS of the reward, which is their sum, (5, N).

    distance (N,) in m is ||Delta_p|| + 1 m Delta_psi. "staged" takes Delta_p + (0, 0,
    CLOSING_HEIGHT), which is 0 where the grapple is CLOSING_HEIGHT higher. clearance and miss (N,)
    in m are `log_clearance` and `centre_miss`, command (N, 6) the commanded velocities in rad/s and
    m/s, ground (N,) the decision's largest force of crane on ground in N.

    kind "paper" is Sec. IV-B2 as printed. "staged" pays r_grapple near the log's centre, r_lift if
    the log is lifted there, and r_balance while both jaws hold it (docs/environment.md says why).
    r_ground punishes hitting the ground. An easy task forgives it: a crane that does not lift yet
    would learn to stay away. actuators "hydraulic": a grip of both jaws earns all of r_grapple,
    empty jaws at most half, and a lift pays in full where the tips are deep (`grip_depth`).
    """
    r_ground = np.zeros_like(distance)
    r_distance = np.exp(-OMEGA2 * distance)
    closed = state.q[:, 7] / Q8_MAX
    if kind == "paper":
        r_grapple = r_distance * closed + (1 - closed) * (1 - r_distance)
        height_error = np.abs(state.log_centre[:, 2] - DESIRED_HEIGHT)
        r_lift = (1 - np.tanh(height_error)) * (1 - r_grapple)
        r_balance = (1 - np.tanh(np.linalg.norm(command, axis=-1))) * (1 - r_lift)
    else:
        near = np.minimum(1, np.exp(-NEAR_SHARPNESS * (distance - REACH_DISTANCE)))
        held = state.touching.all(axis=-1)
        centred = np.exp(-((miss / LIFT_MISS) ** 2))
        grip = centred
        if actuators == "hydraulic":
            closed = np.where(held, 1.0, np.minimum(closed, EMPTY_GRIP))
            # nothing for tips half a radius above the log's centre, all for half a radius below it
            grip = centred * np.clip(0.5 + grip_depth(state), 0, 1)
        r_grapple = GRAPPLE_WEIGHT * near * np.exp(-((miss / GRAPPLE_MISS) ** 2)) * closed
        clearance = np.maximum(clearance, 1e-9)  # 0 on the ground
        height = np.sqrt(np.minimum(clearance, 1 / clearance))  # 1 at 1 m, less below and above
        calm = 1 - np.tanh(np.linalg.norm(command[:, :5], axis=-1))  # the jaws may squeeze
        lift, r_carry = grip * height, CARRY_WEIGHT * centred * held * state.carried
        r_lift, r_balance = LIFT_WEIGHT * lift + r_carry, BALANCE_WEIGHT * calm * held * lift
        hardness = np.clip(2 * ground / GENTLE_FORCE - 1, 0, GROUND_MOST[actuators])
        r_ground = -GROUND_WEIGHT[actuators] * difficulty**4 * hardness
    return np.array([r_distance, r_grapple, r_lift, r_balance, r_ground])


def termination_rule(
    state: CraneState, time: Array, reached: Array, diverged: Array, limits: Array, speed: Array
) -> Array:
    """The first of TERMINATIONS that ends each episode, "none" where it goes on, (N,).

    time (N,) in s since the start, reached (N,) bool, limits (8, 2) of the joints and speed (2, 6),
    as in SPEEDS, in rad, m and s.
    """
    q, (low, high) = state.q[:, LIMITED], limits[LIMITED].T
    beyond = (q < low - LIMIT_TOLERANCE) | (q > high + LIMIT_TOLERANCE)
    rules = [  # in the order of TERMINATIONS
        diverged,
        beyond.any(axis=-1),
        ((state.dq < 2 * speed[0]) | (state.dq > 2 * speed[1])).any(axis=-1),
        np.linalg.norm(state.log_centre - state.grapple_centre, axis=-1) > LOG_RANGE,
        ~reached & (time > REACH_TIME - 1e-9),
        time > TIME_LIMIT - 1e-9,
    ]
    return np.select(rules, TERMINATIONS, default="none")


def grip_conditions(clearance: Array, touching: Array, miss: Array) -> Array:
    """Whether the log is now lifted, held by both jaws, and held near its centre: (3, N) bool.

    clearance and miss (N,) in m, touching (N, 2) bool, as in `info` and `CraneState`.
    """
    return np.array([clearance >= MIN_CLEARANCE, touching.all(axis=-1), miss <= MAX_MISS])
