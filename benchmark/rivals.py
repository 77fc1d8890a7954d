"""What a user would pick instead, measured on the same cranes: 10 minutes each on two cores.

    pip install -r requirements.txt -r benchmark/rivals-requirements.txt
    python benchmark/rivals.py                                  # all, about 10 hours
    python benchmark/rivals.py --rivals sb3_ppo sac --seeds 1   # some
    python benchmark/rivals.py --table                          # the table of what is there

CleanRL's package needs a Python older than 3.11. Download cleanrl/ppo_continuous_action.py from its
repository (commit fe8d8a0) and put the absolute path of its folder on PYTHONPATH.

Each run is a process of its own. Its clock starts with the process: imports and compilation count.
The clock stops while a policy is judged. Every minute the mean action is judged in 120 trials of
the full task, with the normalization of observations that the training has reached. If an update
takes longer, the judge waits for its end. A finished run adds its rows to benchmark/rivals.csv and
is not run again. A killed run leaves no rows.

Each rival has two settings. The settings `published` were made for other tasks:

- SB3 PPO, sbx PPO, SAC, TQC: rl-baselines3-zoo's settings for PyBullet's HalfCheetah. PPO has 16
  environments, SAC and TQC have one. sbx PPO has no gSDE.
- sbx SAC: the example of sbx's README, the zoo's HalfCheetah with train_freq 4, gradient_steps 4.
- rsl-rl PPO, skrl PPO: Isaac Lab's settings for lifting a cube, with 64 environments, not 4096.
- CleanRL PPO: the defaults of its file, with one environment.

`ours` is one try of ours, chosen before any result. It has the cranes and the reward scale of
mppo_beta_crane.py. Starts get harder in the first 0.4 of the time, and some repeat a failure. But
the first episode of each crane has the full task. CleanRL's file scales the reward itself, and its
learning rate falls over a million decisions.

mppo_beta_crane.py runs with its defaults, and its time includes its start. Its schedules end after
1,024,000 decisions, in 8 to 20 minutes on two cores. A run that needs longer is cut off. It saves a
policy every 10 updates, so the judge sees a policy that is a little older than the clock says.
"""

import csv
import importlib
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

sys.path.insert(0, str(Path(__file__).parent.parent))

import gymnasium
import numpy as np
import torch
import tyro
from gymnasium.vector import AutoresetMode
from torch import nn

import crane_options
import crane_runs
import crane_trials
from crane_options import Range, Seed

ROOT = Path(__file__).parent.parent
RESULTS = Path(__file__).parent / "rivals.csv"
COLUMNS = ["rival", "setting", "seed", "budget", "minutes", "decisions", "success", "gentle"]
TASK, TRIALS, EVAL_SEED = "ForestryCrane-v0", 20, 10_000  # trials per log diameter
EVERY = 60.0  # s between two judgements
ENDLESS = 10**9  # decisions or updates: the clock ends the training
STARTED = "RIVALS_STARTED"  # environment variable of a run: time.time() before its process

# ---- settings


@dataclass(frozen=True)
class Setting:
    options: dict[str, Any]  # the library's own
    cranes: int = 64
    normalize: dict[str, Any] | None = None  # options of SB3's VecNormalize
    falling: bool = False  # the learning rate falls linearly to 0
    like_mppo: bool = False  # easy starts first, retries, scaled reward


ZOO_PPO = dict(
    n_steps=512, batch_size=128, n_epochs=20, learning_rate=3e-5, gamma=0.99, gae_lambda=0.9,
    clip_range=0.4, policy_kwargs=dict(
        log_std_init=-2, ortho_init=False, activation_fn=nn.ReLU, net_arch=[256, 256]
    ),
)  # fmt: skip
ZOO_SAC = dict(
    learning_rate=7.3e-4, buffer_size=300_000, gamma=0.98, tau=0.02, train_freq=8, gradient_steps=8,
    learning_starts=10_000, use_sde=True, policy_kwargs=dict(log_std_init=-3, net_arch=[400, 300]),
)  # fmt: skip
SBX_SAC = dict(learning_starts=10_000, train_freq=4, gradient_steps=4)
ZOO_NORMALIZE, ONLY_OBS = dict(norm_reward=True, gamma=0.99), dict(norm_reward=False)
OUR_PPO = dict(
    n_steps=64, batch_size=1024, n_epochs=8, learning_rate=1e-3, gamma=0.97,
    policy_kwargs=dict(log_std_init=-1.2, net_arch=[256, 256]),
)  # fmt: skip
# With 32 cranes this is one gradient step for four decisions: more would leave few decisions. An
# entropy weight that starts at 1 would outweigh the scaled reward.
OUR_SAC = dict(
    learning_rate=1e-3, buffer_size=500_000, gamma=0.97, tau=0.01, gradient_steps=8,
    learning_starts=5000, ent_coef="auto_0.1", policy_kwargs=dict(net_arch=[256, 256]),
)  # fmt: skip
# net, std and steps are not rsl-rl's or skrl's names: their training functions explain them
RSL_RL = dict(
    net=dict(hidden_dims=[256, 128, 64], activation="elu"), std=1.0, steps=24,
    learning_rate=1e-4, num_learning_epochs=5, gamma=0.98, entropy_coef=0.006, desired_kl=0.01,
)  # fmt: skip
OUR_RSL_RL = dict(
    net=dict(hidden_dims=[256, 256], activation="tanh", obs_normalization=True), std=0.3, steps=64,
    learning_rate=1e-3, num_learning_epochs=8, gamma=0.97, entropy_coef=0.0, desired_kl=0.02,
)  # fmt: skip
SKRL = dict(
    net=dict(layers=[256, 128, 64], activations="elu"), std=1.0, rollouts=24,
    learning_rate=1e-4, learning_rate_scheduler_kwargs=dict(kl_threshold=0.01), grad_norm_clip=1.0,
    entropy_loss_scale=0.001, value_loss_scale=2.0, rewards_shaper_scale=0.01,
)  # fmt: skip
OUR_SKRL = dict(
    net=dict(layers=[256, 256], activations="tanh"), std=0.3, rollouts=64,
    learning_rate=1e-3, learning_rate_scheduler_kwargs=dict(kl_threshold=0.02),
    discount_factor=0.97, time_limit_bootstrap=True,
)  # fmt: skip
# the file has no arguments for the networks (2 x 64) and the policy's first std (1)
OUR_CLEANRL = dict(
    num_steps=64, num_minibatches=4, update_epochs=8, learning_rate=1e-3, gamma=0.97,
    target_kl=0.04,
)  # fmt: skip

# ---- the clock


class TimeUp(Exception):
    """The minutes are over."""


@dataclass
class Clock:
    """Wall-clock time since the process was started, without the time for judging.

    A training function sets act: mean actions (N, 6) for raw observations (N, 18).
    """

    started: float  # as of time.time()
    limit: float  # s
    threads: int
    act: Callable[[np.ndarray], np.ndarray] | None = None
    judging: float = 0.0  # s, so far
    next_judgement: float = EVERY  # s
    decisions: int = 0
    rows: list[list] = field(default_factory=list)

    def seconds(self) -> float:
        return time.time() - self.started - self.judging

    def share(self) -> float:
        return min(1.0, self.seconds() / self.limit)

    def predict(self, obs: np.ndarray, state: None = None, deterministic: bool = True) -> tuple:
        """As `crane_trials.run_trials` wants it."""
        return self.act(obs), None

    def judge(self, minutes: float, decisions: int) -> None:
        """Add a row: minutes, decisions, success and gentle success in %."""
        start = time.time()
        scores = crane_trials.evaluate(self, TASK, TRIALS, EVAL_SEED, self.threads)
        rates = (round(100 * scores[name], 1) for name in ("success_rate", "gentle_rate"))
        self.rows.append([round(minutes, 2), decisions, *rates])
        print(*self.rows[-1], flush=True)
        self.judging += time.time() - start

    def tick(self) -> None:
        """Judge if it is time to. TimeUp ends the training."""
        seconds = self.seconds()
        if seconds >= min(self.next_judgement, self.limit):
            self.judge(seconds / 60, self.decisions)
            self.next_judgement = EVERY * (seconds // EVERY + 1)
        if seconds >= self.limit:
            raise TimeUp


class TimedCranes(gymnasium.vector.VectorWrapper):
    """Cranes that look at the clock before each decision, whatever library makes it.

    seed: of the first reset, if the library gives none.
    """

    def __init__(self, setting: Setting, clock: Clock, seed: int | None = None):
        self.clock, self.like_mppo, self.seed = clock, setting.like_mppo, seed
        options = {"env_threads": clock.threads, "retry": 0.5 if self.like_mppo else 0.0}
        super().__init__(gymnasium.make_vec(TASK, setting.cranes, **options))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        given, self.seed = self.seed if seed is None else seed, None
        return self.env.reset(seed=given, options=options)

    def step(self, actions: np.ndarray) -> tuple:
        self.clock.tick()
        if self.like_mppo:
            self.unwrapped.difficulty = min(1.0, self.clock.share() / 0.4)
        obs, reward, *rest = self.env.step(actions)
        self.clock.decisions += self.num_envs
        return obs, reward * (0.06 if self.like_mppo else 1.0), *rest


# ---- one training function per library


def train_sb3(algorithm: str, setting: Setting, seed: int, clock: Clock) -> None:
    """algorithm: module and class, of Stable-Baselines3, sb3-contrib or sbx."""
    from stable_baselines3.common.vec_env import VecNormalize

    from sb3_crane import CraneVecEnv

    (module, name), options = algorithm.split(":"), deepcopy(setting.options)
    if setting.falling:
        start = options["learning_rate"]
        options["learning_rate"] = lambda _: start * (1 - clock.share())
    if module == "sbx" and "activation_fn" in options.get("policy_kwargs", {}):
        options["policy_kwargs"]["activation_fn"] = importlib.import_module("jax").nn.relu
    envs = CraneVecEnv(setting.cranes, env_threads=1)
    envs.envs = TimedCranes(setting, clock)
    envs = VecNormalize(envs, **setting.normalize or dict(norm_obs=False, norm_reward=False))
    maker = getattr(importlib.import_module(module), name)
    model = maker("MlpPolicy", envs, seed=seed, device="cpu", **options)
    clock.act = lambda obs: model.predict(envs.normalize_obs(obs), deterministic=True)[0]
    model.learn(ENDLESS)


def train_rsl_rl(_: str, setting: Setting, seed: int, clock: Clock) -> None:
    """net: of actor and critic; std: of the actions at the start; steps: of a rollout."""
    from rsl_rl.env import VecEnv
    from rsl_rl.runners import OnPolicyRunner
    from tensordict import TensorDict

    def to_dict(obs: np.ndarray) -> TensorDict:
        return TensorDict({"policy": torch.as_tensor(obs)}, [len(obs)])

    class Cranes(VecEnv):
        num_envs, num_actions, device, cfg = setting.cranes, 6, "cpu", {}

        def get_observations(self) -> TensorDict:
            return to_dict(envs.reset(seed=seed)[0])  # asked for only before the first step

        def step(self, actions: torch.Tensor) -> tuple:
            obs, reward, terminated, truncated, _ = envs.step(actions.numpy())
            reward, done = torch.as_tensor(reward).float(), torch.as_tensor(terminated | truncated)
            return to_dict(obs), reward, done, {"time_outs": torch.as_tensor(truncated)}

    torch.manual_seed(seed)
    envs, options = TimedCranes(setting, clock), deepcopy(setting.options)
    net = {"class_name": "MLPModel", **options.pop("net")}
    gaussian = {"class_name": "GaussianDistribution", "init_std": options.pop("std")}
    config = {"num_steps_per_env": options.pop("steps"), "save_interval": ENDLESS}
    config |= {"obs_groups": {"actor": ["policy"], "critic": ["policy"]}, "critic": net}
    config |= {"actor": {**net, "distribution_cfg": gaussian}}
    runner = OnPolicyRunner(Cranes(), config | {"algorithm": {"class_name": "PPO", **options}})
    policy = runner.alg.get_policy()  # it normalizes the observations itself
    clock.act = lambda obs: policy(to_dict(obs)).detach().numpy()
    runner.learn(ENDLESS)


def train_skrl(_: str, setting: Setting, seed: int, clock: Clock) -> None:
    """net: of actor and critic, which share it, as published; std: of the actions at the start."""
    import skrl
    from skrl.envs.wrappers.torch import wrap_env
    from skrl.utils.runner.torch import Runner

    skrl.config.torch.device, skrl.config.torch.key = "cpu", seed
    envs = wrap_env(TimedCranes(setting, clock, seed), wrapper="gymnasium", verbose=False)
    options = deepcopy(setting.options)
    log_std = float(np.log(options.pop("std")))
    net = [{"name": "net", "input": "OBSERVATIONS", **options.pop("net")}]
    policy = {"class": "GaussianMixin", "initial_log_std": log_std, "output": "ACTIONS"}
    value = {"class": "DeterministicMixin", "network": net, "output": "ONE"}
    for name in ("observation_preprocessor", "value_preprocessor"):
        options |= {name: "RunningStandardScaler", f"{name}_kwargs": None}
    options |= {"class": "PPO", "mini_batches": 4, "learning_rate_scheduler": "KLAdaptiveLR"}
    options["experiment"] = {"write_interval": 0, "checkpoint_interval": 0}
    trainer = {"class": "SequentialTrainer", "timesteps": ENDLESS, "headless": True}
    config = {"seed": seed, "agent": options, "trainer": trainer | {"disable_progressbar": True}}
    config |= {"memory": {"class": "RandomMemory", "memory_size": -1}}
    config |= {"models": {"separate": False, "policy": policy | {"network": net}, "value": value}}
    runner = Runner(envs, config)
    agent = runner.agent

    @torch.no_grad()
    def act(obs: np.ndarray) -> np.ndarray:
        given = {"observations": agent._observation_preprocessor(torch.as_tensor(obs))}
        actions = agent.policy.act(given, role="policy")[1]["mean_actions"]
        agent.value.act(given, role="value")  # takes what the shared network keeps for the critic
        return actions.numpy()

    clock.act = act
    runner.trainer.train()


def train_cleanrl(_: str, setting: Setting, seed: int, clock: Clock) -> None:
    """CleanRL's file is not edited. The vector of environments that it gets looks at the clock.

    The file is written for Gymnasium 0.29. Here Gymnasium 1 resets a crane in the step that ends
    its episode, as 0.29 did. `info` is left empty, because the file expects the one of 0.29. A
    transformed observation keeps its space, which the file does not give.
    """
    make_vector, task = gymnasium.vector.SyncVectorEnv, TASK
    transform = gymnasium.wrappers.TransformObservation
    if setting.like_mppo:
        task, retry = "RetryCrane-v0", {"retry": 0.5}
        gymnasium.register(task, entry_point="crane_env:CraneEnv", kwargs=retry)

    class Cranes(gymnasium.vector.VectorWrapper):
        def __init__(self, makers: list, **_):
            super().__init__(make_vector(makers, autoreset_mode=AutoresetMode.SAME_STEP))

        def step(self, actions: np.ndarray) -> tuple:
            clock.tick()
            if setting.like_mppo:
                self.env.set_attr("difficulty", min(1.0, clock.share() / 0.4))
            clock.decisions += self.num_envs
            return *self.env.step(actions)[:4], {}

    file = Path(find_spec("ppo_continuous_action").origin)
    program = {"__name__": "__main__", "__file__": str(file)}

    @torch.no_grad()
    def act(obs: np.ndarray) -> np.ndarray:
        seen = [env.get_wrapper_attr("obs_rms") for env in program["envs"].env.envs]
        mean, var = (np.mean([getattr(s, name) for s in seen], axis=0) for name in ("mean", "var"))
        obs = torch.as_tensor(np.clip((obs - mean) / np.sqrt(var + 1e-8), -10, 10))
        return program["agent"].actor_mean(obs.float()).clamp(-1, 1).numpy()

    clock.act = act
    gymnasium.vector.SyncVectorEnv = Cranes
    gymnasium.wrappers.TransformObservation = lambda env, function: transform(
        env, function, env.observation_space
    )
    sys.argv = [str(file), "--env-id", task, "--seed", str(seed), "--no-cuda"]
    for name, value in {"num_envs": setting.cranes, **setting.options}.items():
        sys.argv += [f"--{name}", str(value)]
    exec(compile(file.read_text(), file, "exec"), program)  # act needs the program's variables
    clock.judge(clock.seconds() / 60, clock.decisions)  # it ends after a million decisions


def train_mppo(_: str, setting: Setting, seed: int, clock: Clock) -> None:
    """mppo_beta_crane.py in a process of its own. Copies of its policy are judged afterwards."""
    command = [sys.executable, str(ROOT / "mppo_beta_crane.py"), "--seed", str(seed)]
    command += ["--torch-threads", str(clock.threads), "--env-threads", str(clock.threads)]
    command += ["--eval-every", "0", "--final-trials", "0"]
    start, copies, quiet = time.time(), [], {"stdout": subprocess.DEVNULL}
    with subprocess.Popen(command, **quiet, stderr=subprocess.DEVNULL) as process:
        for due in [*np.arange(EVERY, clock.limit, EVERY), clock.limit]:
            while process.poll() is None and time.time() - start < due:
                time.sleep(0.1)
            minutes = (time.time() - start) / 60
            copies += [(minutes, path.read_bytes()) for path in Path().glob("runs/*/policy.pt")]
            if process.poll() is not None:
                break
        process.kill()
    if process.returncode > 0:
        raise SystemExit("mppo_beta_crane.py failed; run it alone to see why")
    if not copies:
        raise SystemExit("mppo_beta_crane.py has saved no policy in this time; give more --minutes")
    import crane_policies

    for minutes, contents in copies:
        Path("policy.pt").write_bytes(contents)
        agent = crane_policies.load_policy(Path("policy.pt"))[0]
        clock.act = lambda obs, agent=agent: agent.predict(obs)[0]
        clock.judge(minutes, torch.load("policy.pt", weights_only=True)["global_step"])


# ---- all of them


SDE, ALL_STEPS = dict(use_sde=True, sde_sample_freq=4), dict(train_freq=64, gradient_steps=64)
PUBLISHED = {
    "mppo_beta": Setting({}),
    "sb3_ppo": Setting(ZOO_PPO | SDE, cranes=16, normalize=ZOO_NORMALIZE),
    "sac": Setting(ZOO_SAC, cranes=1),
    "tqc": Setting(ZOO_SAC | ALL_STEPS, cranes=1),
    "sbx_ppo": Setting(ZOO_PPO, cranes=16, normalize=ZOO_NORMALIZE),
    "sbx_sac": Setting(SBX_SAC, cranes=1),
    "rsl_rl_ppo": Setting(RSL_RL),
    "skrl_ppo": Setting(SKRL),
    "cleanrl_ppo": Setting({}, cranes=1),
}
LIKE_MPPO = dict(normalize=ONLY_OBS, like_mppo=True)
OFF_POLICY = Setting(OUR_SAC, cranes=32, **LIKE_MPPO)
OURS = {
    "sb3_ppo": Setting(OUR_PPO | dict(target_kl=0.04), falling=True, **LIKE_MPPO),
    "sac": OFF_POLICY,
    "tqc": OFF_POLICY,
    "sbx_ppo": Setting(OUR_PPO, falling=True, **LIKE_MPPO),  # its target_kl sets the learning rate
    "sbx_sac": OFF_POLICY,
    "rsl_rl_ppo": Setting(OUR_RSL_RL, like_mppo=True),
    "skrl_ppo": Setting(OUR_SKRL, like_mppo=True),
    "cleanrl_ppo": Setting(OUR_CLEANRL, like_mppo=True),
}
SETTINGS = {"published": PUBLISHED, "ours": OURS}
RIVALS = {  # how to train, and the package that it needs, with the class
    "mppo_beta": (train_mppo, "torch"),
    "sb3_ppo": (train_sb3, "stable_baselines3:PPO"),
    "sac": (train_sb3, "stable_baselines3:SAC"),
    "tqc": (train_sb3, "sb3_contrib:TQC"),
    "sbx_ppo": (train_sb3, "sbx:PPO"),
    "sbx_sac": (train_sb3, "sbx:SAC"),
    "rsl_rl_ppo": (train_rsl_rl, "rsl_rl"),
    "skrl_ppo": (train_skrl, "skrl"),
    "cleanrl_ppo": (train_cleanrl, "ppo_continuous_action"),
}


@dataclass
class Args:
    rivals: tuple[Literal[*RIVALS], ...] = tuple(RIVALS)
    """who runs"""
    settings: tuple[Literal["published", "ours"], ...] = ("published", "ours")
    """published: of its makers; ours: one try of ours; mppo_beta has only the first"""
    seeds: tuple[Seed, ...] = (1, 2, 3)
    """one run each"""
    minutes: Annotated[float, Range(0.1, 1000)] = 10.0
    """wall-clock time of a run"""
    threads: Annotated[int, Range(1, 256)] = 2
    """cores of a run, and threads of the physics and of torch"""
    results: Path = RESULTS
    """CSV file that gets the rows of finished runs; use another file for other --threads"""
    table: bool = False
    """only print the table of the runs of --minutes in this file"""

    def __post_init__(self) -> None:
        crane_options.check(vars(self), Args)


def run_here(args: Args) -> None:
    """The one run that this process was started for."""
    (name,), (setting,), (seed,) = args.rivals, args.settings, args.seeds
    torch.set_num_threads(args.threads)
    clock = Clock(float(os.environ[STARTED]), 60 * args.minutes, args.threads)
    train, algorithm = RIVALS[name]
    try:
        train(algorithm, SETTINGS[setting][name], seed, clock)
    except TimeUp:
        pass
    with open(args.results, "a", newline="") as file:  # one write, when all is done
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([name, setting, seed, args.minutes, *row] for row in clock.rows)


def run_all(args: Args) -> None:
    """The runs that have no rows yet, one process after the other."""
    with open(args.results, newline="") as file:
        done = {tuple(row[name] for name in COLUMNS[:4]) for row in csv.DictReader(file)}
    if hasattr(os, "sched_setaffinity"):  # jax takes all cores that it finds
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: args.threads])
    packages = {name: RIVALS[name][1].partition(":")[0] for name in args.rivals}
    missing = {name for name, package in packages.items() if find_spec(package) is None}
    for name in sorted(missing):
        mend = "pip install -r benchmark/rivals-requirements.txt torch=="
        mend += torch.__version__.partition("+")[0]  # so that pip keeps this torch
        if name == "cleanrl_ppo":
            mend = "download CleanRL's file; put the absolute path of its folder on PYTHONPATH"
        print(f"{name} needs {packages[name]}, which is missing: {mend}", flush=True)
    common = ["--minutes", str(args.minutes), "--threads", str(args.threads)]
    common += ["--results", str(args.results.resolve())]
    for seed, name, setting in product(args.seeds, args.rivals, args.settings):
        run = name, setting, str(seed), str(args.minutes)
        if run in done or name in missing or name not in SETTINGS[setting]:
            continue
        print(*run, flush=True)
        command = [sys.executable, __file__, "--rivals", name, "--settings", setting]
        extra = {"OMP_NUM_THREADS": str(args.threads), "JAX_PLATFORMS": "cpu"}
        extra["GOMP_SPINCOUNT"] = "5000"  # as our scripts have it
        extra["CUDA_VISIBLE_DEVICES"] = ""  # skrl would put a part of its networks on a GPU
        with tempfile.TemporaryDirectory() as folder:  # for what they write
            extra[STARTED] = str(time.time())
            words = [*command, "--seeds", str(seed), *common]
            if subprocess.run(words, cwd=folder, env=os.environ | extra).returncode:
                print(f"{name} failed", flush=True)


def results_table(path: Path, budget: float) -> str:
    """Success in %, mean over the seeds, after fifths of the time; the extremes at the end.

    The best comes first.
    """
    runs = defaultdict(lambda: defaultdict(list))
    delay = EVERY / 120  # min, how late a judgement may be, because an update took long
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            if float(row["budget"]) == budget and float(row["minutes"]) <= budget + delay:
                runs[row["rival"], row["setting"]][row["seed"]].append(row)
    times = [budget * fifth / 5 for fifth in range(1, 6)]
    head = ["method", "settings", "seeds", "decisions", *(f"{t:.3g} min" for t in times)]
    head += ["lowest", "highest", "gentle"]
    table = [head, ["--"] * len(head)]
    ends = {run: np.mean([float(r[-1]["success"]) for r in runs[run].values()]) for run in runs}
    for rival, setting in sorted(runs, key=ends.get, reverse=True):
        seeds = runs[rival, setting]
        cells, last = [rival, setting, str(len(seeds))], [rows[-1] for rows in seeds.values()]
        cells.append(f"{np.mean([int(row['decisions']) for row in last]):,.0f}")
        for t in times:
            past = [
                [r for r in rows if float(r["minutes"]) <= t + delay] for rows in seeds.values()
            ]
            scores = [float(rows[-1]["success"]) if rows else 0.0 for rows in past]
            cells.append(f"{np.mean(scores):.1f}")
        gentle = np.mean([float(row["gentle"]) for row in last])
        cells += [str(min(scores)), str(max(scores)), f"{gentle:.1f}"]
        table.append(cells)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in table)


def main() -> None:
    crane_runs.one_line_errors()
    args = tyro.cli(Args, description=__doc__)
    if STARTED in os.environ:
        run_here(args)
        return
    if not args.results.parent.is_dir():
        raise SystemExit(f"--results: no folder {args.results.parent}; make it first")
    if not args.results.exists():
        args.results.write_text(",".join(COLUMNS) + "\n")
    if not args.table:
        run_all(args)
    print(results_table(args.results, args.minutes))


if __name__ == "__main__":
    main()
