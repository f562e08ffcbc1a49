"""Figures without pyplot: they work headless and in threads, and are written whole or not."""

from __future__ import annotations

import contextlib
import io
import os
import threading
from dataclasses import dataclass
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from casadi_ik import palette
from casadi_ik.errors import PictureError

DPI = 160
"""Dots per inch of a picture unless said."""

INK, FAINT = palette.INK, palette.FAINT
"""Colours of text."""


@dataclass(frozen=True)
class Ground:
    """What a picture is drawn on.

    Attributes:
        paper: Its colour.
        ink: Of text.
        faint: Of text beside.
    """

    paper: str
    ink: str
    faint: str


LIGHT = Ground("#ffffff", INK, FAINT)
DARK = Ground(palette.DARK_PAPER, palette.DARK_INK, palette.DARK_FAINT)


def new_figure(width: float, height: float, dpi: float = DPI, ground: Ground = LIGHT) -> Figure:
    """An empty figure.

    Args:
        width: [inch].
        height: [inch].
        dpi: Dots per inch.
        ground: What it is drawn on.
    """
    figure = Figure(figsize=(width, height), dpi=dpi, facecolor=ground.paper)
    FigureCanvasAgg(figure)
    return figure


def save_picture(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure as PNG; at no time is there a half-written file of that name.

    Raises:
        PictureError: It cannot be written; the message names path and reason.
    """
    target = Path(path)
    if target.exists() and not target.is_file():
        raise PictureError(f"{target}: cannot write the picture: not a regular file")
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=figure.dpi)
    part = target.with_name(f".{target.name}.{os.getpid()}.{threading.get_ident()}.part")
    try:
        part.write_bytes(drawn.getvalue())
        part.replace(target)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink()
        reason = error.strerror or str(error)
        raise PictureError(f"{target}: cannot write the picture: {reason}") from error
