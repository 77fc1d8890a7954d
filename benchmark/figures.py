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
from benchmark import runs, tables
from benchmark.runs import LABELS, LEVELS, RESULTS, ROOT, Curve, read_curves, read_rows
from crane_env import mujoco  # it has chosen how to draw without a display
from crane_utils import trials
from crane_utils.world import decorate
from hydraulic_crane import HydraulicCraneVectorEnv

matplotlib.use("Agg")
matplotlib.rcParams["svg.hashsalt"] = "curves"  # the same curves give the same file
FIGURES, POLICIES = ROOT / "assets" / "figures", ROOT / "assets" / "policies"
PAPER = np.mean([*eval_crane.PAPER["none"].values()])  # % of mPPO
PAPER_LABEL = "paper, Table I: another rule, 500 M steps"
# Geryyy/crane_model, test/step_response_fixture.json: means over the edges of a recording
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
    if y.endswith("_rate"):  # untrained policies hardly move: `eval_crane.py zero` lifts nothing
        xs, ys = np.append(0, xs), np.insert(ys, 0, 0, axis=1)
    axis.plot(xs, ys.mean(0), marker="." if len(xs) == 1 else "", **style)
    axis.fill_between(xs, ys.min(0), ys.max(0), color=style["color"], alpha=0.2)


def panels(columns: dict[str, tuple], rows: dict[str, str], path: Path) -> None:
    """columns: what stands below them: runs by label, x and its scale; rows: y by its name."""
    shape = len(rows), len(columns)
    size = {"figsize": (5 * len(columns), 3.2 * len(rows)), "squeeze": False}
    figure, axes = plt.subplots(*shape, sharex="col", sharey="row", **size)
    for column, (below, (lines, x, scale)) in enumerate(columns.items()):
        for row, (name, y) in enumerate(rows.items()):
            axis = axes[row, column]
            for color, (label, seeds) in enumerate(lines.items()):
                label = f"{label}, {len(seeds)} run{'s' * (len(seeds) > 1)}"
                draw(axis, seeds, x, y, scale, color=f"C{color}", label=label)
            axis.grid(alpha=0.3)
            axes[row, 0].set_ylabel(f"{name} of the mean action")
        axis.set_xlabel(below)
        axes[0, column].legend(fontsize=8)
    save(figure, path)


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
    for label, seeds in lines.items():
        ends = [100 * run["eval_success_rate"][-1] for run in seeds]
        print(f"{label}: last success {tables.with_range(np.mean(ends), ends)} %")
    columns = {"steps [million]": (lines, "steps", 1e-6), "minutes": (lines, "minutes", 1)}
    rows = {"success": "eval_success_rate", "return": "eval_episodic_return"}
    panels(columns, rows, figure)


def curves() -> None:
    """Draw learning_curves.svg (results/curves/ and levels/), loading_ and printed_curves.svg."""
    rows = {"success": "eval_success_rate", "gentle success": "eval_gentle_rate"}
    found, columns = read_curves("curves") | read_curves("levels"), {}
    for level in LEVELS:
        names = {f"{script}_{level}".removesuffix("_ideal"): LABELS[script] for script in LABELS}
        lines = {label: [*found[name].values()] for name, label in names.items() if name in found}
        columns[f"steps [million], {level} level"] = (lines, "steps", 1e-6)
    panels(columns, rows, FIGURES / "learning_curves.svg")
    returns = {"return": "eval_episodic_return"}
    both = {"success": "eval_success_rate"} | returns
    # nothing succeeds with the printed reward
    tasks = ("loading", "loading cycle", both), ("printed", "printed reward", returns)
    for folder, task, rows in tasks:
        lines = {
            label + name.removeprefix(script).replace("_", ", "): [*of_seed.values()]
            for name, of_seed in read_curves(folder).items()
            for script, label in LABELS.items()
            if name.startswith(script)
        }
        if lines:
            columns = {f"steps [million], {task}": (lines, "steps", 1e-6)}
            panels(columns, rows, FIGURES / f"{folder}_curves.svg")


def levels() -> None:
    """Draw levels.svg: success of the algorithms on the levels, a dot for each seed."""
    figure, axes = plt.subplots(1, len(LEVELS), figsize=(12, 3.4), sharey=True)
    board = [row for row in read_rows(RESULTS / "leaderboard.csv") if row["method"] == "scripted"]
    for axis, level in zip(axes, LEVELS):
        columns = {label: tables.evaluations(script, level) for script, label in LABELS.items()}
        of = {label: tables.numbers(rows, "success") for label, rows in columns.items()}
        of["scripted"] = [float(row["success_exact"]) for row in board if row["level"] == level]
        for x, success in enumerate(of.values()):
            axis.plot([x] * len(success), success, "o", color=f"C{x}", alpha=0.7)
            axis.hlines(np.mean(success), x - 0.3, x + 0.3, color=f"C{x}", linewidth=2)
        axis.set_xticks(range(len(of)), [label.replace(" ", "\n") for label in of], fontsize=8)
        axis.set_title(f"{level} level")
        axis.grid(axis="y", alpha=0.3)
    axes[0].axhline(PAPER, color="black", linestyle="--", linewidth=1, label=PAPER_LABEL)
    axes[0].legend(fontsize=8, loc="lower left")
    axes[0].set_ylabel("success [%], a dot per training seed")
    save(figure, FIGURES / "levels.svg")


def ablations() -> None:
    """Draw ablations.svg: results/ablations/, a line for each change, a dot for each seed."""
    found = read_curves("ablations")
    shown = {label: found[name] for name, (label, *_) in runs.ABLATIONS.items() if name in found}
    figure, axis = plt.subplots(figsize=(8, 0.36 * len(shown) + 1))
    for row, seeds in enumerate(reversed(shown.values())):
        for k, of_seed in enumerate(seeds.values()):
            success = 100 * of_seed["eval_success_rate"][-1]
            axis.plot(success, row, "o", color=f"C{k}", alpha=0.8)
    axis.axvline(PAPER, color="black", ls="--", lw=1, label=PAPER_LABEL)
    axis.set_yticks(range(len(shown)), [*reversed(shown)])
    axis.set_xlabel("success after 0.6 million steps of 0.1 s [%]")
    axis.set_xlim(-2, 102)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(0.01, 0.5))
    save(figure, FIGURES / "ablations.svg")


def robustness() -> None:
    """Draw robustness.svg: results/robustness.csv, a panel for each change, 95 % intervals."""
    lines: dict[str, dict[str, list]] = {}
    for row in read_rows(RESULTS / "robustness.csv"):
        trials, share = int(row["trials"]), float(row["success"]) / 100
        low, high = eval_crane.wilson_interval(round(share * trials), trials)
        point = [float(row["value"]), 100 * share, 100 * low, 100 * high]
        lines.setdefault(row["changed"], {}).setdefault(row["method"], []).append(point)
    figure, axes = plt.subplots(-(-len(lines) // 3), 3, figsize=(12, 8), sharey=True)
    for axis, (change, of_method) in zip(axes.flat, lines.items()):
        for k, (method, points) in enumerate(of_method.items()):
            x, success, low, high = np.array(sorted(points)).T
            axis.plot(x, success, "o-", color=f"C{k}", label=method)
            axis.fill_between(x, low, high, color=f"C{k}", alpha=0.15)
        axis.set_xlabel(change, fontsize=11)
        axis.grid(alpha=0.3)
    for axis in axes[:, 0]:
        axis.set_ylabel("success [%]", fontsize=11)
    axes[0, 0].legend()
    figure.tight_layout()
    save(figure, FIGURES / "robustness.svg")


def response(axis: str, action: float, at_work: bool = False, step: float = 0.005) -> Array:
    """Speed / command after each step of 1.25 s, with the record's inertia or the crane's own."""
    _, inertia, pose = AXES[axis]
    q2, q3, q4, q8 = (0.5, 0.2, 0.5, 0.3) if at_work else pose
    q = np.array([[-1.2, q2, q3, q4, np.pi / 2 - q2 - q3, np.pi / 2, 0, q8]])
    far_log = np.array([[-20.0, 0.0, 0.0]])  # out of the way
    start, i = (np.zeros(1, int), q, far_log, np.array([0.3])), [*AXES].index(axis)
    skip = {"frame_skip": round(step / 0.005), "physics_step": step}
    crane = HydraulicCraneVectorEnv(1, env_threads=1, autoreset=False, **skip)
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
    speeds, actions, rest = [], np.zeros((1, 6)), round(0.2 / step)
    for k in range(rest + round(1.25 / step)):
        actions[0, i] = action * (k >= rest)
        crane.step(actions)
        speeds.append(crane.state().dq[0, i])
    return (np.array(speeds[rest:]) - speeds[rest - 1]) / crane.command[0, i]


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


def pictures(
    policy: str, diameter: float, trial: int = 0, every: int = 1, label: str = "",
    camera: str = "overview", size: tuple[int, int] = (400, 300),
) -> list[Image.Image]:  # fmt: skip
    """Labelled pictures of a trial of seed 60000, one in `every` steps and the last."""
    agent, task, _ = eval_crane.load_policy(policy)
    look = {"render_mode": "rgb_array", "decorate": decorate, "camera": camera}
    look |= {"width": size[0], "height": size[1], "diameter": diameter, "autoreset": False}
    crane = trials.make_envs(task["env_id"], 1, 1, task["options"], **look).unwrapped
    seeds = trials.monte_carlo_trials(trials.REPORT_SEED, trial + 1, [diameter])[1]
    obs, state, taken, end = crane.reset(seed=seeds[-1:])[0], None, [], False
    for step in tqdm(range(crane.max_steps + 1), unit="step", leave=False):
        if end or step % every == 0:
            taken.append(Image.fromarray(crane.render()[0]))
            pen, text = ImageDraw.Draw(taken[-1], "RGBA"), f"{diameter} m, {step * crane.dt:.1f} s"
            pen.rectangle((0, 0, size[0], 22), fill=(0, 0, 0, 120))
            font = ImageFont.load_default(14)
            pen.text((6, 3), f"{text}{label}", font=font, fill="white")
        if end:
            break
        actions, state = agent.predict(obs, state)
        obs, _, terminated, truncated, _ = crane.step(actions)
        end = bool(terminated[0] | truncated[0])
    crane.close()
    return taken


def sheet(taken: list[Image.Image], columns: int, path: Path) -> None:
    """Write pictures side by side, `columns` in a row."""
    width, height = taken[0].size
    whole = Image.new("RGB", (columns * width, -(-len(taken) // columns) * height), "white")
    for k, picture in enumerate(taken):
        whole.paste(picture, (k % columns * width, k // columns * height))
    whole.save(path, quality=85)
    print(f"written to {path}")


def grasp(
    policy: Positional[str] = f"{POLICIES}/mppo_beta_crane_hydraulic.pt", diameter: float = 0.5
) -> None:
    """Make grasp.jpg: one trial, a picture each 0.7 s."""
    taken = pictures(policy, diameter, every=7, camera="grapple")
    sheet(taken[:12], 4, FIGURES / "grasp.jpg")


def failures(policy: Positional[str] = f"{POLICIES}/trpo_crane.pt") -> None:
    """Make failures.jpg: ends of up to eight failed trials of seed 60000, with their causes."""
    agent, task, _ = eval_crane.load_policy(policy)
    options = trials.crane_class(task["env_id"]).Options(**task["options"])
    args = eval_crane.Args(seed=trials.REPORT_SEED)
    rows = [*eval_crane.play(agent, task["env_id"], options, args)]
    rows = [row for row in rows if not row["success"]]
    if not rows:
        raise SystemExit(f"{policy} fails in none of its trials")
    taken = []
    for k in np.unique(np.linspace(0, len(rows) - 1, 8).astype(int)):
        diameter, trial = rows[k]["diameter"], rows[k]["trial"]
        label = f", {rows[k]['failure'].replace('_', ' ')}"
        taken += pictures(policy, diameter, trial, 1000, label, camera="grapple")[-1:]
    sheet(taken, 4, FIGURES / "failures.jpg")


def hero(
    policy: Positional[str] = f"{POLICIES}/mppo_beta_crane_hydraulic_loading.pt",
    diameter: float = 0.6,
    trial: int = 0,
) -> None:
    """Make loading.gif, the loading cycle at double speed."""
    taken = pictures(policy, diameter, trial, 2, size=(800, 450))
    # One palette and no dithering: where nothing moves no pixel changes, and GIF stores nothing.
    palette = taken[len(taken) // 2].quantize(128)
    taken = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in taken]
    how = {"save_all": True, "append_images": taken[1:], "duration": 100, "loop": 0}
    taken[0].save(FIGURES / "loading.gif", **how)
    print(f"written to {FIGURES / 'loading.gif'}")


if __name__ == "__main__":
    commands = (run, curves, levels, ablations, robustness, drives, grasp, failures, hero)
    tyro.extras.subcommand_cli_from_dict(
        {command.__name__: command for command in commands}, description=__doc__
    )
