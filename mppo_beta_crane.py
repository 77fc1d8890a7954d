"""mPPO: proximal policy optimization with a Beta policy and perturbed actions, on the crane.

The paper's own algorithm (Vu et al., Sec. IV-C). It differs from PPO in two points:

- The policy is a_n ~ Beta(alpha(s), beta(s)) with alpha, beta > 1, and a = low + (high - low) a_n:
  no action outside the limits (Chou et al., 2017). An evaluation takes the mean a_n,
  alpha / (alpha + beta).
- In training each sampled action is perturbed, Eq. (robust ppo): a_n <- clip(a_n + g, 0, 1) with
  g ~ U(-eps, eps). Here eps falls to 0 in the first part of the run.

The rest is PPO (Schulman et al., 2017) with generalized advantage estimation:

    delta_t = r_t + gamma V(s_{t+1}) - V(s_t)         A_t = delta_t + gamma lambda A_{t+1}
    rho     = pi(a | s) / pi_old(a | s)               R   = A + V_old
    L       = -E[min(rho A, clip(rho, 1 - c, 1 + c) A)] + c_v E[(V - R)^2] - c_e E[H]
    KL      = E[rho - 1 - log rho]                    stops the epochs (Schulman, 2020)

Where an episode terminates, V(s_{t+1}) and A_{t+1} are 0. Where the time limit cuts an episode,
V(s_{t+1}) is V(final_obs) and A_{t+1} is 0. In L, A has mean 0 and std 1 in each minibatch.
The executed action follows the perturbed policy, but rho and KL use the unperturbed Beta. So the
policy gradient and KL are biased while eps > 0.
Difficulty, policy width, horizon and step size follow schedules (docs/mppo_beta.md).

    python mppo_beta_crane.py  # the crane: minutes on two cores
    python mppo_beta_crane.py --env-id HalfCheetah-v5 --num-envs 8 --minibatch-size 64 \\
        --eval-every 200
"""

import os
import time
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

# OpenMP workers spin briefly before they sleep: low latency, and two runs can share two cores.
os.environ.setdefault("GOMP_SPINCOUNT", "5000")

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Beta

import crane_env
import crane_options
import crane_runs
import crane_trials
from crane_options import Count, Exponent, Factor, Range, Seed, Share, Size, Threads, Times, Width

ALGORITHM = "mppo_beta"
A_MIN = 1e-4  # executed a_n lie in [A_MIN, 1 - A_MIN]: the log-probability is -inf at 0 and 1
LOG_EXCESS_MAX = 5.0  # bound of log(alpha - 1) and log(beta - 1)


@dataclass
class Args:
    # experiment
    exp_name: str = Path(__file__).stem  # part of the run's folder name
    seed: Seed = 1  # seed of the networks, the policy's samples and the episodes
    total_timesteps: Count = 1_024_000  # decisions of all cranes together, in whole rollouts
    device: Literal["cpu", "cuda"] = "cpu"  # where the networks live
    torch_threads: Annotated[int, Range(1, 256)] = 2  # CPU threads of an update
    env_threads: Threads = 2  # CPU threads of the physics, 0 for all cores
    resume: Path | None = None  # run's folder to continue, perhaps with more total_timesteps

    # task
    env_id: str = "ForestryCrane-v0"  # Gymnasium task with flat Box spaces and episodes that end
    num_envs: Size = 64  # cranes simulated side by side
    env: crane_options.Options = field(default_factory=lambda: {"retry": 0.5})
    """options of the crane: those of the task, except retry; (task: x): that of ForestryCrane-v0"""
    warm_up: Share = 0.4  # share of the run in which the crane's difficulty rises to its full value

    # algorithm
    num_steps: Size = 64  # decisions per crane and rollout
    hidden_sizes: tuple[Width, ...] = (256, 256)  # hidden layers of the actor and of the critic
    normalize_obs: bool = True  # scale observations by their running mean and std
    learning_rate: Factor = 1e-3  # Adam's step size at the start
    gamma: Share = 0.97  # discount per 0.1 s at the start
    horizon_growth: Annotated[float, Range(1, 1000)] = 3.0  # 1 / (1 - gamma) grows by this factor
    gae_lambda: Share = 0.95  # lambda of the advantage estimate, per 0.1 s
    reward_scale: Factor = 0.06  # factor on the reward, per 0.1 s; falls as the horizon grows
    minibatch_size: Count = 1024  # decisions per gradient step
    update_epochs: Times = 8  # passes over each rollout
    clip_coef: Factor = 0.2  # c, bound of the ratio's change
    target_kl: Factor | None = 0.04  # stop after the first epoch whose mean KL exceeds this
    ent_coef: Factor = 0.0  # c_e, weight of the entropy
    vf_coef: Factor = 0.5  # c_v, weight of the value loss
    max_grad_norm: Factor = 0.5  # bound of the gradient's norm
    perturbation: Share = 0.1  # eps at the start, half width of the perturbation of a_n
    perturbed: Annotated[float, Range(0.01, 1)] = 0.4  # share of the run in which eps falls to 0
    log_excess_init: Exponent = 1.5  # log(alpha - 1), log(beta - 1) at the start, before the bound
    narrowing: Exponent = 2.5  # rise of the actor's outputs by schedule, before the bound

    # evaluation
    eval_every: Annotated[int, Range(0, 10**10)] = 25  # updates between evaluations, 0 for none
    eval_trials: Times = 20  # trials per log diameter in each evaluation
    final_trials: Annotated[int, Range(0, 1000)] = 100  # the same after the training, 0 for none
    eval_seed: Seed = 10_000  # seed of all trials

    def __post_init__(self) -> None:
        crane_options.check(vars(self), Args)


def layer_init(layer: nn.Linear, std: float = np.sqrt(2)) -> nn.Linear:
    nn.init.orthogonal_(layer.weight, std)
    nn.init.zeros_(layer.bias)
    return layer


def mlp(inputs: int, hidden_sizes: tuple[int, ...], outputs: int, std: float) -> nn.Sequential:
    layers: list[nn.Module] = []
    for width in hidden_sizes:
        layers += [layer_init(nn.Linear(inputs, width)), nn.Tanh()]
        inputs = width
    return nn.Sequential(*layers, layer_init(nn.Linear(inputs, outputs), std))


class Agent(nn.Module):
    """Actor, critic and observation normalizer. The networks take normalized observations."""

    def __init__(self, obs_dim: int, action_low: np.ndarray, action_high: np.ndarray, args: Args):
        super().__init__()
        self.normalize_obs = args.normalize_obs
        self.actor = mlp(obs_dim, args.hidden_sizes, 2 * len(action_low), std=0.01)
        nn.init.constant_(self.actor[-1].bias, args.log_excess_init)
        self.critic = mlp(obs_dim, args.hidden_sizes, 1, std=1.0)
        self.register_buffer("action_low", torch.as_tensor(action_low, dtype=torch.float32))
        self.register_buffer("action_high", torch.as_tensor(action_high, dtype=torch.float32))
        self.register_buffer("obs_mean", torch.zeros(obs_dim, dtype=torch.float64))
        self.register_buffer("obs_var", torch.ones(obs_dim, dtype=torch.float64))
        self.register_buffer("obs_count", torch.tensor(1e-4, dtype=torch.float64))

    def update_normalizer(self, obs: Tensor) -> None:
        """Merge the mean and variance of obs (N, obs_dim) into the running ones (Chan et al.)."""
        obs, new = obs.double(), len(obs)
        count = self.obs_count + new
        delta = obs.mean(0) - self.obs_mean
        spread = self.obs_var * self.obs_count + obs.var(0, unbiased=False) * new
        self.obs_var.copy_((spread + delta**2 * self.obs_count * new / count) / count)
        self.obs_mean.add_(delta * new / count)
        self.obs_count.copy_(count)

    def normalize(self, obs: Tensor) -> Tensor:
        """(obs - mean) / std, clipped to +-10; obs itself without normalize_obs."""
        if not self.normalize_obs:
            return obs
        scaled = (obs - self.obs_mean.float()) / torch.sqrt(self.obs_var.float() + 1e-8)
        return scaled.clamp(-10, 10)

    def get_value(self, obs: Tensor) -> Tensor:
        """V(s), (B,)."""
        return self.critic(obs).squeeze(-1)

    def get_distribution(self, obs: Tensor) -> Beta:
        """Beta over a_n in [0, 1], batch shape (B, act_dim), alpha and beta above 1."""
        log_excess = LOG_EXCESS_MAX * torch.tanh(self.actor(obs) / LOG_EXCESS_MAX)
        alpha, beta = (1 + log_excess.exp()).chunk(2, dim=-1)
        return Beta(alpha, beta, validate_args=False)

    def to_env(self, actions: Tensor) -> np.ndarray:
        """Actions in the environment's units, from a_n."""
        return (self.action_low + (self.action_high - self.action_low) * actions).cpu().numpy()

    @torch.no_grad()
    def predict(
        self, obs: np.ndarray, state: None = None, deterministic: bool = True
    ) -> tuple[np.ndarray, None]:
        """Actions (B, act_dim) for raw obs (B, obs_dim), and None: it has no memory."""
        obs = torch.as_tensor(obs, dtype=torch.float32, device=self.obs_mean.device)
        distribution = self.get_distribution(self.normalize(obs))
        return self.to_env(distribution.mean if deterministic else distribution.sample()), None


def perturb_actions(actions: Tensor, epsilon: float) -> Tensor:
    """Eq. (robust ppo): clip(a_n + g, 0, 1) with g ~ U(-epsilon, epsilon), A_MIN off 0 and 1."""
    noise = torch.empty_like(actions).uniform_(-1, 1) * epsilon
    return (actions + noise).clamp(A_MIN, 1 - A_MIN)


def compute_gae(
    rewards: Tensor, values: Tensor, next_value: Tensor, dones: Tensor, gamma: float, lam: float
) -> Tensor:
    """Advantages (T, N) of rewards, values, dones (T, N). next_value (N,) is V after the last step.

    dones[t] says that step t ended an episode (in CleanRL: dones[t + 1]). No bootstrapping there.
    Where the time limit cut it, the caller has already added gamma * V(final_obs) to the reward.
    """
    advantages = torch.zeros_like(rewards)
    next_advantage = torch.zeros_like(next_value)
    for t in reversed(range(len(rewards))):
        not_done = 1 - dones[t]
        delta = rewards[t] + gamma * next_value * not_done - values[t]
        advantages[t] = next_advantage = delta + gamma * lam * not_done * next_advantage
        next_value = values[t]
    return advantages


if __name__ == "__main__":
    args, checkpoint = crane_runs.read_arguments(ALGORITHM, Args, __doc__)
    device = torch.device(args.device)
    batch_size = args.num_envs * args.num_steps
    if args.minibatch_size == 1 or batch_size % args.minibatch_size == 1:
        raise SystemExit("--minibatch-size leaves a single decision, with no standard deviation")

    def to_tensor(x: np.ndarray) -> Tensor:
        return torch.as_tensor(x, dtype=torch.float32, device=device)

    # Environments
    try:
        envs = crane_trials.make_envs(args.env_id, args.num_envs, args.env_threads, **args.env)
    except (gymnasium.error.Error, ImportError, crane_options.OptionError) as error:
        raise SystemExit(f"{args.env_id}: {error}") from None
    obs_space, action_space = envs.single_observation_space, envs.single_action_space
    if not action_space.is_bounded():
        raise SystemExit(f"{args.env_id} has unbounded actions, and a Beta needs bounds")
    is_crane = isinstance(envs.unwrapped, crane_env.CraneVectorEnv)
    full_difficulty = envs.unwrapped.difficulty if is_crane else 1.0
    physics_steps = envs.unwrapped.frame_skip if is_crane else 1  # per decision
    tenths = physics_steps / 20 if is_crane else 1.0  # length of a decision [0.1 s]; 1 elsewhere

    # Agent
    torch.manual_seed(args.seed)
    torch.set_num_threads(args.torch_threads)  # the rounding of the weights depends on it
    agent = Agent(obs_space.shape[0], action_space.low, action_space.high, args).to(device)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)
    # With --resume it loads weights and optimizer. From here on Ctrl-C waits for the update.
    run = crane_runs.Run(ALGORITHM, args, envs, agent, optimizer, checkpoint)

    def set_difficulty(iteration: int) -> None:
        """Easy starts first: the difficulty rises to its full value in the warm-up."""
        so_far = iteration / run.num_iterations
        share = so_far / args.warm_up if so_far < args.warm_up else 1.0
        if is_crane:
            envs.unwrapped.difficulty = full_difficulty * share

    # Storage
    obs = torch.zeros((args.num_steps, args.num_envs, obs_space.shape[0]), device=device)
    actions = torch.zeros((args.num_steps, args.num_envs, action_space.shape[0]), device=device)
    rewards, dones = torch.zeros((2, args.num_steps, args.num_envs), device=device)
    set_difficulty(run.first_iteration)  # before the reset: it shapes the first starts
    next_obs = to_tensor(envs.reset(seed=run.env_seed)[0])
    for iteration in run.iterations():
        # Schedules
        progress = (iteration - 1.0) / run.num_iterations
        left = 1.0 - progress
        optimizer.param_groups[0]["lr"] = left * args.learning_rate
        epsilon = args.perturbation * max(0.0, 1 - progress / args.perturbed)
        growth = args.horizon_growth ** max(0.0, 1 - left / 0.75)  # 1 in the first quarter
        gamma = (1 - (1 - args.gamma) / growth) ** tenths
        reward_scale = args.reward_scale * tenths / growth  # V keeps its size as the horizon grows
        narrowing = args.narrowing / run.num_iterations
        set_difficulty(iteration)

        # Rollout
        rollout_start = time.time()
        torch.set_num_threads(1)  # the batches are too small for more
        infos = []
        for step in range(args.num_steps):
            with torch.no_grad():
                agent.update_normalizer(next_obs)
                obs[step] = agent.normalize(next_obs)
                action = agent.get_distribution(obs[step]).sample()
            actions[step] = perturb_actions(action, epsilon)
            next_obs, reward, terminated, truncated, info = envs.step(agent.to_env(actions[step]))
            next_obs = to_tensor(next_obs)
            rewards[step] = to_tensor(reward * reward_scale)
            dones[step] = to_tensor(terminated | truncated)
            infos.append(info)
            cut = truncated & ~terminated  # bootstrap: V stands for what the time limit cut off
            if cut.any():
                final_obs = agent.normalize(to_tensor(np.stack(info["final_obs"][cut])))
                with torch.no_grad():
                    rewards[step, cut] += gamma * agent.get_value(final_obs)

        # Advantages
        update_start = time.time()
        torch.set_num_threads(args.torch_threads)
        b_obs, b_actions = obs.flatten(0, 1), actions.flatten(0, 1)
        with torch.no_grad():
            values = agent.get_value(b_obs).view_as(rewards)
            b_logprobs = agent.get_distribution(b_obs).log_prob(b_actions).sum(-1)
            next_value = agent.get_value(agent.normalize(next_obs))
        advantages = compute_gae(rewards, values, next_value, dones, gamma, args.gae_lambda**tenths)
        b_advantages, b_returns = advantages.flatten(), (advantages + values).flatten()

        # Update
        stats = defaultdict(list)
        for _ in range(args.update_epochs):
            epoch_kls = []
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

                epoch_kls.append((ratio - 1 - logratio).mean().item())
                stats["losses/policy_loss"].append(policy_loss.item())
                stats["losses/value_loss"].append(value_loss.item())
                stats["losses/entropy"].append(entropy.item())
                stats["losses/grad_norm"].append(grad_norm.item())
                stats["losses/old_approx_kl"].append(-logratio.mean().item())
                stats["losses/clipfrac"].append((ratio != clipped).float().mean().item())
                stats["policy/alpha"].append(distribution.concentration1.mean().item())
                stats["policy/beta"].append(distribution.concentration0.mean().item())
            stats["losses/approx_kl"] += epoch_kls
            if args.target_kl is not None and np.mean(epoch_kls) > args.target_kl:
                break
        with torch.no_grad():
            agent.actor[-1].bias += narrowing  # by schedule; the gradient moves it as well

        # Reports
        now = time.time()
        sps = batch_size / (now - rollout_start)
        report = {"time/updates": iteration, "schedule/gamma": gamma}
        report["schedule/perturbation"] = epsilon
        report |= {name: np.mean(numbers) for name, numbers in stats.items()}
        report |= crane_trials.rollout_report(envs, infos)
        unexplained = (b_advantages.var() / (b_returns.var() + 1e-8)).item()
        report["losses/explained_variance"] = 1 - unexplained
        at_bounds = (b_actions <= A_MIN) | (b_actions >= 1 - A_MIN)
        report["policy/boundary_frac"] = at_bounds.float().mean().item()
        report["schedule/learning_rate"] = optimizer.param_groups[0]["lr"]
        report |= {"time/SPS": sps, "time/simulation_SPS": sps * physics_steps}
        report |= {"time/rollout": update_start - rollout_start, "time/update": now - update_start}
        run.finish_update(iteration, report)

    run.finish()
