"""One crane in plain MuJoCo calls: what throughput.py gives to Gymnasium and Stable-Baselines3.

`PlainCrane` computes observation, reward and rules without NumPy, which is slow on small arrays.
"""

import sys
from math import atan2, copysign, cos, exp, hypot, pi, sin, sqrt, tanh
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
import crane_options
import crane_task
import machine

import crane_env


class PlainCrane(gymnasium.Env):
    """One crane with plain MuJoCo calls: scalars, and views that are looked up once.

    The task is ForestryCrane-v0 with its defaults. Two things are left out: `info`, and the clip of
    the observation to its space. No observation of an episode that goes on needs the clip.
    """

    def __init__(self, frame_skip: int = 20):
        self.model = model = machine.load_model(visual=False)
        self.data = data = mujoco.MjData(model)
        self.frame_skip, self.dt = frame_skip, frame_skip * machine.TIMESTEP
        self.qpos, self.qvel, self.act, self.ctrl = data.qpos, data.qvel, data.act, data.ctrl
        self.sensordata, self.warnings = data.sensordata, data.warning
        self.ground_force = data.history[-3 * model.sensor_history[-1, 0] :]  # as in crane_env.py
        self.q_at = machine.JOINTS
        self.dq_at = [machine.JOINTS[i] for i in machine.ACTUATED]
        _, integrators = np.split(model.actuator_gainprm, 2)  # after the velocity actuators
        self.kp = integrators[:, 0]
        self.lead = model.jnt_actfrcrange[machine.SERVOS, 1] / self.kp
        self.servos = list(zip(machine.SERVOS, self.lead.tolist()))
        joint_range = model.jnt_range[machine.JOINTS]
        tolerance = crane_task.LIMIT_TOLERANCE * np.array([-1, 1])
        self.limits = (joint_range[crane_task.LIMITED] + tolerance).tolist()
        self.speeds = machine.SPEEDS["real"].T.tolist()  # lowest and highest of each joint
        self.log_q = model.joint("log").qposadr[0]
        self.log_body = model.body("log").id
        self.log_geoms = [model.geom("log").id, model.geom("log_capsule").id]
        low, high = joint_range.T + [[-0.5], [0.5]]
        bound = [10.0] * 6 + [20.0] * 3 + [1.5 * pi]
        low, high = np.float32([*low, *np.negative(bound)]), np.float32([*high, *bound])
        self.observation_space = gymnasium.spaces.Box(low, high)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (6,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        super().reset(seed=seed)
        model, data = self.model, self.data
        q, (x, y, yaw), diameter = crane_task.sample_start(self.np_random)
        radius, length = diameter / 2, crane_task.LOG_LENGTH
        mass = machine.LOG_DENSITY * pi * radius**2 * length
        across = mass * (3 * radius**2 + length**2) / 12
        cylinder, capsule = self.log_geoms
        model.geom_size[[cylinder, capsule], 0] = radius
        model.geom_size[capsule, 1] = length / 2 - radius
        model.body_mass[self.log_body] = mass
        model.body_inertia[self.log_body] = across, across, mass * radius**2 / 2
        mujoco.mj_setConst(model, data)
        mujoco.mj_resetData(model, data)
        c, s = cos(yaw / 2) / sqrt(2), sin(yaw / 2) / sqrt(2)
        self.qpos[self.log_q : self.log_q + 7] = x, y, radius, c, -c, -s, s
        self.qpos[self.q_at] = q
        self.qpos[machine.SERVOS] = q[machine.ACTUATED][machine.COMMAND_OF_SERVO]
        mujoco.mj_step1(model, data)
        load = data.qfrc_bias[machine.SERVOS]
        self.act[:] = self.qpos[machine.SERVOS] + load / self.kp
        self.diameter, self.decisions, self.reached = float(diameter), 0, False
        self.weight, self.hit = 9.81 * mass, 0.0
        return self._observe([0.0] * 6)[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        model, data = self.model, self.data
        command = self._command(action)
        self.hit = 0.0
        due = self.decisions % max(1, crane_env.ANTI_WINDUP // self.frame_skip) == 0
        for start in range(0, self.frame_skip, crane_env.ANTI_WINDUP):
            if due:
                self._clamp()
            nstep = min(crane_env.ANTI_WINDUP, self.frame_skip - start)
            if start == 0:
                mujoco.mj_step2(model, data)  # mj_step1 has been called, for the observation
                nstep -= 1
            if nstep > 0:
                mujoco.mj_step(model, data, nstep)
            self._look_for_hits()
        mujoco.mj_step1(model, data)
        self.decisions += 1
        now = self.decisions * self.dt

        obs, reward, d_combine, distance, q, dq = self._observe(command)
        if d_combine < crane_task.REACH_DISTANCE and now < crane_task.REACH_TIME + 1e-9:
            self.reached = True
        diverged = bool(self.warnings.number.any())
        terminated = (
            diverged
            or not self._within_limits(q, dq)
            or distance > crane_task.LOG_RANGE
            or (not self.reached and now > crane_task.REACH_TIME - 1e-9)
        )
        truncated = not terminated and now > crane_task.TIME_LIMIT - 1e-9
        return obs, 0.0 if diverged else reward, terminated, truncated, {}

    def _command(self, action: np.ndarray) -> list[float]:
        command = []
        for a, (low, high) in zip(action.tolist(), self.speeds):
            a = min(max(a, -1.0), 1.0)
            command.append(a * high if a >= 0 else -a * low)
        self.ctrl[:] = 2 * [command[i] for i in machine.COMMAND_OF_SERVO]
        return command

    def _clamp(self) -> None:
        qpos = self.qpos.tolist()
        self.act[:] = [
            min(max(a, qpos[i] - lead), qpos[i] + lead)
            for a, (i, lead) in zip(self.act.tolist(), self.servos)
        ]

    def _look_for_hits(self) -> None:
        force = self.ground_force.tolist()
        for i in range(0, len(force), 3):
            self.hit = max(self.hit, hypot(*force[i : i + 3]))

    def _within_limits(self, q: list[float], dq: list[float]) -> bool:
        return all(low <= x <= high for x, (low, high) in zip(q, self.limits)) and all(
            2 * low <= v <= 2 * high for v, (low, high) in zip(dq, self.speeds)
        )

    def _observe(self, command: list[float]) -> tuple:
        """Observation, staged reward, and what the termination rules need."""
        qpos, qvel = self.qpos.tolist(), self.qvel.tolist()
        q, dq = [qpos[i] for i in self.q_at], [qvel[i] for i in self.dq_at]
        (gx, gy, gz, ax, ay, _, lx, ly, lz, ux, uy, uz, *touch) = self.sensordata.tolist()
        x, y, z = lx - gx, ly - gy, lz - gz
        distance = sqrt(x * x + y * y + z * z)
        miss = x * ux + y * uy + z * uz
        level = max(hypot(ux, uy), 1e-9)
        dot, cross = (ax * ux + ay * uy) / level, (ax * uy - ay * ux) / level
        angle = (atan2(cross, dot) + pi / 2) % pi - pi / 2
        rotator = q[6] + (atan2(ly, lx) - q[0] + pi) % (2 * pi) - pi - angle
        if abs(rotator) > crane_task.ROTATOR_MAX:
            angle += copysign(pi, rotator)
        z += (crane_task.D_MAX - self.diameter) / 2
        away = 1.0 - min(abs(dot), 1.0)
        d_combine = sqrt(x * x + y * y + z * z) + away
        aim = sqrt(x * x + y * y + (z + crane_task.CLOSING_HEIGHT) ** 2) + away

        up = min(abs(uz), 1.0)
        clearance = lz - crane_task.LOG_LENGTH / 2 * up - self.diameter / 2 * sqrt(1 - up * up)
        beyond = crane_task.NEAR_SHARPNESS * (aim - crane_task.REACH_DISTANCE)
        grasp = min(1.0, exp(-beyond)) * exp(-((miss / crane_task.GRAPPLE_MISS) ** 2))
        clearance = max(clearance, 1e-9)
        height = sqrt(min(clearance, 1 / clearance))
        centred = exp(-((miss / crane_task.LIFT_MISS) ** 2))
        lift = centred * height
        reward = exp(-crane_task.OMEGA2 * aim) + crane_task.LIFT_WEIGHT * lift
        hardness = max(2 * self.hit / crane_task.GENTLE_FORCE - 1, 0.0)
        hardness = min(hardness, crane_task.GROUND_MOST["ideal"])
        reward -= crane_task.GROUND_WEIGHT["ideal"] * hardness
        reward += crane_task.GRAPPLE_WEIGHT * grasp * q[7] / crane_task.Q8_MAX
        if touch[0] > 0 and touch[1] > 0:
            calm = 1 - tanh(hypot(*command[:5]))
            reward += crane_task.BALANCE_WEIGHT * calm * lift
            on_ground = hypot(*touch[2:5]) + hypot(*touch[5:8])
            carried = min(max(1 - on_ground / self.weight, 0.0), 1.0)
            reward += crane_task.CARRY_WEIGHT * centred * carried
        cos_q1, sin_q1 = cos(q[0]), sin(q[0])
        x, y = cos_q1 * x + sin_q1 * y, cos_q1 * y - sin_q1 * x
        return np.array([*q, *dq, x, y, z, angle], np.float32), reward, d_combine, distance, q, dq


def disagreement(
    policy: Any, options: crane_options.Options, frame_skip: int
) -> tuple[float, float]:
    """Largest difference of an observation and of a reward from those of CraneVectorEnv.

    Two whole episodes are driven by the policy, which grips and lifts in them, and two by noise.
    """
    envs = crane_env.CraneVectorEnv(4, **{**options, "frame_skip": frame_skip})
    plain = [PlainCrane(frame_skip) for _ in range(4)]
    obs, _ = envs.reset(seed=list(range(4)))
    ours = [env.reset(seed=i)[0] for i, env in enumerate(plain)]
    ended, state, worst = np.zeros(4, bool), None, np.abs(obs - ours).max()
    hold, worst_reward, rng = 20 // frame_skip, 0.0, np.random.default_rng(0)
    for decision in range(90 * hold):
        if decision % hold == 0:
            chosen, state = policy.predict(obs[:2], state)
            actions = np.concatenate([chosen, rng.uniform(-1.2, 1.2, (2, 6))])
        obs, rewards, terminated, truncated, _ = envs.advance(actions)
        for i in np.flatnonzero(~ended):
            its_obs, reward, *ends, _ = plain[i].step(actions[i])
            if ends != [terminated[i], truncated[i]]:
                sys.exit(f"PlainCrane ends otherwise, at decision {decision}")
            worst = max(worst, np.abs(its_obs - obs[i]).max())
            worst_reward = max(worst_reward, abs(reward - rewards[i]))
            ended[i] = any(ends)
    envs.close()
    return float(worst), float(worst_reward)
