"""What the tests share."""

import pytest
import torch

import crane_env  # before mujoco, which then draws without a display

torch.set_num_threads(1)  # the batches are too small for more


@pytest.fixture(scope="session")
def opengl():
    """Skips where nothing can be drawn."""
    try:
        crane_env.mujoco.Renderer(crane_env.CraneVectorEnv(1).model, 8, 8).close()
    except Exception as error:
        pytest.skip(f"no OpenGL here: {error}")
