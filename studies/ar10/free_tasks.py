"""What the offset of a relative pose comes from, tasks without it, and the null space."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import casadi as ca
import numpy as np
from matplotlib.figure import Figure
from runner import markdown_table

import casadi_ik as ik
from ar10.figures import translation
from ar10.hand import COLORS, span, within
from ar10.tip_poses import RELATIVE_OFFSET
from casadi_ik.arrays import Array
from casadi_ik.symbolic import dual_quaternion as dq

FLOOR = 1e-4
"""Least distance that is drawn [mm]."""

ROWS = {"pose": "6", "position": "3", "distance": "1"}


def offsets(robot: ik.ArmHand, out: Path, goals: int, rng: np.random.Generator, gain: float) -> str:
    """Where the offset of the relative pose comes from, and the tasks that do not have it."""
    start = within(robot, 0.3)
    postures = robot.lower + rng.uniform(0.2, 0.8, (goals, len(start))) * span(robot)
    turns, shifts = rng.standard_normal((goals, 3)), rng.standard_normal((goals, 3))
    kinds = {
        "pose, 1 m = 1 rad (the paper's)": ("pose", 1.0),
        "pose, 0.1 m = 1 rad": ("pose", 0.1),
        "pose, 0.01 m = 1 rad": ("pose", 0.01),
        "position": ("position", 1.0),
        "distance": ("distance", 1.0),
    }
    left: dict[str, Array] = {}
    for label, (kind, length) in kinds.items():
        control = ik.papers.ScrewControl(
            robot, ik.papers.ScrewTask(kind, "thumb", relative_to="index"), gain, length=length
        )
        whole = ik.papers.ScrewControl(
            robot, ik.papers.ScrewTask("pose", "thumb", relative_to="index"), gain
        )
        found = []
        for posture, turn, shift in zip(postures, turns, shifts, strict=True):
            # The pose of a hand that is not quite the model: 2 degrees and 1 mm off per axis.
            moved = dq.exp(ca.DM(np.deg2rad(2.0) * turn), ca.DM(1e-3 * shift))
            pose = np.array(dq.multiply(ca.DM(whole.target(posture)["pose"]), moved)).ravel()
            point = translation({"pose": pose})
            run = control.run(start, asked(kind, pose, point), 200)
            reached = np.linalg.norm(run.points[-1])
            distance = abs(reached - np.linalg.norm(point))
            miss = np.linalg.norm(run.points[-1] - point)
            found.append(1e3 * (distance if kind == "distance" else miss))
        left[label] = np.array(found)
    rows = [
        (label, ROWS[kinds[label][0]], f"{np.median(v):.3f}", f"{np.percentile(v, 90):.3f}",
         f"{100 * np.mean(v < 1e-3):.0f} %")
        for label, v in left.items()
    ]  # fmt: skip
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    axes = figure.subplots()
    # Tasks that leave nothing lie on each other at the left edge: one wide, one narrow.
    widths = (1.6, 1.6, 1.6, 5.0, 1.8)
    for (label, values), color, width in zip(
        left.items(), (*COLORS, "#222222"), widths, strict=True
    ):
        ranked = np.sort(np.maximum(values, FLOOR))
        share = np.linspace(0, 100, len(ranked))
        name = f"{label} ({ROWS[kinds[label][0]]} of 6 rows)"
        axes.plot(ranked, share, color=color, lw=width, label=name)
    offset = float(np.hypot(*RELATIVE_OFFSET))
    axes.axvline(offset, color="black", lw=1, ls="--", label="offset of the paper's Fig. 5")
    axes.set_title("What is left of a relative pose that the hand cannot take", size=10, loc="left")
    axes.set(xscale="log", xlabel=f"left at the end [mm]; {FLOOR:g} mm stands for less")
    axes.set(ylabel="goals with no more left [%]")
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(0.06, 1.0))
    figure.savefig(out / "offsets.png", dpi=110)
    return f"""
## The offset, and tasks without it

![Distribution of what is left](offsets.png)

The paper explains its offset by six task rows against four degrees of freedom. In the model that is
true as soon as the wanted pose is not exactly one of the four-dimensional family that the hand can
take, as a pose measured on a real hand never is. Here the wanted relative poses are those of random
postures, turned by 2 deg and moved by 1 mm (standard deviations per axis). The six-row law then
trades millimetres against radians; adding m^2 to rad^2 as (17) does, a radian counts as a metre,
so nearly all of the orientation's misfit is paid for in position. Counting 1 cm as a radian shrinks
the offset, but only a task that asks for no more than the hand has makes it vanish.

{markdown_table(("task", "rows", "left, median [mm]", "90th percentile [mm]", "below 1 um"), rows)}
{goals} goals, gain {gain:g}, 200 steps; the distance task is measured by its own error. The
paper's {RELATIVE_OFFSET[0]} mm are of the size that the six-row law leaves; how large it is depends
on how far the wanted pose is from the family, which is assumed here and not published.
"""


def null_space(
    robot: ik.ArmHand, goals: int, rng: np.random.Generator, gains: Sequence[float]
) -> str:
    """What the task leaves free keeps the sliders away from their limits."""
    task = ik.papers.ScrewTask("distance", "thumb", relative_to="index")
    used = [i for i, name in enumerate(robot.actuators) if name.startswith(("thumb", "index"))]
    starts = robot.lower + rng.uniform(0.0, 1.0, (goals, len(robot.home))) * span(robot)
    rows = []
    for centring in gains:
        control = ik.papers.ScrewControl(robot, task, 0.5, centring=centring)
        margins, errors = [], []
        for start in starts:
            run = control.run(start, {"distance": np.array(0.04)}, 200)
            part = ((run.q[-1] - robot.lower) / span(robot))[used]
            margins.append(100 * min(part.min(), 1 - part.max()))
            errors.append(1e6 * run.error_norm[-1])
        middle, tenth = np.percentile(margins, [50, 10])
        typical, largest = np.median(errors), np.max(errors)
        rows.append(
            (f"{centring:g}", f"{middle:.1f}", f"{tenth:.1f}", f"{typical:.2g}", f"{largest:.2g}")
        )
    return f"""
## The null space

The distance of the two tips is one row for four sliders. Led to 40 mm from {goals} random postures,
the three directions that are left bring the sliders back towards the middle of their strokes, and
the distance never notices.

{
        markdown_table(
            (
                "centring per step",
                "margin to the nearest limit, median [% of stroke]",
                "10th percentile [%]",
                "error, median [um]",
                "largest [um]",
            ),
            rows,
        )
    }"""


def asked(kind: str, pose: Array, point: Array) -> dict[str, Array]:
    """The part of a relative pose that a task asks for."""
    every = {"pose": pose, "point": point, "distance": np.array(np.linalg.norm(point))}
    return {name: every[name] for name in (kind if kind != "position" else "point",)}
