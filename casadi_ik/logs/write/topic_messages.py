"""What a block of solves has to say on each of its method's topics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.answers.recorder import SolveBlock
from casadi_ik.logs.mcap.clock import LogClock
from casadi_ik.logs.mcap.message_bytes import HEAD


@dataclass(frozen=True, eq=False)
class Messages:
    """Messages of some solves on one topic.

    Attributes:
        channel: Channel id.
        rows: (m,) payloads, solve by solve.
        sequence: (m,).
        log_time: (m,) [ns].
        publish_time: (m,) [ns].
        ends: (k,) how many of them belong to the first solves up to each.
    """

    channel: int
    rows: NDArray[Any]
    sequence: np.ndarray
    log_time: np.ndarray
    publish_time: np.ndarray
    ends: NDArray[np.int64]

    @property
    def size(self) -> int:
        """Of one message [bytes]."""
        return HEAD.itemsize + self.rows.dtype.itemsize

    def of_solves(self, start: int, stop: int) -> Messages:
        """Those of some of the solves."""
        first = int(self.ends[start - 1]) if start else 0
        part = slice(first, int(self.ends[stop - 1]))
        return Messages(
            self.channel,
            self.rows[part],
            self.sequence[part],
            self.log_time[part],
            self.publish_time[part],
            self.ends[start:stop] - first,
        )


def block_messages(
    block: SolveBlock,
    events: NDArray[Any],
    solves: NDArray[Any],
    channels: Mapping[str, int],
    clock: LogClock,
) -> list[Messages]:
    """The messages of a block by topic.

    Args:
        block: The solves, at least one.
        events: Their events, "solve_id" counted within the block; it is counted on in place.
        solves: Their rows; those not "kept" get no iterations and events.
        channels: Channel id by kind.
        clock: Rule of the log times.
    """
    counts, k = block.batch.iterations, len(block)
    seconds, solve = block.batch.time * 1e9, np.arange(k)
    starts = np.cumsum(counts) - counts
    of_row = np.repeat(solve, counts)
    iteration = np.arange(len(block.rows)) - np.repeat(starts, counts)
    share = (iteration + 1) * np.repeat(seconds / np.maximum(counts, 1), counts)
    published = np.repeat(block.started, counts) + share.astype(np.int64)
    rows = block.rows
    event_of, event_at = (events[key].astype(np.int64) for key in ("solve_id", "iteration"))
    event_published = published[starts[event_of] + event_at]
    events["solve_id"] += block.first
    kept = solves["kept"] > 0
    if not kept.all():
        wanted = np.flatnonzero(kept[of_row])
        rows, of_row, iteration, published = (
            np.take(of_rows, wanted) for of_rows in (rows, of_row, iteration, published)
        )
        wanted = np.flatnonzero(kept[event_of])
        events, event_of, event_at, event_published = (
            np.take(of_events, wanted)
            for of_events in (events, event_of, event_at, event_published)
        )
    return [
        Messages(
            channels["iteration"],
            rows,
            iteration,
            clock.times(block.first + of_row, iteration),
            published,
            np.cumsum(np.where(kept, counts, 0)),
        ),
        Messages(
            channels["event"],
            events,
            event_at,
            clock.times(block.first + event_of, event_at),
            event_published,
            np.cumsum(np.bincount(event_of, minlength=k)),
        ),
        Messages(
            channels["solve"],
            solves,
            block.first + solve,
            clock.times(block.first + solve, np.maximum(counts - 1, 0)),
            block.started + seconds.astype(np.int64),
            1 + solve,
        ),
    ]
