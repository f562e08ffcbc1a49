"""Colours of pictures and pages, by the meaning of the drawn item."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

ARM, ARM_JOINT = "#e8944a", "#5f6975"
HAND, PALM = "#65727f", "#414c58"
PAD = "#2fb5ad"

OBJECT = "#8cc4e8"
SCENE = "#b9c0c7"
TARGET = "#f0b400"
MET, MISSED = "#1f9d55", "#d62f3c"
NEAREST = "#b5179e"

INK, FAINT = "#2b333b", "#7a848e"
"""Colours of text on light pages."""

DARK_PAPER, DARK_INK, DARK_FAINT = "#161b22", "#e6edf3", "#9aa5b1"
"""Colours of pictures for dark pages: background, text, secondary text."""

LINE_COLORS = ("#e08a2e", "#2f6db3", "#1f9d55", "#8e4ec6", "#c2334d", "#0f8b8d")
"""Colours of curves in a chart."""

METHOD_COLORS = {
    "enhanced-dls": "#1f77b4",
    "enhanced-sdls": "#ff7f0e",
    "original-dls": "#2ca02c",
    "original-sdls": "#d62728",
    "thumb-first": "#9467bd",
    "hand-first": "#8c564b",
}
"""Colours of methods in charts that compare several; other methods have no fixed colour."""

PHASE_COLORS = ("#f3f1ec", "#fbecd9", "#deebf7", "#e3f2e1")
"""Background colours of the phases of a solve, by phase code."""


def method_colors(methods: Iterable[str]) -> dict[str, str]:
    """Return a colour for each method: its fixed colour, or a colour that no other method uses."""
    unused = iter([color for color in LINE_COLORS[::-1] if color not in METHOD_COLORS.values()] * 9)
    return {
        name: METHOD_COLORS[name] if name in METHOD_COLORS else next(unused) for name in methods
    }


def shade(value: float, stops: tuple[float, float, float] = (0.0, 0.5, 1.0)) -> str:
    """Return a colour from red through yellow to green, interpolated between three stops."""
    channels = np.array([rgb(stop) for stop in (MISSED, TARGET, MET)]).T
    mixed = [round(float(np.interp(value, stops, channel))) for channel in channels]
    return "#{:02x}{:02x}{:02x}".format(*mixed)


def rgb(color: str) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255, of a colour "#rrggbb"."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)
