"""Write the tables of the CSV files into README.md and docs/, between their marks.

    python benchmark/fill_docs.py

A table stands between <!-- name --> and <!-- end -->. TABLES says which file it comes from. A test
fails when a document and its CSV file differ.
"""

import csv
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def rows_of(name: str) -> list[dict[str, str]]:
    with (HERE / name).open() as file:
        return list(csv.DictReader(file))


def table(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["--"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def leaderboard() -> str:
    """Every row of the leaderboard, level by level, the best first."""
    order = {"ideal": 0, "hydraulic": 1, "randomized": 2}
    ranked = sorted(
        rows_of("leaderboard.csv"),
        key=lambda row: (order[row["level"]], -float(row["gentle_exact"])),
    )
    columns = ["level", "method", "success_exact", "gentle_exact"]
    columns += ["success_pose_errors", "gentle_pose_errors", "training"]
    header = ["level", "method", "success %", "gentle %"]
    header += ["with pose errors", "gentle, with pose errors", "training"]
    return table(header, [[row[name] for name in columns] for row in ranked])


def results() -> str:
    """README's table: the ideal level beside the paper."""
    scripts = {
        "mPPO": "`mppo_beta_crane.py`",
        "PPO": "`ppo_crane.py`",
        "TRPO": "`trpo_crane.py`",
        "recurrent PPO": "`recurrent_ppo_crane.py`",
        "scripted": "`scripted_crane.py`, no learning",
    }
    rows = []
    for row in rows_of("leaderboard.csv"):
        if row["level"] == "ideal" and row["method"] in scripts:
            scores = [row["success_exact"], row["gentle_exact"], row["success_pose_errors"]]
            rows.append([scripts[row["method"]], *scores])
    rows.append(["paper, mPPO", "96.3", "", "91.8"])
    return table(["policy", "exact log pose", "gentle, exact pose", "with pose errors"], rows)


TABLES = {"leaderboard": leaderboard, "results": results}


def filled(text: str) -> str:
    """The document with today's tables. ValueError names a table without an end."""
    for name, make in TABLES.items():
        begin = f"<!-- {name} -->"
        if begin not in text:
            continue
        before, _, rest = text.partition(begin)
        _, end, after = rest.partition("<!-- end -->")
        if not end:
            raise ValueError(f"the table {name} has no <!-- end -->")
        text = f"{before}{begin}\n{make()}\n{end}{after}"
    return text


if __name__ == "__main__":
    for path in DOCUMENTS:
        path.write_text(filled(path.read_text()))
