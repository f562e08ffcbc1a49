"""Lazy imports of optional dependencies and of code that draws results."""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Any


def import_lazily(name: str) -> ModuleType:
    """Import a module by name when it is needed.

    Results import the code that draws them by name only, so that they do not depend on it.

    Raises:
        MissingExtraError: An optional dependency is not installed; the message says how to install
            it.
    """
    return importlib.import_module(name)


class ReprMixin:
    """Base class of results: text as the command line reports it, and HTML in notebooks.

    `casadi_ik.app.report` formats the report of each type.
    """

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {str(self).partition(chr(10))[0]}>"

    def __str__(self) -> str:
        reports: Any = import_lazily("casadi_ik.app.report")
        return str(reports.as_text(reports.report_of(self)))

    def _repr_html_(self) -> str:
        reports: Any = import_lazily("casadi_ik.app.report")
        return str(reports.page_of(self))
