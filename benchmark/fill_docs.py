"""Write the tables of the CSV files into README.md and docs/, between their marks.

    python benchmark/fill_docs.py

A table stands between <!-- name --> and <!-- end -->. TABLES says which function makes it, and the
function says from which file. A test fails when a document and its CSV file differ.

A run keeps the paper's 96.3 % from the first evaluation with 96.3 % or more that is not the last
one, if no later evaluation is below 95 %. Minutes are those of rollouts and updates, without
evaluations, on the machine of the run.
"""

import csv
import sys
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import make_runs
import numpy as np
import plot_curves
import rivals as rival_runs
import tyro
from plot_curves import PAPER, Run, read, recorded

sys.path.insert(0, str(Path(__file__).parent.parent))

from crane_trials import REPORT_SEED

import crane_env
import eval_crane

HERE = Path(__file__).parent
ROOT = HERE.parent
LEVELS = ["ideal", "hydraulic", "randomized"]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def rows_of(name: str) -> list[dict[str, str]]:
    with (HERE / name).open() as file:
        return list(csv.DictReader(file))


def evaluations(run: str, noise: str) -> list[dict[str, str]]:
    """The rows of a run in evaluations.csv, one a seed."""
    rows = rows_of("evaluations.csv")
    return [row for row in rows if (row["run"], row["pose_noise"]) == (run, noise)]


def table(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["--"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def leaderboard() -> str:
    """Means over the seeds of each method of the leaderboard, level by level, the best first."""
    of_method = defaultdict(list)
    for row in rows_of("leaderboard.csv"):
        if row["revision"] != str(crane_env.REVISION):
            continue
        of_method[row["level"], row["method"]].append(row)
    scores = ["gentle_exact", "success_exact", "gentle_pose_errors", "success_pose_errors"]
    means = {
        key: [np.mean([float(row[score]) for row in rows]) for score in scores]
        for key, rows in of_method.items()
    }
    lines = []
    for level, method in sorted(means, key=lambda key: (LEVELS.index(key[0]), -means[key][0])):
        rows = of_method[level, method]
        numbers = [f"{mean:.1f}" for mean in means[level, method]]
        lines.append([level, method, *numbers, str(len(rows)), rows[0]["training"]])
    header = ["level", "method", "gentle %", "success %", "gentle, with pose errors"]
    return table([*header, "success, with pose errors", "number of seeds", "training"], lines)


def results() -> str:
    """README's table: mean, lowest and highest of the training seeds, exact pose, level by level.

    The scripted crane has no seeds. Its row comes from the leaderboard.
    """
    rows = []
    for script in plot_curves.LABELS:
        cells = []
        for level in LEVELS:
            mine = [r for r in evaluations(run_of(script, level), "none") if r["gentle"]]
            for score in ("success", "gentle"):
                numbers = [float(row[score]) for row in mine]
                low, high = min(numbers), max(numbers)
                cells.append(f"{np.mean(numbers):.1f} ({low:.1f}–{high:.1f})")
        rows.append([f"`{script}.py`", *cells])
    scripted = {r["level"]: r for r in rows_of("leaderboard.csv") if r["method"] == "scripted"}
    both = ("success_exact", "gentle_exact")
    cells = [scripted[level][score] for level in LEVELS for score in both]
    rows.append(["`scripted_crane.py`, no learning", *cells])
    rows.append(["paper, mPPO", "96.3", "", "", "", "", ""])
    header = ["policy"]
    for level in LEVELS:
        header += [level, "gentle"]
    return table(header, rows)


def run_of(script: str, level: str) -> str:
    """Name of a script's runs on a level, in evaluations.csv."""
    return f"curves_{script}" if level == "ideal" else f"levels_{script}_{level}"


def seeds() -> str:
    """evaluations.csv: success, gentle success and costs of each training seed, level by level.

    A dash stands for costs that were not measured, or for no success.
    """
    lines = []
    for level in LEVELS:
        for script, method in plot_curves.LABELS.items():
            run = run_of(script, level)
            mine = [r for r in evaluations(run, "none") if r["gentle"]]
            if not mine:
                continue
            folder, name = run.split("_", 1)
            ends = {r["seed"]: r["decisions"][-1] / 1e6 for r in read(folder).get(name, [])}
            trained = dict.fromkeys(f"{ends[row['seed']]:.2f}" for row in mine)
            line = [level, method, ", ".join(trained), ", ".join(row["seed"] for row in mine)]
            for name in ("success", "gentle"):
                numbers = [float(row[name]) for row in mine]
                line += [joined(numbers, 1), f"{np.mean(numbers):.1f}"]
            for name in ("energy [kJ]", "up [s]"):
                cells = [f"{float(row[name]):.1f}" if row.get(name) else "-" for row in mine]
                line.append(", ".join(cells) if set(cells) != {"-"} else "")
            lines.append(line)
    header = ["level", "method", "decisions [million]", "seeds"]
    header += ["success", "mean", "gentle", "mean", "energy [kJ]", "up [s]"]
    return table(header, lines)


def judged() -> list[dict[str, str]]:
    """The rows of levels.csv with policies of training seed 1, judged by the protocol."""
    wanted = {"seed": "1", "trial_seed": str(REPORT_SEED), "per_diameter": "100"}
    return [row for row in rows_of("levels.csv") if row | wanted == row]


def matrix() -> str:
    """Success and gentle success of each policy of training seed 1 on each level."""
    rows = judged()
    lines = []
    for method, trained_on in dict.fromkeys((row["method"], row["trained_on"]) for row in rows):
        cells = {}
        for row in rows:
            if (row["method"], row["trained_on"]) == (method, trained_on):
                success, gentle = float(row["success"]), float(row["gentle"])
                cells[row["judged_on"]] = f"{success:.1f} / {gentle:.1f}"
        lines.append([method, trained_on, *[cells[level] for level in LEVELS]])
    lines.sort(key=lambda line: LEVELS.index(line[1]))
    return table(["method", "made for", *[f"judged on {level}" for level in LEVELS]], lines)


def costs() -> str:
    """What the trials of each policy cost on its own level."""
    lines = []
    left_out = ("peak [kN]", "impulse [kN s]", "> 20 kN [s]")
    heads = [head for head, *_ in eval_crane.CARE_COLUMNS if head not in left_out]
    for row in judged():
        if row["trained_on"] == row["judged_on"]:
            hard = f"{1000 * float(row['> 20 kN [s]']):.2f}"
            numbers = [f"{float(row[head]):.3g}" if row[head] else "" for head in heads]
            lines.append([row["trained_on"], row["method"], hard, *numbers])
    lines.sort(key=lambda line: LEVELS.index(line[0]))
    return table(["level", "method", "> 20 kN [ms]", *heads], lines)


def joined(numbers: Iterable[float], digits: int) -> str:
    """One number a seed; NaN says that it never happened."""
    return ", ".join("never" if np.isnan(x) else f"{x:.{digits}f}" for x in numbers)


def kept_after(run: Run) -> float:
    """Minutes until the run keeps the paper's success, or NaN."""
    minutes, success = recorded(run, "minutes", "eval_success_rate")
    for k in range(len(success) - 1):
        if success[k] >= PAPER["Table I"] and success[k:].min() >= 0.95:
            return minutes[k]
    return np.nan


def crossing(run: Run, x: str, level: float) -> float:
    """x in millions, between two evaluations, where success first reaches level, or NaN."""
    xs, success = recorded(run, x, "eval_success_rate")
    row = np.argmax(success >= level)
    if success[row] < level:
        return np.nan
    return np.interp(level, success[: row + 1][-2:], xs[: row + 1][-2:]) / 1e6


def timed() -> str:
    """The trainings of timed/*.csv: each alone on two cores, with two threads."""
    lines = []
    for name, runs in read("timed").items():
        level = name.removeprefix("mppo_beta_crane").strip("_") or "ideal"
        for run in runs:
            numbers = [run["decisions"][-1] / 1e6, run["minutes"][-1], kept_after(run)]
            cells = [joined([x], digits) for x, digits in zip(numbers, (2, 1, 1))]
            lines.append([level, run["seed"], *cells, f"{100 * run['final_success_rate'][-1]:.1f}"])
    lines.sort(key=lambda line: LEVELS.index(line[0]))
    header = ["level", "seed", "decisions [million]", "training [min]"]
    return table([*header, "96.3 % kept after [min]", "success at the end [%]"], lines)


def algorithms() -> str:
    """evaluations.csv: success of each seed's policy on the ideal level."""
    noises = {"none": "Table I", "step": "Table II"}
    lines = []
    for script in make_runs.SCRIPTS:
        line = [f"`{script}.py`"]
        for noise in noises:
            means = [float(row["success"]) for row in evaluations(f"curves_{script}", noise)]
            line += [joined(means, 1), f"{np.mean(means):.1f}"]
        lines.append(line)
    paper = [cell for title in noises.values() for cell in ("", f"{100 * PAPER[title]:.1f}")]
    lines.append(["paper, mPPO", *paper])
    header = ["exact pose: seeds 1, 2, 3", "mean", "pose errors: seeds 1, 2, 3", "mean"]
    return table(["policy", *header], lines)


def paper() -> str:
    """Tables I and II of the paper beside evaluations.csv: mPPO, training seed 1."""
    exact, errors = (evaluations("curves_mppo_beta_crane", noise)[0] for noise in ("none", "step"))
    lines = []
    for d in eval_crane.PAPER["none"]:
        printed = [str(eval_crane.PAPER[noise][d]) for noise in ("none", "step")]
        ours = [f"{float(row[f'{d} m']):.0f}" for row in (exact, errors)]
        lines.append([str(d), printed[0], ours[0], printed[1], ours[1]])
    means = [f"{float(row['success']):.1f}" for row in (exact, errors)]
    lines.append(["mean", f"{100 * PAPER['Table I']:.1f}", means[0]])
    lines[-1] += [f"{100 * PAPER['Table II']:.1f}", means[1]]
    header = ["d [m]", "paper, Table I", "here", "paper, Table II", "here"]
    return table(header, lines)


def learning() -> str:
    """curves/*.csv: when the four algorithms learn, and the return at the end."""
    lines, curves = [], read("curves")
    for script, label in plot_curves.LABELS.items():
        runs = curves[script]
        cells = [joined([crossing(r, "decisions", p) for r in runs], 2) for p in (0.5, 0.9)]
        returns = [recorded(r, "decisions", "eval_episodic_return")[1][-1] for r in runs]
        lines.append([label, *cells, joined(returns, 0)])
    header = ["half of the trials succeed after [million decisions]", "nine tenths succeed after"]
    return table(["method", *header, "return of the mean action at the end"], lines)


def ablations() -> str:
    """ablations/*.csv: mPPO with one thing changed."""
    runs, lines = read("ablations"), []
    for name, label in plot_curves.ABLATIONS.items():
        if name not in runs:
            continue
        script, flags = make_runs.ABLATIONS.get(name, ("", ""))
        if script == "ppo_crane":
            flags = f"ppo_crane.py {flags}"
        success = [100 * run["final_success_rate"][-1] for run in runs[name]]
        half, most = (
            joined([crossing(run, "simulation_steps", part) for run in runs[name]], 1)
            for part in (0.5, 0.9)
        )
        lines.append([label, f"`{flags}`" if flags else "", joined(success, 1), half, most])
    header = ["change", "flags", "success at the end [%], seeds 1, 2"]
    header += ["half succeed after [million steps]", "nine tenths succeed after"]
    return table(header, lines)


def speed() -> str:
    """throughput.csv: the ratios, a column a frame skip."""
    ratios: dict[str, dict[str, str]] = {}
    for row in measured_ratios():
        ratios.setdefault(row["what"], {})[row["skip"]] = f"{float(row['median']):.2f}"
    rows = [
        [name, *[found.get(skip, "") for skip in ("20", "1")]] for name, found in ratios.items()
    ]
    return table(["ratio", "skip 20", "skip 1"], rows)


def missed() -> str:
    """throughput.csv: the ratios below their targets."""
    rows = []
    for row in measured_ratios():
        if row["note"] and float(row["median"]) < float(row["note"]):
            rows.append([row["what"], row["skip"], f"{float(row['median']):.2f}", row["note"]])
    return table(["ratio", "skip", "value", "target"], rows)


def measured_ratios() -> list[dict[str, str]]:
    with (HERE / "throughput.csv").open() as file:
        next(file)  # the machine
        return [row for row in csv.DictReader(file) if row["part"] == "ratio"]


def rivals() -> str:
    """rivals.csv: success of the runs of ten minutes."""
    return rival_runs.results_table(rival_runs.RESULTS, 10.0)


def scaling() -> str:
    """scaling.csv: what the model predicts from two cores for a network between machines."""
    wanted = ("2", "model, 10 Gbit/s")
    rows = [row for row in rows_of("scaling.csv") if (row["cores"], row["what"]) == wanted]
    header = ["ranks, one core each", "cranes on each", "decisions per second"]
    return table(
        header, [[r["ranks"], r["cranes"], f"{round(float(r['SPS']), -2):,.0f}"] for r in rows]
    )


def profiles() -> str:
    """profiles.csv: shares of a decision, of a physics step and of a training."""
    rows = rows_of("profiles.csv")
    lines = [[row["part"], row["what"], f"{100 * float(row['share']):.0f}"] for row in rows]
    return table(["whole", "part", "share [%]"], lines)


def gpu() -> str:
    """gpu.csv: seconds of mPPO's trainings with the networks on a GPU and on the CPU."""
    lines = []
    for row in rows_of("gpu.csv"):
        networks = {"cuda": "GPU", "cpu": "CPU"}[row["networks"]]
        speed = f"{round(float(row['SPS']), -2):,.0f}"
        seconds = [f"{float(row[name]):.3g}" for name in ("rollout", "update", "physics")]
        lines.append([f"{int(row['cranes']):,}", networks, speed, *seconds])
    header = ["cranes", "networks", "decisions per second", "rollout [s]", "update [s]"]
    return table([*header, "physics [s]"], lines)


def outside() -> str:
    """compare_sb3.csv and pendulum_30_seeds.csv: our returns and those of Stable-Baselines3."""
    lines = []
    for name in ("compare_sb3.csv", "pendulum_30_seeds.csv"):
        returns = defaultdict(list)
        for row in rows_of(name):
            run = row["task"], row["algorithm"], row["library"]
            returns[run].append(float(row["mean_return"]))
        for task, algorithm in dict.fromkeys(run[:2] for run in returns):
            count = len(returns[task, algorithm, "ours"])
            line = [task, plot_curves.LABELS[f"{algorithm}_crane"], str(count)]
            for library in ("ours", "sb3"):
                if mine := returns[task, algorithm, library]:
                    line += [
                        f"{np.mean(mine):.0f} ± {np.std(mine, ddof=1):.0f}",
                        f"{min(mine):.0f}",
                    ]
                else:
                    line += ["", ""]
            lines.append(line)
    header = ["task", "algorithm", "seeds", "ours", "worst seed"]
    return table([*header, "Stable-Baselines3", "worst seed"], lines)


def memory() -> str:
    """masked_pendulum.csv: the return at the end of each run."""
    ends = defaultdict(dict)
    for row in rows_of("masked_pendulum.csv"):
        ends[row["algorithm"]][row["seed"]] = float(row["mean_return"])
    lines = [
        [plot_curves.LABELS[f"{algorithm}_crane"], joined(of_seed.values(), 0)]
        for algorithm, of_seed in ends.items()
    ]
    return table(["algorithm", "return at the end, seeds 1, 2, 3"], lines)


TABLES = {
    "leaderboard": leaderboard,
    "results": results,
    "seeds": seeds,
    "matrix": matrix,
    "costs": costs,
    "timed": timed,
    "algorithms": algorithms,
    "paper": paper,
    "learning": learning,
    "ablations": ablations,
    "speed": speed,
    "missed": missed,
    "rivals": rivals,
    "profiles": profiles,
    "scaling": scaling,
    "gpu": gpu,
    "outside": outside,
    "memory": memory,
}


def filled(text: str) -> str:
    """The document with today's tables. ValueError names a table without an end."""
    for name, make in TABLES.items():
        begin = f"<!-- {name} -->"
        if begin not in text:
            continue
        before, _, rest = text.partition(begin)
        old, end, after = rest.partition("<!-- end -->")
        if not end or "<!--" in old:
            raise ValueError(f"the table {name} has no <!-- end -->")
        text = f"{before}{begin}\n{make()}\n{end}{after}"
    return text


def main() -> None:
    for path in DOCUMENTS:
        path.write_text(filled(path.read_text()))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
