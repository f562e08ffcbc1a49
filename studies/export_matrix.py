"""Do exports of every kind of robot compile without warnings and answer as Python does?

Every robot is exported in every mode, compiled by gcc with warnings as errors and with the address
and undefined-behaviour sanitizers, and its own test is run: it solves stored targets and compares
the answers with those of Python bit for bit (in single precision: each answer must be valid in
double precision, and at most one in a thousand may be missed)::

    python studies/export_matrix.py --out out/export_matrix.md
    python studies/export_matrix.py --robots two_ur10e+tool --modes scene --targets 100
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
TIMEOUT = 1800


@dataclass(frozen=True)
class Cell:
    """The outcome of one robot in one mode.

    Attributes:
        status: "pass", "fail", or "unsupported".
        message: Summary line of the test, or the first error.
        seconds: Time of export, compilation and test [s].
    """

    status: str
    message: str
    seconds: float


def run_cell(robot: str, mode: str, count: int, flags: Sequence[str] = SANITIZERS) -> Cell:
    """Export a robot in a mode, compile the project, and run its test.

    Args:
        robot: Name of the robot.
        mode: Key of `MODES`.
        count: Number of targets that the test solves.
        flags: Further flags of the compiler.
    """
    begin = time.perf_counter()

    def cell(status: str, message: str) -> Cell:
        return Cell(status, message.strip(), time.perf_counter() - begin)

    with tempfile.TemporaryDirectory() as folder:
        project = Path(folder) / "solver"
        try:
            write_folder(
                project, c_project(ik.load_robot(robot), "arm", count=count, **MODES[mode])
            )
        except UnsupportedError as error:
            return cell("unsupported", str(error))
        sources = [str(path.relative_to(project)) for path in sorted(project.glob("src/*.c"))]
        tests = [str(path.relative_to(project)) for path in sorted(project.glob("test/*.c"))]
        precision = ("-Wdouble-promotion",) if "single" in mode else ()
        command = ("gcc", *WARNINGS, *precision, *flags, "-O0", "-ffp-contract=off")
        command += ("-Iinclude", "-Isrc", "-Itest")
        objects = [Path(source).with_suffix(".o").name for source in sources]
        for words in (
            ("-c", *sources),
            (*tests, *objects, "-lm", "-o", "stored"),
            ("example/main.c", *objects, "-lm", "-o", "shown"),
        ):
            built = subprocess.run((*command, *words), cwd=project, capture_output=True, text=True)
            if built.returncode:
                errors = [line for line in built.stderr.splitlines() if "error" in line]
                return cell("fail", (errors or ["not compiled"])[0])
        try:
            tested = subprocess.run(
                project / "stored", capture_output=True, text=True, timeout=TIMEOUT
            )
        except subprocess.TimeoutExpired:
            return cell("fail", f"the test takes longer than {TIMEOUT} s")
        if tested.returncode:
            return cell("fail", tested.stdout.splitlines()[0] if tested.stdout else tested.stderr)
        output = subprocess.run(project / "shown", capture_output=True, text=True)
        if output.returncode:
            return cell("fail", f"example: {output.stdout or output.stderr}")
        return cell("pass", tested.stdout.splitlines()[0])


def main() -> None:
    """Fill the matrix and write it as a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--robots", nargs="*", default=ROBOTS, help="default: all kinds")
    parser.add_argument("--modes", nargs="*", default=tuple(MODES), choices=tuple(MODES))
    parser.add_argument("--targets", type=int, default=1000, help="targets per robot and mode")
    parser.add_argument("--out", type=Path, help="Markdown file of the table")
    args = parser.parse_args()
    lines = ["| robot | mode | result | time [s] | message |", "|---|---|---|---|---|"]
    failed = 0
    for robot in args.robots:
        for mode in args.modes:
            cell = run_cell(robot, mode, args.targets)
            failed += cell.status == "fail"
            message = cell.message.replace("|", "/").splitlines()[0]
            lines.append(f"| {robot} | {mode} | {cell.status} | {cell.seconds:.0f} | {message} |")
            print(lines[-1], flush=True)
            if args.out is not None:
                args.out.parent.mkdir(parents=True, exist_ok=True)
                args.out.write_text("\n".join(lines) + "\n", encoding="utf-8")
    raise SystemExit(1 if failed else 0)


if __name__ == "__main__":
    main()
