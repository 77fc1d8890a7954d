"""mppo_beta_torchrun.py: two ranks are one algorithm, and stop as one."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from reference_update import CLIPPED, SETTINGS, Reference, flags
from script_runs import ROOT, Recording

SETTINGS = SETTINGS | CLIPPED | {"num_envs": 6, "minibatch_size": 20, "target_kl": 0.01}
N, STEPS, EPOCHS = (SETTINGS[name] for name in ("num_envs", "num_steps", "update_epochs"))
LINE = "--env-id toy_tasks:Toy-v0 --hidden-sizes 5 --eval-trials 1 --final-trials 1"


def torchrun(folder, when, *arguments):
    """Two ranks of ranks_program.py: what they printed, and what each of them left."""
    line = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    line += [str(ROOT / "tests" / "ranks_program.py"), str(folder), str(when)]
    words = " ".join(map(str, arguments)).split()
    paths = {
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")]),
        "OMP_NUM_THREADS": "1",
    }
    how = {"capture_output": True, "text": True, "timeout": 300, "env": os.environ | paths}
    ran = subprocess.run([*line, *words], **how)
    ranks = [torch.load(folder / f"rank{r}.pt", weights_only=False) for r in (0, 1)]
    return ran, ranks


def test_two_ranks_are_one_algorithm(tmp_path):
    """Three updates, in the third of which one rank gets a signal; then a fourth with --resume."""
    total = 9 * N * STEPS
    ran, ranks = torchrun(
        tmp_path, 2 * STEPS * N // 2 + 1, LINE, flags(SETTINGS), f"--total-timesteps {total}"
    )
    (folder,) = (tmp_path / "runs").iterdir()
    said = f"stopped after update 3; go on with --resume {folder.relative_to(tmp_path)}"
    assert said in ran.stderr
    saved = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert saved["iteration"] == 3
    assert (saved["args"]["num_envs"], saved["args"]["minibatch_size"]) == (N, 20)
    assert [len(rank["steps"]) for rank in ranks] == [3 * STEPS] * 2
    assert same(saved["weights"], ranks[1]["last"])
    check_updates(ranks, saved["weights"])

    ran, again = torchrun(tmp_path, 0, f"--resume {folder} --total-timesteps {4 * N * STEPS}")
    assert ran.returncode == 0, ran.stderr
    assert [len(rank["steps"]) for rank in again] == [STEPS, STEPS]
    assert [*(tmp_path / "runs").iterdir()] == [folder]
    saved = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert saved["iteration"] == 4
    assert same(saved["weights"], again[0]["last"]) and same(saved["weights"], again[1]["last"])
    assert again[0]["purge_steps"] == [3 * N * STEPS + 1]
    assert again[0]["scalars"]["eval/episodic_return"].keys() == {4 * N * STEPS}
    # no start and no sample twice; the ranks' policies are almost equal at first
    assert (ranks[0]["samples"][0] - ranks[1]["samples"][0]).abs().mean() > 0.03
    starts = np.concatenate([rank["starts"][0] for rank in [*ranks, *again]])
    assert len(np.unique(starts, axis=0)) == 2 * N
    samples = torch.cat([torch.cat(rank["samples"]).flatten() for rank in [*ranks, *again]])
    assert len(samples) == 4 * N * STEPS * 2 and len(samples.unique()) > 0.99 * len(samples)


def same(weights, others):
    return all(torch.equal(weights[name], others[name]) for name in weights)


def check_updates(ranks, saved):
    """The reference, with the cranes of both ranks as if they were of one."""
    settings = SETTINGS | {"hidden_sizes": (5,), "iterations": 9}
    reference = Reference(settings, ranks[0]["first"][0], of_ranks=True)
    obs, done = np.concatenate([rank["starts"][0] for rank in ranks]), 0
    epochs_done, scalars = [], ranks[0]["scalars"]
    for k, update in enumerate(ranks[0]["updates"]):
        steps = [together(ranks, t) for t in range(k * STEPS, (k + 1) * STEPS)]
        actions = np.stack([(step["actions"] - [-2, 0]) / 3 for step in steps])
        obs = reference.rollout(obs, steps, torch.as_tensor(actions))
        epochs = [rank["permutations"][done : done + EPOCHS] for rank in ranks]
        reference.ppo([minibatches(*of_ranks) for of_ranks in zip(*epochs)])
        done += reference.epochs_done
        epochs_done.append(reference.epochs_done)
        for name, weights in reference.w.items():
            ours = update["weights"][name].double()
            torch.testing.assert_close(ours, weights, rtol=1e-5, atol=1e-5)
        assert scalars["charts/learning_rate"][(k + 1) * N * STEPS] == pytest.approx(reference.lr)
        drawn = torch.stack(ranks[0]["samples"][k * STEPS : (k + 1) * STEPS])
        epsilon, noise = 0.1 * (1 - k / 9 / 0.4), (update["actions"] - drawn).abs().max()
        assert 0.8 * epsilon < noise <= epsilon + 1e-6
        assert update["difficulty"] == pytest.approx((k + 1) / 9 / 0.5)
    assert [done, done] == [len(rank["permutations"]) for rank in ranks]
    assert min(epochs_done) < max(epochs_done)
    seen = np.concatenate(reference.seen)
    np.testing.assert_allclose(saved["obs_mean"], seen.mean(0))
    np.testing.assert_allclose(saved["obs_var"], seen.var(0))
    assert saved["obs_count"] == 3 * N * STEPS


def together(ranks, t):
    """A step of the cranes of all ranks."""
    steps = [rank["steps"][t] for rank in ranks]
    names = ("obs", "reward", "terminated", "truncated", "actions", "final_obs")
    joined = {name: [row for step in steps for row in step[name]] for name in names}
    return {name: v if name == "final_obs" else np.array(v) for name, v in joined.items()}


def minibatches(*permutations):
    """(step, crane) of each minibatch, of which each rank has its share."""
    size, share = N // 2, SETTINGS["minibatch_size"] // 2
    for permutation in permutations:
        assert sorted(permutation) == list(range(size * STEPS))
    return [
        [
            (b // size, rank * size + b % size)
            for rank in (0, 1)
            for b in permutations[rank][i : i + share]
        ]
        for i in range(0, size * STEPS, share)
    ]


@pytest.mark.parametrize(
    "said, arguments, launched",
    [
        ("must be multiples of 2 ranks", "--num-envs 5", True),
        ("must be multiples of 2 ranks", "--minibatch-size 33", True),
        ("start it as: torchrun --standalone --nproc-per-node 2", "", False),
    ],
)
def test_what_cannot_work_is_said_in_a_line(tmp_path, monkeypatch, said, arguments, launched):
    for name, value in [("init_process_group", None), ("get_rank", 0), ("get_world_size", 2)]:
        monkeypatch.setattr(torch.distributed, name, lambda *args, value=value: value)
    monkeypatch.setattr(torch.distributed, "is_torchelastic_launched", lambda: launched)
    with pytest.raises(SystemExit, match=said):
        Recording(tmp_path).run("mppo_beta_torchrun", arguments)
