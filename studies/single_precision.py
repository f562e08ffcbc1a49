"""How often does an exported solver in single precision differ from the one in double?

Both are exported and built with the machine's compiler, and solve the same random targets within
reach, one by one; every answer is judged by Python's kinematics, in double precision. What they
take is measured by `bench.py --part export`::

    python studies/single_precision.py --report out/single_precision
"""

from __future__ import annotations

import argparse
import ctypes
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from runner.parts import code_version
from runner.report import command, markdown_table, program, publish

import casadi_ik as ik

ROBOTS = ("kuka_lwr_barrett", "panda+allegro_right")
TOLERANCES = ((5e-3, 3.0), (1e-3, 0.5), (1e-4, 0.05))
"""Tolerances of positions [m] and angles [deg]."""

START_OFFSET = 0.3
"""Displacement of the start from the random configuration [rad, 1 sigma]."""

SLACK = 1e-9
"""Part of a tolerance, and distance beyond a limit [rad or m], that is rounding."""

BATCH_SOURCE = (Path(__file__).parent / "probes" / "many.c").read_text(encoding="utf-8")
"""Solves many targets in a call."""

INTRODUCTION = """
Random arms and hands within limits, {count:,} targets a row; from home a solution far from limits
is wanted, from near (every motor some {away} rad off) one near that. Lost: solved in double
precision only; gained: in single only. False: called solved by single precision, but not so for
Python's kinematics in double precision.
"""


class Library:
    """A built project as a library that solves many targets in a call."""

    def __init__(self, project: Path, real: type[np.floating]) -> None:
        """Build it."""
        name = "float" if real is np.float32 else "double"
        (project / "many.c").write_text(f"#define REAL {name}\n{BATCH_SOURCE}")
        texts = [str(path.relative_to(project)) for path in sorted(project.glob("src/*.c"))]
        flags = ("-std=c11", "-O2", "-fPIC", "-shared", "-ffp-contract=off", "-fno-math-errno")
        command = ("cc", *flags, "-Iinclude", "-Isrc", "many.c", *texts, "-lm", "-o", "many.so")
        subprocess.run(command, cwd=project, check=True)
        self._real = real
        self._solve_many = ctypes.CDLL(str(project / "many.so")).many
        number = ctypes.c_float if real is np.float32 else ctypes.c_double
        self._solve_many.argtypes = [ctypes.c_int, number, number, *[ctypes.c_void_p] * 5]

    def __call__(
        self,
        points: np.ndarray,
        normals: np.ndarray,
        q0: np.ndarray | None,
        motors: int,
        tolerance: tuple[float, float],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Answers (k, n) and whether they are called solved (k,), of k targets."""
        arguments = [
            None if array is None else np.ascontiguousarray(array, dtype=self._real)
            for array in (points, normals, q0)
        ]
        q = np.empty((len(points), motors), dtype=self._real)
        status = np.empty(len(points), dtype=np.int32)
        places = [None if array is None else array.ctypes.data for array in (*arguments, q, status)]
        self._solve_many(len(points), *tolerance, *places)
        return q.astype(float), status == ik.Status.SOLVED


def how_often(name: str, libraries: tuple[Library, Library], count: int) -> list[list[str]]:
    """Rows of the table: how many each solves, and how many of the second's are none."""
    robot, rng, rows = ik.load_robot(name), np.random.default_rng(23), []
    for metres, degrees in TOLERANCES:
        tolerance = metres, float(np.deg2rad(degrees))
        for start in ("home", "near"):
            configurations = robot.random(rng, count)
            points, normals = robot.contacts(configurations)
            q0 = None
            if start == "near":
                starts = configurations + rng.normal(0, START_OFFSET, configurations.shape)
                q0 = np.clip(starts, robot.lower, robot.upper)
            double, single = (
                library(points, normals, q0, configurations.shape[1], tolerance)
                for library in libraries
            )
            position, angle, limit_excess = robot.deviations(single[0], points, normals)
            slack = 1 + SLACK
            is_within = (position <= tolerance[0] * slack) & (angle <= tolerance[1] * slack)
            right = is_within.all(axis=1) & (limit_excess <= SLACK)
            numbers = (
                double[1].sum(),
                single[1].sum(),
                (double[1] & ~single[1]).sum(),
                (single[1] & ~double[1]).sum(),
                (single[1] & ~right).sum(),
            )
            rows.append(
                [name, f"{1e3 * metres:g} mm, {degrees:g} deg", start, *(f"{n:,}" for n in numbers)]
            )
    return rows


def built(name: str, folder: Path, *flags: str) -> Path:
    """Export a project."""
    words = [name, "--out", str(folder), "--prefix", "arm", *flags]
    subprocess.run([sys.executable, "-m", "casadi_ik", "export", *words], check=True)
    return folder


def main(arguments: list[str] | None = None) -> None:
    """Compare and write the report."""
    parser = argparse.ArgumentParser(description="An exported solver in single precision.")
    parser.add_argument("--robots", nargs="+", default=ROBOTS)
    parser.add_argument("--count", type=int, default=10_000, help="targets of a row")
    parser.add_argument("--report", type=Path, default=Path("out/single_precision"), help="folder")
    options = parser.parse_args(arguments)
    rows = list[list[str]]()
    for name in options.robots:
        with tempfile.TemporaryDirectory() as place:
            double = Library(built(name, Path(place) / "double"), np.float64)
            single = Library(built(name, Path(place) / "single", "--single"), np.float32)
            rows += how_often(name, (double, single), options.count)
    heads = ["robot", "tolerance", "start", "double", "single", "lost", "gained", "false"]
    text = INTRODUCTION.format(count=options.count, away=START_OFFSET)
    lost_count, false_count = (sum(int(row[i].replace(",", "")) for row in rows) for i in (5, 7))
    count = options.count * len(rows)
    result = (
        f"Of {count:,} reachable targets, single precision misses {lost_count:,} that double "
        f"precision solves, and {false_count:,} of its solutions are wrong."
    )
    parts = [text, markdown_table(heads, rows)]
    run_by = command(__file__, arguments)
    code = {"single_precision": code_version()}
    publish("Exported solver in single precision", result, parts, options.report, run_by, code)


if __name__ == "__main__":
    program(main)
