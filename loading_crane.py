"""Beyond the paper: the whole loading cycle. The crane lifts the log and puts it into the truck.

Starts and rules are those of crane_env.py; easy tasks also start on the way. Within 30 s the log
must lie in the bunk, between the stakes, within 15 degrees of the truck's axis, slower than 0.05
m/s, with open jaws off it, throughout 0.5 s. This ends the episode as "loaded". A log not lifted
within 12 s, or lost later, ends it, too. A load is gentle if the crane never pressed on ground or
truck with more than 20 kN, and the log met the bed at 1 m/s or less (`ground_peak`: as 20 kN).

Five numbers follow the 18 of crane_env.py, before the hydraulic crane's sensors. On the machine
joint sensors and a camera would give them. They have the errors of `randomize`, no `pose_noise`.

| index | meaning                                                      | unit | low, high   |
|-------|--------------------------------------------------------------|------|-------------|
| 18-20 | from the log's centre to its place: ahead, left, up          | m    | -20, 20     |
| 21    | signed angle from the log to the truck's axis, 0 is aligned  | rad  | -pi/2, pi/2 |
| 22    | tilt of the log, 0 is level                                  | rad  | 0, pi/2     |
"""

from typing import Any

import mujoco
import numpy as np
from numpy import ndarray as Array

import crane_env
from crane_env import GENTLE_FORCE, LOG_LENGTH, MIN_CLEARANCE, Q8_MAX, CraneState, centred
from hydraulic_crane import HydraulicCraneVectorEnv

# ---- the bunk, as in assets/crane.xml, and what "loaded" means
BED, STAKE_TOP, STAKE_Y = 1.2, 2.7, 1.2  # m: above the ground; from the truck's axis
BUNK_X = (-6.5, -1.16)  # m, from the last stakes to the headboard
PLACE_X, STAKE_GAP = -4.1, 1.6  # m: half way between two pairs of stakes; their distance
LIFT_TIME = 12.0  # s, by which a log must have been lifted; soft drives need more than 9
SETTLED, HIT = 0.01, 0.05  # m, by which contacts give way at most: at rest; when a log falls
MAX_ANGLE, MAX_SPEED = np.radians(15), 0.05  # of the log's axis from the truck's; m/s, its ends
OPEN_Q8 = 1.2  # rad; the tips are 1.29 m apart and let go of 0.8 m
GENTLE_SPEED, CONTACTS = 1.0, 4  # m/s, of a log that meets the bed, a fall of 5 cm; contacts seen
LOG_VELOCITY, LOG_TURNING = slice(10, 13), slice(13, 15)  # of qvel; turning across its own axis

# ---- easy starts on the way to the bunk: a log in closed jaws, as stiff servos hold it there
HELD_SHARE = 0.15  # of the cranes at difficulty 0, none at 1 (docs/learned.md, Lift first)
NEAR = 3  # half of them have less than 1 / 2**NEAR of the way to go, and soon let go
HELD_JOINTS = [1.1, 0.05, 0.0], [1.2, 0.15, 0.4]  # q2, q3, q4: tip 4 to 5 m out, 4.7 to 5.7 m up
GRIP_Q8 = ([0.3, 0.4, 0.5, 0.6, 0.7, 0.8], [2.87, 2.62, 2.42, 2.20, 1.96, 1.75])  # m, rad
GRIP_TOP = 0.43  # m from p_C up to the log's upper side: it touches the frame of the grapple

# ---- the reward; a later stage adds to what all earlier ones pay; weights: docs/learned.md
CARRY_HEIGHT = STAKE_TOP + 0.15  # m, of the log's lowest point, to pass the stakes
LIFTED_PAY = 1 + crane_env.GRAPPLE_WEIGHT + crane_env.LIFT_WEIGHT + crane_env.CARRY_WEIGHT  # most
HEIGHT_WEIGHT = 2.0  # as much as r_lift pays for the first metre
SWING_WEIGHT = 3.0  # more than for the height: the way to the bunk takes longer
SWING_ANGLE, RADIUS_MISS = 2.2, 2.5  # rad away where r_swing is 0; m off its radius where 1/e
MIDDLE_WEIGHT, MIDDLE_MISS = 1.5, 0.6  # beside a stake jaws cannot open; m off it, at 1/e
ALONG_WEIGHT = 2.0  # r_lower depends on it, too: a released log cannot be turned
TOO_HIGH, HIGHEST = 3.6, 8.0  # m, of the lowest point: from here it pays less, from there nothing
LOWER_WEIGHT = 4.0  # from TOO_HIGH to the bed
LOW = 0.45  # m above the bed, where no pay asks for a grip: opening jaws need room below them
MOST_ASKEW = np.radians(30)  # of a log that may be let go; full pay up to half of it
LET_GO_WEIGHT = 12.0  # for a weaker squeeze there and for the command to open
RELEASE_WEIGHT, OFF_WEIGHT = 4.0, 2.0  # for jaws that open there; that are open and off the log
LOADED_PAY = 60 * 36.5  # 36.5: most of a step without bonus; at gamma 0.98 waiting is worth 50
GENTLE_BONUS = 1.0  # added share of r_release and r_loaded up to GENTLE_FORCE, less beyond


def over_bunk(state: CraneState) -> Array:
    """Whether the log is between stakes and headboard, seen from above, (N,)."""
    x, y, _ = state.log_centre.T
    along, across, _ = np.minimum(np.abs(state.log_axis.T), 1)
    ahead = LOG_LENGTH / 2 * along + state.diameter / 2 * np.sqrt(1 - along**2)
    aside = STAKE_GAP / 2 * across + state.diameter / 2  # at the stakes
    inside = (np.abs(y) + aside <= STAKE_Y) & (x - ahead >= BUNK_X[0])
    return inside & (x + ahead <= BUNK_X[1] + SETTLED)


def in_bunk(state: CraneState) -> Array:
    """Whether the log is over the bunk, not through its bed, and below the stakes' tops, (N,)."""
    lowest = crane_env.log_clearance(state)
    return over_bunk(state) & (lowest >= BED - HIT) & (lowest < STAKE_TOP)


class LoadingCraneVectorEnv(crane_env.CraneVectorEnv):
    """N cranes that load. `bed_speed` (N,): m/s, the fastest that the log met the bed."""

    REVISION, TIME_LIMIT = 1, 30.0  # s; the scripted crane takes 21 s, on hydraulic drives 25 s
    GOALS, LIMIT_TOLERANCE = ("loaded",), 0.03  # m; under a log the telescope's stop gives 0.022
    GROUND_WEIGHT, FULL_STARTS = 3.0, 0.3  # opening jaws may touch the bed; the lift comes first
    SCRIPTED = "crane_utils.scripted_loading:ScriptedLoadingCrane"  # of eval_crane.py

    def __init__(self, num_envs: int = 1, **kwargs: Any):
        self.bed_speed, self.loose = np.zeros((2, num_envs))  # m/s; steps off the log
        self.lifted, self.starts_held = np.zeros((2, num_envs), bool)
        super().__init__(num_envs, **kwargs)
        self.on_bed = self.history("log_on_bed")  # both live
        self.on_log = self.sensordata[:, self.model.sensor("crane_on_log").adr[0]]

    def make_spec(self) -> mujoco.MjSpec:
        """The truck joins the ground's body: it, too, is pressed on, and it, too, bears the log."""
        spec = super().make_spec()
        spec.compiler.fusestatic = True
        for sensor in (spec.sensor("ground_force"), spec.sensor("log_support")):
            sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_BODY, "world"
        contact = {"type": mujoco.mjtSensor.mjSENS_CONTACT, "reftype": mujoco.mjtObj.mjOBJ_BODY}
        # intprm: data (1 "found", 128 "linvel" in m/s), reduction (0: none), how many contacts
        contact |= {"refname": "log", "objtype": mujoco.mjtObj.mjOBJ_GEOM}
        bed = {"nsample": self.options.frame_skip, "intprm": [129, 0, CONTACTS]}
        spec.add_sensor(name="log_on_bed", objname="bed", **bed, **contact)
        contact |= {"objtype": mujoco.mjtObj.mjOBJ_XBODY}  # with all bodies that it carries
        spec.add_sensor(name="crane_on_log", objname="K1", intprm=[1, 0, 1], **contact)
        return spec

    def draw_episode(self, i: int) -> tuple[Array, Array, float]:
        """The first cranes, fewer as difficulty rises, start on the way, with the log in the jaws.
        A share of the cranes and not of the starts: held episodes are long and would be most steps.
        """
        if self.starts_held[i]:  # it began elsewhere than `starts` says: nothing to repeat
            self.failures[i].clear()
        q, log_pose, diameter = super().draw_episode(i)
        self.starts_held[i] = i + 0.5 < HELD_SHARE * (1 - self.difficulty) * self.num_envs
        if self.starts_held[i]:
            *_, rng = self.rngs[i]
            q[0], q[1:4] = (q[0] + np.pi) * rng.uniform() ** NEAR - np.pi, rng.uniform(*HELD_JOINTS)
            q[4:6] = np.pi / 2 - q[1] - q[2], np.pi / 2
        return q, log_pose, diameter

    def place(self, ids: Array, q: Array, log_pose: Array, diameter: Array) -> None:
        self.lifted[ids] = held = self.starts_held[ids]
        super().place(ids, q, log_pose, diameter)
        self.bed_speed[ids] = self.loose[ids] = 0
        if held.any():
            self.hold(ids[held], diameter[held])

    def hold(self, ids: Array, diameter: Array) -> None:
        """Put the logs into the jaws of cranes `ids`. They sag: by 1 cm, on soft drives 0.4 m."""
        (x, y, z), (axis_x, axis_y) = self.sensordata[ids, :3].T, self.sensordata[ids, 3:5].T
        z += GRIP_TOP - diameter / 2
        yaw = np.arctan2(-axis_x, axis_y)
        cos, sin = np.cos(yaw / 2) / np.sqrt(2), np.sin(yaw / 2) / np.sqrt(2)
        self.batch.joint("log").qpos[ids] = np.stack([x, y, z, cos, -cos, -sin, sin], axis=-1)
        self.qpos[ids, 8:10] = np.interp(diameter, *GRIP_Q8)[:, None]  # both jaws
        self.batch.forward(ids, stage=crane_env.VEL)
        squeeze = self.force_limit[1, ids, 6:] / self.servo_kp[ids, 6:]
        self.act[ids, 6:] = self.qpos[ids, 8:10] + squeeze

    # ---- what is observed and measured, what ends an episode, the reward

    def simulate(self) -> Array:
        """The physics steps, and how fast the log met the bed in them, where they touched."""
        self.on_bed[:] = 0.0  # its history may be longer than this step
        diverged = super().simulate()
        self.loose = np.where(self.on_log > 0, 0, self.loose + 1)
        hits = np.linalg.norm(self.on_bed.reshape(self.num_envs, -1, 4)[..., 1:], axis=-1)
        self.bed_speed = fastest = np.maximum(self.bed_speed, hits.max(axis=-1))
        self.ground_peak = np.maximum(self.ground_peak, fastest * GENTLE_FORCE / GENTLE_SPEED)
        return diverged

    def reached(self, info: dict[str, Array]) -> Array:
        """As for lifting. A log that was lifted has been reached, wherever the jaws hold it."""
        return super().reached(info) | self.lifted

    def observation_limits(self) -> Array:
        high = np.array([20.0, 20.0, 20.0, np.pi / 2, np.pi / 2])
        return np.column_stack([super().observation_limits(), [-high * [1, 1, 1, 1, 0], high]])

    def observe(self, state: CraneState) -> Array:
        """See the table above. The hydraulic crane calls this with the state that it reports."""
        cos, sin, (x, y, z) = np.cos(state.q[:, 0]), np.sin(state.q[:, 0]), state.log_centre.T
        x, y, z = PLACE_X - x, -y, BED + state.diameter / 2 - z
        axis_x, axis_y, axis_z = state.log_axis.T
        angle = (np.pi / 2 - np.arctan2(axis_y, axis_x)) % np.pi - np.pi / 2  # half a turn is none
        tilt = np.arcsin(np.minimum(np.abs(axis_z), 1))
        place = [cos * x + sin * y, cos * y - sin * x, z]
        return np.column_stack([super().observe(state), *place, angle, tilt])

    def conditions(self, state: CraneState, info: dict[str, Array]) -> dict[str, Array]:
        speed = np.linalg.norm(self.qvel[:, LOG_VELOCITY], axis=-1)
        speed += LOG_LENGTH / 2 * np.linalg.norm(self.qvel[:, LOG_TURNING], axis=-1)
        return {
            "not_in_bunk": in_bunk(state),
            "not_along": np.abs(state.log_axis[:, 0]) >= np.cos(MAX_ANGLE),
            "moving": speed < MAX_SPEED,
            "not_released": (self.on_log == 0) & (state.q[:, 7] <= OPEN_Q8),
        }

    def rules(self, state: CraneState, info: dict[str, Array]) -> dict[str, Array]:
        """log_lost: let go outside the bunk, onto the ground or for HOLD_TIME. not_lifted: late."""
        (x, y, _), lowest = state.log_centre.T, info["clearance"]
        outside = (np.abs(y) > STAKE_Y) | (x < BUNK_X[0]) | (x > BUNK_X[1])
        dropped = ((self.loose > 0) & (lowest < SETTLED)) | (self.loose >= self.hold_steps)
        lost = self.lifted & dropped & (outside | (lowest < BED - HIT))
        ends = {"not_lifted": (info["time"] > LIFT_TIME) & ~self.lifted, "log_lost": lost}
        self.lifted |= (lowest >= MIN_CLEARANCE) & state.touching.all(axis=-1)
        return super().rules(state, info) | ends | {"loaded": info["safe"]}

    def reward_terms(self, state: CraneState, info: dict[str, Array]) -> dict[str, Array]:
        """Terms of lifting but r_balance, which pays for standing still. Then the stages above."""
        height = np.minimum(info["clearance"], crane_env.DESIRED_HEIGHT)  # higher pays no less
        terms = super().reward_terms(state, info | {"clearance": height})
        terms.pop("r_balance")
        (x, y, _), lowest = state.log_centre.T, info["clearance"]
        over = over_bunk(state) & (lowest >= BED - HIT)
        askew = np.arccos(np.minimum(np.abs(state.log_axis[:, 0]), 1))  # rad, turned or tilted
        low = over & (lowest < BED + LOW) & (askew < MOST_ASKEW)
        held = np.where(low, 1.0, centred(info["centre_miss"]) * state.touching.all(axis=-1))
        high = 1 - (lowest - TOO_HIGH) / (HIGHEST - TOO_HIGH)
        up = np.clip(np.where(over, high, np.minimum(lowest / CARRY_HEIGHT, high)), 0, 1) * held
        to_go = np.pi - np.abs(np.arctan2(y, x))  # rad round the slew axis
        radius_miss = (np.hypot(x, y) - abs(PLACE_X)) / RADIUS_MISS
        near = np.exp(-(radius_miss**2)) * np.clip(1 - to_go / SWING_ANGLE, 0, 1)
        there, middle = up * near, over * np.exp(-((y / MIDDLE_MISS) ** 2))
        along, straight = 1 - askew / (np.pi / 2), np.clip(2 - 2 * askew / MOST_ASKEW, 0, 1)
        down = np.clip((TOO_HIGH - lowest) / (TOO_HIGH - BED), 0, 1)
        lowered = over * held * along * down * (1 + middle) / 2
        there[low] = along[low] = lowered[low] = 1.0  # opening jaws roll and turn the log
        opened = np.clip((Q8_MAX - state.q[:, 7]) / (Q8_MAX - OPEN_Q8), 0, 1)
        off = (opened == 1) & (self.on_log == 0)
        squeeze = self.servo_kp[:, 6:] * (self.act[:, 6:] - self.qpos[:, 8:10])  # N m
        squeeze = (squeeze / self.force_limit[1, :, 6:]).mean(axis=-1)  # up to 1.2 (measured)
        told = -self.command[:, 5] / crane_env.SPEED_LIMITS[1, 5]  # noise moves it at any squeeze
        lets_go = np.where(opened == 1, 1.0, (2 - squeeze + told) / 4)
        gentle = 1 + GENTLE_BONUS * GENTLE_FORCE / np.maximum(self.ground_peak, GENTLE_FORCE)
        for name in ("r_distance", "r_grapple", "r_lift"):
            terms[name] = np.where(low, LIFTED_PAY / 3, terms[name])
        return terms | {
            "r_height": HEIGHT_WEIGHT * up,
            "r_swing": SWING_WEIGHT * there,
            "r_along": ALONG_WEIGHT * there * along,
            "r_middle": MIDDLE_WEIGHT * up * middle,
            "r_lower": LOWER_WEIGHT * lowered,
            "r_let_go": LET_GO_WEIGHT * low * straight * lets_go,
            "r_release": low * straight * gentle * (RELEASE_WEIGHT * opened + OFF_WEIGHT * off),
            "r_loaded": LOADED_PAY * (info["termination"] == "loaded") * gentle,
        }


class HydraulicLoadingCraneVectorEnv(HydraulicCraneVectorEnv, LoadingCraneVectorEnv):
    """N hydraulic cranes that load. Its hooks call those of the loading crane."""

    REVISION, GROUND_WEIGHT = 1, 0.0  # locked oil presses half-open jaws on the bed


class HydraulicLoadingCraneEnv(crane_env.CraneEnv):
    """One hydraulic crane that loads."""

    cranes = HydraulicLoadingCraneVectorEnv


class LoadingCraneEnv(crane_env.CraneEnv):
    """One crane that loads."""

    cranes = LoadingCraneVectorEnv
