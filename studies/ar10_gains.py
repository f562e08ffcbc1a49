"""The experiments of Chandra et al. 2019 on a model of the AR10: gains, offsets, what removes them.

Index finger pose (their Figs. 2, 3 and Table I), relative pose of index and thumb (Figs. 4, 5), and
the same relative tasks with task-specific Jacobians. One command writes report and figures::

    python studies/ar10_gains.py                   # studies/results/ar10_gains/
    python studies/ar10_gains.py --out out/gains --goals 50
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from ar10.free_tasks import null_space, offsets
from ar10.hand import RESOLUTION
from ar10.tip_poses import INDEX_GAINS, RELATIVE_GAINS, index_pose, relative_pose
from runner import command, program

import casadi_ik as ik

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
        INTRODUCTION.format(command=command(__file__, arguments)),
        index_pose(
            robot,
            options.out,
            options.goals,
            rng,
            options.index_gains,
            options.resolution,
        ),
        relative_pose(robot, options.out, options.relative_gains, options.resolution),
        offsets(robot, options.out, options.goals, rng, options.offset_gain),
        null_space(robot, options.goals, rng, options.centring),
    ]
    (options.out / "report.md").write_text("\n".join(parts), encoding="utf-8")


INTRODUCTION = """\
# Gains and offsets of the screw control law on the AR10

Chandra et al. 2019 control the AR10 by `q+ = q - gain J^+ ln(x_c x_d*)` (their eq. 14). This is
the same law on the published dimensions of the hand, in slider coordinates, one step per unit of
time. Start, goals and the time between their steps are not published: ours are a start at 10 % of
every stroke and goals drawn from the strokes, so curves are to be compared in kind, and figures in
size. Made by `{command}`.
"""


if __name__ == "__main__":
    program(main)
