"""The whole loading cycle."""

from typing import Any

import mujoco
import numpy as np
from numpy import ndarray as Array

import crane_env
from crane_env import LOG_LENGTH, MIN_CLEARANCE, CraneState, log_clearance
from hydraulic_crane import HydraulicCraneVectorEnv

BED, STAKE_TOP = 1.2, 2.7
STAKE_Y = 1.2
BUNK_X = (-6.5, -1.16)
PLACE = np.array([-4.1, 0.0])
SETTLED = 0.01
MAX_ANGLE = np.radians(15)
MAX_SPEED = 0.05
OPEN_Q8 = 1.2
GENTLE_SPEED = 1.0
LOG_VELOCITY = slice(10, 13)


def reach_of_log(state: CraneState) -> Array:
    along = np.abs(state.log_axis)
    across = np.sqrt(np.maximum(1 - along**2, 0))
    return LOG_LENGTH / 2 * along + state.diameter[:, None] / 2 * across


class LoadingCraneVectorEnv(crane_env.CraneVectorEnv):
    REVISION = 1
    TIME_LIMIT = 30.0
    GOALS = ("loaded",)
    SCRIPTED = "scripted_crane:ScriptedLoadingCrane"

    def __init__(self, num_envs: int = 1, **kwargs: Any):
        self.bed_speed = np.zeros(num_envs)
        self.lifted = np.zeros(num_envs, bool)
        self.loose = np.zeros(num_envs, int)
        super().__init__(num_envs, **kwargs)
        self.log_speed = np.zeros(num_envs)
        self.observers.append(LoadingCraneVectorEnv.watch_bed)

    def make_spec(self) -> mujoco.MjSpec:
        spec = super().make_spec()
        spec.compiler.fusestatic = True
        force = spec.sensor("ground_force")
        force.reftype, force.refname = mujoco.mjtObj.mjOBJ_BODY, "world"
        bed = spec.add_sensor(name="log_on_bed", type=mujoco.mjtSensor.mjSENS_CONTACT)
        bed.objtype, bed.objname = mujoco.mjtObj.mjOBJ_BODY, "log"
        bed.reftype, bed.refname = mujoco.mjtObj.mjOBJ_GEOM, "bed"
        bed.intprm[:3] = [1, 0, 1]
        return spec

    def place(self, ids: Array, q: Array, log_pose: Array, diameter: Array) -> None:
        super().place(ids, q, log_pose, diameter)
        self.bed_speed[ids] = self.lifted[ids] = self.loose[ids] = 0

    def watch_bed(self) -> None:
        self.bed_speed = np.maximum(self.bed_speed, self.log_speed * (self.sensordata[:, 20] > 0))
        self.log_speed = np.linalg.norm(self.qvel[:, LOG_VELOCITY], axis=-1)

    def observation_limits(self) -> Array:
        bound = [20.0, 20.0, 20.0, np.pi / 2, np.pi / 2]
        more = np.array([np.negative(bound), bound])
        return np.concatenate([super().observation_limits(), more], axis=-1)

    def observe(self, state: CraneState) -> Array:
        x, y = (PLACE - state.log_centre[:, :2]).T
        up = BED + state.diameter / 2 - state.log_centre[:, 2]
        cos, sin = np.cos(state.q[:, 0]), np.sin(state.q[:, 0])
        axis_x, axis_y, axis_z = state.log_axis.T
        angle = (np.pi / 2 - np.arctan2(axis_y, axis_x)) % np.pi - np.pi / 2
        tilt = np.arcsin(np.minimum(np.abs(axis_z), 1))
        more = [cos * x + sin * y, cos * y - sin * x, up, angle, tilt]
        return np.column_stack([super().observe(state), *more])

    def measure(self, state: CraneState) -> dict[str, Array]:
        return super().measure(state) | {"bed_speed": self.bed_speed.copy()}

    def rules(self, state: CraneState, info: dict[str, Array]) -> dict[str, Array]:
        x, y, _ = state.log_centre.T
        over_bunk = (np.abs(y) < STAKE_Y) & (BUNK_X[0] < x) & (x < BUNK_X[1])
        self.loose = np.where(state.touching.any(axis=-1), 0, self.loose + 1)
        dropped = (info["clearance"] < SETTLED) | (self.loose >= self.hold_steps)
        lost = self.lifted & dropped & ~over_bunk
        self.lifted |= (info["clearance"] >= MIN_CLEARANCE) & state.touching.all(axis=-1)
        more = {"log_lost": lost, "loaded": info["safe"]}
        return super().rules(state, info) | more

    def conditions(self, state: CraneState, info: dict[str, Array]) -> dict[str, Array]:
        lowest, reach = log_clearance(state), reach_of_log(state)
        x, y, _ = state.log_centre.T
        between = np.abs(y) + reach[:, 1] <= STAKE_Y
        ahead = (x - reach[:, 0] >= BUNK_X[0]) & (x + reach[:, 0] <= BUNK_X[1])
        speed = np.linalg.norm(self.qvel[:, LOG_VELOCITY], axis=-1)
        return {
            "not_in_bunk": between & ahead & (lowest >= BED - SETTLED) & (lowest < STAKE_TOP),
            "not_along": np.abs(state.log_axis[:, 0]) >= np.cos(MAX_ANGLE),
            "moving": speed < MAX_SPEED,
            "not_released": ~state.touching.any(axis=-1) & (state.q[:, 7] <= OPEN_Q8),
        }

    def gentle(self, info: dict[str, Array]) -> Array:
        return super().gentle(info) & (info["bed_speed"] <= GENTLE_SPEED)


class LoadingCraneEnv(crane_env.CraneEnv):
    cranes = LoadingCraneVectorEnv


class HydraulicLoadingCraneVectorEnv(HydraulicCraneVectorEnv, LoadingCraneVectorEnv):
    REVISION = 1


class HydraulicLoadingCraneEnv(crane_env.CraneEnv):
    cranes = HydraulicLoadingCraneVectorEnv
