"""Write a trained policy as ONNX. The file runs without torch.

    python -m crane_utils.export_onnx assets/policies/ppo_crane.pt ppo_crane.onnx

`h` and `c` are the memory of recurrent PPO, zeros at the start of an episode:

    import numpy, onnxruntime
    session = onnxruntime.InferenceSession("ppo_crane.onnx")
    memory = {i.name: numpy.zeros((N, i.shape[1]), "f4") for i in session.get_inputs()[1:]}
    actions, *after = session.run(None, {"obs": obs.astype("f4"), **memory})
    memory = dict(zip(memory, after))
"""

import io
import json
import warnings
from pathlib import Path
from unittest import mock

import numpy as np
import onnx
import onnxruntime
import torch
import tyro
from torch import Tensor, nn
from tyro.conf import Positional

from crane_utils import runs


class Predict(nn.Module):
    """An agent's `predict` as a function of tensors: obs and memory to actions and memory."""

    def __init__(self, agent: nn.Module):
        super().__init__()
        self.agent = agent

    def forward(self, obs: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        # `predict` ends in numpy(), which a trace cannot follow
        with mock.patch.object(Tensor, "numpy", lambda tensor: tensor):
            actions, state = self.agent.predict(obs, state or None)
        return actions, *(state or ())


def main(policy: Positional[Path], file: Positional[Path]) -> None:
    """Write the policy in a run's folder or policy.pt to an .onnx file."""
    agent, task, script = runs.load_policy(policy)
    obs_dim, buffer = len(agent.obs_mean), io.BytesIO()
    # with one crane in the trace, what it takes for constant fits any number
    state = agent.initial_state(1) if hasattr(agent, "initial_state") else ()
    inputs = ["obs", "h", "c"][: 1 + len(state)]
    outputs = ["actions", "h_next", "c_next"][: 1 + len(state)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the newer exporter takes twenty times as long
        torch.onnx.export(
            Predict(agent).eval(),
            (torch.zeros(1, obs_dim), *state),
            buffer,
            input_names=inputs,
            output_names=outputs,
            dynamic_axes={name: {0: "N"} for name in inputs + outputs},
            dynamo=False,
        )
    model = onnx.load_from_string(buffer.getvalue())
    onnx.helper.set_model_props(model, {"script": script, "task": json.dumps(task)})
    session = onnxruntime.InferenceSession(model.SerializeToString())
    memory, state = {name: np.zeros((5, len(h[0])), "f4") for name, h in zip("hc", state)}, None
    for obs in np.random.default_rng(0).normal(size=(3, 5, obs_dim)).astype("f4"):
        expected, state = agent.predict(obs, state)
        actions, *after = session.run(None, {"obs": obs, **memory})
        memory = dict(zip(memory, after))
        if not np.allclose(actions, expected, atol=1e-4):
            raise SystemExit(f"{policy}: its `predict` does what a trace cannot repeat")
    onnx.save(model, file)
    print(f"{policy} ({script}) is written to {file}")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__.partition("\n\n")[0])
