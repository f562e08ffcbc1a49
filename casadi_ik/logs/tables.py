"""Tables of a log: rows of solves, iterations or events as arrays, records and dataframes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.layout import opaque
from casadi_ik.errors import LogError, UnknownNameError, optional_import, os_errors
from casadi_ik.files.reprs import RecordReprMixin
from casadi_ik.logs.events import MOVES, SINGULAR, Event, EventKind
from casadi_ik.logs.traces import as_matrix, bits_of

if TYPE_CHECKING:
    import polars as pl

Labels = Mapping[str, tuple[str, ...]]


@dataclass(frozen=True, eq=False)
class MethodRows:
    """Rows of a method.

    Attributes:
        method: Name of the method.
        rows: (k,) structured rows sorted by solve and iteration.
        solve_id: (k,) number of the solve of each row.
        iteration: (k,) number of the iteration within the solve, from 0; for rows of solves, the
            last iteration.
        labels: Names of codes, bits and elements by field, as in `TraceFormat.labels`.
        units: Unit by field, "" if dimensionless.
        shard: (k,) index in `shards` of the shard of each row; None if unknown.
        shards: Names of the shards of the log.

    Example:
        >>> part = ik.logs.open("cup.mcap").iterations().part
        >>> part.method, bool(len(part.rows) == solution.iterations)
        ('hand-first', True)
    """

    method: str
    rows: NDArray[Any]
    solve_id: NDArray[np.int64]
    iteration: NDArray[np.int64]
    labels: Labels
    units: Mapping[str, str]
    shard: NDArray[np.int64] | None = None
    shards: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the fields of a row."""
        return self.rows.dtype.names or ()

    @property
    def origins(self) -> list[str] | None:
        """(k,) name of the shard of each row; None unless the log has several shards."""
        if self.shard is None or len(self.shards) < 2:
            return None
        return [self.shards[i] for i in self.shard.tolist()]

    def where(self, selection: NDArray[Any]) -> MethodRows:
        """Return the rows that flags (k,) or indices select."""
        if selection.dtype == bool and selection.all():
            return self
        return replace(
            self,
            rows=self.rows[selection],
            solve_id=self.solve_id[selection],
            iteration=self.iteration[selection],
            shard=None if self.shard is None else self.shard[selection],
        )

    def first(self, count: int) -> MethodRows:
        """Return the first rows, at most `count`."""
        return self.where(np.arange(min(count, len(self))))

    def readable(self, name: str) -> list[Any]:
        """Return a field of all rows with names in place of codes and bits."""
        values, labels = self.rows[name], self.labels.get(name, ())
        if name.endswith("_mask") and values.dtype.kind == "u":
            return [
                tuple(
                    labels[i] if i < len(labels) else f"coordinate {i}"
                    for i in np.flatnonzero(bits)
                )
                for bits in bits_of(as_matrix(values))
            ]
        if values.ndim == 1 and values.dtype.kind in "iu" and labels:
            codes, indices = np.unique(values, return_inverse=True)
            names = [label_of(labels, code) for code in codes.tolist()]
            return [names[i] for i in indices.tolist()]
        return values.tolist() if values.ndim == 1 else list(values)


@dataclass(frozen=True, eq=False, repr=False)
class Table(RecordReprMixin):
    """Rows of one kind, of one or several methods.

    The properties of a part (`rows`, `labels`, ...) require a table with a single part.

    Attributes:
        kind: "solve", "iteration" or "event".
        parts: Rows by method. A method has several parts if its logs differ in fields or in names
            of codes, as logs of different objects or scenes do.

    Example:
        >>> table = ik.logs.open("cup.mcap").solves()
        >>> table.kind, len(table.array())
        ('solve', 1)
    """

    kind: str
    parts: tuple[MethodRows, ...]

    def __len__(self) -> int:
        return sum(map(len, self.parts))

    @property
    def part(self) -> MethodRows:
        """The only part.

        Raises:
            UnknownNameError: The table has no method or several.
            LogError: The method has several parts.
        """
        if len(self.parts) == 1:
            return self.parts[0]
        methods = list(dict.fromkeys(part.method for part in self.parts))
        if len(methods) == 1:
            raise LogError(
                f"{self.kind}s: found {len(self.parts)} formats of rows (different objects or"
                " scenes), expected 1; use parts or frame()"
            )
        available = ", ".join(methods) or "none"
        raise UnknownNameError(
            f"{self.kind}s: method is missing; expected one of the log's methods: {available}"
        )

    @property
    def method(self) -> str:
        """Name of the only method."""
        return self.part.method

    @property
    def rows(self) -> NDArray[Any]:
        """(k,) structured rows of the log."""
        return self.part.rows

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the fields of a row."""
        return self.part.names

    @property
    def solve_id(self) -> NDArray[np.int64]:
        """(k,) number of the solve of each row."""
        return self.part.solve_id

    @property
    def iteration(self) -> NDArray[np.int64]:
        """(k,) number of the iteration within the solve."""
        return self.part.iteration

    @property
    def labels(self) -> Labels:
        """Names of codes, bits and elements by field."""
        return self.part.labels

    def array(self) -> NDArray[Any]:
        """Return the rows as a structured array (k,) with "solve_id" (and "iteration") first."""
        part = self.part
        keys = [key for key in self._keys if key not in part.names]
        extra, rows = [(key, "<u4") for key in keys], opaque(part.rows)
        result = np.empty(len(part), [*extra, ("row", rows.dtype)])
        result["row"] = rows
        for key in keys:
            result[key] = getattr(part, key)
        return result.view(extra + part.rows.dtype.descr)

    def frame(self) -> pl.DataFrame:
        """Return the rows of all parts as a polars DataFrame with names in place of codes.

        A field with several elements becomes several columns ("q.lwr_joint_1", "target_points.
        thumb.x"). If the log has several shards, "shard" is the shard of each row. Fields that a
        method does not record are null.

        Raises:
            MissingExtraError: polars is not installed.
        """
        with optional_import("dataframes"):
            import polars as pl
        frames = [pl.DataFrame(_columns(part, self._keys)) for part in self.parts]
        return pl.concat(frames, how="diagonal") if frames else pl.DataFrame()

    def write_parquet(self, path: str | os.PathLike[str]) -> None:
        """Write `frame` to a Parquet file, which is faster to query repeatedly than the log.

        Raises:
            MissingExtraError: polars is not installed.
            LogError: The file cannot be written.
        """
        frame = self.frame()
        with os_errors(f"{path}: cannot be written", LogError):
            frame.write_parquet(Path(path))

    def records(self) -> Iterator[dict[str, Any]]:
        """Yield the rows as dictionaries with names in place of codes and masks.

        Events also have a "subject" and the "unit" of their value.
        """
        for part in self.parts:
            columns = {name: getattr(part, name).tolist() for name in self._keys}
            columns |= {name: part.readable(name) for name in part.names}
            if (origins := part.origins) is not None:
                columns["shard"] = origins
            if self.kind == "event":
                events = events_of(part)
                columns["subject"] = [event.subject for event in events]
                columns["unit"] = [event.unit for event in events]
            for values in zip(*columns.values(), strict=True):
                yield {"method": part.method, **dict(zip(columns, values, strict=True))}

    @property
    def _keys(self) -> tuple[str, ...]:
        return ("solve_id",) if self.kind == "solve" else ("solve_id", "iteration")


def events_of(part: MethodRows) -> list[Event]:
    """Return rows of events as `Event` records."""
    bits = bits_of(as_matrix(part.rows["joint_mask"]))
    names = ("kind", "jacobian", "joint_mask", "phase", "value", "threshold")
    columns = part.iteration.tolist(), np.argmax(bits, axis=1).tolist(), *map(part.readable, names)
    phases, units = part.labels.get("phase", ()), part.labels.get("joint_unit", ())
    moves, singular = ([kind.name for kind in kinds] for kinds in (MOVES, SINGULAR))
    events = []
    for iteration, first, kind, jacobian, joints, phase, value, threshold in zip(
        *columns, strict=True
    ):
        member = EventKind.__members__.get(kind)
        subject = ("{joints}" if member is None else member.subject).format(
            joints=", ".join(joints),
            jacobian=jacobian,
            phase=phase if phase or phases else "whole solve",
            before=_label_of_float(phases, threshold),
            after=_label_of_float(phases, value),
            threshold=f"{threshold:.0f}",
            value=f"{value:.0f}",
        )
        events.append(
            Event(
                iteration,
                kind,
                jacobian if kind in singular else "",
                joints,
                phase if isinstance(phase, str) else "",
                value,
                threshold,
                units[first] if kind in moves and first < len(units) else "",
                subject,
            )
        )
    return events


def element_name(labels: Sequence[str], index: int) -> str:
    """Return the name of an element, or its index if it has no name."""
    return labels[index] if index < len(labels) else str(index)


def label_of(labels: Sequence[str], code: int) -> str:
    """Return the name of a code, or the code if it has no name."""
    return (labels[code] if 0 <= code < len(labels) else "") or str(code)


def _columns(part: MethodRows, keys: Sequence[str]) -> dict[str, Any]:
    """Return the columns of a dataframe by name."""
    columns: dict[str, Any] = {"method": [part.method] * len(part)}
    columns |= {name: getattr(part, name).astype(np.uint32) for name in keys}
    for name in part.names:
        values, labels = part.rows[name], part.labels.get(name, ())
        if values.ndim > 1:
            matrix = np.ascontiguousarray(as_matrix(values).T)
            for column, index in zip(matrix, np.ndindex(values.shape[1:]), strict=True):
                axes = ("xyz"[i] if values.shape[-1] == 3 else str(i) for i in index[1:])
                columns[".".join((name, element_name(labels, index[0]), *axes))] = column
        elif labels and not name.endswith("_mask"):
            columns[name] = part.readable(name)
        else:
            columns[name] = np.ascontiguousarray(values)
    if (origins := part.origins) is not None:
        columns["shard"] = origins
    if "joint_mask" in part.names:
        events = events_of(part)
        columns["joints"] = [", ".join(event.joints) for event in events]
        columns["subject"] = [event.subject for event in events]
    return columns


def _label_of_float(labels: Sequence[str], code: float) -> str:
    """Return the name of a code that is stored as a float, or the number if it is not a code."""
    return label_of(labels, int(code)) if np.isfinite(code) else str(code)
