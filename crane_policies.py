"""Policies to judge: what a file holds, a class of your own, or fixed actions.

    from pathlib import Path
    from crane_policies import load_policy

    policy, task, name = load_policy(Path("runs/<run>"))
    actions, state = policy.predict(obs, None, deterministic=True)

obs is (N, 18 or 32) and actions (N, 6). state is the policy's memory, None before the first
decision. `load_policy` reads a policy.pt of the four scripts or of an edited copy, a model of
Stable-Baselines3 (.zip), and an .onnx file of export_onnx.py. docs/compare.md has recipes.
"""

import importlib
import importlib.util
import inspect
import json
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np
import torch

import crane_env
import crane_options
import crane_runs
import mppo_beta_crane
import ppo_crane
import recurrent_ppo_crane
import trpo_crane

SCRIPTS = (mppo_beta_crane, ppo_crane, trpo_crane, recurrent_ppo_crane)
ALGORITHMS = {script.ALGORITHM: script for script in SCRIPTS}
SHIPPED = Path(__file__).parent / "assets" / "policies" / "mppo_beta_crane.pt"


def script_of(name: str, algorithm: str, path: Path) -> ModuleType:
    """The script of this name in this folder, an edited copy or one of ours; or the algorithm's."""
    ours = {Path(script.__file__).resolve(): script for script in SCRIPTS}
    for folder in (Path.cwd(), Path(__file__).parent):
        file = (folder / name).resolve()
        if file in ours:
            return ours[file]
        if file.suffix == ".py" and file.is_file() and "class Agent" in file.read_text():
            spec = importlib.util.spec_from_file_location(file.stem, file)
            script = importlib.util.module_from_spec(spec)
            sys.modules[file.stem] = script  # where dataclasses look for it
            spec.loader.exec_module(script)
            return script
    if algorithm not in ALGORITHMS:
        wanted = f"; its script {name} is not in this folder" if name else ""
        known = ", ".join(ALGORITHMS)
        raise SystemExit(f"{path}: unknown algorithm {algorithm!r}; known: {known}{wanted}")
    return ALGORITHMS[algorithm]


def load_policy(path: Path) -> tuple[Any, dict[str, Any], str]:
    """The policy in a file or a run's folder, the task it was trained on, a name for the tables.

    The task is `env_id`, `revision` and all options of the environment. A model of
    Stable-Baselines3 does not know its options. The name is the algorithm's, that of an edited
    copy's file, or Stable-Baselines3. SystemExit says what is wrong with the file.
    """
    file = path / "policy.pt" if path.is_dir() else path
    if not file.is_file():
        raise SystemExit(f"no file {file}; {hint_for(path)}")
    if file.suffix == ".zip":
        return load_sb3(file), {"env_id": "ForestryCrane-v0"}, "Stable-Baselines3"
    if file.suffix == ".onnx":
        policy = OnnxPolicy(file)
        warn_of_revision(file, policy.task)
        return policy, policy.task, policy.name
    return load_agent(file)


def hint_for(path: Path) -> str:
    """The mend for a path that has no policy."""
    if str(path) in ("scripted", "zero", "random"):
        return f"--policy {path}"
    for folder in (path, path.parent):
        runs = [run for run in folder.glob("*/policy.pt") if run.is_file()]
        if runs:
            return f"the newest run there is {max(runs, key=os.path.getmtime).parent}"
    return "train one first, or give a run's policy.pt"


def load_agent(path: Path) -> tuple[torch.nn.Module, dict[str, Any], str]:
    """The agent in a policy.pt, its task and its name."""
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
        algorithm, task = str(saved["algorithm"]), dict(saved["task"])
        weights, args = saved["weights"], dict(saved["args"])
        expected = torch.as_tensor(saved["fingerprint"])
        wrote = Path(saved.get("script", "")).name  # older files do not name it
    except Exception:  # a damaged file raises many kinds
        raise SystemExit(f"{path} is no policy.pt of this repository") from None
    if "frame_skip" not in task:  # an option that only the crane has
        raise SystemExit(f"{path} was trained on {task.get('env_id')}, not on the crane")
    script = script_of(wrote, algorithm, path)
    used = Path(script.__file__).name
    task = crane_options.DEFAULTS | task  # an option that is newer than the file has its default
    warn_of_revision(path, task)
    mend = f"undo the change of {used} or train again"
    if wrote not in ("", used):
        mend = f"{wrote} wrote it; copy {wrote}, with its Agent, here"
    try:
        obs_dim, low, high = (saved["spaces"][name] for name in ("obs_dim", "low", "high"))
        agent = script.Agent(obs_dim, low.numpy(), high.numpy(), script.Args(**args))
        # policy.pt has no critic, and acting needs none
        agent.load_state_dict({**agent.critic.state_dict(prefix="critic."), **weights})
    except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
        reason = (str(error).splitlines() or [repr(error)])[-1].strip()
        raise SystemExit(f"{path} does not fit {used}: {reason}; {mend}") from None
    actions = crane_runs.fingerprint(agent, obs_dim)
    if actions.shape != expected.shape or not torch.allclose(actions, expected, atol=1e-3):
        told = f"the Agent of {script.__file__} acts otherwise than in the training"
        raise SystemExit(f"{path}: {told}; {mend}")
    ours = (f"{algorithm}_crane.py", "mppo_beta_torchrun.py")
    return agent, task, algorithm if used in ours else used


def warn_of_revision(path: Path, task: dict[str, Any]) -> None:
    if task.get("revision") != crane_env.REVISION:
        print(f"{path} was trained on task revision {task.get('revision')}", file=sys.stderr)


def load_sb3(path: Path) -> Any:
    """The policy in a model of Stable-Baselines3 or sb3-contrib. It needs that library."""
    try:
        from stable_baselines3.common.save_util import load_from_zip_file

        data, weights, _ = load_from_zip_file(path)
        spaces = data["observation_space"], data["action_space"]
        options = {"use_sde": True} if data.get("use_sde") else {}
        options |= data["policy_kwargs"]
        policy = data["policy_class"](*spaces, lambda _: 0.0, **options)
        policy.load_state_dict(weights["policy"])
        scaled = data.get("_last_original_obs") is not None
    except ImportError as error:
        raise SystemExit(f"{path}: {error}; install what it needs (docs/compare.md)") from None
    except Exception as error:  # a damaged file, a model of another version
        raise SystemExit(f"{path} is no model of Stable-Baselines3: {error}") from None
    if scaled:
        lack = "was trained with VecNormalize, whose statistics are not in the .zip"
        print(f"{path} {lack}; see docs/compare.md, recipe 4", file=sys.stderr)
    policy.set_training_mode(False)
    return policy


class OnnxPolicy:
    """A policy in an .onnx file of export_onnx.py. SystemExit says what is wrong with the file."""

    def __init__(self, path: Path):
        try:
            import onnxruntime

            self.session = onnxruntime.InferenceSession(path)
        except ImportError as error:
            raise SystemExit(f"{path}: {error}; pip install onnxruntime") from None
        except Exception as error:
            raise SystemExit(f"{path} is no ONNX file: {error}") from None
        known = self.session.get_modelmeta().custom_metadata_map
        if not known.keys() >= {"task", "algorithm"}:
            hint = "wrap it in a class of your own for --policy my_module:MyPolicy"
            raise SystemExit(f"{path} is not of export_onnx.py and names no task; {hint}")
        # an option that is newer than the file has its default
        self.task = crane_options.DEFAULTS | json.loads(known["task"])
        self.name = known["algorithm"]
        self.memory = self.session.get_inputs()[1:]

    def predict(self, obs: np.ndarray, state: list | None, deterministic: bool = True):
        """Mean actions (N, 6) for obs (N, obs_dim), and the memory after them."""
        state = state or [np.zeros((len(obs), i.shape[1]), np.float32) for i in self.memory]
        inputs = {i.name: part for i, part in zip(self.memory, state)}
        actions, *state = self.session.run(None, {"obs": np.float32(obs), **inputs})
        return actions, state


class FixedPolicy:
    """Zero or uniformly random actions, from torch's generator, which each table seeds anew."""

    def __init__(self, kind: Literal["zero", "random"]):
        self.kind = kind

    def predict(self, obs: np.ndarray, state: None = None, deterministic: bool = True):
        if self.kind == "zero":
            return np.zeros((len(obs), 6)), None
        return 2 * torch.rand(len(obs), 6).numpy() - 1, None


def is_missing(module: str, error: ModuleNotFoundError) -> bool:
    """Whether the module itself is missing, or a package that it is in, and not what it imports."""
    return f"{module}.".startswith(f"{error.name}.")


class OwnPolicy:
    """A user's policy as `run_trials` wants it. SystemExit says what is wrong with it.

    make() gives a function from observations to actions, or an object with `predict` as
    Stable-Baselines3 has it. Each batch of trials gets one of its own.
    """

    def __init__(self, policy: str):
        """policy: my_module:MyPolicy"""
        self.policy = policy
        module, _, attribute = policy.partition(":")
        try:
            found = importlib.import_module(module)
        except ModuleNotFoundError as error:
            if not is_missing(module, error):
                raise
            raise SystemExit(f"--policy {policy}: {error}") from None
        if not hasattr(found, attribute):
            raise SystemExit(f"--policy {policy}: {found.__file__} has no {attribute}")
        self.make = getattr(found, attribute)
        try:
            inspect.signature(self.make).bind()
        except (TypeError, ValueError) as error:
            wanted = f"{attribute} must be a class or function without arguments"
            raise SystemExit(f"--policy {policy}: {error}; {wanted}") from None

    def predict(self, obs: np.ndarray, state: tuple | None, deterministic: bool = True):
        """state: the user's object and, if it has `predict`, its own state."""
        policy, memory = (self.make(), None) if state is None else state
        if hasattr(policy, "predict"):
            answer = policy.predict(obs, memory, deterministic=deterministic)
            if not isinstance(answer, tuple) or len(answer) != 2:
                raise SystemExit(f"--policy {self.policy}: predict must return actions and a state")
            actions, memory = answer
        elif callable(policy):
            actions = policy(obs)
        else:
            given = f"{policy!r} is no function and has no predict"
            raise SystemExit(f"--policy {self.policy}: {given}")
        if isinstance(actions, torch.Tensor):
            actions = actions.detach().cpu()
        try:
            actions = np.asarray(actions)
        except (RuntimeError, TypeError, ValueError) as error:
            raise SystemExit(f"--policy {self.policy}: actions are no array: {error}") from None
        if actions.dtype.kind not in "fiu" or actions.shape != (len(obs), 6):
            wanted = f"numbers ({len(obs)}, 6) for observations {obs.shape}"
            given = f"actions must be {wanted}, got {actions.dtype} {actions.shape}"
            raise SystemExit(f"--policy {self.policy}: {given}")
        if not np.isfinite(actions).all():
            raise SystemExit(f"--policy {self.policy}: actions contain NaN or infinity")
        return actions, (policy, memory)
