"""The files of a log read as one: which rows each has, and where they come from."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from casadi_ik.arrays import Counts
from casadi_ik.errors import LogError
from casadi_ik.logs.read.joining import joined, raised
from casadi_ik.logs.read.shard import Shard
from casadi_ik.logs.read.sources import Sources, offsets_of, overlapping, sources_of
from casadi_ik.logs.read.table import MethodRows


class JoinedShards:
    """The rows of all files of a log, method by method; the solves are read but once."""

    def __init__(self, shards: Sequence[Shard]) -> None:
        """Nothing is read before it is asked for."""
        self._shards = tuple(shards)
        self._own: dict[tuple[int, str], MethodRows] = {}
        self._solves: dict[str, MethodRows] = {}

    @cached_property
    def sources(self) -> Sources:
        """Where the solves come from, and how they are numbered.

        Raises:
            LogError: A solve is in two files, or what a merged log says of its shards is wrong.
        """
        offsets = [0] * len(self._shards)
        if overlapping(self._shards):
            self._own = {
                (i, method): shard.read(method, "solve")
                for i, shard in enumerate(self._shards)
                for method in shard.methods
            }
            offsets = offsets_of(self._shards, self._own)
        return sources_of(self._shards, offsets)

    def solves(self, method: str) -> MethodRows:
        """All solves of a method; they are read once.

        Raises:
            LogError: A file cannot be read, or a solve is in two.
        """
        if method not in self._solves:
            self._solves[method] = self.read(method, "solve")
        return self._solves[method]

    def read(
        self,
        method: str,
        kind: str,
        wanted: Counts | None = None,
        fields: Sequence[str] | None = None,
    ) -> MethodRows:
        """The rows of a method in all files, by solve and iteration.

        Args:
            method: One that at least one file holds.
            kind: "solve", "iteration" or "event".
            wanted: Numbers of the solves; None: all.
            fields: Names of the fields wanted; None: all.

        Raises:
            LogError: A file cannot be read, a method has other fields in it than in the others,
                or a solve is in two.
        """
        holders = [i for i, shard in enumerate(self._shards) if method in shard.methods]
        sources, parts, origin = self.sources, [], []
        for i in holders:
            offset = sources.offsets[i]
            own = None if wanted is None else wanted[wanted >= offset] - offset
            part = self._own.pop((i, method), None) if kind == "solve" and own is None else None
            part = part or self._shards[i].read(method, kind, own, fields)
            first = parts[0] if parts else part
            if part.rows.dtype != first.rows.dtype or part.labels != first.labels:
                raise LogError(
                    f"{self._shards[i].path}: method {method!r} has other fields or names than in "
                    f"{self._shards[holders[0]].path}"
                )
            if offset:
                part = raised(part, offset)
            parts.append(part)
            origin.append(sources.of(i, method, part.solve_id))
        where = str(self._shards[holders[0]].path)
        return joined(where, kind, parts, np.concatenate(origin), sources.names)
