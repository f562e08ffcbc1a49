"""Runs of the control law as pictures."""

from __future__ import annotations

import casadi as ca
import numpy as np
from matplotlib.axes import Axes

import casadi_ik as ik
from casadi_ik.arrays import Array
from casadi_ik.symbolic import dual_quaternion as dq


def translation(target: dict[str, Array]) -> Array:
    """Point of a target pose [m]."""
    return np.array(dq.translation(ca.DM(target["pose"]))).ravel()


def draw_run(
    path: Axes,
    norms: Axes,
    run: ik.Trajectory,
    label: str,
    color: str,
    style: str,
    axes: tuple[int, int] = (1, 2),
) -> None:
    """A run's path in millimetres and its norm over the steps."""
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
    path.set(xlabel=f"{names[0]} [mm], {frame}", ylabel=f"{names[1]} [mm]", aspect="equal")
    path.set_adjustable("datalim")
    path.set_title("Path of the fingertip, a dot per step", size=10, loc="left")
    path.legend(frameon=False, fontsize=8)
    norms.set_title("How the error falls", size=10, loc="left")
    norms.set(xlabel="step", ylabel="screw error norm, eq. (17)", ylim=(1e-9, 5))
    coarse = f"sliders in steps of {1e3 * resolution:g} mm"
    for style, label in (("-", "exact sliders"), (":", coarse)):
        norms.plot([], [], style, color="black", label=label)
    norms.legend(frameon=False, fontsize=8)
