"""The four algorithms again: float64, one sample after another, from what the environments gave."""

import math

import numpy as np
import torch

EPS, BETA1, BETA2 = 1e-5, 0.9, 0.999  # of Adam

SETTINGS = {  # of the compared runs
    "num_steps": 9, "update_epochs": 3, "learning_rate": 0.02, "gamma": 0.9, "gae_lambda": 0.8,
    "reward_scale": 0.5, "target_kl": 0.0085, "max_grad_norm": 1.5, "narrowing": 0.3,
    "horizon_growth": 2.0, "curriculum": 0.5,
}  # fmt: skip
CLIPPED = {"clip_coef": 0.1, "ent_coef": 0.05, "vf_coef": 0.7}


def flags(settings: dict) -> str:
    return " ".join(f"--{name.replace('_', '-')} {value}" for name, value in settings.items())


class Reference:
    """Its weights `w` and what it remembers between updates: moments, statistics, memories.

    args: the script's arguments by name. of_ranks: the observation normalizer changes after each
    rollout.
    """

    def __init__(self, args: dict, weights: dict, of_ranks: bool = False):
        buffers = ("action_low", "action_high", "obs_mean", "obs_var", "obs_count")
        self.w = {k: v.double().requires_grad_() for k, v in weights.items() if k not in buffers}
        self.args, self.of_ranks = args, of_ranks
        self.adam_steps, self.moments = 0, {k: (0.0, 0.0) for k in self.w}
        self.seen, self.iteration = [], 0
        self.memory = self.starts = None

    # ---- networks

    def mlp(self, net: str, x: torch.Tensor) -> torch.Tensor:
        last = 2 * len(self.args["hidden_sizes"])
        for layer in range(0, last + 1, 2):
            x = self.w[f"{net}.{layer}.weight"] @ x + self.w[f"{net}.{layer}.bias"]
            x = torch.tanh(x) if layer < last else x
        return x

    def look(self, x: torch.Tensor, memory: tuple | None) -> tuple[torch.Tensor, tuple | None]:
        """What actor and critic see of an observation, and the memory (h, c) after it."""
        if "lstm.weight_ih_l0" not in self.w:
            return x, None
        h, c = memory or (torch.zeros(self.args["lstm_size"]).double(),) * 2
        gates = self.w["lstm.weight_ih_l0"] @ x + self.w["lstm.bias_ih_l0"]
        gates = gates + self.w["lstm.weight_hh_l0"] @ h + self.w["lstm.bias_hh_l0"]
        entry, keep, new, out = gates.chunk(4)
        c = torch.sigmoid(keep) * c + torch.sigmoid(entry) * torch.tanh(new)
        h = torch.sigmoid(out) * torch.tanh(c)
        return torch.cat([x, h]), (h, c)

    def value(self, seen: torch.Tensor) -> torch.Tensor:
        return self.mlp("critic", seen)[0]

    def policy(self, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """alpha and beta, or mu and sigma, of each action."""
        if "log_std" in self.w:
            return self.mlp("actor", seen), self.w["log_std"].exp()
        excess = (5 * torch.tanh(self.mlp("actor", seen) / 5)).exp()
        return tuple((1 + excess).chunk(2))

    def log_prob(self, seen: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        a, b = self.policy(seen)
        if "log_std" in self.w:
            return (-(((action - a) / b) ** 2) / 2 - b.log() - math.log(2 * math.pi) / 2).sum()
        density = torch.lgamma(a + b) - torch.lgamma(a) - torch.lgamma(b)
        return (density + (a - 1) * action.log() + (b - 1) * (1 - action).log()).sum()

    def entropy_and_std(self, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The entropy of all actions together, the mean standard deviation of one."""
        a, b = self.policy(seen)
        if "log_std" in self.w:
            return (b.log() + math.log(2 * math.pi * math.e) / 2).sum(), b.mean()
        entropy = torch.lgamma(a) + torch.lgamma(b) - torch.lgamma(a + b)
        entropy = entropy - (a - 1) * torch.digamma(a) - (b - 1) * torch.digamma(b)
        entropy = entropy + (a + b - 2) * torch.digamma(a + b)
        return entropy.sum(), (a * b / ((a + b) ** 2 * (a + b + 1))).sqrt().mean()

    # ---- rollout

    def normalized(self, obs: np.ndarray) -> torch.Tensor:
        mean, std = self.statistics
        return torch.as_tensor(np.clip((np.float64(obs) - mean) / std, -10, 10))

    def observe(self, obs: np.ndarray) -> None:
        self.seen.append(np.asarray(obs, float))
        seen = np.concatenate(self.seen)
        self.statistics = seen.mean(0), np.sqrt(seen.var(0) + 1e-8)

    @torch.no_grad()
    def rollout(self, obs: np.ndarray, steps: list[dict], actions: torch.Tensor) -> np.ndarray:
        """Advantages, returns and old log-probabilities of one rollout; the next observation.

        obs (N, obs_dim) is the first observation. actions (T, N, act_dim) are those of the policy.
        Each of steps has obs (N, obs_dim), reward, terminated, truncated (N,), final_obs.
        """
        args, n, self.actions = self.args, len(obs), actions.double()
        self.iteration += 1
        left = 1 - (self.iteration - 1) / args["iterations"]
        self.delta = left * args.get("target_kl", 0.0)
        self.growth = args["horizon_growth"] ** max(0.0, 1 - left / 0.75)
        self.gamma = 1 - (1 - args["gamma"]) / self.growth
        self.lr = left * args["learning_rate"]
        self.x, self.old, self.deltas, self.ends = {}, {}, {}, {}
        self.first_memory = list(self.memory or [None] * n)
        memory, starts, values = list(self.first_memory), self.starts or [True] * n, {}
        self.statistics = getattr(self, "statistics", (0.0, 1.0))
        self.begins = [starts]
        raw = []
        for t, step in enumerate(steps):
            raw.append(obs)
            if not self.of_ranks:
                self.observe(obs)
            for i in range(n):
                self.x[t, i] = self.normalized(obs[i])
                before = None if starts[i] else memory[i]
                seen, memory[i] = self.look(self.x[t, i], before)
                values[t, i] = self.value(seen)
                self.old[t, i] = self.log_prob(seen, self.actions[t, i])
                self.deltas[t, i] = step["reward"][i] * args["reward_scale"] / self.growth
                self.ends[t, i] = step["terminated"][i] or step["truncated"][i]
                if step["truncated"][i] and not step["terminated"][i]:
                    seen, _ = self.look(self.normalized(step["final_obs"][i]), memory[i])
                    self.deltas[t, i] += self.gamma * self.value(seen)
            obs, starts = step["obs"], [bool(self.ends[t, i]) for i in range(n)]
            self.begins.append(starts)
        for i in range(n):
            seen, _ = self.look(self.normalized(obs[i]), None if starts[i] else memory[i])
            values[len(steps), i] = self.value(seen)
        if self.of_ranks:
            self.observe(np.concatenate(raw))
        for t, i in self.old:
            following = 0.0 if self.ends[t, i] else self.gamma * values[t + 1, i]
            self.deltas[t, i] += following - values[t, i]
        self.advantages = {}
        for t, i in self.old:
            advantage, weight = 0.0, 1.0
            for later in range(t, len(steps)):
                advantage += weight * self.deltas[later, i]
                if self.ends[later, i]:
                    break
                weight *= self.gamma * args["gae_lambda"]
            self.advantages[t, i] = advantage
        self.returns = {p: a + values[p] for p, a in self.advantages.items()}
        self.memory, self.starts = memory, starts
        return obs

    def features(self, cranes: set[int]) -> dict:
        """What the networks see in the whole rollout of some cranes."""
        found = {}
        for i in cranes:
            memory = self.first_memory[i]
            for t in range(self.args["num_steps"]):
                memory = None if self.begins[t][i] else memory
                found[t, i], memory = self.look(self.x[t, i], memory)
        return found

    # ---- updates

    def adam(self, loss: torch.Tensor, names: list[str]) -> float:
        """One step on these weights. Returns the gradient's norm before it is clipped."""
        weights = [self.w[name] for name in names]
        grads = torch.autograd.grad(loss, weights)
        norm = math.sqrt(sum((grad**2).sum().item() for grad in grads))
        factor = min(1.0, self.args["max_grad_norm"] / (norm + 1e-6))
        self.adam_steps += 1
        for name, grad in zip(names, grads):
            m, v = self.moments[name]
            m = BETA1 * m + (1 - BETA1) * factor * grad
            v = BETA2 * v + (1 - BETA2) * (factor * grad) ** 2
            self.moments[name] = m, v
            m, v = m / (1 - BETA1**self.adam_steps), v / (1 - BETA2**self.adam_steps)
            with torch.no_grad():
                self.w[name] -= self.lr * m / (v.sqrt() + EPS)
        return norm

    def normalized_advantages(self, batch: list) -> list[torch.Tensor]:
        values, n = [self.advantages[p] for p in batch], len(batch)
        mean = sum(values) / n
        spread = sum((a - mean) ** 2 for a in values) / n
        return [(a - mean) / (math.sqrt(spread) + 1e-8) for a in values]

    def ppo(self, epochs: list[list[list]]) -> dict[str, list[float]]:
        """Epochs of minibatches of (step, crane), until the KL divergence stops them."""
        args, stats = self.args, {}
        self.epochs_done = 0
        for epoch in epochs:
            kls = []
            for batch in epoch:
                seen, n = self.features({i for _, i in batch}), len(batch)
                gain = value_loss = entropy = kl = clipped = std = 0.0
                for p, a in zip(batch, self.normalized_advantages(batch)):
                    logratio = self.log_prob(seen[p], self.actions[p]) - self.old[p]
                    ratio = logratio.exp()
                    bounded = min(max(ratio.item(), 1 - args["clip_coef"]), 1 + args["clip_coef"])
                    clipped += (ratio.item() != bounded) / n
                    gain = gain + (ratio * a if ratio * a <= bounded * a else bounded * a) / n
                    value_loss = value_loss + (self.value(seen[p]) - self.returns[p]) ** 2 / n
                    h, s = self.entropy_and_std(seen[p])
                    entropy, std = entropy + h / n, std + s / n
                    kl += (ratio - 1 - logratio).item() / n
                loss = -gain + args["vf_coef"] * value_loss - args["ent_coef"] * entropy
                norm = self.adam(loss, list(self.w))
                kls.append(kl)
                for name, number in {
                    "losses/policy_loss": -gain,
                    "losses/value_loss": value_loss,
                    "losses/entropy": entropy,
                    "losses/grad_norm": norm,
                    "losses/clipfrac": clipped,
                    "losses/approx_kl": kl,
                    "policy/std": std,
                }.items():
                    stats.setdefault(name, []).append(torch.as_tensor(number).item())
            self.epochs_done += 1
            if sum(kls) / len(kls) > args["target_kl"]:
                break
        with torch.no_grad():
            step = args["narrowing"] / args["iterations"]
            if "log_std" in self.w:
                self.w["log_std"] -= step
            else:
                self.w[f"actor.{2 * len(args['hidden_sizes'])}.bias"] += step
        return stats

    def trpo(self, sample: list, epochs: list[list[list]]) -> dict[str, list[float]]:
        """A natural step with an explicit Fisher matrix, then the critic's minibatches."""
        args, everything = self.args, list(self.old)
        names = [k for k in self.w if not k.startswith("critic")]
        shapes = [self.w[k].shape for k in names]
        old = {p: [x.detach() for x in self.policy(self.x[p])] for p in everything}
        advantages = dict(zip(everything, self.normalized_advantages(everything)))
        with torch.no_grad():
            entropies = [self.entropy_and_std(self.x[p]) for p in everything]
        stats = {
            "losses/entropy": [float(sum(h for h, _ in entropies)) / len(everything)],
            "policy/std": [float(sum(s for _, s in entropies)) / len(everything)],
        }

        def with_policy(flat: torch.Tensor) -> None:
            parts = flat.split([math.prod(shape) for shape in shapes])
            self.w |= {k: x.reshape(s) for k, x, s in zip(names, parts, shapes)}

        def surrogate(flat: torch.Tensor) -> torch.Tensor:
            with_policy(flat)
            ratios = {
                p: (self.log_prob(self.x[p], self.actions[p]) - self.old[p]).exp() for p in old
            }
            return sum(ratios[p] * advantages[p] for p in everything) / len(everything)

        def kl(flat: torch.Tensor, points: list) -> torch.Tensor:
            with_policy(flat)
            total = 0.0
            for p in points:
                (mean, std), (old_mean, old_std) = self.policy(self.x[p]), old[p]
                distance = (old_std**2 + (old_mean - mean) ** 2) / (2 * std**2)
                total = total + (std.log() - old_std.log() + distance - 0.5).sum()
            return total / len(points)

        def damped_fisher(points: list) -> torch.Tensor:
            fisher = torch.autograd.functional.hessian(lambda flat: kl(flat, points), start)
            return fisher + args["cg_damping"] * torch.eye(len(start))

        start = torch.cat([self.w[k].detach().reshape(-1) for k in names])
        at = start.clone().requires_grad_()
        before = surrogate(at)
        (gradient,) = torch.autograd.grad(before, at)
        direction = torch.linalg.solve(damped_fisher(sample), gradient)
        curvature = direction @ damped_fisher(everything) @ direction
        full_step = torch.sqrt(2 * self.delta / curvature) * direction
        fraction, accepted, after, spent = 0.0, start, before, 0.0
        for k in range(args["backtrack_iters"]):
            trial = start + args["backtrack_coeff"] ** k * full_step
            reached, divergence = surrogate(trial), kl(trial, everything)
            if divergence <= self.delta and reached > before:
                fraction, accepted = args["backtrack_coeff"] ** k, trial
                after, spent = reached, divergence
                break
        with_policy(accepted.clone())
        stats |= {"trpo/step_fraction": [fraction], "losses/approx_kl": [float(spent)]}
        stats["losses/policy_loss"] = [-float(after)]
        critic = [k for k in self.w if k.startswith("critic")]
        for batch in (batch for epoch in epochs for batch in epoch):
            losses = [(self.value(self.x[p]) - self.returns[p]) ** 2 for p in batch]
            norm = self.adam(sum(losses) / len(losses), critic)
            stats.setdefault("losses/value_loss", []).append((sum(losses) / len(losses)).item())
            stats.setdefault("losses/grad_norm", []).append(norm)
        self.w["log_std"] = self.w["log_std"] - args["narrowing"] / args["iterations"]
        return stats
