"""First use on a machine, and every later one: a process of its own for each."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile

from bench_report import Section

PROGRAM = """
import time
begin = time.perf_counter()
import casadi_ik as ik
imported = time.perf_counter()
robot = ik.load_robot("kuka_lwr_barrett")
solver = ik.Solver(robot, {method!r})
solver.solve_batch(*(array[None] for array in robot.contacts(robot.home)))
print(imported - begin, time.perf_counter() - imported)
"""


def first_use(methods: tuple[str, ...], later: int) -> Section:
    """Time from the import to the first answer with an empty cache of kernels, and then a full one.

    Args:
        methods: The methods.
        later: Processes that find the cache full; the fastest counts.
    """
    rows = []
    for method in methods:
        with tempfile.TemporaryDirectory() as cache:
            _, cold = _run(method, cache)
            warm = [_run(method, cache) for _ in range(later)]
        imported, answered = (min(times) for times in zip(*warm, strict=True))
        rows.append((method, f"{cold:.1f} s", f"{1e3 * answered:.0f} ms", f"{imported:.2f} s"))
    columns = "method", "empty cache", "full cache", "import apart"
    note = (
        "Wall time in a new process from `load_robot` to the first answer: kernels are generated "
        f"and compiled, or found on disk (the fastest of {later})."
    )
    return Section("First use", columns, rows, note)


def _run(method: str, cache: str) -> tuple[float, float]:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(method=method)],
        env=os.environ | {"CASADI_IK_CACHE": cache},
        capture_output=True,
        text=True,
        check=True,
    )
    imported, answered = map(float, done.stdout.split())
    return imported, answered
