"""A training run: its arguments, its folder, stop signals, and the policy that it leaves behind.

Nothing here learns. A run's folder has TensorBoard's events, policy.pt to act with, checkpoint.pt
to resume from, and copies of the script and of the file of the task's class.
"""

import argparse
import importlib.util
import inspect
import os
import shutil
import signal
import sys
import time
from dataclasses import asdict, fields
from importlib.metadata import version
from pathlib import Path
from secrets import token_hex
from types import FrameType
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from gymnasium.vector import VectorEnv
from pydantic import Field
from torch import nn
from torch.optim import Optimizer

from crane_env import Options
from crane_utils import trials

Share = Annotated[float, Field(ge=0, le=1)]
Factor = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]


def parse(arguments: type, description: str) -> tuple[Any, dict | None]:
    """The script's `Args` from the command line and, with --resume, the run's checkpoint.

    The defaults of --env.* are those of the task that --env-id names, or of the resumed run.
    """
    sys.path.insert(0, os.getcwd())  # where the user's own tasks are
    scan = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    scan.add_argument("--env-id", "--env_id", default=arguments.env_id)
    scan.add_argument("--resume", type=Path)
    seen, _ = scan.parse_known_args()
    checkpoint = None
    if seen.resume:
        if not (seen.resume / "checkpoint.pt").is_file():
            raise SystemExit(f"--resume: no checkpoint.pt in {seen.resume}")
        checkpoint = load(seen.resume / "checkpoint.pt")
        if checkpoint["script"] != (script := Path(sys.argv[0]).name):
            raise SystemExit(f"--resume: {checkpoint['script']} wrote {seen.resume}, not {script}")
        default = restore_args(arguments, checkpoint)
    else:
        default = arguments(env_id=seen.env_id, env=trials.task_options(seen.env_id) or Options())
    summary = description.partition("\n\n")[0]
    # --env.signed-yaw False, and not a flag of its own for each value
    config = (tyro.conf.FlagConversionOff,)
    args = tyro.cli(arguments, default=default, description=summary, config=config)
    if not trials.crane_class(args.env_id) and args.env != Options():
        raise SystemExit(f"{args.env_id} is not the crane and has no --env options")
    if checkpoint:
        given, before = (
            asdict(a) | {f"env.{name}": value for name, value in asdict(a.env).items()}
            for a in (args, default)
        )
        fixed = ["env_id", "num_envs", "num_steps", "hidden_sizes", "lstm_size"]  # shapes
        fixed += ["env.offset", "env.signed_yaw", "env.axes", "env.sensors"]  # observations
        fixed += ["log_std_init", "log_excess_init"]  # the checkpoint has the width
        for name in fixed:
            if given.get(name) != (was := before.get(name)):
                raise SystemExit(f"--resume: --{name.replace('_', '-')} must stay {was}")
        cranes, was = trials.crane_class(args.env_id), checkpoint["task"].get("revision")
        if cranes and cranes.REVISION != was:
            raise SystemExit(f"--resume: the task has revision {cranes.REVISION}, the run {was}")
        batch_size = args.num_envs * args.num_steps
        done = checkpoint["iteration"] * batch_size
        if args.total_timesteps < done + batch_size:
            raise SystemExit(f"--resume: {done:,} steps are done; give more --total-timesteps")
    return args, checkpoint


def restore_args(arguments: type, saved: dict[str, Any]) -> Any:
    """`Args` as they were saved, for the same script or an edited one with other arguments."""
    cranes = trials.crane_class(saved["task"]["env_id"])
    options = (cranes.Options if cranes else Options)(**saved["args"]["env"])
    known = {f.name: saved["args"][f.name] for f in fields(arguments) if f.name in saved["args"]}
    return arguments(**{**known, "env": options})


def restore(
    args: Any, checkpoint: dict | None, agent: nn.Module, optimizer: Optimizer
) -> tuple[int, int]:
    """Load a checkpoint, if any. Returns the first update to make, and the seed of its episodes.

    A resumed run draws new episodes and samples.
    """
    first_iteration = checkpoint["iteration"] + 1 if checkpoint else 1
    env_seed = np.random.SeedSequence((args.seed, first_iteration)).generate_state(1)[0].item()
    if checkpoint:
        agent.load_state_dict(checkpoint["weights"])
        optimizer.load_state_dict(checkpoint["optimizer"])
        torch.manual_seed(env_seed)
    return first_iteration, env_seed


def task_file(env_id: str) -> Path | None:
    """The file of the task's class, None if it is not the crane."""
    cranes = trials.crane_class(env_id)
    return Path(inspect.getfile(cranes)) if cranes else None


def make_folder(args: Any) -> Path:
    """The run's folder: that of --resume, or a new one. Script and task are copied into it."""
    if args.resume:
        folder = args.resume
        shutil.copy(sys.argv[0], folder / "script.unfinished")  # perhaps edited: see `save`
    else:
        # two runs that start together, also in containers, get two folders
        name = f"{args.env_id}__{args.exp_name}__{args.seed}__{int(time.time())}_{token_hex(2)}"
        folder = Path("runs", name.replace("/", "-").replace(":", "-"))
        folder.mkdir(parents=True)
        shutil.copy(sys.argv[0], folder)
        print(f"writing to {folder}", flush=True)
    if task := task_file(args.env_id):
        shutil.copy(task, folder)
    return folder


def save(
    folder: Path, args: Any, envs: VectorEnv, agent: nn.Module, optimizer: Optimizer, iteration: int
) -> None:
    """Write policy.pt, to act with, and checkpoint.pt, to resume from."""
    weights, crane = agent.state_dict(), envs.unwrapped
    run = {"script": Path(sys.argv[0]).name, "args": asdict(args) | {"resume": None}}
    run["task"] = {"env_id": args.env_id, **getattr(crane, "task", {})}
    run["versions"] = {package: version(package) for package in ("mujoco", "torch")}
    run["iteration"] = iteration
    acting = {name: w for name, w in weights.items() if not name.startswith("critic.")}
    if (edited := folder / "script.unfinished").exists():  # of --resume: the code of these weights
        os.replace(edited, folder / run["script"])
    write(folder / "policy.pt", run | {"weights": acting})
    resuming = {"weights": weights, "optimizer": optimizer.state_dict()}
    write(folder / "checkpoint.pt", run | resuming)


def write(path: Path, contents: dict[str, Any]) -> None:
    """Write a file whole or not at all: a kill or a full disk leaves the old one."""
    unfinished = path.with_suffix(".unfinished")
    torch.save(contents, unfinished)
    load(unfinished)  # it refuses what torch.save takes, such as paths or NumPy's numbers
    os.replace(unfinished, path)


def load(path: Path) -> dict[str, Any]:
    """What `write` wrote: numbers, strings and tensors, no code."""
    return torch.load(path, map_location="cpu", weights_only=True)


class StopSignal:
    """Ctrl-C, kill or a closed terminal sets `received`. A second Ctrl-C stops at once."""

    def __init__(self) -> None:
        self.received: int | None = None
        hangup = getattr(signal, "SIGHUP", signal.SIGTERM)  # Windows has none
        for number in (signal.SIGINT, signal.SIGTERM, hangup):
            if signal.getsignal(number) != signal.SIG_IGN:  # as nohup wants it
                signal.signal(number, self.receive)

    def receive(self, number: int, frame: FrameType | None) -> None:
        self.received = number
        if number == signal.SIGINT:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        elif number != signal.SIGTERM:  # the terminal is closed: writing to it would fail
            sys.stdout = open(os.devnull, "w", encoding="utf-8")


def brief(numbers: dict[str, float]) -> str:
    """What the progress bar and the line of an evaluation say."""
    named = {name.rpartition("/")[2]: number for name, number in numbers.items()}
    shown = {"success_rate": ".3g", "gentle_rate": ".3g", "episodic_return": ".3g", "SPS": ",.0f"}
    return ", ".join(f"{name} {named[name]:{how}}" for name, how in shown.items() if name in named)


def check_finite(iteration: int, stats: dict[str, float], agent: nn.Module) -> None:
    """SystemExit that names what is not finite after an update."""
    wrong = [name for name, value in stats.items() if not np.isfinite(value)]
    wrong += [name for name, weights in agent.named_parameters() if not weights.isfinite().all()]
    if wrong:
        what = f"update {iteration}: {', '.join(wrong[:3])} not finite"
        raise SystemExit(f"{what}; try a lower --learning-rate")


def load_policy(path: Path) -> tuple[nn.Module, dict[str, Any], str]:
    """The agent in a run's folder or policy.pt, its task, and the name of its script.

    The agent is built by the copy of the script beside policy.pt, which is code that runs, or by
    the script of that name in this repository. stderr says if the run is not finished, or if its
    task's file has changed.
    """
    path = path / "policy.pt" if path.is_dir() else path
    if not path.is_file():
        raise SystemExit(f"no {path}: give a run's folder, or a policy.pt")
    saved = load(path)
    script = path.parent / saved["script"]
    if not script.is_file():
        script = Path(__file__).parents[1] / saved["script"]
    if not script.is_file():
        raise SystemExit(f"{path} needs {saved['script']}, whose Agent it holds, beside it")
    task, args = task_file(saved["task"]["env_id"]), saved["args"]
    copy = path.parent / task.name if task else path
    if task and copy.is_file() and copy.read_bytes() != task.read_bytes():
        print(f"{task.name} has changed since the training of {path.parent}", file=sys.stderr)
    batch_size, total = args["num_envs"] * args["num_steps"], args["total_timesteps"]
    done = saved.get("iteration", 0) * batch_size
    if 0 < done <= total - batch_size:
        print(f"{path.parent}: after {done:,} of {total:,} steps", file=sys.stderr)
    spec = importlib.util.spec_from_file_location(f"script_of_{path.parent.name}", script)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look for it
    spec.loader.exec_module(module)
    weights = saved["weights"]
    bounds = weights["action_low"].numpy(), weights["action_high"].numpy()
    agent = module.Agent(len(weights["obs_mean"]), *bounds, restore_args(module.Args, saved))
    critic = {name: w for name, w in agent.state_dict().items() if name.startswith("critic.")}
    agent.load_state_dict(critic | weights)  # policy.pt has no critic
    return agent.eval(), saved["task"], script.name
