"""What the thresholds of the log's events catch: events in solves that failed and that did not.

Solves are made once and logged several times, each log with one threshold changed and every other
kind of event as it is; what is counted is read from the logs::

    python studies/event_thresholds.py
    python studies/event_thresholds.py --count 30 --factors 0.5 1 2 --report out/thresholds
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from runner.report import command, markdown_table, program, publish
from samplers import random_arm_targets, random_hands

import casadi_ik as ik
from casadi_ik.logs import EventKind, EventRules, Keep, McapRecorder
from casadi_ik.logs.rows import measured_format

FACTORS = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Thresholds are tried at these multiples of what is the rule, unless said otherwise."""

REPORT = Path(__file__).parent / "results" / "event_thresholds"

TOTALS = Keep(failed=False, singular=False, sample=0.0)
"""The totals of a solve tell how often each kind of event happened."""


class StoredBlocks:
    """A recorder that keeps the blocks in memory."""

    def __init__(self) -> None:
        self.blocks: list[Any] = []

    def record(self, block: Any) -> None:
        """Keep it."""
        self.blocks.append(block)

    def close(self) -> None:
        """Ignore the call."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Ignore the call."""


class Trial(NamedTuple):
    """A rule to be tried.

    Attributes:
        kind: Of the events counted.
        subject: What they are about.
        threshold: The number tried.
        usual: Whether that is the rule.
        rules: With it; other Jacobians give no events.
    """

    kind: EventKind
    subject: str
    threshold: float
    usual: bool
    rules: EventRules


@dataclass(frozen=True)
class Caught:
    """Share of solves with an event, and events per 1000 iterations."""

    failed: float
    solved: float
    rate: float


def trials(block: Any, factors: Sequence[float] = FACTORS) -> Iterator[Trial]:
    """Rules for every Jacobian of a method, for stalls and for oscillations."""
    jacobians_of_log = measured_format(block.format).jacobians
    silent = dict.fromkeys(jacobians_of_log, 0.0), dict.fromkeys(jacobians_of_log, math.inf)
    for name, jacobian in jacobians_of_log.items():
        for factor in factors:
            if jacobian.singular > 0:
                value = factor * jacobian.singular
                rules = EventRules(singular=silent[0] | {name: value}, condition=silent[1])
                yield Trial(EventKind.NEAR_SINGULAR, name, value, factor == 1, rules)
        for factor in factors:
            if jacobian.condition < math.inf:
                value = factor * jacobian.condition
                rules = EventRules(singular=silent[0], condition=silent[1] | {name: value})
                yield Trial(EventKind.ILL_CONDITIONED, name, value, factor == 1, rules)
    usual = EventRules()
    for kind, subject, rule in (
        (EventKind.STALL, "relative spread", "stall_change"),
        (EventKind.OSCILLATION, "shortest step", "oscillation_step"),
    ):
        for factor in factors:
            value = factor * getattr(usual, rule)
            yield Trial(kind, subject, value, factor == 1, EventRules(**{rule: value}))


def caught(blocks: Sequence[Any], trial: Trial) -> Caught:
    """Return the events that a rule detects in a log."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        robot = blocks[0].robot
        with McapRecorder(path, robot_name=robot, rules=trial.rules, keep=TOTALS) as recorder:
            for block in blocks:
                recorder.record(block)
        solves = ik.logs.open(path).solves().array()
    events, solved = solves["events"][:, trial.kind], solves["success"] > 0
    has_event = events > 0
    of_failed, of_solved = (
        100 * float(has_event[rows].mean()) if rows.any() else math.nan
        for rows in (~solved, solved)
    )
    return Caught(of_failed, of_solved, 1e3 * float(events.sum() / solves["iterations"].sum()))


def targets_of(robot: ik.ArmHand, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Shipped grasps on random arms and random hands, half and half."""
    rng, names = np.random.default_rng(seed), ik.shipped_grasps(robot.name)
    grasps = random_arm_targets(robot, names, max(count // 2 // len(names), 1), rng)
    hands = robot.contacts(random_hands(robot, rng, count // 2))
    points, normals = (np.concatenate(pair) for pair in zip(grasps, hands, strict=True))
    return points, normals


def section(
    solver: ik.Solver, count: int, seed: int, factors: Sequence[float]
) -> tuple[str, list[tuple[Trial, Caught]]]:
    """Return the table of a method on a robot, as Markdown, and its figures."""
    stored: Any = StoredBlocks()
    targets = targets_of(solver.robot, count, seed)
    batch = solver.solve_batch(*targets, seed=seed, log=stored)
    rows, counts = [], [(t, caught(stored.blocks, t)) for t in trials(stored.blocks[0], factors)]
    for trial, has_event in counts:
        number = f"{trial.threshold:.2g}"
        rows.append(
            [
                f"{trial.kind.name} {trial.subject}",
                f"**{number}**" if trial.usual else number,
                "" if math.isnan(has_event.failed) else f"{has_event.failed:.1f}",
                "" if math.isnan(has_event.solved) else f"{has_event.solved:.1f}",
                f"{has_event.failed / has_event.solved:.1f}"
                if has_event.solved > 0 < has_event.failed
                else "",
                f"{has_event.rate:.2f}",
            ]
        )
    heads = (
        *("event", "threshold", "% of the failed", "% of the solved", "ratio"),
        "per 1000 iterations",
    )
    failed = int((~batch.success).sum())
    text = (
        f"## {solver.method} on {solver.robot.name}\n\n{len(batch)} solves, {failed} of them"
        f" failed, {batch.iterations.mean():.0f} iterations on average.\n\n"
        + markdown_table(heads, rows)
    )
    return text, counts


def main_result(solver: ik.Solver, counts: Sequence[tuple[Trial, Caught]]) -> str:
    """Return the sentence on the solves that come near a singular arm by the usual rule."""
    near = next(
        has_event
        for trial, has_event in counts
        if trial.usual and trial.kind == EventKind.NEAR_SINGULAR and trial.subject == "arm"
    )
    return (
        f"At the usual threshold, {near.failed:.1f} % of the failed and {near.solved:.1f} % of the "
        f"solved solves of {solver.method} come near a singular arm."
    )


def main(arguments: list[str] | None = None) -> None:
    """Solve, count, write the report."""
    parser = argparse.ArgumentParser(description="What the thresholds of events catch.")
    parser.add_argument("--count", type=int, default=480, help="targets of each method")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--factors", type=float, nargs="+", default=FACTORS, help="thresholds over the rule's"
    )
    parser.add_argument("--report", type=Path, default=REPORT, help="folder of the report")
    options = parser.parse_args(arguments)
    barrett, ar10 = ik.load_robot("kuka_lwr_barrett"), ik.load_robot("baxter_ar10")
    solvers = (
        ik.Solver(barrett, "enhanced-dls", finger_step="closed-form"),
        ik.Solver(barrett, "enhanced-sdls", finger_step="closed-form"),
        ik.Solver(barrett, "hand-first"),
        ik.Solver(barrett, "thumb-first"),
        ik.Solver(ar10, "hand-first"),
    )
    parts, counts = zip(
        *(section(solver, options.count, options.seed, options.factors) for solver in solvers),
        strict=True,
    )
    result = main_result(solvers[0], counts[0])
    text = """
Half of the targets are shipped grasps on random arms, half are random hands on random arms, all
reachable; one start from `robot.home`, within limits. A row is a threshold, the rule in bold, and
the share of the failed and of the solved ones in which the event happened at all.
"""
    run_by = command(__file__, arguments)
    publish("Sensitivity of event thresholds", result, [text, *parts], options.report, run_by)


if __name__ == "__main__":
    program(main)
