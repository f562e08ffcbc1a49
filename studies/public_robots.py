"""Public robot descriptions: the arms, hands and fingers that `casadi-ik import` finds in them.

`public_robots.csv` lists descriptions by repository (``pypi/NAME``: an unpacked wheel of that
package) and path, with the arguments of their macros and the expected structure: the motors of arm
and hand and the fingers of every side. No file of these repositories is part of this one; FOLDER
holds the checkouts, called NAME, OWNER+NAME or OWNER/NAME::

    git clone --depth 1 https://github.com/TheRobotStudio/SO-ARM100 checkouts/SO-ARM100
    python studies/public_robots.py checkouts

A description whose file is missing is skipped. Results are kept in the folder out/public_robots,
and a second run continues there; ``--again`` starts anew. ``--shapes`` fits collision shapes too.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

from runner.figures import RESULTS
from runner.parts import code_version
from runner.report import command, markdown_table, program, publish

from casadi_ik.errors import CasadiIKError
from casadi_ik.files.progress import progress
from casadi_ik.integrations.importing.robot_import import import_robot
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.load_robot import load_description

TABLE = Path(__file__).with_name("public_robots.csv")
CACHE = Path("out") / "public_robots"

INTRODUCTION = """
{count} descriptions of {repositories} public repositories and packages, of which {present} were
present, imported without options. *Structure*: motors of arm + hand, and the fingers; of a body by
side. Expected structures are those that the first run found, reviewed against the joints of the
files and corrected where they were wrong. {right} of {present} are as expected. Processor time is
that of reading, guessing and writing{shapes}; its median is {median:.1f} s, its maximum
{most:.1f} s.
"""


def structure(robot: RobotDescription) -> str:
    """Return the motors of arm and hand and the fingers as one line, by side."""
    if not robot.sides:
        arm = len(robot.arm_actuators)
        fingers = " ".join(finger.name for finger in robot.fingers)
        return f"{arm}+{len(robot.actuators) - arm} {fingers}"
    sides = (
        f"{side.name} {len(side.arm)}+{len(side.hand)} "
        + " ".join(finger.removeprefix(f"{side.name}_") for finger in side.fingers)
        for side in robot.sides
    )
    return f"{len(robot.trunk)} trunk; " + "; ".join(sides)


def checkout(folder: Path, repository: str) -> Path | None:
    """Return the folder of a repository's checkout; None if there is none."""
    owner, _, name = repository.partition("/")
    places = (folder / owner / name, folder / f"{owner}+{name}", folder / name)
    return next((place for place in places if place.is_dir()), None)


def imported(path: Path, arguments: list[str], shapes: bool) -> dict[str, Any]:
    """Import a description; return its structure, or the error, and the processor time [s]."""
    folder, start = Path(tempfile.mkdtemp()), time.process_time()
    out = folder / "robot.yaml"
    try:
        result = import_robot(None, path, out, command="public_robots", xacro=arguments or False)
        out.write_text(result.description.to_yaml(), encoding="utf-8")
        robot = load_description(out)
        if shapes:
            result.with_shapes(out)
        outcome = structure(robot)
    except CasadiIKError as error:
        outcome = f"error: {str(error).replace(str(path.parent), '')}"[:200]
    finally:
        shutil.rmtree(folder)
    return {"outcome": outcome, "seconds": time.process_time() - start}


def key(row: dict[str, str]) -> str:
    """Return what identifies a row of the table."""
    return " ".join([row["repository"], row["path"], row["arguments"]]).strip()


def report(
    rows: list[dict[str, str]], results: dict[str, dict[str, Any]], shapes: bool
) -> tuple[str, list[str]]:
    """Return the result sentence and the blocks of the report."""
    present = [row for row in rows if key(row) in results]
    times = sorted(results[key(row)]["seconds"] for row in present)
    right = sum(results[key(row)]["outcome"] == row["expected"] for row in present)
    text = INTRODUCTION.format(
        count=len(rows),
        repositories=len({row["repository"] for row in rows}),
        present=len(present),
        right=right,
        shapes=", and of fitting shapes" if shapes else "; shapes were not fitted",
        median=times[len(times) // 2],
        most=times[-1],
    )
    lines = [
        [
            row["repository"],
            " ".join([row["path"], row["arguments"]]).strip(),
            row["expected"],
            "as expected" if outcome == row["expected"] else outcome.replace("|", " "),
        ]
        for row in present
        for outcome in [results[key(row)]["outcome"]]
    ]
    heads = ["repository", "description", "expected structure", "found"]
    result = (
        f"{right} of {len(present)} public descriptions are imported without options with the "
        "expected structure."
    )
    return result, [text, markdown_table(heads, lines)]


def main() -> None:
    """Import the descriptions of the table and write the report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="folder of the checkouts")
    parser.add_argument("--again", action="store_true", help="discard earlier results")
    parser.add_argument("--shapes", action="store_true", help="fit collision shapes as well")
    options = parser.parse_args()
    with TABLE.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    cache_file = CACHE / ("shapes.jsonl" if options.shapes else "structure.jsonl")
    cache_file.parent.mkdir(parents=True, exist_ok=True)
    if options.again:
        cache_file.unlink(missing_ok=True)
    results: dict[str, dict[str, Any]] = {}
    if cache_file.exists():
        for line in cache_file.read_text(encoding="utf-8").splitlines():
            result = json.loads(line)
            results[result.pop("key")] = result
    with progress(len(rows), say=print) as move, cache_file.open("a", encoding="utf-8") as file:
        for row in rows:
            place = checkout(options.folder, row["repository"])
            if key(row) not in results and place is not None and (place / row["path"]).exists():
                result = imported(place / row["path"], row["arguments"].split(), options.shapes)
                results[key(row)] = result
                file.write(json.dumps({"key": key(row), **result}) + "\n")
                file.flush()
            move(1)
    if not results:
        raise SystemExit(f"{options.folder}: has no checkout of a repository of {TABLE.name}")
    result, parts = report(rows, results, options.shapes)
    run_by, folder = command(__file__, None), RESULTS / "public_robots"
    publish("Public robot descriptions", result, parts, folder, run_by, {"import": code_version()})


if __name__ == "__main__":
    program(main)
