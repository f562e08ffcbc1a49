"""Palm poses that can be reached while the thumb is held on its contact.

Held by the thumb, the palm has three coordinates left: the virtual joint and the thumb's two
joints. The study draws them uniformly for thumb contacts all over the workspace and asks which of
these palms the arm can follow within its limits::

    python studies/closed_chain_workspace.py
"""

from __future__ import annotations

import numpy as np
from closed_chain import HeldThumb, cylinder
from numpy.typing import NDArray
from runner.figures import OURS, PAPER, field, figure, options, title, write
from runner.report import command, program

import casadi_ik as ik
from casadi_ik.files.arrays import Array


def random_palms(
    robot: ik.ArmHand, chain: HeldThumb, contact: tuple, count: int, rng: np.random.Generator
) -> tuple[Array, Array, Array, Array]:
    """Palms on a contact: rotations, origins, virtual joint and thumb joints, all uniform."""
    q = np.tile(robot.home, (count, 1))
    thumb = list(robot.description.finger_actuators(robot.thumb))
    q[:, thumb] = rng.uniform(robot.lower[thumb], robot.upper[thumb], (count, len(thumb)))
    turn = rng.uniform(-np.pi, np.pi, count)
    rotation, origin = chain.palms(q, contact, turn)
    return rotation, origin, turn, q[:, thumb]


def main(arguments: list[str] | None = None) -> None:
    """Run the study and write its page."""
    args = options(
        "Palm poses with the thumb held.",
        2000,
        arguments,
        palms=(300, "tried for each contact"),
        grasp=("cup", "whose thumb contact is shown by itself"),
    )
    rng = np.random.default_rng(args.seed)
    robot = ik.load_robot("kuka_lwr_barrett")
    chain = HeldThumb(robot)
    points, normals = (
        part[:, chain.thumb] for part in robot.contacts(robot.random(rng, args.count))
    )
    share, spread, blocked = (np.empty(args.count) for _ in range(3))
    for i in range(args.count):
        rotation, origin, _, _ = random_palms(
            robot, chain, (points[i], normals[i]), args.palms, rng
        )
        follows = chain.is_followed(rotation, origin)
        share[i] = 100 * follows.mean()
        reached_origins = origin[follows]
        blocked[i] = 100 * np.mean(chain.in_reach(rotation, origin) & ~follows)
        spread[i] = (
            1e3 * np.linalg.norm(np.ptp(reached_origins, axis=0)) if len(reached_origins) else 0.0
        )

    contact = ik.load_grasp(args.grasp).contacts[robot.thumb]
    target = (np.asarray(contact.point), np.asarray(contact.normal))
    rotation, origin, turn, joints = random_palms(robot, chain, target, 20_000, rng)
    follows = chain.is_followed(rotation, origin)

    plot, grid = figure(2, 2, 5.4, 4.2)
    r, z = cylinder(points)
    mesh = field(grid[0, 0], r, z, share, 16, 0, 100, "viridis")
    title(
        grid[0, 0],
        "palms the arm follows [%], by thumb contact",
        "contact from the base's axis [m]",
        "contact's height [m]",
    )
    plot.colorbar(mesh, ax=grid[0, 0])
    grid[0, 1].hist(share, bins=40, color=OURS)
    title(grid[0, 1], "the same, how often", "palms the arm follows [%]", "thumb contacts")
    across = np.cross(target[1], [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    plane_points = 1e3 * np.stack([(origin - target[0]) @ across, (origin - target[0]) @ target[1]])
    shown_rows = rng.permutation(len(turn))[:6000]
    for mask, color, label in ((~follows, "0.85", "out of reach"), (follows, OURS, "reachable")):
        part = shown_rows[mask[shown_rows]]
        grid[1, 0].scatter(*plane_points[:, part], s=2, color=color, rasterized=True)
        grid[1, 0].plot([], [], "o", ms=5, color=color, label=label)
    grid[1, 0].plot(0, 0, "o", color=PAPER, ms=8, label="thumb's contact")
    grid[1, 0].set_aspect("equal", adjustable="datalim")
    grid[1, 0].legend(frameon=False, fontsize=8, loc="lower left")
    title(
        grid[1, 0],
        f"{args.grasp}: where the palm can be",
        "across the normal [mm]",
        "along the contact's normal [mm]",
    )
    mesh = field(
        grid[1, 1],
        np.rad2deg(turn),
        np.rad2deg(joints.sum(axis=1)),
        100.0 * _smoothed(turn, joints.sum(axis=1), follows),
        36,
        0,
        100,
        "viridis",
    )
    title(
        grid[1, 1],
        f"{args.grasp}: palms the arm follows [%]",
        "virtual joint [deg]",
        "thumb joints, summed [deg]",
    )
    plot.colorbar(mesh, ax=grid[1, 1])

    low, high = share < 10, share > 90
    result = (
        f"Half of the thumb contacts let the arm follow at least {np.median(share):.0f} % of the "
        "palm poses."
    )
    text = f"""
`{command(__file__, arguments)}`:
{args.count} thumb contacts of `{robot.name}` (from configurations uniform within limits), for each
{args.palms} palms uniform in virtual joint and thumb joints, the arm in closed form within limits;
and 20,000 palms on the thumb contact of the grasp `{args.grasp}`.

| | 5 % | 25 % | median | 75 % | 95 % |
|---|---|---|---|---|---|
| palms the arm follows [%] | {_quantiles(share)} |
| diagonal of the reachable palms' box [mm] | {_quantiles(spread)} |

Half of the contacts let the arm follow at least {np.median(share):.0f} % of the palms;
{100 * low.mean():.0f} % let it follow less than a tenth (they lie {np.median(r[low]):.2f} m from
the base's axis and {np.median(z[low]):.2f} m high in the median) and {100 * high.mean():.0f} %
more than nine tenths. For the `{args.grasp}` it is
{100 * follows.mean():.0f} %: the palm moves on a shell about the contact, as thick as the thumb's
joints allow, and the arm cuts a piece out of it. Of all palms the arm cannot follow,
{100 * blocked.mean() / (100 - share.mean()):.0f} % are within reach of the wrist and fail at joint
limits, the others are too far or too near. The paper finds the chain's workspace narrow: so it is
at the border of the arm's reach, while well inside it most of what the thumb allows is there.
"""
    heading = "Workspace of the closed chain"
    write(args.out, "closed_chain_workspace", plot, heading, result, text)


def _smoothed(x: Array, y: Array, hit: NDArray[np.bool_]) -> Array:
    """Share of hits in the cell of each sample, 36 by 36 cells."""
    i, j = (np.clip(((v - v.min()) / np.ptp(v) * 36).astype(int), 0, 35) for v in (x, y))
    cell = i * 36 + j
    hits, all_ = np.bincount(cell, hit, 36 * 36), np.bincount(cell, minlength=36 * 36)
    return (hits / np.maximum(all_, 1))[cell]


def _quantiles(values: Array) -> str:
    return " | ".join(f"{v:.0f}" for v in np.percentile(values, [5, 25, 50, 75, 95]))


if __name__ == "__main__":
    program(main)
