"""Where the solves of a log come from: its shards, and which number a solve has in which.

The shards of a study may each count from 0. If two of them use a number for different solves of a
method, the numbers go on from shard to shard, in the order in which the files were named and
below a folder in the order of their paths: solve n of a shard becomes n plus, for every shard
before it, its largest number plus one. Otherwise every number stays as it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np

from casadi_ik.arrays import Counts
from casadi_ik.errors import LogError
from casadi_ik.kernels.rows import opaque
from casadi_ik.logs.mcap.metadata import SHARDS, parsed_json, values_of
from casadi_ik.logs.read.shard import Shard, naming
from casadi_ik.logs.read.table import MethodRows


@dataclass(frozen=True, eq=False)
class Source:
    """A shard, as it was written.

    Attributes:
        name: Of its file; below a folder the path from there.
        first: What its solves' numbers were raised by.
        metadata: Where it comes from.
        ranges: (m, 2) first and last numbers of its solves here, by method; None: all of the file.
    """

    name: str
    first: int
    metadata: Mapping[str, Any]
    ranges: Mapping[str, Counts] | None = None


class _Merged(msgspec.Struct):
    """What a merged log says of one of its shards."""

    file: str
    first: int = 0
    solves: dict[str, list[tuple[int, int]]] = {}
    differs: dict[str, str] = {}


@dataclass
class Sources:
    """All that the shards of a log come from.

    Attributes:
        sources: One by one.
        first: Number of a file's first source.
        offsets: What a file's numbers are raised by.
    """

    sources: list[Source] = field(default_factory=list)
    first: list[int] = field(default_factory=list)
    offsets: list[int] = field(default_factory=list)

    @property
    def names(self) -> tuple[str, ...]:
        """What each is called."""
        return tuple(source.name for source in self.sources)

    def differences(self) -> dict[str, tuple[Any, ...]]:
        """Entries of the metadata in which they differ, and all that is said there."""
        found: dict[str, tuple[Any, ...]] = {}
        for key in dict.fromkeys(key for each in self.sources for key in each.metadata):
            values: list[Any] = []
            for each in self.sources:
                if each.metadata.get(key) not in values:
                    values.append(each.metadata.get(key))
            if len(values) > 1:
                found[key] = tuple(values)
        return found

    def of(self, shard: int, method: str, numbers: Counts) -> Counts:
        """Which source the solves (k,) of a file come from, by their numbers here."""
        first = self.first[shard]
        last = self.first[shard + 1] if shard + 1 < len(self.first) else len(self.sources)
        found = np.full(len(numbers), first)
        for i in range(first, last):
            ranges = (self.sources[i].ranges or {}).get(method)
            if ranges is not None and len(ranges):
                place = np.searchsorted(ranges[:, 0], numbers, "right") - 1
                found[(place >= 0) & (numbers <= ranges[place, 1])] = i
        return found


def sources_of(shards: Sequence[Shard], offsets: Sequence[int]) -> Sources:
    """Where the solves of some files come from, merged ones included.

    Raises:
        LogError: What a merged log says of its shards is malformed.
    """
    found = Sources(offsets=list(offsets))
    for shard, offset in zip(shards, offsets, strict=True):
        found.first.append(len(found.sources))
        with naming(shard.path):
            merged = _merged(shard.record.get(SHARDS, "[]"))
            if not merged:
                found.sources.append(Source(shard.name, offset, shard.metadata))
            for each in merged:
                ranges = {
                    method: np.array(pairs, np.int64).reshape(-1, 2) + offset
                    for method, pairs in each.solves.items()
                }
                metadata = values_of({**shard.record, **each.differs})
                found.sources.append(Source(each.file, offset + each.first, metadata, ranges))
    return found


def _merged(text: str) -> list[_Merged]:
    value = parsed_json(f"metadata: {SHARDS}", text)
    try:
        found = msgspec.convert(value, list[_Merged])
    except msgspec.ValidationError as error:
        raise LogError(f"metadata: {SHARDS}: {error}") from error
    limit = 2**32
    for each in found:
        pairs = [number for ranges in each.solves.values() for pair in ranges for number in pair]
        if not all(0 <= number < limit for number in (each.first, *pairs)):
            raise LogError(f"metadata: {SHARDS}: a number of a solve is negative or too large")
    return found


def offsets_of(shards: Sequence[Shard], solves: Mapping[tuple[int, str], MethodRows]) -> list[int]:
    """What the numbers of each shard's solves are raised by: see above.

    Args:
        shards: The shards.
        solves: All solves by number of the shard and method.

    Raises:
        LogError: One and the same solve is in two shards, or there are too many.
    """
    clash = False
    for method in dict.fromkeys(name for _, name in solves):
        parts = [(shards[i], part) for (i, name), part in solves.items() if name == method]
        numbers = np.concatenate([part.solve_id for _, part in parts])
        if len(np.unique(numbers)) < len(numbers):
            _refuse_same(method, parts)
            clash = True
    if not clash:
        return [0] * len(shards)
    largest = [-1] * len(shards)
    for (i, _), part in solves.items():
        largest[i] = max(largest[i], int(part.solve_id.max(initial=-1)))
    offsets = [0, *np.cumsum(np.array(largest) + 1).tolist()]
    if offsets.pop() >= 2**32:
        raise LogError(f"{shards[0].path} and others: more solves than can be numbered")
    return offsets


def _refuse_same(method: str, parts: Sequence[tuple[Shard, MethodRows]]) -> None:
    """See to it that no solve is in two shards, whatever its number.

    Raises:
        LogError: One is.
    """
    seen: dict[bytes, Shard] = {}
    for shard, part in parts:
        rows = part.rows.copy()
        rows["solve_id"] = 0
        own = [row.tobytes() for row in opaque(rows)]
        same = [i for i, row in enumerate(own) if row in seen]
        if same:
            first = min(same, key=lambda i: part.solve_id[i])
            raise LogError(
                f"{shard.path}: solve {part.solve_id[first]} of {method} is in"
                f" {seen[own[first]].path} too ({len(same)} such solves)"
            )
        seen.update(dict.fromkeys(own, shard))


def overlapping(shards: Sequence[Shard]) -> bool:
    """Whether two shards may hold a solve of the same number, by the times of their chunks."""
    spans = []
    for shard in shards:
        chunks = shard.contents.chunks
        if chunks:
            times = [min(c.message_start_time for c in chunks)]
            times.append(max(c.message_end_time for c in chunks))
            spans.append(tuple(shard.clock.locate(np.array(times, np.uint64))[0].tolist()))
    spans.sort()
    return any(after[0] <= before[1] for before, after in pairwise(spans))


def ranges_of(numbers: Counts) -> list[list[int]]:
    """Sorted numbers as first and last of every run."""
    ends = np.flatnonzero(np.diff(numbers) != 1)
    firsts = numbers[np.concatenate([[0], ends + 1]).astype(int)] if len(numbers) else numbers
    lasts = numbers[np.append(ends, len(numbers) - 1)] if len(numbers) else numbers
    return np.stack([firsts, lasts], axis=1).tolist()
