"""Writes the two jaw meshes, assets/jaw_outer.obj and assets/jaw_inner.obj.

A jaw is a band bent to an arc between its pivot (the origin) and its tip (CHORD, 0, 0); the arc
bulges by SAGITTA towards -y, away from the log. The outer jaw has two bands with a gap, through
which the inner jaw's single band passes when the grapple closes on a thin log. The script also
prints the capsule chain of crane.xml, whose straight segments straddle the arc.

    python assets/make_meshes.py
"""

from pathlib import Path

import numpy as np
import tyro

CHORD = 0.8566  # m, pivot to tip
SAGITTA = 0.30  # m
THICKNESS = 0.05  # m, measured along the arc's radius
OUTER_BANDS = [(-0.190, -0.105), (0.105, 0.190)]  # m, along the hinge axis z
INNER_BANDS = [(-0.100, 0.100)]
SECTIONS = 48  # of the mesh along the arc
SEGMENTS = 5  # of the capsule chain

RADIUS = (CHORD**2 / 4 + SAGITTA**2) / (2 * SAGITTA)
HALF_ANGLE = np.arcsin(CHORD / 2 / RADIUS)


def arc(radius: float, sections: int) -> np.ndarray:
    """Points (sections + 1, 2) of the jaw's xy plane, `radius` from the arc's centre, in m."""
    angle = np.linspace(-HALF_ANGLE, HALF_ANGLE, sections + 1)
    centre = np.array([CHORD / 2, RADIUS - SAGITTA])
    return centre + radius * np.stack([np.sin(angle), -np.cos(angle)], axis=-1)


def band(low: float, high: float, first_vertex: int) -> tuple[list[str], list[str]]:
    """OBJ lines (vertices, faces) of a closed bent band between z = low and z = high."""
    inside, outside = arc(RADIUS - THICKNESS / 2, SECTIONS), arc(RADIUS + THICKNESS / 2, SECTIONS)
    vertices = []
    for i in range(SECTIONS + 1):
        for (x, y), z in zip(
            [inside[i], inside[i], outside[i], outside[i]], [low, high, high, low]
        ):
            vertices.append(f"v {x:.5f} {y:.5f} {z:.5f}")
    quads = [(0, 1, 2, 3)]  # the cap at the pivot, then the sides, then the cap at the tip
    for i in range(SECTIONS):
        ring, following = 4 * i, 4 * (i + 1)
        for k in range(4):
            quads.append((ring + k, following + k, following + (k + 1) % 4, ring + (k + 1) % 4))
    last = 4 * SECTIONS
    quads.append((last + 3, last + 2, last + 1, last))
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return vertices, [
        f"f {a + first_vertex} {c + first_vertex} {b + first_vertex}" for a, b, c in triangles
    ]


def write_jaw(path: Path, bands: list[tuple[float, float]]) -> None:
    vertices, faces = [], []
    for low, high in bands:
        new_vertices, new_faces = band(low, high, len(vertices) + 1)
        vertices += new_vertices
        faces += new_faces
    path.write_text("\n".join(["# written by make_meshes.py", *vertices, *faces]) + "\n")


def main() -> None:
    here = Path(__file__).parent
    write_jaw(here / "jaw_outer.obj", OUTER_BANDS)
    write_jaw(here / "jaw_inner.obj", INNER_BANDS)
    # A chord lies inside its arc: moved out by half its sagitta, it misses by as much both ways.
    chord_sagitta = RADIUS * (1 - np.cos(HALF_ANGLE / SEGMENTS))
    nodes = arc(RADIUS + chord_sagitta / 2, SEGMENTS)
    end = nodes[-1] - nodes[-2]
    nodes[-1] -= THICKNESS / 2 * end / np.linalg.norm(end)  # the cap ends at the tip
    print(f"arc radius {RADIUS:.4f} m, capsules miss it by {500 * chord_sagitta:.1f} mm at most")
    for (x0, y0), (x1, y1) in zip(nodes[:-1], nodes[1:]):
        print(f"fromto: {x0:.4f} {y0:.4f} z  {x1:.4f} {y1:.4f} z")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
