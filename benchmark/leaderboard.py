"""The leaderboard: methods judged on frozen levels by docs/compare.md's protocol.

    python benchmark/leaderboard.py check                       # judge every row again
    python benchmark/leaderboard.py check --method mPPO         # the rows of one method
    python benchmark/leaderboard.py add --method "My method" --level ideal --policy model.zip \
        --training-seed 2

Each training seed has a row of its own. `add` judges a policy and writes its row to
benchmark/leaderboard.csv, in place of its author's own row of the same method, level and seed.
fill_docs.py then writes the table of docs/compare.md, with the means over the seeds. `check`
judges the policies of the rows again. Their paths begin in the current folder. It fails if a score
differs by more than TOLERANCE: policies of the same weights differ by a trial or two between
processors, through rounding.
"""

import csv
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

sys.path.insert(0, str(Path(__file__).parent.parent))

import crane_trials
import tyro
from crane_options import Seed
from tqdm import tqdm
from tyro.conf import Positional

import crane_env

HERE = Path(__file__).parent
BOARD = HERE / "leaderboard.csv"
LEVELS = {
    "ideal": "ForestryCrane-v0",
    "hydraulic": "ForestryCraneHydraulic-v0",
    "randomized": "ForestryCraneRandomized-v0",
}
NOISES = {"exact": "none", "pose_errors": "step"}
COLUMNS = ["method", "level", "training_seed", "policy", "training", "author", "revision"]
SCORES = [f"{what}_{noise}" for noise in NOISES for what in ("success", "gentle")]
TOLERANCE = 1.0  # percentage points, six trials of 600


@dataclass
class Args:
    what: Positional[Literal["check", "add"]]
    """check rows, or add one"""
    method: str = ""
    """name of the method; check: its rows only"""
    level: Literal["ideal", "hydraulic", "randomized"] | None = None
    """add: level of the new row; check: rows of this level only"""
    training_seed: Seed = 1
    """add: seed of the training that made the policy; a method without training has 1"""
    policy: str = ""
    """add: a file as eval_crane.py takes it, scripted, or my_module:MyPolicy"""
    training: str = ""
    """what the training took, such as "1.02 million decisions" """
    author: str = ""
    """who made it, with a link to the code"""
    board: Annotated[Path, tyro.conf.arg(help="the CSV file")] = BOARD


def score(policy: str, level: str) -> dict[str, float]:
    """SCORES in % of 600 trials of REPORT_SEED."""
    judge = [sys.executable, str(HERE.parent / "eval_crane.py"), "--json"]
    judge += ["--seed", str(crane_trials.REPORT_SEED), "--env-id", LEVELS[level]]
    own = policy == "scripted" or ":" in policy
    judge += ["--policy", policy] if own else [policy]
    scores = {}
    for name, noise in NOISES.items():
        ran = subprocess.run([*judge, "--pose-noise", noise], stdout=subprocess.PIPE, text=True)
        if ran.returncode:
            raise SystemExit(f"{policy} could not be judged")  # eval_crane.py has said why
        answer = json.loads(ran.stdout.splitlines()[-1])
        if answer["changed"].get("sensors") and not own:
            raise SystemExit(f"{policy} needs sensors, which {level} does not have")
        scores[f"success_{name}"] = round(100 * answer["mean_success_rate"], 1)
        scores[f"gentle_{name}"] = round(100 * answer["mean_gentle_rate"], 1)
    return scores


def check(rows: list[dict[str, str]], method: str, level: str | None) -> list[str]:
    """One line, also printed at once, for each score that does not come again."""
    wrong = []
    chosen = [
        row for row in rows if method in ("", row["method"]) and level in (None, row["level"])
    ]
    if not chosen:
        raise SystemExit(f"the leaderboard has no method {method!r} on {level or 'any level'}")
    for row in tqdm(chosen, unit="row"):
        lines, of = [], f"{row['method']} on {row['level']}, seed {row['training_seed']}"
        if row["revision"] != str(crane_env.REVISION):
            lines.append(f"{of}: revision {row['revision']}, the task has {crane_env.REVISION}")
        try:
            scores = score(row["policy"], row["level"])
        except SystemExit as error:
            scores = {}
            lines.append(f"{of}: {error}")
        for name, now in scores.items():
            if round(abs(now - float(row[name])), 1) > TOLERANCE:
                lines.append(f"{of}: {name} is {now} %, the row says {row[name]} %")
        for line in lines:
            tqdm.write(line)
        wrong += lines
    return wrong


def read_rows(board: Path) -> list[dict[str, str]]:
    if not board.is_file():
        return []
    with board.open(newline="") as file:
        return list(csv.DictReader(file))


def of_the_same(row: dict[str, str], args: Args) -> bool:
    return (row["method"], row["level"]) == (args.method, args.level)


def main() -> None:
    args = tyro.cli(Args, description=__doc__.partition("\n\n")[0])
    rows = read_rows(args.board)
    if args.what == "check" and not rows:
        raise SystemExit(f"{args.board} has no rows")
    if rows and (wrong := rows[0].keys() ^ {*COLUMNS, *SCORES}):
        raise SystemExit(f"{args.board} is no leaderboard: columns {sorted(wrong)} differ")
    if unknown := {row["level"] for row in rows} - LEVELS.keys():
        raise SystemExit(f"{args.board}: no level {', '.join(unknown)}; there are {list(LEVELS)}")
    if not args.board.parent.is_dir():
        raise SystemExit(f"no folder {args.board.parent}; make it first")
    if args.what == "check":
        if args.policy:
            raise SystemExit("check judges the policies of the rows; --policy is for add")
        wrong = check(rows, args.method, args.level)
        raise SystemExit(f"{len(wrong)} differences" if wrong else 0)
    if not (args.method and args.level and args.policy):
        raise SystemExit("add needs --method, --level and --policy")
    new = {name: str(getattr(args, name)) for name in COLUMNS[:-1]}
    new["revision"] = crane_env.REVISION
    author = next((row["author"] for row in rows if of_the_same(row, args)), None)
    if author not in (None, args.author):
        of = f"{args.method} on {args.level} is a row of {author!r}"
        raise SystemExit(f"{of}, not of {args.author!r}; choose another --method")
    new |= score(args.policy, args.level)
    rows = read_rows(args.board)  # again: judging takes minutes, and another row may have come
    same = [row for row in rows if all(row[name] == new[name] for name in COLUMNS[:3])]
    if same:
        print(f"replaced: {same[0]}")
    rows = [row for row in rows if row not in same] + [new]
    unfinished = args.board.with_suffix(".tmp")
    with unfinished.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*COLUMNS, *SCORES])
        writer.writeheader()
        writer.writerows(rows)
    unfinished.replace(args.board)
    print({name: new[name] for name in SCORES})
    print("now run: python benchmark/fill_docs.py")


if __name__ == "__main__":
    main()
