"""benchmark/rivals.py: its clock, its cranes and its table."""

import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "benchmark"))

import rivals  # noqa: E402

from crane_env import CraneEnv  # noqa: E402


@pytest.fixture
def now(monkeypatch):
    """The time in s, which passes only where a test says so."""
    now = [1000.0]
    monkeypatch.setattr(rivals.time, "time", lambda: now[0])
    return now


def test_the_clock_stops_while_it_judges_and_ends_the_training(monkeypatch, now):
    def judged_for_a_minute(policy, *protocol):
        now[0] += 60
        return {"success_rate": 0.5, "gentle_rate": 0.25}

    monkeypatch.setattr(rivals.crane_trials, "evaluate", judged_for_a_minute)
    clock = rivals.Clock(started=990.0, limit=100.0, threads=1)  # 10 s went into imports
    with pytest.raises(rivals.TimeUp):
        for _ in range(1000):
            clock.tick()
            clock.decisions += 64
            now[0] += 1
    minutes, decisions, success, gentle = zip(*clock.rows)
    assert minutes == (1.0, 1.67)  # 60 and 100 s
    assert decisions == (64 * 50, 64 * 90)
    assert set(success) == {50.0} and set(gentle) == {25.0}


def test_a_long_update_is_judged_once(monkeypatch, now):
    scores = {"success_rate": 0.0, "gentle_rate": 0.0}
    monkeypatch.setattr(rivals.crane_trials, "evaluate", lambda *_: scores)
    clock = rivals.Clock(started=1000.0, limit=600.0, threads=1)
    now[0] += 190  # three judgements would have been due
    clock.tick()
    clock.tick()
    assert [row[0] for row in clock.rows] == [3.17]


def test_the_cranes_of_our_settings_get_harder_with_the_time(now):
    clock = rivals.Clock(started=1000.0, limit=100.0, threads=1)
    easy = rivals.TimedCranes(rivals.Setting({}, cranes=2, like_mppo=True), clock)
    plain = rivals.TimedCranes(rivals.Setting({}, cranes=2), clock)
    (first, _), (second, _) = easy.reset(seed=1), plain.reset(seed=1)
    np.testing.assert_array_equal(first, second)
    seeded = rivals.TimedCranes(rivals.Setting({}, cranes=2), clock, seed=1)  # for skrl, gives none
    np.testing.assert_array_equal(seeded.reset()[0], second)
    assert (seeded.reset()[0] != second).any()
    now[0] += 20  # half of the easy time
    actions = np.zeros((2, 6))
    scaled, full = easy.step(actions)[1], plain.step(actions)[1]
    assert easy.unwrapped.difficulty == pytest.approx(0.5)
    assert plain.unwrapped.difficulty == 1.0
    np.testing.assert_allclose(scaled, 0.06 * full)
    assert clock.decisions == 4


CLEANRL = """
import sys
import gymnasium as gym
import numpy as np
import torch

class Agent:
    actor_mean = torch.nn.Linear(18, 6)

def make():
    env = gym.wrappers.NormalizeObservation(gym.make(sys.argv[2]))
    return gym.wrappers.TransformObservation(env, lambda obs: np.clip(obs, -10, 10))

agent, envs = Agent(), gym.vector.SyncVectorEnv([make])
envs.reset(seed=1)
for _ in range(3):
    obs, *_, infos = envs.step(np.full((1, 6), 0.5))
with torch.no_grad():
    agent.actor_mean.weight.mul_(20)
    actions = agent.actor_mean(torch.as_tensor(obs).float())
crane = envs.unwrapped.envs[0].unwrapped
said = dict(actions=actions, infos=infos, words=sys.argv[1:], difficulty=crane.difficulty)
said |= dict(retry=crane.envs.options["retry"], mode=envs.unwrapped.metadata["autoreset_mode"].name)
torch.save(said, "said.pt")
"""


@pytest.fixture
def cleanrl(tmp_path, monkeypatch, now):
    """Trains with a stand-in of CleanRL's file. Gymnasium is as before afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "argv", sys.argv)
    for module, name in [
        (gymnasium.vector, "SyncVectorEnv"),
        (gymnasium.wrappers, "TransformObservation"),
    ]:
        monkeypatch.setattr(module, name, getattr(module, name))
    (tmp_path / "ppo_continuous_action.py").write_text(CLEANRL)
    setting = rivals.Setting({"num_steps": 64}, cranes=1, like_mppo=True)
    yield lambda clock: rivals.train_cleanrl("", setting, 7, clock)
    gymnasium.registry.pop("RetryCrane-v0")


def test_cleanrls_file_runs_on_the_cranes(monkeypatch, cleanrl):
    """The judge normalizes as the program does, and sees its networks."""
    raw, judged, step = [], [], CraneEnv.step

    def watched(crane, action):
        raw.append(step(crane, action))
        return raw[-1]

    def judge(policy, *_):
        judged.append(policy.predict(raw[-1][0][None])[0])
        return {"success_rate": 0.0, "gentle_rate": 0.0}

    monkeypatch.setattr(CraneEnv, "step", watched)
    monkeypatch.setattr(rivals.crane_trials, "evaluate", judge)
    clock = rivals.Clock(started=980.0, limit=100.0, threads=1)  # half of the easy time is over
    cleanrl(clock)
    said = torch.load("said.pt", weights_only=True)
    words = "--env-id RetryCrane-v0 --seed 7 --no-cuda --num_envs 1 --num_steps 64"
    assert (said["infos"], said["words"]) == ({}, words.split())
    assert (said["difficulty"], said["retry"], said["mode"]) == (0.5, 0.5, "SAME_STEP")
    assert clock.rows == [[0.33, 3, 0.0, 0.0]]
    assert said["actions"].abs().max() > 1  # the judge limits what the crane would limit
    np.testing.assert_allclose(judged[0], said["actions"].clamp(-1, 1), atol=1e-5)


def test_the_clock_ends_cleanrls_file(monkeypatch, cleanrl):
    scores = {"success_rate": 0.0, "gentle_rate": 0.0}
    monkeypatch.setattr(rivals.crane_trials, "evaluate", lambda *_: scores)
    with pytest.raises(rivals.TimeUp):
        cleanrl(rivals.Clock(started=800.0, limit=100.0, threads=1))


def test_every_setting_has_a_rival():
    for settings in rivals.SETTINGS.values():
        assert settings.keys() <= rivals.RIVALS.keys()
    assert rivals.PUBLISHED.keys() == rivals.RIVALS.keys()


def test_the_table_takes_the_last_judgement_before_each_time(tmp_path):
    path = tmp_path / "rivals.csv"
    rows = [
        "a,ours,1,10.0,0.5,100,0,0",
        "a,ours,1,10.0,4.0,900,50,10",
        "a,ours,1,10.0,10.1,3000,90,30",
        "a,ours,2,10.0,10.0,1000,70,50",
        "a,ours,2,10.0,10.9,9999,99,99",  # too late
        "a,ours,3,0.7,0.7,9,99,99",  # a try: not of these minutes
    ]
    path.write_text("\n".join([",".join(rivals.COLUMNS), *rows]) + "\n")
    last = rivals.results_table(path, 10.0).splitlines()[-1]
    # of seeds 1 and 2: 0 and nothing yet at 2 min, 50 and nothing at 4, 6, 8 min
    scores = "0.0 | 25.0 | 25.0 | 25.0 | 80.0 | 70.0 | 90.0 | 40.0"
    assert last == f"| a | ours | 2 | 2,000 | {scores} |"
