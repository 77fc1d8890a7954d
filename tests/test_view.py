"""Pictures, window and film: what stands in them, not whether they please."""

import os
import shutil
import subprocess
import sys
import time

import gymnasium
import numpy as np
import pytest

import crane_env
import crane_policies
import crane_trials
import crane_view
import eval_crane
import machine
from crane_env import CraneVectorEnv
from crane_trials import monte_carlo_trials
from scripted_crane import IDEAL, ScriptedCrane

LOOK = """
import glfw, mujoco, numpy as np
from crane_env import CraneVectorEnv
envs = CraneVectorEnv(1, diameter=0.8, render_mode="human")
envs.reset(seed=0)
window, model = envs.viewer, envs.viewer.model
for name in ("overview", "side"):
    window.look_from(name)
    window.show()
    eyes = [np.array(window.scene.camera[k].pos) for k in (0, 1)]
    assert np.allclose(np.mean(eyes, axis=0), model.camera(name).pos, atol=1e-3), name
    area = mujoco.MjrRect(0, 0, *glfw.get_framebuffer_size(window.window))
    pixels = np.zeros((area.height, area.width, 3), np.uint8)
    mujoco.mjr_readPixels(pixels, None, area, window.context)
    red, green, blue = np.moveaxis(pixels.astype(int), -1, 0)
    paint = ((red > 100) & (green < red / 2) & (blue < red / 2)).mean()
    assert 0.005 < paint < 0.1, (name, paint)
far = window.camera.distance
window.on_scroll(None, 0, 1)
assert window.camera.distance < 0.99 * far
other = CraneVectorEnv(1, diameter=0.3, render_mode="human")
other.reset(seed=1)
window.show()
window.on_key(None, glfw.KEY_TAB, 0, glfw.PRESS, 0)
assert window.pressed == ["TAB"] and not window.held("Q")
envs.close()
assert not window.is_running()
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="needs Xvfb, a display without a screen")
def test_the_window_looks_from_the_cameras():
    """From where crane.xml has them, and nothing stands in front of them."""
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "800x600x24"]
    display = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
    os.close(write)
    with os.fdopen(read) as pipe:
        number = pipe.readline().strip()
    try:
        environment = {**os.environ, "DISPLAY": f":{number}", "MUJOCO_GL": "glfw"}
        ran = subprocess.run(
            [sys.executable, "-c", LOOK], env=environment, capture_output=True, text=True
        )
    finally:
        display.terminate()
        display.wait()
    assert ran.returncode == 0, ran.stderr


class FakeWindow:
    """Presses keys as planned: (frame, key). Remembers what it was to show."""

    plan: list = []
    holds: dict = {}

    def __init__(self, cranes):
        self.cranes, self.frame, self.pressed, self.text, self.seen = cranes, 0, [], [], []
        self.open, self.views = True, []

    def show(self):
        self.frame += 1
        self.pressed += [key for frame, key in self.plan if frame == self.frame]
        self.seen.append(dict(self.text) | {"q1": self.cranes.qpos[0, 0]})

    def held(self, key):
        return self.frame in self.holds.get(key, ())

    def look_from(self, name):
        self.views.append(name)

    def is_running(self):
        return self.open

    def close(self):
        self.open = False


def look(monkeypatch, plan, holds=None, **options):
    """The window after `show` has gone through the plan with a crane that nobody moves."""
    monkeypatch.setattr(crane_env, "HEADLESS", False)
    monkeypatch.setattr(crane_view, "Window", FakeWindow)
    monkeypatch.setattr(time, "sleep", lambda seconds: slept.append(seconds))
    slept = []
    FakeWindow.plan, FakeWindow.holds = plan, holds or {}
    windows = []
    fake_init = FakeWindow.__init__

    def remember(self, cranes):
        fake_init(self, cranes)
        windows.append(self)

    monkeypatch.setattr(FakeWindow, "__init__", remember)
    args = eval_crane.Args(policy="zero", diameters=(0.4, 0.5))
    zero = crane_policies.FixedPolicy("zero")
    crane_view.show(zero, "zero", "ForestryCrane-v0", options, args)
    return windows[0], slept


def test_keys_of_the_window(monkeypatch):
    window, slept = look(
        monkeypatch,
        [(10, "UP"), (20, "LEFT"), (30, "C"), (40, "TAB"), (50, "TAB"), (90, "ESCAPE")],
        {"Q": range(50, 70)},
    )
    assert not window.open and window.views == ["side"]
    assert window.seen[8]["log"].startswith("0.40 m") and window.seen[15]["log"].startswith("0.50")
    assert [window.seen[k]["driver"] for k in (35, 48, 85)] == ["zero", "keyboard", "scripted"]
    assert np.median(slept[25:]) > 2 * np.median(slept[:15])


@pytest.mark.parametrize("option", [{"speed": "mjcf"}, {"axes": "world"}])
def test_the_scripted_crane_drives_only_what_it_knows(monkeypatch, option):
    window, _ = look(monkeypatch, [(10, "TAB"), (20, "TAB"), (40, "ESCAPE")], **option)
    assert [window.seen[k]["driver"] for k in (5, 15, 30)] == ["zero", "keyboard", "zero"]


def test_a_lever_moves_its_joint_until_it_is_let_go(monkeypatch):
    window, _ = look(monkeypatch, [(1, "TAB"), (120, "ESCAPE")], {"Q": range(20, 60)})
    q1 = [shown["q1"] for shown in window.seen]
    assert q1[70] - q1[20] > 0.4  # one second at up to 0.8 rad/s
    assert abs(q1[18] - q1[10]) < 0.02 and abs(q1[118] - q1[90]) < 0.02


@pytest.mark.parametrize("env_id", ["ForestryCrane-v0", "ForestryCraneHydraulic-v0"])
def test_what_is_shown_is_the_trial_that_is_judged(env_id):
    """To the last bit, though it is drawn several times in a decision."""
    options = {"diameter": 0.3, "pose_noise": "step"}
    seed = monte_carlo_trials(10_000, 1, [0.3])[1]
    scripted = ScriptedCrane(settings=IDEAL)
    judged = crane_trials.run_trials(scripted, crane_trials.make_envs(env_id, 1, **options), seed)
    crane = CraneVectorEnv(1, **options, **gymnasium.spec(env_id).kwargs)
    drawn = []
    crane.watch = drawn.append
    trial = crane_view.Trial(crane, seed[0], 0.3)
    while not trial.ended:
        trial.advance(scripted)
    for name in ("success", "ground_peak", "litres", "swing_peak", "centre_miss"):
        assert trial.info[name][0] == judged[name][0], name
    assert trial.info["time"][0] == pytest.approx(crane.decisions[0] * 0.1)
    assert np.sum(drawn) == pytest.approx(crane.decisions[0] * 0.1)
    assert len(drawn) == crane.decisions[0] * (5 if crane.hydraulic else 4)
    ended_at = trial.info["time"][0]
    trial.advance(scripted)
    assert trial.info["time"][0] == ended_at  # the clock stands after the end


def test_the_next_trial_is_the_judges(monkeypatch):
    """The window shows the trials that the tables count."""
    starts = []
    original = CraneVectorEnv.place

    def place(envs, ids, q, log_pose, diameter):
        starts.append((q[0].copy(), diameter[0]))
        original(envs, ids, q, log_pose, diameter)

    monkeypatch.setattr(CraneVectorEnv, "place", place)
    look(monkeypatch, [(5, "ENTER"), (15, "BACKSPACE"), (25, "DOWN"), (35, "ESCAPE")])
    starts = starts[1:]  # the first opens the window
    for k, (trial, diameter) in enumerate([(0, 0.4), (1, 0.4), (1, 0.4), (1, 0.3)]):
        seed = monte_carlo_trials(10_000, 2, [diameter])[1][trial]
        judged = CraneVectorEnv(1, diameter=diameter)
        judged.reset(seed=[seed])
        np.testing.assert_array_equal(starts[k][0], judged.state().q[0])
        assert starts[k][1] == pytest.approx(diameter)


@pytest.mark.parametrize(
    "change, phase",
    [
        ({}, "reaching"),
        ({"time_to_reach": 1.0}, "gripping"),
        ({"time_to_reach": 1.0, "clearance": 0.2}, "lifting"),
        ({"time_up": 5.0, "clearance": 0.2}, "holding"),
        ({"termination": "overspeed"}, "failed: overspeed"),
        ({"termination": "time_limit", "not_held": True}, "failed: not held"),
        ({"termination": "time_limit", "success": True}, "success"),
    ],
)
def test_the_caption_names_the_phase(change, phase):
    info = {"termination": "none", "success": False, "time_up": np.inf, "time_to_reach": np.inf}
    info |= {"clearance": 0.0, "diameter": 0.5, "log_mass": 351.0, "ground_peak": 2e3, "litres": 1}
    info["time"] = 1.2
    info |= {name: False for name in ("not_reached", "not_lifted", "not_held", "off_centre")}
    info = {name: np.array([value]) for name, value in (info | change).items()}
    lines = dict(crane_view.caption(info, "mine"))
    assert lines["phase"] == phase and lines["time"] == "1.2 s"
    assert lines["log"] == "0.50 m, 351 kg" and lines["on the ground"] == "2 kN at most"


def test_the_world_is_only_seen():
    """Trees and stones touch nothing, stand clear of crane and cameras, and are not simulated."""
    bare, seen = machine.load_model(visual=False), machine.load_model()
    assert seen.ngeom > bare.ngeom + 300
    for name in ("qpos0", "body_mass", "body_inertia", "dof_damping"):
        np.testing.assert_array_equal(getattr(bare, name), getattr(seen, name))
    assert seen.nbody == bare.nbody
    added = (seen.geom_group == 1).nonzero()[0]
    assert not seen.geom_contype[added].any() and not seen.geom_conaffinity[added].any()
    trees = added[seen.geom_type[added] == 7]  # meshes
    assert len(trees) == 150
    far = np.linalg.norm(seen.geom_pos[trees, :2], axis=1)
    assert far.min() - 3.4 > np.linalg.norm(seen.camera("overview").pos[:2])  # the widest tree
