"""Names of the arrays that pass between the parts of the package."""

from __future__ import annotations
