"""PPO: proximal policy optimisation with a Gaussian policy, on the crane.

The paper's first baseline (Vu et al., Sec. IV-B), after Schulman et al., 2017:

- a ~ N(mu(s), sigma^2) with a standard deviation that does not depend on the state; the policy
  knows no limits, the environment gets the action clipped to them;
- its mean mu(s) acts when the policy is evaluated.

With generalised advantage estimation:

    delta_t = r_t + gamma V(s_{t+1}) - V(s_t)      V(s_{t+1}) is 0 where an episode terminated and
    A_t     = delta_t + gamma lambda A_{t+1}       V(final_obs) where the time limit cut it;
                                                   A_{t+1} is 0 where an episode ended
    L       = -E[min(rho A, clip(rho, 1 - c, 1 + c) A)] + c_v E[(V - R)^2] - c_e E[H]
    rho     = pi(a | s) / pi_old(a | s),  R = A + V_old

Three things change along a run (why: benchmark/README.md). Exploration narrows by itself, for noise
in joint speeds shakes the hanging grapple. The horizon 1 / (1 - gamma) grows, for a short one soon
learns to lift and a long one takes time over its grip. The step size falls to 0.

    python ppo_crane.py                      # the forestry crane, minutes on two cores
    python ppo_crane.py --env-id HalfCheetah-v5 --num-envs 8 --gamma 0.99 --horizon-growth 1
    python ppo_crane.py --resume runs/<run>
"""

import os
import signal
import sys
import time
from collections import deque
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

# Waiting threads look 5,000 times, then sleep: fast alone, and two runs at once do not stall.
os.environ.setdefault("GOMP_SPINCOUNT", "5000")

import gymnasium
import numpy as np
import torch
import tyro
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torch import Tensor, nn
from torch.distributions import Normal
from torch.utils.tensorboard import SummaryWriter
from tqdm import trange

import crane_env

ALGORITHM = "ppo"
MACHINE_ARGS = ("resume", "device", "torch_threads", "env_threads")  # not taken from a checkpoint


@dataclass
class Args:
    # --- experiment
    exp_name: str = "ppo_crane"  # name of the run's folder
    seed: int = 1  # seed of network, policy samples and episodes
    total_timesteps: int = 1_024_000  # decisions to train for, over all cranes, in whole rollouts
    device: Literal["cpu", "cuda"] = "cpu"  # where the networks live
    torch_threads: int = 2  # CPU threads of an update; results are the same for equal numbers
    resume: str | None = None  # run's folder to go on in; it sets all but device and threads
    paper: bool = False  # take the paper's protocol (days of training) as defaults

    # --- environment
    env_id: str = "ForestryCrane-v0"  # or any Gymnasium task with flat Box spaces
    num_envs: int = 64  # cranes simulated side by side
    env_threads: int = 2  # physics threads, 0 for all cores
    frame_skip: int = 20  # physics steps of 5 ms per decision
    contact: Literal["primitive", "sdf"] = "primitive"  # contact model of jaws and log
    reward: Literal["staged", "paper"] = "staged"  # staged, or as printed in the paper
    omega2: float = 1.0  # sharpness of r_distance and r_grapple [1/m]
    speed: Literal["real", "mjcf"] = "real"  # joint speed limits
    offset: Literal["plus", "minus"] = "plus"  # sign of the diameter's part in Delta_p,z
    signed_yaw: bool = True  # observe the signed angle to the log, not the paper's Delta_psi
    axes: Literal["crane", "world"] = "crane"  # of Delta_p; crane: along the boom, to its left, up
    pose_noise: Literal["none", "step", "episode"] = "none"  # error of the observed log pose
    integrator: Literal["implicitfast", "implicit", "discrete", "Euler"] = "implicitfast"
    """MuJoCo integrator"""
    solver: Literal["Newton", "CG"] = "Newton"  # MuJoCo constraint solver
    retry: float = 0.25  # share of episodes that start as a recent failure of that crane did
    curriculum: bool = False  # raise the task's difficulty from 0 to 1 with the success rate

    # --- algorithm
    num_steps: int = 64  # decisions per crane and rollout
    hidden_sizes: tuple[int, ...] = (256, 256)  # width of each hidden layer, of actor and of critic
    normalize_obs: bool = True  # scale observations by their running mean and deviation
    learning_rate: float = 7e-4  # Adam's step size
    anneal_lr: bool = True  # lower the step size linearly to 0
    gamma: float = 0.97  # discount per 0.1 s at the start; other decision rates rescale it
    horizon_growth: float = 3.0  # 1 / (1 - gamma) grows by this factor along the run; 1: it stays
    gae_lambda: float = 0.95  # lambda of the advantage estimate, per 0.1 s
    bootstrap: bool = True  # count V(final_obs) where the time limit cuts an episode; off: 0
    reward_scale: float = 0.06  # factor on the reward, per 0.1 s; falls as the horizon grows
    minibatch_size: int = 1024  # decisions per gradient step
    update_epochs: int = 8  # passes over each rollout
    clip_coef: float = 0.2  # c, bound of the ratio's change
    target_kl: float | None = 0.04  # an update ends with the epoch whose mean KL passes this
    ent_coef: float = 0.0  # c_e, weight of the entropy
    vf_coef: float = 0.5  # c_v, weight of the value loss
    max_grad_norm: float = 0.5  # bound of the gradient's norm
    log_std_init: float = -1.2  # log sigma at the start [action units]
    narrowing: float = 1.25  # by which it sinks along the run, whatever is learned; 0: it does not

    # --- reports
    eval_every: int = 50  # updates between two deterministic evaluations, 0 for none
    eval_trials: int = 20  # trials per log diameter in each (other tasks: episodes)
    final_trials: int = 100  # trials per log diameter after training, 0 for none
    eval_seed: int = 10_000  # seed of all evaluation trials


LEAST = {  # the smallest values of arguments that have one
    0: "seed env_threads learning_rate eval_every final_trials eval_seed reward_scale omega2 "
    "max_grad_norm vf_coef clip_coef",
    1: "total_timesteps torch_threads num_envs frame_skip num_steps hidden_sizes horizon_growth "
    "minibatch_size update_epochs eval_trials",
}

# What the paper states (Sec. IV); what it leaves open is guessed and named when it runs.
PAPER = """
--paper --total-timesteps 500_000_000 --num-envs 42 --frame-skip 1 --contact sdf --reward paper
--offset minus --no-signed-yaw --axes world --retry 0 --integrator implicit --solver CG
--num-steps 1000 --hidden-sizes 256 256 256 256 --learning-rate 3e-4 --no-anneal-lr --gamma 0.99
--horizon-growth 1 --reward-scale 0.02 --log-std-init -0.5 --narrowing 0 --minibatch-size 2000
--update-epochs 30 --target-kl None
"""
PAPER_GUESSES = """Paper's protocol. Unpublished, so guessed (their values: --help --paper): gamma,
lambda, clip range, minibatch size, reward scale, weights of value loss and entropy, gradient bound,
tanh units, no annealing, normalised observations and advantages, sigma at the start,
omega 1-3 = 1, z_l,d = 1 m, speed limits "real", start of an episode, its length (9 s, not 15 s)."""


def layer_init(layer: nn.Linear, std: float = np.sqrt(2)) -> nn.Linear:
    nn.init.orthogonal_(layer.weight, std)
    nn.init.zeros_(layer.bias)
    return layer


class Agent(nn.Module):
    """Actor, critic and the observation normaliser, all in one state_dict."""

    def __init__(self, obs_dim: int, action_low: np.ndarray, action_high: np.ndarray, args: Args):
        super().__init__()
        act_dim = len(action_low)
        self.actor = self._network(obs_dim, args.hidden_sizes, act_dim, std=0.01)
        self.log_std = nn.Parameter(torch.full((act_dim,), args.log_std_init))
        self.critic = self._network(obs_dim, args.hidden_sizes, 1, std=1.0)
        self.register_buffer("action_low", torch.as_tensor(action_low, dtype=torch.float32))
        self.register_buffer("action_high", torch.as_tensor(action_high, dtype=torch.float32))
        self.register_buffer("obs_mean", torch.zeros(obs_dim, dtype=torch.float64))
        self.register_buffer("obs_var", torch.ones(obs_dim, dtype=torch.float64))
        self.register_buffer("obs_count", torch.tensor(1e-4, dtype=torch.float64))

    @staticmethod
    def _network(inputs: int, hidden_sizes: tuple[int, ...], outputs: int, std: float) -> nn.Module:
        layers: list[nn.Module] = []
        for width in hidden_sizes:
            layers += [layer_init(nn.Linear(inputs, width)), nn.Tanh()]
            inputs = width
        return nn.Sequential(*layers, layer_init(nn.Linear(inputs, outputs), std))

    def update_normalizer(self, obs: Tensor) -> None:
        """Merge the mean and variance of obs (N, obs_dim) into the running ones (Chan et al.)."""
        obs = obs.double()
        count = self.obs_count + len(obs)
        delta = obs.mean(0) - self.obs_mean
        spread = self.obs_var * self.obs_count + obs.var(0, unbiased=False) * len(obs)
        self.obs_var.copy_((spread + delta**2 * self.obs_count * len(obs) / count) / count)
        self.obs_mean.add_(delta * len(obs) / count)
        self.obs_count.copy_(count)

    def normalize(self, obs: Tensor) -> Tensor:
        """(obs - mean) / std within +-10, what the networks take; `predict` takes raw ones."""
        scaled = (obs - self.obs_mean.float()) / torch.sqrt(self.obs_var.float() + 1e-8)
        return scaled.clamp(-10, 10)

    def get_value(self, obs: Tensor) -> Tensor:
        """V(s), (B,)."""
        return self.critic(obs).squeeze(-1)

    def get_distribution(self, obs: Tensor) -> Normal:
        """Gaussian over actions, batch shape (B, act_dim), before clipping to the limits."""
        mean = self.actor(obs)
        return Normal(mean, self.log_std.exp().expand_as(mean), validate_args=False)

    def predict(self, obs: Tensor, deterministic: bool = True) -> Tensor:
        """Actions (B, act_dim) in the environment's units."""
        distribution = self.get_distribution(self.normalize(obs))
        return self.to_env(distribution.mean if deterministic else distribution.sample())

    def to_env(self, actions: Tensor) -> Tensor:
        return torch.clamp(actions, self.action_low, self.action_high)


def compute_gae(
    rewards: Tensor, values: Tensor, last_value: Tensor, dones: Tensor, gamma: float, lam: float
) -> Tensor:
    """Advantages (T, N) from rewards, values and episode ends (T, N), and what follows them (N,).

    Nothing follows an end; gamma V(final_obs) of one by the time limit is part of its reward.
    """
    next_values = torch.cat([values[1:], last_value[None]]) * (1 - dones)
    advantages = torch.zeros_like(rewards)
    last = torch.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        delta = rewards[t] + gamma * next_values[t] - values[t]
        last = delta + gamma * lam * (1 - dones[t]) * last
        advantages[t] = last
    return advantages


def crane_kwargs(args: Args) -> dict:
    """The crane environment's arguments among args."""
    names = ["frame_skip", "contact", "reward", "omega2", "speed", "offset", "signed_yaw"]
    names += ["axes", "pose_noise", "integrator", "solver", "env_threads"]
    return {name: getattr(args, name) for name in names}


def is_crane(args: Args) -> bool:
    return args.env_id.startswith("ForestryCrane")


def make_envs(args: Args, num_envs: int, **kwargs) -> gymnasium.vector.VectorEnv:
    if is_crane(args):
        return gymnasium.make_vec(args.env_id, num_envs, **crane_kwargs(args), **kwargs)
    autoreset = {"autoreset_mode": AutoresetMode.SAME_STEP}
    return gymnasium.make_vec(args.env_id, num_envs, "sync", vector_kwargs=autoreset)


def evaluate(agent: Agent, args: Args, trials: int) -> dict[str, float]:
    """Mean return, and for the crane success rates, of the mean action; trials per log diameter."""
    if is_crane(args):
        diameters, seeds = crane_env.monte_carlo_trials(args.eval_seed, trials)
        envs = make_envs(args, len(seeds), diameter=diameters)
        obs, _ = envs.reset(seed=seeds)
    else:
        envs = make_envs(args, trials)
        obs, _ = envs.reset(seed=args.eval_seed)
    returns, success = np.zeros(len(obs)), np.zeros(len(obs), bool)
    ended = np.zeros(len(obs), bool)
    while not ended.all():
        with torch.no_grad():
            actions = agent.predict(torch.as_tensor(obs, dtype=torch.float32, device=args.device))
        obs, reward, terminated, truncated, info = envs.step(actions.cpu().numpy())
        returns += np.where(ended, 0, reward)
        if is_crane(args):
            success |= info["success"] & ~ended
        ended |= terminated | truncated
    envs.close()
    result = {"eval/episodic_return": returns.mean()}
    if is_crane(args):
        result["eval/success_rate"] = success.mean()
        for d in np.unique(diameters):
            result[f"eval/success_rate_{d:.1f}m"] = success[diameters == d].mean()
    return result


def save_atomically(contents: dict, path: Path) -> None:
    torch.save(contents, path.with_suffix(".tmp"))
    os.replace(path.with_suffix(".tmp"), path)


if __name__ == "__main__":
    default = tyro.cli(Args, args=PAPER.split()) if "--paper" in sys.argv else Args()
    args = tyro.cli(Args, description=__doc__, default=default)
    checkpoint = None
    if args.resume is not None:
        path = Path(args.resume)
        path = path / "checkpoint.pt" if path.is_dir() else path
        try:
            checkpoint = torch.load(path, map_location="cpu", weights_only=True)
            saved, task = checkpoint["args"], checkpoint["task"]
            ours = checkpoint["algorithm"] == ALGORITHM and "optimizer" in checkpoint
            ours &= task == crane_env.REVISION and saved.keys() == asdict(args).keys()
        except OSError as error:
            raise SystemExit(f"--resume: {error}") from None
        except Exception:  # whatever a file that is no checkpoint may raise
            ours = False
        if not ours:
            raise SystemExit(f"--resume: {path} is no checkpoint.pt of today's {ALGORITHM}")
        args = Args(**saved | {name: getattr(args, name) for name in MACHINE_ARGS})
        print(f"all arguments but {', '.join(MACHINE_ARGS[1:])} are those of {path}")
    elif args.paper:
        print(PAPER_GUESSES)
    for least, names in LEAST.items():
        for name in names.split():
            if not np.all(np.asarray(getattr(args, name)) >= least):
                raise SystemExit(f"--{name.replace('_', '-')} must be at least {least}")
    if not (0 <= args.gamma <= 1 and 0 <= args.gae_lambda <= 1):
        raise SystemExit("--gamma and --gae-lambda must lie in [0, 1]")
    batch_size = args.num_envs * args.num_steps
    num_minibatches = -(-batch_size // args.minibatch_size)
    num_iterations = max(1, args.total_timesteps // batch_size)
    if args.minibatch_size == 1 or batch_size % args.minibatch_size == 1:
        raise SystemExit("--minibatch-size leaves one sample alone, with no standard deviation")
    # gamma, lambda and the reward scale are stated per 0.1 s
    tenths = args.frame_skip / 20 if is_crane(args) else 1.0
    gae_lambda = args.gae_lambda**tenths

    torch.manual_seed(args.seed)
    torch.set_num_threads(args.torch_threads)  # rounding, of the first weights too, depends on it
    device = torch.device(args.device)
    if args.device == "cuda" and not torch.cuda.is_available():
        raise SystemExit("--device cuda: torch finds no GPU here; use --device cpu")

    try:
        envs = make_envs(args, args.num_envs, retry=args.retry)
        envs = RecordEpisodeStatistics(envs, buffer_length=200)  # info["episode"], return_queue
    except (gymnasium.error.Error, ImportError, ValueError) as error:
        raise SystemExit(f"{args.env_id}: {error}") from None
    obs_space, action_space = envs.single_observation_space, envs.single_action_space
    spaces = (obs_space, action_space)
    if not all(isinstance(s, gymnasium.spaces.Box) and len(s.shape) == 1 for s in spaces):
        raise SystemExit(f"--env-id: {args.env_id} has no flat Box observations and actions")
    agent = Agent(obs_space.shape[0], action_space.low, action_space.high, args).to(device)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)

    first_iteration = 1
    difficulty = 0.0 if args.curriculum else 1.0
    if checkpoint is not None:
        agent.load_state_dict(checkpoint["weights"])
        optimizer.load_state_dict(checkpoint["optimizer"])
        first_iteration = checkpoint["iteration"] + 1
        if first_iteration > num_iterations:
            print("all updates of this run are done: only a final evaluation is made again")
        difficulty = checkpoint["difficulty"]
        run_dir = path.parent
    else:
        started = f"{int(time.time())}_{os.getpid()}"
        run_name = f"{args.env_id}__{args.exp_name}__{args.seed}__{started}"
        run_dir = Path("runs") / run_name.replace("/", "-")
    writer = SummaryWriter(run_dir, purge_step=(first_iteration - 1) * batch_size + 1)
    rows = "\n".join(f"|{key}|{value}|" for key, value in asdict(args).items())
    writer.add_text("hyperparameters", "|argument|value|\n|-|-|\n" + rows)

    def save(iteration: int) -> None:
        weights = agent.state_dict()
        policy = {  # acts without the critic
            "algorithm": ALGORITHM,
            "task": crane_env.REVISION,
            "args": asdict(args),
            "weights": {k: v for k, v in weights.items() if not k.startswith("critic.")},
            "global_step": iteration * batch_size,
        }
        writer.flush()
        save_atomically(policy, run_dir / "policy.pt")
        state = {
            "weights": weights,
            "optimizer": optimizer.state_dict(),
            "iteration": iteration,
            "difficulty": difficulty,
        }
        save_atomically(policy | state, run_dir / "checkpoint.pt")

    obs = torch.zeros((args.num_steps, args.num_envs, obs_space.shape[0]), device=device)
    actions = torch.zeros((args.num_steps, args.num_envs, action_space.shape[0]), device=device)
    rewards = torch.zeros((args.num_steps, args.num_envs), device=device)
    dones = torch.zeros((args.num_steps, args.num_envs), device=device)

    if is_crane(args):
        envs.unwrapped.difficulty = difficulty
    # A resumed run meets other episodes and samples than the interrupted run has met.
    reset_seed = int(np.random.SeedSequence((args.seed, first_iteration)).generate_state(1)[0])
    if checkpoint is not None:
        torch.manual_seed(reset_seed)
    next_obs, _ = envs.reset(seed=reset_seed)
    next_obs = torch.as_tensor(next_obs, dtype=torch.float32, device=device)
    recent_success = deque(maxlen=200)
    start_time = time.time()
    stopping = False

    def stop_after_update(*_) -> None:
        """Ctrl-C: end after this update, as in the writer it may break a lock; twice: at once."""
        global stopping
        stopping = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    signal.signal(signal.SIGINT, stop_after_update)
    completed = first_iteration - 1
    progress = trange(first_iteration, num_iterations + 1, initial=completed, total=num_iterations)
    try:
        for iteration in progress:
            # ---- rollout: the actor alone; values and log-probabilities follow in one batch
            rollout_start = time.time()
            torch.set_num_threads(1)  # more only wait for each other in its small batches
            fraction = 1.0 - (iteration - 1.0) / num_iterations
            if args.anneal_lr:
                optimizer.param_groups[0]["lr"] = fraction * args.learning_rate
            # the horizon grows after the first quarter, the reward shrinks alike: V keeps its size
            growth = args.horizon_growth ** max(0.0, 1 - fraction / 0.75)
            gamma = (1 - (1 - args.gamma) / growth) ** tenths
            reward_scale = args.reward_scale * tenths / growth
            ended: dict[str, list] = {"return": [], "length": [], "termination": []}
            terms = {f"r_{name}": 0.0 for name in ("distance", "grapple", "lift", "balance")}
            cut_at, cut_obs = [], []  # (step, crane) and end of episodes cut by the time limit
            for step in range(args.num_steps):
                with torch.no_grad():
                    if args.normalize_obs:
                        agent.update_normalizer(next_obs)
                    # kept as the policy saw it, for the normaliser moves on
                    obs[step] = agent.normalize(next_obs)
                    actions[step] = agent.get_distribution(obs[step]).sample()
                    env_actions = agent.to_env(actions[step]).cpu().numpy()
                next_obs, reward, terminated, truncated, info = envs.step(env_actions)
                next_obs = torch.as_tensor(next_obs, dtype=torch.float32, device=device)
                done = terminated | truncated
                rewards[step] = torch.as_tensor(reward * reward_scale, device=device)
                dones[step] = torch.as_tensor(done, device=device)

                for i in np.flatnonzero(done):
                    if truncated[i] and not terminated[i]:
                        cut_at.append((step, i))
                        last_obs = torch.as_tensor(info["final_obs"][i], dtype=torch.float32)
                        cut_obs.append(agent.normalize(last_obs.to(device)))
                    ended["return"].append(info["episode"]["r"][i])
                    ended["length"].append(info["episode"]["l"][i])
                    if is_crane(args):
                        ended["termination"].append(info["termination"][i])
                        recent_success.append(info["success"][i])
                if is_crane(args):
                    for name in terms:
                        terms[name] += info[name].mean() / args.num_steps
            global_step = iteration * batch_size
            update_start = time.time()

            # ---- advantages
            torch.set_num_threads(args.torch_threads)
            with torch.no_grad():
                b_obs, b_actions = obs.flatten(0, 1), actions.flatten(0, 1)
                values = agent.get_value(b_obs).view_as(rewards)
                b_logprobs = agent.get_distribution(b_obs).log_prob(b_actions).sum(-1)
                last_value = agent.get_value(agent.normalize(next_obs))
                if cut_at and args.bootstrap:
                    cut_values = agent.get_value(torch.stack(cut_obs))
                    rewards[tuple(zip(*cut_at))] += gamma * cut_values
                advantages = compute_gae(rewards, values, last_value, dones, gamma, gae_lambda)
                returns = advantages + values
            b_advantages, b_returns = advantages.flatten(), returns.flatten()

            # ---- update
            stats: dict[str, list[float]] = {}
            for _ in range(args.update_epochs):
                for mb in torch.randperm(batch_size, device=device).split(args.minibatch_size):
                    distribution = agent.get_distribution(b_obs[mb])
                    logratio = distribution.log_prob(b_actions[mb]).sum(-1) - b_logprobs[mb]
                    ratio = logratio.exp()
                    adv = b_advantages[mb]
                    adv = (adv - adv.mean()) / (adv.std() + 1e-8)
                    clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
                    policy_loss = -torch.min(adv * ratio, adv * clipped).mean()
                    value_loss = ((agent.get_value(b_obs[mb]) - b_returns[mb]) ** 2).mean()
                    entropy = distribution.entropy().sum(-1).mean()
                    loss = policy_loss + args.vf_coef * value_loss - args.ent_coef * entropy

                    optimizer.zero_grad()
                    loss.backward()
                    grad_norm = nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
                    optimizer.step()

                    with torch.no_grad():
                        new_stats = {
                            "losses/policy_loss": policy_loss,
                            "losses/value_loss": value_loss,
                            "losses/entropy": entropy,
                            "losses/old_approx_kl": -logratio.mean(),
                            "losses/approx_kl": (ratio - 1 - logratio).mean(),
                            "losses/clipfrac": ((ratio - 1).abs() > args.clip_coef).float().mean(),
                            "losses/grad_norm": grad_norm,
                        }
                    for name, value in new_stats.items():
                        stats.setdefault(name, []).append(value.item())
                epoch_kl = np.mean(stats["losses/approx_kl"][-num_minibatches:])
                if args.target_kl is not None and epoch_kl > args.target_kl:
                    break
            with torch.no_grad():
                stats["policy/std"] = [agent.log_std.exp().mean().item()]
                residual_var = (b_returns - values.flatten()).var()
                stats["losses/explained_variance"] = [(1 - residual_var / b_returns.var()).item()]
                agent.log_std -= args.narrowing / num_iterations
            completed = iteration

            # ---- reports
            now = time.time()
            sps = (iteration - first_iteration + 1) * batch_size / (now - start_time)
            report = {name: np.mean(values) for name, values in stats.items()}
            report["charts/learning_rate"] = optimizer.param_groups[0]["lr"]
            report["charts/gamma"] = gamma
            report["charts/updates"] = iteration
            report["charts/SPS"] = sps
            report["time/rollout"] = update_start - rollout_start
            report["time/update"] = now - update_start
            if ended["return"]:
                report["charts/episodic_return"] = np.mean(ended["return"])
                report["charts/episodic_length"] = np.mean(ended["length"])
            if is_crane(args):
                report["charts/simulation_SPS"] = sps * args.frame_skip
                report["charts/difficulty"] = difficulty
                report |= {f"reward/{name[2:]}": value for name, value in terms.items()}
                if ended["return"]:
                    report["charts/success_rate"] = np.mean(recent_success)
                    for name in crane_env.TERMINATIONS:
                        share = np.mean(np.array(ended["termination"]) == name)
                        report[f"termination/{name}"] = share
                    full = len(recent_success) == recent_success.maxlen
                    if args.curriculum and full and np.mean(recent_success) > 0.5:
                        difficulty = min(1.0, difficulty + 0.05)
                        envs.unwrapped.difficulty = difficulty
                        recent_success.clear()
            for name, value in report.items():
                writer.add_scalar(name, value, global_step)
            recent = {"return": envs.return_queue, "success": recent_success}
            shown = {name: np.mean(values) for name, values in recent.items() if values}
            progress.set_postfix({**shown, "SPS": int(sps)}, refresh=False)
            if args.paper and iteration == first_iteration:
                progress.write(f"estimated hours in all: {args.total_timesteps / sps / 3600:.1f}")
            last = iteration == num_iterations
            if iteration % 10 == 0 or last:
                save(iteration)
            if args.eval_every and (iteration % args.eval_every == 0 or last):
                for name, value in evaluate(agent, args, args.eval_trials).items():
                    writer.add_scalar(name, value, global_step)
            if stopping:
                raise KeyboardInterrupt
        signal.signal(signal.SIGINT, signal.default_int_handler)
        progress.close()
        if args.final_trials:
            for name, value in evaluate(agent, args, args.final_trials).items():
                name = name.replace("eval/", "final/")
                writer.add_scalar(name, value, num_iterations * batch_size)
                print(f"{name}: {value:.3f}")
    except KeyboardInterrupt:
        save(completed)
        progress.close()
        print(f"interrupted; go on with --resume {run_dir}")
        raise SystemExit(130) from None
    writer.close()
    envs.close()
    print(f"policy saved to {run_dir / 'policy.pt'}")
