"""Import of matplotlib."""

import contextlib
import importlib
import os
import sys


def import_matplotlib() -> None:
    """Import matplotlib even if MPLBACKEND names a backend that is not installed.

    Importing matplotlib fails then. The variable is often inherited from a notebook or a desktop of
    another environment; pictures in files do not need that backend.
    """
    if "matplotlib" in sys.modules:
        return
    inherited = os.environ.pop("MPLBACKEND", None)
    try:
        matplotlib = importlib.import_module("matplotlib")
    finally:
        if inherited is not None:
            os.environ["MPLBACKEND"] = inherited
    if inherited:
        with contextlib.suppress(ValueError):
            matplotlib.rcParams["backend"] = inherited
