"""Fill the tables of README.md and docs/ from the CSV files, and check the leaderboard.

    python benchmark/tables.py
    python benchmark/tables.py --check --method "My method"

A table stands between <!-- name --> and <!-- end -->. The function of that name makes it.

--check evaluates policies of benchmark/results/leaderboard.csv in 600 trials of seed 60000. It
fills in scores that are missing, or of an earlier revision of the level. It fails where another one
differs by more than a percentage point.
"""

import re
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from itertools import product
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

import numpy as np
import tyro
from tqdm import tqdm

from benchmark import runs
from benchmark.runs import LABELS, LEVELS, LOADING, RESULTS, Curve, read_curves, read_rows
from crane_utils.trials import DIAMETERS, crane_class
from eval_crane import PAPER

DOCUMENTS = [runs.ROOT / "README.md", *sorted((runs.ROOT / "docs").glob("*.md"))]
PAPER_MEANS = {noise: f"{np.mean([*of_d.values()]):.1f}" for noise, of_d in PAPER.items()}


def table(header: list[str], lines: list[list[str]]) -> str:
    return "\n".join(f"| {' | '.join(line)} |" for line in [header, ["--"] * len(header), *lines])


def evaluations(script: str, level: str, noise: str = "none", folder: str = "levels") -> list[dict]:
    """The rows of a script's runs on a level, one a seed. folder: loading for the loading cycle."""
    lifts_ideal = (folder, level) == ("levels", "ideal")
    run = f"curves_{script}" if lifts_ideal else f"{folder}_{script}_{level}"
    rows = read_rows(RESULTS / "evaluations.csv")
    return [row for row in rows if (row["run"], row["pose_noise"]) == (run, noise)]


def numbers(rows: list[dict[str, str]], column: str) -> list[float]:
    return [float("nan" if row[column] == "" else row[column]) for row in rows]


def joined(values: Iterable[float], digits: int, missing: str = "never") -> str:
    """One number a seed."""
    return ", ".join(missing if np.isnan(x) else f"{x:.{digits}f}" for x in values)


def with_range(middle: float, values: list[float]) -> str:
    """A mean or median and, of more than one value, the lowest and the highest."""
    return f"{middle:.1f}" + f" ({min(values):.1f}–{max(values):.1f})" * (len(values) > 1)


def results() -> str:
    """evaluations.csv: mean, lowest and highest of the seeds. leaderboard.csv: scripted crane."""
    levels, lines = ["hydraulic", "randomized", "ideal"], []
    for script in LABELS:
        cells = []
        for level in levels:
            rows = evaluations(script, level)
            for score in (numbers(rows, "success"), numbers(rows, "gentle")):
                cells.append(with_range(np.mean(score), score))
        lines.append([f"`{script}.py`", *cells])
    board = read_rows(RESULTS / "leaderboard.csv")
    scripted = {row["level"]: row for row in board if row["method"] == "scripted"}
    both = ("success_exact", "gentle_exact")
    cells = [scripted.get(level, {}).get(score, "") for level in levels for score in both]
    lines.append(["`scripted_crane.py`, no learning", *cells])
    lines.append(["paper, mPPO, weaker rule", "", "", "", "", PAPER_MEANS["none"], ""])
    return table(["policy", *[head for level in levels for head in (level, "gentle")]], lines)


def each_seed(folder: str, levels: Iterable[str]) -> Iterator[tuple[list[str], list[dict]]]:
    """Level, method, steps and seeds as cells, and the rows of evaluations.csv."""
    curves = read_curves(folder) | (read_curves("curves") if folder == "levels" else {})
    for level, (script, method) in product(levels, LABELS.items()):
        if rows := evaluations(script, level, folder=folder):
            name = script if (folder, level) == ("levels", "ideal") else f"{script}_{level}"
            steps = dict.fromkeys(f"{run['steps'][-1] / 1e6:.2f}" for run in curves[name].values())
            yield [level, method, ", ".join(steps), ", ".join(row["seed"] for row in rows)], rows


def short() -> str:
    """short/: success at the end of half of the steps, as a user's terminal shows it."""
    found = read_curves("short")[runs.MPPO]
    ends = [f"{100 * run['eval_success_rate'][-1]:.1f}" for run in found.values()]
    return table(["training seed", *map(str, found)], [["success", *ends]])


def causes(rows: list[dict[str, str]]) -> str:
    """What failed trials are counted under, sums of the seeds, the most frequent first."""
    counts: Counter[str] = Counter()
    for row in rows:
        for cause in filter(None, row["failures"].split(", ")):
            name, number = cause.split(" ")
            counts[re.sub("_q.$", "", name)] += int(number)
    return ", ".join(f"`{name}` {number}" for name, number in counts.most_common())


def seeds() -> str:
    """evaluations.csv: success and gentle success of each training seed, causes of failures."""
    lines = []
    for line, rows in each_seed("levels", LEVELS):
        for score in (numbers(rows, "success"), numbers(rows, "gentle")):
            line += [joined(score, 1), f"{np.mean(score):.1f}"]
        lines.append([*line, causes(rows)])
    header = ["level", "method", "steps [million]", "seeds", "success", "mean", "gentle", "mean"]
    return table([*header, "failures by cause"], lines)


def loading() -> str:
    """evaluations.csv and loading.csv: policies and the scripted crane in the loading cycle."""
    names, lines = ("success", "gentle", "up [s]", "oil [l]", "energy [kJ]"), []
    for line, rows in each_seed("loading", LOADING):
        cells = [joined(numbers(rows, name), 1, "-") for name in names]
        lines.append([*line, *cells, causes(rows)])
    for row in read_rows(RESULTS / "loading.csv"):
        cells = [f"{float(row[name]):.1f}" for name in names]
        lines.append([row["level"], "scripted", "", "", *cells, causes([row])])
    header = ["level", "method", "steps [million]", "seeds", "success", "gentle", "loaded [s]"]
    return table([*header, "oil [l]", "energy [kJ]", "failures by cause"], lines)


def steps_to(run: Curve, level: float) -> float:
    """Million steps, between two evaluations, where success first reaches a level, or NaN."""
    success, steps = run["eval_success_rate"], run["steps"]
    row = np.argmax(success >= level)
    if success[row] < level:
        return np.nan
    return np.interp(level, success[: row + 1][-2:], steps[: row + 1][-2:]) / 1e6


def learning() -> str:
    """curves/: when the four algorithms learn, and the return at the end."""
    lines, curves = [], read_curves("curves")
    for script, label in LABELS.items():
        of_seed = curves[script].values()
        cells = [joined([steps_to(run, level) for run in of_seed], 2) for level in (0.5, 0.9)]
        returns = [run["eval_episodic_return"][-1] for run in of_seed]
        lines.append([label, *cells, joined(returns, 0)])
    header = ["half of the trials succeed after [million steps]", "nine tenths succeed after"]
    return table(["method", *header, "return of the mean action at the end"], lines)


def paper() -> str:
    """The paper's Tables I and II beside evaluations.csv: mPPO's first seed."""
    ours = {noise: evaluations("mppo_beta_crane", "ideal", noise)[0] for noise in PAPER}
    lines = []
    for d in DIAMETERS:
        cells = [[str(PAPER[noise][d]), f"{float(ours[noise][f'{d} m']):.0f}"] for noise in PAPER]
        lines.append([str(d), *cells[0], *cells[1]])
    means = [[PAPER_MEANS[noise], f"{float(ours[noise]['success']):.1f}"] for noise in PAPER]
    lines.append(["mean", *means[0], *means[1]])
    return table(["d [m]", "paper, Table I", "here", "paper, Table II", "here"], lines)


def costs() -> str:
    """levels.csv: metrics of shipped policies on their own levels, and success on the others."""
    metrics, lines = ["oil [l]", "energy [kJ]", "up [s]", "swing [rad]"], []
    rows = read_rows(RESULTS / "levels.csv")
    of = {(row["method"], row["trained_on"], row["evaluated_on"]): row for row in rows}
    for level, method in product(LEVELS, [*LABELS.values(), "scripted"]):
        own = of[method, level, level]
        cells = [f"{float(own[name]):.3g}" for name in metrics]
        for other in ("hydraulic", "randomized"):
            row = of.get((method, level, other))
            cells.append(f"{float(row['success']):.1f}" if row else "")
        lines.append([level, method, *cells])
    header = ["level", "method", *metrics, "success, hydraulic", "success, randomized"]
    return table(header, lines)


def timed() -> str:
    """curves/: minutes of mPPO alone on two cores, without evaluations, one number a seed."""
    whole, kept, of_seed = [], [], read_curves("curves")[runs.MPPO]
    for run in of_seed.values():
        success, minutes = run["eval_success_rate"], run["minutes"]
        good = [k for k in range(len(success) - 1) if success[k:].min() >= 0.95]
        whole.append(minutes[-1])
        kept.append(next((minutes[k] for k in good if success[k] >= 0.963), np.nan))
    lines = [["training [min]", *(f"{x:.1f}" for x in whole)]]
    lines.append(["96.3 % kept after [min]", *(joined([x], 1) for x in kept)])
    return table(["training seed", *map(str, of_seed)], lines)


def ablations() -> str:
    """ablations/ and printed/: success of mPPO with something changed, one number a seed."""
    lines, curves = [], read_curves("ablations") | read_curves("printed")
    labels = {name: label for name, (label, _, _) in runs.ABLATIONS.items()}
    labels[runs.MPPO] = "reward and observations as printed, 25 million steps"
    for name, label in labels.items():
        of_seed = curves.get(name, {})
        ends = ("eval_success_rate", "eval_gentle_rate")
        cells = [joined((100 * run[end][-1] for run in of_seed.values()), 1) for end in ends]
        if of_seed:
            lines.append([label, ", ".join(map(str, of_seed)), *cells])
    return table(["change", "seeds", "success", "gentle"], lines)


def robustness() -> str:
    """robustness.csv: each change of the hydraulic crane at one value."""
    shown = {"more dead time [s]": 0.12, "constant pose error [m]": 0.15}
    shown |= {"slope of the ground [degrees]": 3.0, "friction, times": 0.6}
    shown |= {"flow of the pump, times": 0.6, "force limits, times": 0.6}
    of: dict[tuple[str, float], dict[str, str]] = defaultdict(dict)
    for row in read_rows(RESULTS / "robustness.csv"):
        of[row["changed"], float(row["value"])][row["method"]] = f"{float(row['success']):.0f}"
    methods = list(dict.fromkeys(method for cells in of.values() for method in cells))
    lines = [
        [f"{changed}: {value:g}", *[of[changed, value].get(method, "") for method in methods]]
        for changed, value in shown.items()
        if (changed, value) in of
    ]
    return table(["change", *methods], lines)


def speed() -> str:
    """throughput.csv: the ratios and their spread over the rounds, a column a frame skip."""
    ratios: dict[str, dict[str, str]] = defaultdict(dict)
    for row in read_rows(RESULTS / "throughput.csv"):
        if row["part"] == "ratio":
            middle, low, high = (float(row[name]) for name in ("median", "min", "max"))
            ratios[row["what"]][row["skip"]] = f"{middle:.2f} ({low:.2f}–{high:.2f})"
    lines = [[name, *[of.get(skip, "") for skip in ("20", "1")]] for name, of in ratios.items()]
    return table(["ratio", "skip 20", "skip 1"], lines)


def leaderboard() -> str:
    """leaderboard.csv: means over the seeds of each method, level by level, the best first."""
    of_method = defaultdict(list)
    for row in read_rows(RESULTS / "leaderboard.csv"):
        if row["success_exact"]:
            key = (row["level"], row["method"], row["revision"], row["training"])
            of_method[key].append(row)
    lines = []
    for (level, method, revision, training), rows in of_method.items():
        scores = ("gentle_exact", "success_exact", "gentle_pose_errors", "success_pose_errors")
        means = [f"{np.mean(numbers(rows, score)):.1f}" for score in scores]
        lines.append([level, method, *means, str(len(rows)), revision, training])
    lines.sort(key=lambda line: ([*LEVELS].index(line[0]), -float(line[2])))
    header = ["level", "method", "gentle %", "success %", "gentle, with pose errors"]
    header += ["success, with pose errors", "number of seeds", "revision", "training"]
    return table(header, lines)


def rivals() -> str:
    """rivals.csv: success after ten minutes, with our settings and with published ones."""
    names = {"mppo_beta": "our mPPO", "rsl_rl_ppo": "PPO of rsl-rl", "skrl_ppo": "PPO of skrl"}
    names |= {"sb3_ppo": "PPO of Stable-Baselines3", "sac": "SAC of Stable-Baselines3"}
    names |= {"tqc": "TQC of sb3-contrib", "sbx_ppo": "PPO of sbx", "sbx_sac": "SAC of sbx"}
    names |= {"cleanrl_ppo": "PPO of CleanRL"}
    ends: dict[tuple[str, str], dict] = defaultdict(dict)  # the last row of each seed
    for row in read_rows(RESULTS / "rivals.csv"):  # by minutes
        if float(row["budget"]) == 10:
            ends[row["rival"], row["setting"]][row["seed"]] = row
    for seed, run in read_curves("curves")[runs.MPPO].items():
        end = {"steps": run["steps"][-1], "success": 100 * run["eval_success_rate"][-1]}
        ends["mppo_beta", "ours"][seed] = end
    lines = []
    for rival, name in names.items():
        ours, published = ([*ends[rival, setting].values()] for setting in ("ours", "published"))
        scores = [numbers(rows, "success") for rows in (ours, published)]
        cells = [with_range(np.mean(score), score) if score else "" for score in scores]
        steps = f"{np.mean(numbers(ours, 'steps')) / 1e6:.2f}"
        lines.append((-np.mean(scores[0]), [name, steps, *cells]))
    header = ["method", "steps [million]", "success, our settings", "success, published settings"]
    return table(header, [line for _, line in sorted(lines)])


def held() -> str:
    """held.csv: success after 9 s / after ten more seconds without command. contacts.csv: SDF."""
    of = {(row["method"], row["level"]): row for row in read_rows(RESULTS / "held.csv")}
    sdf = {row["method"]: row for row in read_rows(RESULTS / "contacts.csv")}
    lines = []
    for method in [*LABELS.values(), "scripted"]:
        rows = [of[method, level] for level in LEVELS]
        cells = [f"{float(row['success']):.1f} / {float(row['held']):.1f}" for row in rows]
        lines.append([method, *cells, f"{float(sdf[method]['success']):.1f}"])
    return table(["policy", *LEVELS, "ideal, SDF contacts"], lines)


ALL = (results, seeds, loading, learning, paper, costs, held, timed, ablations, robustness, speed)
ALL += (leaderboard, rivals, short)
TABLES: dict[str, Callable[[], str]] = {make.__name__: make for make in ALL}


def filled(text: str) -> str:
    """The document with today's tables. KeyError names a table that nobody makes."""

    def fill(found: re.Match) -> str:
        return f"<!-- {found[1]} -->\n{TABLES[found[1]]()}\n<!-- end -->"

    return re.sub(r"<!-- (\w+) -->.*?<!-- end -->", fill, text, flags=re.DOTALL)


def differences(method: str) -> list[str]:
    """Evaluate policies again and fill in missing scores. A line for each that differs."""
    path, wrong = RESULTS / "leaderboard.csv", []
    chosen = [row for row in read_rows(path) if method in ("", row["method"])]
    if not chosen:
        raise SystemExit(f"the leaderboard has no method {method!r}")
    for row in tqdm(chosen, unit="row"):
        key = {name: row[name] for name in ("method", "level", "training_seed")}
        now = {"revision": str(crane_class(LEVELS[row["level"]]).REVISION)}
        for name, noise in (("exact", "none"), ("pose_errors", "step")):
            scores = runs.evaluate(row["policy"], noise, "--env-id", LEVELS[row["level"]])
            now |= {f"{what}_{name}": f"{scores[what]:.1f}" for what in ("success", "gentle")}
        if row["success_exact"] == "" or row["revision"] != now["revision"]:
            rows = read_rows(path)  # again: evaluations take minutes
            rows = [old | now if key.items() <= old.items() else old for old in rows]
            runs.write_rows(path, rows)
            continue
        for name, value in now.items():
            if abs(float(value) - float(row[name])) > 1.0 + 1e-9:  # elsewhere rounding differs
                wrong.append(f"{[*key.values()]}: {name} is {value}, the row says {row[name]}")
    return wrong


def main(check: bool = False, method: str = "") -> None:
    """Fill the tables.

    Args:
        check: evaluate the leaderboard's policies first; their paths begin in the repository
        method: the same for the rows of this method only
    """
    wrong = differences(method) if check or method else []
    for path in DOCUMENTS:
        text = path.read_text(encoding="utf-8")
        if (new := filled(text)) != text:
            path.write_text(new, encoding="utf-8", newline="\n")
            print(f"filled {path}")
    sys.exit("\n".join(wrong) or 0)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
