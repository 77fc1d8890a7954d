import crane_env  # noqa: F401  before any test imports mujoco, which looks for OpenGL as it loads
