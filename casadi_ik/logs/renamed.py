"""Warnings for deprecated names of logs."""

from __future__ import annotations

import warnings


def warn_renamed(old: str, new: str, stacklevel: int) -> None:
    """Warn that a name is deprecated.

    Args:
        old: Deprecated name.
        new: Name to use instead.
        stacklevel: Stack level of the caller's caller, as for `warnings.warn`.
    """
    warnings.warn(f"{old} is deprecated; use {new}", DeprecationWarning, stacklevel=stacklevel)
