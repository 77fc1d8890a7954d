"""Speed of simulator and training, beside bare MuJoCo, Gymnasium and Stable-Baselines3 (SB3).

All of it is one run on one machine. The cheap measurements take turns, so that a disturbance hits
all of them. At the end come the ratios that matter, some with a target.

    pip install -r benchmark/requirements.txt
    python benchmark/throughput.py                      # ten minutes; run nothing else
    python benchmark/throughput.py --only physics env   # some parts
    python benchmark/throughput.py --quick              # does it work? its numbers mean nothing

- physics: mujoco.mj_step alone, on the states that the shipped policy visits. This is the limit.
- env: CraneVectorEnv driven by that policy. The policy's own time does not count.
- vector: the same for Gymnasium's vector environments of `PlainCrane`, one crane in plain MuJoCo
  calls. A check comes first: it is the task of CraneVectorEnv.
- training: iterations of our scripts and of SB3, from the second on.

Both sides of the training have the same network, rollout, epochs and minibatch. TRPO solves for its
direction on 1,024 decisions. SB3 has the number and kind of environments in which its PPO collects
fastest, and RecurrentPPO also 64 environments at once. SB3 has 1 or 2 threads, whichever is faster,
with torch's own settings, no monitor and no normalized observations. Our scripts have their default
threads and run all epochs. Everything else has their defaults.

What is timed is the start of a training: no crane holds a log yet. "update" is what follows the
rollout. Ours contains values, log-probabilities and advantages, which SB3 computes before.
"""

import csv
import multiprocessing
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

os.environ["OMP_NUM_THREADS"] = "1"  # in all processes; torch is told its own number
sys.path.insert(0, str(Path(__file__).parent.parent))

import crane_policies
import crane_runs
import crane_task
import gymnasium
import mujoco
import numpy as np
import torch
import tyro
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from plain_crane import PlainCrane, disagreement
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tqdm import tqdm

import eval_crane
from crane_env import CraneVectorEnv
from scripted_crane import HYDRAULIC, IDEAL, ScriptedCrane

try:
    import psutil
    import sb3_contrib
    import sb3_training as sb3
    import stable_baselines3
    from sb3_training import CRANES, EPOCHS, LSTM, MINIBATCHES, NETWORK, SEED, THREADS, Iteration
except ImportError as error:
    sys.exit(f"{error.name} is missing: pip install -r benchmark/requirements.txt")

os.environ.pop("GOMP_SPINCOUNT", None)  # of our scripts, imported above; SB3 has torch's default
ROOT = Path(__file__).parent.parent
RESULTS = Path(__file__).parent / "throughput.csv"
PARTS = ("physics", "env", "vector", "training")
HELD_STEPS = 20  # physics steps that an action of the policy holds, at any frame skip
SCRIPTS = ("mppo_beta", "ppo", "trpo", "recurrent_ppo")
JOBS = 10  # processes of training for a frame skip
EPISODES = "mj_step, whole episodes"
STATE = mujoco.mjtState.mjSTATE_INTEGRATION  # all, with the solver's warm start


class Sizes(NamedTuple):
    repetitions: int
    decisions: int  # at 10 Hz, of each crane in each repetition
    cranes: tuple[int, ...]  # of CraneVectorEnv
    workers: tuple[int, ...]  # of Gymnasium's environments
    num_steps: int  # decisions per crane and rollout


FULL = Sizes(3, 90, (1, 64), (1, 16), 128)  # 90 decisions: an episode
QUICK = Sizes(2, 3, (1, 64), (1, 2), 8)


class Result(NamedTuple):
    unit: str
    values: list[float]
    note: str = ""


Results = dict[tuple[str, str, int], Result]  # by part, what, frame skip


@dataclass
class Args:
    only: tuple[Literal["physics", "env", "vector", "training"], ...] = PARTS
    """parts to measure; a ratio between two parts needs both"""
    quick: bool = False
    """tiny sizes, to try the script"""
    csv: Path | None = None
    """file to write; unset: benchmark/throughput.csv after a full run, none after any other"""


# ---- physics, env, vector: cheap, so repeated by turns


class Sample(NamedTuple):
    """A crane before a decision."""

    model: mujoco.MjModel
    state: np.ndarray
    ctrl: np.ndarray
    kind: str  # "free motion", "held log", or "" between them


def record(policy: Any, options: dict, decisions: int) -> list[Sample]:
    """The states that `drive` visits with CRANES cranes, one a decision, crane after crane."""
    envs = CraneVectorEnv(CRANES, **options | {"frame_skip": HELD_STEPS})
    obs, _ = envs.reset(seed=SEED)
    memory, data, done = None, mujoco.MjData(envs.model), np.ones(CRANES, bool)
    models: list[Any] = [None] * CRANES
    samples: list[list[Sample]] = [[] for _ in range(CRANES)]
    for _ in range(decisions):
        before = []
        for i in range(CRANES):
            models[i] = envs.batch.get_model(i) if done[i] else models[i]  # a new log
            envs.batch.get_data(i, data)
            state = np.empty(mujoco.mj_stateSize(models[i], STATE))
            mujoco.mj_getState(models[i], data, state, STATE)
            before.append((models[i], state, data.sensordata[12:14] > 0))
        actions, memory = policy.predict(obs, memory)
        obs, _, terminated, truncated, info = envs.step(actions)
        done = terminated | truncated
        for i in np.flatnonzero(~done):  # the controls of an ended episode are gone
            model, state, touching = before[i]
            lifted = touching.all() and info["clearance"][i] > crane_task.MIN_CLEARANCE
            kind = "held log" if lifted else "" if touching.any() else "free motion"
            ctrl = envs.batch.get_data(i, data).ctrl.copy()
            samples[i].append(Sample(model, state, ctrl, kind))
    envs.close()
    return [sample for crane in samples for sample in crane]


def replay(samples: list[Sample]) -> float:
    """Steps/s of mj_step alone, HELD_STEPS from each sample."""
    data, elapsed = mujoco.MjData(samples[0].model), 0.0
    for model, state, ctrl, _ in samples:
        mujoco.mj_setState(model, data, state, STATE)
        data.ctrl[:] = ctrl
        start = time.perf_counter()
        mujoco.mj_step(model, data, HELD_STEPS)
        elapsed += time.perf_counter() - start
    return HELD_STEPS * len(samples) / elapsed


def replay_in_threads(samples: list[Sample]) -> float:
    """Steps/s of THREADS times `replay` at once; mj_step lets go of Python's lock."""
    with ThreadPoolExecutor(THREADS) as pool:
        return sum(pool.map(replay, [samples[k::THREADS] for k in range(THREADS)]))


def drive(make_envs: Callable, policy: Any, decisions: int, frame_skip: int) -> float:
    """Decisions/s of envs.step alone."""
    envs = make_envs()
    obs, _ = envs.reset(seed=SEED)
    memory, hold, elapsed = None, HELD_STEPS // frame_skip, 0.0
    for step in range(decisions * hold):
        if step % hold == 0:
            actions, memory = policy.predict(obs, memory)
        start = time.perf_counter()
        obs = envs.step(actions)[0]
        elapsed += time.perf_counter() - start
    envs.close()
    return decisions * hold * envs.num_envs / elapsed


def env_name(cranes: int = CRANES, threads: int = THREADS) -> str:
    return f"CraneVectorEnv {cranes} cranes, {threads} threads"


def scripted_name(actuators: str) -> str:
    return f"{env_name()}, {actuators} drives under the scripted crane"


def cheap_cells(parts: tuple[str, ...], sizes: Sizes, policy: Any, options: dict) -> dict:
    """What to measure by turns: unit, repetitions and function of each key of Results."""
    cells = {}
    if "physics" in parts:
        samples = record(policy, options, sizes.decisions)
        runs = {EPISODES: partial(replay, samples)}
        runs[f"{EPISODES}, {THREADS} threads at once"] = partial(replay_in_threads, samples)
        for kind in ("free motion", "held log"):
            selected = [sample for sample in samples if sample.kind == kind]
            if selected:  # --quick holds no log
                runs[f"mj_step, {kind}"] = partial(replay, selected)
        for what, run in runs.items():
            cells["physics", what, HELD_STEPS] = ("steps/s", sizes.repetitions, run)

    def add(part: str, what: str, skip: int, n: int, make_envs: Callable, policy=policy) -> None:
        run = partial(drive, make_envs, policy, sizes.decisions * max(1, 4 // n), skip)
        cells[part, what, skip] = ("decisions/s", sizes.repetitions, run)

    for skip in (20, 1):
        if "env" in parts:
            for n, threads in product(sizes.cranes, (1, 2)):
                own = {"frame_skip": skip, "env_threads": threads}
                make = partial(CraneVectorEnv, n, **options | own)
                add("env", env_name(n, threads), skip, n, make)
            for actuators, settings in {"ideal": IDEAL, "hydraulic": HYDRAULIC}.items():
                own = {"frame_skip": skip, "env_threads": THREADS, "actuators": actuators}
                make = partial(CraneVectorEnv, CRANES, **options | own)
                script = ScriptedCrane(settings=settings)
                add("env", scripted_name(actuators), skip, CRANES, make, script)
        if "vector" in parts:
            same = {"autoreset_mode": AutoresetMode.SAME_STEP}  # as CraneVectorEnv
            for n in sizes.workers:
                envs = [partial(PlainCrane, skip)] * n
                make = partial(SyncVectorEnv, envs, **same)
                add("vector", f"SyncVectorEnv {n}", skip, n, make)
                make = partial(AsyncVectorEnv, envs, context=sb3.START, **same)
                add("vector", f"AsyncVectorEnv {n}", skip, n, make)
    return cells


# ---- training: each in a process of its own


def answer(connection: Any, function: Callable, args: tuple) -> None:
    connection.send(function(*args))


def in_child(function: Callable, *args: Any) -> Any:
    """function(*args) in a fresh process."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=answer, args=(sender, function, args))
    process.start()
    sender.close()
    try:
        result = receiver.recv()
    except EOFError:
        raise SystemExit(f"{function.__name__}{args} has failed, see above") from None
    process.join()
    return result


def train_ours(script: str, frame_skip: int, num_steps: int) -> list[Iteration]:
    """Iterations 2 to 4 of one of our scripts."""
    rollout = CRANES * num_steps
    threads = crane_policies.ALGORITHMS[script].Args().torch_threads
    flags = {"num-envs": CRANES, "env-threads": THREADS, "torch-threads": threads}
    flags |= {"env.frame-skip": frame_skip, "num-steps": num_steps, "update-epochs": EPOCHS}
    flags |= {"total-timesteps": 4 * rollout, "eval-every": 0, "final-trials": 0}
    if script == "recurrent_ppo":
        flags |= {"num-minibatches": MINIBATCHES, "lstm-size": LSTM}
    else:
        flags |= {"minibatch-size": rollout // MINIBATCHES}
    flags |= {"fisher-samples": sb3.FISHER_SAMPLES} if script == "trpo" else {"target-kl": None}
    words = [word for name, value in flags.items() for word in (f"--{name}", str(value))]
    words += ["--hidden-sizes", *map(str, NETWORK)]
    command = [sys.executable, str(ROOT / f"{script}_crane.py"), *words]
    with tempfile.TemporaryDirectory() as folder, open(Path(folder) / "log", "w+") as log:
        if subprocess.run(command, cwd=folder, stdout=log, stderr=log).returncode:
            log.seek(0)
            raise SystemExit(f"{' '.join(command)} has failed:\n{log.read()[-2000:]}")
        (run,) = Path(folder).glob("runs/*")
        events = EventAccumulator(str(run)).Reload()
    updates = events.Scalars("time/update")
    seconds = np.diff([event.wall_time for event in updates])
    values = [event.value for event in updates[1:]]
    return [Iteration(rollout / s, value, threads) for s, value in zip(seconds, values)]


def measure_training(results: Results, sizes: Sizes, bar: tqdm) -> None:
    rollout = CRANES * sizes.num_steps

    def add(what: str, skip: int, iterations: list[Iteration], note: str) -> None:
        chosen = sb3.with_better_threads(iterations)
        note = f"{note}, torch threads {chosen[0].threads}"
        rates, updates = [i.rate for i in chosen], [i.update for i in chosen]
        results["training", what, skip] = Result("decisions/s", rates, note)
        results["training", f"{what}, update", skip] = Result("s", updates)
        bar.update()

    for skip in (20, 1):
        for script in SCRIPTS:
            bar.set_description(script)
            note = f"{CRANES} cranes, physics threads {THREADS}"
            add(f"{script}_crane.py", skip, train_ours(script, skip, sizes.num_steps), note)
        bar.set_description("SB3's arrangements")
        trials = in_child(sb3.try_arrangements, skip, rollout // 4)
        speeds = []
        for (kind, n), trial in zip(sb3.ARRANGEMENTS, trials):
            rates = [i.rate for i in sb3.with_better_threads(trial)]
            what = f"SB3 PPO collects, {kind}VecEnv {n}"
            results["training", what, skip] = Result("decisions/s", rates)
            speeds.append(np.median(rates))
        bar.update()
        fastest = sb3.ARRANGEMENTS[np.argmax(speeds)]
        for what, job in {
            "SB3 PPO": ("PPO", *fastest),
            "SB3 PPO on CraneVectorEnv": ("PPO", "Crane", CRANES),
            "SB3 TRPO": ("TRPO", *fastest),
            "SB3 RecurrentPPO": ("RecurrentPPO", *fastest),
            "SB3 RecurrentPPO, 64 at once": ("RecurrentPPO", "Dummy", 64),
        }.items():
            bar.set_description(what)
            iterations = in_child(sb3.train_sb3, *job, skip, rollout)
            add(what, skip, iterations, f"{job[1]}VecEnv {job[2]}")


# ---- reports


def machine() -> str:
    cpu = platform.processor()
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next((x.split(": ")[1] for x in lines if x.startswith("model name")), cpu)
    memory = psutil.virtual_memory().total / 2**30
    libraries = (mujoco, gymnasium, torch, stable_baselines3, sb3_contrib)
    versions = ", ".join(f"{library.__name__} {library.__version__}" for library in libraries)
    return (
        f"{cpu}, {os.cpu_count()} logical cores, {memory:.0f} GB, {platform.platform()}, "
        f"Python {platform.python_version()}, {versions}"
    )


def table(results: Results) -> list[list]:
    """Header and rows; steps/s are physics steps."""
    rows = [["part", "what", "skip", "unit", "median", "min", "max", "n", "steps/s", "note"]]
    for part, what, skip in sorted(results, key=lambda key: PARTS.index(key[0])):
        unit, values, note = results[part, what, skip]
        numbers = [float(f"{x:.4g}") for x in (np.median(values), min(values), max(values))]
        factor = {"steps/s": 1, "decisions/s": skip}.get(unit)
        steps = round(factor * numbers[0]) if factor else ""
        rows.append([part, what, skip, unit, *numbers, len(values), steps, note])
    return rows


class Ratio(NamedTuple):
    name: str
    skip: int
    value: float
    target: float | None = None


def ratios(results: Results) -> list[Ratio]:
    """What has been measured beside something else.

    The paper trains PPO at 6500 steps/s with 64 cores and a GPU, its recurrent PPO at 0.23 and its
    TRPO at 0.38 of that speed.
    """

    def median(part: str, what: str, skip: int) -> float:
        result = results.get((part, what, skip))
        return float(np.median(result.values)) if result else np.nan

    found = []
    for skip, env_target, ppo_target in [(20, 0.85, 1.8), (1, 0.55, 1.5)]:
        env, train = partial(median, "env", skip=skip), partial(median, "training", skip=skip)
        limit = THREADS * median("physics", EPISODES, HELD_STEPS)
        vector = [key for key in results if key[0] == "vector" and key[2] == skip]
        rival = max((median(*key) for key in vector), default=np.nan)
        ours, ppo, trpo = env(env_name()), train("ppo_crane.py"), train("trpo_crane.py")
        recurrent, sb3_ppo = train("recurrent_ppo_crane.py"), train("SB3 PPO")
        sb3_recurrent = max(train("SB3 RecurrentPPO"), train("SB3 RecurrentPPO, 64 at once"))
        ideal, hydraulic = (env(scripted_name(kind)) for kind in ("ideal", "hydraulic"))
        for name, value, target in [
            ("`CraneVectorEnv` / twice `mj_step` on one thread", skip * ours / limit, env_target),
            ("`CraneVectorEnv` / Sync- or AsyncVectorEnv of `PlainCrane`", ours / rival, None),
            ("`CraneVectorEnv`, hydraulic drives / ideal servos", hydraulic / ideal, 0.8),
            ("PPO / SB3 PPO on `PlainCrane`", ppo / sb3_ppo, ppo_target),
            ("PPO / SB3 PPO on `CraneVectorEnv`", ppo / train("SB3 PPO on CraneVectorEnv"), None),
            ("TRPO / sb3-contrib TRPO on `PlainCrane`", trpo / train("SB3 TRPO"), None),
            ("recurrent PPO / sb3-contrib RecurrentPPO", recurrent / sb3_recurrent, None),
            ("recurrent PPO / PPO (paper: 0.23)", recurrent / ppo, None),
            ("TRPO / PPO (paper: 0.38)", trpo / ppo, None),
        ]:
            found.append(Ratio(name, skip, value, target))
    found.append(Ratio("PPO's simulation steps/s / the paper's 6,500", 1, ppo / 6500))
    return [ratio for ratio in found if not np.isnan(ratio.value)]


def main() -> None:
    crane_runs.one_line_errors()
    args = tyro.cli(Args, description=__doc__)
    full = not args.quick and set(args.only) == set(PARTS)
    path = args.csv or (RESULTS if full else None)
    if path and not path.parent.is_dir():
        raise SystemExit(f"--csv: no folder {path.parent}; make it first")
    sizes = QUICK if args.quick else FULL
    torch.set_num_threads(1)
    if hasattr(os, "sched_setaffinity"):  # Linux: as many cores for everybody
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:THREADS])
    print(machine())
    policy, task, _ = crane_policies.load_policy(crane_policies.SHIPPED)
    _, options = eval_crane.task_of(eval_crane.Args(), task)
    if {"vector", "training"} & set(args.only):
        for skip in (20, 1):
            apart = max(disagreement(policy, options, skip))
            print(f"PlainCrane beside CraneVectorEnv, skip {skip}: apart by {apart:.0e}")
            if apart > 1e-3:
                raise SystemExit("PlainCrane is another task: plain_crane.py needs your change")

    results: Results = {}
    cells = cheap_cells(args.only, sizes, policy, options)
    total = sum(repetitions for _, repetitions, _ in cells.values())
    total += 2 * JOBS * ("training" in args.only)
    with tqdm(total=total) as bar:
        for repetition in range(sizes.repetitions):
            for key, (unit, repetitions, run) in cells.items():
                if repetition < repetitions:
                    bar.set_description(key[1])
                    results.setdefault(key, Result(unit, [])).values.append(run())
                    bar.update()
        if "training" in args.only:
            measure_training(results, sizes, bar)

    rows = table(results)
    for part, what, skip, unit, *numbers, steps, note in rows:
        print(f"{part:<8} {what:<50} {skip:>4} {unit:<11}", *(f"{x:>9}" for x in numbers), end=" ")
        print(f"{steps:>8}  {note}")
    found = ratios(results)
    if found:
        print(f"\n{'ratio':<60} skip {'value':>6} target")
    else:
        print("\nno ratio without physics and env, env and vector, or training")
    for name, skip, value, target in found:
        verdict = "" if target is None else f"{target:>6}  {'met' if value >= target else 'MISSED'}"
        print(f"{name:<60} {skip:>4} {value:>6.2f} {verdict}")
        rows.append(["ratio", name, skip, "1", f"{value:.4g}", "", "", "", "", target])
    if path:
        unfinished = path.with_suffix(".tmp")
        with open(unfinished, "w", newline="") as file:
            file.write(f"# {machine()}\n")
            csv.writer(file).writerows(rows)
        os.replace(unfinished, path)
        print(f"written to {path}")


if __name__ == "__main__":
    main()
