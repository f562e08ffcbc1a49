"""Representations of results: text, HTML in notebooks, and short representations of records.

The code that formats and draws results is imported by name when it is needed, so that results do
not depend on it.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Mapping, Sequence
from typing import Any


class ReprMixin:
    """Base class of results: text as the command line reports it, and HTML in notebooks.

    `casadi_ik.app.report` formats the report of each type.
    """

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {str(self).partition(chr(10))[0]}>"

    def __str__(self) -> str:
        reports: Any = importlib.import_module("casadi_ik.app.report")
        return str(reports.as_text(reports.report_of(self)))

    def _repr_html_(self) -> str:
        reports: Any = importlib.import_module("casadi_ik.app.report")
        return str(reports.page_of(self))


class RecordReprMixin:
    """Base class of dataclasses with arrays: a short representation.

    Arrays are represented by their shapes, and long values are shortened. The dataclass decorator
    must not add another representation (`repr=False`).
    """

    def __repr__(self) -> str:
        fields: Any = dataclasses.fields(self)  # type: ignore[arg-type]
        texts = [f"{field.name}={_short_repr(getattr(self, field.name))}" for field in fields]
        return f"{type(self).__name__}({', '.join(texts)})"


MAX_REPR = 80
"""Maximum number of characters of the representation of a field."""


def _short_repr(value: Any) -> str:
    """Return the representation of a value on one short line."""
    shape = getattr(value, "shape", None)
    if isinstance(shape, tuple) and shape:
        return f"array of shape {shape}"
    text = f"<{type(value).__name__}>" if dataclasses.is_dataclass(value) else repr(value)
    if len(text) <= MAX_REPR and "\n" not in text:
        return text
    if isinstance(value, Mapping | Sequence) and not isinstance(value, str):
        return f"{type(value).__name__} of {len(value)}"
    return f"{' '.join(text.split())[:MAX_REPR]}..."
