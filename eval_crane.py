"""Evaluate policies by the paper's protocol: log diameters 0.3 ... 0.8 m, 100 trials of each.

    python eval_crane.py                                # the shipped mPPO policy beside Table I
    python eval_crane.py --env.pose-noise step          # Table II
    python eval_crane.py runs/<run> runs/<another run>  # policies of this repository's scripts
    python eval_crane.py scripted                       # no learning, see scripted_crane.py
    python eval_crane.py my_module:MyPolicy             # your own, see docs/compare.md
    python eval_crane.py --video lift.mp4               # film one trial per diameter
    python eval_crane.py --viewer                       # watch, or drive, in a window

A trial of lifting succeeds if the log is reached within 6 s, and is lifted, held by both jaws and
gripped within 0.3 m of its centre throughout the last 0.5 s of 9 s. Trial k of a diameter and a
seed is always the same trial. A run's folder holds the script that trained it, and that code runs
here.
"""

import csv
import importlib
import json
import os
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, field
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro
from numpy import ndarray as Array
from pydantic import Field, ValidationError
from pydantic.dataclasses import dataclass
from tqdm import tqdm

from crane_env import D_MAX, D_MIN, STRICT, Options
from crane_utils import film, runs, trials
from crane_utils.metrics import Metrics
from crane_utils.trials import DIAMETERS, EVAL_SEED

SHIPPED = str(Path(__file__).parent / "assets" / "policies" / "mppo_beta_crane.pt")
PAPER = {  # % of 100 trials per diameter in m
    "none": {0.3: 94, 0.4: 96, 0.5: 98, 0.6: 98, 0.7: 96, 0.8: 96},  # Table I
    "step": {0.3: 88, 0.4: 94, 0.5: 93, 0.6: 93, 0.7: 92, 0.8: 91},  # Table II
}
CRANES = 200  # simulated at once
AVERAGES = [  # columns of the table: heading, value, factor to the heading's unit, average
    ("reach [s]", "time_to_reach", 1.0, np.mean),
    ("miss [m]", "centre_miss", 1.0, np.mean),
    ("up [s]", "time_up", 1.0, np.median),
    ("oil [l]", "litres", 1.0, np.median),
    ("energy [kJ]", "energy", 1e-3, np.median),
    ("swing [rad]", "swing_peak", 1.0, np.median),
]
KEPT = ["success", "gentle", "failure", "ground_peak", *(key for _, key, _, _ in AVERAGES)]


@dataclass(config=STRICT)
class Args:
    policies: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """run's folders or policy.pt files; scripted, zero or random; my_module:MyPolicy; none: the
    shipped mPPO policy"""
    env_id: str | None = None
    """task to evaluate on, with its own options; unset: the policy's own, or ForestryCrane-v0"""
    trials: Annotated[int, Field(ge=1)] = 100
    """trials per log diameter"""
    diameters: tuple[Annotated[float, Field(ge=D_MIN, le=D_MAX)], ...] = DIAMETERS
    """log diameters [m]"""
    seed: Annotated[int, Field(ge=0)] = EVAL_SEED
    """seed of the trials; the leaderboard has 60000 (docs/compare.md)"""
    stochastic: bool = False
    """sample actions instead of taking the mean action"""
    threads: Annotated[int, Field(ge=0)] = 0
    """CPU threads of the physics, 0 for all cores"""
    csv: Path | None = None
    """write one row a trial to this file"""
    json: bool = False
    """print one JSON object per policy, each on a line, and no tables"""
    video: Path | None = None
    """film one trial per diameter into this .mp4 or .gif"""
    viewer: bool = False
    """show one trial after another in a window, of the first diameter"""
    trial: Annotated[int, Field(ge=0)] = 0
    """number of the filmed or first shown trial, as in the column `trial` of --csv"""
    camera: Literal["overview", "side", "grapple"] = "overview"
    """camera of the film and of the window"""
    width: Annotated[int, Field(ge=64, le=1920, multiple_of=2)] = 640
    """width of the film [pixels]; the format is 16:9"""


@dataclass(config=STRICT)
class TaskArgs:
    env: Options = field(default_factory=Options)


class Zero:
    """Never moves."""

    def predict(self, obs: Array, state: None, deterministic: bool = True) -> tuple[Array, None]:
        return np.zeros((len(obs), 6)), None


class Random:
    """Uniform actions, from torch's generator."""

    def predict(self, obs: Array, state: None, deterministic: bool = True) -> tuple[Array, None]:
        return 2 * torch.rand(len(obs), 6).numpy() - 1, None


BUILT_IN = {
    "scripted": "scripted_crane:ScriptedCrane",
    "zero": "eval_crane:Zero",
    "random": "eval_crane:Random",
}


LEGEND = """\
Gentle: success, and `ground_peak` at most 20 kN. Peak: its median in all trials. The other
columns are of the successes: means of reach (until the log is reached) and miss (from grapple to
log centre at the end), medians of the others. Up: when all conditions of success had held for
0.5 s."""
PAPERS = " The paper's rule is weaker. Its training took 500 million physics steps."


def load_policy(name: str, env_id: str | None = None) -> tuple[Any, dict[str, Any], str]:
    """A policy, the task it was trained on or written for, and a name for the tables."""
    if name == "scripted" and env_id:  # a task may name a scripted crane of its own
        name = getattr(trials.crane_class(env_id), "SCRIPTED", name)
    if name in BUILT_IN or (":" in name and not Path(name).exists()):
        module, _, attribute = BUILT_IN.get(name, name).partition(":")
        made = getattr(importlib.import_module(module), attribute)
        if not hasattr(made, "predict"):
            raise SystemExit(f"{name} must be a class with predict (docs/compare.md)")
        policy = made()
        return policy, getattr(policy, "task", {}), name
    return runs.load_policy(Path(name))


def task_of(policy: Any, trained: dict, args: Args, flags: list[str]) -> tuple[str, Options]:
    """The task's id and options: those of the training, but for --env-id and the flags --env.*."""
    env_id = args.env_id or trained.get("env_id", "ForestryCrane-v0")
    cranes = trials.crane_class(env_id)
    if cranes is None:
        raise SystemExit(f"{env_id} is not the crane: its vector_entry_point is no CraneVectorEnv")
    default = trials.task_options(env_id)
    if "options" in trained and not args.env_id:
        default = cranes.Options(**asdict(default) | trained["options"])
    config = (tyro.conf.FlagConversionOff,)
    options = tyro.cli(TaskArgs, args=flags, default=TaskArgs(env=default), config=config).env
    differs = {
        name: f"{value!r}, not {getattr(options, name, None)!r}"
        for name, value in trained.get("options", {}).items()
        if value != getattr(options, name, None)
    }
    if trained.get("env_id", env_id) != env_id:
        differs["the task"] = f"{trained['env_id']}, not {env_id}"
    elif trained.get("revision", cranes.REVISION) != cranes.REVISION:
        differs["revision"] = f"{trained['revision']}, not {cranes.REVISION}"
    for name, values in differs.items():
        print(f"the policy was made for {name} {values}", file=sys.stderr)
    envs = trials.make_envs(env_id, 1, 1, asdict(options))
    observed, acted = envs.single_observation_space, envs.single_action_space
    has = describe(observed.shape[0], acted.low, acted.high)
    if hasattr(policy, "obs_mean"):
        needs = describe(len(policy.obs_mean), policy.action_low, policy.action_high)
        if needs != has:
            raise SystemExit(f"the policy has {needs}, and {env_id} has {has}")
    return env_id, options


def describe(observations: int, low: Any, high: Any) -> str:
    return f"{observations} observations and actions from {low.tolist()} to {high.tolist()}"


def play(policy: Any, env_id: str, options: Options, args: Args) -> Iterator[dict]:
    """Yields a row a trial: diameter (m), trial (its number), and KEPT."""
    diameters, seeds = trials.monte_carlo_trials(args.seed, args.trials, args.diameters)
    with tqdm(total=len(seeds), unit="trial", leave=False, disable=args.json) as bar:
        for start in range(0, len(seeds), CRANES):
            d = diameters[start : start + CRANES]
            envs = trials.make_envs(env_id, len(d), args.threads, asdict(options), diameter=d)
            metrics = Metrics(envs.unwrapped)
            batch = seeds[start : start + CRANES]
            results = trials.run_trials(policy, envs, batch, not args.stochastic, metrics)
            envs.close()
            for i in range(len(d)):
                row = {"diameter": d[i].item(), "trial": (start + i) % args.trials}
                yield row | {name: results[name][i].item() for name in KEPT}
            bar.update(len(d))


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """95 % score interval of a success probability (Wilson, 1927)."""
    z, p = 1.959964, successes / trials
    centre = (p + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * np.sqrt(p * (1 - p) / trials + z**2 / (4 * trials**2))
    return max(0.0, centre - half), min(1.0, centre + half)


def summarize(rows: list[dict], published: dict[float, float]) -> dict[str, Any]:
    """A line of the table. Averages are of successes: a trial that ends early would look cheap."""
    n, wins = len(rows), [row for row in rows if row["success"]]
    low, high = wilson_interval(len(wins), n)
    paper = [published.get(d) for d in sorted({row["diameter"] for row in rows})]
    line = {
        "trials": n,
        **({} if None in paper else {"paper %": round(float(np.mean(paper)), 1)}),
        "success %": 100 * len(wins) / n,
        "95 % interval": f"{100 * low:.1f}-{100 * high:.1f}",
        "gentle %": 100 * sum(row["gentle"] for row in rows) / n,
        "peak [kN]": 1e-3 * np.median([row["ground_peak"] for row in rows]).item(),
    }
    for head, key, factor, average in AVERAGES:
        line[head] = factor * average([row[key] for row in wins]).item() if wins else ""
    failures = Counter(row["failure"] for row in rows if not row["success"])
    return line | {"failures": ", ".join(f"{name} {k}" for name, k in failures.most_common())}


def print_table(lines: dict[str, dict]) -> None:
    """A Markdown table of named lines."""
    heads = [*dict.fromkeys(head for line in lines.values() for head in line)]
    cells = [[name, *(line.get(head, "") for head in heads)] for name, line in lines.items()]
    heads = ["", *heads]
    cells = [[f"{c:.4g}" if isinstance(c, float) else str(c) for c in row] for row in cells]
    widths = [max(map(len, column)) for column in zip(heads, *cells)]
    for row in [heads, ["-" * w for w in widths], *cells]:
        print("| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths)) + " |")


def main() -> None:
    sys.path.insert(0, os.getcwd())  # where the user's policies and tasks are
    summary = __doc__.partition("\n\n")[0]
    args, flags = tyro.cli(
        Args,
        description=summary + " Behind the policies --env.NAME changes an option of the task.",
        return_unknown_args=True,
    )
    if (args.csv or args.json) and (args.video or args.viewer):
        raise SystemExit("--csv and --json are for evaluations: leave out --video and --viewer")
    if args.video and len(args.policies) > 1:
        raise SystemExit("--video films one policy")
    torch.set_num_threads(1)  # the batches are too small for more
    evaluated = []
    for name in args.policies or (SHIPPED,):  # all errors before the first trial
        try:
            policy, trained, label = load_policy(name, args.env_id)
            evaluated.append((name, label, policy, *task_of(policy, trained, args, flags)))
        except ValidationError as error:
            raise SystemExit(f"{name} does not fit the code here: {error}") from None
    file = args.csv and open(args.csv, "w", encoding="utf-8", newline="")
    overall = {}
    for name, label, policy, env_id, options in evaluated:
        torch.manual_seed(args.seed)
        scene = {"seed": args.seed, "trial": args.trial, "camera": args.camera}
        scene["deterministic"] = not args.stochastic
        if args.viewer:
            film.window(policy, label, env_id, asdict(options), args.diameters[0], **scene)
            continue
        if args.video:
            scene["width"] = args.width
            film.film(policy, label, env_id, asdict(options), args.video, args.diameters, **scene)
            continue
        rows = []
        for row in play(policy, env_id, options, args):
            rows.append({"policy": name, "env_id": env_id, **row})
            if file and not file.tell():
                csv.DictWriter(file, rows[-1]).writeheader()
            if file:
                csv.DictWriter(file, rows[-1]).writerow(rows[-1])
        task = env_id.rpartition(":")[2].partition("-")[0]
        papers_task = task in ("ForestryCrane", "ForestryCranePaper")
        published = PAPER.get(options.pose_noise, {}) if papers_task else {}
        table = {
            f"{d} m": summarize([row for row in rows if row["diameter"] == d], published)
            for d in args.diameters
        }
        table["all"] = overall[f"{label} ({name})"] = summarize(rows, published)
        if args.json:
            answer = {"policy": name, "env_id": env_id, "options": asdict(options)}
            answer |= {"revision": trials.crane_class(env_id).REVISION, "seed": args.seed}
            answer["table"] = table
            answer["versions"] = {package: version(package) for package in ("mujoco", "torch")}
            print(json.dumps(answer), flush=True)
            continue
        registered = asdict(trials.task_options(env_id))
        changed = [f"{k}={v}" for k, v in asdict(options).items() if v != registered[k]]
        print(f"\n{label} ({name}) on {', '.join([env_id, *changed])}, seed {args.seed}")
        print_table(table)
    if overall and not args.json:
        print(LEGEND + (PAPERS if any("paper %" in line for line in overall.values()) else ""))
        if len(overall) > 1:
            print()
            print_table(overall)


if __name__ == "__main__":
    main()
