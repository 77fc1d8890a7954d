"""Options of the task, the numbers they allow, and their defaults.

`CraneVectorEnv` and `gymnasium.make` take them as keywords, the training scripts as `--env.*`. The
scripts declare their own arguments with the same types.
"""

from collections.abc import Mapping
from types import NoneType
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypedDict,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np


class Range(NamedTuple):
    """Lowest and highest value that a number of this `Annotated` type may have."""

    low: float
    high: float


Size = Annotated[int, Range(1, 16_384)]
Width = Annotated[int, Range(1, 4096)]
Times = Annotated[int, Range(1, 1000)]
Count = Annotated[int, Range(1, 10**10)]
Threads = Annotated[int, Range(0, 256)]
Seed = Annotated[int, Range(0, 2**32 - 1)]
Share = Annotated[float, Range(0, 1)]
Factor = Annotated[float, Range(0, 1_000_000)]
Exponent = Annotated[float, Range(-20, 20)]


class OptionError(ValueError):
    """A task or an option that cannot be used. The scripts print it without a traceback."""


def check(values: Mapping[str, Any], *annotated: Any) -> None:
    """OptionError names a value that its annotation does not allow, and what it allows.

    annotated: classes or functions. It checks bools, Literals and numbers with a Range, also inside
    a tuple or next to None.
    """
    annotations = {}
    for each in annotated:
        annotations |= get_type_hints(each, include_extras=True)
    for name, value in values.items():
        if name not in annotations:
            known = ", ".join(each for each in annotations if each not in ("options", "return"))
            raise OptionError(f"there is no option {name!r}, only {known}")
        kind, items = annotations[name], [value]
        if NoneType in get_args(kind):
            kind, items = get_args(kind)[0], [] if value is None else [value]
        if get_origin(kind) is tuple:
            kind, items, name = get_args(kind)[0], value, f"each of {name}"
        limits = getattr(kind, "__metadata__", [None])[0]
        if isinstance(limits, Range):
            (low, high), whole = limits, get_args(kind)[0] is int
            types = (int, np.integer) if whole else (int, float, np.number)
            numbers = all(isinstance(i, types) and not isinstance(i, bool) for i in items)
            good = numbers and all(low <= item <= high for item in items)
            needed = f"a {'whole ' if whole else ''}number in [{low:,}, {high:,}]"
        elif get_origin(kind) is Literal or kind is bool:
            allowed = get_args(kind) or (False, True)
            good = all(item in allowed for item in items)
            needed = f"one of {', '.join(map(repr, allowed))}"
        else:  # a path, a name
            continue
        if not good:
            raise OptionError(f"{name} must be {needed}, got {value!r}")


class Options(TypedDict, total=False):
    """What can be changed about the task: keywords of `gymnasium.make`, `--env.*` of the scripts.

    In parentheses: what ForestryCrane-v0 has. Other tasks of this crane have other values.
    """

    frame_skip: Annotated[int, Range(1, 1800)]  # physics steps of 5 ms per decision (task: 20)
    actuators: Literal["ideal", "hydraulic"]  # servos, or the machine's own drives (task: ideal)
    randomize: Share  # width of the random errors of drives, log and sensors (task: 0.0)
    sensors: bool  # also observe last command, rates of q5 and q6, oil forces (task: False)
    contact: Literal["primitive", "sdf"]  # contact model of jaws and log (task: primitive)
    reward: Literal["staged", "paper"]  # staged, or as printed in the paper (task: staged)
    speed: Literal["real", "mjcf"]  # joint speed limits (task: real)
    offset: Literal["plus", "minus"]  # sign of the diameter's part in Delta_p,z (task: plus)
    signed_yaw: bool  # observe the signed angle to the log, not the paper's Delta_psi (task: True)
    axes: Literal["crane", "world"]  # of Delta_p; crane: along the boom, left, up (task: crane)
    pose_noise: Literal["none", "step", "episode"]  # how often the pose error is drawn (task: none)
    difficulty: Share  # 0: easy starts, 1: the full task (task: 1.0)
    retry: Share  # largest share of episodes that repeat a failed start (task: 0.0)
    integrator: Literal["implicitfast", "implicit", "discrete"]  # MuJoCo's (task: implicitfast)
    solver: Literal["Newton", "CG"]  # MuJoCo's constraint solver (task: Newton)


DEFAULTS = Options(
    frame_skip=20, actuators="ideal", randomize=0.0, sensors=False, contact="primitive",
    reward="staged", speed="real", offset="plus", signed_yaw=True, axes="crane",
    pose_noise="none", difficulty=1.0, retry=0.0, integrator="implicitfast", solver="Newton",
)  # fmt: skip
PAPER = Options(  # ForestryCranePaper-v0
    frame_skip=1, contact="sdf", reward="paper", offset="minus", signed_yaw=False, axes="world",
    integrator="implicit", solver="CG",
)  # fmt: skip
HYDRAULIC = Options(actuators="hydraulic", sensors=True)  # ForestryCraneHydraulic-v0
RANDOMIZED = Options(randomize=1.0, **HYDRAULIC)  # ForestryCraneRandomized-v0


def complete(options: Options) -> Options:
    """The options with all defaults filled in. OptionError names a wrong one and what it allows."""
    check(options, Options)
    return {**DEFAULTS, **options}
