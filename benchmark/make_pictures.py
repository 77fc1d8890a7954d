"""Pictures of the shipped policies, for README.md and docs/: a film, stills, failures.

    python benchmark/make_pictures.py hero      # assets/figures/lift.gif, two logs side by side
    python benchmark/make_pictures.py stills    # assets/figures/stills.jpg, six moments of a trial
    python benchmark/make_pictures.py failures  # assets/figures/failures.jpg, ends of failed trials

Each takes some minutes without a GPU: MuJoCo then draws on the processor.
"""

import sys
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

sys.path.insert(0, str(Path(__file__).parent.parent))

import crane_policies
import crane_runs
import crane_trials
import crane_view
import numpy as np
import torch
import tyro
from crane_trials import REPORT_SEED, monte_carlo_trials
from numpy import ndarray as Array
from PIL import Image
from tqdm import tqdm
from tyro.conf import Positional

import eval_crane

FIGURES = Path(__file__).parent.parent / "assets" / "figures"
FPS = 10  # a frame each decision


def frames_of(
    policy: Any, task: dict, diameter: float, number: int, size: tuple[int, int]
) -> Iterator[tuple[float, Array, dict]]:
    """Time in s, picture and `info` after each decision of a trial; size is (width, height)."""
    args = eval_crane.Args(seed=REPORT_SEED)
    env_id, options = eval_crane.task_of(args, task)
    scene = {"render_mode": "rgb_array", "width": size[0], "height": size[1]}
    crane = crane_trials.make_envs(env_id, 1, diameter=diameter, **scene, **options).unwrapped
    seed = monte_carlo_trials(REPORT_SEED, number + 1, [diameter])[1][-1]
    trial = crane_view.Trial(crane, seed, diameter)
    yield 0.0, crane.render()[0], trial.info
    while not trial.ended:
        trial.advance(policy)
        yield crane.decisions[0] * crane.dt, crane.render()[0], trial.info
    crane.close()


def hero(policy: Any, task: dict) -> None:
    """A thin and a thick log side by side, 800 pixels wide, in at most 2.5 MB."""
    columns = []
    for diameter in tqdm((0.3, 0.8), unit="trial"):
        taken = frames_of(policy, task, diameter, 1, (400, 300))
        columns.append(
            [labelled(picture, f"{diameter} m, {time:.1f} s") for time, picture, _ in taken]
        )
    film = []
    for row in zip(*columns):
        film.append(Image.fromarray(np.concatenate([np.asarray(p) for p in row], axis=1)))
    # One palette and no dithering: where nothing moves no pixel changes, and GIF stores nothing.
    palette = film[len(film) // 2].quantize(160)
    film = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in film]
    file = FIGURES / "lift.gif"
    how = {"save_all": True, "append_images": film[1:], "duration": 1000 / FPS, "loop": 0}
    with crane_view.whole_file(file) as path:
        film[0].save(path, format="GIF", **how)
    print(f"{file}: {file.stat().st_size / 1e6:.2f} MB")


def sheet(pictures: list[Image.Image], columns: int, file: Path) -> None:
    """Pictures of equal size in rows."""
    width, height = pictures[0].size
    rows = -(-len(pictures) // columns)
    whole = Image.new("RGB", (columns * width, rows * height), "white")
    for k, picture in enumerate(pictures):
        whole.paste(picture, (k % columns * width, k // columns * height))
    with crane_view.whole_file(file) as path:
        whole.save(path, format="JPEG", quality=85)
    print(f"{file}: {file.stat().st_size / 1e6:.2f} MB")


def labelled(picture: Array, text: str) -> Image.Image:
    return crane_view.write_on(Image.fromarray(picture), [(text, "")])


def stills(policy: Any, task: dict) -> None:
    """Six moments of a grasp, as in the paper's figure."""
    moments = [0.0, 1.5, 3.0, 4.0, 5.0, 9.0]
    taken = frames_of(policy, task, 0.5, 0, (400, 300))
    shots = [labelled(p, f"{t:.1f} s") for t, p, _ in taken if round(t, 1) in moments]
    sheet(shots, 3, FIGURES / "stills.jpg")


def failures(policy: Any, task: dict) -> None:
    """Up to six failed trials of the 600, as they ended: of each diameter and failure one first."""
    args = eval_crane.Args(seed=REPORT_SEED)
    records = list(eval_crane.judge(policy, *eval_crane.task_of(args, task), args))
    kinds: dict[tuple, list[int]] = {}
    for index, record in enumerate(records):
        if record["failure"]:
            kinds.setdefault((record["diameter"], record["failure"]), []).append(index)
    by_turns = [index for turn in zip_longest(*kinds.values()) for index in turn]
    shots = []
    for index in sorted([index for index in by_turns if index is not None][:6]):
        diameter, failure = records[index]["diameter"], records[index]["failure"]
        *_, (time, picture, _) = frames_of(policy, task, diameter, index % args.trials, (400, 300))
        shots.append(labelled(picture, f"{diameter} m, {failure.replace('_', ' ')}, {time:.1f} s"))
    if not shots:
        raise SystemExit("none of the trials failed")
    sheet(shots, 3, FIGURES / "failures.jpg")


def main(
    what: Positional[Literal["hero", "stills", "failures"]],
    policy: Positional[Path] = crane_policies.SHIPPED,
) -> None:
    """policy: a run's folder or policy.pt."""
    torch.set_num_threads(1)
    agent, task, _ = crane_policies.load_policy(policy)
    {"hero": hero, "stills": stills, "failures": failures}[what](agent, task)


if __name__ == "__main__":
    crane_runs.one_line_errors()
    tyro.cli(main, description=__doc__.partition("\n\n")[0])
