"""What an episode costs: oil, energy, swing and time, observed after each physics step."""

from typing import Any

import numpy as np
from numpy import ndarray as Array

from crane_env import ACTION_OF_SERVO, ACTUATED, JOINTS, SERVOS, SPEED_LIMITS, CraneVectorEnv
from hydraulic_crane import cylinder_levers, oil_per_movement

MOVING = 0.01  # share of its speed limit below which a joint only trembles


class Metrics:
    """Costs of the present episode of N cranes, `values` by name, (N,) each.

    litres of oil, energy of the pump (J), swing_peak of the grapple (rad), time_up (s, when the log
    was safely up; inf before, and if it is lost).

    The pump gives every joint its oil, at the pressure that the hardest of those that move needs.
    """

    def __init__(self, envs: CraneVectorEnv):
        n = envs.num_envs
        self.drive_force = envs.batch.bind("qfrc_actuator")
        self.values = {name: np.zeros(n) for name in ("litres", "energy", "swing_peak", "time_up")}
        self.values["time_up"][:] = np.inf
        envs.observers.append(self.after_physics_step)

    def clear(self, ids: Array) -> None:
        """New episodes of cranes `ids`."""
        for name, value in self.values.items():
            value[ids] = np.inf if name == "time_up" else 0.0

    def after_physics_step(self, envs: CraneVectorEnv) -> None:
        """Add what the last physics step took."""
        seconds = envs.model.opt.timestep
        q, dq = envs.qpos[:, JOINTS], envs.qvel[:, JOINTS][:, ACTUATED]
        dq = dq * ~envs.warnings.any(axis=-1, keepdims=True)  # the engine has reset those
        force = self.drive_force[:, SERVOS] @ np.eye(6)[ACTION_OF_SERVO]  # of both stages, jaws
        oil = oil_per_movement(cylinder_levers(q[:, 1], q[:, 2]), dq, force)
        flow = np.sum(oil * np.abs(dq), axis=-1)
        moving = np.abs(dq) > MOVING * np.minimum(*np.abs(SPEED_LIMITS))
        pressure = np.max(np.maximum(force * np.sign(dq) / oil, 0) * moving, axis=-1)
        swing = np.hypot(q[:, 4] - np.pi / 2 + q[:, 1] + q[:, 2], q[:, 5] - np.pi / 2)
        self.values["litres"] += 1000 * flow * seconds
        self.values["energy"] += flow * pressure * seconds
        self.values["swing_peak"] = np.maximum(self.values["swing_peak"], swing)

    def after_step(self, info: dict[str, Any]) -> dict[str, Array]:
        """Copies of the values after a step with this `info`. Ended episodes begin anew."""
        up = self.values["time_up"]
        up[:] = np.where(info["safe"], np.minimum(up, info["time"]), np.inf)
        values = {name: value.copy() for name, value in self.values.items()}
        self.clear(np.flatnonzero(info["termination"] != "none"))
        return values
