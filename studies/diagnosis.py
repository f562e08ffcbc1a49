"""Is the verdict on what cannot be solved right, and what does it cost?

Barely reachable targets are contacts of configurations within limits: none may be called
unreachable. Impossible ones are made impossible in several ways; their reasons, times and nearest
contacts can be kept and compared with those of another version::

    python studies/diagnosis.py                                  # 400 and 20 targets per set
    python studies/diagnosis.py --count 4000 --impossible 200 --out studies/results/diagnosis
    python studies/diagnosis.py --keep before.npz                # run there, then, here:
    python studies/diagnosis.py --against before.npz
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from bench_report import Section, write_report

import casadi_ik as ik
from casadi_ik.arrays import Array

Targets = tuple[Array, Array]
# (robot, rng, count) -> (count, n) configurations within limits.
Configurations = Callable[[ik.ArmHand, np.random.Generator, int], Array]
TITLE = "The verdict on what cannot be solved"
Kept = dict[str, Any]
"""Arrays by name of the targets / what they are."""

ROBOT = "kuka_lwr_barrett"
ALMOST = 0.99
"""Part of the tolerance by which contacts are moved that only the tolerance makes reachable."""


def at_limits(
    robot: ik.ArmHand, rng: np.random.Generator, count: int, part: float, off: float = 0.0
) -> Array:
    """Part of the actuators at their limits, or up to `off` [rad] from them."""
    q, near = robot.random(rng, count), off * rng.random((count, len(robot.actuators)))
    chance = rng.random(q.shape)
    q = np.where(chance < part / 2, robot.lower + near, q)
    return np.where(chance > 1 - part / 2, robot.upper - near, q)


def stretched(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """The elbow almost straight: the wrist at 99.9 % to 99.9999 % of the arm's length."""
    q, a, b = at_limits(robot, rng, count, 0.3), 0.4, 0.39
    length = (1 - 10.0 ** rng.uniform(-6, -3, count)) * (a + b)
    elbow = np.arccos((length**2 - a * a - b * b) / (2 * a * b))
    q[:, robot.actuators.index("lwr_joint_4")] = elbow * rng.choice([-1, 1], count)
    return q


def wide_open(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """The hand opened as far as it can, or up to 1e-3 rad from it; any spread."""
    q = robot.random(rng, count)
    for i, name in enumerate(robot.actuators):
        if name.startswith("bh_") and name != "bh_spread":
            q[:, i] = robot.lower[i] + 1e-3 * rng.random(count)
    return q


REACHABLE: dict[str, Configurations] = {
    "40 % of the actuators at limits": lambda r, g, n: at_limits(r, g, n, 0.4),
    "80 % of the actuators at limits": lambda r, g, n: at_limits(r, g, n, 0.8),
    "80 % within 1e-3 rad of limits": lambda r, g, n: at_limits(r, g, n, 0.8, 1e-3),
    "arm stretched": stretched,
    "hand wide open": wide_open,
}


def moved(targets: Targets, rng: np.random.Generator, metres: float, angle: float) -> Targets:
    """Every contact moved and every normal turned by so much, any way."""
    points, normals = targets
    shift, turn = rng.normal(size=points.shape), rng.normal(size=normals.shape)
    points = points + metres * shift / np.linalg.norm(shift, axis=2, keepdims=True)
    turn -= (turn * normals).sum(axis=2, keepdims=True) * normals
    turn /= np.linalg.norm(turn, axis=2, keepdims=True)
    return points, normals * np.cos(angle) + turn * np.sin(angle)


def impossible(robot: ik.ArmHand, count: int, seed: int) -> dict[str, Targets]:
    """Targets of which most, in some sets all, cannot be reached."""
    rng = np.random.default_rng(seed)
    points, normals = hands = robot.contacts(robot.random(rng, count))
    centred = points - points.mean(axis=1, keepdims=True)
    beyond = robot.random(rng, count)
    blocked, wrist = beyond.copy(), robot.actuators.index("lwr_joint_6")
    blocked[:, wrist] = robot.upper[wrist] + 0.5
    joint = rng.integers(0, len(robot.actuators), count)
    beyond[np.arange(count), joint] = robot.upper[joint] + 0.15
    return {
        "1.5 m too far": (points + np.array([1.5, 0, 0]), normals),
        "0.5 m too far": (points + np.array([0.5, 0, 0]), normals),
        "in the shoulder": (centred + np.array([0, 0, 0.31]), normals),
        "contacts 250 mm apart": (
            points + 0.25 * np.array([[0, 1, 0], [1, -1, 0], [-1, -1, 0]]),
            normals,
        ),
        "thumb's normal reversed": (points, normals * np.array([[-1], [1], [1]])),
        "contacts moved by 30 mm": moved(hands, rng, 0.03, 0.0),
        "contacts moved by 10 mm": moved(hands, rng, 0.01, 0.0),
        "normals turned by 30 deg": moved(hands, rng, 0.0, np.deg2rad(30)),
        "normals turned by 10 deg": moved(hands, rng, 0.0, np.deg2rad(10)),
        "an actuator 0.15 rad beyond its limit": robot.contacts(beyond),
        "the wrist 0.5 rad beyond its limit": robot.contacts(blocked),
    }


def false_alarms(robot: ik.ArmHand, count: int, bad: int, seed: int) -> Section:
    """Targets that can be reached, all of them asked for a diagnosis."""
    solver, tolerance = ik.Solver(robot), ik.Tolerance()
    rng = np.random.default_rng(seed)
    sets: dict[str, tuple[Targets, Array]] = {}
    for name, made in REACHABLE.items():
        sets[name] = robot.contacts(made(robot, rng, count)), robot.home
    for name, made in REACHABLE.items():
        hands = robot.contacts(made(robot, rng, count))
        away = ALMOST * tolerance.position, ALMOST * tolerance.angle
        sets[f"{name}, contacts moved by {ALMOST:.0%} of the tolerance"] = (
            moved(hands, rng, *away),
            robot.home,
        )
    hands = robot.contacts(at_limits(robot, rng, bad, 0.4))
    sets["40 % at limits, from starts at other limits"] = hands, at_limits(robot, rng, bad, 1.0)
    rows = []
    for name, ((points, normals), q0) in sets.items():
        plain = solver.solve_batch(points, normals, q0)
        batch = solver.solve_batch(points, normals, q0, diagnose=True)
        called = int((batch.status_names == "UNREACHABLE").sum())
        left = int((~batch.success).sum()) - called
        found = int(batch.success.sum() - plain.success.sum())
        counts = len(points), int(plain.success.sum()), found, left, called
        rows.append((name, *(f"{number:,}" for number in counts)))
    columns = "targets", "n", "solved", "solved by the diagnosis", "in doubt", "called unreachable"
    note = "All of these can be reached. In doubt: not solved, and not called unreachable."
    return Section("False alarms", columns, rows, note)


def verdicts(robot: ik.ArmHand, count: int, seed: int) -> tuple[Section, Kept]:
    """Reasons and times where there is no solution; and what another version may differ in."""
    solver = ik.Solver(robot)
    rows: list[tuple[str, ...]] = []
    kept: Kept = {}
    for name, (points, normals) in impossible(robot, count, seed).items():
        left = ~solver.solve_batch(points, normals).success
        points, normals = points[left], normals[left]
        if not left.any():
            continue
        solver.solve_batch(points[:2], normals[:2], diagnose=True)
        plain = _seconds(lambda p=points, m=normals: solver.solve_batch(p, m))
        full = _seconds(lambda p=points, m=normals: solver.solve_batch(p, m, diagnose=True))
        batch = solver.solve_batch(points, normals, diagnose=True)
        whys = [why for why in batch.diagnoses if why is not None]
        if not whys:
            continue
        alone = [_alone(solver, p, m) for p, m in zip(points, normals, strict=True)]
        helped = [_seconds(lambda why=why: why.lines) for why in whys]
        reasons = Counter(why.reason.name for why in whys)
        sure = np.mean([why.established for why in whys])
        rows.append(
            (
                name,
                f"{len(points)}",
                f"{batch.success.sum()}",
                ", ".join(f"{number} {reason}" for reason, number in reasons.most_common()),
                f"{100 * sure:.0f}",
                f"{1e3 * (full - plain) / len(points):.2f}",
                *(f"{1e3 * np.quantile(alone, part):.2f}" for part in (0.5, 0.95)),
                f"{1e3 * np.median(helped):.2f}",
            )
        )
        kept |= _kept(name, points, batch.diagnoses)
    columns = (
        *("targets", "n", "solved after all", "reasons", "certain %"),
        *("in a batch", "alone, median", "alone, 95 %", "what would help, median"),
    )
    note = (
        "n: targets that hand-first does not solve. Processor times in ms that the diagnosis adds "
        "per target, in a batch of all n and target by target; what would help (`lines`) is looked "
        "for when it is asked for."
    )
    return Section("Reasons and times", columns, rows, note), kept


def _alone(solver: ik.Solver, points: Array, normals: Array) -> float:
    """Seconds that the diagnosis of one target adds to its solve, the least of three times."""
    target = points[None], normals[None]
    full, plain = (
        min(_seconds(lambda d=diagnose: solver.solve_batch(*target, diagnose=d)) for _ in range(3))
        for diagnose in (True, False)
    )
    return full - plain


def _seconds(call: Callable[[], object]) -> float:
    """Processor time of a call."""
    begin = time.thread_time()
    call()
    return time.thread_time() - begin


def _kept(name: str, points: Array, whys: tuple[ik.Diagnosis | None, ...]) -> Kept:
    nearest = [
        np.nan if why is None else max(near.position_error for near in why.nearest.values())
        for why in whys
    ]
    return {
        f"{name}/points": points,
        f"{name}/reason": np.array(["" if why is None else why.reason.name for why in whys]),
        f"{name}/certain": np.array([why is not None and why.established for why in whys]),
        f"{name}/nearest": np.array(nearest),
        f"{name}/helps": np.array(
            [
                ""
                if why is None
                else ", ".join(
                    [
                        *(f"{item.part} {item.finger}" for item in why.freed),
                        *(item.lifted for item in why.reliefs),
                    ]
                )
                for why in whys
            ]
        ),
    }


def agreement(kept: Kept, before: Path) -> Section:
    """The same targets, diagnosed by another version."""
    rows = []
    with np.load(before) as old:
        for name in dict.fromkeys(key.split("/")[0] for key in kept):
            was, now = ({part: data[f"{name}/{part}"] for part in PARTS} for data in (old, kept))
            if not np.array_equal(was["points"], now["points"]):
                continue
            same = was["reason"] == now["reason"]
            both = (was["reason"] != "") & (now["reason"] != "")
            helps = was["helps"][both & same] == now["helps"][both & same]
            changes = Counter(
                f"{a or 'solved'} -> {b or 'solved'}"
                for a, b in zip(was["reason"][~same], now["reason"][~same], strict=True)
            )
            rows.append(
                (
                    name,
                    f"{len(same)}",
                    f"{same.sum()}",
                    ", ".join(f"{number} {change}" for change, number in changes.items()),
                    f"{was['certain'].sum()} / {now['certain'].sum()}",
                    f"{np.median(now['nearest'][both] / was['nearest'][both]):.3f}",
                    f"{100 * helps.mean():.0f}",
                )
            )
    columns = "targets", "n", "same reason", "others", "certain", "nearest", "same remedies %"
    note = (
        "Certain: called unreachable, before / now. Nearest: largest distance of the nearest "
        "contacts, now by before, median."
    )
    return Section(f"Against another version ({before.name})", columns, rows, note)


PARTS = "points", "reason", "certain", "nearest", "helps"


def main(arguments: list[str] | None = None) -> None:
    """Ask, print, write the report."""
    parser = argparse.ArgumentParser(description=TITLE)
    parser.add_argument("--count", type=int, default=400, help="reachable targets per set")
    parser.add_argument("--bad-starts", type=int, default=1200, help="reachable, from bad starts")
    parser.add_argument("--impossible", type=int, default=20, help="other targets per set")
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--keep", type=Path, metavar="NPZ", help="keep the verdicts")
    parser.add_argument("--against", type=Path, metavar="NPZ", help="compare with kept verdicts")
    parser.add_argument("--out", type=Path, help="folder for report.md")
    options = parser.parse_args(arguments)
    robot = ik.load_robot(ROBOT)
    sections = []
    if options.count:
        sections.append(false_alarms(robot, options.count, options.bad_starts, options.seed))
    found, kept = verdicts(robot, options.impossible, options.seed)
    sections.append(found)
    if options.against:
        sections.append(agreement(kept, options.against))
    for section in sections:
        section.show()
    if options.keep:
        np.savez(options.keep, allow_pickle=False, **kept)
    if options.out:
        command = (
            f"python studies/diagnosis.py --count {options.count} --bad-starts "
            f"{options.bad_starts} --impossible {options.impossible} --seed {options.seed}"
        )
        if options.against:
            command += f" --against {options.against.name}"
        write_report(options.out / "report.md", command, sections, TITLE)


if __name__ == "__main__":
    main()
