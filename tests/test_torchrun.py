"""mppo_beta_torchrun.py: its ranks are one algorithm, and none of them can leave the others behind.

Every test starts processes that import torch: some seconds each.
"""

import inspect
import os
import re
import signal
import socket
import subprocess
import sys
import time

import pytest
import torch
from script_runs import ROOT, only_run, scalars, small

import mppo_beta_crane as mppo
import mppo_beta_torchrun as torchrun_script

PROGRAM = ROOT / "tests" / "ranks_program.py"
SCRIPT = ROOT / "mppo_beta_torchrun.py"
SHORT = [*small("mppo_beta"), "--eval-every", "0"]  # 4 cranes, 16 decisions, minibatches of 32


def torchrun(cwd, *arguments, ranks=2, start=subprocess.run, **kwargs):
    """A finished process, or with start=subprocess.Popen one that runs. Output is text."""
    line = [sys.executable, "-m", "torch.distributed.run"]
    line += [*kwargs.pop("how", ["--standalone"]), "--nproc-per-node", str(ranks)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}
    pipe = subprocess.PIPE
    line += map(str, arguments)
    return start(line, cwd=cwd, env=environment, stdout=pipe, stderr=pipe, text=True, **kwargs)


def look(cwd, how, ranks, *arguments):
    """What each rank of ranks_program.py left."""
    cwd.mkdir()
    result = torchrun(cwd, PROGRAM, cwd, how, *arguments, ranks=ranks)
    assert result.returncode == 0, result.stderr
    return [torch.load(cwd / f"rank{r}.pt", weights_only=True) for r in range(ranks)]


def children(process, cwd):
    """Process numbers of the ranks of a running torchrun, once the first checkpoint is there."""
    deadline = time.monotonic() + 120
    while not list(cwd.glob("runs/*/checkpoint.pt")) and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    listed = subprocess.run(["pgrep", "-P", str(process.pid)], stdout=subprocess.PIPE, text=True)
    return map(int, listed.stdout.split())


def test_its_formulas_are_those_of_one_process():
    """Tests of mppo_beta_crane.py hold for it too."""
    for name in ("layer_init", "mlp", "perturb_actions", "compute_gae"):
        ours, theirs = (inspect.getsource(getattr(m, name)) for m in (torchrun_script, mppo))
        assert ours == theirs
    blocks = []  # what the time limit cut off, up to the advantages
    for script in (torchrun_script, mppo):
        _, found, rest = inspect.getsource(script).partition("            cut = truncated & ~")
        assert found
        blocks.append(rest.partition("        # Advantages")[0])
    assert blocks[0] == blocks[1]


def test_two_ranks_have_the_gradient_of_one(tmp_path):
    """The same cranes, all in one process or half of them in each of two."""
    arguments = [*SHORT, "--minibatch-size", "64", "--update-epochs", "3", "--perturbation", "0"]
    arguments += ["--total-timesteps", "128", "--target-kl", "1000"]
    (one,) = look(tmp_path / "one", "exact", 1, *arguments)
    two = look(tmp_path / "two", "exact", 2, *arguments)
    assert len(one["gradients"]) == 6  # two updates
    for k, gradient in enumerate(one["gradients"]):
        assert gradient.dtype == torch.float64 and gradient.abs().max() > 1e-3
        for rank in two:
            torch.testing.assert_close(rank["gradients"][k], gradient, rtol=1e-6, atol=1e-6)
    for name in ("obs_mean", "obs_var", "obs_count"):
        torch.testing.assert_close(two[1]["weights"][name], one["weights"][name])


def test_all_ranks_have_the_same_weights_and_other_cranes(tmp_path):
    arguments = [*SHORT, "--total-timesteps", "192", "--target-kl", "0.003"]
    first, second = look(tmp_path / "two", "sampled", 2, *arguments)
    assert first["weights"].keys() == second["weights"].keys()
    for name, weights in first["weights"].items():
        assert torch.equal(weights, second["weights"][name]), name
    assert len(first["gradients"]) == len(second["gradients"])
    saved = torch.load(only_run(tmp_path / "two") / "checkpoint.pt", weights_only=True)
    assert all(torch.equal(saved["weights"][k], w) for k, w in first["weights"].items())
    assert saved["args"]["num_envs"] == 4 and saved["args"]["minibatch_size"] == 32
    # ranks that saw the same cranes would have counted half of what they saw twice
    (one,) = look(tmp_path / "one", "sampled", 1, *arguments)
    assert not torch.allclose(one["weights"]["obs_mean"], first["weights"]["obs_mean"])
    assert one["weights"]["obs_count"] == first["weights"]["obs_count"]


def test_a_killed_rank_ends_the_run_and_any_number_of_ranks_goes_on(tmp_path):
    arguments = [SCRIPT, *SHORT, "--total-timesteps", "64000"]
    process = torchrun(tmp_path, *arguments, start=subprocess.Popen)
    _, second = children(process, tmp_path)
    os.kill(second, signal.SIGKILL)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert errors.count("another rank is gone; go on with --resume") == 1
    assert SCRIPT.name not in "".join(re.findall(r'File "(.*)"', errors))  # no traceback of ours
    folder = only_run(tmp_path)
    done = torch.load(folder / "checkpoint.pt", weights_only=True)["iteration"]
    for ranks in (1, 2):
        done += 1
        line = [SCRIPT, "--resume", folder, "--total-timesteps", 64 * done]
        result = torchrun(tmp_path, *line, ranks=ranks)
        assert result.returncode == 0, result.stderr
    assert scalars(folder)["time/updates"] == list(range(1, done + 1))


def test_two_machines_train_together(tmp_path):
    """Two addresses of the loopback stand for two machines."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"127.0.0.1:{free.getsockname()[1]}"
    nodes = []
    for node in (0, 1):
        how = ["--nnodes", "2", "--node-rank", str(node), "--rdzv-backend", "static"]
        how += ["--rdzv-endpoint", endpoint, "--local-addr", f"127.0.0.{node + 1}"]
        line = [PROGRAM, tmp_path, "sampled", *SHORT, "--total-timesteps", "128"]
        nodes.append(torchrun(tmp_path, *line, ranks=1, how=how, start=subprocess.Popen))
    for node in nodes:
        _, errors = node.communicate(timeout=120)
        assert node.returncode == 0, errors
    first, second = (torch.load(tmp_path / f"rank{r}.pt", weights_only=True) for r in (0, 1))
    assert all(torch.equal(w, second["weights"][k]) for k, w in first["weights"].items())
    assert only_run(tmp_path)


@pytest.mark.parametrize("target", ["a rank", "torchrun"])
def test_a_signal_stops_all_ranks_with_the_update_saved(tmp_path, target):
    arguments = [SCRIPT, *SHORT, "--total-timesteps", "64000", "--eval-every", "1"]
    process = torchrun(tmp_path, *arguments, start=subprocess.Popen)
    _, second = children(process, tmp_path)
    os.kill(process.pid if target == "torchrun" else second, signal.SIGTERM)
    output, errors = process.communicate(timeout=60)
    assert "stopped after update" in output and "another rank is gone" not in errors
    done = torch.load(only_run(tmp_path) / "checkpoint.pt", weights_only=True)["iteration"]
    assert f"stopped after update {done}; go on with --resume" in output


def test_help_needs_no_other_rank(tmp_path):
    result = torchrun(tmp_path, SCRIPT, "--help")
    assert result.returncode == 0 and result.stdout.count("usage: ") == 1


@pytest.mark.parametrize(
    ("ranks", "arguments", "said"),
    [
        (2, ["--num-envs", "5"], "must be multiples of 2 ranks"),
        (None, [], "start it as: torchrun --standalone --nproc-per-node 2"),
    ],
)
def test_what_cannot_work_is_said_in_a_line(tmp_path, ranks, arguments, said):
    if ranks is None:
        line = [sys.executable, SCRIPT, *arguments]
        result = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True)
    else:
        result = torchrun(tmp_path, SCRIPT, *arguments, ranks=ranks)
    assert result.returncode == 1 and said in result.stderr
    assert "crane_" not in "".join(re.findall(r'File "(.*)"', result.stderr))
    assert not (tmp_path / "runs").exists()
