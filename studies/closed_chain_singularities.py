"""Where the arm-thumb closed chain comes near singular, by choice of its active joints.

Configurations are drawn uniformly within limits; of each the condition of H_p (eq. 7 of Qiu &
Kermani 2021) is computed, for the paper's active joints and for those that QR with column pivoting
chooses there::

    python studies/closed_chain_singularities.py
"""

from __future__ import annotations

import numpy as np
from closed_chain import LENGTH, constraints, cylinder
from numpy.typing import NDArray
from runner.figures import OURS, PAPER, field, figure, options, title, write
from runner.report import command, program

import casadi_ik as ik
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.closed_chain import VIRTUAL, mobility, pivoted, split


def conditions(
    robot: ik.ArmHand, q: Array
) -> tuple[dict[str, Array], dict[str, Array], NDArray[np.int64]]:
    """Condition of H_p and largest |passive / active| rate by active set, and pivoted columns."""
    parts = split(robot.description)
    columns = list(parts.columns)
    fixed = tuple(columns.index(c) for c in parts.active)
    condition = {name: np.empty(len(q)) for name in ("paper", "pivoted")}
    ratio = {name: np.empty(len(q)) for name in condition}
    selected = np.zeros((len(q), len(columns)), dtype=np.int64)
    for row, matrix in enumerate(constraints(robot, q)):
        active, _ = pivoted(matrix)
        selected[row, list(active)] = 1
        for name, indices in (("paper", fixed), ("pivoted", active)):
            passive = [i for i in range(len(columns)) if i not in indices]
            H_p = matrix[:, passive]
            condition[name][row] = np.linalg.cond(H_p)
            rates = np.linalg.solve(H_p, matrix[:, list(indices)])
            ratio[name][row] = np.abs(rates).max()
    return condition, ratio, selected


def main(arguments: list[str] | None = None) -> None:
    """Run the study and write its page."""
    args = options(
        "Singularities of the closed chain.",
        30_000,
        arguments,
        near=(100.0, "condition from which a configuration counts as near singular"),
    )
    robot = ik.load_robot("kuka_lwr_barrett")
    q = robot.random(np.random.default_rng(args.seed), args.count)
    condition, ratio, selected = conditions(robot, q)
    r, z = cylinder(robot.palm(q)[:, :3, 3])
    parts = split(robot.description)
    names = ["virtual" if c == VIRTUAL else robot.actuators[c] for c in parts.columns]

    plot, grid = figure(2, 3)
    elbow, wrist = (np.rad2deg(q[:, robot.description.arm_actuators[i]]) for i in (3, 5))
    for row, (name, values) in enumerate(condition.items()):
        log = np.log10(values)
        mesh = field(grid[row, 0], r, z, log, 40, 0.5, 3.0, "magma_r")
        title(
            grid[row, 0],
            f"{name} active joints: median log10 cond(H_p)",
            "palm from the base's axis [m]",
            "palm's height [m]",
        )
        plot.colorbar(mesh, ax=grid[row, 0])
        mesh = field(grid[row, 1], elbow, wrist, log, 40, 0.5, 3.0, "magma_r")
        title(grid[row, 1], "the same over elbow and wrist", "arm joint 4 [deg]", "joint 6 [deg]")
        plot.colorbar(mesh, ax=grid[row, 1])
    share = np.linspace(0, 100, len(q))
    for (name, values), color in zip(condition.items(), (PAPER, OURS), strict=True):
        grid[0, 2].semilogx(np.sort(values), share, color=color, lw=2, label=name)
    grid[0, 2].axvline(args.near, color="0.6", lw=1, ls="--")
    grid[0, 2].set_xlim(1, 1e5)
    grid[0, 2].legend(frameon=False, fontsize=9)
    title(grid[0, 2], "how often", "cond(H_p)", "configurations below [%]")
    selection_share = 100 * selected.mean(axis=0)
    colors = [PAPER if c in parts.active else OURS for c in parts.columns]
    grid[1, 2].barh(names, selection_share, color=colors)
    grid[1, 2].invert_yaxis()
    title(grid[1, 2], "active by pivoting (orange: paper)", "% of cases", "")

    def percentiles(values: Array) -> str:
        return " | ".join(f"{v:.3g}" for v in np.percentile(values, [50, 90, 99]))

    near_share = {name: 100 * np.mean(values > args.near) for name, values in condition.items()}
    straight = np.abs(elbow) < 10
    bad = condition["paper"] > args.near
    moves = mobility(constraints(robot, q[:1])[0])
    result = (
        f"With the active joints of the paper {near_share['paper']:.1f} % of the configurations "
        f"are near singular; with joints chosen by pivoting {near_share['pivoted']:.2f} %."
    )
    text = f"""
`{command(__file__, arguments)}`:
{args.count} configurations of `{robot.name}` uniform within limits; lengths in units of
{LENGTH} m. The chain of arm, thumb and virtual joint has {len(names)} coordinates and mobility
{moves}.

| | median | 90 % | 99 % |
|---|---|---|---|
| cond(H_p), the paper's active joints | {percentiles(condition["paper"])} |
| cond(H_p), active joints by pivoting | {percentiles(condition["pivoted"])} |
| largest passive / active rate, the paper's | {percentiles(ratio["paper"])} |
| largest passive / active rate, by pivoting | {percentiles(ratio["pivoted"])} |

With the paper's active joints (virtual joint, thumb 2, arm 7 and 6) {near_share["paper"]:.1f} %
of the configurations are near singular (condition above {args.near:g}). Worst is the straight
elbow, at the border of the reach, whatever the wrist does: the elbow is passive there. But
{100 * np.mean(bad & ~straight) / max(np.mean(bad), 1e-12):.0f} % of the near singular ones have it
more than 10 deg from straight. They are singularities of the choice, not of the
mechanism: with the active joints chosen anew by QR with column pivoting
{near_share["pivoted"]:.2f} % remain. Pivoting keeps the virtual joint active in
{selection_share[0]:.0f} % of the configurations. A fixed choice cannot be good everywhere; the
method `thumb-first` makes none, since its steps along the null space of the thumb's rows need no
H_p.
"""
    name = "Singularities of the closed chain"
    write(args.out, "closed_chain_singularities", plot, name, result, text)


if __name__ == "__main__":
    program(main)
