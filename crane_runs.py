"""A training run: its folder, TensorBoard, evaluations, signals, stop and resume.

This module has no learning. The training scripts call it in this order: `read_arguments`,
`Run(...)`, `run.iterations()`, after each update `run.finish_update(...)`, and `run.finish()`.
eval_crane.py, export_onnx.py and crane_policies.py use `one_line_errors` or `fingerprint`.
"""

import io
import os
import signal
import sys
import threading
import time
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import numpy as np
import torch
import torch.distributed as dist
import tyro
from filelock import FileLock, Timeout
from gymnasium.vector import VectorEnv
from torch import nn
from torch.optim import Optimizer
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

import crane_env
import crane_trials
from crane_options import DEFAULTS, OptionError

MAX_BATCH = 2**20  # decisions of a rollout, all in memory
# What --resume may change. load_checkpoint compares the options in env one by one.
CHANGEABLE = {"resume", "total_timesteps", "device", "torch_threads", "env_threads", "env"}
SHOWN = {"return": "charts/episodic_return", "success": "charts/success_rate", "SPS": "time/SPS"}
LOCKS: list[FileLock] = []  # of this process; kept, because a lock without a reference opens


def one_line_errors(hint: str = "") -> None:
    """From now on, files that cannot be used and Ctrl-C end with one line and no traceback.

    hint follows a file's error. All other errors keep their traceback.
    """

    def report(kind: type, error: BaseException, trace: TracebackType | None) -> None:
        if issubclass(kind, KeyboardInterrupt):
            say("\ninterrupted", sys.stderr)
        elif issubclass(kind, OSError):
            say(f"\n{kind.__name__}: {error}{hint}", sys.stderr)
        else:
            sys.__excepthook__(kind, error, trace)
        if issubclass(kind, BrokenPipeError):
            say("", sys.stdout)  # or Python complains of the closed pipe when it exits

    def report_of_thread(args: threading.ExceptHookArgs) -> None:
        # TensorBoard writes in a thread. The main thread meets its error at the next scalar.
        if not issubclass(args.exc_type, OSError):
            threading.__excepthook__(args)

    sys.excepthook, threading.excepthook = report, report_of_thread


def say(line: str, stream: TextIO | None = None) -> None:
    """Print a line, unless the terminal or the pipe is closed. Then nothing more goes there."""
    stream = stream or sys.stdout
    try:
        print(line, file=stream, flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def lock_folder(folder: Path) -> None:
    """Make a run's folder and hold its lock until the process ends. SystemExit if another does."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / "lock", blocking=False)
    try:
        lock.acquire()
    except Timeout:
        raise SystemExit(f"another process trains in {folder}") from None
    LOCKS.append(lock)


def read_arguments(algorithm: str, arguments: type, description: str) -> tuple[Any, dict | None]:
    """Args of the command line, and the checkpoint that --resume names, if any.

    SystemExit says what is wrong with them. arguments: the script's dataclass `Args`.
    description: its docstring.
    """
    one_line_errors()
    args, checkpoint = tyro.cli(arguments, description=description.partition("\n\n")[0]), None
    if args.resume is not None:
        args, checkpoint = load_checkpoint(args.resume, algorithm, arguments)
    if args.device == "cuda" and not torch.cuda.is_available():
        raise SystemExit("--device cuda: torch finds no GPU; use --device cpu")
    batch_size = args.num_envs * args.num_steps
    if batch_size > MAX_BATCH:
        raise SystemExit(f"--num-envs times --num-steps must be at most {MAX_BATCH:,}")
    if checkpoint and checkpoint["iteration"] > max(1, args.total_timesteps // batch_size):
        done = checkpoint["iteration"] * batch_size
        mend = f"give --total-timesteps {done + batch_size} or more"
        raise SystemExit(f"--resume: {done:,} decisions are done; {mend}")
    return args, checkpoint


def share_arguments(algorithm: str, arguments: type, description: str) -> tuple[Any, dict | None]:
    """What rank 0 gets from `read_arguments`, on all ranks. If it exits, the others do so too."""
    one_line_errors()
    cpu = torch.device("cpu")  # several CPU ranks can then run beside one GPU
    shared: list[Any] = [None]
    if dist.get_rank() == 0:
        try:
            shared = [read_arguments(algorithm, arguments, description)]
        except (SystemExit, OSError) as error:
            code = getattr(error, "code", 1)  # 0 or 2 after --help or a wrong argument
            code = code if isinstance(code, int | None) else 1
            dist.broadcast_object_list([code], device=cpu)
            raise
    dist.broadcast_object_list(shared, device=cpu)
    if not isinstance(shared[0], tuple):  # rank 0 has said why
        raise SystemExit(shared[0])
    return shared[0]


def load_checkpoint(folder: Path, algorithm: str, arguments: type) -> tuple[Any, dict]:
    """The arguments of a run, with those of the command line, and checkpoint.pt in its folder."""
    path = folder / "checkpoint.pt"
    if not path.is_file():
        raise SystemExit(f"--resume: there is no {path}; give the folder of a run")
    lock_folder(folder)
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        task, written_by = checkpoint["task"], checkpoint["algorithm"]
        revision = task.get("revision", crane_env.REVISION)  # only the crane has one
        if (written_by, revision) != (algorithm, crane_env.REVISION):
            hint = f"; this is {algorithm}, task revision {crane_env.REVISION}"
            raise SystemExit(f"--resume: {path} is of {written_by}, task revision {revision}{hint}")
        if not {"weights", "optimizer", "iteration", "fingerprint"} <= checkpoint.keys():
            raise SystemExit(f"--resume: {path} lacks what a checkpoint has, as a policy.pt does")
        # every option as it was, should a default have changed since
        options = {name: task[name] for name in DEFAULTS if name in task}
        options = checkpoint["args"]["env"] | options
        saved = arguments(**checkpoint["args"] | {"env": options})
    except OptionError as error:  # a range has changed since
        raise SystemExit(f"--resume: {path}: {error}") from None
    except Exception:  # a damaged file raises many kinds
        raise SystemExit(f"--resume: {path} is damaged or not of this script") from None
    args = tyro.cli(arguments, default=saved)
    given = vars(args) | args.env
    for name, value in (vars(saved) | options).items():
        if value != given[name] and name not in CHANGEABLE:
            raise SystemExit(f"--resume: this run has {name} {value}; leave the argument out")
    return args, checkpoint


def fingerprint(agent: nn.Module, obs_dim: int) -> torch.Tensor:
    """Actions (3, 16, act_dim) at three fixed batches of observations, one after the other.

    With the same weights it differs only if the code of the Agent has changed.
    """
    state, actions = None, []
    for obs in np.random.default_rng(0).standard_normal((3, 16, obs_dim)):
        action, state = agent.predict(obs, state)
        actions.append(action)
    return torch.as_tensor(np.array(actions))


class Run:
    """What a training leaves on disk, and what can stop it.

    algorithm, args, checkpoint: as in `read_arguments`. A checkpoint's weights go to the agent,
    its state to the optimizer. envs: of `crane_trials.make_envs`. rank: of this process, if several
    train together. Only rank 0 has a folder, writes and evaluates.

    Attributes: `num_iterations` updates in all, `first_iteration`, the folder `dir`, and `env_seed`
    for the first reset. A resumed run draws new episodes and samples.
    """

    def __init__(
        self,
        algorithm: str,
        args: Any,
        envs: VectorEnv,
        agent: nn.Module,
        optimizer: Optimizer,
        checkpoint: dict | None,
        rank: int = 0,
    ):
        self.algorithm, self.args, self.rank = algorithm, args, rank
        self.agent, self.optimizer = agent, optimizer
        space = envs.single_action_space
        self.spaces = {"obs_dim": envs.single_observation_space.shape[0]}
        self.spaces |= {"low": torch.as_tensor(space.low), "high": torch.as_tensor(space.high)}
        self.batch_size = args.num_envs * args.num_steps
        self.num_iterations = max(1, args.total_timesteps // self.batch_size)
        done = 0 if checkpoint is None else checkpoint["iteration"]
        self.first_iteration = done + 1
        seeds = np.random.SeedSequence((args.seed, self.first_iteration))
        self.env_seed = int(seeds.generate_state(1)[0])
        self.final_scores: dict[str, float] = {}
        if checkpoint is not None:
            try:
                agent.load_state_dict(checkpoint["weights"])
                optimizer.load_state_dict(checkpoint["optimizer"])
            except (RuntimeError, ValueError) as error:
                reason = str(error).splitlines()[-1].strip()
                raise SystemExit(f"--resume: the run has another Agent or task: {reason}") from None
            actions = fingerprint(agent, self.spaces["obs_dim"])
            if not torch.allclose(actions, checkpoint["fingerprint"], atol=1e-3):
                wrote = f"that of {checkpoint['script']}, which began the run"
                raise SystemExit(f"--resume: the Agent of this script acts otherwise than {wrote}")
            torch.manual_seed(self.env_seed)
            if done == self.num_iterations:
                self.final_scores = checkpoint.get("final_scores", {})

        if rank == 0:
            name = f"{args.env_id}__{args.exp_name}__{args.seed}__{int(time.time())}_{os.getpid()}"
            self.dir = args.resume or Path("runs", name.replace("/", "-"))
            if args.resume is None:
                lock_folder(self.dir)
            self.writer = SummaryWriter(self.dir, purge_step=done * self.batch_size + 1)
            lines = [f"    {name}: {value}" for name, value in asdict(args).items()]
            self.writer.add_text("hyperparameters", "\n".join(lines))
        on_crane = isinstance(envs.unwrapped, crane_env.CraneVectorEnv)
        self.task = {"env_id": args.env_id, **(envs.unwrapped.task if on_crane else {})}

        self.stop_signals: list[int] = []
        signals = {signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGINT)}
        self.handlers = {signum: signal.getsignal(signum) for signum in signals}
        for signum, handler in self.handlers.items():
            if handler != signal.SIG_IGN:  # nohup ignores some
                signal.signal(signum, self.stop_after_update)
        if rank == 0:
            print(f"writing to {self.dir}", flush=True)

    def stop_after_update(self, signum: int, frame: object) -> None:
        """Ctrl-C, kill or a closed terminal: finish the update. A second Ctrl-C: stop at once."""
        self.stop_signals.append(signum)
        if signum == signal.SIGINT:
            signal.signal(signum, signal.SIG_DFL)

    def iterations(self) -> tqdm:
        """The numbers of the updates to make, with a progress bar."""
        remaining = range(self.first_iteration, self.num_iterations + 1)
        if not remaining and self.rank == 0:
            done = f"all {self.num_iterations} updates are done"
            print(f"{done}; more --total-timesteps extend the run")
        count = {"initial": self.first_iteration - 1, "total": self.num_iterations}
        self.bar = tqdm(remaining, **count, disable=self.rank > 0)
        return self.bar

    def finish_update(
        self, iteration: int, report: dict[str, float], stop: bool | None = None
    ) -> None:
        """Write the report. Evaluate and save when it is time to, and stop if a signal came.

        stop: whether a signal came to any rank, where the ranks have agreed on it.
        """
        args, last = self.args, iteration == self.num_iterations
        wrong = [name for name, value in report.items() if not np.isfinite(value)]
        if wrong or not all(tensor.isfinite().all() for tensor in self.agent.state_dict().values()):
            self.bar.close()
            what = ", ".join(wrong[:2]) or "the weights"
            hint = "lower --learning-rate (TRPO: --max-kl) or look at the task's rewards"
            raise SystemExit(f"update {iteration}: {what} not finite; {hint}")
        if self.rank == 0:
            for key, value in report.items():
                self.writer.add_scalar(key, value, iteration * self.batch_size)
            if stop or self.stop_signals:
                self.save(iteration)  # before an evaluation: torchrun kills after 30 s
            if args.eval_every and (iteration % args.eval_every == 0 or last):
                self.evaluate("eval", args.eval_trials, iteration)
        stopping = bool(self.stop_signals) if stop is None else stop
        if self.rank == 0 and (iteration % 10 == 0 or last or stopping):
            self.save(iteration)
        if stopping:
            self.bar.close()
            if self.rank == 0:
                say(f"stopped after update {iteration}; go on with --resume {self.dir}")
            raise SystemExit(128 + (self.stop_signals or [signal.SIGTERM])[0])  # as a shell does
        self.bar.set_postfix({k: f"{report[v]:.3g}" for k, v in SHOWN.items() if v in report})

    def evaluate(self, name: str, trials: int, iteration: int) -> dict[str, float]:
        """Scores of `crane_trials.evaluate`, also written to TensorBoard under name."""
        args = self.args
        protocol = {"trials": trials, "seed": args.eval_seed, "env_threads": args.env_threads}
        scores = crane_trials.evaluate(self.agent, args.env_id, **protocol, **args.env)
        for key, value in scores.items():
            self.writer.add_scalar(f"{name}/{key}", value, iteration * self.batch_size)
        return scores

    def save(self, iteration: int) -> None:
        """Write policy.pt, to act with, and checkpoint.pt, to resume from."""
        self.writer.flush()
        weights = self.agent.state_dict()
        acting = {name: w for name, w in weights.items() if not name.startswith("critic.")}
        args = asdict(self.args) | {"resume": None}
        policy = {"algorithm": self.algorithm, "task": self.task, "args": args}
        policy |= {"weights": acting, "global_step": iteration * self.batch_size}
        policy |= {"script": Path(sys.argv[0]).name, "spaces": self.spaces}
        policy["fingerprint"] = fingerprint(self.agent, self.spaces["obs_dim"])
        state = {"weights": weights, "optimizer": self.optimizer.state_dict()}
        state |= {"iteration": iteration, "final_scores": self.final_scores}
        # A kill or a full disk leaves the old files whole.
        for name, contents in (("policy", policy), ("checkpoint", policy | state)):
            buffer = io.BytesIO()  # torch would turn a full disk into a RuntimeError
            torch.save(contents, buffer)
            (self.dir / f"{name}.tmp").write_bytes(buffer.getvalue())
            os.replace(self.dir / f"{name}.tmp", self.dir / f"{name}.pt")
        # from now on an error can say how to go on
        one_line_errors(f"; fix this, then go on with --resume {self.dir}")

    def finish(self) -> None:
        """Final trials, unless they were made already."""
        for signum, handler in self.handlers.items():  # all is saved
            signal.signal(signum, handler)
        if self.rank > 0:
            return
        print(f"policy saved to {self.dir / 'policy.pt'}", flush=True)
        if self.args.final_trials and not self.final_scores:
            trials = self.args.final_trials
            self.final_scores = self.evaluate("final", trials, self.num_iterations)
            self.save(self.num_iterations)
        for name, score in self.final_scores.items():
            print(f"final/{name}: {score:.3f}", flush=True)
        self.writer.close()
