"""The colours of every picture and page, so that the same thing looks the same everywhere."""

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
"""Of text."""

DARK_PAPER, DARK_INK, DARK_FAINT = "#161b22", "#e6edf3", "#9aa5b1"
"""Of pictures for dark pages: the ground, and text on it."""

LINES = ("#e08a2e", "#2f6db3", "#1f9d55", "#8e4ec6", "#c2334d", "#0f8b8d")
"""Of the lines of a diagram."""

METHODS = {
    "enhanced-dls": "#1f77b4",
    "enhanced-sdls": "#ff7f0e",
    "original-dls": "#2ca02c",
    "original-sdls": "#d62728",
    "thumb-first": "#9467bd",
    "hand-first": "#8c564b",
}
"""Of the methods, wherever several are drawn beside each other; others have none of their own."""

PHASES = ("#f3f1ec", "#fbecd9", "#deebf7", "#e3f2e1")
"""By the code of the phase."""


def method_colors(methods: Iterable[str]) -> dict[str, str]:
    """A colour for each of some methods: its own, or one that no other of them has."""
    free = iter([color for color in LINES[::-1] if color not in METHODS.values()] * 9)
    return {name: METHODS[name] if name in METHODS else next(free) for name in methods}


def shade(value: float, stops: tuple[float, float, float] = (0.0, 0.5, 1.0)) -> str:
    """From red at the first of some values over yellow to green at the last."""
    channels = np.array([rgb(one) for one in (MISSED, TARGET, MET)]).T
    mixed = [round(float(np.interp(value, stops, channel))) for channel in channels]
    return "#{:02x}{:02x}{:02x}".format(*mixed)


def rgb(color: str) -> tuple[int, int, int]:
    """Red, green and blue, 0 to 255, of a colour as above."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)
