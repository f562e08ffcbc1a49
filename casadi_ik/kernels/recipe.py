"""What a graph follows from, as a short text: known before the graph is built.

Building a large graph and hashing it takes half a second, loading its library a few milliseconds.
A graph that is a function of plain data and of this package's sources alone need not be built to
be recognised.
"""

from __future__ import annotations

import hashlib
import pickle
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

BUILD_NO_GRAPHS = (
    *("cli", "drawing", "exporting", "files", "importing"),
    *("palette.py", "viewing", "views"),
)
"""What has no code that can change a graph; the code of every other part may, a new one included.
import-linter checks that none of them uses CasADi."""


def recipe(*parts: Any) -> str:
    """A hash of data and of the code that makes graphs from it, 32 hexadecimal digits.

    Args:
        parts: Everything the graph depends on; plain picklable data.
    """
    digest = hashlib.sha256(_sources())
    digest.update(pickle.dumps(parts))
    return digest.hexdigest()[:32]


@cache
def _sources() -> bytes:
    digest = hashlib.sha256(f"numpy {version('numpy')}".encode())
    root = Path(__file__).parents[1]
    for path in sorted(root.rglob("*.[pc]*")):
        inside = path.relative_to(root)
        if path.suffix not in (".py", ".c") or inside.parts[0] in BUILD_NO_GRAPHS:
            continue
        digest.update(inside.as_posix().encode() + b"\0" + path.read_bytes())
    return digest.digest()
