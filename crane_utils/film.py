"""Watch a crane: --video and --viewer of eval_crane.py."""

import os
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from numpy import ndarray as Array
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

from crane_env import D_MAX, D_MIN, CraneVectorEnv, log_clearance
from crane_utils.metrics import Metrics
from crane_utils.trials import make_envs, monte_carlo_trials, run_trials
from crane_utils.world import decorate

FPS = 20  # frames a second of a film

# MuJoCo's viewer uses every letter itself. It tells us when a key goes down, not when it goes up.
LEVERS = list("1234567890-=")  # two keys for each of the six actions: negative and positive
KEYS = {257: "Enter", 264: "Down", 265: "Up", 268: "Home"}  # GLFW's
KEYS |= {ord(key): key for key in [*LEVERS, "."]}
HELP = """
.            who drives: policy or keyboard
1 2, 3 4     slew right, left; boom down, up
5 6, 7 8     arm down, up; telescope in, out
9 0, - =     rotator left, right; jaws open, close
             A joint moves at full speed until you press one of its two keys again.
Enter, Home  next trial, this trial again
Up, Down     this trial with a thicker, thinner log
[ ], Esc     other cameras, free camera (mouse)
"""


def caption(crane: CraneVectorEnv, driver: str, metrics: Metrics, failure: str | None) -> dict:
    """What a film and the window say of crane 0; failure is that of `info`, None before the end."""
    state = crane.state()
    if failure is not None:
        phase = f"failed: {failure}".replace("_", " ") if failure else "success"
    elif log_clearance(state)[0] < 0.01:
        phase = "gripping" if np.isfinite(crane.reach_time[0]) else "reaching"
    else:  # the log is off the ground
        safe = all(streak[0] >= crane.hold_steps for streak in crane.streaks.values())
        phase = "safe" if safe else "lifting"
    mass = crane.log_mass[0]
    return {
        "log": f"{state.diameter[0]:.2f} m, {mass:.0f} kg",
        "driver": driver,
        "time": f"{crane.batch.time[0]:.1f} s",
        "phase": phase,
        "hardest hit": f"{crane.ground_peak[0] / 1e3:.0f} kN",
        "oil": f"{metrics.values['litres'][0]:.1f} l",
    }


def frame(crane: CraneVectorEnv, lines: dict[str, str]) -> Array:
    """What the camera of crane 0 sees, below lines of two columns: (height, width, 3), uint8.

    What the grapple's camera sees is in the lower right corner.
    """
    picture = Image.fromarray(crane.render()[0])
    if crane.camera != "grapple":
        inset = Image.fromarray(crane.picture(0, "grapple")).reduce(3)
        picture.paste(inset, (picture.width - inset.width, picture.height - inset.height))
    draw, size = ImageDraw.Draw(picture, "RGBA"), picture.height // 28
    font = ImageFont.load_default(size)
    draw.rectangle((0, 0, 21 * size, (len(lines) + 0.5) * 1.25 * size), fill=(0, 0, 0, 120))
    for i, (name, value) in enumerate(lines.items()):
        y = (i + 0.25) * 1.25 * size
        draw.text((0.5 * size, y), name, font=font, fill=(220, 220, 220))
        draw.text((9 * size, y), value, font=font, fill=(255, 255, 255))
    return np.asarray(picture)


def film(
    policy: Any, name: str, env_id: str, options: dict[str, Any], path: Path,
    diameters: Sequence[float], seed: int, trial: int = 0, camera: str = "overview",
    width: int = 640, deterministic: bool = True,
) -> list[bool]:  # fmt: skip
    """Film one trial per log diameter (m) into an .mp4 or .gif; which of them succeeded.

    Each is trial number `trial` of `evaluate` with this seed. width is in pixels.
    """
    look = {"render_mode": "rgb_array", "camera": camera, "decorate": decorate}
    look |= {"width": width, "height": width * 9 // 32 * 2}  # 16:9, the height is even
    envs = make_envs(env_id, 1, 1, options, autoreset=False, **look)
    crane = envs.unwrapped
    metrics = Metrics(crane)
    gif = path.suffix.lower() == ".gif"
    how = {"duration": 1000 / FPS, "loop": 0} if gif else {"fps": FPS, "macro_block_size": 2}
    frames = round(crane.TIME_LIMIT * FPS) * len(diameters)  # at most
    successes, waited = [], 0.0

    def shoot(crane: CraneVectorEnv) -> None:
        """A frame each time that 1 / FPS s have passed."""
        nonlocal waited
        waited += crane.model.opt.timestep
        if waited > 1 / FPS - 1e-9:
            waited -= 1 / FPS
            video.append_data(frame(crane, caption(crane, name, metrics, None)))
            bar.update()

    crane.observers.append(shoot)
    unfinished = path.with_name(f"unfinished_{path.name}")
    try:
        bar = tqdm(total=frames, unit="frame", leave=False)
        with bar, imageio.get_writer(unfinished, **how) as video:
            for diameter in diameters:
                _, seeds = monte_carlo_trials(seed, trial + 1, [diameter])
                crane.fixed_diameter = np.array([diameter])
                metrics.clear(np.array([0]))
                results = run_trials(policy, envs, seeds[-1:], deterministic)
                successes.append(bool(results["success"][0]))
                end = frame(crane, caption(crane, name, metrics, results["failure"][0]))
                for _ in range(FPS // 2):  # half a second to read it
                    video.append_data(end)
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)
        envs.close()
    print(f"{path}: {sum(successes)} of {len(successes)} filmed trials succeeded")
    return successes


def window(
    policy: Any, name: str, env_id: str, options: dict[str, Any], diameter: float,
    seed: int, trial: int = 0, camera: str = "overview", deterministic: bool = True,
) -> None:  # fmt: skip
    """Show trials in real time until the window is closed. Keys: HELP.

    diameter (m), seed and trial say which trial is first. macOS needs mjpython instead of python.
    """
    import mujoco.viewer  # needs a display

    look = {"render_mode": "human", "decorate": decorate}
    crane = make_envs(env_id, 1, 1, options, autoreset=False, **look).unwrapped
    metrics = Metrics(crane)
    print(HELP)
    # The window that the environment would open at its first `render`, with our keys.
    pressed: deque[int] = deque()
    crane.scene = crane.batch.get_model(0), crane.batch.get_data(0)
    ui = {"show_left_ui": False, "show_right_ui": False}
    crane.viewer = mujoco.viewer.launch_passive(*crane.scene, key_callback=pressed.append, **ui)
    crane.viewer.cam.type = mujoco.mjtCamera.mjCAMERA_FIXED
    crane.viewer.cam.fixedcamid = crane.model.camera(camera).id
    shown_groups = crane.viewer.opt.geomgroup.copy()
    by_hand, restart, drawn_at, waited = False, True, time.perf_counter(), 0.0
    levers, failure = np.zeros(6), None

    def watch(crane: CraneVectorEnv) -> None:
        """Each time that 1 / FPS s have passed, wait for the clock and draw."""
        nonlocal drawn_at, waited
        waited += crane.model.opt.timestep
        if waited < 1 / FPS - 1e-9:
            return
        lines = caption(crane, "keyboard" if by_hand else name, metrics, failure)
        place = mujoco.mjtFont.mjFONT_NORMAL, mujoco.mjtGridPos.mjGRID_TOPLEFT
        crane.viewer.set_texts((*place, "\n".join(lines), "\n".join(lines.values())))
        crane.viewer.opt.geomgroup[:] = shown_groups  # the viewer's keys 0 ... 5 hide some
        crane.render()
        time.sleep(max(0.0, drawn_at + waited - time.perf_counter()))
        drawn_at, waited = time.perf_counter(), 0.0

    crane.observers.append(watch)
    while crane.viewer.is_running():
        while pressed:
            key = KEYS.get(pressed.popleft())
            if key in LEVERS:
                joint, positive = divmod(LEVERS.index(key), 2)
                levers[joint] = 0 if levers[joint] else 2 * positive - 1
            elif key == ".":
                by_hand, state, levers = not by_hand, None, np.zeros(6)
            elif key in ("Enter", "Home", "Up", "Down"):
                restart, trial = True, trial + (key == "Enter")
                change = {"Up": 0.1, "Down": -0.1}.get(key, 0.0)
                diameter = min(max(round(diameter + change, 3), D_MIN), D_MAX)
        if restart:
            _, seeds = monte_carlo_trials(seed, trial + 1, [diameter])
            crane.fixed_diameter = np.array([diameter])
            metrics.clear(np.array([0]))
            obs, _ = crane.reset(seed=seeds[-1:])
            restart, state, failure, levers = False, None, None, np.zeros(6)
        if failure is not None:
            waited = 1 / FPS
            watch(crane)
            continue
        actions = levers[None]
        if not by_hand:
            actions, state = policy.predict(obs, state, deterministic=deterministic)
        obs, _, terminated, truncated, info = crane.step(actions)
        if terminated[0] or truncated[0]:
            failure = str(info["failure"][0])
    crane.close()
