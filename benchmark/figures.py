"""Draw the figures of README.md and docs/ into assets/figures/, or the curves of your own runs.

python benchmark/figures.py run runs/<run>   # learning curves of runs and of CSV files
python benchmark/figures.py curves           # or another one of the repository's figures
"""

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent))

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import tyro
from numpy import ndarray as Array
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm
from tyro.conf import Positional

import eval_crane
from benchmark import runs
from benchmark.runs import LABELS, RESULTS, ROOT, Curve, read_curves, read_rows
from crane_utils import trials
from crane_utils.world import decorate
from hydraulic_crane import HydraulicCraneVectorEnv

matplotlib.use("Agg")
matplotlib.rcParams["svg.hashsalt"] = "curves"  # the same curves give the same file
FIGURES = ROOT / "assets" / "figures"
PAPER = np.mean([*eval_crane.PAPER["none"].values()])  # % of mPPO, Table I
ABLATIONS = {name: label for name, (label, *_) in runs.ABLATIONS.items()} | {
    # with earlier settings, without r_ground and with other drives (commit fd1bad9)
    "perturb_rpo": "mean perturbed instead (RPO) *",
    "no_bootstrap": "no bootstrapping at the time limit *",
    "curriculum": "difficulty rises with success *",
}
INSTANTS = np.array([0.06, 0.10, 0.15, 0.20, 0.30, 0.45, 0.60, 0.90, 1.20])  # s
AXES = {  # speed / command that the machine had at INSTANTS; inertia; q2, q3, q4, q8, in the air
    "slew": ([0.01, 0.02, 0.13, 0.33, 0.87, 1.42, 1.33, 0.75, 1.04], 4251, (1.2, -0.5, 0.0, 0.3)),
    "boom": ([0.05, 0.01, 0.35, 0.70, 1.19, 0.90, 0.93], 4855, (0.38, 0.5, 0.0, 0.3)),
    "arm": ([0.03, 0.08, 0.70, 1.04, 0.87, 0.88, 0.89], 5923, (0.51, 0.03, 0.0, 0.3)),
    "telescope": ([0.01, 0.01, -0.01, 0.08, 0.84, 1.22, 1.05], 1690, (0.51, 1.0, 1.16, 0.3)),
    "rotator": ([0.02, 0.02, 0.12, 0.33, 0.76, 0.95, 0.98], 49.6, (0.52, 1.04, 0.09, 1.35)),
}


def save(figure: plt.Figure, path: Path) -> None:
    metadata = {"Date": None} if path.suffix == ".svg" else None
    figure.savefig(path, dpi=200, bbox_inches="tight", metadata=metadata)
    print(f"written to {path}")


def draw(axis: plt.Axes, seeds: list[Curve], x: str, y: str, scale: float, **style: Any) -> None:
    """Means of x and y over the seeds at the steps of the first seed; the range of y shaded."""
    end = min(run["steps"][-1] for run in seeds)
    steps = [*[at for at in seeds[0]["steps"] if at < end], end]
    ys = np.array([np.interp(steps, run["steps"], run[y]) for run in seeds])
    xs = scale * np.mean([np.interp(steps, run["steps"], run[x]) for run in seeds], axis=0)
    axis.plot(xs, ys.mean(0), **style)
    axis.fill_between(xs, ys.min(0), ys.max(0), color=style["color"], alpha=0.2)


def four_panels(columns: dict[str, tuple], rows: dict[str, str], path: Path) -> None:
    """columns: what stands below them: runs by label, x and its scale; rows: y by its name."""
    figure, axes = plt.subplots(2, 2, figsize=(10, 6.4), sharex="col", sharey="row")
    for column, (below, (lines, x, scale)) in enumerate(columns.items()):
        for row, (name, y) in enumerate(rows.items()):
            axis = axes[row, column]
            for color, (label, seeds) in enumerate(lines.items()):
                label = f"{label}, {len(seeds)} run{'s' * (len(seeds) > 1)}"
                draw(axis, seeds, x, y, scale, color=f"C{color}", label=label)
            axis.grid(alpha=0.3)
            axes[row, 0].set_ylabel(f"{name} of the mean action")
        axis.set_xlabel(below)
    axes[0, 0].legend(fontsize=8)
    save(figure, path)


def learning_curves(lines: dict[str, list[Curve]], path: Path) -> None:
    columns = {"steps [million]": (lines, "steps", 1e-6), "minutes": (lines, "minutes", 1)}
    four_panels(columns, {"success": "eval_success_rate", "return": "eval_episodic_return"}, path)


def run(paths: Positional[tuple[Path, ...]], figure: Path = Path("curves.svg")) -> None:
    """Draw the learning curves of runs on the crane; those with the same task and name are one.

    Args:
        paths: folders of runs, or CSV files of benchmark/results/
        figure: file to write, .svg, .png or .pdf
    """
    lines: dict[str, list[Curve]] = {}
    for path in paths:
        if path.is_dir():  # <task>__<name>__<seed>__<time>
            label, rows = path.resolve().name.rsplit("__", 2)[0], runs.export(path)
        elif (rows := read_rows(path)) and "eval_success_rate" in rows[0]:
            label = path.stem.rsplit("_seed", 1)[0]
        else:
            raise SystemExit(f"{path} is neither the folder of a run nor the CSV file of one")
        lines.setdefault(label, []).append(runs.curve(rows))
        if not len(lines[label][-1]["steps"]):
            raise SystemExit(f"{path} has no evaluation on the crane yet (--eval-every)")
    learning_curves(lines, figure)


def curves() -> None:
    """Draw learning_curves.svg and level_curves.svg: results/curves/ and results/levels/."""
    found, columns = read_curves("curves") | read_curves("levels"), {}
    for level in ("", "_hydraulic", "_randomized"):
        lines = {label: found.get(script + level) for script, label in LABELS.items()}
        lines = {label: [*of_seed.values()] for label, of_seed in lines.items() if of_seed}
        columns[f"steps [million], {level[1:]} level"] = (lines, "steps", 1e-6)
    learning_curves(columns.pop("steps [million],  level")[0], FIGURES / "learning_curves.svg")
    rows = {"success": "eval_success_rate", "gentle success": "eval_gentle_rate"}
    four_panels(columns, rows, FIGURES / "level_curves.svg")


def ablations() -> None:
    """Draw ablations.svg: results/ablations/, a line for each change, a dot for each seed."""
    found = read_curves("ablations")
    shown = {label: found[name] for name, label in ABLATIONS.items() if name in found}
    figure, axis = plt.subplots(figsize=(8, 0.36 * len(shown) + 1))
    for row, seeds in enumerate(reversed(shown.values())):
        for k, of_seed in enumerate(seeds.values()):
            success = 100 * of_seed["eval_success_rate"][-1]
            axis.plot(success, row, "o", color=f"C{k}", alpha=0.8)
    axis.axvline(PAPER, color="black", ls="--", lw=1, label="paper, mPPO, Table I")
    axis.set_yticks(range(len(shown)), [*reversed(shown)])
    axis.set_xlabel("success at the end of 12.3 million physics steps [%]")
    axis.set_xlim(-2, 102)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(0.15, 0.5))
    save(figure, FIGURES / "ablations.svg")


def robustness() -> None:
    """Draw robustness.svg: results/robustness.csv, a panel for each change."""
    lines: dict[str, dict[str, list]] = {}
    for row in read_rows(RESULTS / "robustness.csv"):
        point = float(row["value"]), float(row["success"])
        lines.setdefault(row["changed"], {}).setdefault(row["method"], []).append(point)
    rows = -(-len(lines) // 4)
    figure = plt.figure(figsize=(12, 3 * rows))
    for k, (change, of_method) in enumerate(lines.items()):
        axis = figure.add_subplot(rows, 4, k + 1, xlabel=change, ylim=(0, 102))
        axis.set_ylabel("" if k % 4 else "success [%]")
        for method, points in of_method.items():
            axis.plot(*zip(*sorted(points)), "o-", markersize=4, label=method)
        axis.grid(alpha=0.3)
        axis.set_xscale("log" if change.startswith("passive") else "linear")
    handles = axis.get_legend_handles_labels()
    figure.legend(*handles, loc="upper center", bbox_to_anchor=(0.5, 0.03), ncols=6)
    figure.subplots_adjust(hspace=0.3)
    save(figure, FIGURES / "robustness.svg")


def response(axis: str, action: float, at_work: bool = False) -> Array:
    """Speed / command after each of 250 physics steps, with the record's inertia or the own."""
    import mujoco  # after crane_env, which chooses its OpenGL

    _, inertia, pose = AXES[axis]
    q2, q3, q4, q8 = (0.5, 0.2, 0.5, 0.3) if at_work else pose
    q = np.array([[-1.2, q2, q3, q4, np.pi / 2 - q2 - q3, np.pi / 2, 0, q8]])
    far_log = np.array([[-20.0, 0.0, 0.0]])  # out of the way
    start, i = (np.zeros(1, int), q, far_log, np.array([0.3])), [*AXES].index(axis)
    crane = HydraulicCraneVectorEnv(1, env_threads=1, frame_skip=1, autoreset=False)
    crane.reset(seed=0)
    crane.place(*start)
    if not at_work:
        model, data = crane.batch.get_model(0), crane.batch.get_data(0)
        mujoco.mj_forward(model, data)
        moving, momentum = np.zeros(model.nv), np.zeros(model.nv)
        moving[{"telescope": [3, 4], "rotator": [7]}.get(axis, [i])] = 1
        mujoco.mj_mulM(model, data, momentum, moving)
        for body in range(1, model.nbody - 1):  # all but the world and the log
            view = crane.batch.body(model.body(body).name)
            view.mass[:] *= inertia / (moving @ momentum)
            view.inertia[:] *= inertia / (moving @ momentum)
        crane.place(*start)
    speeds, actions = [], np.zeros((1, 6))
    for step in range(290):
        actions[0, i] = action * (step >= 40)
        crane.step(actions)
        speeds.append(crane.state().dq[0, i])
    return (np.array(speeds[40:]) - speeds[39]) / crane.command[0, i]


def drives() -> None:
    """Draw drives.svg: answers of the hydraulic drives and of the machine to a step."""
    figure, panels = plt.subplots(1, len(AXES), figsize=(15, 3.2), sharey=True)
    for (axis, (measured, *_)), panel in zip(AXES.items(), panels):
        at = INSTANTS[: len(measured)]
        both_ways = [response(axis, action) for action in (0.4, -0.4)]
        worst = np.abs(np.array(both_ways)[:, np.round(at / 0.005).astype(int) - 1] - measured)
        seconds = 0.005 * np.arange(1, 251)
        panel.axhline(1, color="0.8", linewidth=1)
        panel.plot(seconds, both_ways[0], label="this model")
        panel.plot(seconds, response(axis, 0.4, True), "C0:", label="at work, its own inertia")
        panel.plot(at, measured, "ko", markersize=4, label="machine")
        panel.set_title(f"{axis}\n{worst.max():.2f} apart at most", fontsize=10)
        panel.set_xlabel("time since the command [s]")
        panel.set_xlim(0, at[-1] + 0.05)
    panels[0].set_ylabel("speed / commanded speed")
    panel.legend(fontsize=8, loc="lower right")
    save(figure, FIGURES / "drives.svg")


def pictures(policy: str, diameter: float) -> list[Image.Image]:
    """A labelled picture after each step of a trial of seed 60000."""
    agent, task, _ = eval_crane.load_policy(policy)
    look = {"render_mode": "rgb_array", "width": 400, "height": 300, "decorate": decorate}
    how = task["options"] | look | {"diameter": diameter, "autoreset": False}
    crane = trials.make_envs(task["env_id"], 1, 1, how).unwrapped
    seed = trials.monte_carlo_trials(trials.REPORT_SEED, 2, [diameter])[1][1]
    obs, state, taken = crane.reset(seed=[seed])[0], None, []
    for step in tqdm(range(crane.max_steps + 1), unit="picture"):
        taken.append(Image.fromarray(crane.render()[0]))
        pen, label = ImageDraw.Draw(taken[-1], "RGBA"), f"{diameter} m, {step * crane.dt:.1f} s"
        pen.rectangle((0, 0, 400, 22), fill=(0, 0, 0, 120))
        pen.text((6, 3), label, font=ImageFont.load_default(14), fill="white")
        actions, state = agent.predict(obs, state)
        obs = crane.step(actions)[0]
    crane.close()
    return taken


def hero(policy: Positional[str] = eval_crane.SHIPPED) -> None:
    """Make lift.gif, in minutes without a GPU. policy: a run's folder or policy.pt."""
    pairs = zip(pictures(policy, 0.3), pictures(policy, 0.8))
    film = [Image.fromarray(np.concatenate([*map(np.asarray, pair)], axis=1)) for pair in pairs]
    # One palette and no dithering: where nothing moves no pixel changes, and GIF stores nothing.
    palette = film[len(film) // 2].quantize(160)
    film = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in film]
    how = {"save_all": True, "append_images": film[1:], "duration": 100, "loop": 0}
    film[0].save(FIGURES / "lift.gif", **how)
    print(f"written to {FIGURES / 'lift.gif'}")


if __name__ == "__main__":
    commands = (run, curves, ablations, robustness, drives, hero)
    tyro.extras.subcommand_cli_from_dict(
        {command.__name__: command for command in commands}, description=__doc__
    )
