"""Table I as printed in Qiu & Kermani 2021: six of their twelve objects."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Printed:
    """A cell of Table I.

    Attributes:
        success: Success rate [%] of 10,000 arm configurations.
        time: Mean time over solved cases [s] (MATLAB r2019b, i5-6400).
        iterations: Mean iterations over solved cases.
    """

    success: float
    time: float
    iterations: float


METHODS = ("enhanced-sdls", "original-sdls", "enhanced-dls", "original-dls")

_COLUMNS: dict[str, tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    "cup": (
        (97.74, 2.79, 96.96, 13.41),
        (0.2791, 1.254, 0.2116, 0.139),
        (184.34, 2460.6, 170.87, 219.8),
    ),
    "apple": (
        (95.20, 3.52, 95.33, 10.35),
        (0.5537, 1.663, 0.2527, 0.126),
        (219.10, 3249.1, 169.70, 198.2),
    ),
    "banana": (
        (95.79, 1.89, 96.77, 12.93),
        (0.6497, 1.623, 0.3346, 0.127),
        (212.25, 3177.7, 165.77, 211.8),
    ),
    "cracker_box": (
        (88.28, 3.00, 94.49, 9.98),
        (1.003, 2.071, 0.3204, 0.139),
        (285.98, 4027.1, 184.45, 219.2),
    ),
    # Printed as "Can"; which of the YCB cans it is the paper does not say. Time and iterations of
    # its enhanced DLS are printed the wrong way round (215.26 s, 0.6122 iterations).
    "tomato_soup_can": (
        (93.03, 3.55, 94.72, 9.60),
        (1.076, 1.963, 0.6122, 0.153),
        (291.27, 3728.5, 215.26, 254.1),
    ),
    "bleach_cleanser": (
        (95.93, 2.84, 96.90, 11.06),
        (0.6614, 1.908, 0.3288, 0.146),
        (226.56, 3497.5, 178.82, 255.0),
    ),
}

TABLE_I: dict[str, dict[str, Printed]] = {
    grasp: {method: Printed(*values) for method, *values in zip(METHODS, *columns, strict=True)}
    for grasp, columns in _COLUMNS.items()
}
"""By shipped grasp and method."""


def printed_mean(method: str) -> Printed:
    """Mean of a method's printed objects."""
    cells = [cells[method] for cells in TABLE_I.values()]
    count = len(cells)
    return Printed(
        sum(cell.success for cell in cells) / count,
        sum(cell.time for cell in cells) / count,
        sum(cell.iterations for cell in cells) / count,
    )
