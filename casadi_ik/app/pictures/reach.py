"""Pictures of reachability maps and of base placements."""

from __future__ import annotations

from os import PathLike

from matplotlib.figure import Figure

from casadi_ik.app.drawing import palette
from casadi_ik.app.pictures.charts import DPI, new_figure, save_picture
from casadi_ik.errors import InputError
from casadi_ik.planning.reach.place_base import BasePlacement
from casadi_ik.planning.reach.reach_map import ReachMap

COLORS = "viridis"
"""Name of the colour scale of shares and counts."""


def draw_reach_map(
    reach: ReachMap, path: str | PathLike[str] | None = None, *, title: str = "", dpi: float = DPI
) -> Figure:
    """Draw the share of reachable orientations in the three layers through the middle of a map.

    Args:
        reach: Map of a region.
        path: PNG file to write; None: none.
        title: Title; "": robot, meaning and counts.
        dpi: Dots per inch.

    Raises:
        InputError: The map has no grid.
        PictureError: The file cannot be written.
    """
    if not reach.shape:
        raise InputError("draw_reach_map: the map has no grid; expected a map of a region")
    figure = new_figure(12.0, 4.4, dpi)
    axes = figure.subplots(1, 3)
    image = None
    for ax, normal, (horizontal, vertical) in zip(axes, "yxz", ("xz", "yz", "xy"), strict=True):
        positions, share = reach.layer_shares(normal)
        columns, rows = (
            positions[:, 0, "xyz".index(horizontal)],
            positions[0, :, "xyz".index(vertical)],
        )
        image = ax.pcolormesh(columns, rows, share.T, cmap=COLORS, vmin=0, vmax=1, rasterized=True)
        ax.plot(0, 0, marker="+", color="white", markersize=9)
        layer = positions[0, 0, "xyz".index(normal)]
        ax.set_title(f"{normal} = {layer:.2f} m", color=palette.INK, fontsize=10)
        ax.set_xlabel(f"{horizontal} [m]", color=palette.FAINT)
        ax.set_ylabel(f"{vertical} [m]", color=palette.FAINT)
        ax.set_aspect("equal")
        ax.set_xlim(columns[0], columns[-1])
        ax.set_ylim(rows[0], rows[-1])
    counts = reach.counts
    total = max(reach.code.size, 1)
    shares = ", ".join(f"{count / total:.2%} {name}" for name, count in counts.items())
    figure.suptitle(
        title or f"{reach.robot}: {total:,} palm poses, {reach.meaning}\n{shares}",
        color=palette.INK,
        fontsize=11,
    )
    figure.subplots_adjust(left=0.06, right=0.9, top=0.8, bottom=0.12, wspace=0.28)
    if image is not None:
        bar = figure.colorbar(image, cax=figure.add_axes((0.92, 0.15, 0.015, 0.6)))
        bar.set_label("reachable orientations", color=palette.FAINT)
    if path is not None:
        save_picture(figure, path)
    return figure


def draw_base_placement(
    placement: BasePlacement,
    path: str | PathLike[str] | None = None,
    *,
    title: str = "",
    dpi: float = DPI,
) -> Figure:
    """Draw the bases that were evaluated, coloured by the number of palm poses they reach.

    Args:
        placement: Result of `Solver.place_base`.
        path: PNG file to write; None: none.
        title: Title; "": best number and proved bound.
        dpi: Dots per inch.

    Raises:
        PictureError: The file cannot be written.
    """
    figure = new_figure(6.4, 5.2, dpi)
    ax = figure.add_axes((0.12, 0.11, 0.68, 0.76))
    order = placement.counts.argsort(kind="stable")
    x, y = placement.bases[order, :2].T
    points = ax.scatter(x, y, c=placement.counts[order], cmap=COLORS, s=24, linewidths=0)
    ax.plot(*placement.base[:2], marker="*", color="#d62f3c", markersize=15, linestyle="none")
    ax.set_xlabel("x of the base [m]", color=palette.FAINT)
    ax.set_ylabel("y of the base [m]", color=palette.FAINT)
    ax.set_aspect("equal")
    bar = figure.colorbar(points, cax=figure.add_axes((0.83, 0.11, 0.025, 0.76)))
    bar.set_label("palm poses reached", color=palette.FAINT)
    total = len(placement.reached)
    text = f"best base: {placement.count} of {total}, proved bound {placement.upper_bound}"
    figure.suptitle(title or text, color=palette.INK, fontsize=11)
    if path is not None:
        save_picture(figure, path)
    return figure
