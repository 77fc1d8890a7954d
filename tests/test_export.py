"""export_onnx.py, and models of Stable-Baselines3, as eval_crane.py judges them."""

import json
import re
import subprocess
import sys
import zipfile

import numpy as np
import onnx
import onnxruntime
import pytest
import stable_baselines3
import torch
from script_runs import ALGORITHMS, ROOT

import crane_policies
import eval_crane
import export_onnx
import ppo_crane
from crane_trials import evaluate


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_an_onnx_file_acts_as_the_policy(tmp_path, algorithm):
    """In turn, with the memory of an LSTM, for another number of cranes than at the export."""
    path = ROOT / "assets" / "policies" / f"{algorithm}_crane.pt"
    export_onnx.main(path, tmp_path / "policy.onnx")
    agent, task, _ = crane_policies.load_policy(path)
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    memory = {i.name: np.zeros((7, i.shape[1]), "f4") for i in session.get_inputs()[1:]}
    assert len(memory) == (2 if algorithm == "recurrent_ppo" else 0)
    judged, judged_task, name = crane_policies.load_policy(tmp_path / "policy.onnx")
    assert (judged_task, name) == (task, algorithm)
    rng, state, judged_state = np.random.default_rng(0), None, None
    for _ in range(5):
        obs = rng.normal(size=(7, 18))
        actions, *after = session.run(None, {"obs": obs.astype("f4"), **memory})
        memory = dict(zip(memory, after))
        expected, state = agent.predict(obs, state)
        np.testing.assert_allclose(actions, expected, rtol=1e-6, atol=1e-6)
        again, judged_state = judged.predict(obs, judged_state)
        np.testing.assert_array_equal(again, actions)
    assert np.ptp(expected) > 0.1


def test_the_onnx_file_lifts_logs(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    export_onnx.main(crane_policies.SHIPPED, tmp_path / "policy.onnx")
    line = ["eval_crane.py", "policy.onnx", "--trials", "2", "--pose-noise", "none"]
    monkeypatch.setattr(sys, "argv", line)
    eval_crane.main()
    (mean,) = re.findall(r"\| mean  \| 96.3    \| ([0-9.]+)", capsys.readouterr().out)
    assert float(mean) > 80


def test_the_command_writes_a_file(tmp_path):
    line = [sys.executable, ROOT / "export_onnx.py", crane_policies.SHIPPED, tmp_path / "a.onnx"]
    result = subprocess.run(line, capture_output=True, text=True)
    assert result.returncode == 0 and "(mppo_beta) is written to" in result.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["a.onnx"]


def test_an_agent_with_another_predict_is_not_exported(tmp_path, monkeypatch):
    """MeanAction would export what the agent does no more."""
    predict = ppo_crane.Agent.predict
    half = lambda *args, **kwargs: (predict(*args, **kwargs)[0] / 2, None)  # noqa: E731
    monkeypatch.setattr(ppo_crane.Agent, "predict", half)
    path = ROOT / "assets" / "policies" / "ppo_crane.pt"
    saved = torch.load(path, weights_only=True)
    saved["fingerprint"] /= 2  # as of a run of the changed script
    torch.save(saved, tmp_path / "policy.pt")
    with pytest.raises(SystemExit, match="another `predict`"):
        export_onnx.main(tmp_path / "policy.pt", tmp_path / "policy.onnx")
    assert [file.name for file in tmp_path.iterdir()] == ["policy.pt"]


@pytest.mark.parametrize("name", ["PPO", "SAC"])
def test_a_model_of_stable_baselines3_is_judged(tmp_path, monkeypatch, name):
    import crane_env  # noqa: F401  registers the tasks

    monkeypatch.chdir(tmp_path)
    model = getattr(stable_baselines3, name)("MlpPolicy", "ForestryCrane-v0", seed=1)
    model.save("model.zip")
    policy, task, _ = crane_policies.load_policy(tmp_path / "model.zip")
    ours = evaluate(policy, task["env_id"], 1, 40_000)
    assert ours == evaluate(model, "ForestryCrane-v0", 1, 40_000)
    with pytest.raises(SystemExit, match="model.zip is no policy.pt; give what"):
        export_onnx.main(tmp_path / "model.zip", tmp_path / "model.onnx")
    line = ["eval_crane.py", "model.zip", "--env-id", "ForestryCraneHydraulic-v0"]
    monkeypatch.setattr(sys, "argv", line)
    with pytest.raises(
        SystemExit, match=r"observes \(18,\); ForestryCraneHydraulic-v0 gives \(32,\)"
    ):
        eval_crane.main()


@pytest.mark.parametrize(
    "kind, said", [("zip", "is no model of Stable-Baselines3"), ("onnx", "is no ONNX file")]
)
def test_damaged_files_are_named(tmp_path, kind, said):
    path = tmp_path / f"policy.{kind}"
    path.write_bytes(b"junk")
    with pytest.raises(SystemExit, match=f"policy.{kind} {said}"):
        crane_policies.load_policy(path)


def test_a_zip_of_something_else_is_named(tmp_path):
    with zipfile.ZipFile(tmp_path / "photos.zip", "w") as file:
        file.writestr("photo.txt", "a crane")
    with pytest.raises(SystemExit, match="photos.zip is no model of Stable-Baselines3"):
        crane_policies.load_policy(tmp_path / "photos.zip")


def test_an_onnx_file_of_others_is_told_what_to_do(tmp_path):
    import onnx

    path = tmp_path / "policy.onnx"
    kind = onnx.TensorProto.FLOAT
    obs, actions = (
        onnx.helper.make_tensor_value_info(name, kind, ["N", width])
        for name, width in (("obs", 6), ("actions", 6))
    )
    node = onnx.helper.make_node("Tanh", ["obs"], ["actions"])
    graph = onnx.helper.make_graph([node], "g", [obs], [actions])
    opset = [onnx.helper.make_opsetid("", 17)]
    onnx.save(onnx.helper.make_model(graph, opset_imports=opset, ir_version=8), path)
    with pytest.raises(SystemExit, match="not of export_onnx.py.*--policy my_module:MyPolicy"):
        crane_policies.load_policy(path)


def test_an_option_that_is_newer_than_the_file_has_its_default(tmp_path):
    path = tmp_path / "policy.onnx"
    export_onnx.main(crane_policies.SHIPPED, path)
    _, task, _ = crane_policies.load_policy(path)
    model = onnx.load(path)
    older = {"algorithm": "ppo", "task": json.dumps({k: task[k] for k in task if k != "speed"})}
    onnx.helper.set_model_props(model, older)
    onnx.save(model, path)
    assert crane_policies.load_policy(path)[1] == task and task["speed"] == "real"


def test_the_files_name_is_checked_first(tmp_path):
    with pytest.raises(SystemExit, match="policy.bin must end in .onnx"):
        export_onnx.main(crane_policies.SHIPPED, tmp_path / "policy.bin")
    assert not list(tmp_path.iterdir())
