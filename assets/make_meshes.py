"""Writes the meshes of the jaws, assets/jaw_root.obj, jaw_middle.obj and jaw_tip.obj.

A jaw is a band bent to an arc between its pivot (the origin) and its tip (CHORD, 0, 0); the arc
bulges by SAGITTA towards -y, away from the log. The outer jaw has two bands with a gap, through
which the inner jaw's single band passes when the grapple closes on a thin log; crane.xml scales the
meshes, 1 m wide, to each band's width. A band comes in PIECES, the shorter the nearer to the tip,
which holds the log: SDF contacts are searched for in the box that a piece shares with the log, and
the smaller the box, the fewer are missed (assets/README.md). The script also prints the capsule
chain of crane.xml, whose straight segments straddle the arc.

    python assets/make_meshes.py
"""

from pathlib import Path

import numpy as np
import tyro

CHORD = 0.8566  # m, pivot to tip
SAGITTA = 0.30  # m
THICKNESS = 0.05  # m, measured along the arc's radius
SECTIONS = 48  # of the meshes along the arc
PIECES = {"root": (0, 32), "middle": (32, 44), "tip": (44, 48)}  # sections of each
SEGMENTS = 5  # of the capsule chain

RADIUS = (CHORD**2 / 4 + SAGITTA**2) / (2 * SAGITTA)
HALF_ANGLE = np.arcsin(CHORD / 2 / RADIUS)


def arc(radius: float, sections: int) -> np.ndarray:
    """Points (sections + 1, 2) of the jaw's xy plane, `radius` from the arc's centre, in m."""
    angle = np.linspace(-HALF_ANGLE, HALF_ANGLE, sections + 1)
    centre = np.array([CHORD / 2, RADIUS - SAGITTA])
    return centre + radius * np.stack([np.sin(angle), -np.cos(angle)], axis=-1)


def piece(first: int, last: int) -> str:
    """OBJ text of the closed band between two of the arc's sections, z from -0.5 to 0.5 m."""
    inside, outside = arc(RADIUS - THICKNESS / 2, SECTIONS), arc(RADIUS + THICKNESS / 2, SECTIONS)
    lines = ["# written by make_meshes.py"]
    for i in range(first, last + 1):
        corners = [(*inside[i], -0.5), (*inside[i], 0.5), (*outside[i], 0.5), (*outside[i], -0.5)]
        lines += [f"v {x:.5f} {y:.5f} {z:.1f}" for x, y, z in corners]
    quads = [(0, 1, 2, 3)]  # the cap towards the pivot, then the sides, then the cap at the end
    for ring in range(0, 4 * (last - first), 4):
        for k in range(4):
            quads.append((ring + k, ring + 4 + k, ring + 4 + (k + 1) % 4, ring + (k + 1) % 4))
    end = 4 * (last - first)
    quads.append((end + 3, end + 2, end + 1, end))
    for a, b, c, d in quads:
        lines += [f"f {a + 1} {c + 1} {b + 1}", f"f {a + 1} {d + 1} {c + 1}"]
    return "\n".join(lines) + "\n"


def main() -> None:
    here = Path(__file__).parent
    for name, (first, last) in PIECES.items():
        (here / f"jaw_{name}.obj").write_text(piece(first, last))
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
