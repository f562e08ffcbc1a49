"""What needs more than the package installs is looked up when it is asked for."""

from __future__ import annotations

import importlib
from types import ModuleType


def on_demand(name: str) -> ModuleType:
    """A part of the package that an extra brings to life, by its name.

    What is shown knows what shows it by this name alone: pictures stand on everything else.

    Raises:
        MissingExtraError: The extra is not installed; the message says how to install it.
    """
    return importlib.import_module(name)
