"""Runs of the scripts inside the test's own process, and what can be seen of them."""

import contextlib
import runpy
import signal
import sys
from collections import defaultdict
from copy import deepcopy
from pathlib import Path
from unittest import mock

import torch
import torch.utils.tensorboard
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torch.distributions import Beta, Normal

ROOT = Path(__file__).parent.parent
ALGORITHMS = ["mppo_beta_crane", "ppo_crane", "trpo_crane", "recurrent_ppo_crane"]
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Recording:
    """What a script did. `run` may be called again, for another run in the same folder.

    scalars: {tag: {global step: value}}. first: the weights before the first update. updates: what
    the script has after each update. starts, steps: what the training's environments gave and
    took. samples: what the policy drew. permutations: of `torch.randperm`.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.scalars, self.purge_steps = defaultdict(dict), []
        self.first, self.updates = [], []
        self.starts, self.steps, self.samples, self.permutations = [], [], [], []

    def begin(self, folder: Path, purge_step: int) -> "Recording":
        """TensorBoard's writer is this recording."""
        self.purge_steps.append(purge_step)
        self.first.append(deepcopy(self.script["agent"].state_dict()))
        return self

    def add_scalar(self, tag: str, value: float, step: int) -> None:
        """The first number of an update follows the update."""
        self.scalars[tag][step] = float(value)
        if not tag.startswith("eval/") and self.seen != self.script["iteration"]:
            self.seen = self.script["iteration"]
            kept = {"step": step, "actions": self.script["actions"]}
            kept |= {"weights": self.script["agent"].state_dict()}
            kept |= {"difficulty": self.script["envs"].unwrapped.difficulty}
            self.updates.append(deepcopy(kept))

    def add_text(self, *args) -> None: ...

    def close(self) -> None: ...

    @property
    def script(self) -> dict:
        """The variables of the script that runs."""
        return vars(sys.modules["__main__"])

    def watch(self, owner, name: str, keep) -> mock._patch:
        """A patch: keep(object, arguments, result) sees each call of a method or function."""
        method = getattr(owner, name)

        def call(*args, **kwargs):
            result = method(*args, **kwargs)
            keep(args, deepcopy(result))
            return result

        return mock.patch.object(owner, name, call)

    def keep_start(self, args: tuple, result: tuple) -> None:
        if args[0] is self.script.get("envs"):  # and not those of an evaluation
            self.starts.append(result[0])

    def keep_step(self, args: tuple, result: tuple) -> None:
        if args[0] is self.script.get("envs"):
            names = ("obs", "reward", "terminated", "truncated", "info")
            step = dict(zip(names, result)) | {"actions": args[1].copy()}
            step["final_obs"] = [*step["info"].get("final_obs", [None] * len(step["obs"]))]
            self.steps.append(step)

    def run(self, script: str, *arguments) -> dict:
        """Run a script with these words as arguments; the variables that it left."""
        words = [word for argument in arguments for word in str(argument).split()]
        path, self.seen = str(ROOT / f"{script}.py"), None
        with contextlib.ExitStack() as stack:
            for patch in [
                mock.patch.object(sys, "argv", [path, *words]),
                mock.patch.object(sys, "path", sys.path[:]),
                mock.patch.object(torch.utils.tensorboard, "SummaryWriter", self.begin),
                self.watch(RecordEpisodeStatistics, "reset", self.keep_start),
                self.watch(RecordEpisodeStatistics, "step", self.keep_step),
                self.watch(torch, "randperm", lambda _, x: self.permutations.append(x.tolist())),
                self.watch(Beta, "sample", lambda _, x: self.samples.append(x)),
                self.watch(Normal, "sample", lambda _, x: self.samples.append(x)),
                contextlib.chdir(self.folder),
            ]:
                stack.enter_context(patch)
            stack.callback(torch.set_num_threads, torch.get_num_threads())
            for number in SIGNALS:  # a test in the background ignores some, and scripts respect it
                stack.callback(signal.signal, number, signal.signal(number, signal.SIG_DFL))
            return runpy.run_path(path, run_name="__main__")
