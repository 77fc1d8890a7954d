"""A scripted crane: resolved-rate control and four phases, the classical baseline of the policies.

It sees what a policy sees, 18 numbers and on hydraulic drives the force of the slew's oil, and
learns nothing. It knows the crane's lengths and speed limits (assets/README.md) and that Delta_p is
0 where the jaws' tips just clear the ground, whatever the log's diameter.

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
Delta_p - T v, with the last command v. In k_s s the swing is replaced by s + T s', and q8 by
q8 + T q8'. The slew's oil is a soft spring without much damping. On it crane and grapple swing with
a period of 2.8 s, for longer than a trial. Pressure feedback damps this: the slew yields to the
force F of its oil, as a fraction of the limit, by relief F.

Phases of each crane: APPROACH (over the log, turning along it), DESCEND, CLOSE, LIFT. On the task
of loading_crane.py `ScriptedLoadingCrane` goes on with SWING, LOWER, OPEN and RISE.

    python eval_crane.py scripted  # --video and --viewer work too
"""

from dataclasses import dataclass

import numpy as np

from crane_env import SPEED_LIMITS

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
Q7_MAX = np.pi / 2 + 0.2  # rad; goals start within pi/2, pose errors move them by less than 0.2
NEARLY_ALIGNED = 0.2  # rad; to descend
Q8_CLOSED = 1.2  # rad; gripped: a 0.8 m log stops the jaws at 1.75 rad
Q8_THIN, Q8_THICK = 1.8, 1.55  # rad; closing jaws meet a log of 0.3 m here, one of 0.8 m there
CARRY_HEIGHT = 1.2  # m, of p_C; the log then hangs 0.8 m or more above the ground
APPROACH, DESCEND, CLOSE, LIFT = range(4)

SWING, LOWER, OPEN, RISE = range(4, 8)  # of a crane that loads


@dataclass(frozen=True)
class Settings:
    """What depends on the drives.

    IDEAL was set by hand. HYDRAULIC comes from a random search, some 90 candidates on 72 trials of
    seed 10000 of each harder level, for success and gentle success, then from tries on seeds 10000
    and 40000 (docs/learned.md).
    """

    k_p: float = 1.5  # 1/s; half the pendulum's omega of 3 rad/s, so as not to drive it
    k_yaw: float = 3.0  # 1/s; from pi/2 to 0.1 rad in one second
    k_s: float = 2.5  # 1/s; adds k_s / (2 omega) = 0.4 to the damping ratio of the swing
    latency: float = 0.0  # s, T
    max_speed: float = 2.0  # m/s; 95 % of the ways are below 5.3 m, and 6 s must suffice
    max_acceleration: float = 2.0  # m/s^2; leans the grapple by 0.2 rad, a quarter of q6's range
    haste: float = 1.0  # times this acceleration to lift; soft oil takes 1 s to bear a thick log
    relief: float = 0.0  # rad/s of the slew, where its oil pushes with all its force
    q8_open: float = 0.4  # rad; tips 2.2 m apart and, hovering, 0.15 m above a 0.8 m log
    hover: float = 0.4  # m above the closing height; the tips then pass over the log
    near: float = 0.5  # m off the log at most, to descend: open tips come down beside the log
    over: float = 0.12  # m off the log at most, to close the jaws
    level: float = 0.03  # m off the closing height at most: higher tips only pinch a thin log
    aligned: float = 0.1  # rad off the log's yaw at most, to close the jaws
    clearance: float = 0.0  # m, of the tips above the ground when they close around a thin log
    rise: float = 0.0  # m/rad, more clearance for each rad that q8 is still short of Q8_THIN
    jaw_speed: float = 1.0  # command of the closing jaws, a fraction of q8's limit
    meeting_speed: float = 1.0  # the same from slow_at to Q8_THIN, where they meet the log
    slow_at: float = 1.2  # rad, of q8
    squeeze: float = 1.0  # command of the jaws while the crane lifts
    stalled: float = 0.1  # rad/s; slower jaws have gripped


IDEAL = Settings()
HYDRAULIC = Settings(
    k_yaw=2.0, k_s=0.5, latency=0.283, max_speed=1.47, max_acceleration=1.5, haste=3.7, relief=0.24,
    q8_open=0.1, hover=0.14, near=0.38, over=0.25, level=0.09, aligned=0.075, clearance=-0.01,
    rise=0.52, jaw_speed=0.93, meeting_speed=0.19, slow_at=0.94, squeeze=0.75, stalled=0.25,
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


def half_turn(angle: np.ndarray) -> np.ndarray:
    """The angle in [-pi/2, pi/2) that turns a log into the same place."""
    return (angle + np.pi / 2) % np.pi - np.pi / 2


def bounded(vector: np.ndarray, length: float) -> np.ndarray:
    """vector (N, 3), shortened where it is longer than length."""
    return vector / np.maximum(1.0, np.linalg.norm(vector, axis=-1, keepdims=True) / length)


class ScriptedCrane:
    """Maps observations (N, 18 or more) of ForestryCrane-v0 to actions (N, 6).

    settings: None takes the second of `drives` where observations have the column SLEW_FORCE, as
    those of hydraulic drives with `sensors`, else the first.
    """

    drives = IDEAL, HYDRAULIC
    SLEW_FORCE = 26  # column of the force of the slew's oil

    def __init__(self, settings: Settings | None = None):
        self.settings = settings
        options = {"frame_skip": 20, "offset": "plus", "axes": "crane", "signed_yaw": True}
        self.task = {"options": options}  # what it is made for

    def predict(
        self, obs: np.ndarray, state: "ScriptedCrane | None" = None, deterministic: bool = True
    ) -> tuple[np.ndarray, "ScriptedCrane"]:
        """Actions (N, 6) and the memory of this batch of trials. None starts new trials."""
        if state is None:
            ideal, hydraulic = self.drives
            drives = hydraulic if obs.shape[1] > self.SLEW_FORCE else ideal
            state = type(self)(self.settings or drives)
            state.start(len(obs))
        return state.act(obs), state

    def start(self, cranes: int) -> None:
        self.phase = np.full(cranes, APPROACH)
        self.velocity = np.zeros((cranes, 3))  # commanded last, m/s
        self.swing = None  # (N, 3) m, of the last step
        self.q7_goal = np.zeros(cranes)  # rad, over the log

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

        # The rotator turns against yaw, and against the slew to come. A log looks the same after
        # half a turn: keep to one goal, in the middle of the rotator's range.
        x, y, _ = (p_centre + delta_p).T
        slew = np.arctan2(y, x) - np.arctan2(p_plumb[:, 1], p_plumb[:, 0])
        goal = self.q7_goal + half_turn(q[:, 6] + slew - obs[:, 17] - self.q7_goal)
        self.q7_goal = np.where(np.abs(goal) > Q7_MAX, half_turn(goal), goal)
        turn = q[:, 6] + slew - self.q7_goal

        away = np.linalg.norm(delta_p[:, :2], axis=-1)
        # Tips far under a thick log would pull soft drives down. Jaws meet a thick log early, so
        # the grapple starts high and sinks while they close.
        q8_then = q8 + settings.latency * q8_speed
        still_open = np.clip(Q8_THIN - q8_then, 0.0, Q8_THIN - Q8_THICK)
        clearance = settings.clearance + settings.rise * still_open
        at_level = np.abs(delta_p[:, 2] + clearance) < settings.level
        near_by = (away < settings.near) & (np.abs(turn) < NEARLY_ALIGNED)
        in_place = (away < settings.over) & at_level & (np.abs(turn) < settings.aligned)
        gripped = (q8 > Q8_CLOSED) & (q8_speed < settings.stalled)
        self.phase[(self.phase == APPROACH) & near_by] = DESCEND
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
        most = settings.max_acceleration * DT * np.where(self.phase == LIFT, settings.haste, 1.0)
        self.velocity += bounded(wanted - self.velocity, most[:, None])
        yaw_rate = np.where(lifting, turn_of_log, settings.k_yaw * turn)

        task = np.concatenate([self.velocity, yaw_rate[:, None]], axis=-1)
        rates = SPEED * damped_least_squares(plumb_jacobian(plumb_frames) * SPEED, task, DAMPING)
        if obs.shape[1] > self.SLEW_FORCE:
            rates[:, 0] -= settings.relief * obs[:, self.SLEW_FORCE]
        fractions = np.where(rates < 0, -rates / LOW, rates / HIGH)
        # too fast for a joint: all slow down and the direction stays; the rotator alone is clipped
        fractions /= np.maximum(1.0, np.abs(fractions[:, :4]).max(axis=-1, keepdims=True))
        jaws = (settings.q8_open - q8_then) / ((DT + settings.latency) * SPEED_LIMITS[1, 5])
        meeting = (q8 > settings.slow_at) & (q8 < Q8_THIN)
        closing = np.where(meeting, settings.meeting_speed, settings.jaw_speed)
        jaws = np.where(self.phase == CLOSE, closing, jaws)
        jaws = np.where(lifting, jaws_of_log, jaws)
        return np.clip(np.concatenate([fractions, jaws[:, None]], axis=-1), -1.0, 1.0)

    def carry(
        self, obs: np.ndarray, p_plumb: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What cranes do from LIFT on: velocity (N, 3) m/s, turn (N,) rad/s, jaws' command (N,).

        This crane only lifts. A subclass may also set `self.phase` here. p_plumb (N, 3) in m is the
        grapple's place when plumb.
        """
        way = np.zeros_like(p_plumb)
        way[:, 2] = CARRY_HEIGHT - p_plumb[:, 2]
        velocity = bounded(self.settings.k_p * way, self.settings.max_speed)
        return velocity, np.zeros(len(obs)), np.full(len(obs), self.settings.squeeze)
