"""The colours of every picture and page, so that the same thing looks the same everywhere."""

from __future__ import annotations

ARM, ARM_JOINT = "#e8944a", "#5f6975"
HAND, PALM, HAND_JOINT = "#65727f", "#414c58", "#333c46"

OBJECT = "#8cc4e8"
SCENE = "#b9c0c7"
TARGET = "#f0b400"
MET, MISSED = "#1f9d55", "#d62f3c"
NEAREST = "#e00000"

INK, FAINT = "#2b333b", "#7a848e"
"""Of text."""

LINES = ("#e08a2e", "#2f6db3", "#1f9d55", "#8e4ec6", "#c2334d", "#0f8b8d")
"""Of the lines of a diagram."""

PHASES = ("#f3f1ec", "#fbecd9", "#deebf7", "#e3f2e1")
"""By the code of the phase."""

EVENTS = {
    "NEAR_SINGULAR": "#8e4ec6",
    "ILL_CONDITIONED": "#b48ad6",
    "STALL": "#2b333b",
    "OSCILLATION": "#0f8b8d",
    "RESTART": "#2f6db3",
}
"""Of the events that are marked; the others show as phases and limits."""


def rgb(color: str) -> tuple[int, int, int]:
    """Red, green and blue, 0 to 255, of a colour as above."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)
