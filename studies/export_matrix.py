"""Do exports of every kind of robot compile without warnings and answer as Python does?

Every robot is exported in every mode, compiled by gcc with warnings as errors and with the address
and undefined-behaviour sanitizers, and its own test is run: it solves stored targets and compares
the answers with those of Python bit for bit (in single precision: each answer must be valid in
double precision, and at most one in a thousand may be missed)::

    python studies/export_matrix.py --report studies/results/export_matrix
    python studies/export_matrix.py --robots two_ur10e+tool --modes scene --targets 100
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runner.parts import read_parts, run_parts
from runner.report import command, markdown_table, program, publish

import casadi_ik as ik
from casadi_ik.errors import UnsupportedError
from casadi_ik.export.project import c_project, write_folder

ROBOTS = (
    "kuka_lwr_barrett",
    "panda+shadow",
    "panda+panda_hand",
    "viperx_300s+so100_jaw",
    "ur5e+robotiq_2f85",
    "xarm7+tool",
    "two_ur10e+tool",
    "two_ur10e+robotiq_2f85",
    "g1+dex3",
    "mobile_kuka_lwr_barrett",
    "ar10",
    "trifinger",
    "robotiq_2f85",
    "tool",
    "panda",
)
"""Arms with hands, with grippers and with tools, bodies, and hands, grippers and arms alone."""

MODES: Mapping[str, Mapping[str, Any]] = {
    "plain": {},
    "scene": {"capacity": 4},
    "follow": {"follow": True},
    "single": {"single": True},
    "single scene": {"single": True, "capacity": 4},
}
"""Arguments of `c_project` by mode. Palms are part of every mode where contacts determine them."""

WARNINGS = ("-std=c11", "-pedantic", "-Wall", "-Wextra", "-Werror")
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
TIMEOUT = 7200
"""Longest time of a test [s]."""

INTRODUCTION = """
Every robot is exported in every mode, compiled by gcc as C11 with warnings as errors and with the
address and undefined-behaviour sanitizers, and the project's own test and example are run. The test
solves {count:,} stored targets and compares the answers with those of Python bit for bit; in single
precision, each answer must be valid in double precision and at most one in a thousand may be
missed.
"""


HEADS = ("robot", "mode", "result", "time [s]", "answers")


@dataclass(frozen=True)
class Cell:
    """A robot that is exported in a mode.

    Attributes:
        robot: Name of the robot.
        mode: Key of `MODES`.
        count: Number of targets that the test solves.
        size: Number of cells, for the progress bar.
    """

    robot: str
    mode: str
    count: int
    size: int = 1

    @property
    def path(self) -> Path:
        """Path of the result."""
        return Path(self.robot) / f"{self.mode.replace(' ', '_')}_{self.count}.json"


class FailureError(Exception):
    """A step failed; the message is the first line that says why."""


def run_cell(cell: Cell) -> dict[str, Any]:
    """Export a robot in a mode, compile the project, and run its test and its example.

    Returns:
        `status` ("pass", "fail" or "unsupported"), `message` (summary line of the test, or the
        first error) and `seconds`.
    """
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        try:
            status, message = "pass", _test_export(cell, Path(folder) / "solver")
        except UnsupportedError as error:
            status, message = "unsupported", str(error)
        except FailureError as error:
            status, message = "fail", str(error)
    seconds = time.perf_counter() - begin
    return {"status": status, "message": message.strip().splitlines()[0], "seconds": seconds}


def _test_export(cell: Cell, project: Path) -> str:
    """Return the summary line of the exported project's own test."""
    robot = ik.load_robot(cell.robot)
    write_folder(project, c_project(robot, "arm", count=cell.count, **MODES[cell.mode]))
    sources = [str(path.relative_to(project)) for path in sorted(project.glob("src/*.c"))]
    tests = [str(path.relative_to(project)) for path in sorted(project.glob("test/*.c"))]
    precision = ("-Wdouble-promotion",) if "single" in cell.mode else ()
    compiler = ("gcc", *WARNINGS, *precision, *SANITIZERS, "-O0", "-ffp-contract=off")
    compiler += ("-Iinclude", "-Isrc", "-Itest")
    objects = [Path(source).with_suffix(".o").name for source in sources]
    for words in (
        ("-c", *sources),
        (*tests, *objects, "-lm", "-o", "stored"),
        ("example/main.c", *objects, "-lm", "-o", "shown"),
    ):
        built = subprocess.run((*compiler, *words), cwd=project, capture_output=True, text=True)
        if built.returncode:
            errors = [line for line in built.stderr.splitlines() if "error" in line]
            raise FailureError((errors or ["not compiled"])[0])
    summary = _output(project / "stored")
    _output(project / "shown")
    return summary


def _output(program: Path) -> str:
    """Run a program and return the first line of its output."""
    try:
        done = subprocess.run(program, capture_output=True, text=True, timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        raise FailureError(f"{program.name}: takes longer than {TIMEOUT} s") from None
    lines = done.stdout.splitlines() or done.stderr.splitlines() or [""]
    if done.returncode:
        raise FailureError(f"{program.name}: {lines[0]}")
    return lines[0]


def main(arguments: list[str] | None = None) -> None:
    """Fill the matrix and write the report."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--robots", nargs="+", default=ROBOTS, help="default: all kinds")
    parser.add_argument("--modes", nargs="+", default=tuple(MODES), choices=tuple(MODES))
    parser.add_argument("--targets", type=int, default=1000, help="targets per robot and mode")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--out", type=Path, default=Path("out/export_matrix"), help="results")
    parser.add_argument("--report", type=Path, help="folder (default: OUT/report)")
    options = parser.parse_args(arguments)
    cells = [
        Cell(robot, mode, options.targets) for robot in options.robots for mode in options.modes
    ]
    run_parts(run_cell, cells, options.out, jobs=options.jobs, title="exports")
    done, codes = read_parts(options.out, cells)
    counts = Counter(result["status"] for _, result in done)
    rows = [
        [cell.robot, cell.mode, result["status"], f"{result['seconds']:.0f}", result["message"]]
        for cell, result in done
    ]
    result = (
        f"Of {len(done)} exports, {counts['pass']} answer as Python does, {counts['fail']} fail, "
        f"and {counts['unsupported']} are refused as not supported."
    )
    parts = [INTRODUCTION.format(count=options.targets), markdown_table(HEADS, rows)]
    folder, run_by = options.report or options.out / "report", command(__file__, arguments)
    publish("Exports of every kind of robot", result, parts, folder, run_by, {"export": codes})
    if counts["fail"]:
        sys.exit(f"{folder / 'report.md'}: {counts['fail']} exports fail")


if __name__ == "__main__":
    program(main)
