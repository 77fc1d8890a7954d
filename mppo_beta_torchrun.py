"""mPPO on several processes: data-parallel with torch.distributed, on one machine or on many.

This is mppo_beta_crane.py, except that each rank has a share of the cranes and of each minibatch:
--num-envs and --minibatch-size count those of all ranks. The ranks average their gradients, the KL
divergence that stops an update, and the statistics of advantages and observations. So all have the
same weights. The observation normalizer changes after each rollout and not in it, so the first
rollout has raw observations. Rank 0 evaluates, and writes what it has seen.
Several machines: docs/speed.md.

    torchrun --standalone --nproc-per-node 2 mppo_beta_torchrun.py
"""

import os
import time
from collections import defaultdict
from dataclasses import asdict, field, replace
from pathlib import Path
from typing import Annotated, Literal

# OpenMP workers spin briefly before they sleep: low latency, and two runs can share two cores.
os.environ.setdefault("GOMP_SPINCOUNT", "5000")

import numpy as np
import torch
import torch.distributed as dist
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn
from torch.distributions import Beta
from tqdm import tqdm

from crane_env import STRICT, Options
from crane_utils import runs, trials
from crane_utils.runs import Count, Factor, Share

A_MIN = 1e-4  # in training a_n is in [A_MIN, 1 - A_MIN]: the log-probability is -inf at 0 and 1
PERTURBED = 0.4  # share of the run in which eps falls to 0
LOG_EXCESS_MAX = 5.0  # bound of log(alpha - 1) and log(beta - 1)


@dataclass(config=STRICT)
class Args:
    # run
    exp_name: str = Path(__file__).stem  # part of the run's folder name
    seed: Annotated[int, Field(ge=0)] = 1  # of the networks, the policy's samples and the episodes
    total_timesteps: Count = 1_024_000  # steps of all cranes together, in whole rollouts
    device: Literal["cpu", "cuda"] = "cpu"  # where the networks live
    threads: Count = 1  # CPU threads of physics and updates, of each rank
    eval_every: Count = 25  # updates between evaluations
    eval_trials: Count = 10  # trials per log diameter in each evaluation
    final_trials: Count = 100  # the same after the last update
    resume: Path | None = None  # run's folder to continue, perhaps with more total_timesteps

    # task
    env_id: str = "ForestryCrane-v0"  # Gymnasium task with flat Box spaces and episodes that end
    num_envs: Count = 64  # cranes simulated side by side
    env: Options = field(default_factory=Options)  # options of the task that --env-id names
    physics_step: Factor = 0.01  # of cranes in training, s; 0 is the task's own (docs/training.md)

    # algorithm
    num_steps: Count = 64  # steps per crane and rollout
    hidden_sizes: tuple[Count, ...] = (256, 256)  # hidden layers of the actor and of the critic
    learning_rate: Factor = 1.4e-3  # Adam's step size at the start
    gamma: Share = 0.97  # discount per step at the start
    gae_lambda: Share = 0.95  # lambda of the advantage estimate, per step
    reward_scale: Factor = 0.06  # factor on the reward; falls as the horizon grows
    minibatch_size: Annotated[int, Field(ge=2)] = 1024  # steps per gradient step
    update_epochs: Count = 4  # passes over each rollout
    clip_coef: Factor = 0.2  # c, bound of the ratio's change
    target_kl: Factor = 0.04  # stop after the first epoch whose mean KL exceeds this
    ent_coef: Factor = 0.0  # c_e, weight of the entropy
    vf_coef: Factor = 0.5  # c_v, weight of the value loss
    max_grad_norm: Factor = 0.5  # bound of the gradient's norm
    perturbation: Share = 0.1  # eps at the start, half width of the perturbation of a_n
    log_excess_init: float = 1.5  # log(alpha - 1), log(beta - 1) at the start, before the bound

    # schedules (docs/training.md)
    curriculum: Share = 0.4  # cranes: share of the run in which the difficulty rises to 1
    retry: Share = 0.5  # cranes: largest share of episodes that repeat a failed start
    horizon_growth: Annotated[float, Field(ge=1)] = 3.0  # 1 / (1 - gamma) grows by this factor
    narrowing: float = 2.5  # rise of the actor's outputs in the run, before the bound


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
        self.actor = mlp([obs_dim, *args.hidden_sizes, 2 * len(action_low)], last_gain=0.01)
        nn.init.constant_(self.actor[-1].bias, args.log_excess_init)
        self.critic = mlp([obs_dim, *args.hidden_sizes, 1], last_gain=1.0)
        self.register_buffer("action_low", torch.tensor(action_low))
        self.register_buffer("action_high", torch.tensor(action_high))
        self.register_buffer("obs_mean", torch.zeros(obs_dim, dtype=torch.float64))
        self.register_buffer("obs_var", torch.ones(obs_dim, dtype=torch.float64))
        self.register_buffer("obs_count", torch.tensor(0.0, dtype=torch.float64))

    def update_normalizer(self, obs: Tensor) -> None:
        """Merge mean and variance of obs (N, obs_dim), float64, into the running ones (Chan)."""
        new = len(obs) * dist.get_world_size()
        count, mean = self.obs_count + new, average(obs.mean(0))
        delta = mean - self.obs_mean
        spread = self.obs_var * self.obs_count + average(((obs - mean) ** 2).mean(0)) * new
        self.obs_var.copy_((spread + delta**2 * self.obs_count * new / count) / count)
        self.obs_mean.add_(delta * new / count)
        self.obs_count.copy_(count)

    def normalize(self, obs: Tensor) -> Tensor:
        """(obs - mean) / std of obs in float64, as float32, clipped to +-10."""
        return ((obs - self.obs_mean) / torch.sqrt(self.obs_var + 1e-8)).float().clamp(-10, 10)

    def get_value(self, obs: Tensor) -> Tensor:
        return self.critic(obs).squeeze(-1)

    def get_distribution(self, obs: Tensor) -> Beta:
        """Beta over a_n in [0, 1], batch shape (B, act_dim), alpha and beta above 1."""
        log_excess = LOG_EXCESS_MAX * torch.tanh(self.actor(obs) / LOG_EXCESS_MAX)
        alpha, beta = (1 + log_excess.exp()).chunk(2, dim=-1)
        return Beta(alpha, beta, validate_args=False)

    def to_env(self, actions: Tensor) -> np.ndarray:
        """Actions in the environment's units and dtype, from a_n."""
        low, high = self.action_low.double(), self.action_high.double()
        return torch.lerp(low, high, actions.double()).to(self.action_low.dtype).cpu().numpy()

    @torch.no_grad()
    def predict(self, obs: np.ndarray, state: None = None, deterministic: bool = True) -> tuple:
        """Actions (B, act_dim) for raw obs (B, obs_dim), and None: it has no memory."""
        obs = torch.as_tensor(obs, dtype=torch.float64, device=self.obs_mean.device)
        distribution = self.get_distribution(self.normalize(obs))
        return self.to_env(distribution.mean if deterministic else distribution.sample()), None


def average(x: Tensor) -> Tensor:
    """The mean over all ranks of x, which is overwritten."""
    dist.all_reduce(x)
    return x / dist.get_world_size()


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

    all_args, checkpoint = runs.parse(Args, __doc__)
    if not dist.is_torchelastic_launched():
        raise SystemExit(f"start it as: torchrun --standalone --nproc-per-node 2 {__file__}")
    dist.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo")
    rank, world_size = dist.get_rank(), dist.get_world_size()
    if all_args.num_envs % world_size or all_args.minibatch_size % world_size:
        raise SystemExit(f"--num-envs and --minibatch-size must be multiples of {world_size} ranks")
    args = replace(all_args, num_envs=all_args.num_envs // world_size)  # this rank's share
    args.minibatch_size //= world_size
    if args.device == "cuda":
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    device = torch.device(args.device)
    batch_size = args.num_envs * args.num_steps
    num_iterations = max(1, args.total_timesteps // (world_size * batch_size))

    def to_tensor(x: np.ndarray, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.as_tensor(x, dtype=dtype, device=device)

    def difficulty(iteration: int) -> float:  # easy starts first; 1 is the full task
        return min(1.0, iteration / num_iterations / max(args.curriculum, 1e-9))

    # Environments
    evaluation = {"threads": args.threads, "options": asdict(args.env)}
    training = evaluation | {"retry": args.retry, "physics_step": args.physics_step}
    envs = trials.make_envs(args.env_id, args.num_envs, **training)
    obs_space, action_space = envs.single_observation_space, envs.single_action_space
    if not np.all(action_space.high - action_space.low < 1e9):
        raise SystemExit(f"a Beta policy needs bounded actions, and {args.env_id} has none")

    # Agent
    torch.manual_seed(args.seed)
    torch.set_num_threads(args.threads)  # the rounding of the weights depends on it
    agent = Agent(obs_space.shape[0], action_space.low, action_space.high, args).to(device)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)
    first_iteration, env_seed = runs.restore(args, checkpoint, agent, optimizer)
    for weights in agent.state_dict().values():
        dist.broadcast(weights, 0)  # another CPU may round them otherwise
    seeds = np.random.SeedSequence(env_seed).generate_state(all_args.num_envs)
    seeds = np.split(seeds, world_size)[rank].tolist()
    torch.manual_seed(seeds[0])  # from now on each rank samples for itself

    stop = runs.StopSignal()
    if rank == 0:
        folder, done = runs.make_folder(args), (first_iteration - 1) * world_size * batch_size
        writer, lines = SummaryWriter(folder, purge_step=done + 1), asdict(all_args).items()
        writer.add_text("hyperparameters", "\n".join(f"    {k}: {v}" for k, v in lines))

    # Storage
    obs = torch.zeros((args.num_steps, args.num_envs, obs_space.shape[0]), device=device)
    actions = torch.zeros((args.num_steps, args.num_envs, action_space.shape[0]), device=device)
    rewards, dones = torch.zeros((2, args.num_steps, args.num_envs), device=device)
    envs.unwrapped.difficulty = difficulty(first_iteration)  # it shapes the first starts
    next_obs = to_tensor(envs.reset(seed=seeds)[0], torch.float64)
    todo = range(first_iteration, num_iterations + 1)
    count = {"initial": first_iteration - 1, "total": num_iterations, "disable": rank > 0}
    for iteration in (bar := tqdm(todo, **count)):
        # Schedules
        left = 1 - (iteration - 1) / num_iterations  # share of the run that is to come
        optimizer.param_groups[0]["lr"] = left * args.learning_rate
        epsilon = args.perturbation * max(0.0, 1 - (1 - left) / PERTURBED)
        growth = args.horizon_growth ** max(0.0, 1 - left / 0.75)  # 1 in the first quarter
        gamma = 1 - (1 - args.gamma) / growth
        reward_scale = args.reward_scale / growth  # V keeps its size as the horizon grows
        envs.unwrapped.difficulty = difficulty(iteration)

        # Rollout
        began, infos, raw_obs = time.perf_counter(), [], []
        torch.set_num_threads(1)  # the batches are too small for more
        for step in range(args.num_steps):
            with torch.no_grad():
                raw_obs.append(next_obs)
                obs[step] = agent.normalize(next_obs)
                action = agent.get_distribution(obs[step]).sample()
            noise = epsilon * torch.empty_like(action).uniform_(-1, 1)  # Eq. (20)
            actions[step] = (action + noise).clamp(A_MIN, 1 - A_MIN)
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

        # Advantages. The policy was frozen: values and log-probabilities come in one batch here
        torch.set_num_threads(args.threads)
        b_obs, b_actions = obs.flatten(0, 1), actions.flatten(0, 1)
        with torch.no_grad():
            values = agent.get_value(b_obs).view_as(rewards)
            b_logprobs = agent.get_distribution(b_obs).log_prob(b_actions).sum(-1)
            next_value = agent.get_value(agent.normalize(next_obs))
            agent.update_normalizer(torch.cat(raw_obs))  # no rank waits for others in a rollout
        advantages = compute_gae(rewards, values, next_value, dones, gamma, args.gae_lambda)
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
                adv = adv - average(adv.mean())
                adv = adv / (average((adv**2).mean()).sqrt() + 1e-8)
                clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
                policy_loss = -torch.min(adv * ratio, adv * clipped).mean()
                value_loss = ((agent.get_value(b_obs[mb]) - b_returns[mb]) ** 2).mean()
                entropy = distribution.entropy().sum(-1).mean()
                loss = policy_loss + args.vf_coef * value_loss - args.ent_coef * entropy
                optimizer.zero_grad()
                loss.backward()
                grads = [parameter.grad for parameter in agent.parameters()]
                nn.utils.vector_to_parameters(average(nn.utils.parameters_to_vector(grads)), grads)
                grad_norm = nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
                optimizer.step()
                epoch_kls.append((ratio - 1 - logratio).mean().item())
                stats["losses/policy_loss"].append(policy_loss.item())
                stats["losses/value_loss"].append(value_loss.item())
                stats["losses/entropy"].append(entropy.item())
                stats["losses/grad_norm"].append(grad_norm.item())
                stats["losses/clipfrac"].append((ratio != clipped).float().mean().item())
                stats["policy/std"].append(distribution.stddev.mean().item())
            stats["losses/approx_kl"] += epoch_kls
            if average(torch.tensor(np.mean(epoch_kls), device=device)) > args.target_kl:
                break
        with torch.no_grad():  # the policy narrows by schedule; the gradient moves it as well
            agent.actor[-1].bias += args.narrowing / num_iterations

        # Log
        global_step = iteration * world_size * batch_size
        stats = {name: np.mean(numbers) for name, numbers in stats.items()}
        stats |= trials.rollout_report(envs, infos)
        explained = 1 - (b_advantages.var() / (b_returns.var() + 1e-8)).item()  # A = R - V
        stats |= {"losses/explained_variance": explained, "schedule/gamma": gamma}
        stats["schedule/perturbation"] = epsilon
        stats["charts/learning_rate"] = left * args.learning_rate
        stats["charts/SPS"] = world_size * batch_size / (time.perf_counter() - began)
        runs.check_finite(iteration, stats, agent)
        for name, value in stats.items() if rank == 0 else ():
            writer.add_scalar(name, value, global_step)

        # Evaluate
        final = iteration == num_iterations
        stopping = average(torch.tensor(float(bool(stop.received)), device=device)) > 0  # any rank
        if rank == 0 and (final or iteration % args.eval_every == 0):
            number = args.final_trials if final else args.eval_trials
            scores = trials.evaluate(agent, args.env_id, number, **evaluation)
            for name, score in scores.items():
                writer.add_scalar(f"eval/{name}", score, global_step)
            bar.write(f"{global_step:,} steps: {runs.brief(scores)}")

        # Save after the evaluation: if a kill interrupts it, the resumed run repeats it
        if rank == 0 and (final or iteration % 10 == 0 or stopping):
            runs.save(folder, all_args, envs, agent, optimizer, iteration)
        if stopping and not final and rank == 0:
            raise SystemExit(f"stopped after update {iteration}; go on with --resume {folder}")
        if stopping:
            break
        bar.set_postfix_str(runs.brief(stats))
    if rank == 0:
        writer.close()
    dist.destroy_process_group()
