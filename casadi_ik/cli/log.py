"""`casadi-ik log info`, `solves` and `events`: what is in logs, as tables."""

from __future__ import annotations

import argparse
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby, islice
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from casadi_ik import logs
from casadi_ik.cli.answer import Answer
from casadi_ik.cli.report import duration, fields, table
from casadi_ik.errors import printable
from casadi_ik.logs.explain.phrases import SERIOUS, plain_name, told
from casadi_ik.logs.read.one_solve import happening


def info(arguments: argparse.Namespace) -> Answer:
    """What logs hold.

    Raises:
        LogError: A file is missing, damaged or no log of casadi_ik.
    """
    parts: list[RenderableType] = []
    for name in arguments.files:
        parts += _report(logs.open(name), name)
    return Answer(Group(*parts))


def solves(arguments: argparse.Namespace) -> Answer:
    """The solves of logs, as one.

    Raises:
        LogError: A file is missing, damaged or no log of casadi_ik.
        UnknownNameError: A filter names what there is not.
    """
    found = logs.open(arguments.files).solves(**filters(arguments))
    parts: list[RenderableType] = []
    left = arguments.most
    for part in found.parts:
        shown = islice(logs.Table("solve", (part,)).records(), left)
        if len(part) and left:
            parts.append(Text(f"  {part.method}", "bold"))
            for shard, records in groupby(shown, lambda record: record.get("shard")):
                of_shard = [] if shard is None else [Text(f"  from {shard}", "dim")]
                parts += [*of_shard, _solve_rows(part, records)]
            left -= min(left, len(part))
    return Answer(Group(*parts, _count(len(found), arguments.most, "solves")))


def events(arguments: argparse.Namespace) -> Answer:
    """The events of logs, as one.

    Raises:
        LogError: A file is missing, damaged or no log of casadi_ik.
        UnknownNameError: A filter names what there is not.
    """
    found = logs.open(arguments.files).events(**filters(arguments))
    rows = table("solve", "iteration", "method", "phase", "what happened", right=_NUMBERS)
    for record in islice(found.records() if len(found) else (), arguments.most):
        event = happening(record)
        rows.add_row(
            str(record["solve_id"]),
            str(event.iteration),
            record["method"],
            event.phase,
            Text(told(event), "yellow" if event.kind in SERIOUS else ""),
        )
    return Answer(Group(_kept_whole(rows), _count(len(found), arguments.most, "events")))


def filters(arguments: argparse.Namespace) -> dict[str, Any]:
    """The filters of a command as `Log` takes them."""
    return {
        name: getattr(arguments, name) for name in ("method", "solve", "status", "event", "phase")
    }


def _solve_rows(part: logs.MethodRows, records: Iterable[Mapping[str, Any]]) -> Table:
    """A row per solve of one method; restarts only if there are any."""
    restarts = ["restarts"] if part.rows["restarts"].any() else []
    heads = ["solve", "status", "iterations", *restarts, "mm off", "deg off", "time", "events"]
    rows = table(*heads, right=_NUMBERS)
    for record in records:
        rows.add_row(
            str(record["solve_id"]),
            Text(record["status"], "green" if record["success"] else "red"),
            str(record["iterations"]),
            *(str(record[name]) for name in restarts),
            _worst(record["position_error"], 1e3),
            _worst(record["angle_error"], math.degrees(1.0)),
            duration(record["time"]),
            _tally(part.labels["events"], record) + ("" if record["kept"] else " (totals only)"),
        )
    return _kept_whole(rows)


SHOWN = 4
"""How many files, or values in which shards differ, are named."""

SHORT, LONG = 60, 2000
"""Characters of a name and of a text of the metadata that are shown."""

_NUMBERS = ("solve", "iteration", "iterations", "restarts", "mm off", "deg off", "time")


def _kept_whole(rows: Table) -> Table:
    """Only the last column wraps."""
    for column in rows.columns[:-1]:
        column.no_wrap = True
    return rows


def _count(count: int, most: int, what: str) -> RenderableType:
    if count <= most:
        return Text(f"  {count or 'no'} {what}")
    return Text(f"  the first {most} of {count} {what} (--most shows more)")


def _worst(values: Any, factor: float) -> str:
    """The largest error of all fingers; "free" if none has one."""
    known = [value for value in np.ravel(values).tolist() if not math.isnan(value)]
    return f"{factor * max(known):.2f}" if known else "free"


def _tally(kinds: Sequence[str], record: Mapping[str, Any]) -> str:
    """How often what happened in a solve, but for what happens in every one; what was held."""
    counts = zip(kinds, np.ravel(record["events"]).tolist(), strict=True)
    usual = ("PHASE_CHANGE", "LIMIT_LEFT", "RELEASED")
    found = [f"{count} {plain_name(k.lower())}" for k, count in counts if count and k not in usual]
    found += [f"{name} held" for name in record.get("fixed_mask", ())]
    return ", ".join(found)


def _report(log: logs.Log, name: str) -> list[RenderableType]:
    about = log.info()
    iterations = sum(counts["iteration"] for counts in about.counts.values())
    each = f", {about.size / iterations:.0f} bytes/iteration" if iterations else ""
    packed = f"{about.chunks}, compression {about.compression}"
    if about.compressed:
        packed += f" ({about.uncompressed / about.compressed:.1f} times smaller)"
    attached = (f"{name} ({size(length)})" for name, length in about.attachments.items())
    sources = log.sources.names
    shards = {"shards": named(sources, "")} if len(sources) > 1 else {}
    return [
        Text(name, "bold", no_wrap=True, overflow="ignore"),
        fields(
            {
                "robot": about.robot,
                **shards,
                "size": f"{size(about.size)}{each}",
                "chunks": packed,
                "attached": ", ".join(attached) or "nothing",
                **_unfinished(about),
            }
        ),
        _methods(log),
        fields(_origin(about)),
    ]


def _unfinished(about: logs.LogInfo) -> dict[str, str]:
    """Files without an end and files without anything, if there are any."""
    found = {}
    if about.unfinished:
        why = "killed while writing, or still at it (casadi-ik log finish)"
        found["unfinished"] = named(about.unfinished, why)
    if about.left_out:
        found["left out"] = named(about.left_out, "nothing in it is whole")
    return found


def named(items: Sequence[Any], why: str) -> str:
    """How many there are, the first few, and why they are named."""
    first = ", ".join(map(str, items[:SHOWN]))
    more = f" and {len(items) - SHOWN} more" if len(items) > SHOWN else ""
    count = f"{len(items)}: " if len(items) > 1 else ""
    return f"{count}{first}{more}" + (f": {why}" if why else "")


def _methods(log: logs.Log) -> RenderableType:
    right = ("solves", "iterations")
    rows = table("method", *right, "status", "smallest sigma", "events", right=right)
    for method, counts in log.info().counts.items():
        statuses = _counter(log.solves(method=method), "status")
        kinds = _counter(log.events(method=method), "kind")
        rows.add_row(
            method,
            str(counts["solve"]),
            str(counts["iteration"]),
            _counted(statuses),
            _smallest(log.solves(method=method)),
            _counted(kinds),
        )
    return rows


def _smallest(solves: logs.Table) -> str:
    """Smallest singular value of every Jacobian over all solves, or that it was not measured."""
    field = "lowest_sigma"
    if field not in solves.names:
        return "not measured"
    values = np.concatenate([[np.full(solves.rows[field].shape[1], np.nan)], solves.rows[field]])
    lowest = np.fmin.reduce(values, axis=0).tolist()
    return "\n".join(
        f"{plain_name(name)} {'not measured' if math.isnan(value) else f'{value:.2g}'}"
        for name, value in zip(solves.labels[field], lowest, strict=True)
    )


def _counter(table: logs.Table, field: str) -> Counter[str]:
    return Counter(record[field] for record in table.records())


def _counted(counter: Counter[str]) -> str:
    return "\n".join(f"{count} {name}" for name, count in counter.most_common()) or "none"


def _origin(about: logs.LogInfo) -> dict[str, str]:
    """The metadata that says where a log is from, as text by name."""
    metadata = about.metadata
    packages = {"casadi_ik": metadata.get("code_version"), "python": metadata.get("python")}
    packages |= metadata.get("packages", {})
    pairs = {
        "created": str(metadata.get("created")),
        "seed": str(metadata.get("seed")),
        "machine": _flat(metadata.get("machine", {})),
        "versions": " ".join(f"{name} {value}" for name, value in packages.items()),
    }
    if "scene" not in metadata.get("parameters", {}):
        pairs["collision"] = "not checked"
    for name, value in metadata.get("parameters", {}).items():
        pairs[name.replace("_", " ")] = _flat(value)
    for key, values in about.differs.items():
        if key == "parameters":
            for name in dict.fromkeys(name for each in values for name in each):
                own = list(dict.fromkeys(_flat(each.get(name)) for each in values))
                if len(own) > 1:
                    pairs[name.replace("_", " ")] = _several(own)
        elif key in pairs and key != "created":
            pairs[key] = _several([_flat(value) for value in values])
    return {printable(name, SHORT): printable(text, LONG) for name, text in pairs.items()}


def _several(texts: Sequence[str]) -> str:
    """What shards differ in."""
    more = f" | {len(texts) - SHOWN} more" if len(texts) > SHOWN else ""
    return " | ".join(texts[:SHOWN]) + more + " (by shard)"


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
