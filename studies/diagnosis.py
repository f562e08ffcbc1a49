"""Is the verdict on what cannot be solved right, and what does it cost?

Barely reachable targets are contacts of configurations within limits: none may be called
unreachable. Impossible ones are made impossible in several ways; their reasons and nearest contacts
can be kept and compared with those of another version. Times by turns with another version:
`bench.py --part diagnosis`::

    python studies/diagnosis.py                                  # 400 and 20 targets per set
    python studies/diagnosis.py --count 4000 --impossible 200 --report studies/results/diagnosis
    python studies/diagnosis.py --keep before.npz                # run there, then, here:
    python studies/diagnosis.py --against before.npz
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from impossible_targets import classes_of, impossible, rigidly_moved
from runner.parts import code_version
from runner.report import command, markdown_table, program, publish

import casadi_ik as ik
from casadi_ik.files.arrays import Array

Stored = dict[str, Any]
"""Arrays by name of the targets / what they are."""

ALMOST = 0.99
"""Part of the tolerance by which contacts are moved that only the tolerance makes reachable."""


def at_limits(
    robot: ik.ArmHand, rng: np.random.Generator, count: int, part: float, off: float = 0.0
) -> Array:
    """Part of the actuators at their limits, or up to `off` [rad] from them."""
    q, offsets = robot.random(rng, count), off * rng.random((count, len(robot.actuators)))
    chance = rng.random(q.shape)
    q = np.where(chance < part / 2, robot.lower + offsets, q)
    return np.where(chance > 1 - part / 2, robot.upper - offsets, q)


def straight(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Return configurations with a nearly straight elbow, by 1e-3 to 0.03 rad."""
    q = at_limits(robot, rng, count, 0.3)
    arm = list(robot.description.arm_actuators)
    bend = 10.0 ** rng.uniform(-3, -1.5, count) * rng.choice([-1, 1], count)
    middle = arm[len(arm) // 2]
    q[:, middle] = np.clip(bend, robot.lower[middle], robot.upper[middle])
    return q


def wide_open(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Return configurations with an open hand, up to 1e-3 of the range from the limits."""
    q, hand = robot.random(rng, count), list(robot.description.hand_actuators)
    offsets = 1e-3 * rng.random((count, len(hand))) * (robot.upper - robot.lower)[hand]
    q[:, hand] = robot.lower[hand] + offsets
    return q


REACHABLE: dict[str, Callable[..., Array]] = {
    "40 % of the actuators at limits": partial(at_limits, part=0.4),
    "80 % of the actuators at limits": partial(at_limits, part=0.8),
    "80 % within 1e-3 rad of limits": partial(at_limits, part=0.8, off=1e-3),
    "arm stretched": straight,
    "hand wide open": wide_open,
}


def false_alarms(robot: ik.ArmHand, count: int, bad: int, seed: int) -> list[list[str]]:
    """Rows of targets that can be reached, all of them asked for a diagnosis."""
    solver, tolerance = ik.Solver(robot), ik.Tolerance()
    rng, rows = np.random.default_rng(seed), list[list[str]]()
    displacement = ALMOST * tolerance.position, ALMOST * tolerance.angle
    sets: dict[str, tuple[Callable[..., Array], int, Array, tuple[float, float]]] = {}
    for by, distance in (
        ("", (0.0, 0.0)),
        (f", contacts moved by {ALMOST:.0%} of t", displacement),
    ):
        sets |= {f"{name}{by}": (x, count, robot.home, distance) for name, x in REACHABLE.items()}
    name = "40 % at limits, from starts at other limits"
    sets[name] = partial(at_limits, part=0.4), bad, at_limits(robot, rng, bad, 1.0), (0.0, 0.0)
    for name, (draw, n, q0, (metres, angle)) in sets.items():
        points, normals = rigidly_moved(robot.contacts(draw(robot, rng, n)), rng, metres, angle)
        plain = solver.solve_batch(points, normals, q0)
        batch = solver.solve_batch(points, normals, q0, diagnose=True)
        false_count = int((batch.status_names == "UNREACHABLE").sum())
        left = int((~batch.success).sum()) - false_count
        lost_count = int(batch.success.sum() - plain.success.sum())
        counts = len(points), int(plain.success.sum()), lost_count, left, false_count
        rows.append([name, *(f"{number:,}" for number in counts)])
    return rows


def verdicts(robot: ik.ArmHand, count: int, seed: int) -> tuple[list[list[str]], Stored]:
    """Reasons and times where there is no solution; and what another version may differ in."""
    solver, rows, stored = ik.Solver(robot), list[list[str]](), Stored()
    for name in classes_of(robot):
        points, normals = impossible(robot, name, np.random.default_rng(seed), count)
        left = ~solver.solve_batch(points, normals).success
        points, normals = points[left], normals[left]
        if not left.any():
            continue
        solver.solve_batch(points[:2], normals[:2], diagnose=True)
        plain = _seconds(lambda p=points, m=normals: solver.solve_batch(p, m))
        full = _seconds(lambda p=points, m=normals: solver.solve_batch(p, m, diagnose=True))
        batch = solver.solve_batch(points, normals, diagnose=True)
        whys = [verdict for verdict in batch.diagnoses if verdict is not None]
        if not whys:
            continue
        remedy_times = [_seconds(lambda verdict=verdict: verdict.lines) for verdict in whys]
        reasons = Counter(verdict.reason.name for verdict in whys)
        cells = [name, f"{len(points)}", f"{batch.success.sum()}"]
        cells += [", ".join(f"{number} {reason}" for reason, number in reasons.most_common())]
        cells += [f"{100 * np.mean([verdict.established for verdict in whys]):.0f}"]
        cells += [
            f"{1e3 * (full - plain) / len(points):.2f}",
            f"{1e3 * np.median(remedy_times):.2f}",
        ]
        rows.append(cells)
        stored |= _stored_verdicts(name, points, batch.diagnoses)
    return rows, stored


def _seconds(call: Callable[[], object]) -> float:
    """Processor time of a call."""
    begin = time.thread_time()
    call()
    return time.thread_time() - begin


def _stored_verdicts(
    name: str, points: Array, whys: tuple[ik.solve.Diagnosis | None, ...]
) -> Stored:
    nearest = [
        np.nan
        if verdict is None
        else max(contact.position_error for contact in verdict.nearest.values())
        for verdict in whys
    ]
    return {
        f"{name}/points": points,
        f"{name}/reason": np.array(
            ["" if verdict is None else verdict.reason.name for verdict in whys]
        ),
        f"{name}/certain": np.array(
            [verdict is not None and verdict.established for verdict in whys]
        ),
        f"{name}/nearest": np.array(nearest),
        f"{name}/helps": np.array(
            [
                ""
                if verdict is None
                else ", ".join(
                    [
                        *(f"{item.part} {item.finger}" for item in verdict.released),
                        *(item.lifted for item in verdict.reliefs),
                    ]
                )
                for verdict in whys
            ]
        ),
    }


def agreement(stored: Stored, reference: Path) -> list[list[str]]:
    """Rows of the same targets, diagnosed by another version."""
    rows = list[list[str]]()
    with np.load(reference) as old:
        for name in dict.fromkeys(key.split("/")[0] for key in stored):
            was, current = (
                {part: data[f"{name}/{part}"] for part in PARTS} for data in (old, stored)
            )
            if not np.array_equal(was["points"], current["points"]):
                continue
            is_equal = was["reason"] == current["reason"]
            both = (was["reason"] != "") & (current["reason"] != "")
            helps = was["helps"][both & is_equal] == current["helps"][both & is_equal]
            changes = Counter(
                f"{a or 'solved'} -> {b or 'solved'}"
                for a, b in zip(was["reason"][~is_equal], current["reason"][~is_equal], strict=True)
            )
            cells = [name, f"{len(is_equal)}", f"{is_equal.sum()}"]
            cells += [", ".join(f"{number} {change}" for change, number in changes.items())]
            cells += [f"{was['certain'].sum()} / {current['certain'].sum()}"]
            cells += [f"{np.median(current['nearest'][both] / was['nearest'][both]):.3f}"]
            rows.append([*cells, f"{100 * helps.mean():.0f}"])
    return rows


PARTS = "points", "reason", "certain", "nearest", "helps"

FALSE = """
All of these can be reached. *In doubt:* not solved, and not called unreachable.
"""

REASONS = """
*n:* targets that hand-first does not solve. *Diagnosis* and *remedies:* processor time [ms] that
the diagnosis adds per target in a batch of all n, and in the median that of what would help
(`lines`), which is looked for when it is asked for.
"""

AGREEMENT = """
*Certain:* called unreachable, there / here. *Nearest:* largest distance of the nearest contacts,
here by there, median.
"""


def main(arguments: list[str] | None = None) -> None:
    """Ask, print, write the report."""
    parser = argparse.ArgumentParser(description="The verdict on what cannot be solved.")
    parser.add_argument("--robot", default="kuka_lwr_barrett")
    parser.add_argument("--count", type=int, default=400, help="reachable targets per set")
    parser.add_argument("--bad-starts", type=int, default=1200, help="reachable, from bad starts")
    parser.add_argument("--impossible", type=int, default=20, help="other targets per set")
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--keep", type=Path, metavar="NPZ", help="keep the verdicts")
    parser.add_argument("--against", type=Path, metavar="NPZ", help="compare with kept verdicts")
    parser.add_argument("--report", type=Path, default=Path("out/diagnosis"), help="folder")
    options = parser.parse_args(arguments)
    robot, parts, alarm_sentence = ik.load_robot(options.robot), list[str](), ""
    if options.count:
        heads = ["targets", "n", "solved", "solved by the diagnosis", "in doubt"]
        rows = false_alarms(robot, options.count, options.bad_starts, options.seed)
        alarms, count = (sum(int(row[i].replace(",", "")) for row in rows) for i in (-1, 1))
        alarm_sentence = f"{alarms:,} of {count:,} reachable targets are called unreachable. "
        parts += ["## False alarms", FALSE, markdown_table([*heads, "called unreachable"], rows)]
    rows, stored = verdicts(robot, options.impossible, options.seed)
    certain = min(float(row[4]) for row in rows)
    result = f"At least {certain:.0f} % of the targets of every class have a certain reason."
    heads = ["targets", "n", "solved after all", "reasons", "certain %", "diagnosis", "remedies"]
    parts += ["## Reasons and times", REASONS, markdown_table(heads, rows)]
    if options.against:
        rows = agreement(stored, options.against)
        heads = ["targets", "n", "same reason", "others", "certain", "nearest", "same remedies %"]
        title = f"## Against another version ({options.against.name})"
        parts += [title, AGREEMENT, markdown_table(heads, rows)]
    if options.keep:
        np.savez(options.keep, allow_pickle=False, **stored)
    run_by, code = command(__file__, arguments), {"diagnosis": code_version()}
    publish(
        "Diagnosis of unreachable targets",
        f"{alarm_sentence}{result}",
        parts,
        options.report,
        run_by,
        code,
    )
    print((options.report / "report.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    program(main)
