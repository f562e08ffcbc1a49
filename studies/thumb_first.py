"""How the method thumb-first keeps to limits, and from how many starts it solves.

Two sets of targets on random arms: the hands of the shipped grasps, and the same with the distal
joints drawn from 25 to 45 deg. Compared are fixing joints one by one ("freeze") and ProxQP on the
same step, from one start each, and all starts; hand-first in the same run sets the scale of times::

    python studies/thumb_first.py
"""

from __future__ import annotations

import platform
from importlib.metadata import version
from typing import Any

import numpy as np
from runner.figures import OURS, PAPER, figure, options, title, write
from runner.report import command, markdown_table, program
from samplers import random_arm_targets

import casadi_ik as ik
from casadi_ik.files.arrays import Array

Targets = tuple[Array, Array]

VARIANTS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("one start, freeze", "thumb-first", {"options": {"starts": 1}}),
    ("... in the virtual machine", "thumb-first", {"options": {"starts": 1}, "compiled": False}),
    ("one start, ProxQP", "thumb-first", {"options": {"starts": 1, "step": "proxqp"}}),
    ("all starts, freeze", "thumb-first", {}),
    ("hand-first", "hand-first", {}),
)


TICKS = range(1, 16)
"""Iterations that are drawn."""

CURVES = (("one start, ProxQP", PAPER, "o"), ("one start, freeze", OURS, "-"))
"""Variants that are drawn: points that lie on a line."""


def bent_targets(robot: ik.ArmHand, count: int, rng: np.random.Generator) -> Targets:
    """Return hands of built-in grasps with distal joints of 25 to 45 deg, on random arms."""
    names = ik.shipped_grasps(robot.name)
    q = robot.random(rng, count * len(names))
    for i, name in enumerate(names):
        for actuator, value in ik.load_grasp(name).posture.items():
            q[i * count : (i + 1) * count, robot.actuators.index(actuator)] = value
    distal = [i for i, name in enumerate(robot.actuators) if name.endswith("_distal")]
    q[:, distal] = np.radians(rng.uniform(25, 45, (len(q), len(distal))))
    return robot.contacts(q)


def main(arguments: list[str] | None = None) -> None:
    """Run the study and write its page."""
    args = options("Success, iterations and time of thumb-first.", 250, arguments)
    rng = np.random.default_rng(args.seed)
    robot = ik.load_robot("kuka_lwr_barrett")
    grasps = ik.shipped_grasps(robot.name)
    sets = {
        "grasps": random_arm_targets(robot, grasps, args.count, rng),
        "bent": bent_targets(robot, args.count, rng),
    }
    lines, batches, scale = [], {}, {}
    scale_solver = ik.Solver(robot, "hand-first")
    for name, targets in sets.items():
        scale_solver.solve_batch(*targets)  # no time holds a first use
        reference = scale_solver.solve_batch(*targets)
        scale[name] = reference.time.sum() / reference.iterations.sum()
    for label, method, settings in VARIANTS:
        solver = ik.Solver(robot, method, **settings)
        cells = [label]
        points, normals = sets["grasps"]
        solver.solve_batch(points[:8], normals[:8])  # nor does any other time
        for name, targets in sets.items():
            batch = batches[label, name] = solver.solve_batch(*targets)
            solved = batch.success
            ratio = batch.time.sum() / batch.iterations.sum() / scale[name]
            cells += [
                f"{100 * solved.mean():.2f}",
                f"{batch.iterations[solved].mean():.2f}",
                f"{np.percentile(batch.iterations[solved], 99):.0f}",
                f"{ratio:.1f}",
            ]
        lines.append(cells)

    plot, ((axes,),) = figure(1, 1, 7.0, 3.6)
    for name, filled in zip(sets, (True, False), strict=True):
        for label, color, marker in CURVES:
            batch = batches[label, name]
            within = [(batch.iterations[batch.success] <= i).sum() for i in TICKS]
            left = 100 * (1 - np.array(within) / len(batch))
            style = {"mfc": color if filled else "white", "ms": 6, "lw": 1.8, "color": color}
            line = marker if filled or marker == "o" else "--"
            named = f"{name}: {label.partition(', ')[2]}"
            axes.plot(TICKS, np.where(left > 0, left, np.nan), line, label=named, **style)
    axes.set(yscale="log", ylim=(50 / args.count / len(grasps), 150), xticks=TICKS[1::2])
    axes.legend(frameon=False, fontsize=9, loc="upper right")
    title(axes, "One start: not yet solved [%]", "iterations", "not yet solved [%]")
    total = args.count * len(grasps)
    one_start, all_starts = (
        {name: 100 * batches[label, name].success.mean() for name in sets}
        for label in ("one start, freeze", "all starts, freeze")
    )
    result = (
        f"One start solves {one_start['grasps']:.4g} % of the targets of shipped hands and "
        f"{one_start['bent']:.4g} % of bent ones; restarts solve {all_starts['grasps']:.4g} % and "
        f"{all_starts['bent']:.4g} %."
    )
    heads = ["variant"]
    for name in sets:
        heads += [f"{name}: solved %", "iterations", "99 %", "time"]
    text = f"""
`{command(__file__, arguments)}`: {total} targets a set on
`{robot.name}`, 5 mm / 3 deg, limits enforced, start at home. *grasps*: hands of the {len(grasps)}
shipped grasps; *bent*: the same with distal joints from 25 to 45 deg; arms uniform within limits.
The time is that of an iteration as a ratio to hand-first's on the same targets in the same run, the
lookup of the start included. Python {platform.python_version()}, CasADi {version("casadi")},
proxsuite {version("proxsuite")}, {platform.machine()}.

{markdown_table(heads, lines)}
Fixing the worst joint at its limit and solving again takes the same way as the quadratic program,
which may let go of a joint again: both solve alike in as many iterations. Fixing them can be
compiled with the rest of the iteration, which the time shows; so it is the
default, and ProxQP remains as `options={{"step": "proxqp"}}`.
"""
    heading = "Thumb first: one start, restarts and limits"
    write(args.out, "thumb_first", plot, heading, result, text)


if __name__ == "__main__":
    program(main)
