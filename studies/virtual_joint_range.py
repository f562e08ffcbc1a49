"""How far the virtual joint at the thumb's tip can be turned, by arm configuration.

The thumb rests on its contact and the hand keeps its posture; the virtual joint turns the palm
about the contact's normal, and the arm follows within its limits or cannot. Counted are the turns
that some arm configuration follows, and those in one piece with the start::

    python studies/virtual_joint_range.py
"""

from __future__ import annotations

import numpy as np
from closed_chain import HeldThumb, cylinder
from numpy.typing import NDArray
from runner.figures import OURS, field, figure, options, title, write
from runner.report import command, program

import casadi_ik as ik
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array


def usable(robot: ik.ArmHand, chain: HeldThumb, q: Array, steps: int) -> NDArray[np.bool_]:
    """Return which rotations the arm can follow (k, steps), from -pi."""
    turns = 2 * np.pi * (np.arange(steps) / steps - 0.5)
    points, normals = (part[:, chain.thumb] for part in robot.contacts(q))
    follows = np.empty((len(q), steps), dtype=bool)
    for i, turn in enumerate(turns):
        palms = chain.palms(q, (points, normals), np.full(len(q), turn))
        follows[:, i] = chain.is_followed(*palms)
    return follows


def connected(follows: NDArray[np.bool_]) -> Array:
    """Width [deg] of the usable turns in one piece with turn zero, (k,)."""
    steps = follows.shape[1]
    zero = steps // 2
    onwards = np.roll(follows, -zero, axis=1)
    up = np.cumprod(onwards, axis=1).sum(axis=1)
    down = np.cumprod(onwards[:, ::-1], axis=1).sum(axis=1)
    width = np.where(follows.all(axis=1), steps, up + down)
    return np.where(follows[:, zero], width, 0) * 360.0 / steps


def main(arguments: list[str] | None = None) -> None:
    """Run the study and write its page."""
    args = options(
        "Usable range of the virtual joint.",
        3000,
        arguments,
        steps=(72, "turns tried in a full circle"),
    )
    if args.steps < 2 or args.steps % 2:
        raise InputError(f"--steps: found {args.steps}, expected an even number")
    robot = ik.load_robot("kuka_lwr_barrett")
    chain = HeldThumb(robot)
    q = robot.random(np.random.default_rng(args.seed), args.count)
    hand = list(robot.description.hand_actuators)
    q[:, hand] = robot.home[hand]
    follows = usable(robot, chain, q, args.steps)
    at_rest = follows[:, args.steps // 2].mean()
    width, total_width = connected(follows), 360.0 * follows.mean(axis=1)

    plot, grid = figure(2, 2, 5.4, 4.0)
    turns = 360.0 * (np.arange(args.steps) / args.steps - 0.5)
    grid[0, 0].plot(turns, 100 * follows.mean(axis=0), color=OURS, lw=2)
    grid[0, 0].set(xlim=(-180, 180), ylim=(0, 102), xticks=range(-180, 181, 60))
    title(
        grid[0, 0],
        "arms that follow a turn [%]",
        "turn of the virtual joint [deg]",
        "arm configurations [%]",
    )
    grid[0, 1].hist(width, bins=np.linspace(0, 360, 37).tolist(), color=OURS)
    title(grid[0, 1], "how wide the range is", "usable range [deg]", "arm configurations")
    r, z = cylinder(robot.palm(q)[:, :3, 3])
    mesh = field(grid[1, 0], r, z, width, 16, 0, 360, "viridis")
    title(
        grid[1, 0],
        "median range in one piece [deg]",
        "palm from the base's axis [m]",
        "palm's height [m]",
    )
    plot.colorbar(mesh, ax=grid[1, 0])
    elbow, wrist = (np.abs(np.rad2deg(q[:, chain.arm[i]])) for i in (3, 5))
    mesh = field(grid[1, 1], elbow, wrist, width, 16, 0, 360, "viridis")
    title(
        grid[1, 1],
        "the same over elbow and wrist",
        "|arm joint 4| [deg]",
        "|arm joint 6| [deg]",
    )
    plot.colorbar(mesh, ax=grid[1, 1])

    def quartiles(values: Array) -> str:
        return " | ".join(f"{v:.0f}" for v in np.percentile(values, [5, 25, 50, 75, 95]))

    is_outer = r > np.quantile(r, 0.75)
    result = (
        "The arm lets half of the configurations turn the virtual joint by at least "
        f"{np.median(width):.0f} deg."
    )
    text = f"""
`{command(__file__, arguments)}`:
{args.count} arms of `{robot.name}` uniform within limits, the hand at home; the palm is turned
about the thumb's contact normal in steps of {360 / args.steps:g} deg, the arm follows in closed
form over all its swivels, within limits. (At turn zero an arm is found for {100 * at_rest:.2f} %:
the one that was drawn, or another.)

| usable range [deg] | 5 % | 25 % | median | 75 % | 95 % |
|---|---|---|---|---|---|
| in one piece with the start | {quartiles(width)} |

The virtual joint has no limits of its own; the arm gives it some.
{100 * np.mean(width >= 360):.0f} % of the arms can turn it all the way round, half of them at least
{np.median(width):.0f} deg without leaving the range, and {100 * np.mean(width < 60):.0f} % less
than 60 deg. It narrows where the palm
is far from the base: in the farthest quarter the median is {np.median(width[is_outer]):.0f} deg,
in the rest {np.median(width[~is_outer]):.0f} deg. Beyond a gap there is more to be had for
{100 * np.mean(total_width > width + 1):.1f} % of the arms: elsewhere the usable turns are
one piece, though the arm may have to change its branch within it.
"""
    write(args.out, "virtual_joint_range", plot, "Range of the virtual joint", result, text)


if __name__ == "__main__":
    program(main)
