"""The view of the cranes for Stable-Baselines3, and SB3's algorithms on it."""

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

import crane_policies
import crane_task
import crane_trials
from crane_env import CraneVectorEnv
from sb3_crane import CraneVecEnv


@pytest.fixture(autouse=True)
def threads():
    """SB3 sets none, and other tests may."""
    torch.set_num_threads(1)


def test_steps_are_the_cranes():
    """Also over the ends of episodes, where SB3 wants the last observation in `infos`."""
    view, cranes = CraneVecEnv(5, env_threads=1), CraneVectorEnv(5, env_threads=1)
    view.seed(7)
    np.testing.assert_array_equal(view.reset(), cranes.reset(seed=7)[0])
    rng, ends = np.random.default_rng(0), 0
    for _ in range(100):
        actions = np.sign(rng.uniform(-1, 1, (5, 6)))
        obs, reward, done, infos = view.step(actions)
        expected, pay, terminated, truncated, info = cranes.step(actions)
        np.testing.assert_array_equal(obs, expected)
        np.testing.assert_allclose(reward, pay, rtol=1e-6)
        assert (done == (terminated | truncated)).all() and reward.dtype == np.float32
        for i in range(5):
            assert bool(infos[i]) == done[i]
            if done[i]:
                ends += 1
                np.testing.assert_array_equal(
                    infos[i]["terminal_observation"], info["final_obs"][i]
                )
                assert infos[i]["TimeLimit.truncated"] == truncated[i]
                assert infos[i]["is_success"] == info["success"][i]
                assert infos[i]["termination"] == info["termination"][i]
    assert ends > 5


def test_a_truncated_episode_says_so(monkeypatch):
    monkeypatch.setattr(crane_task, "TIME_LIMIT", 0.3)
    view = CraneVecEnv(2)
    view.reset()
    for _ in range(3):
        _, _, done, infos = view.step(np.zeros((2, 6)))
    assert done.all() and all(info["TimeLimit.truncated"] for info in infos)


def test_attributes_and_options():
    view = CraneVecEnv(3, "ForestryCranePaper-v0", contact="primitive", difficulty=0.5)
    assert view.get_attr("frame_skip") == [1, 1, 1] and view.get_attr("difficulty", [1]) == [0.5]
    view.set_attr("difficulty", 0.25)
    assert view.envs.difficulty == 0.25
    with pytest.raises(ValueError, match="all cranes share difficulty"):
        view.set_attr("difficulty", 1.0, indices=[0])
    assert view.env_is_wrapped(VecMonitor) == [False] * 3
    with pytest.raises(TypeError, match="autoreset_mode"):
        CraneVecEnv(2, autoreset_mode="NextStep")
    with pytest.raises(ValueError, match="Pendulum-v1 is not the crane"):
        CraneVecEnv(2, "Pendulum-v1")


def test_a_model_with_state_dependent_exploration_loads(tmp_path):
    model = PPO("MlpPolicy", CraneVecEnv(2), use_sde=True, device="cpu")
    model.save(tmp_path / "model.zip")
    obs = np.random.default_rng(0).normal(size=(3, 18)).astype(np.float32)
    loaded = crane_policies.load_sb3(tmp_path / "model.zip")
    np.testing.assert_array_equal(
        loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0]
    )


def test_sb3_trains_saves_and_is_judged(tmp_path, monkeypatch):
    """The README's recipe. Success reaches SB3's own log."""
    monkeypatch.setattr(crane_task, "REACH_TIME", 0.5)  # every episode ends soon
    model = PPO("MlpPolicy", VecMonitor(CraneVecEnv(8)), n_steps=16, batch_size=64, device="cpu")
    model.learn(256)
    assert list(model.ep_success_buffer) and len(model.ep_info_buffer) == len(
        model.ep_success_buffer
    )
    model.save(tmp_path / "model")
    model = PPO.load(tmp_path / "model", device="cpu")
    scores = crane_trials.evaluate(model, "ForestryCrane-v0", trials=1, seed=1, env_threads=1)
    assert scores["success_rate"] == 0 and np.isfinite(scores["episodic_return"])
