"""Import of matplotlib."""

import contextlib
import importlib
import os
import sys


def import_matplotlib() -> None:
    """Import matplotlib even if MPLBACKEND names a backend that is not installed.

    The variable is often inherited from a notebook or desktop of another environment, and makes
    the import fail, although files do not need that backend.
    """
    if sys.modules.get("matplotlib") is not None:
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
