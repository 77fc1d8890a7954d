"""Where the time goes: in a decision, in a physics step and in the torch operations of a training.

    python benchmark/profiles.py    # a minute; run nothing else

- A decision: the engine's share of CraneVectorEnv.step, for 64 cranes under the shipped mPPO
  policy. The rest is Python: poses, rewards, rules, costs.
- A physics step: its stages for one crane, called one by one in the states that the policy visits.
  The shares are those of their sum, without the integration and the sensors. Each time is that of
  the fastest of 20 calls, without the call from Python. A call of mj_flex shows what that takes,
  because this function has nothing to do here.
- Torch in PPO: the share of matrix products in all torch operations of a short training.

benchmark/profiles.csv has the results.
"""

import csv
import runpy
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent))

import crane_policies
import crane_runs
import mujoco
import numpy as np
import tyro
from plain_crane import PlainCrane
from torch.profiler import profile
from tqdm import tqdm

from crane_env import CraneVectorEnv

ROOT = Path(__file__).parent.parent
CRANES, DECISIONS, SEED = 64, 90, 1
TRIALS, REPEATS = 5, 20  # of the physics; in each state
RESULTS = Path(__file__).parent / "profiles.csv"
STATE = mujoco.mjtState.mjSTATE_INTEGRATION  # all, with the solver's warm start
STAGES = {  # of a physics step up to the accelerations, in the engine's order
    "positions and inertia": (
        mujoco.mj_kinematics,
        mujoco.mj_comPos,
        mujoco.mj_camlight,
        mujoco.mj_tendon,
        mujoco.mj_makeM,
        mujoco.mj_factorM,
    ),
    "collisions": (mujoco.mj_collision,),
    "constraints, set up": (
        mujoco.mj_makeConstraint,
        mujoco.mj_island,
        mujoco.mj_transmission,
        mujoco.mj_projectConstraint,
    ),
    "velocities and forces": (
        mujoco.mj_fwdVelocity,
        mujoco.mj_fwdActuation,
        mujoco.mj_fwdAcceleration,
    ),
    "constraints, solved": (mujoco.mj_fwdConstraint,),
}
Rows = list[tuple[str, str, float]]  # part, what, share in [0, 1]


def env_shares() -> Rows:
    policy, _, _ = crane_policies.load_policy(crane_policies.SHIPPED)
    rows = []
    for frame_skip in (20, 1):
        for threads in (1, 2):
            envs = CraneVectorEnv(CRANES, frame_skip=frame_skip, env_threads=threads)
            step, engine, total = envs.batch.step, 0.0, 0.0

            def timed_step(step: Callable = step, **kwargs: Any) -> None:
                nonlocal engine
                begin = time.perf_counter()
                step(**kwargs)
                engine += time.perf_counter() - begin

            envs.batch.step = timed_step
            obs, _ = envs.reset(seed=SEED)
            for k in range(DECISIONS * 20 // frame_skip):
                if k * frame_skip % 20 == 0:
                    actions, _ = policy.predict(obs)
                begin = time.perf_counter()
                obs = envs.step(actions)[0]
                total += time.perf_counter() - begin
            envs.close()
            name = f"engine: skip {frame_skip}, {threads} thread{'s' * (threads > 1)}"
            rows.append(("a decision", name, engine / total))
    return rows


def physics_shares() -> Rows:
    """Shares of the stages' sum."""
    policy, _, _ = crane_policies.load_policy(crane_policies.SHIPPED)
    crane = PlainCrane()
    everything = {**STAGES, "call": (mujoco.mj_flex,)}
    probe, seconds = mujoco.MjData(crane.model), defaultdict(float)
    state = np.empty(mujoco.mj_stateSize(crane.model, STATE))
    for seed in range(TRIALS):
        obs, ended = crane.reset(seed=seed)[0], False
        while not ended:
            obs, _, terminated, truncated, _ = crane.step(policy.predict(obs[None])[0][0])
            ended = terminated or truncated
            mujoco.mj_getState(crane.model, crane.data, state, STATE)
            mujoco.mj_setState(crane.model, probe, state, STATE)
            for stage, functions in everything.items():
                times = []
                for _ in range(REPEATS):
                    probe.qacc_warmstart = crane.data.qacc_warmstart  # the solver changes it
                    begin = time.perf_counter()
                    for function in functions:
                        function(crane.model, probe)
                    times.append(time.perf_counter() - begin)
                seconds[stage] += min(times)
    call = seconds.pop("call")
    for stage, functions in STAGES.items():
        seconds[stage] -= len(functions) * call
    whole = sum(seconds.values())
    return [("a physics step", stage, spent / whole) for stage, spent in seconds.items()]


def torch_shares() -> Rows:
    """Shares of torch's own time in a training of PPO; the physics is no part of it."""
    arguments = "--total-timesteps 24576 --eval-every 0 --final-trials 0 --torch-threads 1".split()
    sys.argv = ["ppo_crane.py", *arguments]
    with tempfile.TemporaryDirectory() as folder, chdir(folder), profile() as profiled:
        runpy.run_path(str(ROOT / "ppo_crane.py"), run_name="__main__")
    seconds = {entry.key: entry.self_cpu_time_total for entry in profiled.key_averages()}
    whole = sum(spent for key, spent in seconds.items() if key.startswith("aten::"))
    spent = seconds["aten::addmm"] + seconds["aten::mm"]
    return [("torch in PPO", "matrix products", spent / whole)]


def main() -> None:
    parts = (env_shares, physics_shares, torch_shares)
    rows = [row for part in tqdm(parts, unit="part") for row in part()]
    with open(RESULTS, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["part", "what", "share"])
        writer.writerows([part, what, f"{share:.3f}"] for part, what, share in rows)
    for part, what, share in rows:
        print(f"{part:16} {what:30} {100 * share:5.1f} %")


if __name__ == "__main__":
    crane_runs.one_line_errors()
    tyro.cli(main, description=__doc__)
