"""Logs read back: one file or several as one, filtered without reading what is not asked for."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from casadi_ik.arrays import Counts
from casadi_ik.errors import LogError, UnknownNameError, printable
from casadi_ik.logs.read import filters
from casadi_ik.logs.read.files import Paths, open_shards
from casadi_ik.logs.read.filters import Names, Solves
from casadi_ik.logs.read.info import LogInfo
from casadi_ik.logs.read.joined_shards import JoinedShards
from casadi_ik.logs.read.shard import Shard
from casadi_ik.logs.read.sources import Sources
from casadi_ik.logs.read.table import MethodRows, Table

logger = logging.getLogger(__name__)


def open_log(path: Paths) -> Log:
    """Open a log.

    Args:
        path: A file, a folder (all .mcap files in it and below), or several of these: the shards
            of one study, read as one log. How its solves are numbered: see `read.sources`.

    Raises:
        LogError: A file is missing, is no MCAP file, is damaged, or is not a log of casadi_ik; or
            the files are not of one robot, or a method is not of one kind in all of them.

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
        for shard in shards[1:]:
            if shard.robot != first.robot:
                raise LogError(
                    f"{shard.path}: robot {shard.robot!r}, but {first.path} has {first.robot!r}"
                )
        self.shards = tuple(shards)
        self.methods = tuple(dict.fromkeys(m for shard in shards for m in shard.methods))
        self.metadata = first.metadata
        self.left_out = tuple(left_out)
        self._joined = JoinedShards(self.shards)
        for shard in shards:
            if not shard.contents.complete:
                lost = shard.contents.size - shard.contents.readable
                where = printable(str(shard.path))
                logger.warning("%s: not finished; %d bytes at its end are lost", where, lost)

    def __repr__(self) -> str:
        return f"<Log of {len(self.shards)} file(s), methods {', '.join(self.methods) or 'none'}>"

    def info(self) -> LogInfo:
        """What is in it.

        Example:
            >>> ik.logs.open("cup.mcap").info().robot
            'kuka_lwr_barrett'
        """
        counts = {
            method: {
                kind: sum(shard.count(method, kind) for shard in self.shards)
                for kind in ("iteration", "solve", "event")
            }
            for method in self.methods
        }
        contents = [shard.contents for shard in self.shards]
        chunks = [chunk for each in contents for chunk in each.chunks]
        return LogInfo(
            paths=tuple(each.path for each in contents),
            size=sum(each.size for each in contents),
            robot=self.shards[0].robot,
            counts=counts,
            compression=self.metadata["compression"],
            chunks=len(chunks),
            uncompressed=sum(chunk.uncompressed_size for chunk in chunks),
            compressed=sum(chunk.compressed_size for chunk in chunks),
            metadata=self.metadata,
            attachments={item.name: item.data_size for item in contents[0].attachments},
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
        return self.shards[0].attachment(name)

    def solves(
        self,
        *,
        method: Names = None,
        solve: Solves = None,
        status: Names = None,
        event: Names = None,
        phase: Names = None,
    ) -> Table:
        """Solves: the question, the answer, totals of iterations and events.

        Raises:
            UnknownNameError: No such method, status, event or phase.
            LogError: The log is damaged, or a solve is in it twice.

        Example:
            >>> len(ik.logs.open("cup.mcap").solves(status="SOLVED").array())
            1
        """
        wanted = filters.numbers(solve)
        parts = [self._joined.solves(name) for name in self._methods(method)]
        self._known("status", status, parts, "status")
        self._known("event", event, parts, "events")
        self._known("phase", phase, parts, "phase_iterations")
        found = []
        for part in parts:
            keep = np.ones(len(part), dtype=bool)
            if wanted is not None:
                keep &= np.isin(part.solve_id, wanted)
            if status is not None:
                keep &= np.isin(part.rows["status"], filters.codes(part, "status", status))
            for name, values in (("events", event), ("phase_iterations", phase)):
                if values is not None:
                    keep &= part.rows[name][:, filters.codes(part, name, values)].any(axis=1)
            found.append(filters.chosen(part, keep))
        return Table("solve", tuple(found))

    def iterations(
        self,
        *,
        method: Names = None,
        solve: Solves = None,
        status: Names = None,
        event: Names = None,
        phase: Names = None,
        fields: Sequence[str] | None = None,
    ) -> Table:
        """Iterations, by solve and iteration; of the solves that kept theirs.

        Args:
            method: See `Log`.
            solve: See `Log`.
            status: See `Log`.
            event: See `Log`.
            phase: See `Log`.
            fields: Names of the fields wanted, which saves memory; None: all.

        Raises:
            UnknownNameError: No such method, status, event, phase or field.
            LogError: The log is damaged, or a solve is in it twice.

        Example:
            >>> rows = ik.logs.open("cup.mcap").iterations(solve=0).array()
            >>> len(rows) == solution.iterations, rows["q"].shape[1]
            (True, 14)
        """
        return self._rows("iteration", method, solve, status, event, phase, fields)

    def events(
        self,
        *,
        method: Names = None,
        solve: Solves = None,
        status: Names = None,
        event: Names = None,
        phase: Names = None,
    ) -> Table:
        """Events, by solve and iteration; of the solves that kept their iterations.

        Raises:
            UnknownNameError: No such method, status, event or phase.
            LogError: The log is damaged.

        Example:
            >>> "kind" in ik.logs.open("cup.mcap").events().names
            True
        """
        return self._rows("event", method, solve, status, event, phase, None)

    def _rows(
        self,
        kind: str,
        method: Names,
        solve: Solves,
        status: Names,
        event: Names,
        phase: Names,
        fields: Sequence[str] | None,
    ) -> Table:
        numbers: dict[str, Counts | None] = {}
        if status is None and event is None and phase is None:
            chosen = filters.numbers(solve)
            numbers = dict.fromkeys(self._methods(method), chosen)
        else:
            table = self.solves(method=method, solve=solve, status=status, event=event, phase=phase)
            numbers = {part.method: part.solve_id for part in table.parts}
        parts = []
        for name, wanted in numbers.items():
            asked = fields
            if fields is not None and phase is not None:
                asked = [*fields, *(["phase"] if "phase" not in fields else [])]
            part = self._joined.read(name, kind, wanted, asked)
            keep = np.ones(len(part), dtype=bool)
            if phase is not None and "phase" in (part.rows.dtype.names or ()):
                keep &= np.isin(part.rows["phase"], filters.codes(part, "phase", phase))
            if kind == "event" and event is not None:
                keep &= np.isin(part.rows["kind"], filters.codes(part, "kind", event))
            parts.append(filters.chosen(part, keep))
        return Table(kind, tuple(parts))

    @property
    def sources(self) -> Sources:
        """Where the solves come from, and how they are numbered.

        Raises:
            LogError: A solve is in two files, or what a merged log says of its shards is wrong.
        """
        return self._joined.sources

    def _methods(self, method: Names) -> tuple[str, ...]:
        if method is None:
            return self.methods
        names = tuple(filters.names(method))
        for name in names:
            if name not in self.methods:
                known = ", ".join(self.methods) or "none"
                raise UnknownNameError(
                    f"{self.shards[0].path}: no method {name!r}; the log holds: {known}"
                )
        return names

    def _known(self, what: str, values: Names, parts: Sequence[MethodRows], field: str) -> None:
        """See to it that at least one method knows the names.

        Raises:
            UnknownNameError: None does.
        """
        if values is None:
            return
        known = dict.fromkeys(label for part in parts for label in part.labels.get(field, ()))
        for name in filters.names(values):
            if name not in known or not name:
                raise UnknownNameError(
                    f"{self.shards[0].path}: no {what} {name!r}; there are: "
                    f"{', '.join(filter(None, known))}"
                )
