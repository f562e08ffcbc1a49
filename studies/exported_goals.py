"""What an exported solver and a call from Python shall take, what they take, and where it goes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

import casadi_ik as ik

HEADS = ["goal", "wanted", "found", "reached", "if not, why"]

C_MEAN, C_BYTES, WASM, FAST, FAST_TAIL, BEYOND_BATCH = 15.0, 2**20, 25.0, 20.0, 150.0, 45.0
"""Times [us], code [bytes]."""

TARGETS = 100_000
"""Random ones whose iterations are counted."""


def iterations(robot: ik.ArmHand) -> tuple[float, float]:
    """Of random targets the mean, and the 999th of a thousand."""
    points, normals = robot.contacts(robot.random(np.random.default_rng(4), TARGETS))
    found = ik.Solver(robot).solve_batch(points, normals).iterations
    return float(found.mean()), float(np.quantile(found, 0.999))


def rows(
    robot: ik.ArmHand, cpu: Mapping[str, float], fast: Sequence[float], code: int
) -> list[list[str]]:
    """Rows of the table of goals.

    Args:
        robot: That was measured.
        cpu: CPU time of a solve by way [us].
        fast: Of a million calls of `fast` mean, median, 99.9th percentile and largest time [us].
        code: Size of the code [bytes].
    """
    batch, alone, solve = (
        cpu[f"Python, {name}"] for name in ("batch", "Solver.fast", "Solver.solve")
    )
    plain = cpu["plain C"]
    usual, many = iterations(robot)
    each = plain / usual
    lanes = (
        f"one target leaves all but one lane of the registers idle: {usual:.1f} iterations of "
        f"{each:.1f} us, lookup and verdict in them, where a batch takes {batch / usual:.1f} us"
    )
    after_another = (
        f"one target in a thousand takes {many:.0f} iterations, {many / usual:.1f} times the mean, "
        f"at {each:.1f} us each {many * each:.0f} us; they wait for each other"
    )
    objects = f"the kernel takes {alone:.1f} us, questions and answers as objects the rest"
    found = [
        ("plain C, mean", plain, C_MEAN, lanes),
        ("Solver.fast, in all", alone, FAST, lanes),
        ("Solver.fast, 99.9th percentile on the wall", fast[2], FAST_TAIL, after_another),
        ("Solver.solve, beyond a batch's time", solve - batch, BEYOND_BATCH, objects),
    ]
    wasm = cpu.get("WebAssembly in node (median, wall)")
    if wasm is not None:
        found.append(("WebAssembly in node", wasm, WASM, "two lanes at most, and no wider lookup"))
    table = [
        _row(f"{name}", f"<= {wanted:g} us", f"{value:.1f} us", value <= wanted, why)
        for name, value, wanted, why in found
    ]
    table.append(_row("code", f"<= {C_BYTES:,} bytes", f"{code:,} bytes", code <= C_BYTES, ""))
    return table


def _row(name: str, wanted: str, found: str, reached: bool, why: str) -> list[str]:
    return [name, wanted, found, "yes" if reached else "**no**", "" if reached else why]
