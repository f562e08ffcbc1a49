"""What a log answers with: rows of solves, iterations or events, as arrays and as dataframes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import LogError, MissingExtraError, UnknownNameError
from casadi_ik.kernels.rows import opaque
from casadi_ik.logs.events.kinds import EventKind
from casadi_ik.logs.events.traces import as_matrix, bits_of

if TYPE_CHECKING:
    import polars as pl

Labels = Mapping[str, tuple[str, ...]]

_AXES = ("x", "y", "z")


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

    @property
    def origins(self) -> list[str] | None:
        """(k,) name of the shard of each row, if the log has several."""
        if self.shard is None or len(self.shards) < 2:
            return None
        return [self.shards[i] for i in self.shard.tolist()]

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of one kind: of one method, or of several one after the other.

    What belongs to one method (`rows`, `labels`, ...) can be asked for if there is but one.

    Attributes:
        kind: "solve", "iteration" or "event".
        parts: The rows by method.

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
        """
        if len(self.parts) != 1:
            known = ", ".join(part.method for part in self.parts) or "none"
            raise UnknownNameError(f"{self.kind}s: of which method? There are: {known}")
        return self.parts[0]

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
        return self.part.rows.dtype.names or ()

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
        keys = [key for key in self._keys if key not in (part.rows.dtype.names or ())]
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
        pl = _polars()
        frames = [pl.DataFrame(_series(pl, part, self._keys)) for part in self.parts]
        return pl.concat(frames, how="diagonal") if frames else pl.DataFrame()

    def write_parquet(self, path: str | os.PathLike[str]) -> None:
        """Write `frame` to a Parquet file, for queries that come again.

        Raises:
            MissingExtraError: polars is not installed.
            LogError: It cannot be written.
        """
        frame = self.frame()
        try:
            frame.write_parquet(Path(path))
        except OSError as error:
            raise LogError(f"{path}: cannot be written: {error.strerror or error}") from error

    def records(self) -> Iterator[dict[str, Any]]:
        """The rows one by one, for people: codes and masks as names, events with a "subject"."""
        for part in self.parts:
            subjects = _subjects(part) if self.kind == "event" else None
            fields = {name: _readable(part, name) for name in part.rows.dtype.names or ()}
            origins = part.origins
            for i in range(len(part)):
                record: dict[str, Any] = {"method": part.method}
                record |= {name: int(getattr(part, name)[i]) for name in self._keys}
                record |= {name: values[i] for name, values in fields.items()}
                if origins is not None:
                    record["shard"] = origins[i]
                if subjects is not None:
                    record["subject"] = subjects[i]
                yield record

    @property
    def _keys(self) -> tuple[str, ...]:
        return ("solve_id",) if self.kind == "solve" else ("solve_id", "iteration")


def _series(pl: Any, part: MethodRows, keys: Sequence[str]) -> dict[str, Any]:
    """The columns of a part by name."""
    columns: dict[str, Any] = {"method": pl.repeat(part.method, len(part), eager=True)}
    columns |= {name: getattr(part, name).astype(np.uint32) for name in keys}
    for name in part.rows.dtype.names or ():
        values, labels = part.rows[name], part.labels.get(name, ())
        if values.ndim > 1:
            matrix = np.ascontiguousarray(as_matrix(values).T)
            for column, label in zip(matrix, _element_names(values.shape[1:], labels), strict=True):
                columns[f"{name}.{label}"] = column
        elif labels and values.dtype.kind in "iu" and not name.endswith("_mask"):
            known = pl.Series([label_of(labels, code) for code in range(256)])
            columns[name] = known.gather(values.astype(np.uint32))
        else:
            columns[name] = np.ascontiguousarray(values)
    if (origins := part.origins) is not None:
        columns["shard"] = origins
    if "joint_mask" in columns or "joint_mask.0" in columns:
        columns["joints"] = [", ".join(names) for names in _readable(part, "joint_mask")]
        columns["subject"] = _subjects(part)
    return columns


def _element_names(shape: tuple[int, ...], labels: Sequence[str]) -> list[str]:
    """Names of the elements of a field, row by row."""
    names: list[str] = []
    for index in np.ndindex(shape):
        rest = (_AXES[i] if shape[-1] == len(_AXES) else str(i) for i in index[1:])
        names.append(".".join((element_name(labels, index[0]), *rest)))
    return names


def _readable(part: MethodRows, name: str) -> list[Any]:
    """A field as a person would have it: names for codes and bits."""
    values, labels = part.rows[name], part.labels.get(name, ())
    if name.endswith("_mask") and values.dtype.kind == "u":
        return [
            tuple(labels[i] if i < len(labels) else f"coordinate {i}" for i in np.flatnonzero(bits))
            for bits in bits_of(as_matrix(values))
        ]
    if values.ndim == 1 and values.dtype.kind in "iu" and labels:
        return [label_of(labels, code) for code in values.tolist()]
    return values.tolist() if values.ndim == 1 else list(values)


def element_name(labels: Sequence[str], index: int) -> str:
    """The name of an element, or its number."""
    return labels[index] if index < len(labels) else str(index)


def label_of(labels: Sequence[str], code: int) -> str:
    """The name of a code, or the code."""
    return (labels[code] if 0 <= code < len(labels) else "") or str(code)


def _code_of(labels: Sequence[str], value: float) -> str:
    """The name of a code that is kept as a float, or the number."""
    return label_of(labels, int(value)) if np.isfinite(value) else str(value)


def _subjects(part: MethodRows) -> list[str]:
    """What each event is about: the Jacobian, the joints, the phases."""
    kinds = _readable(part, "kind")
    joints = [", ".join(names) for names in _readable(part, "joint_mask")]
    jacobian = _readable(part, "jacobian")
    phases = part.labels.get("phase", ())
    subjects = []
    for i, kind in enumerate(kinds):
        before, after = part.rows["threshold"][i], part.rows["value"][i]
        if kind == EventKind.PHASE_CHANGE.name:
            subject = f"{_code_of(phases, before)} -> {_code_of(phases, after)}"
        elif kind == EventKind.RESTART.name:
            subject = f"{before:.0f} -> {after:.0f}"
        elif kind in (EventKind.NEAR_SINGULAR.name, EventKind.ILL_CONDITIONED.name):
            subject = jacobian[i]
        elif kind == EventKind.STALL.name:
            phase = int(part.rows["phase"][i])
            subject = label_of(phases, phase) if phase or phases else "whole solve"
        else:
            subject = joints[i]
        subjects.append(subject)
    return subjects


def _polars() -> Any:
    try:
        import polars
    except ImportError as error:
        raise MissingExtraError(
            "dataframes need polars: pip install 'casadi-ik[dataframes]'"
        ) from error
    return polars
