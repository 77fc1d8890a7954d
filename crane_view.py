"""Look at a crane: pictures, a window, a film of trials (--video and --viewer of eval_crane.py)."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import imageio
import mujoco
import numpy as np
from numpy import ndarray as Array
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

import crane_task
from crane_env import CraneVectorEnv
from crane_trials import make_envs, monte_carlo_trials
from scripted_crane import HYDRAULIC, IDEAL, ScriptedCrane

CAMERAS = ["overview", "side", "grapple"]
LEVERS = [("Q", "A"), ("W", "S"), ("E", "D"), ("R", "F"), ("T", "G"), ("U", "J")]  # of each action
FPS = 20  # of a film
HELP = [
    ("Q A", "slew"),
    ("W S", "boom"),
    ("E D", "arm"),
    ("R F", "telescope"),
    ("T G", "rotator"),
    ("U J", "jaws"),
    ("Tab", "who drives"),
    ("Enter", "next trial"),
    ("Backspace", "this trial again"),
    ("Up Down", "thicker, thinner log"),
    ("Left Right", "slow motion, real time"),
    ("Space", "pause"),
    ("C", "camera"),
    ("Esc", "close"),
]

UNKNOWN = {  # info that `reset` lacks and `caption` shows
    "termination": np.array(["none"]),
    "time_to_reach": np.array([np.inf]),
    "time_up": np.array([np.inf]),
    "ground_peak": np.zeros(1),
    "litres": np.zeros(1),
    "time": np.zeros(1),
}


class Photographer:
    """Takes the frames of render_mode "rgb_array".

    A fraction below 1 makes them smaller than the cranes want them.
    """

    def __init__(self, cranes: CraneVectorEnv, fraction: float = 1.0, camera: str | None = None):
        self.cranes, self.camera = cranes, camera or cranes.camera
        size = [int(fraction * side) for side in cranes.frame_size]
        self.renderer = mujoco.Renderer(cranes.batch.get_model(0), *size)

    def show(self) -> tuple[Array, ...]:
        """RGB frames (height, width, 3), uint8, one a crane."""
        frames, batch = [], self.cranes.batch
        for i in range(self.cranes.num_envs):
            batch.get_model(i, self.renderer.model)
            self.renderer.update_scene(batch.get_data(i), self.camera)
            frames.append(self.renderer.render())
        return tuple(frames)

    def close(self) -> None:
        self.renderer.close()


class Window:
    """The window of render_mode "human" shows crane 0.

    The left mouse button turns the view, the right one moves it, the wheel zooms.

    Attributes: `text`, lines of two columns at the top; `help`, the same at the bottom; `pressed`,
    names of the keys that were pressed since they were last taken out.
    """

    def __init__(self, cranes: CraneVectorEnv):
        import glfw  # needs a display's libraries

        self.glfw, self.batch = glfw, cranes.batch
        if not glfw.init():
            raise RuntimeError("render_mode 'human' cannot open this display")
        glfw.window_hint(glfw.SAMPLES, 4)
        self.window = glfw.create_window(1280, 800, "Forestry crane", None, None)
        if not self.window:
            raise RuntimeError("render_mode 'human' needs a display with OpenGL")
        glfw.make_context_current(self.window)
        self.model, self.data = self.batch.get_model(0), self.batch.get_data(0)
        self.scene = mujoco.MjvScene(self.model, maxgeom=2000)
        self.option, self.camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self.context = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100)
        self.text: list[tuple[str, str]] = []
        self.help: list[tuple[str, str]] = []
        self.pressed: list[str] = []
        self.pointer = (0.0, 0.0)
        glfw.set_key_callback(self.window, self.on_key)
        glfw.set_cursor_pos_callback(self.window, self.on_move)
        glfw.set_scroll_callback(self.window, self.on_scroll)
        mujoco.mj_forward(self.model, self.data)  # places the cameras if there was no reset yet
        self.look_from(cranes.camera)

    def look_from(self, name: str) -> None:
        """Go to a camera of the model. From one that stands on the ground the mouse leads away."""
        number = self.model.camera(name).id
        self.camera.type, self.camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, number
        if self.model.cam_bodyid[number] == 0:
            position = self.data.cam_xpos[number]
            forward = -self.data.cam_xmat[number].reshape(3, 3)[:, 2]
            self.camera.type = mujoco.mjtCamera.mjCAMERA_FREE
            self.camera.distance = (self.model.stat.center - position) @ forward
            self.camera.lookat[:] = position + self.camera.distance * forward
            self.camera.azimuth = np.degrees(np.arctan2(forward[1], forward[0]))
            self.camera.elevation = np.degrees(np.arcsin(forward[2]))

    def on_key(self, window: Any, key: int, code: int, action: int, modifiers: int) -> None:
        if action == self.glfw.PRESS:
            names = (name for name in dir(self.glfw) if name.startswith("KEY_"))
            self.pressed += [n[4:] for n in names if getattr(self.glfw, n) == key]

    def on_move(self, window: Any, x: float, y: float) -> None:
        glfw, (before_x, before_y) = self.glfw, self.pointer
        self.pointer = (x, y)
        for button, motion in [
            (glfw.MOUSE_BUTTON_LEFT, mujoco.mjtMouse.mjMOUSE_ROTATE_V),
            (glfw.MOUSE_BUTTON_RIGHT, mujoco.mjtMouse.mjMOUSE_MOVE_V),
        ]:
            if glfw.get_mouse_button(window, button) == glfw.PRESS:
                height = glfw.get_window_size(window)[1]
                self.move_camera(motion, (x - before_x) / height, (y - before_y) / height)

    def on_scroll(self, window: Any, x: float, y: float) -> None:
        self.move_camera(mujoco.mjtMouse.mjMOUSE_ZOOM, 0.0, 0.05 * y)

    def move_camera(self, motion: mujoco.mjtMouse, x: float, y: float) -> None:
        mujoco.mjv_moveCamera(self.model, motion, x, y, self.camera)

    def held(self, name: str) -> bool:
        """Whether the key is down now."""
        key = getattr(self.glfw, f"KEY_{name}")
        return self.is_running() and self.glfw.get_key(self.window, key) == self.glfw.PRESS

    def is_running(self) -> bool:
        """Whether it is still open."""
        return self.window is not None and not self.glfw.window_should_close(self.window)

    def show(self) -> None:
        """Draw the crane as it is now, and read keys and mouse."""
        if not self.is_running():
            return
        self.glfw.make_context_current(self.window)  # another crane may have drawn since
        self.batch.get_model(0, self.model)
        self.batch.get_data(0, self.data)
        every = mujoco.mjtCatBit.mjCAT_ALL
        look = self.option, None, self.camera, every, self.scene
        mujoco.mjv_updateScene(self.model, self.data, *look)
        area = mujoco.MjrRect(0, 0, *self.glfw.get_framebuffer_size(self.window))
        mujoco.mjr_render(area, self.scene, self.context)
        font, grid = mujoco.mjtFont.mjFONT_NORMAL, mujoco.mjtGridPos
        for place, lines in [
            (grid.mjGRID_TOPLEFT, self.text),
            (grid.mjGRID_BOTTOMLEFT, self.help),
        ]:
            columns = ["\n".join(column) for column in zip(*lines)] or ["", ""]
            mujoco.mjr_overlay(font, place, area, *columns, self.context)
        self.glfw.swap_buffers(self.window)
        self.glfw.poll_events()

    def close(self) -> None:
        if self.window is not None:
            self.glfw.make_context_current(self.window)
            self.context.free()
            self.glfw.destroy_window(self.window)
        self.window = None


def caption(info: dict[str, Array], driver: str) -> list[tuple[str, str]]:
    """What a film and the window say of the info of a `Trial`, in two columns."""
    ended = info["termination"][0] != "none"
    if ended and not info["success"][0]:
        names = [name for name in crane_task.CONDITIONS if info[name][0]]
        phase = info["termination"][0] if info["termination"][0] != "time_limit" else names[0]
        phase = f"failed: {phase}".replace("_", " ")
    elif ended:
        phase = "success"
    elif info["clearance"][0] > 0.01:
        phase = "holding" if np.isfinite(info["time_up"][0]) else "lifting"
    else:
        phase = "gripping" if np.isfinite(info["time_to_reach"][0]) else "reaching"
    return [
        ("log", f"{info['diameter'][0]:.2f} m, {info['log_mass'][0]:.0f} kg"),
        ("driver", driver),
        ("time", f"{info['time'][0]:.1f} s"),
        ("phase", phase),
        ("on the ground", f"{info['ground_peak'][0] / 1e3:.0f} kN at most"),
        ("oil", f"{info['litres'][0]:.1f} l"),
    ]


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


class Trial:
    """One trial of one crane, as `crane_trials.run_trials` plays it, one decision after another."""

    def __init__(self, crane: CraneVectorEnv, seed: Any, diameter: float):
        self.crane, self.state, self.ended = crane, None, False
        crane.fixed_diameter = np.array([diameter])
        self.obs, info = crane.reset(seed=[seed])
        self.info = info | UNKNOWN

    def advance(self, policy: Any, deterministic: bool = True) -> None:
        """Go on by a decision. After the end `info` stays that of the end."""
        actions, self.state = policy.predict(self.obs, self.state, deterministic=deterministic)
        self.obs, _, terminated, truncated, info = self.crane.advance(actions)
        if not self.ended:
            self.info = info | {"time": self.crane.decisions * self.crane.dt}  # s
            self.ended = bool(terminated[0] or truncated[0])


def film(policy: Any, driver: str, env_id: str, options: dict, args: Any) -> None:
    """One trial per diameter, 20 frames a second, with the grapple in a corner."""
    scene = {"width": args.width, "height": args.width * 9 // 32 * 2, "camera": args.camera}
    crane = make_envs(
        env_id, 1, diameter=0.5, render_mode="rgb_array", **scene, **options
    ).unwrapped
    corner = None if args.camera == "grapple" else Photographer(crane, 1 / 3, "grapple")
    gif = args.video.suffix.lower() == ".gif"
    how = {"duration": 1000 / FPS, "loop": 0} if gif else {"fps": FPS, "macro_block_size": 2}
    seeds = [monte_carlo_trials(args.seed, args.trial + 1, [d])[1][-1] for d in args.diameters]
    frames = round(crane_task.TIME_LIMIT * FPS) * len(seeds)  # fewer where a trial ends early
    bar, filmed, successes = tqdm(total=frames, unit="frame", leave=False), 0.0, 0
    with whole_file(args.video) as path, bar, imageio.get_writer(path, **how) as video:

        def watch(seconds: float) -> None:
            """A frame each time that 1 / FPS s have passed."""
            nonlocal filmed
            filmed += seconds
            if filmed * FPS < 1 - 1e-9:
                return
            filmed -= 1 / FPS
            start = time.time()
            video.append_data(frame(crane, corner, caption(trial.info, driver)))
            if bar.n == 1:  # the first also compiles the shaders
                minutes = frames * (time.time() - start) / 60
                bar.write(f"a film of up to {frames} frames takes {minutes:.1f} minutes at most")
            bar.update()

        crane.watch = watch
        for diameter, seed in zip(args.diameters, seeds):
            trial = Trial(crane, seed, diameter)
            while not trial.ended:
                trial.advance(policy, not args.stochastic)
            successes += bool(trial.info["success"])
            end = frame(crane, corner, caption(trial.info, driver))
            for _ in range(FPS // 2):  # half a second to read it
                video.append_data(end)
    if corner is not None:
        corner.close()
    crane.close()
    count = f"{len(seeds)} trial{'s' * (len(seeds) > 1)}"
    print(f"{count} filmed in {args.video}, {successes} succeeded")


def frame(crane: CraneVectorEnv, corner: Photographer | None, lines: list) -> Array:
    """A picture with the lines of `caption`, and what another camera sees in its corner."""
    picture = Image.fromarray(crane.render()[0])
    if corner is not None:
        inset = Image.fromarray(corner.show()[0])
        picture.paste(inset, (picture.width - inset.width, picture.height - inset.height))
    return np.asarray(write_on(picture, lines))


def write_on(picture: Image.Image, lines: list[tuple[str, str]]) -> Image.Image:
    """The picture with lines of two columns at its top."""
    draw, height = ImageDraw.Draw(picture, "RGBA"), max(8, picture.height // 28)
    font = ImageFont.load_default(height)
    draw.rectangle((0, 0, 19 * height, (len(lines) + 0.5) * 1.25 * height), fill=(0, 0, 0, 120))
    for i, (name, value) in enumerate(lines):
        y = (i + 0.25) * 1.25 * height
        draw.text((0.5 * height, y), name, font=font, fill=(220, 220, 220))
        draw.text((8 * height, y), value, font=font, fill=(255, 255, 255))
    return picture


class Keyboard:
    """Drives with the keys LEVERS: each joint at its full speed while a key of it is held."""

    def __init__(self, window: Window):
        self.window = window

    def predict(self, obs: Array, state: None, deterministic: bool) -> tuple[Array, None]:
        held = [[self.window.held(key) for key in pair] for pair in LEVERS]
        return np.array([[float(up) - float(down) for up, down in held]]), None


def show(policy: Any, driver: str, env_id: str, options: dict, args: Any) -> None:
    """Trials in a window, in real time, until it is closed. Keys: HELP."""
    scene = {"render_mode": "human", "camera": args.camera}
    crane = make_envs(env_id, 1, diameter=0.5, **scene, **options).unwrapped
    crane.reset(seed=args.seed)
    window, first = crane.viewer, CAMERAS.index(args.camera)
    cameras = CAMERAS[first:] + CAMERAS[:first]
    window.help = HELP
    drivers = {driver: policy, "keyboard": Keyboard(window)}
    known = {"axes": "crane", "offset": "plus", "frame_skip": 20, "speed": "real"}
    if known.items() <= crane.options.items():
        settings = HYDRAULIC if crane.options["actuators"] == "hydraulic" else IDEAL
        drivers["scripted"] = ScriptedCrane(crane.options["signed_yaw"], settings)
    names, number, diameter = list(drivers), args.trial, args.diameters[0]
    speed, paused = 1.0, False
    drawn_at = time.time()

    def new_trial() -> Trial:
        seed = monte_carlo_trials(args.seed, number + 1, [diameter])[1][-1]
        trial = Trial(crane, seed, diameter)
        window.text = caption(trial.info, names[0])
        return trial

    def watch(seconds: float) -> None:
        """Draw in time with the clock."""
        nonlocal drawn_at
        window.show()
        time.sleep(max(0.0, seconds / speed - (time.time() - drawn_at)))
        drawn_at = time.time()

    crane.watch = watch
    trial, ended_at = new_trial(), np.inf
    while window.is_running():
        again = False
        for key in window.pressed:
            if key == "TAB":
                names.append(names.pop(0))
                trial.state = None
            elif key == "C":
                cameras.append(cameras.pop(0))
                window.look_from(cameras[0])
            elif key in ("LEFT", "RIGHT"):
                speed = 0.25 if key == "LEFT" else 1.0
            elif key == "SPACE":
                paused = not paused
            elif key == "ESCAPE":
                return crane.close()
            elif key in ("UP", "DOWN"):
                again, change = True, 0.1 if key == "UP" else -0.1
                diameter = float(np.clip(diameter + change, crane_task.D_MIN, crane_task.D_MAX))
            elif key in ("ENTER", "BACKSPACE"):
                again, number = True, number + (key == "ENTER")
        window.pressed.clear()
        if paused:
            ended_at = time.time() if trial.ended else np.inf
        elif time.time() > ended_at + 2 and names[0] != "keyboard":
            again, number = True, number + 1
        if again:
            trial, ended_at = new_trial(), np.inf
        if paused:
            watch(0.02)
            continue
        was_ended = trial.ended
        trial.advance(drivers[names[0]], not args.stochastic)
        window.text = caption(trial.info, names[0])
        if trial.ended and not was_ended:
            ended_at = time.time()
    crane.close()
