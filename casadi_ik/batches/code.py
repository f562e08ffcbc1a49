"""Which code an answer is from."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path

DECIDING = ("*.py", "*.c")
IDLE = ("batches", "cli", "views", "logs")
"""Parts of the package that have no say in what a solve comes to."""


@cache
def code_version() -> str:
    """Version of the package and a digest of the sources that decide a result."""
    digest = hashlib.sha256()
    root = Path(str(files("casadi_ik")))
    for path in sorted(path for pattern in DECIDING for path in root.rglob(pattern)):
        name = path.relative_to(root)
        if name.parts[0] not in IDLE:
            digest.update(name.as_posix().encode() + b"\0" + path.read_bytes())
    return f"{version('casadi-ik')}+{digest.hexdigest()[:12]}"
