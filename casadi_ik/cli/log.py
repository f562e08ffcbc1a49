"""`casadi-ik log`: looking into logs."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from casadi_ik import logs
from casadi_ik.cli.answer import Answer
from casadi_ik.cli.report import fields, table


def info(files: Iterable[str]) -> Answer:
    """What logs hold.

    Raises:
        LogError: A file is missing, damaged or no log of casadi_ik.
    """
    parts: list[RenderableType] = []
    for name in files:
        parts += _report(logs.open(name))
    return Answer(Group(*parts))


def _report(log: logs.Log) -> list[RenderableType]:
    about = log.info()
    iterations = sum(counts["iteration"] for counts in about.counts.values())
    each = f", {about.size / iterations:.0f} bytes/iteration" if iterations else ""
    packed = f"{about.chunks}, compression {about.compression}"
    if about.compressed:
        packed += f" ({about.uncompressed / about.compressed:.1f} times smaller)"
    attached = (f"{name} ({size(length)})" for name, length in about.attachments.items())
    return [
        Text(", ".join(map(str, about.paths)), "bold", no_wrap=True, overflow="ignore"),
        fields(
            {
                "robot": about.robot,
                "size": f"{size(about.size)}{each}",
                "chunks": packed,
                "attached": ", ".join(attached) or "nothing",
            }
        ),
        _methods(log),
        fields(_origin(about.metadata)),
    ]


def _methods(log: logs.Log) -> RenderableType:
    right = ("solves", "iterations")
    rows = table("method", *right, "status", "events", right=right)
    for method, counts in log.info().counts.items():
        statuses = _counter(log.solves(method=method), "status")
        kinds = _counter(log.events(method=method), "kind")
        rows.add_row(
            method,
            str(counts["solve"]),
            str(counts["iteration"]),
            _counted(statuses),
            _counted(kinds),
        )
    return rows


def _counter(table: logs.Table, field: str) -> Counter[str]:
    return Counter(record[field] for record in table.records())


def _counted(counter: Counter[str]) -> str:
    return "\n".join(f"{count} {name}" for name, count in counter.most_common()) or "none"


def _origin(metadata: Mapping[str, Any]) -> dict[str, str]:
    """The metadata that says where a log is from, as text by name."""
    packages = {"casadi_ik": metadata.get("code_version"), "python": metadata.get("python")}
    packages |= metadata.get("packages", {})
    pairs = {
        "created": str(metadata.get("created")),
        "seed": str(metadata.get("seed")),
        "machine": _flat(metadata.get("machine", {})),
        "versions": " ".join(f"{name} {value}" for name, value in packages.items()),
    }
    for name, value in metadata.get("parameters", {}).items():
        pairs[name.replace("_", " ")] = _flat(value)
    return pairs


def _flat(value: Any) -> str:
    """JSON on one line, a mapping as "name value, ..."."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_flat(item)}" for key, item in value.items()) or "none"
    return value if isinstance(value, str) else json.dumps(value)


def size(count: int) -> str:
    """Bytes in the unit that suits them."""
    for unit, scale in (("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return f"{count / scale:.3g} {unit}"
    return f"{count} bytes"
