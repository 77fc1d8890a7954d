"""Judge a policy by the paper's Monte-Carlo protocol: log diameters 0.3 ... 0.8 m, 100 trials each.

    python eval_crane.py                              # the shipped mPPO policy, Tables I and II
    python eval_crane.py runs/<run>                   # a policy of this repository's scripts
    python eval_crane.py runs/*__mine__*/             # several, and their mean on each task
    python eval_crane.py --policy scripted            # no learning, see scripted_crane.py
    python eval_crane.py --video lift.mp4             # or --viewer, in a window

A trial succeeds if the log is reached within 6 s, and is lifted, held by both jaws and gripped
within 0.3 m of its centre throughout the last 0.5 s of 9 s. Trial k of a diameter and a seed is
always the same trial. Intervals are 95 % Wilson score intervals.
"""

import csv
import json
import os
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium
import numpy as np
import torch
import tyro
from tqdm import tqdm

import crane_env
import crane_options
import crane_runs
import crane_trials
from crane_options import Range, Seed, Threads
from crane_policies import SHIPPED, FixedPolicy, OwnPolicy, is_missing, load_policy
from crane_task import CONDITIONS, D_MAX, D_MIN, DIAMETERS
from crane_trials import make_envs, monte_carlo_trials, run_trials
from crane_view import film, show, whole_file
from scripted_crane import DT, HYDRAULIC, IDEAL, ScriptedCrane

PAPER = {  # % of 100 trials per diameter in m
    "none": {0.3: 94, 0.4: 96, 0.5: 98, 0.6: 98, 0.7: 96, 0.8: 96},  # Table I
    "step": {0.3: 88, 0.4: 94, 0.5: 93, 0.6: 93, 0.7: 92, 0.8: 91},  # Table II
}
TITLES = {"none": "Table I, clean", "step": "Table II, pose noise", "episode": "Pose noise"}
CRANES = 200  # simulated at once
CARE_COLUMNS = [  # of the table of costs: heading, result, factor to the heading's unit, average
    ("peak [kN]", "ground_peak", 1e-3, np.median),
    ("impulse [kN s]", "ground_impulse", 1e-3, np.median),
    ("> 20 kN [s]", "ground_time", 1.0, np.mean),
    ("oil [l]", "litres", 1.0, np.median),
    ("energy [kJ]", "energy", 1e-3, np.median),
    ("work [kJ]", "work", 1e-3, np.median),
    ("up [s]", "time_up", 1.0, np.median),
    ("swing [rad]", "swing_peak", 1.0, np.median),
    ("log [m/s]", "log_speed", 1.0, np.median),
]


@dataclass
class Args:
    path: Annotated[tuple[Path, ...], tyro.conf.Positional] = (SHIPPED,)
    """a run's folder or a policy.pt, a model of Stable-Baselines3 (.zip), or an .onnx file. Several
    are judged one after the other, and a table compares them"""
    policy: str = "file"
    """file: the one at PATH; scripted: no learning; zero: never move; random: uniform actions;
    my_module:MyPolicy: your own. MyPolicy()(obs) gives actions (docs/compare.md)"""
    env_id: str | None = None
    """task to judge on; unset: the one the policy was trained on, or ForestryCrane-v0"""
    contact: Literal["primitive", "sdf"] | None = None
    """contact model of jaws and log; unset: the task's"""
    signed_yaw: bool = True
    """what --policy scripted observes: the signed angle to the log or the paper's Delta_psi"""
    pose_noise: Literal["none", "step", "episode"] | None = None
    """error of the observed log pose; unset: one table without and one with `step`"""
    trials: Annotated[int, Range(1, 10_000)] = 100
    """trials per log diameter"""
    diameters: tuple[Annotated[float, Range(D_MIN, D_MAX)], ...] = DIAMETERS
    """log diameters [m]"""
    seed: Seed = 10_000
    """seed of the trials; reported scores have seed 60000 (docs/compare.md)"""
    stochastic: bool = False
    """sample actions instead of taking the mean action"""
    env_threads: Threads = 0
    """physics threads, 0 for all cores"""
    csv: Path | None = None
    """write one row a trial to this file, also after Ctrl-C; docs/compare.md has its columns"""
    json: bool = False
    """print one JSON object per policy, each on a line, and nothing else: one table, without pose
    errors unless asked for. Its rates are shares in [0, 1]"""
    video: Path | None = None
    """film one trial per diameter into this .mp4 or .gif instead of judging"""
    trial: Annotated[int, Range(0, 9_999)] = 0
    """number of the filmed trial, and of the first in the window, as in the column `trial` of
    --csv. Give its --seed and --pose-noise too"""
    camera: Literal["overview", "side", "grapple"] = "overview"
    """camera of the film and of the window"""
    width: Annotated[int, Range(64, 1920)] = 640
    """width of the video [pixels], even; the format is 16:9"""
    viewer: bool = False
    """show one trial after another in a window instead of judging"""

    def __post_init__(self) -> None:
        crane_options.check(vars(self), Args)


def task_of(args: Args, trained_on: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """The task's id and options to judge on, with a warning where it is not the policy's own."""
    env_id = args.env_id or trained_on["env_id"]
    asked = f"--env-id {env_id}" if args.env_id else f"the policy's task {env_id}"
    try:
        on_crane = crane_trials.is_crane(env_id)
    except (gymnasium.error.Error, ModuleNotFoundError) as error:
        module = env_id.rpartition(":")[0]
        if isinstance(error, ModuleNotFoundError) and not is_missing(module, error):
            raise
        ours = ", ".join(name for name in gymnasium.registry if name.startswith("ForestryCrane"))
        raise SystemExit(f"{asked}: {error}; of this repository: {ours}") from None
    if not on_crane:
        raise SystemExit(f"{asked} is not the crane; name a task of CraneVectorEnv or a subclass")
    names = trained_on.keys() & crane_options.DEFAULTS.keys() - {"difficulty", "retry"}
    options = {} if args.env_id else {name: trained_on[name] for name in names}
    if "sensors" in trained_on:
        options["sensors"] = trained_on["sensors"]  # what its networks read
    options |= {"contact": args.contact} if args.contact else {}
    if args.policy == "scripted":
        options |= {"axes": "crane", "offset": "plus", "signed_yaw": args.signed_yaw}
    elif args.env_id and "sensors" in trained_on:
        warn_of_differences(env_id, trained_on)
    return env_id, options


def warn_of_differences(env_id: str, trained_on: dict[str, Any]) -> None:
    """Say what a policy knows otherwise than the task has it."""
    if trained_on["env_id"].split(":")[-1] != env_id.split(":")[-1]:
        print(f"the policy was trained on {trained_on['env_id']}", file=sys.stderr)
    registered = one_crane(env_id, {}).options
    for name in ("signed_yaw", "axes", "offset", "frame_skip", "speed", "sensors"):
        ours, theirs = registered[name], trained_on[name]
        if ours != theirs:
            print(f"the policy knows {name}={theirs!r}; {env_id} has {ours!r}", file=sys.stderr)


def judge(policy: Any, env_id: str, options: dict, args: Args) -> Iterator[dict]:
    """Yields a record of each trial: diameter (m), trial (its number), success, failure,
    time_to_reach (s), centre_miss (m), and the costs `crane_env.CARE`.
    """
    diameters, seeds = monte_carlo_trials(args.seed, args.trials, args.diameters)
    with tqdm(total=len(seeds), unit="trial", leave=False) as bar:
        for start in range(0, len(seeds), CRANES):
            chunk = slice(start, start + CRANES)
            sizes = diameters[chunk]
            envs = make_envs(env_id, len(sizes), args.env_threads, diameter=sizes, **options)
            results = run_trials(policy, envs, seeds[chunk], not args.stochastic)
            envs.close()
            for i, diameter in enumerate(sizes):
                end = {name: values[i].item() for name, values in results.items()}
                trial = {"diameter": float(diameter), "trial": (start + i) % args.trials}
                yield trial | trial_record(end)
            bar.update(len(sizes))


def trial_record(end: dict) -> dict:
    """What is reported of a trial's end. Its failure is the first rule or condition it broke."""
    failure = end["termination"]
    if failure == "time_limit":
        failure = next((name for name in CONDITIONS if end[name]), "")
    kept = ("success", "time_to_reach", "centre_miss", *crane_env.CARE)
    return {name: end[name] for name in kept} | {"failure": failure}


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """95 % score interval of a success probability (Wilson, 1927)."""
    z, p = 1.959964, successes / trials
    centre = (p + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * np.sqrt(p * (1 - p) / trials + z**2 / (4 * trials**2))
    return max(0.0, centre - half), min(1.0, centre + half)


def summarize(records: list[dict]) -> list[dict]:
    """One cell a diameter."""
    cells = []
    for d in sorted({r["diameter"] for r in records}):
        trials = [r for r in records if r["diameter"] == d]
        successes, gentle = (sum(r[score] for r in trials) for score in ("success", "gentle"))
        cells.append(
            {
                "diameter": d,
                "trials": len(trials),
                "successes": successes,
                "success_rate": successes / len(trials),
                "interval": wilson_interval(successes, len(trials)),
                "gentle_rate": gentle / len(trials),
                "gentle_interval": wilson_interval(gentle, len(trials)),
                "failures": dict(Counter(r["failure"] for r in trials if not r["success"])),
            }
        )
    return cells


def print_table(records: list[dict], cells: list[dict], paper: dict, title: str) -> None:
    """Success by diameter beside the paper's % by diameter, if it has any."""
    print(f"\n{title}")
    print("| d [m] | paper % | success % | 95 % interval | reach [s] | miss [m] | failures |")
    print("|-------|---------|-----------|---------------|-----------|----------|----------|")
    for cell in cells:
        good = [r for r in records if r["success"] and r["diameter"] == cell["diameter"]]
        published = paper.get(cell["diameter"], "")
        reach = f"{np.mean([r['time_to_reach'] for r in good]):.2f}" if good else ""
        miss = f"{np.mean([r['centre_miss'] for r in good]):.3f}" if good else ""
        low, high = (100 * bound for bound in cell["interval"])
        failures = ", ".join(f"{name} {count}" for name, count in cell["failures"].items())
        print(
            f"| {cell['diameter']:<5} | {published:<7} | {100 * cell['success_rate']:<9.1f} "
            f"| {low:5.1f} - {high:5.1f} | {reach:<9} | {miss:<8} | {failures} |"
        )
    wins, trials = sum(c["successes"] for c in cells), sum(c["trials"] for c in cells)
    low, high = (100 * bound for bound in wilson_interval(wins, trials))
    published = [paper.get(cell["diameter"]) for cell in cells]
    mean = "" if None in published else f"{np.mean(published):.1f}"
    print(f"| mean  | {mean:<7} | {100 * wins / trials:<9.1f} | {low:5.1f} - {high:5.1f} | | | |")
    print("Reach is the mean time until d_combine < 0.35 m. Miss is the mean distance from grip to")
    print("log centre, along the log. Both are means over the successes.")
    print_care(records, cells)


def mean_costs(trials: list[dict]) -> dict[str, float]:
    """Average of each of CARE_COLUMNS, by heading, NaN if there is none.

    The force on the ground is that of all trials. All else is of successes: a trial that ends
    early would look cheap.
    """
    costs = {}
    for head, key, factor, average in CARE_COLUMNS:
        values = [r[key] for r in trials if key.startswith("ground") or r["success"]]
        costs[head] = factor * average(values).item() if values else np.nan
    return costs


def print_care(records: list[dict], cells: list[dict]) -> None:
    """What the trials cost, one row a diameter and one for all."""
    heads = [head for head, *_ in CARE_COLUMNS]
    print(f"\n| d [m] | gentle % | 95 % interval | {' | '.join(heads)} |")
    print(f"|-------|----------|---------------|{'|'.join('-' * (len(h) + 2) for h in heads)}|")
    rows = [([r for r in records if r["diameter"] == c["diameter"]], c["diameter"]) for c in cells]
    for trials, name in [*rows, (records, "all")]:
        gentle = sum(r["gentle"] for r in trials)
        low, high = (100 * bound for bound in wilson_interval(gentle, len(trials)))
        line = [f"{name:<5}", f"{100 * gentle / len(trials):<8.1f}", f"{low:5.1f} - {high:5.1f}"]
        for head, cost in mean_costs(trials).items():
            number = "" if np.isnan(cost) else f"{cost:.4g}"
            line.append(f"{number:<{len(head)}}")
        print(f"| {' | '.join(line)} |")
    print("Gentle is success without more than 20 kN of the crane on the ground. Peak and impulse")
    print("are of that force. Work is the drives' |force x speed|. Up is the time until the log is")
    print("safely up. Log is the log's speed at the end. Gentle and > 20 kN are means over all")
    print("trials. Peak and impulse are medians over all trials. All others are medians over the")
    print("successes.")


def print_json(records: list[dict], cells: list[dict], where: dict) -> None:
    """One object: where it was judged, what judged it, the cells, their means and costs."""
    answer = where | {"trials": len(records), "cells": cells}
    for score in ("success", "gentle"):
        count = sum(r[score] for r in records)
        answer[f"mean_{score}_rate"] = count / len(records)
        answer[f"mean_{score}_interval"] = wilson_interval(count, len(records))
    costs = mean_costs(records)  # JSON has no NaN
    answer["costs"] = {name: None if np.isnan(x) else x for name, x in costs.items()}
    answer["revision"] = crane_env.REVISION
    answer["versions"] = {name: version(name) for name in ("mujoco", "numpy", "torch")}
    print(json.dumps(answer), flush=True)


def write_csv(path: Path, records: list[dict]) -> None:
    with whole_file(path) as whole, open(whole, "w", newline="") as file:
        writer = csv.DictWriter(file, records[0].keys())
        writer.writeheader()
        writer.writerows(records)


def check_combinations(args: Args) -> None:
    """SystemExit that names arguments that do not fit together."""
    known = ("file", "scripted", "zero", "random")
    from_file, wrong_use = args.policy == "file", "goes with --policy file only"
    for wrong, message in [
        (
            args.policy not in known and not re.fullmatch(r"\w+(\.\w+)*:\w+", args.policy),
            f"--policy must be {', '.join(known)} or my_module:MyPolicy, got {args.policy!r}",
        ),
        (not args.diameters, "--diameters needs at least one number"),
        (len({*args.diameters}) < len(args.diameters), "--diameters names a diameter twice"),
        (not from_file and args.path != (SHIPPED,), f"PATH {wrong_use}"),
        (not args.path, "PATH is empty; name a policy"),
        (len({*args.path}) < len(args.path), "PATH names a policy twice"),
        (
            len(args.path) > 1 and (args.csv or args.video or args.viewer),
            "--csv, --video and --viewer take one policy",
        ),
        (not from_file and args.stochastic, f"--stochastic {wrong_use}"),
        (
            args.stochastic and any(path.suffix == ".onnx" for path in args.path),
            "--stochastic: an .onnx file has the mean action only; judge its policy.pt",
        ),
        (
            args.policy != "scripted" and not args.signed_yaw,
            "--no-signed-yaw is for --policy scripted; a trained policy brings its own",
        ),
        (args.video and args.viewer, "choose --video or --viewer"),
        (
            (args.video or args.viewer) and (args.json or args.csv),
            "--video and --viewer judge nothing: --json and --csv have nothing to write",
        ),
        (
            (args.video or args.viewer) and args.trials != Args.trials,
            "--video and --viewer show single trials; drop --trials",
        ),
        (
            (args.trial or args.camera != Args.camera) and not (args.video or args.viewer),
            "--trial and --camera are for --video and --viewer",
        ),
        (args.width != Args.width and not args.video, "--width is for --video"),
        (
            args.video and args.video.suffix.lower() not in (".mp4", ".gif"),
            f"--video: {args.video} must end in .mp4 or .gif",
        ),
        (args.width % 2, f"--width must be even, got {args.width}"),
        (
            args.viewer and crane_env.HEADLESS,
            "--viewer needs a display, and DISPLAY is not set; use --video lift.mp4",
        ),
    ]:
        if wrong:
            raise SystemExit(message)


def check_files(args: Args) -> None:
    """SystemExit that names a file that cannot be written."""
    for path in (args.video, args.csv):
        if path and not path.parent.is_dir():
            raise SystemExit(f"no folder {path.parent}; make it first")
        if path and path.exists() and not path.is_file():
            raise SystemExit(f"{path} is no file; name a file")
        if path:  # a full or read-only disk is better met before the work
            with tempfile.TemporaryFile(dir=path.parent) as probe:
                probe.write(b"x")


def print_comparison(tables: dict[tuple[str, str, str], list[dict]]) -> None:
    """The scores by policy, task and pose noise. Several policies of a task have a mean, too."""
    print("\n| task | pose noise | success % | gentle % | policy |")
    print("|------|------------|-----------|----------|--------|")
    for task, noise in dict.fromkeys(key[1:] for key in tables):
        scores = {
            policy: [100 * np.mean([r[score] for r in records]) for score in ("success", "gentle")]
            for (policy, *of), records in tables.items()
            if of == [task, noise]
        }
        if len(scores) > 1:
            scores[f"mean of {len(scores)}"] = np.mean([*scores.values()], axis=0)
        for policy, (success, gentle) in scores.items():
            print(f"| {task} | {noise:<10} | {success:<9.1f} | {gentle:<8.1f} | {policy} |")


def main() -> None:
    crane_runs.one_line_errors()
    sys.path.insert(0, os.getcwd())  # where the user's policies, tasks and edited scripts are
    args = tyro.cli(Args, description=__doc__.partition("\n\n")[0])
    check_combinations(args)
    check_files(args)
    torch.set_num_threads(1)  # the batches are too small for more
    policies = [policy_of(path, args) for path in args.path]  # all errors before the first trial
    tables = {}
    for policy, name, source, env_id, options in policies:
        if args.video or args.viewer:
            torch.manual_seed(args.seed)
            options["pose_noise"] = args.pose_noise or "none"
            (film if args.video else show)(policy, name, env_id, options, args)
        else:
            tables |= report(policy, name, source, env_id, options, args)
    if tables and not args.json:
        print_comparison(tables)
    print(end="", flush=True)  # a closed pipe is met here and not when Python exits


def policy_of(path: Path, args: Args) -> tuple[Any, str, str, str, dict[str, Any]]:
    """A policy, its name, where it comes from, and the id and options of the task to judge it on.

    Without --policy file, path is ignored.
    """
    trained_on, name, source = {"env_id": "ForestryCrane-v0"}, args.policy, args.policy
    if args.policy == "file":
        policy, trained_on, name = load_policy(path)
        source = str(path)
    elif args.policy in ("zero", "random"):
        policy = FixedPolicy(args.policy)
    elif args.policy != "scripted":
        policy, name = OwnPolicy(args.policy), "mine"
    env_id, options = task_of(args, trained_on)
    options |= {"difficulty": 1.0, "retry": 0.0}  # all trials are of the full task
    crane = one_crane(env_id, options)
    if args.policy == "scripted":
        policy = scripted_policy(crane)
    observed, wanted = crane.single_observation_space, getattr(policy, "observation_space", None)
    if wanted is not None and wanted.shape != observed.shape:  # of Stable-Baselines3
        raise SystemExit(f"{source} observes {wanted.shape}; {env_id} gives {observed.shape}")
    return policy, name, source, env_id, options


def one_crane(env_id: str, options: dict[str, Any]) -> crane_env.CraneVectorEnv:
    """A closed crane, to look at its options and spaces."""
    envs = make_envs(env_id, 1, **options)
    envs.close()
    return envs.unwrapped


def scripted_policy(crane: crane_env.CraneVectorEnv) -> ScriptedCrane:
    """The scripted crane with its settings for these drives. SystemExit if it cannot drive them."""
    if crane.dt != DT:
        raise SystemExit(f"the scripted crane decides every {DT} s, not every {crane.dt} s")
    if crane.options["speed"] != "real":
        raise SystemExit("the scripted crane knows the speed limits of the real machine only")
    settings = HYDRAULIC if crane.options["actuators"] == "hydraulic" else IDEAL
    return ScriptedCrane(crane.options["signed_yaw"], settings)


def report(
    policy: Any, name: str, source: str, env_id: str, options: dict[str, Any], args: Args
) -> dict[tuple[str, str, str], list[dict]]:
    """Judge a policy and print its tables. Returns the records of its trials, by source, task and
    pose noise.
    """
    given, registered = one_crane(env_id, options).options, one_crane(env_id, {}).options
    # the title has two of these, the others change no trial
    unimportant = {"contact", "difficulty", "pose_noise", "retry", "reward"}
    changed = {
        option: value
        for option, value in given.items()
        if value != registered[option] and option not in unimportant
    }
    papers_task = env_id.split(":")[-1] in ("ForestryCrane-v0", "ForestryCranePaper-v0")
    papers_task &= not changed
    contact, all_records, tables = given["contact"], [], {}
    difference = "".join(f", {option}={value!r}" for option, value in changed.items())
    task = env_id + difference + (", sdf contact" if contact == "sdf" else "")
    noises = [args.pose_noise or "none"] if args.pose_noise or args.json else ["none", "step"]
    for noise in noises:
        torch.manual_seed(args.seed)
        options["pose_noise"] = noise
        tables[source, task, noise] = records = []
        try:
            for record in judge(policy, env_id, options, args):
                records.append(record)
        finally:  # Ctrl-C keeps what is judged
            all_records += [{"pose_noise": noise, "seed": args.seed, **r} for r in records]
            if args.csv and all_records:
                write_csv(args.csv, all_records)
        cells = summarize(records)
        if args.json:
            where = {"policy": source, "env_id": env_id, "contact": contact, "pose_noise": noise}
            print_json(records, cells, where | {"seed": args.seed, "changed": changed})
            continue
        what = f"{name} ({source}) on {env_id}, {contact} contact, pose noise {noise}{difference}"
        paper = PAPER.get(noise, {}) if papers_task else {}
        title = TITLES[noise] if papers_task else "Trials"
        print_table(records, cells, paper, f"{title}: {what}, seed {args.seed}")
    return tables


if __name__ == "__main__":
    main()
