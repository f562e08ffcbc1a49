"""The experiments of Chandra et al. 2019 on a model of the AR10: gains, offsets, what removes them.

Index finger pose (their Figs. 2, 3 and Table I), relative pose of index and thumb (Figs. 4, 5), and
the same relative tasks with task-specific Jacobians. One command writes report and figures::

    python studies/ar10_gains.py                   # studies/results/ar10_gains/
    python studies/ar10_gains.py --out out/gains --goals 50
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

import casadi as ca
import numpy as np
from matplotlib.axes import Axes
from runner.figures import COLORS, figure, title
from runner.parts import code_version
from runner.report import command, markdown_table, program, publish

import casadi_ik as ik
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics import dual_quaternion as dq

STEPS = 80
"""Line style of a drawn run."""

RESOLUTION = 1e-4
"""Steps of a slider [m]: an assumption, from memory of what small servo screws repeat to."""


def within(robot: ik.ArmHand, part: float) -> Array:
    """Return a configuration with every actuator at a fraction of its stroke."""
    return robot.lower + part * span(robot)


def span(robot: ik.ArmHand) -> Array:
    """Strokes of all actuators."""
    return robot.upper - robot.lower


def final_distance(control: ik.papers.ScrewControl, start: Array, goal: Array, steps: int) -> float:
    """Distance of the tip from the goal's after so many steps [mm]."""
    target = control.target(goal)
    end = control.run(start, target, steps).points[-1]
    return 1e3 * float(np.linalg.norm(end - translation(target)))


def rate_rows(rates: list[tuple[float, float]]) -> list[tuple[str, str, str]]:
    """Fitted rates beside the law's."""
    return [
        (f"{gain:g}", f"{rate:.3f}", "infinite" if gain == 1 else f"{-np.log(1 - gain):.3f}")
        for gain, rate in rates
    ]


def translation(target: dict[str, Array]) -> Array:
    """Point of a target pose [m]."""
    return np.array(dq.translation(ca.DM(target["pose"]))).ravel()


def draw_run(
    path: Axes,
    norms: Axes,
    run: ik.papers.Trajectory,
    label: str,
    color: str,
    style: str,
    axes: tuple[int, int] = (1, 2),
) -> None:
    """Draw the path of a run [mm] and its norm over the steps."""
    x, y = (1e3 * run.points[:, i] for i in axes)
    path.plot(x, y, style, color=color, ms=3, marker=".", lw=1.2, label=label or None)
    norms.semilogy(np.maximum(run.error_norm, 1e-12), style, color=color, lw=1.4)


def finish(
    path: Axes,
    norms: Axes,
    pose: Array,
    resolution: float,
    axes: tuple[int, int] = (1, 2),
    names: str = "yz",
    frame: str = "hand base",
) -> None:
    """Goal, titles, labels and legend of a figure; dotted are sliders in steps [m]."""
    goal = 1e3 * translation({"pose": pose})
    path.plot(*goal[list(axes)], "k+", ms=12, label="goal")
    across, up = f"{names[0]} [mm], {frame}", f"{names[1]} [mm]"
    title(path, "Path of the fingertip, a dot per step", across, up)
    path.set(aspect="equal", adjustable="datalim")
    path.legend(frameon=False, fontsize=8)
    title(norms, "How the error falls", "step", "screw error norm, eq. (17)")
    norms.set_ylim(1e-9, 5)
    coarse = f"sliders in steps of {1e3 * resolution:g} mm"
    for style, label in (("-", "exact sliders"), (":", coarse)):
        norms.plot([], [], style, color="black", label=label)
    norms.legend(frameon=False, fontsize=8)


TABLE_I = {0.1: (-1.37181, -3.89763), 0.5: (-0.196327, -0.373781), 1.0: (-0.598718, -0.714857)}
"""Chandra et al. 2019, Table I: final error in X and Y [mm] by gain, index finger."""

RELATIVE_OFFSET = (5.5, 0.2)
"""Chandra et al. 2019, section III: steady offset in x and y [mm] of their Fig. 5."""

INDEX_GOAL = 0.637
"""Fraction of every stroke at the goal of the index fingertip's pose."""

INDEX_GAINS = (0.1, 0.5, 1.0)
RELATIVE_GAINS = (0.1, 0.3, 0.6, 1.0)


def spread(distances: Array) -> str:
    """Median and 90th percentile [mm]."""
    return f"{np.median(distances):.2f} / {np.percentile(distances, 90):.2f}"


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
    start, goal = within(robot, 0.1), within(robot, INDEX_GOAL)
    plot, ((path, norms),) = figure(1, 2, 5, 4.2)
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
        ended = np.array([final_distance(coarse, start, g, 300) for g in random_goals])
        x, y = TABLE_I.get(gain, (np.nan, np.nan))
        printed = ("", "") if np.isnan(x) else (f"{x:.2f}, {y:.2f}", f"{np.hypot(x, y):.2f}")
        rows.append((f"{gain:g}", *printed, spread(ended)))
    finish(path, norms, ik.papers.ScrewControl(robot, task).target(goal)["pose"], resolution)
    plot.tight_layout()
    plot.savefig(out / "index_pose.png")
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
    plot, ((path, norms),) = figure(1, 2, 5, 4.2)
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
    plot.tight_layout()
    plot.savefig(out / "relative_pose.png")
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


FLOOR = 1e-4
"""Least distance that is drawn [mm]."""

ROWS = {"pose": "6", "position": "3", "distance": "1"}


def offsets(robot: ik.ArmHand, out: Path, goals: int, rng: np.random.Generator, gain: float) -> str:
    """Study the offset of the relative pose, and tasks without it."""
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
        pose_control = ik.papers.ScrewControl(
            robot, ik.papers.ScrewTask("pose", "thumb", relative_to="index"), gain
        )
        errors = []
        for posture, turn, shift in zip(postures, turns, shifts, strict=True):
            # The pose of a hand that is not quite the model: 2 degrees and 1 mm off per axis.
            displacement = dq.exp(ca.DM(np.deg2rad(2.0) * turn), ca.DM(1e-3 * shift))
            pose = np.array(
                dq.multiply(ca.DM(pose_control.target(posture)["pose"]), displacement)
            ).ravel()
            point = translation({"pose": pose})
            run = control.run(start, requested_part(kind, pose, point), 200)
            distance = np.linalg.norm(run.points[-1])
            distance = abs(distance - np.linalg.norm(point))
            miss = np.linalg.norm(run.points[-1] - point)
            errors.append(1e3 * (distance if kind == "distance" else miss))
        left[label] = np.array(errors)
    rows = [
        (label, ROWS[kinds[label][0]], f"{np.median(v):.3f}", f"{np.percentile(v, 90):.3f}",
         f"{100 * np.mean(v < 1e-3):.0f} %")
        for label, v in left.items()
    ]  # fmt: skip
    plot, ((axes,),) = figure(1, 1, 8, 3.6)
    for (label, values), color in zip(left.items(), (*COLORS, "#222222"), strict=True):
        name = f"{label} ({ROWS[kinds[label][0]]} of 6 rows)"
        if values.max() < FLOOR:
            name += f": less than {FLOOR:g} mm, always"
        axes.plot(
            np.sort(values), np.linspace(0, 100, len(values)), color=color, lw=1.8, label=name
        )
    offset = float(np.hypot(*RELATIVE_OFFSET))
    axes.axvline(offset, color="black", lw=1, ls="--", label="offset of the paper's Fig. 5")
    name = "What is left of a relative pose that the hand cannot take"
    title(axes, name, "left at the end [mm]", "goals with no more left [%]")
    axes.set(xscale="log", xlim=(1e-2, 1e2))
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    plot.tight_layout()
    plot.savefig(out / "offsets.png")
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
    """Compare slider positions with and without the use of redundancy."""
    task = ik.papers.ScrewTask("distance", "thumb", relative_to="index")
    used_motors = [
        i for i, name in enumerate(robot.actuators) if name.startswith(("thumb", "index"))
    ]
    starts = robot.lower + rng.uniform(0.0, 1.0, (goals, len(robot.home))) * span(robot)
    rows = []
    for centring in gains:
        control = ik.papers.ScrewControl(robot, task, 0.5, centring=centring)
        margins, errors = [], []
        for start in starts:
            run = control.run(start, {"distance": np.array(0.04)}, 200)
            part = ((run.q[-1] - robot.lower) / span(robot))[used_motors]
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


def requested_part(kind: str, pose: Array, point: Array) -> dict[str, Array]:
    """Return the part of a relative pose that a task constrains."""
    parts = {"pose": pose, "point": point, "distance": np.array(np.linalg.norm(point))}
    return {name: parts[name] for name in (kind if kind != "position" else "point",)}


def main_result(robot: ik.ArmHand, gains: Sequence[float], resolution: float) -> str:
    """Return the sentence on the final errors of the index fingertip's pose by gain."""
    task, start = ik.papers.ScrewTask("pose", "index"), within(robot, 0.1)
    goal = within(robot, INDEX_GOAL)
    exact, stepped = (
        [
            final_distance(control, start, goal, 300)
            for gain in gains
            for control in [ik.papers.ScrewControl(robot, task, gain, resolution=step)]
        ]
        for step in (0.0, resolution)
    )
    printed = [float(np.hypot(*pair)) for pair in TABLE_I.values()]
    return (
        f"With exact sliders the index fingertip ends within {max(exact):.1g} mm of its goal for "
        f"every gain; sliders in steps of {1e3 * resolution:g} mm leave {min(stepped):.2g} to "
        f"{max(stepped):.2g} mm, and the offsets of the paper's Table I are {min(printed):.2g} to "
        f"{max(printed):.2g} mm."
    )


CENTRING = (0.0, 0.05, 0.2)


def main(arguments: list[str] | None = None) -> None:
    """Run the experiments and write report and figures."""
    parser = argparse.ArgumentParser(description="Gain study of the AR10.")
    parser.add_argument("--robot", default="ar10")
    parser.add_argument("--goals", type=int, default=200, help="random goals per table row")
    parser.add_argument("--seed", type=int, default=0)
    for name, gains in (("index", INDEX_GAINS), ("relative", RELATIVE_GAINS)):
        parser.add_argument(
            f"--{name}-gains", type=float, nargs="+", default=gains, help=f"of the {name} pose"
        )
    parser.add_argument(
        "--resolution", type=float, default=RESOLUTION, help="steps of a slider [m]"
    )
    parser.add_argument("--offset-gain", type=float, default=0.6, help="of the section on offsets")
    parser.add_argument(
        "--centring", type=float, nargs="+", default=CENTRING, help="gains in the null space"
    )
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "results" / "ar10_gains"
    )
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    robot = ik.load_robot(options.robot)
    rng = np.random.default_rng(options.seed)
    parts = [
        INTRODUCTION,
        index_pose(
            *(robot, options.out, options.goals, rng, options.index_gains, options.resolution)
        ),
        relative_pose(robot, options.out, options.relative_gains, options.resolution),
        offsets(robot, options.out, options.goals, rng, options.offset_gain),
        null_space(robot, options.goals, rng, options.centring),
    ]
    result = main_result(robot, options.index_gains, options.resolution)
    heading = "Gains and offsets of the screw control law on the AR10"
    run_by = command(__file__, arguments)
    publish(heading, result, parts, options.out, run_by, {"ar10_gains": code_version()})


INTRODUCTION = """
Chandra et al. 2019 control the AR10 by `q+ = q - gain J^+ ln(x_c x_d*)` (their eq. 14). This is
the same law on the published dimensions of the hand, in slider coordinates, one step per unit of
time. Start, goals and the time between their steps are not published: ours are a start at 10 % of
every stroke and goals drawn from the strokes, so curves are to be compared in kind, and figures in
size.
"""


if __name__ == "__main__":
    program(main)
