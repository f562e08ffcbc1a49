"""Answers of a log: rows of solves, iterations or events, as arrays, records and dataframes."""

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
from casadi_ik.files.lazy_import import RecordReprMixin
from casadi_ik.logs.events import MOVES, SINGULAR, Event, EventKind, as_matrix, bits_of

if TYPE_CHECKING:
    import polars as pl

Labels = Mapping[str, tuple[str, ...]]


@dataclass(frozen=True, eq=False)
class MethodRows:
    """Rows of one method.

    Attributes:
        method: The method.
        rows: (k,) structured, by solve and iteration.
        solve_id: (k,) the solve that each row belongs to.
        iteration: (k,) its number within the solve from 0; of a solve the last.
        labels: Names that make a field readable, as in `TraceFormat.labels`.
        units: Unit by field, "" if dimensionless.
        shard: (k,) which of `shards` each row comes from; None where that is not told.
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
        """Fields of a row."""
        return self.rows.dtype.names or ()

    @property
    def origins(self) -> list[str] | None:
        """(k,) name of the shard of each row, if the log has several."""
        if self.shard is None or len(self.shards) < 2:
            return None
        return [self.shards[i] for i in self.shard.tolist()]

    def where(self, wanted: NDArray[Any]) -> MethodRows:
        """Some of the rows, by flags (k,) or numbers."""
        if wanted.dtype == bool and wanted.all():
            return self
        return replace(
            self,
            rows=self.rows[wanted],
            solve_id=self.solve_id[wanted],
            iteration=self.iteration[wanted],
            shard=None if self.shard is None else self.shard[wanted],
        )

    def first(self, count: int) -> MethodRows:
        """So many of the rows at most, the first."""
        return self.where(np.arange(min(count, len(self))))

    def readable(self, name: str) -> list[Any]:
        """A field as a person would have it: names for codes and bits."""
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
            known, place = np.unique(values, return_inverse=True)
            names = [label_of(labels, code) for code in known.tolist()]
            return [names[i] for i in place.tolist()]
        return values.tolist() if values.ndim == 1 else list(values)


@dataclass(frozen=True, eq=False, repr=False)
class Table(RecordReprMixin):
    """Rows of one kind: of one method, or of several one after the other.

    What belongs to one part (`rows`, `labels`, ...) is available if there is only one.

    Attributes:
        kind: "solve", "iteration" or "event".
        parts: The rows by method; of logs whose fields or names of codes differ (other objects or
            scenes) those of a method are several parts.

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
        """The rows of the only method.

        Raises:
            UnknownNameError: There is none, or there are several.
            LogError: Rows of the method differ in their fields.
        """
        if len(self.parts) == 1:
            return self.parts[0]
        methods = list(dict.fromkeys(part.method for part in self.parts))
        if len(methods) == 1:
            raise LogError(
                f"{self.kind}s: the logs have {len(self.parts)} kinds of rows (other objects or"
                " scenes), expected one; use parts or frame()"
            )
        known = ", ".join(methods) or "none"
        raise UnknownNameError(f"{self.kind}s: of which method? There are: {known}")

    @property
    def method(self) -> str:
        """The only method."""
        return self.part.method

    @property
    def rows(self) -> NDArray[Any]:
        """(k,) the rows as they stand in the log."""
        return self.part.rows

    @property
    def names(self) -> tuple[str, ...]:
        """Fields of a row."""
        return self.part.names

    @property
    def solve_id(self) -> NDArray[np.int64]:
        """(k,) the solve that each row belongs to."""
        return self.part.solve_id

    @property
    def iteration(self) -> NDArray[np.int64]:
        """(k,) number within the solve."""
        return self.part.iteration

    @property
    def labels(self) -> Labels:
        """Names that make a field readable."""
        return self.part.labels

    def array(self) -> NDArray[Any]:
        """The rows of the only method, (k,) structured, with "solve_id" (and "iteration") first."""
        part = self.part
        keys = [key for key in self._keys if key not in part.names]
        extra, rows = [(key, "<u4") for key in keys], opaque(part.rows)
        result = np.empty(len(part), [*extra, ("row", rows.dtype)])
        result["row"] = rows
        for key in keys:
            result[key] = getattr(part, key)
        return result.view(extra + part.rows.dtype.descr)

    def frame(self) -> pl.DataFrame:
        """The rows as a polars DataFrame: a column per number, codes as their names.

        A field with several numbers becomes several columns ("q.lwr_joint_1", "target_points.
        thumb.x"). Of a log of several shards "shard" names that of each row. Methods stand one
        below the other; what a method does not record is null.

        Raises:
            MissingExtraError: polars is not installed.
        """
        with optional_import("dataframes"):
            import polars as pl
        frames = [pl.DataFrame(_columns(part, self._keys)) for part in self.parts]
        return pl.concat(frames, how="diagonal") if frames else pl.DataFrame()

    def write_parquet(self, path: str | os.PathLike[str]) -> None:
        """Write `frame` to a Parquet file, for queries that come again.

        Raises:
            MissingExtraError: polars is not installed.
            LogError: It cannot be written.
        """
        frame = self.frame()
        with os_errors(f"{path}: cannot be written", LogError):
            frame.write_parquet(Path(path))

    def records(self) -> Iterator[dict[str, Any]]:
        """The rows one by one, for people: codes and masks as names.

        Events have a "subject" and the "unit" of their value beside.
        """
        for part in self.parts:
            columns = {name: getattr(part, name).tolist() for name in self._keys}
            columns |= {name: part.readable(name) for name in part.names}
            if (origins := part.origins) is not None:
                columns["shard"] = origins
            if self.kind == "event":
                found = events_of(part)
                columns["subject"] = [event.subject for event in found]
                columns["unit"] = [event.unit for event in found]
            for values in zip(*columns.values(), strict=True):
                yield {"method": part.method, **dict(zip(columns, values, strict=True))}

    @property
    def _keys(self) -> tuple[str, ...]:
        return ("solve_id",) if self.kind == "solve" else ("solve_id", "iteration")


def events_of(part: MethodRows) -> list[Event]:
    """The rows of events, one by one, as people have them."""
    bits = bits_of(as_matrix(part.rows["joint_mask"]))
    names = ("kind", "jacobian", "joint_mask", "phase", "value", "threshold")
    columns = part.iteration.tolist(), np.argmax(bits, axis=1).tolist(), *map(part.readable, names)
    phases, units = part.labels.get("phase", ()), part.labels.get("joint_unit", ())
    moves, singular = ([kind.name for kind in kinds] for kinds in (MOVES, SINGULAR))
    found = []
    for iteration, first, kind, jacobian, joints, phase, value, threshold in zip(
        *columns, strict=True
    ):
        known = EventKind.__members__.get(kind)
        subject = ("{joints}" if known is None else known.subject).format(
            joints=", ".join(joints),
            jacobian=jacobian,
            phase=phase if phase or phases else "whole solve",
            before=_label_of_float(phases, threshold),
            after=_label_of_float(phases, value),
            threshold=f"{threshold:.0f}",
            value=f"{value:.0f}",
        )
        found.append(
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
    return found


def element_name(labels: Sequence[str], index: int) -> str:
    """The name of an element, or its number."""
    return labels[index] if index < len(labels) else str(index)


def label_of(labels: Sequence[str], code: int) -> str:
    """The name of a code, or the code."""
    return (labels[code] if 0 <= code < len(labels) else "") or str(code)


def _columns(part: MethodRows, keys: Sequence[str]) -> dict[str, Any]:
    """The columns of a dataframe by name."""
    columns: dict[str, Any] = {"method": [part.method] * len(part)}
    columns |= {name: getattr(part, name).astype(np.uint32) for name in keys}
    for name in part.names:
        values, labels = part.rows[name], part.labels.get(name, ())
        if values.ndim > 1:
            matrix = np.ascontiguousarray(as_matrix(values).T)
            for column, index in zip(matrix, np.ndindex(values.shape[1:]), strict=True):
                rest = ("xyz"[i] if values.shape[-1] == 3 else str(i) for i in index[1:])
                columns[".".join((name, element_name(labels, index[0]), *rest))] = column
        elif labels and not name.endswith("_mask"):
            columns[name] = part.readable(name)
        else:
            columns[name] = np.ascontiguousarray(values)
    if (origins := part.origins) is not None:
        columns["shard"] = origins
    if "joint_mask" in part.names:
        found = events_of(part)
        columns["joints"] = [", ".join(event.joints) for event in found]
        columns["subject"] = [event.subject for event in found]
    return columns


def _label_of_float(labels: Sequence[str], code: float) -> str:
    """The name of a code that is kept as a float, or the number."""
    return label_of(labels, int(code)) if np.isfinite(code) else str(code)
