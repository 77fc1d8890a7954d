"""Write the tables of the CSV files into README.md and docs/, between their marks.

    python benchmark/fill_docs.py

A table stands between <!-- name --> and <!-- end -->. TABLES says which file it comes from. A test
fails when a document and its CSV file differ.
"""

import csv
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
LEVELS = ["ideal", "hydraulic", "randomized"]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def rows_of(name: str) -> list[dict[str, str]]:
    with (HERE / name).open() as file:
        return list(csv.DictReader(file))


def table(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["--"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def leaderboard() -> str:
    """Every row of the leaderboard, level by level, the best first."""
    ranked = sorted(
        rows_of("leaderboard.csv"),
        key=lambda row: (LEVELS.index(row["level"]), -float(row["gentle_exact"])),
    )
    columns = ["level", "method", "success_exact", "gentle_exact"]
    columns += ["success_pose_errors", "gentle_pose_errors", "training"]
    header = ["level", "method", "success %", "gentle %"]
    header += ["with pose errors", "gentle, with pose errors", "training"]
    return table(header, [[row[name] for name in columns] for row in ranked])


def results() -> str:
    """README's table: our methods and the paper's, exact pose, success and gentle by level."""
    scripts = {
        "mPPO": "`mppo_beta_crane.py`",
        "PPO": "`ppo_crane.py`",
        "TRPO": "`trpo_crane.py`",
        "recurrent PPO": "`recurrent_ppo_crane.py`",
        "scripted": "`scripted_crane.py`, no learning",
    }
    scores = {}
    for row in rows_of("leaderboard.csv"):
        scores[row["method"], row["level"]] = [row["success_exact"], row["gentle_exact"]]
    rows = []
    for method, name in scripts.items():
        cells = [scores.get((method, level), ["", ""]) for level in LEVELS]
        rows.append([name, *sum(cells, [])])
    rows.append(["paper, mPPO", "96.3", "", "", "", "", ""])
    header = ["policy"]
    for level in LEVELS:
        header += [level, "gentle"]
    return table(header, rows)


def shipped() -> str:
    """The leaderboard's policies of the ideal level, by file."""
    columns = ["policy", "success_exact", "gentle_exact"]
    columns += ["success_pose_errors", "gentle_pose_errors"]
    rows = [row for row in rows_of("leaderboard.csv") if row["level"] == "ideal"]
    header = ["policy", "exact pose", "gentle, exact pose", "pose errors", "gentle, pose errors"]
    return table(
        header,
        [[f"`{Path(row[columns[0]]).name}`"] + [row[c] for c in columns[1:]] for row in rows],
    )


def seeds() -> str:
    """Success and gentle success of each training seed, level by level."""
    rows = rows_of("level_seeds.csv")
    lines = []
    for level, method in dict.fromkeys((row["level"], row["method"]) for row in rows):
        mine = [row for row in rows if (row["level"], row["method"]) == (level, method)]
        scores = []
        for name in ("success", "gentle"):
            numbers = [float(row[name]) for row in mine]
            scores += [", ".join(row[name] for row in mine), f"{sum(numbers) / len(numbers):.1f}"]
        decisions = f"{int(mine[0]['decisions']) / 1e6:.2f} million"
        lines.append(
            [level, method, decisions, ", ".join(r["training_seed"] for r in mine), *scores]
        )
    lines.sort(key=lambda line: LEVELS.index(line[0]))
    header = ["level", "method", "decisions", "seeds", "success", "mean", "gentle", "mean"]
    return table(header, lines)


def matrix() -> str:
    """Success and gentle success of each policy of training seed 1 on each level."""
    rows = [row for row in rows_of("levels.csv") if row["seed"] == "1"]
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
    names = ["ground_peak_kN", "energy_kJ", "litres", "time_up_s"]
    lines = []
    for row in rows_of("levels.csv"):
        if row["trained_on"] == row["judged_on"] and row["seed"] == "1":
            lines.append(
                [row["trained_on"], row["method"], *[f"{float(row[n]):.1f}" for n in names]]
            )
    header = [
        "level",
        "method",
        "peak force on the ground [kN]",
        "energy [kJ]",
        "oil [l]",
        "up [s]",
    ]
    return table(header, sorted(lines, key=lambda line: LEVELS.index(line[0])))


TABLES = {
    "leaderboard": leaderboard,
    "results": results,
    "shipped": shipped,
    "seeds": seeds,
    "matrix": matrix,
    "costs": costs,
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


if __name__ == "__main__":
    for path in DOCUMENTS:
        path.write_text(filled(path.read_text()))
