"""The scripted crane of the loading cycle: scripted_crane.py with more phases after LIFT.

LIFT raises the log and turns it along the truck. SWING goes on over the stakes, round the slew axis
at the bunk's radius. LOWER ends where the log or the jaws are just above the bed. In OPEN the crane
rises as the opening jaws reach deeper. RISE goes straight up.

    python eval_crane.py scripted --env-id ForestryCraneLoading-v0
"""

from dataclasses import asdict, dataclass

import numpy as np

from crane_env import LOG_LENGTH, PIVOT_HEIGHT, SPEED_LIMITS
from loading_crane import BED, PLACE_X, STAKE_TOP
from scripted_crane import (
    APPROACH,
    DT,
    HYDRAULIC,
    LIFT,
    LOWER,
    NEARLY_ALIGNED,
    OPEN,
    RISE,
    SWING,
    ScriptedCrane,
    Settings,
    bounded,
    half_turn,
)

BUNK_RADIUS, BUNK_AZIMUTH = -PLACE_X, -np.pi  # m, rad; logs start at azimuths down to -2.1
BUNK_Q7 = -np.pi / 2  # rad, of a log along the truck
WAIT_AZIMUTH = -2.4  # rad; an aligned log waits there, 1.1 m or more from the stakes, to be high
RISE_HEIGHT = 3.0  # m, of p_C; the jaws are then above the stakes
DRAG_HEIGHT = 0.3  # m, of the log's lowest point, before it turns and moves sideways
SLIPPED = 0.85  # m, of Delta_p; a gripped log has at most 0.7
RELEASE_RATE = SPEED_LIMITS[1, 5]  # rad/s, of jaws that open at full command
FREE_Q8 = 1.3  # rad; wider jaws have let go: tips 1.1 m apart
JAW_OUTLINE = np.array(  # m, corners of assets/crane.xml: from a jaw's pivot along it, and outward
    [[0.3164, 0.2930], [0.5402, 0.2930], [0.7378, 0.1879], [0.8490, 0.0230]]
)
JAW_RADIUS = 0.025  # m, half of a jaw's thickness


@dataclass(frozen=True)
class LoadingSettings(Settings):
    """LOADING_IDEAL and LOADING_HYDRAULIC come from random searches on 60 and 48 trials of seed
    10000, and the ideal crane's release_speed from tries on 24.
    """

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
    release_speed: float = 0.12  # of opening jaws until FREE_Q8; with 0.2 ideal servos drop logs
    q8_release: float = 0.9  # rad; the tips are 1.73 m apart then, and the stakes 2.3 m


LOADING_IDEAL = LoadingSettings(
    k_s=2.1, max_speed=2.24, max_acceleration=2.15, aligned=0.0937, still=0.3, carry_p=1.06,
    turn_speed=1.34, lift_speed=1.13, more=0.513, release=0.03, q8_release=0.956,
)  # fmt: skip
LOADING_HYDRAULIC = LoadingSettings(**asdict(HYDRAULIC) | dict(
    k_s=0.705, latency=0.223, max_speed=1.36, max_acceleration=1.88, near=0.355, over=0.0833,
    level=0.0559, aligned=0.121, clearance=0.0387, rise=0.1, jaw_speed=1.0, squeeze=0.69,
    lift_speed=2.5, over_stakes=0.08, more=0.106, carry_speed=2.49, turn_p=0.807,
    lower_speed=1.0, release_speed=0.4, q8_release=0.839,
))  # fmt: skip


def jaw_depth(q8: np.ndarray) -> np.ndarray:
    """How far the jaws reach below p_C, (N,) in m. Nearly closed jaws are bulges, not tips."""
    along, outward = JAW_OUTLINE.T[:, :, None]
    below_pivot = np.max(along * np.sin(q8) - outward * np.cos(q8), axis=0)
    return below_pivot + JAW_RADIUS - PIVOT_HEIGHT


class ScriptedLoadingCrane(ScriptedCrane):
    """Maps observations (N, 23 or more) of ForestryCraneLoading-v0 to actions (N, 6).

    A log that slips out of the jaws before it was lifted is grasped again.
    """

    drives = LOADING_IDEAL, LOADING_HYDRAULIC
    SLEW_FORCE = 31

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
