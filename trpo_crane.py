"""TRPO: trust region policy optimization with a Gaussian policy, on the crane.

A baseline of the paper (Vu et al., Sec. V-A), after Schulman et al., 2015:

- The policy is a ~ N(mu(s), sigma^2) as in PPO. An evaluation takes the mean mu(s).
- Each rollout gives one step p of the policy along the natural gradient. Its length keeps the mean
  KL divergence from the old policy within delta.

    max g^T p   subject to   1/2 p^T (F + d I) p <= delta         g = grad E[rho A]
    p = sqrt(2 delta / x^T (F + d I) x) x,   (F + d I) x = g

  F is the Hessian of the mean KL divergence at the old policy. A few iterations of conjugate
  gradient solve for x roughly, with products F v and without F itself (Schulman et al., App. C.1).
- A line search over the whole rollout takes the first of p, c p, c^2 p, ... with KL <= delta and a
  larger E[rho A]. If none qualifies, the policy stays.
- The critic is fitted on its own, by minibatches of (V - R)^2.

Advantages A, returns R and the time limit are as in ppo_crane.py. A is scaled over the rollout.
Difficulty, width, horizon, reward_scale, delta and step size have schedules (docs/training.md).

    python trpo_crane.py  # the crane: minutes on two cores
    python trpo_crane.py --env-id Hopper-v5 --num-envs 8 --minibatch-size 64 --eval-every 200
"""

import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import asdict, field
from pathlib import Path
from typing import Annotated, Literal

# OpenMP workers spin briefly before they sleep: low latency, and two runs can share two cores.
os.environ.setdefault("GOMP_SPINCOUNT", "5000")

import numpy as np
import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence
from tqdm import tqdm

from crane_env import STRICT, Options
from crane_utils import runs, trials
from crane_utils.runs import Count, Factor, Share


@dataclass(config=STRICT)
class Args:
    # run
    exp_name: str = Path(__file__).stem  # part of the run's folder name
    seed: Annotated[int, Field(ge=0)] = 1  # of the networks, the policy's samples and the episodes
    total_timesteps: Count = 2_048_000  # steps of all cranes together, in whole rollouts
    device: Literal["cpu", "cuda"] = "cpu"  # where the networks live
    threads: Count = 2  # CPU threads of physics and updates
    eval_every: Count = 12  # updates between evaluations
    eval_trials: Count = 10  # trials per log diameter in each evaluation
    final_trials: Count = 100  # the same after the last update
    resume: Path | None = None  # run's folder to continue, perhaps with more total_timesteps

    # task
    env_id: str = "ForestryCrane-v0"  # Gymnasium task with flat Box spaces and episodes that end
    num_envs: Count = 128  # cranes simulated side by side
    env: Options = field(default_factory=Options)  # options of the task that --env-id names
    physics_step: Factor = 0.01  # of cranes in training, s; 0 is the task's own (docs/training.md)

    # algorithm
    num_steps: Count = 64  # steps per crane and rollout
    hidden_sizes: tuple[Count, ...] = (256, 256)  # hidden layers of the actor and of the critic
    learning_rate: Factor = 1.4e-3  # Adam's step size at the start, for the critic
    gamma: Share = 0.97  # discount per step at the start
    gae_lambda: Share = 0.95  # lambda of the advantage estimate, per step
    reward_scale: Factor = 0.06  # factor on the reward; falls as the horizon grows
    minibatch_size: Count = 2048  # steps per gradient step of the critic
    update_epochs: Count = 4  # passes of the critic over each rollout
    target_kl: Factor = 0.06  # delta at the start, bound of the mean KL divergence of one step
    cg_iters: Count = 15  # iterations of the conjugate gradient
    cg_damping: Factor = 0.1  # d, added to the diagonal of F
    fisher_samples: Count = 1024  # steps of each rollout whose F gives the step's direction
    backtrack_iters: Count = 10  # largest number of trials of the line search
    backtrack_coeff: Annotated[float, Field(gt=0, lt=1)] = 0.8  # c, factor from trial to trial
    max_grad_norm: Factor = 0.5  # bound of the norm of the critic's gradient
    log_std_init: float = -1.2  # log sigma at the start; actions reach from -1 to 1

    # schedules (docs/training.md)
    curriculum: Share = 0.4  # cranes: share of the run in which the difficulty rises to 1
    retry: Share = 0.0  # cranes: largest share of episodes that repeat a failed start
    horizon_growth: Annotated[float, Field(ge=1)] = 3.0  # 1 / (1 - gamma) grows by this factor
    narrowing: float = 0.3  # fall of log sigma in the run


def mlp(sizes: list[int], last_gain: float) -> nn.Sequential:
    """Linear layers of these sizes with tanh between them. last_gain: of the last one's weights."""
    layers, gains = [], [np.sqrt(2)] * (len(sizes) - 2) + [last_gain]
    for inputs, outputs, gain in zip(sizes, sizes[1:], gains):
        layer = nn.Linear(inputs, outputs)
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


class Agent(nn.Module):
    """Actor, critic and observation normalizer. The networks take normalized observations."""

    def __init__(self, obs_dim: int, action_low: np.ndarray, action_high: np.ndarray, args: Args):
        super().__init__()
        self.actor = mlp([obs_dim, *args.hidden_sizes, len(action_low)], last_gain=0.01)
        self.log_std = nn.Parameter(torch.full((len(action_low),), args.log_std_init))
        self.critic = mlp([obs_dim, *args.hidden_sizes, 1], last_gain=1.0)
        self.register_buffer("action_low", torch.tensor(action_low))
        self.register_buffer("action_high", torch.tensor(action_high))
        self.register_buffer("obs_mean", torch.zeros(obs_dim, dtype=torch.float64))
        self.register_buffer("obs_var", torch.ones(obs_dim, dtype=torch.float64))
        self.register_buffer("obs_count", torch.tensor(0.0, dtype=torch.float64))

    def update_normalizer(self, obs: Tensor) -> None:
        """Merge mean and variance of obs (N, obs_dim), float64, into the running ones (Chan)."""
        new = len(obs)
        count = self.obs_count + new
        delta = obs.mean(0) - self.obs_mean
        spread = self.obs_var * self.obs_count + obs.var(0, correction=0) * new
        self.obs_var.copy_((spread + delta**2 * self.obs_count * new / count) / count)
        self.obs_mean.add_(delta * new / count)
        self.obs_count.copy_(count)

    def normalize(self, obs: Tensor) -> Tensor:
        """(obs - mean) / std of obs in float64, as float32, clipped to +-10."""
        return ((obs - self.obs_mean) / torch.sqrt(self.obs_var + 1e-8)).float().clamp(-10, 10)

    def get_value(self, obs: Tensor) -> Tensor:
        return self.critic(obs).squeeze(-1)

    def get_distribution(self, obs: Tensor) -> Normal:
        """Gaussian over actions before clipping, batch shape (B, act_dim)."""
        mean = self.actor(obs)
        return Normal(mean, self.log_std.exp().expand_as(mean), validate_args=False)

    def policy_parameters(self) -> list[nn.Parameter]:  # fisher_vector_product has this order
        return [*self.actor.parameters(), self.log_std]

    def to_env(self, actions: Tensor) -> np.ndarray:
        """Actions in the environment's units: -1 and 1 become the limits, if there are any."""
        low, high = self.action_low.double(), self.action_high.double()
        scaled = torch.where(high - low < 1e9, (low + high + (high - low) * actions) / 2, actions)
        return scaled.clamp(low, high).to(self.action_low.dtype).cpu().numpy()

    @torch.no_grad()
    def predict(self, obs: np.ndarray, state: None = None, deterministic: bool = True) -> tuple:
        """Actions (B, act_dim) for raw obs (B, obs_dim), and None: it has no memory."""
        obs = torch.as_tensor(obs, dtype=torch.float64, device=self.obs_mean.device)
        distribution = self.get_distribution(self.normalize(obs))
        return self.to_env(distribution.mean if deterministic else distribution.sample()), None


def flat(tensors: Iterable[Tensor]) -> Tensor:
    return torch.cat([tensor.reshape(-1) for tensor in tensors])


def fisher_vector_product(agent: Agent, obs: Tensor, damping: float) -> Callable[[Tensor], Tensor]:
    """The function v -> (F + damping I) v, v like the flat `policy_parameters`.

    F = E[J^T J / sigma^2] for the weights of mu, with J = d mu / d weights, and 2 for each log
    sigma. Second derivatives of mu drop out because d KL / d mu is 0 at the old policy.
    """
    mean, weights = agent.get_distribution(obs).mean, list(agent.actor.parameters())
    u = torch.zeros_like(mean, requires_grad=True)  # only to differentiate: J^T u is linear in u
    jt_u = flat(torch.autograd.grad(mean, weights, u, create_graph=True))

    def product(v: Tensor) -> Tensor:
        v_weights, v_log_std = v.split([len(jt_u), len(agent.log_std)])
        (jv,) = torch.autograd.grad(jt_u, u, v_weights, retain_graph=True)  # d(v^T J^T u) / du
        mjv = jv * torch.exp(-2 * agent.log_std.detach()) / len(obs)
        jt_mjv = flat(torch.autograd.grad(mean, weights, mjv, retain_graph=True))
        return torch.cat([jt_mjv, 2 * v_log_std]) + damping * v

    return product


def conjugate_gradient(matvec: Callable[[Tensor], Tensor], b: Tensor, iterations: int) -> Tensor:
    """Roughly x with matvec(x) = b, for a symmetric positive definite matrix."""
    x, residual = torch.zeros_like(b), b.clone()
    direction, residual_sq = b, b @ b
    for _ in range(iterations):
        if residual_sq <= 1e-20 * (b @ b):
            break
        product = matvec(direction)
        step = residual_sq / (direction @ product)
        x += step * direction
        residual -= step * product
        direction = residual + (residual @ residual) / residual_sq * direction
        residual_sq = residual @ residual
    return x


def surrogate_and_kl(
    agent: Agent, obs: Tensor, actions: Tensor, advantages: Tensor, old: Normal
) -> tuple[Tensor, Tensor]:
    """E[rho A] of the agent and its mean KL divergence from the old policy."""
    distribution = agent.get_distribution(obs)
    ratio = (distribution.log_prob(actions) - old.log_prob(actions)).sum(-1).exp()
    return (ratio * advantages).mean(), kl_divergence(old, distribution).sum(-1).mean()


@torch.no_grad()
def line_search(
    agent: Agent, full_step: Tensor, batch: tuple, delta: float, args: Args
) -> tuple[float, float, float]:
    """Move the policy along full_step. Returns the accepted fraction, its KL and its E[rho A].

    batch: obs, actions, advantages and old policy, as `surrogate_and_kl` takes them. If no fraction
    is accepted, the policy stays as it was, and the first two are 0.
    """
    old_surrogate, _ = surrogate_and_kl(agent, *batch)
    start = flat(agent.policy_parameters())
    for k in range(args.backtrack_iters):
        fraction = args.backtrack_coeff**k
        nn.utils.vector_to_parameters(start + fraction * full_step, agent.policy_parameters())
        surrogate, kl = surrogate_and_kl(agent, *batch)
        if kl <= delta and surrogate > old_surrogate:
            return fraction, kl.item(), surrogate.item()
    nn.utils.vector_to_parameters(start, agent.policy_parameters())
    return 0.0, 0.0, old_surrogate.item()


def compute_gae(
    rewards: Tensor, values: Tensor, next_value: Tensor, dones: Tensor, gamma: float, lam: float
) -> Tensor:
    """Advantages (T, N). dones[t] says that step t ended an episode (in CleanRL: dones[t + 1])."""
    advantages = torch.zeros_like(rewards)
    next_advantage = torch.zeros_like(next_value)
    for t in reversed(range(len(rewards))):
        not_done = 1 - dones[t]
        delta = rewards[t] + gamma * next_value * not_done - values[t]
        advantages[t] = next_advantage = delta + gamma * lam * not_done * next_advantage
        next_value = values[t]
    return advantages


if __name__ == "__main__":
    from torch.utils.tensorboard import SummaryWriter  # not above: acting does without it

    args, checkpoint = runs.parse(Args, __doc__)
    device = torch.device(args.device)
    batch_size = args.num_envs * args.num_steps
    num_iterations = max(1, args.total_timesteps // batch_size)

    def to_tensor(x: np.ndarray, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.as_tensor(x, dtype=dtype, device=device)

    def difficulty(iteration: int) -> float:  # easy starts first; 1 is the full task
        return min(1.0, iteration / num_iterations / max(args.curriculum, 1e-9))

    # Environments
    evaluation = {"threads": args.threads, "options": asdict(args.env)}
    training = evaluation | {"retry": args.retry, "physics_step": args.physics_step}
    envs = trials.make_envs(args.env_id, args.num_envs, **training)
    obs_space, action_space = envs.single_observation_space, envs.single_action_space

    # Agent
    torch.manual_seed(args.seed)
    torch.set_num_threads(args.threads)  # the rounding of the weights depends on it
    agent = Agent(obs_space.shape[0], action_space.low, action_space.high, args).to(device)
    optimizer = torch.optim.Adam(
        agent.critic.parameters(), lr=args.learning_rate, eps=1e-5, fused=True
    )
    first_iteration, env_seed = runs.restore(args, checkpoint, agent, optimizer)

    folder, stop = runs.make_folder(args), runs.StopSignal()
    writer = SummaryWriter(folder, purge_step=(first_iteration - 1) * batch_size + 1)
    writer.add_text("hyperparameters", "\n".join(f"    {k}: {v}" for k, v in asdict(args).items()))

    # Storage
    obs = torch.zeros((args.num_steps, args.num_envs, obs_space.shape[0]), device=device)
    actions = torch.zeros((args.num_steps, args.num_envs, action_space.shape[0]), device=device)
    rewards, dones = torch.zeros((2, args.num_steps, args.num_envs), device=device)
    envs.unwrapped.difficulty = difficulty(first_iteration)  # it shapes the first starts
    next_obs = to_tensor(envs.reset(seed=env_seed)[0], torch.float64)
    todo = range(first_iteration, num_iterations + 1)
    for iteration in (bar := tqdm(todo, initial=first_iteration - 1, total=num_iterations)):
        # Schedules
        left = 1 - (iteration - 1) / num_iterations  # share of the run that is to come
        optimizer.param_groups[0]["lr"] = left * args.learning_rate
        growth = args.horizon_growth ** max(0.0, 1 - left / 0.75)  # 1 in the first quarter
        gamma = 1 - (1 - args.gamma) / growth
        reward_scale = args.reward_scale / growth  # V keeps its size as the horizon grows
        envs.unwrapped.difficulty = difficulty(iteration)

        # Rollout
        began, infos = time.perf_counter(), []
        torch.set_num_threads(1)  # the batches are too small for more
        for step in range(args.num_steps):
            with torch.no_grad():
                agent.update_normalizer(next_obs)
                obs[step] = agent.normalize(next_obs)
                actions[step] = agent.get_distribution(obs[step]).sample()
            next_obs, reward, terminated, truncated, info = envs.step(agent.to_env(actions[step]))
            next_obs = to_tensor(next_obs, torch.float64)
            rewards[step] = to_tensor(reward * reward_scale)
            dones[step] = to_tensor(terminated | truncated)
            infos.append(info)
            cut = truncated & ~terminated
            if cut.any():  # bootstrap: V stands for what the time limit cut off
                final_obs = to_tensor(np.stack(info["final_obs"][cut]), torch.float64)
                with torch.no_grad():
                    rewards[step, cut] += gamma * agent.get_value(agent.normalize(final_obs))

        # Advantages. The policy was frozen: values and old policy come in one batch here
        torch.set_num_threads(args.threads)
        b_obs, b_actions = obs.flatten(0, 1), actions.flatten(0, 1)
        with torch.no_grad():
            values = agent.get_value(b_obs).view_as(rewards)
            old = agent.get_distribution(b_obs)
            next_value = agent.get_value(agent.normalize(next_obs))
        advantages = compute_gae(rewards, values, next_value, dones, gamma, args.gae_lambda)
        b_advantages, b_returns = advantages.flatten(), (advantages + values).flatten()

        # Policy update: one step
        adv = b_advantages - b_advantages.mean()
        adv = adv / (adv.std(correction=0) + 1e-8)
        batch = (b_obs, b_actions, adv, old)
        surrogate, _ = surrogate_and_kl(agent, *batch)
        gradient = flat(torch.autograd.grad(surrogate, agent.policy_parameters()))
        # F of a sample gives a good direction, but a length with which KL can exceed delta.
        sample = torch.randperm(batch_size, device=device)[: args.fisher_samples]
        matvec = fisher_vector_product(agent, b_obs[sample], args.cg_damping)
        direction = conjugate_gradient(matvec, gradient, args.cg_iters)
        curvature = direction @ fisher_vector_product(agent, b_obs, args.cg_damping)(direction)
        delta = left * args.target_kl
        full_step = torch.sqrt(2 * delta / (curvature + 1e-12)) * direction
        fraction, kl, new_surrogate = line_search(agent, full_step, batch, delta, args)
        stats = defaultdict(list)
        stats["losses/policy_loss"] = [-new_surrogate]
        stats["losses/entropy"] = [old.entropy().sum(-1).mean().item()]
        stats["policy/std"] = [old.stddev.mean().item()]
        stats["losses/approx_kl"], stats["trpo/step_fraction"] = [kl], [fraction]

        # Critic update
        for _ in range(args.update_epochs):
            for mb in torch.randperm(batch_size, device=device).split(args.minibatch_size):
                value_loss = ((agent.get_value(b_obs[mb]) - b_returns[mb]) ** 2).mean()
                optimizer.zero_grad()
                value_loss.backward()
                grad_norm = nn.utils.clip_grad_norm_(agent.critic.parameters(), args.max_grad_norm)
                optimizer.step()
                stats["losses/value_loss"].append(value_loss.item())
                stats["losses/grad_norm"].append(grad_norm.item())
        with torch.no_grad():  # the policy narrows by schedule; the gradient moves it as well
            agent.log_std -= args.narrowing / num_iterations

        # Log
        global_step = iteration * batch_size
        stats = {name: np.mean(numbers) for name, numbers in stats.items()}
        stats |= trials.rollout_report(envs, infos)
        explained = 1 - (b_advantages.var() / (b_returns.var() + 1e-8)).item()  # A = R - V
        stats |= {"losses/explained_variance": explained, "schedule/gamma": gamma}
        stats["charts/learning_rate"] = left * args.learning_rate
        stats["charts/SPS"] = batch_size / (time.perf_counter() - began)
        runs.check_finite(iteration, stats, agent)
        for name, value in stats.items():
            writer.add_scalar(name, value, global_step)

        # Evaluate
        final = iteration == num_iterations
        if final or iteration % args.eval_every == 0:
            number = args.final_trials if final else args.eval_trials
            scores = trials.evaluate(agent, args.env_id, number, **evaluation)
            for name, score in scores.items():
                writer.add_scalar(f"eval/{name}", score, global_step)
            bar.write(f"{global_step:,} steps: {runs.brief(scores)}")

        # Save after the evaluation: if a kill interrupts it, the resumed run repeats it
        if final or iteration % 10 == 0 or stop.received:
            runs.save(folder, args, envs, agent, optimizer, iteration)
            if stop.received and not final:
                raise SystemExit(f"stopped after update {iteration}; go on with --resume {folder}")
        bar.set_postfix_str(runs.brief(stats))
    writer.close()
