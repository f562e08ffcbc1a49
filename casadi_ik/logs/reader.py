"""Logs read back: one file or several as one, filtered without reading what is not asked for."""

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
from casadi_ik.logs.events import EventKind
from casadi_ik.logs.format import MESSAGE_KINDS
from casadi_ik.logs.shards import Paths, Shard, ShardOrigins, open_shards
from casadi_ik.logs.tables import MethodRows, Table

logger = logging.getLogger(__name__)

Names = str | EventKind | Iterable[str | EventKind] | None
Solves = int | Iterable[int] | None


class Filters(TypedDict, total=False):
    """What narrows down an answer of a `Log`; what is left out or None does not."""

    method: Names
    solve: Solves
    status: Names
    event: Names
    phase: Names


@dataclass(frozen=True)
class LogInfo:
    """What is in a log, without reading its messages.

    Attributes:
        paths: The files.
        size: Their size [bytes].
        robot: Name of the robot.
        counts: Messages by method and kind: {"enhanced-dls": {"iteration": 120, ...}}.
        compression: Of the chunks.
        chunks: How many chunks there are.
        uncompressed: Size of the chunks' contents [bytes].
        compressed: Size of the chunks as stored [bytes].
        metadata: Where the log comes from (seed, versions, parameters, ...), of the first file.
        attachments: Attached files and their sizes [bytes], of the first file.
        unfinished: Files without a footer: their writer was killed or is still at it. What is
            after their last complete chunk is lost.
        left_out: Files in which nothing is whole: their writer was killed before its first chunk.
        differs: Entries of the metadata in which the shards differ, and what they say.

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
        path: A file, a folder (all .mcap files in it and below), or several of these: the shards
            of one study, read as one log. How its solves are numbered: see `logs.shards`.

    Raises:
        LogError: A file is missing, is no MCAP file, is damaged, or is not a log of casadi_ik; or
            the files are not of one robot. A folder may hold MCAP files of others, which are left
            out with a warning.

    Example:
        >>> ik.logs.open("cup.mcap").methods
        ('hand-first',)
    """
    return Log(*open_shards(path))


class Log:
    """One log, in one file or several. Nothing stays open, so there is nothing to close.

    Filters (all optional, together they narrow down):

    - `method`: a name or several.
    - `solve`: a number or several.
    - `status`: of the solve, a name ("STALLED") or several.
    - `event`: a kind ("NEAR_SINGULAR") or several: solves in which one happened, their
      iterations, the events themselves.
    - `phase`: a name ("refinement") or several: solves that spent iterations in it, the iterations
      and events in it.

    Attributes:
        shards: The files.
        methods: What methods there are.
        metadata: Where the log comes from, of the first file.
        left_out: Files in which nothing is whole.

    Example:
        >>> log = ik.logs.open("cup.mcap")
        >>> log.methods
        ('hand-first',)
    """

    def __init__(self, shards: Sequence[Shard], left_out: Sequence[Path] = ()) -> None:
        """Put shards together; use `open_log`."""
        first = shards[0]
        self.shards = tuple(shards)
        self.methods = tuple(dict.fromkeys(m for shard in shards for m in shard.methods))
        self.metadata = first.metadata
        self.left_out = tuple(left_out)
        for shard in shards:
            if shard.robot != first.robot:
                raise LogError(
                    f"{shard.path}: robot {shard.robot!r}, but {first.path} has {first.robot!r}"
                )
            if not shard.contents.complete:
                lost = shard.contents.size - shard.contents.end
                where = printable(str(shard.path))
                logger.warning("%s: not finished; %d bytes at its end are lost", where, lost)

    def __repr__(self) -> str:
        return f"<Log of {len(self.shards)} file(s), methods {', '.join(self.methods) or 'none'}>"

    @cached_property
    def sources(self) -> ShardOrigins:
        """Where the solves come from, and how they are numbered.

        Raises:
            LogError: A solve is in two files, or what a merged log says of its shards is wrong.
        """
        return ShardOrigins(self.shards)

    def info(self) -> LogInfo:
        """What is in it.

        Example:
            >>> ik.logs.open("cup.mcap").info().robot
            'kuka_lwr_barrett'
        """
        contents = [shard.contents for shard in self.shards]
        chunks = [chunk for each in contents for chunk in each.chunks]
        return LogInfo(
            paths=tuple(each.path for each in contents),
            size=sum(each.size for each in contents),
            robot=self.shards[0].robot,
            counts={
                method: {
                    kind: sum(shard.count(method, kind) for shard in self.shards)
                    for kind in MESSAGE_KINDS
                }
                for method in self.methods
            },
            compression=self.metadata["compression"],
            chunks=len(chunks),
            uncompressed=sum(chunk.uncompressed_size for chunk in chunks),
            compressed=sum(chunk.compressed_size for chunk in chunks),
            metadata=self.metadata,
            attachments={
                item.name: item.data_size for item in contents[0].summary.attachment_indexes
            },
            unfinished=tuple(each.path for each in contents if not each.complete),
            left_out=self.left_out,
            differs=self.sources.differences(),
        )

    def attachment(self, name: str) -> bytes:
        """An attached file, e.g. "robot.urdf", of the first file.

        Raises:
            UnknownNameError: Nothing of that name is attached.
            LogError: It cannot be read.
        """
        known = self.shards[0].attachments()
        if name not in known:
            raise UnknownNameError(
                f"{self.shards[0].path}: no attachment {name!r}; attached: "
                f"{', '.join(known) or 'none'}"
            )
        return known[name].data

    def solves(self, **filters: Unpack[Filters]) -> Table:
        """Solves: the question, the answer, totals of iterations and events.

        Args:
            filters: See `Log`.

        Raises:
            UnknownNameError: No such method, status, event or phase.
            LogError: The log is damaged, or a solve is in it twice.

        Example:
            >>> len(ik.logs.open("cup.mcap").solves(status="SOLVED").array())
            1
        """
        _check_filters(filters)
        wanted = _numbers(filters.get("solve"))
        status, event, phase = (filters.get(name) for name in ("status", "event", "phase"))
        methods = self._methods(filters.get("method"))
        parts = [part for name in methods for part in self._read(name, "solve", wanted)]
        self._check_known("status", status, parts, "status")
        self._check_known("event", event, parts, "events")
        self._check_known("phase", phase, parts, "phase_iterations")
        found = []
        for part in parts:
            keep = np.ones(len(part), dtype=bool)
            if status is not None:
                keep &= np.isin(part.rows["status"], _codes(part, "status", status))
            for name, values in (("events", event), ("phase_iterations", phase)):
                if values is not None:
                    keep &= part.rows[name][:, _codes(part, name, values)].any(axis=1)
            found.append(part.where(keep))
        return Table("solve", tuple(found))

    def iterations(
        self, *, fields: Sequence[str] | None = None, **filters: Unpack[Filters]
    ) -> Table:
        """Iterations, by solve and iteration; of the solves that kept theirs.

        Args:
            fields: Names of the fields wanted, which saves memory; None: all.
            filters: See `Log`.

        Raises:
            UnknownNameError: No such method, status, event, phase or field.
            LogError: The log is damaged, or a solve is in it twice.

        Example:
            >>> rows = ik.logs.open("cup.mcap").iterations(solve=0).array()
            >>> len(rows) == solution.iterations, rows["q"].shape[1]
            (True, 14)
        """
        return self._rows("iteration", fields, filters)

    def events(self, **filters: Unpack[Filters]) -> Table:
        """Events, by solve and iteration; of the solves that kept their iterations.

        Args:
            filters: See `Log`.

        Raises:
            UnknownNameError: No such method, status, event or phase.
            LogError: The log is damaged.

        Example:
            >>> "kind" in ik.logs.open("cup.mcap").events().names
            True
        """
        return self._rows("event", None, filters)

    def _rows(self, kind: str, fields: Sequence[str] | None, filters: Filters) -> Table:
        _check_filters(filters)
        event, phase = filters.get("event"), filters.get("phase")
        if filters.get("status") is None and event is None and phase is None:
            numbers = _numbers(filters.get("solve"))
            wanted_of = dict.fromkeys(self._methods(filters.get("method")), numbers)
        else:
            wanted_of = {part.method: part.solve_id for part in self.solves(**filters).parts}
        if fields is not None and phase is not None:
            fields = [*fields, "phase"]
        parts = []
        for name, wanted in wanted_of.items():
            for part in self._read(name, kind, wanted, fields):
                keep = np.ones(len(part), dtype=bool)
                if phase is not None and "phase" in part.names:
                    keep &= np.isin(part.rows["phase"], _codes(part, "phase", phase))
                if kind == "event" and event is not None:
                    keep &= np.isin(part.rows["kind"], _codes(part, "kind", event))
                parts.append(part.where(keep))
        return Table(kind, tuple(parts))

    def _read(
        self,
        method: str,
        kind: str,
        wanted: Counts | None = None,
        fields: Sequence[str] | None = None,
    ) -> list[MethodRows]:
        """Read the rows of a method in all files, by solve and iteration.

        Logs of other objects or scenes have other fields or other names of codes. Their rows
        cannot stand in one array, so the rows of each kind of log are a part.

        Args:
            method: One that at least one file holds.
            kind: "solve", "iteration" or "event".
            wanted: Numbers of the solves, sorted; None: all.
            fields: Names of the fields wanted; None: all.

        Returns:
            At least one part; only parts with rows, if any has rows.

        Raises:
            LogError: A file cannot be read, or a solve is in two.
        """
        sources = self.sources
        alike: dict[object, list[MethodRows]] = {}
        for i, shard in enumerate(self.shards):
            if method not in shard.methods:
                continue
            offset = sources.offsets[i]
            numbers = None if wanted is None else wanted[wanted >= offset] - offset
            whole = kind == "solve" and numbers is None
            part = shard.solves(method) if whole else shard.read(method, kind, numbers, fields)
            if offset:
                rows = part.rows.copy()
                if "solve_id" in part.names:
                    rows["solve_id"] += np.uint32(offset)
                part = replace(part, rows=rows, solve_id=part.solve_id + offset)
            part = replace(part, shard=sources.of(i, method, part.solve_id), shards=sources.names)
            form = part.rows.dtype.descr, sorted(part.labels.items())
            alike.setdefault(repr(form), []).append(part)
        parts = [self._sorted(_joined(group), kind) for group in alike.values()]
        return [part for part in parts if len(part)] or parts[:1]

    def _sorted(self, part: MethodRows, kind: str) -> MethodRows:
        """Sort rows by solve and iteration.

        Raises:
            LogError: A solve is there twice.
        """
        # Every solve has fewer than 2**24 iterations.
        key = part.solve_id * 2**24 + part.iteration
        if np.any(np.diff(key) < 0):
            order = np.argsort(key, kind="stable")
            part, key = part.where(order), key[order]
        if kind != "event":
            number = key if kind == "iteration" else part.solve_id
            twice = np.flatnonzero(np.diff(number) == 0)
            if len(twice):
                solve, where = part.solve_id[twice[0]], self.shards[0].path
                raise LogError(f"{where}: solve {solve} of method {part.method!r} is there twice")
        return part

    def _methods(self, method: Names) -> tuple[str, ...]:
        if method is None:
            return self.methods
        names = tuple(_names(method))
        for name in names:
            if name not in self.methods:
                known = ", ".join(self.methods) or "none"
                raise UnknownNameError(
                    f"{self.shards[0].path}: no method {name!r}; the log holds: {known}"
                )
        return names

    def _check_known(
        self, what: str, values: Names, parts: Sequence[MethodRows], field: str
    ) -> None:
        """Check that at least one method knows the names.

        Raises:
            UnknownNameError: None does.
        """
        known = dict.fromkeys(label for part in parts for label in part.labels.get(field, ()))
        for name in _names(values):
            if name not in known or not name:
                raise UnknownNameError(
                    f"{self.shards[0].path}: no {what} {name!r}; there are: "
                    f"{', '.join(filter(None, known))}"
                )


def _check_filters(filters: Filters) -> None:
    for name in filters:
        if name not in Filters.__annotations__:
            known = ", ".join(Filters.__annotations__)
            raise TypeError(f"a log has no filter {name!r}; there are: {known}")


def _joined(parts: Sequence[MethodRows]) -> MethodRows:
    """Parts of one method one after the other; at least one."""
    if len(parts) == 1:
        return parts[0]
    names = ("rows", "solve_id", "iteration", "shard")
    return replace(
        parts[0],
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names},
    )


def _numbers(solve: Solves) -> Counts | None:
    """The numbers of solves, sorted; None if all are wanted."""
    if solve is None:
        return None
    numbers = [solve] if isinstance(solve, int | np.integer) else list(solve)
    return np.unique(np.array(numbers, dtype=np.int64))


def _codes(part: MethodRows, field: str, values: Names) -> list[int]:
    """The codes of names; of those the method does not know none."""
    labels = part.labels.get(field, ())
    return [labels.index(name) for name in _names(values) if name in labels]


def _names(values: Names) -> list[str]:
    """One name or several as a list; an `EventKind` counts as its name."""
    several = [values] if isinstance(values, str | EventKind) else list(values or ())
    return [value.name if isinstance(value, EventKind) else value for value in several]
