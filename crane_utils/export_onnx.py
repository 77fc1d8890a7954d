"""Write a trained policy as ONNX. The file runs without torch.

    python export_onnx.py assets/policies/ppo_crane.pt ppo_crane.onnx
    python eval_crane.py ppo_crane.onnx

Inference, for N cranes at once (`h` and `c` are the memory of recurrent PPO, zeros at the start of
an episode; other policies have neither):

    import numpy, onnxruntime
    session = onnxruntime.InferenceSession("ppo_crane.onnx")
    memory = {i.name: numpy.zeros((N, i.shape[1]), "f4") for i in session.get_inputs()[1:]}
    actions, *after = session.run(None, {"obs": obs.astype("f4"), **memory})
    memory = dict(zip(memory, after))

The file has the normalizer, the mean action and the memory. actions (N, 6) are those of `predict`
for obs (N, 18 or 32), float32.
"""

import io
import json
import os
import sys
import warnings
from pathlib import Path

import onnx
import torch
import tyro
from torch import Tensor, nn
from torch.distributions import Beta
from tyro.conf import Positional

import crane_policies
import crane_runs
from crane_view import whole_file


class MeanAction(nn.Module):
    """An agent's `predict` as a function of tensors: obs and memory to actions and memory."""

    def __init__(self, agent: nn.Module):
        super().__init__()
        self.agent = agent

    def forward(self, obs: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        agent = self.agent
        features = agent.normalize(obs)
        if state:  # h and c of an LSTM
            before = tuple(part[None] for part in state)
            memory, after = agent.lstm(features[None], before)
            features, state = torch.cat([features, memory[0]], dim=-1), (after[0][0], after[1][0])
        distribution = agent.get_distribution(features)
        mean, low, high = distribution.mean, agent.action_low, agent.action_high
        if isinstance(distribution, Beta):  # over a_n in [0, 1]
            return low + (high - low) * mean, *state
        return mean.clamp(low, high), *state


def main(policy: Positional[Path], file: Positional[Path]) -> None:
    """Write a policy as ONNX.

    Args:
        policy: a run's folder or a policy.pt
        file: the .onnx file to write
    """
    crane_runs.one_line_errors()
    if file.suffix != ".onnx":
        raise SystemExit(f"{file} must end in .onnx")
    if policy.suffix in (".zip", ".onnx"):
        raise SystemExit(f"{policy} is no policy.pt; give what a script of this repository trained")
    sys.path.insert(0, os.getcwd())  # where edited scripts are
    agent, task, name = crane_policies.load_policy(policy)
    obs = torch.zeros(2, agent.obs_mean.shape[0])
    state = agent.initial_state(2) if hasattr(agent, "initial_state") else ()
    inputs = ["obs", "h", "c"][: 1 + len(state)]
    outputs = ["actions", "h_next", "c_next"][: 1 + len(state)]
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the newer exporter takes twenty times as long
        torch.onnx.export(
            MeanAction(agent).eval(),
            (obs, *state),
            buffer,
            input_names=inputs,
            output_names=outputs,
            dynamic_axes={name: {0: "N"} for name in inputs + outputs},
            dynamo=False,
        )
    model = onnx.load_from_string(buffer.getvalue())
    onnx.helper.set_model_props(model, {"algorithm": name, "task": json.dumps(task)})
    with whole_file(file) as path:
        onnx.save(model, path)
        exported = crane_runs.fingerprint(crane_policies.OnnxPolicy(path), obs.shape[1])
        if not torch.allclose(exported, crane_runs.fingerprint(agent, obs.shape[1]), atol=1e-4):
            raise SystemExit(f"{policy}: its Agent has another `predict`; adapt MeanAction")
    print(f"{policy} ({name}) is written to {file}")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__.partition("\n\n")[0])
