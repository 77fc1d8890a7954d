"""Speed of simulator and training, beside bare MuJoCo, Gymnasium and Stable-Baselines3 (SB3).

    pip install -r benchmark/requirements.txt
    python benchmark/speed.py    # 40 minutes; run nothing else

benchmark/results/throughput.csv gets the speeds, measured by turns, and their ratios. Cranes are
driven by the shipped policy or the scripted crane, whose own time does not count. Trainings are
timed at their start, from the second iteration on. Ours and SB3 have the same networks, rollout,
epochs and minibatch. SB3's fastest number of threads and arrangement of cranes counts.
"""

import multiprocessing
import os
import platform
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from math import atan2, copysign, cos, pi, sin, sqrt
from pathlib import Path
from time import perf_counter
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"  # in all processes; torch is told its own number
sys.path.insert(0, str(Path(__file__).parent.parent))

import gymnasium
import numpy as np
import sb3_contrib
import stable_baselines3
import torch
import tyro
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from tqdm import tqdm

import crane_env as task
from benchmark.runs import RESULTS, ROOT, export, write_rows
from crane_env import ACTION_OF_SERVO, ACTUATED, JOINTS, SERVOS, CraneVectorEnv, mujoco
from crane_utils import runs
from crane_utils.sb3 import CraneVecEnv
from eval_crane import SHIPPED
from hydraulic_crane import HydraulicCraneVectorEnv
from scripted_crane import ScriptedCrane

SEED, CRANES, THREADS, HELD = 1, 64, 2, 20  # HELD: physics steps of an action, at any frame skip
EPOCHS, MINIBATCHES, FISHER_SAMPLES = 8, 4, 1024
RATIOS = [  # name, dividend and divisor
    ("`CraneVectorEnv` / twice `mj_step` on one thread", "CraneVectorEnv", "twice mj_step"),
    ("`CraneVectorEnv` / Sync- or AsyncVectorEnv of `PlainCrane`", "CraneVectorEnv", "vectors"),
    ("`CraneVectorEnv`, hydraulic drives / ideal servos", "hydraulic", "ideal"),
    ("PPO / SB3 PPO on `PlainCrane`", "ppo", "SB3 PPO"),
    ("PPO / SB3 PPO on `CraneVectorEnv`", "ppo", "SB3 PPO on CraneVectorEnv"),
    ("TRPO / sb3-contrib TRPO on `PlainCrane`", "trpo", "SB3 TRPO"),
    ("recurrent PPO / sb3-contrib RecurrentPPO", "recurrent_ppo", "SB3 RecurrentPPO"),
    ("recurrent PPO / PPO (paper: 0.23)", "recurrent_ppo", "ppo"),
    ("TRPO / PPO (paper: 0.38)", "trpo", "ppo"),
    ("PPO's physics steps/s / the paper's 6,500", "ppo", "the paper's PPO"),  # 64 cores and a GPU
]


class PlainCrane(gymnasium.Env):
    """One crane in plain MuJoCo calls and scalars: faster than NumPy. `seconds` is MuJoCo's part.

    It moves and observes as ForestryCrane-v0. It has less to do: neither reward nor rules.
    """

    def __init__(self, frame_skip: int = 20):
        cranes = CraneVectorEnv(1, env_threads=1, frame_skip=frame_skip)
        self.observation_space = cranes.single_observation_space
        self.action_space = cranes.single_action_space
        self.frame_skip, self.piece, self.max_steps = frame_skip, cranes.piece, cranes.max_steps
        self.model, self.data, self.seconds = cranes.model, mujoco.MjData(cranes.model), 0.0
        self.kp = cranes.servo_kp[0]
        leads = self.model.jnt_actfrcrange[SERVOS, 1] / self.kp
        self.leads, self.speeds = [*zip(SERVOS, leads.tolist())], task.SPEED_LIMITS.T.tolist()

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        super().reset(seed=seed)
        model, data = self.model, self.data
        q, (x, y, yaw), self.diameter = task.sample_start(self.np_random)
        radius, length, log = self.diameter / 2, task.LOG_LENGTH, model.body("log")
        mass = task.LOG_DENSITY * pi * radius**2 * length
        across = mass * (3 * radius**2 + length**2) / 12
        model.geom("log").size[0] = model.geom("log_capsule").size[0] = radius
        model.geom("log_capsule").size[1] = length / 2 - radius
        log.mass[0], log.inertia[:] = mass, (across, across, mass * radius**2 / 2)
        mujoco.mj_setConst(model, data)
        mujoco.mj_resetData(model, data)
        c, s = cos(yaw / 2) / sqrt(2), sin(yaw / 2) / sqrt(2)
        data.joint("log").qpos[:] = x, y, radius, c, -c, -s, s
        data.qpos[JOINTS] = q
        data.qpos[SERVOS] = q[ACTUATED][ACTION_OF_SERVO]
        mujoco.mj_step1(model, data)
        data.act[:] = data.qpos[SERVOS] + data.qfrc_bias[SERVOS] / self.kp
        self.steps = 0
        return self.observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        model, data = self.model, self.data
        actions = [min(max(a, -1.0), 1.0) for a in action.tolist()]
        command = [a * (high if a > 0 else -low) for a, (low, high) in zip(actions, self.speeds)]
        data.ctrl[:] = 2 * [command[i] for i in ACTION_OF_SERVO]
        due = self.steps % max(1, self.piece // self.frame_skip) == 0
        for start in range(0, self.frame_skip, self.piece):
            if due:  # anti-windup
                places, act = data.qpos.tolist(), data.act.tolist()
                act = [(a, places[i], lead) for a, (i, lead) in zip(act, self.leads)]
                data.act[:] = [min(max(a, place - lead), place + lead) for a, place, lead in act]
            nstep, begun = min(self.piece, self.frame_skip - start), perf_counter()
            if start == 0:
                mujoco.mj_step2(model, data)  # mj_step1 has been called, for the observation
                nstep -= 1
            if nstep > 0:
                mujoco.mj_step(model, data, nstep)
            if start + self.piece >= self.frame_skip:
                mujoco.mj_step1(model, data)
            self.seconds += perf_counter() - begun
        self.steps += 1
        return self.observe(), 0.0, False, self.steps == self.max_steps, {}

    def observe(self) -> np.ndarray:
        places, speeds = self.data.qpos.tolist(), self.data.qvel.tolist()
        q, dq = [places[i] for i in JOINTS], [speeds[JOINTS[i]] for i in ACTUATED]
        gx, gy, gz, ax, ay, _, lx, ly, lz, ux, uy, *_ = self.data.sensordata.tolist()
        x, y, z = lx - gx, ly - gy, lz - gz + (task.D_MAX - self.diameter) / 2
        angle = (atan2(ax * uy - ay * ux, ax * ux + ay * uy) + pi / 2) % pi - pi / 2
        rotator = q[6] + (atan2(ly, lx) - q[0] + pi) % (2 * pi) - pi - angle
        angle += copysign(pi, rotator) if abs(rotator) > task.ROTATOR_MAX else 0.0
        c, s = cos(q[0]), sin(q[0])
        return np.array([*q, *dq, c * x + s * y, c * y - s * x, z, angle], np.float32)


def disagreement(policy: Any, frame_skip: int) -> float:
    """Largest difference of PlainCrane's observations from those of CraneVectorEnv in a trial."""
    envs, plain = CraneVectorEnv(1, frame_skip=frame_skip), PlainCrane(frame_skip)
    obs, other, worst = envs.reset(seed=[1])[0], plain.reset(seed=1)[0], 0.0
    for step in range(plain.max_steps - 1):
        worst = max(worst, np.abs(obs[0] - other).max())
        if step * frame_skip % HELD == 0:
            actions, _ = policy.predict(obs)
        obs, other = envs.step(actions)[0], plain.step(actions[0])[0]
    return worst


# ---- what is measured: each function returns speeds in steps/s


def drive(make: Callable, policy: Any, tenths: int, frame_skip: int) -> list[float]:
    """envs.step alone, for so many tenths of a second of the crane."""
    envs, memory, elapsed, steps = make(), None, 0.0, tenths * HELD // frame_skip
    obs, _ = envs.reset(seed=SEED)
    for step in range(steps):
        if step * frame_skip % HELD == 0:
            actions, memory = policy.predict(obs, memory)
        start = perf_counter()
        obs = envs.step(actions)[0]
        elapsed += perf_counter() - start
    envs.close()
    return [steps * envs.num_envs / elapsed]


def bare(policy: Any, tenths: int, frame_skip: int) -> list[float]:
    """MuJoCo alone, one crane after the other, twice as fast as on one thread."""
    envs = SyncVectorEnv([PlainCrane] * 16)
    drive(lambda: envs, policy, tenths, HELD)
    seconds = sum(crane.seconds for crane in envs.envs)
    return [THREADS * 16 * tenths * HELD / frame_skip / seconds]


def vectors(policy: Any, tenths: int, frame_skip: int) -> list[float]:
    """The faster of Gymnasium's vectors of 16 plain cranes."""
    how = {"env_fns": [partial(PlainCrane, frame_skip)] * 16, "autoreset_mode": "SameStep"}
    made = (partial(kind, **how) for kind in (SyncVectorEnv, AsyncVectorEnv))
    return max(drive(make, policy, tenths, frame_skip) for make in made)


def train_ours(script: str, frame_skip: int, rollout: int) -> list[float]:
    """Iterations 2 and 3 of one of our scripts."""
    flags = f"--num-envs {CRANES} --threads {THREADS} --num-steps {rollout // CRANES} "
    flags += f"--total-timesteps {3 * rollout} --update-epochs {EPOCHS} --final-trials 1 "
    batch = f"minibatch-size {rollout // MINIBATCHES}"
    batch = f"num-minibatches {MINIBATCHES}" if script == "recurrent_ppo" else batch
    flags += f"--env.frame-skip {frame_skip} --physics-step 0 --{batch} "
    flags += f"--fisher-samples {FISHER_SAMPLES}" if script == "trpo" else "--target-kl 1e9"
    command = [sys.executable, str(ROOT / f"{script}_crane.py"), *flags.split()]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(command, cwd=folder, check=True, **quiet)  # run it alone to see an error
        return [float(row["SPS"]) for row in export(next(Path(folder).glob("runs/*")))[1:]]


def train_sb3(algorithm: str, kind: str, n: int, frame_skip: int, rollout: int) -> list[float]:
    """Two iterations of SB3 on n cranes, with the better number of threads."""
    plain = [partial(PlainCrane, frame_skip)] * n
    if kind == "Crane":
        envs = CraneVecEnv(n, env_threads=THREADS, frame_skip=frame_skip)
    else:
        envs = DummyVecEnv(plain) if kind == "Dummy" else SubprocVecEnv(plain)
    policy = {"net_arch": [256, 256], "log_std_init": -1.2}  # as ours start: wilder ones end more
    options = {"n_steps": rollout // n, "batch_size": rollout // MINIBATCHES, "device": "cpu"}
    maker, network, epochs = stable_baselines3.PPO, "MlpPolicy", {"n_epochs": EPOCHS}
    if algorithm == "TRPO":
        # The step as in trpo_crane.py: SB3 averages the KL divergence over the action's components.
        # It takes gradient and line search over the sample, too.
        maker, epochs = sb3_contrib.TRPO, {"n_critic_updates": EPOCHS}
        options |= {"target_kl": 0.04 / 6, "cg_damping": 0.1 / 6}
        options |= {"sub_sampling_factor": max(1, rollout // FISHER_SAMPLES)}
    elif algorithm == "RecurrentPPO":  # one memory, as ours; its networks do not see obs beside it
        maker, network = sb3_contrib.RecurrentPPO, "MlpLstmPolicy"
        policy |= {"lstm_hidden_size": 64, "shared_lstm": True, "enable_critic_lstm": False}
    model = maker(network, envs, policy_kwargs=policy, **options, **epochs).learn(rollout)
    rates: dict[int, list[float]] = {1: [], 2: []}
    for threads in (1, 2, 1, 2):
        torch.set_num_threads(threads)
        start = perf_counter()
        model.learn(rollout, reset_num_timesteps=False)
        rates[threads].append(rollout / (perf_counter() - start))
    envs.close()
    return max(rates.values(), key=np.median)


def best_sb3(algorithm: str, ways: list, frame_skip: int, rollout: int) -> list[float]:
    """`train_sb3` in the fastest of several arrangements, each in a fresh process."""
    rates = []
    for way in ways:
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            rates.append(pool.submit(train_sb3, algorithm, *way, frame_skip, rollout).result())
    return max(rates, key=np.median)


# ---- all of it


def cells() -> dict[tuple[str, int], Callable[[], list[float]]]:
    """What to measure, by name and frame skip."""
    policy, script = runs.load_policy(Path(SHIPPED))[0], ScriptedCrane()
    os.environ.pop("GOMP_SPINCOUNT", None)  # the script has set it; SB3 has torch's default
    tenths, rollout = 450, 128 * CRANES  # five whole episodes
    found: dict = {("the paper's PPO", 1): lambda: [6500.0]}
    for skip in (20, 1):
        assert disagreement(policy, skip) < 1e-3, "PlainCrane is another task"
        own = {"env_threads": THREADS, "frame_skip": skip}
        ideal = partial(CraneVectorEnv, CRANES, **own)
        hydraulic = partial(HydraulicCraneVectorEnv, CRANES, **own)
        found["twice mj_step", skip] = partial(bare, policy, tenths, skip)
        found["CraneVectorEnv", skip] = partial(drive, ideal, policy, tenths, skip)
        found["ideal", skip] = partial(drive, ideal, script, tenths, skip)
        found["hydraulic", skip] = partial(drive, hydraulic, script, tenths, skip)
        found["vectors", skip] = partial(vectors, policy, tenths, skip)
        for name in ("mppo_beta", "ppo", "trpo", "recurrent_ppo"):
            found[name, skip] = partial(train_ours, name, skip, rollout)
        plain, ours = [("Dummy", 16), ("Dummy", 64), ("Subproc", 16)], [("Crane", CRANES)]
        for name in ("PPO", "TRPO", "RecurrentPPO"):
            found[f"SB3 {name}", skip] = partial(best_sb3, name, plain, skip, rollout)
        found["SB3 PPO on CraneVectorEnv", skip] = partial(best_sb3, "PPO", ours, skip, rollout)
    return found


def main() -> None:
    torch.set_num_threads(1)
    if hasattr(os, "sched_setaffinity"):  # Linux: as many cores for everybody
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:THREADS])
    measured, speeds = cells(), defaultdict(list)
    for key in (bar := tqdm([*measured] * 3, unit="cell")):
        bar.set_description(f"{key[0]}, skip {key[1]}")
        speeds[key].append(np.median(measured[key]()))
    libraries = (mujoco, gymnasium, torch, stable_baselines3, sb3_contrib)
    versions = [f", {library.__name__} {library.__version__}" for library in libraries]
    machine = f"{os.cpu_count()} cores, {platform.platform()}{''.join(versions)}"
    rows: list[dict] = [{"part": "machine", "what": machine}]
    values = {("steps/s", *key): of_rounds for key, of_rounds in speeds.items()}
    for skip, (name, ours, other) in product((20, 1), RATIOS):
        if (other, skip) in speeds:  # round by round: the machine may become slower or faster
            values["ratio", name, skip] = np.array(speeds[ours, skip]) / speeds[other, skip]
    for (part, what, skip), of_rounds in values.items():
        row = {"part": part, "what": what, "skip": skip}
        for name, of in (("median", np.median), ("min", min), ("max", max)):
            row[name] = f"{of(of_rounds):.4g}"
        rows.append(row)
    write_rows(RESULTS / "throughput.csv", rows)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
