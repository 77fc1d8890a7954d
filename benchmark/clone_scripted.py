"""mPPO from demonstrations: the network imitates the scripted crane, then mPPO goes on from there.

    python benchmark/clone_scripted.py               # a minute; prints the run's folder
    python mppo_beta_crane.py --resume runs/<folder>

The scripted crane makes one trial in each of many cranes. Its actions are perturbed as in mPPO, Eq.
(robust ppo). So it also shows how to come back to where it would have been. The Beta is fitted to
the executed actions by maximum likelihood, the critic to the lambda returns of mppo_beta_crane.py,
computed anew with the critic of each epoch:

    L = -E[log pi(a_n | s)] + c_v E[(V - R)^2]

The result is a run before its first update. Its arguments are those of mppo_beta_crane.py. Their
defaults are a short run without an easy task, with smaller steps.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

import crane_options
import crane_runs
import crane_trials
import numpy as np
import torch
import tyro
from crane_options import Factor, Size, Times
from torch import Tensor, nn
from tqdm import trange

import mppo_beta_crane as mppo
from scripted_crane import DT, HYDRAULIC, IDEAL, ScriptedCrane

MARGIN = 0.005  # off 0 and 1, where the script often is: the likelihood is infinite there


def short_run() -> mppo.Args:
    steps = {"learning_rate": 5e-4, "warm_up": 0.0, "narrowing": 1.5}
    return mppo.Args(exp_name="cloned", total_timesteps=256_000, eval_every=10, **steps)


@dataclass
class Args:
    trials: Size = 512  # demonstrations
    clone_epochs: Times = 40  # passes over them
    clone_learning_rate: Factor = 1e-3  # Adam's step size in these passes
    run: mppo.Args = field(default_factory=short_run)
    """arguments of mPPO, which goes on with them"""

    def __post_init__(self) -> None:
        crane_options.check(vars(self), Args)


def demonstrate(agent: mppo.Agent, args: mppo.Args, trials: int) -> dict[str, Tensor]:
    """One trial of the scripted crane in each of N = `trials` cranes, T decisions.

    Returns obs and next_obs (T, N, obs_dim), not normalized; actions a_n (T, N, 6); rewards,
    terminated and alive (T, N). next_obs is what the action led to, before a new start. alive is
    1 up to a trial's end: what follows belongs to another trial.
    """
    envs = crane_trials.make_envs(args.env_id, trials, args.env_threads, **args.env)
    hydraulic = envs.unwrapped.hydraulic
    policy, state = ScriptedCrane(settings=HYDRAULIC if hydraulic else IDEAL), None
    obs, _ = envs.reset(seed=args.seed)
    rows, alive, successes = [], np.ones(trials, bool), 0
    for _ in trange(envs.unwrapped.max_decisions, desc="demonstrations", unit="decision"):
        action, state = policy.predict(obs[:, :18], state)
        share = (torch.as_tensor(action, dtype=torch.float32) + 1) / 2  # a_n
        actions = mppo.perturb_actions(share, args.perturbation).clamp(MARGIN, 1 - MARGIN)
        next_obs, reward, terminated, truncated, info = envs.step(agent.to_env(actions))
        done, after = terminated | truncated, next_obs.copy()
        if done.any():
            after[done] = np.stack(info["final_obs"][done])
            successes += (info["success"] & alive & done).sum()
        rows.append((obs, actions, reward * args.reward_scale, after, terminated, alive))
        obs, alive = next_obs, alive & ~done
    envs.close()
    print(f"success of the demonstrations: {successes / trials:.3f}")
    names = ("obs", "actions", "rewards", "next_obs", "terminated", "alive")
    columns = (np.array(column) for column in zip(*rows))
    return {name: torch.as_tensor(x, dtype=torch.float32) for name, x in zip(names, columns)}


def clone(agent: mppo.Agent, demonstrations: dict[str, Tensor], args: Args) -> None:
    """Fit actor and critic to the demonstrations."""
    rewards, terminated, alive = (demonstrations[k] for k in ("rewards", "terminated", "alive"))
    kept = alive.flatten() > 0
    agent.update_normalizer(demonstrations["obs"].flatten(0, 1)[kept])
    obs, next_obs = (agent.normalize(demonstrations[name]) for name in ("obs", "next_obs"))
    b_obs = obs.flatten(0, 1)[kept]
    b_actions = demonstrations["actions"].flatten(0, 1)[kept]
    ends = 1 - torch.cat([alive[1:], torch.zeros_like(alive[:1])])
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.clone_learning_rate, eps=1e-5)
    for _ in trange(args.clone_epochs, desc="cloning", unit="epoch"):
        with torch.no_grad():
            values, after = agent.get_value(obs), agent.get_value(next_obs)
            # as in mPPO: V stands for what the time limit cut off
            cut = args.run.gamma * after * ends * (1 - terminated)
            discounts = args.run.gamma, args.run.gae_lambda
            advantages = mppo.compute_gae(rewards + cut, values, after[-1], ends, *discounts)
        b_returns = (advantages + values).flatten()[kept]
        for mb in torch.randperm(len(b_obs)).split(args.run.minibatch_size):
            logprobs = agent.get_distribution(b_obs[mb]).log_prob(b_actions[mb]).sum(-1)
            value_loss = ((agent.get_value(b_obs[mb]) - b_returns[mb]) ** 2).mean()
            optimizer.zero_grad()
            (-logprobs.mean() + args.run.vf_coef * value_loss).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), args.run.max_grad_norm)
            optimizer.step()


def main(args: Args) -> None:
    run_args = args.run
    if not crane_trials.is_crane(run_args.env_id):
        raise SystemExit(f"{run_args.env_id} is not the crane, and the script drives nothing else")
    if run_args.resume is not None:
        raise SystemExit("--run.resume would overwrite that run; leave it to mppo_beta_crane.py")
    torch.manual_seed(run_args.seed)
    torch.set_num_threads(run_args.torch_threads)
    envs = crane_trials.make_envs(run_args.env_id, 1, **run_args.env)
    if envs.unwrapped.dt != DT:
        raise SystemExit("the scripted crane decides every 0.1 s: leave frame_skip at 20")
    spaces = envs.single_observation_space, envs.single_action_space
    agent = mppo.Agent(spaces[0].shape[0], spaces[1].low, spaces[1].high, run_args)
    clone(agent, demonstrate(agent, run_args, args.trials), args)
    optimizer = torch.optim.Adam(agent.parameters(), run_args.learning_rate, eps=1e-5, fused=True)
    run = crane_runs.Run(mppo.ALGORITHM, run_args, envs, agent, optimizer, None)
    scores = run.evaluate("eval", run_args.eval_trials, iteration=0)
    run.save(iteration=0)
    if run.stop_signals:  # it came during the evaluation
        raise SystemExit(128 + run.stop_signals[0])
    print(f"success of the cloned policy: {scores['success_rate']:.3f}")
    print(f"go on with: python mppo_beta_crane.py --resume {run.dir}")


if __name__ == "__main__":
    crane_runs.one_line_errors()
    main(tyro.cli(Args, description=__doc__))
