"""Judge a policy by the paper's Monte-Carlo protocol: log diameters 0.3 ... 0.8 m, 100 trials each.

    python eval_crane.py                              # the shipped mPPO policy, Tables I and II
    python eval_crane.py runs/<run>/policy.pt         # any policy of this repository's scripts
    python eval_crane.py --policy scripted            # without learning, see scripted_crane.py
    python eval_crane.py --policy random --trials 20
    python eval_crane.py --video lift.mp4             # or --viewer, in a window

A trial succeeds as `grip_conditions` and `success_conditions` of crane_env.py say: log reached
within 6 s, and through the last 0.5 s of 9 s lifted, held by both jaws, and gripped within 0.3 m of
its centre. Trial k of a diameter and seed is always the same trial. Intervals are 95 % Wilson score
intervals.
"""

import csv
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import imageio
import numpy as np
import torch
import tyro
from tqdm import tqdm

import crane_env
import mppo_beta_crane
import ppo_crane
import recurrent_ppo_crane
import trpo_crane
from crane_env import CraneVectorEnv, monte_carlo_trials
from scripted_crane import ScriptedCrane

SCRIPTS = (mppo_beta_crane, ppo_crane, trpo_crane, recurrent_ppo_crane)
ALGORITHMS = {script.ALGORITHM: script for script in SCRIPTS}
SHIPPED = Path(__file__).parent / "assets" / "policies" / "mppo_beta_crane.pt"
PAPER = {  # % of 100 trials per diameter in m
    "none": {0.3: 94, 0.4: 96, 0.5: 98, 0.6: 98, 0.7: 96, 0.8: 96},  # Table I
    "step": {0.3: 88, 0.4: 94, 0.5: 93, 0.6: 93, 0.7: 92, 0.8: 91},  # Table II
}
CRANES = 600  # simulated at once
Act = Callable[[np.ndarray], np.ndarray]  # observations (N, 18) to actions (N, 6)


@dataclass
class Args:
    path: Annotated[Path, tyro.conf.Positional] = SHIPPED
    """policy.pt of a run"""
    policy: Literal["file", "scripted", "zero", "random"] = "file"
    """file: the one at PATH; scripted: no learning; zero: never move; random: uniform actions"""
    signed_yaw: bool = True
    """scripted observes the signed angle to the log, not the paper's Delta_psi"""
    trials: int = 100
    """trials per log diameter"""
    diameters: tuple[float, ...] = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
    """log diameters [m]"""
    seed: int = 40_000
    """seed of the trials"""
    contact: Literal["primitive", "sdf"] = "primitive"
    """contact model of jaws and log"""
    pose_noise: Literal["none", "step", "episode"] | None = None
    """error of the observed log pose; unset: the table without and the one with `step`"""
    stochastic: bool = False
    """sample actions instead of taking the mean action"""
    env_threads: int = 0
    """physics threads, 0 for all cores"""
    csv: Path | None = None
    """write one row a trial to this file"""
    json: bool = False
    """print one JSON object and nothing else (one table, noise none unless said)"""
    video: Path | None = None
    """film one trial per diameter into this .mp4 or .gif instead of evaluating"""
    camera: Literal["overview", "side", "grapple"] = "overview"
    """of the video"""
    width: int = 1280
    """of the video [pixels], 16:9, at most 1920"""
    viewer: bool = False
    """show one trial after another in a window instead of evaluating"""


def load_policy(path: Path, stochastic: bool) -> tuple[Callable[[], Act], dict, str]:
    """Maker of an acting function with fresh memory, environment arguments, algorithm name."""
    path = path / "policy.pt" if path.is_dir() else path
    if not path.is_file():
        raise SystemExit(f"no file {path}; train one first, or give the path of a run's policy.pt")
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
        algorithm = str(saved["algorithm"])
        args = {"axes": "world"} | dict(saved["args"])  # as they were before one could choose
        weights = saved["weights"]
    except Exception:
        raise SystemExit(f"{path} is no policy.pt of this repository") from None
    if algorithm not in ALGORITHMS:
        raise SystemExit(f"{path}: unknown algorithm {algorithm!r}; known: {', '.join(ALGORITHMS)}")
    module = ALGORITHMS[algorithm]
    known = {field.name for field in fields(module.Args)}
    if saved.get("task") != crane_env.REVISION or not args.keys() <= known:
        print(
            f"{path} is of another revision of this repository; judged by today's", file=sys.stderr
        )
    try:
        args = module.Args(**{key: value for key, value in args.items() if key in known})
        on_crane = module.is_crane(args)
        agent = module.Agent(18, np.full(6, -1.0), np.full(6, 1.0), args)
        if on_crane:
            # policy.pt has no critic, and acting needs none
            agent.load_state_dict({**agent.critic.state_dict(prefix="critic."), **weights})
    except Exception as error:  # whatever a damaged file may raise
        reason = (str(error).splitlines() or [repr(error)])[-1].strip()
        raise SystemExit(f"{path} does not fit a {algorithm} policy: {reason}") from None
    if not on_crane:
        raise SystemExit(f"{path} was trained on {args.env_id}, not on the crane")

    def make_act() -> Act:
        state = None

        @torch.no_grad()
        def act(obs: np.ndarray) -> np.ndarray:
            nonlocal state
            obs = torch.as_tensor(obs)
            if not hasattr(agent, "initial_state"):
                return agent.predict(obs, not stochastic).numpy()
            state = agent.initial_state(len(obs)) if state is None else state
            actions, state = agent.predict(obs, state, not stochastic)
            return actions.numpy()

        return act

    return make_act, module.crane_kwargs(args), algorithm


def fixed_policy(
    kind: str, seed: int, signed_yaw: bool = True
) -> tuple[Callable[[], Act], dict, str]:
    """`load_policy` for policies without weights."""

    if kind == "scripted":
        return lambda: ScriptedCrane(signed_yaw), {"signed_yaw": signed_yaw}, kind
    rng = np.random.default_rng(seed)

    def make_act() -> Act:
        if kind == "zero":
            return lambda obs: np.zeros((len(obs), 6))
        return lambda obs: rng.uniform(-1, 1, (len(obs), 6))

    return make_act, {}, kind


def run_trials(make_act: Callable[[], Act], kwargs: dict, diameters, seeds) -> list[dict]:
    """One record a trial: diameter, success, failure, time_to_reach (s), centre_miss (m)."""
    records = []
    chunks = [slice(i, i + CRANES) for i in range(0, len(seeds), CRANES)]
    bar = tqdm(total=0, desc=f"{len(seeds)} trials", leave=False)
    for chunk in chunks:
        envs = CraneVectorEnv(len(seeds[chunk]), diameter=diameters[chunk], **kwargs)
        obs, _ = envs.reset(seed=seeds[chunk])
        act, results = make_act(), [None] * envs.num_envs
        bar.total = len(chunks) * envs.max_decisions
        for _ in range(envs.max_decisions):
            obs, _, terminated, truncated, info = envs.advance(act(obs))
            for i in np.flatnonzero(terminated | truncated):
                if results[i] is None:  # the first end of this crane's trial
                    results[i] = {key: value[i] for key, value in info.items()}
            bar.update()
        records += [trial_record(d, result) for d, result in zip(diameters[chunk], results)]
        envs.close()
    bar.close()
    return records


def trial_record(diameter: float, info: dict) -> dict:
    failure = str(info["termination"])
    if failure == "time_limit":
        conditions = ["not_reached", "not_lifted", "not_held", "off_centre"]
        failure = next((name for name in conditions if info[name]), "")
    return {
        "diameter": float(diameter),
        "success": bool(info["success"]),
        "failure": failure,
        "time_to_reach": float(info["time_to_reach"]),
        "centre_miss": float(info["centre_miss"]),
    }


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
        successes = sum(r["success"] for r in trials)
        cells.append(
            {
                "diameter": d,
                "trials": len(trials),
                "successes": successes,
                "success_rate": successes / len(trials),
                "interval": wilson_interval(successes, len(trials)),
                "failures": dict(Counter(r["failure"] for r in trials if not r["success"])),
            }
        )
    return cells


def print_table(records: list[dict], cells: list[dict], noise: str, title: str) -> None:
    print(f"\n{title}")
    print("| d [m] | paper % | ours % | 95 % interval | reach [s] | miss [m] | failures |")
    print("|-------|---------|--------|---------------|-----------|----------|----------|")
    for cell in cells:
        good = [r for r in records if r["success"] and r["diameter"] == cell["diameter"]]
        paper = PAPER.get(noise, {}).get(cell["diameter"], "")
        reach = f"{np.mean([r['time_to_reach'] for r in good]):.2f}" if good else ""
        miss = f"{np.mean([r['centre_miss'] for r in good]):.3f}" if good else ""
        low, high = (100 * bound for bound in cell["interval"])
        failures = ", ".join(f"{name} {count}" for name, count in cell["failures"].items())
        print(
            f"| {cell['diameter']:<5} | {paper:<7} | {100 * cell['success_rate']:<6.1f} "
            f"| {low:5.1f} - {high:5.1f} | {reach:<9} | {miss:<8} | {failures} |"
        )
    wins, trials = sum(c["successes"] for c in cells), sum(c["trials"] for c in cells)
    low, high = (100 * bound for bound in wilson_interval(wins, trials))
    published = [PAPER.get(noise, {}).get(cell["diameter"]) for cell in cells]
    paper = "" if None in published else f"{np.mean(published):.1f}"
    print(f"| mean  | {paper:<7} | {100 * wins / trials:<6.1f} | {low:5.1f} - {high:5.1f} | | | |")
    print(
        "Reach (first d_combine < 0.35 m) and miss (grip to log centre) are means of the successes."
    )


def film(make_act: Callable[[], Act], kwargs: dict, args: Args) -> None:
    """One trial per diameter. At 10 decisions a second, a frame is also taken between decisions."""
    skip = kwargs.get("frame_skip", 20)
    substeps = 2 if skip % 20 == 0 else 1
    frame_every = max(1, round(10 / (skip // substeps)))
    dt = skip // substeps * crane_env.TIMESTEP
    fps = round(1 / (frame_every * dt))
    gif = args.video.suffix == ".gif"
    options = {"duration": 1000 / fps, "loop": 0} if gif else {"fps": fps, "macro_block_size": 2}
    size = {"width": args.width, "height": args.width * 9 // 32 * 2}
    kwargs = kwargs | size | {"render_mode": "rgb_array", "camera": args.camera}
    kwargs["frame_skip"] = skip // substeps
    diameters, seeds = monte_carlo_trials(args.seed, 1, args.diameters)
    unfinished = args.video.with_name(f"unfinished_{args.video.name}")
    try:
        frames = round(crane_env.TIME_LIMIT * fps) * len(seeds)  # fewer where one ends early
        bar = tqdm(total=frames, unit="frame", leave=False)
        with bar, imageio.get_writer(unfinished, **options) as video:
            for diameter, seed in zip(diameters, seeds):
                envs = CraneVectorEnv(1, diameter=diameter, **kwargs)
                obs, _ = envs.reset(seed=[seed])
                act, ended, step = make_act(), False, 0
                while not ended:
                    if step % substeps == 0:
                        actions = act(obs)
                    obs, _, terminated, truncated, _ = envs.advance(actions)
                    if step % frame_every == 0:
                        video.append_data(envs.render()[0])
                        bar.update()
                    ended, step = terminated[0] or truncated[0], step + 1
                envs.close()
        os.replace(unfinished, args.video)
    finally:
        unfinished.unlink(missing_ok=True)
    print(f"{len(seeds)} trials filmed in {args.video}")


def show(make_act: Callable[[], Act], kwargs: dict, args: Args) -> None:
    """Trials in a window, in real time, until it is closed; diameters are drawn."""
    envs = CraneVectorEnv(1, render_mode="human", **kwargs)
    try:
        obs, _ = envs.reset(seed=args.seed)
        act = make_act()
        while envs.viewer is None or envs.viewer.is_running():
            start = time.time()
            obs, _, terminated, truncated, info = envs.step(act(obs))
            envs.render()
            if terminated[0] or truncated[0]:
                print("success" if info["success"][0] else f"failed: {info['termination'][0]}")
                act = make_act()
            time.sleep(max(0.0, envs.dt - (time.time() - start)))
    except KeyboardInterrupt:
        pass
    envs.close()


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    low, high = crane_env.D_MIN, crane_env.D_MAX
    for wrong, message in [
        (args.trials < 1, f"--trials must be at least 1, got {args.trials}"),
        (args.seed < 0, f"--seed must be at least 0, got {args.seed}"),
        (args.env_threads < 0, f"--env-threads must be at least 0, got {args.env_threads}"),
        (not args.diameters, "--diameters needs at least one number"),
        (
            not all(low <= d <= high for d in args.diameters),
            f"--diameters must lie in [{low}, {high}] m, got {args.diameters}",
        ),
        (args.policy != "file" and args.path != SHIPPED, "PATH goes with --policy file only"),
        (args.policy != "file" and args.stochastic, "--stochastic goes with --policy file only"),
        (
            args.policy != "scripted" and not args.signed_yaw,
            "--no-signed-yaw is for --policy scripted; a trained policy brings its own",
        ),
        (args.video and args.viewer, "either --video or --viewer"),
        (
            (args.video or args.viewer) and (args.json or args.csv),
            "--video and --viewer judge nothing, so that --json and --csv have nothing to write",
        ),
        (
            args.video and args.video.suffix not in (".mp4", ".gif"),
            f"--video: {args.video} must end in .mp4 or .gif",
        ),
        (
            args.width % 2 or not 64 <= args.width <= 1920,
            f"--width must be even and lie in [64, 1920], got {args.width}",
        ),
        (
            args.viewer and crane_env.HEADLESS,
            "--viewer needs a display, and DISPLAY is not set; use --video lift.mp4",
        ),
    ]:
        if wrong:
            raise SystemExit(message)
    for path in filter(None, (args.video, args.csv)):
        if not path.parent.is_dir():
            raise SystemExit(f"no folder {path.parent}; make it first")
        if path.is_dir():
            raise SystemExit(f"{path} is a folder; name a file")
    if args.policy == "file":
        make_act, kwargs, name = load_policy(args.path, args.stochastic)
        source = str(args.path)
    else:
        make_act, kwargs, name = fixed_policy(args.policy, args.seed, args.signed_yaw)
        source = args.policy
    torch.set_num_threads(1)  # small batches: more threads only wait for each other
    kwargs |= {"contact": args.contact, "env_threads": args.env_threads}
    if args.video or args.viewer:
        torch.manual_seed(args.seed)
        kwargs["pose_noise"] = args.pose_noise or "none"
        return (film if args.video else show)(make_act, kwargs, args)

    diameters, seeds = monte_carlo_trials(args.seed, args.trials, args.diameters)
    noises = [args.pose_noise or "none"] if args.pose_noise or args.json else ["none", "step"]
    all_records = []
    for noise in noises:
        torch.manual_seed(args.seed)
        records = run_trials(make_act, {**kwargs, "pose_noise": noise}, diameters, seeds)
        cells = summarize(records)
        all_records += [{"pose_noise": noise, **record} for record in records]
        if args.json:
            wins = sum(cell["successes"] for cell in cells)
            result = {
                "policy": source,
                "contact": args.contact,
                "pose_noise": noise,
                "seed": args.seed,
                "cells": cells,
                "mean_success_rate": wins / len(records),
            }
            json.dump(result, sys.stdout)
            print()
        else:
            table = {"none": "Table I, clean", "step": "Table II, pose noise"}.get(
                noise, "Pose noise"
            )
            what = (
                f"{name} ({source}), {args.contact} contact, pose noise {noise}, seed {args.seed}"
            )
            print_table(records, cells, noise, f"{table}: {what}")
    if args.csv:
        with open(args.csv, "w", newline="") as file:
            writer = csv.DictWriter(file, all_records[0].keys())
            writer.writeheader()
            writer.writerows(all_records)


if __name__ == "__main__":
    main()
