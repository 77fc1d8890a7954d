"""What is only seen: grass, gravel, a forest's edge, bark and growth rings.

`CraneVectorEnv(decorate=decorate)` adds it to the model. Nothing here collides or moves.
"""

import numpy as np
from numpy import ndarray as Array

from crane_env import mujoco  # it has chosen how to draw without a display

TREES = 150
NEAREST_TREE, FARTHEST_TREE = 19.0, 48.0  # m from the crane; the overview camera is 14 m away


def noise(size: int, cells: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Smooth noise around 0 that tiles, (size, size): one octave per number of cells."""
    total = np.zeros((size, size))
    for count in cells:
        grid = rng.standard_normal((count, count))
        place = np.arange(size) * count / size
        low, part = place.astype(int), place % 1
        part = part**2 * (3 - 2 * part)
        high = (low + 1) % count
        rows = grid[low] * (1 - part[:, None]) + grid[high] * part[:, None]
        total += (rows[:, low] * (1 - part) + rows[:, high] * part) / len(cells)
    return total


def coloured(shade: Array, dark: tuple, light: tuple) -> Array:
    """Pixels (..., 3), uint8: the colour dark where shade is -1, light where it is 1."""
    share = np.clip(shade[..., None] / 2 + 0.5, 0, 1)
    return np.uint8(255 * (np.array(dark) * (1 - share) + np.array(light) * share))


def log_faces(size: int, rng: np.random.Generator) -> Array:
    """The six faces (6 size, size, 3) of an upright log: bark around it, rings at its ends."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, size)] * 2)
    radius = np.hypot(x, y)
    rings = np.sin(90 * radius * (1 + 0.05 * noise(size, (4, 8), rng)))
    wood = coloured(rings + 0.3 * noise(size, (64,), rng), (0.66, 0.46, 0.26), (0.86, 0.68, 0.44))
    furrows = noise(size, (8, 16), rng) + 2 * noise(size, (64,), rng)
    bark = coloured(furrows, (0.20, 0.14, 0.10), (0.47, 0.35, 0.26))
    end = np.where(radius[..., None] < 1, wood, bark)  # the corners of this face lie on the side
    return np.concatenate([bark, bark, bark, bark, end, end])


def spruce() -> tuple[Array, Array]:
    """Vertices (V, 3) and faces (F, 3) of four cones, one above another, 1 m high in all."""
    vertices, faces, edges = [], [], 9
    cones = [(0.1, 0.5, 0.2), (0.3, 0.68, 0.16), (0.5, 0.85, 0.12), (0.7, 1.0, 0.08)]
    for low, high, radius in cones:
        first = len(vertices)
        for k in range(edges):
            angle = 2 * np.pi * (k + low) / edges
            vertices.append([radius * np.cos(angle), radius * np.sin(angle), low])
        vertices += [[0, 0, high], [0, 0, low + 0.03]]
        for k in range(edges):
            a, b = first + k, first + (k + 1) % edges
            faces += [[a, b, first + edges], [b, a, first + edges + 1]]
    return np.array(vertices), np.array(faces)


def add_texture(spec: mujoco.MjSpec, name: str, kind: str, pixels: Array) -> None:
    """A texture of pixels (height, width, 3), uint8; kind is "2D" or "CUBE"."""
    texture = spec.add_texture(name=name, type=getattr(mujoco.mjtTexture, f"mjTEXTURE_{kind}"))
    texture.height, texture.width, texture.nchannel = pixels.shape
    texture.data = pixels.tobytes()


def decorate(spec: mujoco.MjSpec) -> None:
    """Add to the crane's spec what is only seen."""
    rng, world = np.random.default_rng(4), spec.worldbody
    rgb = mujoco.mjtTextureRole.mjTEXROLE_RGB
    grass = coloured(noise(512, (4, 16, 64, 256), rng), (0.13, 0.20, 0.07), (0.42, 0.46, 0.20))
    gravel = coloured(noise(256, (8, 64, 128), rng), (0.33, 0.31, 0.28), (0.62, 0.59, 0.54))
    for name, kind, pixels, repeat in [
        ("grass", "2D", grass, 0.12),
        ("gravel", "2D", gravel, 0.5),
        ("log", "CUBE", log_faces(256, rng), 1.0),
    ]:
        add_texture(spec, name, kind, pixels)
        uniform = kind == "2D"
        material = spec.add_material(name=name, texuniform=uniform, texrepeat=[repeat, repeat])
        material.textures[rgb], material.specular = name, 0.05
    spec.geom("ground").material, spec.geom("ground").size[:2] = "grass", 0  # to the horizon
    spec.geom("log").material = "log"

    vertices, faces = spruce()
    seen = {"contype": 0, "conaffinity": 0, "group": 1}
    box, cylinder = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    road = {"size": [60, 2.6, 0.01], "pos": [0, 0, -0.004], "material": "gravel"}
    world.add_geom(type=box, **road, **seen)
    for size in (11, 14, 17):  # m, of three kinds of trees
        mesh = spec.add_mesh(name=f"spruce_{size}", smoothnormal=False, scale=[size] * 3)
        mesh.uservert, mesh.userface = vertices.ravel(), faces.ravel()
    planted = 0
    while planted < TREES:
        angle, turn = rng.uniform(0, 2 * np.pi, 2)
        distance = rng.uniform(NEAREST_TREE, FARTHEST_TREE)
        x, y, green = distance * np.cos(angle), distance * np.sin(angle), rng.uniform(0.8, 1.2)
        if abs(y) < 5:  # the road
            continue
        planted += 1
        size, rgba = rng.choice([11, 14, 17]), [0.10 * green, 0.19 * green, 0.09 * green, 1]
        quat = [np.cos(turn / 2), 0, 0, np.sin(turn / 2)]
        kind = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": f"spruce_{size}"}
        world.add_geom(pos=[x, y, 0], quat=quat, rgba=rgba, **kind, **seen)
        trunk = {"size": [0.015 * size, 0.06 * size, 0], "pos": [x, y, 0.06 * size]}
        world.add_geom(type=cylinder, **trunk, rgba=[0.25, 0.18, 0.13, 1], **seen)
