"""A forestry crane that grasps and lifts a log: MuJoCo simulator and Gymnasium environment.

    import gymnasium, crane_env
    env = gymnasium.make("ForestryCrane-v0")                    # one crane, `CraneEnv`
    envs = gymnasium.make_vec("ForestryCrane-v0", num_envs=64)  # many at once, `CraneVectorEnv`

The crane turns at q1 (slew), lifts at q2 (boom) and q3 (arm), reaches with q4 (two equal telescope
stages). Two passive joints q5, q6 let a rotator q7 hang down with the grapple's two jaws q8.
Section and equation names refer to Vu et al., "Towards Autonomous Wood-Log Grasping with a Forestry
Crane: Simulator and Benchmarking". `ForestryCranePaper-v0` comes close to the task as printed.
`ForestryCraneHydraulic-v0` has drives as measured on the machine. In `ForestryCraneRandomized-v0`
each episode draws drives, a log and sensor errors.
Sources of all numbers: assets/README.md. The task on one page: docs/environment.md.

Observation, float32, `Box` of shape (18,), with sensors (32,):

| index | meaning                                          | unit  | low     | high   |
|-------|--------------------------------------------------|-------|---------|--------|
| 0     | q1 slew angle                                    | rad   | -4.21   | 4.21   |
| 1     | q2 boom angle, positive lifts                    | rad   | -1.7    | 2.063  |
| 2     | q3 arm angle, 0 square to the boom               | rad   | -1.41   | 2.0    |
| 3     | q4 length of each telescope stage                | m     | -0.5    | 2.736  |
| 4     | q5 passive tip angle, hangs at pi/2 - q2 - q3    | rad   | -2.0708 | 2.0708 |
| 5     | q6 passive tilt angle, hangs at pi/2             | rad   | 0.2854  | 2.8562 |
| 6     | q7 rotator angle                                 | rad   | -3.6416 | 3.6416 |
| 7     | q8 jaw angle, 0 open                             | rad   | -0.5    | 3.5    |
| 8     | q1 velocity                                      | rad/s | -10     | 10     |
| 9     | q2 velocity                                      | rad/s | -10     | 10     |
| 10    | q3 velocity                                      | rad/s | -10     | 10     |
| 11    | q4 velocity of each stage                        | m/s   | -10     | 10     |
| 12    | q7 velocity                                      | rad/s | -10     | 10     |
| 13    | q8 velocity                                      | rad/s | -10     | 10     |
| 14    | Delta_p,x, grapple centre to log (option axes)   | m     | -20     | 20     |
| 15    | Delta_p,y                                        | m     | -20     | 20     |
| 16    | Delta_p,z (option offset)                        | m     | -20     | 20     |
| 17    | signed angle to the log, 0 aligned, see below    | rad   | -4.7124 | 4.7124 |
| 18    | last command of q1, fraction of its limit        | 1     | -1      | 1      |
| 19    | last command of q2                               | 1     | -1      | 1      |
| 20    | last command of q3                               | 1     | -1      | 1      |
| 21    | last command of q4                               | 1     | -1      | 1      |
| 22    | last command of q7                               | 1     | -1      | 1      |
| 23    | last command of q8                               | 1     | -1      | 1      |
| 24    | q5 velocity                                      | rad/s | -10     | 10     |
| 25    | q6 velocity                                      | rad/s | -10     | 10     |
| 26    | force of the oil on q1, fraction of its limit    | 1     | -1      | 1      |
| 27    | force of the oil on q2                           | 1     | -1      | 1      |
| 28    | force of the oil on q3                           | 1     | -1      | 1      |
| 29    | force of the oil on q4                           | 1     | -1      | 1      |
| 30    | force of the oil on q7                           | 1     | -1      | 1      |
| 31    | force of the oil on q8                           | 1     | -1      | 1      |

Indices 18 to 31 exist with sensors=True only, as in `ForestryCraneHydraulic-v0`. With
signed_yaw=False index 17 is the paper's Delta_psi, without unit.

Action, float32, `Box` of shape (6,): commanded joint velocity as a fraction of its limit in that
direction. 0 stops the joint; values outside the box are clipped.

| index | meaning          | unit | low | high | speed "real" at -1, +1    | speed "mjcf"  |
|-------|------------------|------|-----|------|---------------------------|---------------|
| 0     | q1 slew          | 1    | -1  | 1    | -0.764, 0.802 rad/s       | -1.57, 1.57   |
| 1     | q2 boom          | 1    | -1  | 1    | -0.326, 0.239 rad/s       | -1.57, 1.57   |
| 2     | q3 arm           | 1    | -1  | 1    | -0.344, 0.326 rad/s       | -1.57, 1.57   |
| 3     | q4 each stage    | 1    | -1  | 1    | -0.630, 0.400 m/s         | -2, 2         |
| 4     | q7 rotator       | 1    | -1  | 1    | -2.12, 2.12 rad/s         | -3, 3         |
| 5     | q8 jaws          | 1    | -1  | 1    | -1.8, 1.8 rad/s           | -3, 3         |
"""

import ctypes
import ctypes.util
import os
import sys
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal, Unpack
from weakref import WeakSet

if not os.environ.get("DISPLAY") and ctypes.util.find_library("EGL"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # mujoco chooses its OpenGL when it is imported

import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from mujoco.batch import Batch, SimulationError
from numpy.random import Generator, SeedSequence, default_rng

import crane_options
import crane_task
import machine
from crane_options import Options, Range, Size, Threads, check, complete
from crane_task import CONDITIONS, D_MAX, D_MIN, GENTLE_FORCE, LOG_LENGTH, TERMS, CraneState
from machine import ACTUATED, COMMAND_OF_SERVO, COSTS, JOINTS, PASSIVE, SERVOS, SPEEDS, TIMESTEP

# ---- constants

HEADLESS = sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys()
REVISION = 7  # of the task; raise it when a change makes trained policies worse
ANTI_WINDUP = 5  # most steps between two clamps of the integrators; crane.xml's nsample equals it

CARE = ["gentle", *COSTS, "time_up", "log_speed"]
Array = np.ndarray
ALIVE: WeakSet["CraneVectorEnv"] = WeakSet()  # all cranes, for `outlive_fork`


# ---- environments


class CraneVectorEnv(gymnasium.vector.VectorEnv):
    """N cranes stepped together on one `mujoco.batch.Batch`.

    Crane i's starts depend on the seed, on i and, with retry, on how its episodes ended. They do
    not depend on N or on the threads.

    `info` describes the step just made, for every crane, also one whose episode just ended:
    `termination` (one of TERMINATIONS, or "none"), the reward's TERMS, `d_combine`, `clearance`,
    `centre_miss` (m), `diameter` (m), `log_mass` (kg), `time_to_reach` (s, inf before), and, where
    an episode ended, `success`, the same as `is_success` for Stable-Baselines3, and which of
    CONDITIONS failed it. The mask `_key` says for which cranes `key` is meaningful. `final_obs` and
    `final_info` hold the end of an episode.

    CARE says what the episode has cost so far: `ground_peak` (N), `ground_impulse` (N s) and
    `ground_time` (s above GENTLE_FORCE) of the crane's force on the ground, `litres` of oil,
    `energy` of the pump and `work` of the drives (J), `swing_peak` (rad) of the grapple, `time_up`
    (s, when the log was safely up; inf before, and if it is lost), `log_speed` (m/s), and `gentle`,
    success with at most GENTLE_FORCE. With randomize, `drawn_...` say what was drawn.
    """

    metadata = {
        "render_modes": ["rgb_array"] if HEADLESS else ["human", "rgb_array"],
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: Size = 1,  # N
        diameter: float | Array | None = None,  # one or (N,), m; None draws it
        env_threads: Threads = 0,  # physics threads, 0 for all cores
        render_mode: Literal["human", "rgb_array"] | None = None,
        camera: Literal["overview", "side", "grapple"] = "overview",
        width: Annotated[int, Range(1, 1920)] = 640,
        height: Annotated[int, Range(1, 1080)] = 480,
        autoreset_mode: Literal["SameStep", "NextStep"] = "SameStep",  # or Gymnasium's enum
        **options: Unpack[Options],
    ):
        given = {
            "num_envs": num_envs,
            "env_threads": env_threads,
            "render_mode": render_mode,
            "camera": camera,
            "width": width,
            "height": height,
            "autoreset_mode": getattr(autoreset_mode, "value", autoreset_mode),
        }
        check(given | options, CraneVectorEnv.__init__, Options)
        if render_mode == "human" and HEADLESS:  # the window's library would end the process
            raise RuntimeError("render_mode 'human' needs a display, and DISPLAY is not set")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        if diameter is not None:
            d = np.asarray(diameter)
            fits = d.shape in [(), (num_envs,)] and d.dtype.kind in "fiu"
            if not fits or not np.all((D_MIN <= d) & (d <= D_MAX)):
                needed = f"one number or {num_envs} numbers in [{D_MIN}, {D_MAX}] m"
                raise ValueError(f"diameter must be {needed}, got {diameter}")
            diameter = np.broadcast_to(d.astype(float), num_envs)
        self.options = options = complete(options)
        self.task = {"revision": REVISION, **options}  # what a trained policy knows of it
        self.num_envs, self.fixed_diameter = int(num_envs), diameter
        self.process = os.getpid()
        self.render_mode, self.camera, self.frame_size = render_mode, camera, (height, width)
        self.viewer = None  # the window, or the renderer of "rgb_array"
        self.watch: Callable[[float], None] | None = None  # after each piece, with its seconds
        self.speed, self.frame_skip = SPEEDS[options["speed"]], int(options["frame_skip"])
        self.difficulty = options["difficulty"]
        self.dt = self.frame_skip * TIMESTEP  # s, one decision
        self.max_decisions = int(np.ceil(crane_task.TIME_LIMIT / self.dt - 1e-9))
        # The hold begins and ends with a decision, and both count.
        self.hold_decisions = int(np.floor(crane_task.HOLD_TIME / self.dt + 1e-9)) + 1
        self.metadata = {**self.metadata, "render_fps": max(1, round(1 / self.dt))}
        self.metadata["autoreset_mode"] = self.autoreset_mode

        engine = {name: options[name] for name in ("contact", "integrator", "solver", "actuators")}
        self.model = machine.load_model(**engine, visual=render_mode is not None)
        self.hydraulic = options["actuators"] == "hydraulic"
        self.batch = batch = Batch(self.model, self.num_envs, env_threads, persistent=True)
        ALIVE.add(self)
        for field in ("geom_size", "body_mass", "body_inertia"):
            batch.expand(field)  # each crane has a log of its own
        if options["randomize"]:  # and a machine of its own
            names = ("actuator_gainprm", "actuator_biasprm", "actuator_delay", "dof_damping")
            self.engine = {name: batch.expand(name) for name in (*names, "geom_friction")}
        # live views of the engine's arrays, one row a crane
        self.qpos, self.qvel, self.act = batch.bind("qpos"), batch.bind("qvel"), batch.bind("act")
        self.ctrl, self.qfrc_bias = batch.bind("ctrl"), batch.bind("qfrc_bias")
        self.drive_force, self.sensordata = batch.bind("qfrc_actuator"), batch.bind("sensordata")
        self.log_size, self.log_velocity = batch.geom("log").size, batch.joint("log").qvel
        # history ends with ground_force, the only sensor that has one: x, y, z of the last steps
        remembered = 3 * self.model.sensor_history[:, 0].max()
        self.ground_force = batch.bind("history")[:, -remembered:]
        self.joint_range = self.model.jnt_range[JOINTS]  # (8, 2), rad and m
        velocity, integrators = np.split(self.model.actuator_gainprm, 2)
        self.servo_kv = velocity[:, 0]  # 0 of hydraulic drives
        self.servo_kp = np.tile(integrators[:, 0], (self.num_envs, 1))
        self.max_lead = self.model.jnt_actfrcrange[SERVOS, 1] / self.servo_kp
        self.drawn = {
            name: np.tile(nominal, (self.num_envs, *[1] * np.ndim(nominal)))
            for name, (nominal, _, _) in machine.DRAWN.items()
            if self.hydraulic or name not in machine.OF_DRIVES
        }
        self.valves = machine.Valves(self.num_envs)
        self.costs = machine.Costs(self.num_envs)
        self.time_up = np.full(self.num_envs, np.inf)  # s
        self.decisions = np.zeros(self.num_envs, int)  # since the start of each episode
        self.reach_time = np.full(self.num_envs, np.inf)  # s
        self.streaks = np.zeros((3, self.num_envs), int)  # of `grip_conditions`, in decisions
        self.resting = np.zeros(self.num_envs, bool)  # NEXT_STEP: ended in the step before
        self.starts: list[tuple] = [()] * self.num_envs
        self.rngs: list[tuple[Generator, Generator, Generator]] | None = None
        draws = self.max_decisions + 1 if options["pose_noise"] == "step" else 1
        self.noise = np.zeros((self.num_envs, draws, 2))  # epsilon_p, epsilon_o

        low, high = self.joint_range.T + np.array([[-0.5], [0.5]])
        bound = np.repeat([10.0, 20.0, 1.5 * np.pi], [6, 3, 1])  # dq, Delta_p, its angle
        if options["sensors"]:
            bound = np.append(bound, np.repeat([1.0, 10.0, 1.0], [6, 2, 6]))
        bounds = np.float32([[*low, *-bound], [*high, *bound]])
        self.single_observation_space = gymnasium.spaces.Box(*bounds)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (6,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: int | Sequence | None = None, options=None) -> tuple[Array, dict]:
        """New episodes. seed: one for all (crane i draws from its i-th child), or one per crane."""
        if options:
            raise ValueError(f"reset takes no options, got {options}; see difficulty and diameter")
        super().reset(seed=seed if isinstance(seed, int) else None)
        if seed is not None or self.rngs is None:
            if seed is None or isinstance(seed, (int, np.integer)):
                seed = SeedSequence(seed).spawn(self.num_envs)
            seeds = [s if isinstance(s, SeedSequence) else SeedSequence(s) for s in seed]
            if len(seeds) != self.num_envs:
                raise ValueError(f"{len(seeds)} seeds for {self.num_envs} cranes")
            # starts, pose noise and machines have streams of their own: one leaves the others alone
            streams = [(s, s.generate_state(4), s.generate_state(8)[4:]) for s in seeds]
            self.rngs = [tuple(map(default_rng, stream)) for stream in streams]
            self.failures = [deque(maxlen=4) for _ in seeds]  # starts of failed episodes
            self.recent_success = [deque(maxlen=10) for _ in seeds]  # a crane's last episodes
        self.resting[:] = False
        obs, info = self.start_episodes(np.arange(self.num_envs))
        return obs, info | {f"_{key}": np.ones(self.num_envs, bool) for key in info}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Advance every crane by one decision, actions (N, 6), and start anew after an end.

        SAME_STEP: where an episode ends, the observation is that of the next start. NEXT_STEP: it
        is that of the end. The next step ignores the action there and gives the start, reward 0.
        """
        obs, reward, terminated, truncated, info = self.advance(actions)
        done = terminated | truncated
        of_ends = {"success", "is_success", "gentle", *CONDITIONS}
        everywhere = np.ones(self.num_envs, bool)
        info |= {f"_{key}": done if key in of_ends else everywhere for key in info}
        again = done
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            again, self.resting = self.resting, done.copy()
        elif done.any():
            info["final_info"] = info.copy()
            info["final_obs"] = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(done):
                info["final_obs"][i] = obs[i].copy()
            info["_final_obs"] = info["_final_info"] = done
        if again.any():
            starts, start_info = self.start_episodes(np.flatnonzero(again))
            obs[again] = starts[again]
            if self.autoreset_mode == AutoresetMode.NEXT_STEP:
                reward[again], info["log_speed"][again] = 0.0, 0.0
                info["time_to_reach"][again] = info["time_up"][again] = np.inf
                for key, values in (start_info | self.costs.total).items():
                    info[key][again] = values[again]
        return obs, reward, terminated, truncated, info

    def advance(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """`step` without autoreset. RuntimeError before `reset`, ValueError for wrong actions."""
        if self.rngs is None:
            raise RuntimeError("call reset() before step()")
        actions = np.asarray(actions, dtype=np.float64)
        if actions.shape != (self.num_envs, 6):
            raise ValueError(f"actions must have shape ({self.num_envs}, 6), got {actions.shape}")
        if not np.isfinite(actions).all():
            raise ValueError("actions must be finite, got NaN or infinity")
        actions = np.clip(actions, -1, 1)
        command = actions * machine.speed_limit(actions, self.speed)
        diverged = self.simulate(command)
        self.decisions += 1

        state, time = self.state(), self.decisions * self.dt
        obs, info = self.observe(state, command)
        in_time = time < crane_task.REACH_TIME + 1e-9
        near = (info["d_combine"] < crane_task.REACH_DISTANCE) & in_time
        self.reach_time = np.minimum(self.reach_time, np.where(near, time, np.inf))
        reached = np.isfinite(self.reach_time)
        gripped = crane_task.grip_conditions(info["clearance"], state.touching, info["centre_miss"])
        self.streaks = (self.streaks + 1) * gripped
        safe = (self.streaks >= self.hold_decisions).all(axis=0)
        self.time_up = np.where(safe, np.minimum(self.time_up, time), np.inf)

        bounds, speed = self.joint_range, self.speed
        ending = crane_task.termination_rule(state, time, reached, diverged, bounds, speed)
        ending[self.resting] = "none"
        truncated = ending == "time_limit"
        terminated = (ending != "none") & ~truncated
        # Success, for training, evaluation and tests alike: the log was reached in time, each of
        # the grip's conditions held at every decision of the last HOLD_TIME, nothing ended early.
        failed = ~np.array([reached, *(self.streaks >= self.hold_decisions)])
        info |= dict(zip(CONDITIONS, failed)) | {"success": truncated & ~failed.any(axis=0)}
        info["is_success"] = info["success"]
        info |= {name: cost.copy() for name, cost in self.costs.total.items()}
        info["gentle"] = info["success"] & (info["ground_peak"] <= GENTLE_FORCE)
        info["time_up"] = self.time_up.copy()
        info["log_speed"] = np.linalg.norm(self.log_velocity[:, :3], axis=-1)
        info |= {"termination": ending, "time_to_reach": self.reach_time.copy()}
        reward = sum(info[term] for term in TERMS)
        for i in np.flatnonzero(ending != "none"):
            self.recent_success[i].append(bool(info["success"][i]))
            if not info["success"][i]:
                self.failures[i].append(self.starts[i])
        if self.render_mode == "human" and self.watch is None:
            self.render()
        return obs, np.where(diverged, 0.0, reward), terminated, truncated, info

    def simulate(self, command: Array) -> Array:
        """frame_skip physics steps under a command (N, 6), rad/s and m/s; which diverged, (N,)."""
        self.stay_in_process()
        if not self.hydraulic:
            self.ctrl[:] = np.tile(command[:, COMMAND_OF_SERVO], 2)  # servos and their integrators
        failed = np.zeros(self.num_envs, bool)
        self.costs.impact[:] = 0.0
        # Anti-windup: an integrator leads its joint by no more than the force limit can use. This
        # lead keeps squeezing the log at zero command, as a check valve does. If a decision is
        # shorter than a piece, only every k-th decision of an episode clamps the integrators.
        piece = machine.VALVE_STEPS if self.hydraulic else ANTI_WINDUP
        every = max(1, piece // self.frame_skip)
        due = self.decisions % every == 0
        for start in range(0, self.frame_skip, piece):
            position = self.qpos[:, SERVOS]
            low, high = position - self.max_lead, position + self.max_lead
            np.clip(self.act, low, high, out=self.act, where=due[:, None])
            nstep = min(piece, self.frame_skip - start)
            if self.hydraulic:
                ids = np.flatnonzero(due)
                gain = np.where(command < 0, self.drawn["gain"][:, 0], self.drawn["gain"][:, 1])
                wanted, seconds = (gain * command)[ids], nstep * every * TIMESTEP
                speed = self.valves.mean_speed(ids, wanted, self.qpos[ids], seconds)
                self.ctrl[ids, 8:] = speed[:, COMMAND_OF_SERVO]
            last = start + nstep == self.frame_skip  # sensors are needed after this one only
            stage = mujoco.mjtStage.mjSTAGE_VEL if last else mujoco.mjtStage.mjSTAGE_NONE
            try:
                self.batch.step(nstep=nstep, stage=stage)
            except SimulationError as error:
                failed[error.ids] = True
            self.count_costs(nstep * TIMESTEP)
            if self.watch is not None:
                self.watch(nstep * TIMESTEP)
        finite = np.isfinite(self.qpos).all(axis=-1) & np.isfinite(self.qvel).all(axis=-1)
        return failed | self.batch.warning[:, :, 1].any(axis=-1) | ~finite

    def count_costs(self, seconds: float) -> None:
        """Add to `costs` what the last piece of a decision took."""
        sound = ~self.batch.warning[:, :, 1].any(axis=-1)[:, None]  # the engine reset the others
        ground = np.linalg.norm(self.ground_force.reshape(self.num_envs, -1, 3), axis=-1) * sound
        q, dq = self.qpos[:, JOINTS], self.qvel[:, JOINTS][:, ACTUATED] * sound
        force = self.drive_force[:, SERVOS] @ np.eye(6)[COMMAND_OF_SERVO]  # of both stages, jaws
        self.costs.add(ground, q, dq, force, seconds)

    def start_episodes(self, ids: Array) -> tuple[Array, dict[str, Array]]:
        """New episodes in cranes `ids`; observations and info of all cranes."""
        for i in ids:
            (start_rng, noise_rng, machine_rng), failures = self.rngs[i], self.failures[i]
            retry = self.options["retry"] * np.mean(self.recent_success[i] or 0.0)  # 0 at first
            if retry and failures and start_rng.random() < retry:
                self.starts[i] = failures[start_rng.integers(len(failures))]
            else:
                self.starts[i] = crane_task.sample_start(start_rng)
            bound = crane_task.POSE_NOISE
            self.noise[i] = noise_rng.uniform(-bound, bound, self.noise[i].shape)
            if self.options["randomize"]:
                drawn = machine.draw_machine(machine_rng, self.options["randomize"])
                for name, values in self.drawn.items():
                    values[i] = drawn[name]
        starts = [self.starts[i] for i in ids]
        if self.difficulty < 1:
            starts = [crane_task.ease_start(*start, self.difficulty) for start in starts]
        q, log_pose, diameter = (np.array(part) for part in zip(*starts))
        q[:, 4:6] += self.drawn["swing"][ids]
        if self.fixed_diameter is not None:
            diameter = self.fixed_diameter[ids]
        self.place(ids, q, log_pose, diameter)
        if self.render_mode == "human":
            self.render()
        return self.observe(self.state(), np.zeros((self.num_envs, 6)))

    def place(self, ids: Array, q: Array, log_pose: Array, diameter: Array) -> None:
        """Start episodes at rest in cranes `ids`: q (n, 8), log (x, y, yaw) (n, 3), m and rad."""
        self.stay_in_process()
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        radius, (x, y, yaw) = diameter / 2, log_pose.T
        # the log's own z axis lies along (-sin yaw, cos yaw, 0): a turn by yaw after one by -pi/2
        cos, sin = np.cos(yaw / 2) / np.sqrt(2), np.sin(yaw / 2) / np.sqrt(2)
        self.batch.joint("log").qpos[ids] = np.stack([x, y, radius, cos, -cos, -sin, sin], axis=-1)
        self.qpos[np.ix_(ids, JOINTS)] = q
        self.qpos[np.ix_(ids, SERVOS)] = q[:, ACTUATED][:, COMMAND_OF_SERVO]

        mass = self.drawn["density"][ids] * np.pi * radius**2 * LOG_LENGTH
        across, along = mass * (3 * radius**2 + LOG_LENGTH**2) / 12, mass * radius**2 / 2
        log, capsule = self.batch.body("log"), self.batch.geom("log_capsule")
        self.log_size[ids, 0] = capsule.size[ids, 0] = radius
        capsule.size[ids, 1] = LOG_LENGTH / 2 - radius
        log.mass[ids, 0] = mass
        log.inertia[ids] = np.stack([across, across, along], axis=-1)
        if self.options["randomize"]:
            self.set_machine(ids)
        self.batch.set_const(ids)  # bounding volumes and inverse weights follow
        self.batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_VEL)

        # the integrators start with the static load, so that an idle crane neither sags nor swings
        load = self.qfrc_bias[np.ix_(ids, SERVOS)]
        self.act[ids] = self.qpos[np.ix_(ids, SERVOS)] + load / self.servo_kp[ids]
        self.valves.close(ids)
        self.decisions[ids] = 0
        self.reach_time[ids] = self.time_up[ids] = np.inf
        self.costs.clear(ids)
        self.streaks[:, ids] = 0

    def set_machine(self, ids: Array) -> None:
        """Give the engine what was drawn for cranes `ids`. Ideal servos keep their gains."""
        friction = self.model.geom_friction * self.drawn["friction"][ids, None, None]
        self.engine["geom_friction"][ids] = friction
        if not self.hydraulic:
            return
        stiffness = self.drawn["stiffness"][ids][:, COMMAND_OF_SERVO]
        self.servo_kp[ids] = stiffness
        self.max_lead[ids] = self.model.jnt_actfrcrange[SERVOS, 1] / stiffness
        self.engine["actuator_gainprm"][ids, 8:, 0] = stiffness
        self.engine["actuator_biasprm"][ids, 8:, 1] = -stiffness
        damping = self.drawn["damping"][ids][:, COMMAND_OF_SERVO]
        self.engine["dof_damping"][np.ix_(ids, SERVOS)] = damping
        delay = self.model.actuator_delay[8:] + self.drawn["extra_delay"][ids, None]
        self.engine["actuator_delay"][ids, 8:] = delay

    def state(self) -> CraneState:
        """A copy of the state of all cranes."""
        q, dq = self.qpos[:, JOINTS], self.qvel[:, JOINTS][:, ACTUATED]
        # as in crane.xml; sensors of your own go behind the crane's force on the ground
        parts = np.split(self.sensordata.copy(), [3, 6, 9, 12, 14, 17, 20], axis=1)
        *poses, touch, support, pressure, _ = parts
        weight = 9.81 * self.batch.body("log").mass[:, 0]
        ground = np.linalg.norm(support, axis=-1) + np.linalg.norm(pressure, axis=-1)
        carried = np.clip(1 - ground / weight, 0, 1)
        return CraneState(q, dq, *poses, touch > 0, 2 * self.log_size[:, 0], carried)

    def observe(self, state: CraneState, command: Array) -> tuple[Array, dict[str, Array]]:
        """Observations (N, 18 or 32) with sensor errors, float32; info and reward terms without."""
        delta_p, delta_psi, signed_angle = crane_task.relative_pose(state, self.options["offset"])
        d_combine = np.linalg.norm(delta_p, axis=-1) + delta_psi
        clearance, miss = crane_task.log_clearance(state), crane_task.centre_miss(state)
        kind, drives, impact = self.options["reward"], self.options["actuators"], self.costs.impact
        info = {"d_combine": d_combine, "clearance": clearance, "centre_miss": miss}
        info |= {"diameter": state.diameter, "log_mass": self.batch.body("log").mass[:, 0].copy()}
        above = 0.0 if kind == "paper" else crane_task.CLOSING_HEIGHT
        distance = np.linalg.norm(delta_p + [0, 0, above], axis=-1) + delta_psi
        terms = crane_task.reward_terms(
            state, distance, clearance, miss, command, impact, self.difficulty, kind, drives
        )
        info |= dict(zip(TERMS, np.where(np.isnan(terms), 0.0, terms)))  # NaN where it diverged
        if self.options["randomize"]:
            info |= {f"drawn_{name}": values.copy() for name, values in self.drawn.items()}
        delta_p, q = delta_p + self.drawn["pose_error"], state.q + self.drawn["joint_error"]
        angle = signed_angle + self.drawn["yaw_error"]
        if not self.options["signed_yaw"]:
            change = np.abs(np.cos(signed_angle)) - np.abs(np.cos(angle))
            angle = np.clip(delta_psi + change, 0, 1)  # Delta_psi with the error of the yaw
        if self.options["pose_noise"] != "none":
            now = np.minimum(self.decisions, self.noise.shape[1] - 1)
            epsilon = self.noise[np.arange(len(now)), now]
            delta_p, angle = crane_task.noisy_pose(delta_p, angle, epsilon)
        if self.options["axes"] == "crane":
            cos, sin, (x, y, z) = np.cos(state.q[:, 0]), np.sin(state.q[:, 0]), delta_p.T
            delta_p = np.array([cos * x + sin * y, cos * y - sin * x, z]).T
        parts = [q, state.dq, delta_p, angle[:, None]]
        if self.options["sensors"]:
            force = self.servo_kp * (self.act - self.qpos[:, SERVOS])
            force += self.servo_kv * (self.ctrl[:, :8] - self.qvel[:, SERVOS])
            limit_of_force = self.model.jnt_actfrcrange[SERVOS, 1]
            force = np.clip(force / limit_of_force, -1, 1)[:, machine.FIRST_SERVO]
            last_command = command / machine.speed_limit(command, self.speed)
            parts += [last_command, self.qvel[:, JOINTS][:, PASSIVE], force]
        obs = np.concatenate(parts, axis=-1)
        obs[np.isnan(obs)] = 0  # of a crane that diverged
        space = self.single_observation_space
        return np.clip(obs, space.low, space.high).astype(np.float32, order="C"), info

    def stay_in_process(self) -> None:
        """RuntimeError in a forked process, which has none of the threads."""
        if os.getpid() != self.process and self.batch.nthread > 1:
            raise RuntimeError("make the cranes after the fork, or with env_threads=1")

    def __reduce__(self) -> None:
        raise TypeError("cranes cannot be copied or pickled; make new ones")

    @property
    def difficulty(self) -> float:
        """From 0 (easy) to 1 (the full task). It acts on r_ground at once, then on starts."""
        return self._difficulty

    @difficulty.setter
    def difficulty(self, value: float) -> None:
        check({"difficulty": value}, Options)
        self._difficulty = value

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """The attribute, once a crane, as Gymnasium's SyncVectorEnv gives it."""
        return (getattr(self, name),) * self.num_envs

    def set_attr(self, name: str, values: Any) -> None:
        """Set the difficulty, which all cranes share: one value, or a list of N equal ones."""
        values = list(values) if isinstance(values, (list, tuple)) else [values] * self.num_envs
        if name != "difficulty":
            raise AttributeError(f"only difficulty can be set, not {name}; make other cranes")
        if values != values[:1] * self.num_envs:
            raise ValueError("all cranes share difficulty: give one value or N equal ones")
        self.difficulty = values[0]

    def render(self) -> tuple[Array, ...] | None:
        """RGB frames (height, width, 3), uint8, one a crane; "human" shows crane 0 in `viewer`."""
        if self.render_mode is not None and self.viewer is None:
            import crane_view  # needs libraries that nothing else does

            kind = crane_view.Window if self.render_mode == "human" else crane_view.Photographer
            self.viewer = kind(self)
        return self.viewer.show() if self.viewer else None

    def close_extras(self, **kwargs: Any) -> None:
        if self.viewer is not None:
            self.viewer.close()
        self.viewer = None


def outlive_fork() -> None:
    """Keep all cranes alive in a forked process: their end would wait for threads for ever."""
    for envs in ALIVE:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(envs.batch))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=outlive_fork)


class CraneEnv(gymnasium.Env):
    """One crane: a view of `CraneVectorEnv`, without its num_envs and autoreset_mode."""

    metadata = CraneVectorEnv.metadata
    __reduce__ = CraneVectorEnv.__reduce__
    _spec: EnvSpec | None = None

    def __init__(self, **kwargs: Any):
        if "autoreset_mode" in kwargs:
            raise ValueError("one crane has no autoreset_mode: reset() it after an episode")
        self.envs = CraneVectorEnv(num_envs=1, **{"env_threads": 1, **kwargs})
        self.metadata = {k: v for k, v in self.envs.metadata.items() if k != "autoreset_mode"}
        self.render_mode = self.envs.render_mode
        self.observation_space = self.envs.single_observation_space
        self.action_space = self.envs.single_action_space

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Array, dict]:
        super().reset(seed=seed)
        obs, info = self.envs.reset(seed=seed, options=options)
        return obs[0], {key: value[0] for key, value in info.items() if not key.startswith("_")}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        if np.shape(action) != self.action_space.shape:
            raise ValueError(f"an action must have shape (6,), got {np.shape(action)}")
        obs, reward, terminated, truncated, info = self.envs.advance(np.asarray(action)[None])
        info = {key: value[0] for key, value in info.items()}
        return obs[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    @property
    def difficulty(self) -> float:
        """As `CraneVectorEnv.difficulty`."""
        return self.envs.difficulty

    @difficulty.setter
    def difficulty(self, value: float) -> None:
        self.envs.difficulty = value

    @property
    def spec(self) -> EnvSpec | None:
        """What Gymnasium knows of the task, with the length of an episode in decisions."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        # The registered task cannot have this length: it depends on frame_skip. For the same
        # reason a make() from this spec with another frame_skip needs max_episode_steps=-1.
        self._spec = spec and replace(spec, max_episode_steps=self.envs.max_decisions)

    def render(self) -> Array | None:
        frames = self.envs.render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        self.envs.close()


CLASSES = {"entry_point": "crane_env:CraneEnv", "vector_entry_point": "crane_env:CraneVectorEnv"}
gymnasium.register("ForestryCrane-v0", **CLASSES)
gymnasium.register("ForestryCranePaper-v0", kwargs=crane_options.PAPER, **CLASSES)
gymnasium.register("ForestryCraneHydraulic-v0", kwargs=crane_options.HYDRAULIC, **CLASSES)
gymnasium.register("ForestryCraneRandomized-v0", kwargs=crane_options.RANDOMIZED, **CLASSES)
