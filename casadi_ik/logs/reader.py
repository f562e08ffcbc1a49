"""Logs of one or several files, with filters that read only the matching chunks."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np

from casadi_ik.errors import LogError, UnknownNameError, printable
from casadi_ik.files.arrays import Counts
from casadi_ik.logs.chunks import is_section
from casadi_ik.logs.events import EventKind
from casadi_ik.logs.format import MESSAGE_KINDS
from casadi_ik.logs.shards import Paths, Shard, ShardOrigins, open_shards
from casadi_ik.logs.tables import MethodRows, Table

logger = logging.getLogger(__name__)

Names = str | EventKind | Iterable[str | EventKind] | None
Solves = int | Iterable[int] | None


class Filters(TypedDict, total=False):
    """Filters of the queries of a `Log`; a filter that is absent or None matches everything."""

    method: Names
    solve: Solves
    status: Names
    event: Names
    phase: Names


@dataclass(frozen=True)
class LogInfo:
    """Summary of a log, obtained without reading its messages.

    Attributes:
        paths: Paths of the files.
        size: Their total size [bytes].
        robot: Name of the robot.
        counts: Number of messages by method and kind: {"enhanced-dls": {"iteration": 120, ...}}.
        compression: Compression of the chunks.
        chunks: Number of chunks.
        uncompressed: Total size of the unpacked chunks [bytes].
        compressed: Total size of the chunks in the files [bytes].
        metadata: Provenance (seed, versions, parameters, ...) of the first file.
        attachments: Size of the attached files of the first file by name [bytes].
        unfinished: Files without an end, because their writer was killed or is still writing; data
            after their last complete chunk are lost.
        left_out: Files without a complete record, whose writer was killed before its first chunk.
        differs: Distinct values of every metadata entry in which the shards differ.

    Example:
        >>> info = ik.logs.open("cup.mcap").info()
        >>> info.robot, info.counts["hand-first"]["solve"]
        ('kuka_lwr_barrett', 1)
    """

    paths: tuple[Path, ...]
    size: int
    robot: str
    counts: Mapping[str, Mapping[str, int]]
    compression: str
    chunks: int
    uncompressed: int
    compressed: int
    metadata: Mapping[str, Any]
    attachments: Mapping[str, int]
    unfinished: tuple[Path, ...]
    left_out: tuple[Path, ...] = ()
    differs: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)


def open_log(path: Paths) -> Log:
    """Open a log.

    Args:
        path: A file, a folder (all .mcap files in it and its subfolders), or several of these: the
            shards of a study, which are read as one log. `casadi_ik.logs.shards` explains how
            their solves are numbered. MCAP files of other programs in a folder are skipped with a
            warning.

    Raises:
        LogError: A file is missing, not an MCAP file, damaged, or not a log of casadi_ik; or the
            files belong to different robots.

    Example:
        >>> ik.logs.open("cup.mcap").methods
        ('hand-first',)
    """
    return Log(*open_shards(path))


class Log:
    """A log of one or several files, which are opened for each query and closed again.

    Queries have the following optional filters; rows must match all of them:

    - `method`: Name of a method, or several.
    - `solve`: Number of a solve, or several.
    - `status`: Name of the status of a solve ("STALLED"), or several.
    - `event`: Kind of event ("NEAR_SINGULAR"), or several. Matches solves with such an event, their
      iterations, and the events themselves.
    - `phase`: Name of a phase ("refinement"), or several. Matches solves with iterations in it, and
      the iterations and events in it.

    Attributes:
        shards: Files of the log.
        methods: Names of the methods.
        metadata: Provenance of the first file.
        left_out: Files without a complete record.

    Example:
        >>> log = ik.logs.open("cup.mcap")
        >>> log.methods
        ('hand-first',)
    """

    def __init__(self, shards: Sequence[Shard], left_out: Sequence[Path] = ()) -> None:
        """Combine shards; `open_log` calls this.

        Raises:
            LogError: The shards belong to different robots.
        """
        first = shards[0]
        self.shards = tuple(shards)
        self.methods = tuple(dict.fromkeys(m for shard in shards for m in shard.methods))
        self.metadata = first.metadata
        self.left_out = tuple(left_out)
        for shard in shards:
            if shard.robot != first.robot:
                raise LogError(
                    f"{shard.path}: robot: found {shard.robot!r}, expected {first.robot!r} as in"
                    f" {first.path}"
                )
            if not shard.contents.complete:
                lost_bytes = shard.contents.size - shard.contents.end
                path = printable(str(shard.path))
                logger.warning(
                    "%s: log is incomplete; %d bytes at its end are lost", path, lost_bytes
                )

    def __repr__(self) -> str:
        return f"<Log of {len(self.shards)} file(s), methods {', '.join(self.methods) or 'none'}>"

    @cached_property
    def sources(self) -> ShardOrigins:
        """Origins and numbers of the solves.

        Raises:
            LogError: A solve is in two files, or the metadata of a merged log are invalid.
        """
        return ShardOrigins(self.shards)

    def info(self) -> LogInfo:
        """Return a summary of the log.

        Raises:
            LogError: A solve is in two files.

        Example:
            >>> ik.logs.open("cup.mcap").info().robot
            'kuka_lwr_barrett'
        """
        contents = [shard.contents for shard in self.shards]
        chunks = [index for item in contents for index in item.chunks]
        return LogInfo(
            paths=tuple(item.path for item in contents),
            size=sum(item.size for item in contents),
            robot=self.shards[0].robot,
            counts={
                method: {
                    kind: sum(shard.count(method, kind) for shard in self.shards)
                    for kind in MESSAGE_KINDS
                }
                for method in self.methods
            },
            compression=self.metadata["compression"],
            chunks=sum(not is_section(index) for index in chunks),
            uncompressed=sum(index.uncompressed_size for index in chunks),
            compressed=sum(index.compressed_size for index in chunks),
            metadata=self.metadata,
            attachments={
                item.name: item.data_size for item in contents[0].summary.attachment_indexes
            },
            unfinished=tuple(item.path for item in contents if not item.complete),
            left_out=self.left_out,
            differs=self.sources.differences(),
        )

    def attachment(self, name: str) -> bytes:
        """Return an attached file of the first file, e.g. "robot.urdf".

        Raises:
            UnknownNameError: No file of that name is attached.
            LogError: The log cannot be read.
        """
        attachments = self.shards[0].attachments()
        if name not in attachments:
            raise UnknownNameError(
                f"{self.shards[0].path}: no attachment {name!r}; attached: "
                f"{', '.join(attachments) or 'none'}"
            )
        return attachments[name].data

    def solves(self, **filters: Unpack[Filters]) -> Table:
        """Return solves: targets, solutions, and numbers of iterations and events.

        Args:
            filters: See `Log`.

        Raises:
            UnknownNameError: A method, status, event or phase does not exist.
            LogError: The log is damaged, or holds a solve twice.

        Example:
            >>> len(ik.logs.open("cup.mcap").solves(status="SOLVED").array())
            1
        """
        _check_filters(filters)
        numbers = _solve_numbers(filters.get("solve"))
        status, event, phase = (filters.get(name) for name in ("status", "event", "phase"))
        methods = self._methods(filters.get("method"))
        parts = [part for name in methods for part in self._read(name, "solve", numbers)]
        self._check_names("status", status, parts, "status")
        self._check_names("event", event, parts, "events")
        self._check_names("phase", phase, parts, "phase_iterations")
        matching = []
        for part in parts:
            matches = np.ones(len(part), dtype=bool)
            if status is not None:
                matches &= np.isin(part.rows["status"], _codes(part, "status", status))
            for name, values in (("events", event), ("phase_iterations", phase)):
                if values is not None:
                    matches &= part.rows[name][:, _codes(part, name, values)].any(axis=1)
            matching.append(part.where(matches))
        return Table("solve", tuple(matching))

    def iterations(
        self, *, fields: Sequence[str] | None = None, **filters: Unpack[Filters]
    ) -> Table:
        """Return logged iterations sorted by solve and iteration.

        Args:
            fields: Names of the fields to read, which saves memory; None: all.
            filters: See `Log`.

        Raises:
            UnknownNameError: A method, status, event, phase or field does not exist.
            LogError: The log is damaged, or holds a solve twice.

        Example:
            >>> rows = ik.logs.open("cup.mcap").iterations(solve=0).array()
            >>> len(rows) == solution.iterations, rows["q"].shape[1]
            (True, 14)
        """
        return self._filtered_rows("iteration", fields, filters)

    def events(self, **filters: Unpack[Filters]) -> Table:
        """Return logged events sorted by solve and iteration.

        Args:
            filters: See `Log`.

        Raises:
            UnknownNameError: A method, status, event or phase does not exist.
            LogError: The log is damaged.

        Example:
            >>> "kind" in ik.logs.open("cup.mcap").events().names
            True
        """
        return self._filtered_rows("event", None, filters)

    def _filtered_rows(self, kind: str, fields: Sequence[str] | None, filters: Filters) -> Table:
        """Return iterations or events that match all filters."""
        _check_filters(filters)
        event, phase = filters.get("event"), filters.get("phase")
        if filters.get("status") is None and event is None and phase is None:
            numbers = _solve_numbers(filters.get("solve"))
            numbers_by_method = dict.fromkeys(self._methods(filters.get("method")), numbers)
        else:
            numbers_by_method = {
                part.method: part.solve_id for part in self.solves(**filters).parts
            }
        if fields is not None and phase is not None:
            fields = [*fields, "phase"]
        parts = []
        for name, numbers in numbers_by_method.items():
            for part in self._read(name, kind, numbers, fields):
                matches = np.ones(len(part), dtype=bool)
                if phase is not None and "phase" in part.names:
                    matches &= np.isin(part.rows["phase"], _codes(part, "phase", phase))
                if kind == "event" and event is not None:
                    matches &= np.isin(part.rows["kind"], _codes(part, "kind", event))
                parts.append(part.where(matches))
        return Table(kind, tuple(parts))

    def _read(
        self,
        method: str,
        kind: str,
        numbers: Counts | None = None,
        fields: Sequence[str] | None = None,
    ) -> list[MethodRows]:
        """Read the rows of a method from all files, sorted by solve and iteration.

        Logs of other objects or scenes have other fields or other names of codes. Their rows cannot
        be in one array, so each such group of logs has a separate part.

        Args:
            method: A method of at least one file.
            kind: "solve", "iteration" or "event".
            numbers: Sorted numbers of the solves; None: all.
            fields: Names of the fields; None: all.

        Returns:
            Parts with rows; if there are no rows, one part without rows, or none if no file has the
            topic.

        Raises:
            LogError: A file cannot be read, or a solve is in two files.
        """
        sources = self.sources
        groups: dict[str, list[MethodRows]] = {}
        for i, shard in enumerate(self.shards):
            if (method, kind) not in shard.topics:
                continue
            offset = sources.offsets[i]
            in_shard = None if numbers is None else numbers[numbers >= offset] - offset
            if kind == "solve" and in_shard is None:
                part = shard.solves(method)
            else:
                part = shard.read(method, kind, in_shard, fields)
            if kind != "solve" and len(self.shards) > 1:
                # A truncated file may end within a solve, whose number another file may have.
                part = part.where(np.isin(part.solve_id, shard.solve_numbers(method)))
            if offset:
                rows = part.rows.copy()
                if "solve_id" in part.names:
                    rows["solve_id"] += np.uint32(offset)
                part = replace(part, rows=rows, solve_id=part.solve_id + offset)
            shard_indices = sources.original_shards(i, method, part.solve_id)
            part = replace(part, shard=shard_indices, shards=sources.names)
            row_format = part.rows.dtype.descr, sorted(part.labels.items())
            groups.setdefault(repr(row_format), []).append(part)
        parts = [self._sort(_concatenate(group), kind) for group in groups.values()]
        return [part for part in parts if len(part)] or parts[:1]

    def _sort(self, part: MethodRows, kind: str) -> MethodRows:
        """Sort rows by solve and iteration.

        Raises:
            LogError: A solve occurs twice.
        """
        # Every solve has fewer than 2**24 iterations.
        key = part.solve_id * 2**24 + part.iteration
        if np.any(np.diff(key) < 0):
            order = np.argsort(key, kind="stable")
            part, key = part.where(order), key[order]
        if kind != "event":
            number = key if kind == "iteration" else part.solve_id
            duplicates = np.flatnonzero(np.diff(number) == 0)
            if len(duplicates):
                solve, path = part.solve_id[duplicates[0]], self.shards[0].path
                raise LogError(f"{path}: solve {solve} of method {part.method!r} occurs twice")
        return part

    def _methods(self, method: Names) -> tuple[str, ...]:
        """Return the methods that a filter selects.

        Raises:
            UnknownNameError: A method is not in the log.
        """
        if method is None:
            return self.methods
        names = tuple(_names(method))
        for name in names:
            if name not in self.methods:
                available = ", ".join(self.methods) or "none"
                raise UnknownNameError(
                    f"{self.shards[0].path}: no method {name!r}; the log holds: {available}"
                )
        return names

    def _check_names(
        self, kind: str, values: Names, parts: Sequence[MethodRows], field: str
    ) -> None:
        """Check that names are labels of a field for at least one method.

        Raises:
            UnknownNameError: A name is not a label of any method. Without parts, labels are
                unknown, and every name is accepted.
        """
        if not parts:
            return
        labels = dict.fromkeys(label for part in parts for label in part.labels.get(field, ()))
        for name in _names(values):
            if name not in labels or not name:
                raise UnknownNameError(
                    f"{self.shards[0].path}: no {kind} {name!r}; there are: "
                    f"{', '.join(filter(None, labels))}"
                )


def _check_filters(filters: Filters) -> None:
    for name in filters:
        if name not in Filters.__annotations__:
            available = ", ".join(Filters.__annotations__)
            raise TypeError(f"a log has no filter {name!r}; there are: {available}")


def _concatenate(parts: Sequence[MethodRows]) -> MethodRows:
    """Concatenate parts of one method, at least one."""
    if len(parts) == 1:
        return parts[0]
    names = ("rows", "solve_id", "iteration", "shard")
    return replace(
        parts[0],
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names},
    )


def _solve_numbers(solve: Solves) -> Counts | None:
    """Return the sorted solve numbers of a filter; None if it selects all."""
    if solve is None:
        return None
    numbers = [solve] if isinstance(solve, int | np.integer) else list(solve)
    return np.unique(np.array(numbers, dtype=np.int64))


def _codes(part: MethodRows, field: str, values: Names) -> list[int]:
    """Return the codes of names; names that the method does not have are skipped."""
    labels = part.labels.get(field, ())
    return [labels.index(name) for name in _names(values) if name in labels]


def _names(values: Names) -> list[str]:
    """Return a name or several as a list; an `EventKind` is replaced by its name."""
    items = [values] if isinstance(values, str | EventKind) else list(values or ())
    return [item.name if isinstance(item, EventKind) else item for item in items]
