"""The page in docs/play, where its packages are installed: npm ci --prefix docs/play."""

import functools
import http.server
import json
import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import crane_policies
from crane_env import CraneVectorEnv
from crane_trials import monte_carlo_trials

ROOT = Path(__file__).parent.parent
PLAY = ROOT / "docs" / "play"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (PLAY / "node_modules").is_dir(), reason="needs npm ci"),
]


def test_the_page_has_the_crane_of_python(tmp_path):
    """Same start and observation; open loop the logs are lifted in both versions of MuJoCo."""
    policy, _, _ = crane_policies.load_policy(crane_policies.SHIPPED)
    for diameter in (0.3, 0.5, 0.8):
        envs = CraneVectorEnv(1, diameter=diameter)
        obs, _ = envs.reset(seed=monte_carlo_trials(40_000, 1, [diameter])[1])
        q, log, _ = envs.starts[0]
        observations, actions = [obs[0]], []
        for _ in range(90):
            action, _ = policy.predict(obs)
            obs, *_, info = envs.advance(action)
            observations.append(obs[0])
            actions.append(action[0].tolist())
        trial = {"diameter": diameter, "start": {"q": q.tolist(), "log": log.tolist()}}
        (tmp_path / "trial.json").write_text(json.dumps(trial | {"actions": actions}))
        command = ["node", str(PLAY / "compare.js"), str(tmp_path / "trial.json")]
        ran = subprocess.run(command, capture_output=True, text=True, check=True)
        there = json.loads(ran.stdout)
        here, difference = np.array(observations), np.array(there["observations"]) - observations
        np.testing.assert_allclose(there["observations"][0], here[0], atol=2e-6)
        assert info["success"][0] and there["result"] == "success"
        assert abs(there["up"] - info["time_up"][0]) <= 0.3
        assert np.abs(difference[-1, :8]).max() < 0.2 and np.abs(difference[-1, 14:17]).max() < 0.3


def test_a_crane_that_does_not_move_fails(tmp_path):
    trial = {"diameter": 0.5, "start": {"q": [-1.5, 0.5, 0.1, 0.3, 0.97, 1.57, 0, 0.3]}}
    trial["start"]["log"], trial["actions"] = [0, -6.5, 0], [[0] * 6] * 90
    (tmp_path / "trial.json").write_text(json.dumps(trial))
    command = ["node", str(PLAY / "compare.js"), str(tmp_path / "trial.json")]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads(ran.stdout)["result"] == "not reached in 6 s"


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_the_page_runs_in_a_browser():
    """The policy moves the crane, and nothing throws."""
    onnx = PLAY / "policy.onnx"
    export = [sys.executable, "export_onnx.py", str(crane_policies.SHIPPED), str(onnx)]
    subprocess.run(export, cwd=ROOT, check=True, capture_output=True)
    quiet = type("Quiet", (http.server.SimpleHTTPRequestHandler,), {"log_message": lambda *_: None})
    handler = functools.partial(quiet, directory=ROOT)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://127.0.0.1:{server.server_port}/docs/play/#policy"
    flags = ["--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"]
    flags += ["--enable-unsafe-swiftshader", "--window-size=320,240"]
    flags += ["--virtual-time-budget=60000", "--timeout=150000", "--dump-dom", address]
    try:
        ran = subprocess.run([CHROMIUM, *flags], capture_output=True, text=True, timeout=180)
    finally:
        server.shutdown()
    rows = dict(re.findall(r"<td>([^<]*)</td><td>([^<]*)</td>", ran.stdout))
    assert rows["driver"] == "policy" and float(rows["time"].split()[0]) > 0.1
    assert "see docs/play/README.md" not in ran.stdout
    assert rows["Q A"] == "slew"
