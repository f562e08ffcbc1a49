"""How a batch is cut: a part per thread, or so that the iterations of a part fit into memory."""

from __future__ import annotations

from collections.abc import Iterator

PART_BYTES = 2**24
"""About how many bytes of iterations a part may have if they are to be kept; what it has made is
lost if the process is killed before it goes to the log."""

CACHED_BYTES = 2**22
"""A part of `ENOUGH` solves has no more than this: what the next one needs is then at hand, in the
caches and in the process. Parts of 16 MiB make a study of hand-first with a log a tenth slower."""

ENOUGH = 256
"""Solves of a part that keep the vectors busy: its last ones have them to themselves."""

FIRST_PART = 64
"""Solves of the first parts of a traced batch, from which the others' size is learned."""


class BatchParts:
    """The parts of a batch in order; iterating may go on while finished parts are learned from."""

    def __init__(self, count: int, jobs: int, trace: bool) -> None:
        """Cut.

        Args:
            count: Targets.
            jobs: Threads.
            trace: Whether all iterations are kept.
        """
        self._count = count
        self._trace = trace
        self._largest = max(1, -(-count // jobs))
        self._size = min(FIRST_PART, self._largest) if trace else self._largest

    def __iter__(self) -> Iterator[slice]:
        """The parts; a single empty one if there are no targets.

        A part is recorded while the next is solved. The last parts of a traced batch grow smaller,
        so that little is left to record when all are solved.
        """
        start = 0
        while True:
            left = self._count - start
            size = min(self._size, max(left // 2, ENOUGH)) if self._trace else self._size
            stop = min(start + size, self._count)
            yield slice(start, stop)
            start = stop
            if start == self._count:
                return

    def learn(self, solves: int, size: int) -> None:
        """Take note of how many bytes of iterations so many solves had."""
        cached, fitting = (bound * solves // max(size, 1) for bound in (CACHED_BYTES, PART_BYTES))
        self._size = max(1, min(max(cached, min(ENOUGH, fitting)), self._largest))
