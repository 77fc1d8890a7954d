"""A scripted crane: resolved-rate control and four phases, the classical baseline of the policies.

It sees what a policy sees, the 18 numbers of the observation, and learns nothing. It knows the
crane's lengths and speed limits (assets/README.md) and that Delta_p is 0 where the jaws' tips just
clear the ground, whatever the log's diameter.

Frames: K_i = K_{i-1} RotZ(q_i) Trans(a, 0, d) RotX(alpha). A column of the Jacobian is z x (p - o)
for a joint that turns about the axis z through o, and z for a telescope stage. The passive joints
q5, q6 are not commanded, but where the grapple hangs plumb, q5 = pi/2 - q2 - q3 and q6 = pi/2:
the Jacobian J of p_C and yaw by q1 ... q4, q7 is taken with dq5 = -dq2 - dq3 and dq6 = 0.
Damped least squares (Nakamura and Hanafusa, 1986) turns a task velocity v = (dx, dy, dz, dyaw) into
joint rates dq. J and dq are fractions of the joints' limits, so fast joints move more:

    dq = J^T (J J^T + lambda^2 I)^-1 v

The controller moves p_plumb, the grapple's place when plumb, over the log, at the height h that the
phase asks for. The tip follows the swing s = p_C - p_plumb, which damps it:

    v = bound(k_p (Delta_p + s + h)) + k_s s     k_s s horizontal, v's change bounded too
    s'' = -omega^2 s - x''                of the tip at x; with x' = k_s s its damping is k_s s'

Hydraulic drives answer late, by T. On the way to the log Delta_p is therefore replaced by
Delta_p - T v, with the last command v. In k_s s the swing is replaced by s + T s'.

Phases of each crane: APPROACH (over the log, turning along it), DESCEND, CLOSE, LIFT. On the task
of loading_crane.py `ScriptedLoadingCrane` goes on with SWING, LOWER, OPEN and RISE.

    python eval_crane.py scripted                    # --video and --viewer work too
    python eval_crane.py scripted_crane:UnsignedScriptedCrane --env.signed-yaw False
"""

from typing import NamedTuple

import numpy as np

from crane_env import LOG_LENGTH, PIVOT_HEIGHT, SPEED_LIMITS
from loading_crane import BED, PLACE_X, STAKE_TOP

DH = (  # a [m], d [m], alpha [rad] of q1, q2, q3, q4 stage 1, q4 stage 2, q5, q6, q7
    (-0.18, 2.425, np.pi / 2),
    (3.49288, 0.0, 0.0),
    (-0.3925, 0.0, np.pi / 2),
    (0.0, 3.157, 0.0),
    (0.0, 0.0, -np.pi / 2),
    (-0.213, 0.0, -np.pi / 2),
    (0.0, 0.0, -np.pi / 2),
    (0.0, 0.578, 0.0),
)
SLEW_HEIGHT = 1.1407  # m, of frame K0 above the ground
CENTRE_DEPTH = 0.5  # m, p_C below K8
DT = 0.1  # s, one step
LOW, HIGH = SPEED_LIMITS[:, :5]  # speed limits of q1 ... q4, q7, rad/s and m/s
SPEED = np.minimum(-LOW, HIGH)

DAMPING = 0.1  # lambda, m/s at full joint speed; J's smallest singular value in the task: 0.85
K_YAW = 3.0  # 1/s; from pi/2 to 0.1 rad in one second
Q7_MAX = np.pi / 2 + 0.2  # rad; goals start within pi/2, pose errors move them by less than 0.2
NEARLY_ALIGNED = 0.2  # rad; to descend
Q8_CLOSED = 1.2  # rad; gripped: a 0.8 m log stops the jaws at 1.75 rad
Q8_THIN, Q8_THICK = 1.8, 1.55  # rad; closing jaws meet a log of 0.3 m here, one of 0.8 m there
CARRY_HEIGHT = 1.2  # m, of p_C; the log then hangs 0.8 m or more above the ground
APPROACH, DESCEND, CLOSE, LIFT = range(4)

# loading
BUNK_RADIUS, BUNK_AZIMUTH = -PLACE_X, -np.pi  # m, rad; logs start at azimuths down to -2.1
BUNK_Q7 = -np.pi / 2  # rad, of a log along the truck
WAIT_AZIMUTH = -2.4  # rad; any log is 1.3 m from the truck there, so it waits there to be high
RISE_HEIGHT = 3.0  # m, of p_C; the jaws are then above the stakes
DRAG_HEIGHT = 0.3  # m, of the log's lowest point, before it turns and moves sideways
SLIPPED = 0.85  # m, of Delta_p; a gripped log has at most 0.7
RELEASE_RATE = SPEED_LIMITS[1, 5]  # rad/s, of jaws that open at full command
FREE_Q8 = 1.3  # rad; wider jaws have let go: tips 1.1 m apart
JAW_OUTLINE = np.array(  # m, corners of assets/crane.xml: from a jaw's pivot along it, and outward
    [[0.3164, 0.2930], [0.5402, 0.2930], [0.7378, 0.1879], [0.8490, 0.0230]]
)
JAW_RADIUS = 0.025  # m, half of a jaw's thickness
SWING, LOWER, OPEN, RISE = range(4, 8)


class Settings(NamedTuple):
    """What depends on the drives.

    IDEAL was set by hand. HYDRAULIC comes from random searches on 72 trials of seed 10000, for
    success and gentle success (docs/learned.md). LOADING_IDEAL and LOADING_HYDRAULIC come from
    random searches on 60 and 48 trials of seed 10000.
    """

    k_p: float = 1.5  # 1/s; half the pendulum's omega of 3 rad/s, so as not to drive it
    k_s: float = 2.5  # 1/s; adds k_s / (2 omega) = 0.4 to the damping ratio of the swing
    latency: float = 0.0  # s, T
    max_speed: float = 2.0  # m/s; 95 % of the ways are below 5.3 m, and 6 s must suffice
    max_acceleration: float = 2.0  # m/s^2; leans the grapple by 0.2 rad, a quarter of q6's range
    q8_open: float = 0.4  # rad; tips 2.2 m apart and, hovering, 0.15 m above a 0.8 m log
    hover: float = 0.4  # m above the closing height; the tips then pass over the log
    near: float = 0.5  # m off the log at most, to descend: open tips come down beside the log
    over: float = 0.12  # m off the log at most, to close the jaws
    level: float = 0.03  # m off the closing height at most: higher tips only pinch a thin log
    aligned: float = 0.1  # rad off the log's yaw at most, to close the jaws
    clearance: float = 0.0  # m, of the tips above the ground when they close around a thin log
    rise: float = 0.0  # m/rad, how much higher they are before; a thick log stops the jaws there
    jaw_speed: float = 1.0  # command of the closing jaws, a fraction of q8's limit
    meeting_speed: float = 1.0  # the same from slow_at to Q8_THIN, where they meet the log
    slow_at: float = 1.2  # rad, of q8
    squeeze: float = 1.0  # command of the jaws while the crane lifts
    stalled: float = 0.1  # rad/s; slower jaws have gripped
    # loading
    lift_speed: float = 2.0  # m/s at most, to rise
    over_stakes: float = 0.15  # m, of the log's lowest point above the stakes, to swing over them
    more: float = 0.3  # m, by which it goes on rising
    carry_p: float = 1.0  # 1/s, like k_p; the loaded grapple swings more slowly
    carry_speed: float = 2.0  # m/s at most, sideways
    turn_p: float = 1.5  # 1/s; loose logs turn in the jaws when these turn fast
    turn_speed: float = 1.0  # rad/s at most
    placed: float = 0.45  # m off the place at most, to lower; it goes on moving there
    still: float = 0.25  # m, swing at most, to lower
    lower_speed: float = 0.8  # m/s at most
    release: float = 0.06  # m, of the jaws above the bed, to open
    touch: float = 0.02  # m, of the log above the bed, to open
    calm: float = 0.3  # m/s at which it swings at most, to open
    release_speed: float = (
        0.12  # of the jaws, a fraction of q8's limit, until FREE_Q8; 0.2 drops logs
    )
    q8_release: float = 0.9  # rad; the tips are 1.73 m apart then, and the stakes 2.3 m


IDEAL = Settings()
HYDRAULIC = Settings(
    k_p=1.83, k_s=0.497, latency=0.283, max_speed=1.16, max_acceleration=1.0, q8_open=0.101,
    hover=0.11, near=0.391, over=0.119, level=0.0442, aligned=0.0915, clearance=0.0905, rise=0.411,
    jaw_speed=0.945, meeting_speed=0.182, slow_at=1.0, squeeze=0.801, stalled=0.0441,
)  # fmt: skip


LOADING_IDEAL = IDEAL._replace(
    k_s=2.1, max_speed=2.24, max_acceleration=2.15, aligned=0.0937, still=0.3, carry_p=1.06,
    turn_speed=1.34, lift_speed=1.13, more=0.513, release=0.03, q8_release=0.956,
)  # fmt: skip
LOADING_HYDRAULIC = HYDRAULIC._replace(
    k_s=0.705, latency=0.223, max_speed=1.36, max_acceleration=1.88, near=0.355, over=0.0833,
    level=0.0559, aligned=0.121, clearance=0.0387, rise=0.1, jaw_speed=1.0, squeeze=0.69,
    lift_speed=2.5, over_stakes=0.08, more=0.106, carry_speed=2.49, turn_p=0.807,
    lower_speed=1.0, release_speed=0.4, q8_release=0.839,
)  # fmt: skip


def forward_kinematics(q: np.ndarray) -> np.ndarray:
    """Frames K0 ... K8 in the world, (9, N, 4, 4), of N cranes with joints q (N, 8), rad and m."""
    frame = np.tile(np.eye(4), (len(q), 1, 1))
    frame[:, 2, 3] = SLEW_HEIGHT
    frames = [frame]
    straight = np.zeros(len(q))
    turns = [q[:, 0], q[:, 1], q[:, 2], straight, straight, q[:, 4], q[:, 5], q[:, 6]]
    for i, ((a, d, alpha), theta) in enumerate(zip(DH, turns)):
        extension = q[:, 3] if i in (3, 4) else 0.0
        c, s = np.cos(theta), np.sin(theta)
        link = np.zeros((len(q), 4, 4))
        link[:, 0] = np.stack([c, -s * np.cos(alpha), s * np.sin(alpha), a * c], axis=-1)
        link[:, 1] = np.stack([s, c * np.cos(alpha), -c * np.sin(alpha), a * s], axis=-1)
        link[:, 2, 1], link[:, 2, 2] = np.sin(alpha), np.cos(alpha)
        link[:, 2, 3], link[:, 3, 3] = d + extension, 1.0
        frames.append(frames[-1] @ link)
    return np.stack(frames)


def grapple_centre(frames: np.ndarray) -> np.ndarray:
    """p_C (N, 3) in m, on the z axis of K8."""
    return frames[-1, :, :3, 3] + CENTRE_DEPTH * frames[-1, :, :3, 2]


def plumb(q: np.ndarray) -> np.ndarray:
    """q (N, 8) with the passive joints where gravity holds them at rest."""
    q = q.copy()
    q[:, 4], q[:, 5] = np.pi / 2 - q[:, 1] - q[:, 2], np.pi / 2
    return q


def plumb_jacobian(frames: np.ndarray) -> np.ndarray:
    """d(x, y, z, yaw of the grapple) / d(q1 ... q4, q7), (N, 4, 5), from a plumb crane's frames."""
    axis, origin = frames[:-1, :, :3, 2], frames[:-1, :, :3, 3]
    turning = np.concatenate(  # rows x, y, z, yaw of each joint, (8, N, 4)
        [np.cross(axis, grapple_centre(frames) - origin), axis[:, :, 2:]], axis=-1
    )
    telescope = np.concatenate([axis[3] + axis[4], np.zeros((len(axis[3]), 1))], axis=-1)
    q5 = turning[5]
    columns = [turning[0], turning[1] - q5, turning[2] - q5, telescope, turning[7]]
    return np.stack(columns, axis=-1)


def damped_least_squares(jacobian: np.ndarray, task: np.ndarray, damping: float) -> np.ndarray:
    """Joint rates (N, n) for task velocities (N, m) and Jacobians (N, m, n)."""
    transposed = jacobian.transpose(0, 2, 1)
    square = jacobian @ transposed + damping**2 * np.eye(task.shape[1])
    return (transposed @ np.linalg.solve(square, task[:, :, None]))[:, :, 0]


def jaw_depth(q8: np.ndarray) -> np.ndarray:
    """How far the jaws reach below p_C, (N,) in m. Nearly closed jaws are bulges, not tips."""
    along, outward = JAW_OUTLINE.T[:, :, None]
    below_pivot = np.max(along * np.sin(q8) - outward * np.cos(q8), axis=0)
    return below_pivot + JAW_RADIUS - PIVOT_HEIGHT


def half_turn(angle: np.ndarray) -> np.ndarray:
    """The angle in [-pi/2, pi/2) that turns a log into the same place."""
    return (angle + np.pi / 2) % np.pi - np.pi / 2


def bounded(vector: np.ndarray, length: float) -> np.ndarray:
    """vector (N, 3), shortened where it is longer than length."""
    return vector / np.maximum(1.0, np.linalg.norm(vector, axis=-1, keepdims=True) / length)


class ScriptedCrane:
    """Maps observations (N, 18 or more) of ForestryCrane-v0 to actions (N, 6).

    settings: None takes the second of `drives` for 32 or more numbers, as hydraulic drives have
    them, else the first.
    """

    signed_yaw = True  # False finds the sign of Delta_psi by turning
    drives = IDEAL, HYDRAULIC

    def __init__(self, settings: Settings | None = None):
        self.settings = settings
        options = {"frame_skip": 20, "offset": "plus", "axes": "crane"}
        self.task = {"options": options | {"signed_yaw": self.signed_yaw}}  # what it is made for

    def predict(
        self, obs: np.ndarray, state: "ScriptedCrane | None" = None, deterministic: bool = True
    ) -> tuple[np.ndarray, "ScriptedCrane"]:
        """Actions (N, 6) and the memory of this batch of trials. None starts new trials."""
        if state is None:
            settings = self.settings or self.drives[obs.shape[1] >= 32]
            state = type(self)(settings)
            state.start(len(obs))
        return state.act(obs), state

    def start(self, cranes: int) -> None:
        self.phase = np.full(cranes, APPROACH)
        self.velocity = np.zeros((cranes, 3))  # commanded last, m/s
        self.swing = None  # (N, 3) m, before
        self.q7_goal = np.zeros(cranes)  # rad, over the log
        self.log_yaw = None  # (N, 2) rad, where the log may lie by the first observation
        self.doubt = np.zeros((cranes, 2))  # how badly either has predicted Delta_psi since

    def find_signed_angle(self, delta_psi: np.ndarray, grapple_axis: np.ndarray) -> np.ndarray:
        """Angle to the log (N,) in rad from Delta_psi (N,) = 1 - |cos|, which hides its sign.

        The first observation leaves two yaws for the log, and the rotator turns towards one of
        them. The log's yaw is the one that has predicted Delta_psi better since.
        """
        cosine = (1 - delta_psi) / np.linalg.norm(grapple_axis[:, :2], axis=-1)  # undo the tilt
        angle = np.arccos(np.clip(cosine, 0, 1))
        grapple_yaw = np.arctan2(grapple_axis[:, 1], grapple_axis[:, 0])
        if self.log_yaw is None:
            self.log_yaw = grapple_yaw[:, None] + np.stack([angle, -angle], axis=-1)
        predicted = half_turn(self.log_yaw - grapple_yaw[:, None])
        self.doubt += np.abs(np.abs(predicted) - angle[:, None])
        better = predicted[np.arange(len(angle)), self.doubt.argmin(axis=-1)]
        return np.copysign(angle, better)

    def act(self, obs: np.ndarray) -> np.ndarray:
        obs, settings = np.asarray(obs, dtype=np.float64), self.settings
        q, q8, q8_speed = obs[:, :8], obs[:, 7], obs[:, 13]
        # Delta_p comes along the crane's axes; this controller works along the world's
        cos, sin, (ahead, left, up) = np.cos(q[:, 0]), np.sin(q[:, 0]), obs[:, 14:17].T
        delta_p = np.stack([cos * ahead - sin * left, sin * ahead + cos * left, up], axis=-1)
        frames, plumb_frames = forward_kinematics(q), forward_kinematics(plumb(q))
        p_centre, p_plumb = grapple_centre(frames), grapple_centre(plumb_frames)
        swing = p_centre - p_plumb
        swing_rate = 0 * swing if self.swing is None else (swing - self.swing) / DT
        self.swing, self.swing_rate = swing, swing_rate
        angle = obs[:, 17]
        if not self.signed_yaw:
            angle = self.find_signed_angle(angle, frames[-1, :, :3, 0])

        # The rotator turns against yaw, and against the slew to come. A log looks the same after
        # half a turn: keep to one goal, in the middle of the rotator's range.
        x, y, _ = (p_centre + delta_p).T
        slew = np.arctan2(y, x) - np.arctan2(p_plumb[:, 1], p_plumb[:, 0])
        goal = self.q7_goal + half_turn(q[:, 6] + slew - angle - self.q7_goal)
        self.q7_goal = np.where(np.abs(goal) > Q7_MAX, half_turn(goal), goal)
        turn = q[:, 6] + slew - self.q7_goal

        away = np.linalg.norm(delta_p[:, :2], axis=-1)
        # Tips far under a thick log would pull soft drives down. Jaws meet a thick log early, so
        # the grapple starts high and sinks while they close.
        expected_q8 = q8 + settings.latency * q8_speed
        thicker = np.clip(Q8_THIN - expected_q8, 0.0, Q8_THIN - Q8_THICK)
        clearance = settings.clearance + settings.rise * thicker
        level = np.abs(delta_p[:, 2] + clearance) < settings.level
        near = (away < settings.near) & (np.abs(turn) < NEARLY_ALIGNED)
        in_place = (away < settings.over) & level & (np.abs(turn) < settings.aligned)
        gripped = (q8 > Q8_CLOSED) & (q8_speed < settings.stalled)
        self.phase[(self.phase == APPROACH) & near] = DESCEND
        self.phase[(self.phase == DESCEND) & in_place] = CLOSE
        self.phase[(self.phase == CLOSE) & gripped] = LIFT
        hovering, lifting = self.phase == APPROACH, self.phase >= LIFT

        # Delta_p,z is 0 where the jaws' tips just clear the ground, whatever the log's diameter.
        way = delta_p + swing - settings.latency * self.velocity
        way[:, 2] += np.where(hovering, settings.hover, clearance)
        carried, turn_of_log, jaws_of_log = self.carry(obs, p_plumb)
        wanted = bounded(settings.k_p * way, settings.max_speed)
        wanted[lifting] = carried[lifting]
        damping = settings.k_s * (swing + settings.latency * swing_rate)[:, :2]
        wanted[:, :2] += np.where((self.phase >= OPEN)[:, None], 0.0, damping)
        self.velocity += bounded(wanted - self.velocity, settings.max_acceleration * DT)
        yaw_rate = np.where(lifting, turn_of_log, K_YAW * turn)

        task = np.concatenate([self.velocity, yaw_rate[:, None]], axis=-1)
        rates = SPEED * damped_least_squares(plumb_jacobian(plumb_frames) * SPEED, task, DAMPING)
        fractions = np.where(rates < 0, -rates / LOW, rates / HIGH)
        # too fast for a joint: all slow down and the direction stays; the rotator alone is clipped
        fractions /= np.maximum(1.0, np.abs(fractions[:, :4]).max(axis=-1, keepdims=True))
        jaws = (settings.q8_open - q8) / (DT * SPEED_LIMITS[1, 5])
        meeting = (q8 > settings.slow_at) & (q8 < Q8_THIN)
        closing = np.where(meeting, settings.meeting_speed, settings.jaw_speed)
        jaws = np.where(self.phase == CLOSE, closing, jaws)
        jaws = np.where(lifting, jaws_of_log, jaws)
        return np.clip(np.concatenate([fractions, jaws[:, None]], axis=-1), -1.0, 1.0)

    def carry(
        self, obs: np.ndarray, p_plumb: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What cranes do from LIFT on: velocity (N, 3) m/s, turn (N,) rad/s, jaws' command (N,).

        This crane only lifts. p_plumb (N, 3) in m is the grapple's place when plumb.
        """
        way = np.zeros_like(p_plumb)
        way[:, 2] = CARRY_HEIGHT - p_plumb[:, 2]
        velocity = bounded(self.settings.k_p * way, self.settings.max_speed)
        return velocity, np.zeros(len(obs)), np.full(len(obs), self.settings.squeeze)


class UnsignedScriptedCrane(ScriptedCrane):
    """The same for the paper's Delta_psi, which has no sign."""

    signed_yaw = False


class ScriptedLoadingCrane(ScriptedCrane):
    """Loads the log: observations (N, 23 or more) of ForestryCraneLoading-v0.

    LIFT raises the log and turns it along the truck. SWING goes on over the stakes, round the slew
    axis at the bunk's radius. LOWER ends where the log or the jaws are just above the bed. In OPEN
    the crane rises as the opening jaws reach deeper. RISE goes straight up. A log that slips out of
    the jaws before is grasped again.
    """

    drives = LOADING_IDEAL, LOADING_HYDRAULIC

    def start(self, cranes: int) -> None:
        super().start(cranes)
        self.spot = np.zeros((cranes, 3))  # m, where the jaws open

    def carry(
        self, obs: np.ndarray, p_plumb: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        settings, phase, latency = self.settings, self.phase, self.settings.latency
        q1, q7, q8 = obs[:, 0], obs[:, 6], obs[:, 7]
        up, angle, tilt = obs[:, 20:23].T  # from the log to its place in the bunk
        lowest = BED - up - LOG_LENGTH / 2 * np.sin(tilt)  # of the log, m above the ground
        radius, height = np.hypot(p_plumb[:, 0], p_plumb[:, 1]), p_plumb[:, 2]
        slew = BUNK_AZIMUTH - q1
        # The rotator turns against the slew to come. Of the two goals, half a turn apart, that near
        # BUNK_Q7 keeps it within 0.6 rad of its middle before.
        ahead = q7 + slew - BUNK_Q7
        turn = ahead - half_turn(ahead - angle)
        # jaws that open reach deeper; they are this much wider when the crane has followed them
        opening = RELEASE_RATE * settings.release_speed * (1 / settings.k_p + latency)
        deepest = jaw_depth(np.maximum(q8 - opening, np.minimum(q8, np.pi / 2)))
        above = height - BED - deepest - settings.release

        # phases
        high = lowest > STAKE_TOP + settings.over_stakes
        miss = np.maximum(np.abs(slew) * radius, np.abs(radius - BUNK_RADIUS))
        still = np.linalg.norm(self.swing[:, :2], axis=-1) < settings.still
        over_place = (miss < settings.placed) & still & (np.abs(turn) < settings.aligned)
        slipped = np.linalg.norm(obs[:, 14:17], axis=-1) > SLIPPED
        phase[(phase == LIFT) & high & (np.abs(turn) < NEARLY_ALIGNED)] = SWING
        phase[(phase == SWING) & over_place] = LOWER
        calm = np.linalg.norm(self.swing_rate[:, :2], axis=-1) < settings.calm
        down = (above < 0) | (lowest < BED + settings.touch)
        phase[(phase == LOWER) & down & calm] = OPEN
        phase[(phase == OPEN) & (q8 < settings.q8_release + 0.1)] = RISE
        phase[((phase == LIFT) | (phase == SWING)) & slipped] = APPROACH
        opens = phase >= OPEN
        self.spot[~opens] = p_plumb[~opens]

        # velocity
        around = radius * np.where(phase == LIFT, WAIT_AZIMUTH - q1, slew)
        outward, cos, sin = BUNK_RADIUS - radius, np.cos(q1), np.sin(q1)
        way = np.stack([outward * cos - around * sin, outward * sin + around * cos], axis=-1)
        way = np.where(opens[:, None], (self.spot - p_plumb)[:, :2], way)
        way[(phase == LIFT) & (lowest < DRAG_HEIGHT)] = 0.0
        way -= latency * self.velocity[:, :2]
        level = bounded(settings.carry_p * way, settings.carry_speed)
        over_stakes = STAKE_TOP + settings.over_stakes + settings.more - lowest
        sink = -above - np.where((phase == LOWER) & ~down, 2 * settings.release, 0.0)
        rise = np.select([phase <= SWING, phase <= OPEN], [over_stakes, sink], RISE_HEIGHT - height)
        rise = settings.k_p * (rise - latency * self.velocity[:, 2])
        rise = np.clip(rise, -settings.lower_speed, settings.lift_speed)

        # rotator and jaws
        turn = np.clip(settings.turn_p * turn, -settings.turn_speed, settings.turn_speed)
        turn[opens | (lowest < DRAG_HEIGHT)] = 0.0
        fastest = np.where(q8 < FREE_Q8, 1.0, settings.release_speed)
        release = np.clip((settings.q8_release - q8) / (DT * RELEASE_RATE), -fastest, 1.0)
        jaws = np.where(opens, release, settings.squeeze)
        return np.column_stack([level, rise]), turn, jaws
