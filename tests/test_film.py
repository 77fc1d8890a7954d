"""Films and the window: which trial they show, and that it moves as where it is evaluated."""

from contextlib import nullcontext
from types import SimpleNamespace

import gymnasium
import imageio.v3 as imageio
import mujoco.viewer
import numpy as np
import pytest

from crane_env import CraneVectorEnv
from crane_utils import film
from crane_utils.trials import make_envs, monte_carlo_trials, run_trials
from crane_utils.world import decorate
from hydraulic_crane import HydraulicCraneVectorEnv


class Short(HydraulicCraneVectorEnv):
    """Three steps, which succeed with thin logs."""

    TIME_LIMIT, HOLD_TIME = 0.3, 0.1

    def conditions(self, state, info):
        return {"too_thick": state.diameter < 0.5}


gymnasium.register("Short-v0", vector_entry_point=Short)
OPTIONS = {"randomize": 1.0, "pose_noise": "step"}


class Waving:
    """A policy that keeps what it sees."""

    def __init__(self):
        self.seen, self.fails = [], False

    def predict(self, obs, state, deterministic=True):
        step = 0 if state is None else state
        self.seen.append(obs[0].copy())
        if self.fails and step:
            raise RuntimeError("lost")
        return np.cos(step + np.arange(6))[None], step + 1


@pytest.mark.parametrize("file", ["film.gif", "film.mp4"])
def test_a_film_shows_the_trials_that_are_evaluated(opengl, tmp_path, file):
    """To the last bit, with another trial's number; and a film that fails leaves the old one."""
    filmed, evaluated, path = Waving(), Waving(), tmp_path / file
    what = ("mine", "Short-v0", OPTIONS, path, [0.3, 0.8], 10_000, 2)
    assert film.film(filmed, *what, width=128) == [True, False]
    for diameter in (0.3, 0.8):
        _, seeds = monte_carlo_trials(10_000, 3, [diameter])
        envs = make_envs("Short-v0", 1, 1, OPTIONS, diameter=diameter)
        assert run_trials(evaluated, envs, seeds[2:])["success"] == [diameter == 0.3]
    np.testing.assert_array_equal(filmed.seen, evaluated.seen)
    frames = imageio.imread(path)
    most = 32  # 20 a second of both trials; GIF merges equal ones
    assert frames.shape[1:] == (72, 128, 3) and 12 <= len(frames) <= most
    assert len(frames) == most or path.suffix == ".gif"
    assert np.abs(frames[0].astype(int) - frames[5]).max() > 30 and frames[0].std() > 10
    filmed.fails, before = True, path.read_bytes()
    with pytest.raises(RuntimeError, match="lost"):
        film.film(filmed, *what, width=128)
    assert path.read_bytes() == before and [*tmp_path.iterdir()] == [path]


def test_the_caption_names_the_phase():
    envs, phases = Short(1, diameter=0.4), []
    envs.reset(seed=0)
    metrics = film.Metrics(envs)
    for reached, height, streak in [(np.inf, 0.2, 0), (1.0, 0.2, 0), (1.0, 2.0, 1), (1.0, 2.0, 6)]:
        envs.reach_time[:], envs.qpos[0, 12] = reached, height
        envs.streaks = {"too_thick": np.array([streak])}
        envs.batch.forward()
        phases.append(film.caption(envs, "mine", metrics, None)["phase"])
    phases += [film.caption(envs, "mine", metrics, end)["phase"] for end in ("not_held", "")]
    assert phases == ["reaching", "gripping", "lifting", "safe", "failed: not held", "success"]


def test_the_window_shows_the_trials_that_are_evaluated(monkeypatch):
    """Enter is the next trial, Down a thinner log. A key drives a joint by hand."""
    keys = {5: 257, 40: 264, 70: ord("."), 71: 268, 74: ord("1")}  # Enter, Down, Home
    starts, shown, q1, place = [], [], [], CraneVectorEnv.place

    def launch(model, data, key_callback, **kwargs):
        def sync():
            q1.append(data.qpos[0])
            if key := keys.get(len(shown)):
                key_callback(key)

        opt, cam = SimpleNamespace(geomgroup=np.ones(6)), SimpleNamespace()
        viewer = SimpleNamespace(opt=opt, cam=cam, lock=nullcontext, sync=sync, close=list)
        viewer.set_texts = lambda text: shown.append([line.split("\n") for line in text[2:]])
        viewer.is_running = lambda: len(shown) < 110
        return viewer

    def record(envs, ids, q, log_pose, diameter):
        starts.append((*q[0], *log_pose[0], diameter[0]))
        place(envs, ids, q, log_pose, diameter)

    monkeypatch.setattr(mujoco.viewer, "launch_passive", launch)
    monkeypatch.setattr(Short, "TIME_LIMIT", 0.6)
    monkeypatch.setattr(film.time, "sleep", lambda seconds: None)
    monkeypatch.setattr(CraneVectorEnv, "place", record)
    film.window(Waving(), "mine", "Short-v0", OPTIONS, diameter=0.5, seed=10_000)
    begun, starts[:] = starts[:], []
    for diameter, trial in [(0.5, 0), (0.5, 1), (0.4, 1), (0.4, 1)]:
        seeds = monte_carlo_trials(10_000, 2, [diameter])[1]
        make_envs("Short-v0", 1, 1, OPTIONS, diameter=diameter).reset(seed=[seeds[trial]])
    assert begun == starts
    said = [dict(zip(*columns)) for columns in shown]
    assert [said[k]["driver"] for k in (60, 80)] == ["mine", "keyboard"]
    assert said[38]["phase"] == "failed: too thick" and said[0]["log"].startswith("0.50 m")
    assert q1[109] < q1[86] - 0.02


def test_the_world_is_only_seen():
    """Trees and stones touch nothing, stand clear of the cameras, and are not simulated."""
    bare = CraneVectorEnv(1, render_mode="rgb_array").model
    seen = CraneVectorEnv(1, render_mode="rgb_array", decorate=decorate).model
    assert seen.ngeom > bare.ngeom + 300 and seen.nbody == bare.nbody
    added = (seen.geom_group == 1).nonzero()[0]
    assert not seen.geom_contype[added].any() and not seen.geom_conaffinity[added].any()
    trees = added[seen.geom_type[added] == mujoco.mjtGeom.mjGEOM_MESH]
    far = np.linalg.norm(seen.geom_pos[trees, :2], axis=1)
    assert far.min() - 3.4 > np.linalg.norm(seen.camera("overview").pos[:2])  # the widest tree
