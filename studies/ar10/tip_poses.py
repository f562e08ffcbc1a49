"""Index finger pose (Figs. 2, 3, Table I), relative pose of index and thumb (Figs. 4, 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from runner import markdown_table

import casadi_ik as ik
from ar10.figures import draw_run, finish, translation
from ar10.hand import COLORS, STEPS, final_distance, rate_rows, span, within
from casadi_ik.arrays import Array

TABLE_I = {0.1: (-1.37181, -3.89763), 0.5: (-0.196327, -0.373781), 1.0: (-0.598718, -0.714857)}
"""Chandra et al. 2019, Table I: final error in X and Y [mm] by gain, index finger."""

RELATIVE_OFFSET = (5.5, 0.2)
"""Chandra et al. 2019, section III: steady offset in x and y [mm] of their Fig. 5."""

INDEX_GAINS = (0.1, 0.5, 1.0)
RELATIVE_GAINS = (0.1, 0.3, 0.6, 1.0)


@dataclass(frozen=True)
class Final:
    """How runs to many goals ended: distance from the goal and its median, 90th percentile [mm]."""

    distances: Array

    def __str__(self) -> str:
        return f"{np.median(self.distances):.2f} / {np.percentile(self.distances, 90):.2f}"


def index_pose(
    robot: ik.ArmHand,
    out: Path,
    goals: int,
    rng: np.random.Generator,
    gains: Sequence[float],
    resolution: float,
) -> str:
    """Figs. 2, 3 and Table I: the index fingertip's pose for several gains."""
    task = ik.papers.ScrewTask("pose", "index")
    start, goal = within(robot, 0.1), within(robot, 0.637)
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    path, norms = figure.subplots(1, 2)
    rows, rates = [], []
    random_goals = robot.lower + rng.uniform(0.1, 0.9, (goals, len(start))) * span(robot)
    for gain, color in zip(gains, cycle(COLORS), strict=False):
        for step, style in ((0.0, "-"), (resolution, ":")):
            control = ik.papers.ScrewControl(robot, task, gain, resolution=step)
            run = control.run(start, control.target(goal), STEPS)
            label = "" if step else f"gain {gain:g}"
            draw_run(path, norms, run, label, color, style)
            if not step:
                rates.append((gain, run.rate(1e-7)))
        coarse = ik.papers.ScrewControl(robot, task, gain, resolution=resolution)
        ended = Final(np.array([final_distance(coarse, start, g, 300) for g in random_goals]))
        x, y = TABLE_I.get(gain, (np.nan, np.nan))
        printed = ("", "") if np.isnan(x) else (f"{x:.2f}, {y:.2f}", f"{np.hypot(x, y):.2f}")
        rows.append((f"{gain:g}", *printed, str(ended)))
    finish(path, norms, ik.papers.ScrewControl(robot, task).target(goal)["pose"], resolution)
    figure.savefig(out / "index_pose.png", dpi=110)
    steps = f"{1e3 * resolution:g} mm"
    header = f"model, sliders in {steps}: left over {goals} goals, median / 90th percentile [mm]"
    return f"""
## Index fingertip pose

![Index fingertip: path and screw error norm](index_pose.png)

Left the path of the tip in the finger's plane, right the screw error norm (17). The paper describes
its Figs. 2 and 3 the same way: exponential fall, slowest for 0.1. With exact sliders (full lines)
every gain ends at zero error. The paper's does not (Table I): 4 mm are left at gain 0.1, under 1 mm
at 0.5 and 1. Sliders that move in steps of {steps} (an assumption; dotted) would
explain that: once the gain times the remaining slider error is less than half a step, nothing moves
any more, so what is left grows as 1/gain. With that one number assumed, the model's figures are of
the table's size.

{markdown_table(("gain", "Table I, X and Y [mm]", "its norm [mm]", header), rows)}
The gain of 1 ends closer in the model than on their hand, where it also oscillated a little; in the
model it is a Newton step. A delay between measurement and motion, which the model does not have,
may be the difference. Their finger frame's orientation is not published, so the norms are what can
be compared.

The rate of the fall, fitted to the logarithm of the norm above 1e-7 with exact sliders. A discrete
law of gain g per step multiplies the error by 1 - g, a rate of -ln(1 - g) per step; the continuous
law's rate would be g itself.

{markdown_table(("gain", "fitted rate per step", "-ln(1 - gain)"), rate_rows(rates))}"""


def relative_pose(robot: ik.ArmHand, out: Path, gains: Sequence[float], resolution: float) -> str:
    """Figs. 4 and 5: the thumb's tip seen from the index fingertip."""
    task = ik.papers.ScrewTask("pose", "thumb", relative_to="index")
    start, goal = within(robot, 0.1), within(robot, 0.537)
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    path, norms = figure.subplots(1, 2)
    rates, ends = [], []
    target = ik.papers.ScrewControl(robot, task).target(goal)
    for gain, color in zip(gains, cycle(COLORS), strict=False):
        run = ik.papers.ScrewControl(robot, task, gain).run(start, target, STEPS)
        draw_run(path, norms, run, f"gain {gain:g}", color, "-", axes=(0, 1))
        rates.append((gain, run.rate(1e-7)))
        coarse = ik.papers.ScrewControl(robot, task, gain, resolution=resolution)
        ends.append(1e3 * (coarse.run(start, target, 300).points[-1] - translation(target)))
        draw_run(path, norms, coarse.run(start, target, STEPS), "", color, ":", axes=(0, 1))
    finish(
        path, norms, target["pose"], resolution, axes=(0, 1), names="xy", frame="index tip frame"
    )
    # The display of eq. (15) has no column for the index's proximal joint: it never moves.
    printed = np.full(len(start), np.inf)
    printed[robot.actuators.index("index_proximal_slider")] = 0.0
    literal = ik.papers.ScrewControl(robot, task, 0.6, speed=printed).run(start, target, 300)
    left = 1e3 * (literal.points[-1] - translation(target))
    draw_run(path, norms, literal, "gain 0.6, eq. (15) as printed", "#666666", "--", axes=(0, 1))
    norms.set_xlim(-1, STEPS)
    path.legend(frameon=False, fontsize=8)
    figure.savefig(out / "relative_pose.png", dpi=110)
    rows = [
        (gain, rate, law, ", ".join(f"{value:.2f}" for value in end))
        for (gain, rate, law), end in zip(rate_rows(rates), ends, strict=True)
    ]
    steps = f"{1e3 * resolution:g} mm"
    return f"""
## Relative pose of index and thumb

![Thumb tip seen from the index tip](relative_pose.png)

The thumb's tip in the frame of the index tip, four sliders for six rows (eqs. 15, 16). Dotted:
sliders in steps of {steps}. Dashed: eq. (15) as it is displayed, with three columns; the column of
the index's proximal joint, which eq. (16) has, is missing there, so that joint cannot move and
{np.linalg.norm(left):.1f} mm are left. With all four columns an achievable relative pose is reached
exactly by every gain.

{
        markdown_table(
            (
                "gain",
                "fitted rate per step",
                "-ln(1 - gain)",
                f"left with sliders in {steps}: x, y, z [mm]",
            ),
            rows,
        )
    }
The paper finds 0.6 most suited and an offset of {RELATIVE_OFFSET[0]} mm in x and
{RELATIVE_OFFSET[1]} mm in y at the end of Fig. 5. In the model 0.6 is the best of those that do not
take the whole step at once, which overshoots here too; the offset is the next section's.
"""
