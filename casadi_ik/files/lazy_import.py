"""What needs more than the package installs is looked up when it is asked for."""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Any


def import_lazily(name: str) -> ModuleType:
    """A part of the package that an extra brings to life, by its name.

    What is shown knows what shows it by this name alone: pictures stand on everything else.

    Raises:
        MissingExtraError: The extra is not installed; the message says how to install it.
    """
    return importlib.import_module(name)


class ReprMixin:
    """What prints as the command line reports it, and shows itself in notebooks.

    `casadi_ik.app.report` knows what there is to say about each kind.
    """

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {str(self).partition(chr(10))[0]}>"

    def __str__(self) -> str:
        reports: Any = import_lazily("casadi_ik.app.report")
        return str(reports.as_text(reports.report_of(self)))

    def _repr_html_(self) -> str:
        reports: Any = import_lazily("casadi_ik.app.report")
        return str(reports.page_of(self))
