"""Look at a policy: a film of trials, or a window (--video and --viewer of eval_crane.py)."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import imageio
from tqdm import tqdm

import crane_task
import machine
from crane_trials import make_envs, monte_carlo_trials


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A path to write to, which becomes `path` once all is written. An error leaves nothing."""
    path = path.resolve()
    unfinished = path.with_name(f"unfinished_{path.name}")
    try:
        yield unfinished
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def film(policy: Any, env_id: str, options: dict, args: Any) -> None:
    """One trial per diameter, 20 frames a second. A frame is also taken halfway through a decision
    of 0.1 s.
    """
    size = {"width": args.width, "height": args.width * 9 // 32 * 2}
    scene = options | size | {"render_mode": "rgb_array", "camera": args.camera}
    skip = make_envs(env_id, 1, **options).unwrapped.frame_skip
    substeps = 2 if skip % 20 == 0 else 1
    scene["frame_skip"] = skip // substeps
    frame_every = max(1, round(10 / scene["frame_skip"]))
    fps = round(1 / (frame_every * scene["frame_skip"] * machine.TIMESTEP))
    gif = args.video.suffix.lower() == ".gif"
    how = {"duration": 1000 / fps, "loop": 0} if gif else {"fps": fps, "macro_block_size": 2}
    diameters, seeds = monte_carlo_trials(args.seed, 1, args.diameters)
    frames = round(crane_task.TIME_LIMIT * fps) * len(seeds)  # fewer where a trial ends early
    bar, mean = tqdm(total=frames, unit="frame", leave=False), not args.stochastic
    with whole_file(args.video) as path, bar, imageio.get_writer(path, **how) as video:
        for diameter, seed in zip(diameters, seeds):
            crane = make_envs(env_id, 1, diameter=diameter, **scene).unwrapped
            obs, _ = crane.reset(seed=[seed])
            state, ended, step = None, False, 0
            while not ended:
                if step % substeps == 0:
                    actions, state = policy.predict(obs, state, deterministic=mean)
                obs, _, terminated, truncated, _ = crane.advance(actions)
                if step % frame_every == 0:
                    video.append_data(crane.render()[0])
                    bar.update()
                ended, step = terminated[0] or truncated[0], step + 1
            crane.close()
    print(f"{len(seeds)} trials filmed in {args.video}")


def show(policy: Any, env_id: str, options: dict, args: Any) -> None:
    """Trials in a window, in real time, until it is closed. Diameters are drawn."""
    crane = make_envs(env_id, 1, render_mode="human", **options).unwrapped
    obs, _ = crane.reset(seed=args.seed)
    state = None
    while crane.viewer.is_running():
        start = time.time()
        actions, state = policy.predict(obs, state, deterministic=not args.stochastic)
        obs, _, terminated, truncated, info = crane.step(actions)
        if terminated[0] or truncated[0]:
            print("success" if info["success"][0] else f"failed: {info['termination'][0]}")
            state = None
        time.sleep(max(0.0, crane.dt - (time.time() - start)))
    crane.close()
