"""Draw the drives' answers to a step of the velocity command over those of the real machine.

python benchmark/plot_drives.py    # assets/figures/drives.svg, a few seconds
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import matplotlib

matplotlib.use("Agg")
import crane_runs
import machine
import matplotlib.pyplot as plt
import numpy as np
import tyro
from test_hydraulics import AXES, LABS_FIT, MEASURED, TIMES, response

FIGURE = Path(__file__).parent.parent / "assets" / "figures" / "drives.svg"


def main() -> None:
    figure, panels = plt.subplots(
        1, len(AXES), figsize=(15, 3.2), sharey=True, layout="constrained"
    )
    for axis, panel in zip(AXES, panels):
        curve, measured = response(axis, 0.4), np.array(MEASURED[axis])
        instants = TIMES[: len(measured)]
        seconds = machine.TIMESTEP * np.arange(1, len(curve) + 1)
        worst = np.abs(np.interp(instants, seconds, curve) - measured).max()
        panel.axhline(1, color="0.8", linewidth=1)
        panel.plot(seconds, curve, label="this model")
        panel.plot(instants, measured, "ko", markersize=4, label="machine")
        panel.set_title(f"{axis}: {worst:.2f} apart\n(the lab's own model: {LABS_FIT[axis]})")
        panel.set_xlabel("time since the command [s]")
        panel.set_xlim(0, instants[-1] + 0.05)
    panels[0].set_ylabel("speed / commanded speed")
    panels[0].legend()
    figure.savefig(FIGURE)
    print(f"written to {FIGURE}")


if __name__ == "__main__":
    crane_runs.one_line_errors()
    tyro.cli(main, description=__doc__)
