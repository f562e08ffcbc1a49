"""What a page is asked to do, done in a thread of its own: of each thing only the newest.

Whoever drags sends twenty changes a second, whatever a solve takes. Each change has a key; one that
was not begun when another of its key comes is dropped. What can wait is begun once nothing has come
for a while, and given up when something comes. The thread that talks to the browsers only ever puts
a change down.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from casadi_ik.errors import shortened
from casadi_ik.kernels.cancellation import CancelledError, cancellable

logger = logging.getLogger(__name__)

Work = Callable[[], None]

PAUSE = 0.02
"""What follows a drag waits so long, and so never is in the way of an answer [s]."""

REST = 0.15
"""After so long nothing moves any more [s]; in a drag, changes are 0.05 s apart."""

LOOKS = 0.5
"""After so long whoever drags looks, and does not go on at once [s]: time for what takes long."""

FAULTS = 20
"""So many different ones are told of."""


class Newest:
    """A thread that does the newest change of every key, then draws, then what can wait."""

    def __init__(self, refresh: Work, later: tuple[tuple[float, Work], ...] = ()) -> None:
        """Start it.

        Args:
            refresh: Called after changes, once for all that were waiting.
            later: Each called once nothing has come for so long [s], the shortest first; all begun
                anew after the next change if that comes in between.
        """
        self._refresh, self._later = refresh, later
        self._changes: dict[str, Work] = {}
        self._something = threading.Condition()
        self._busy = self._stopped = False
        self._awaited = 0
        self._moved_on = threading.Event()
        self._told: set[str] = set()
        self.dropped = 0
        self._thread = threading.Thread(target=self._run, name="casadi-ik view", daemon=True)
        self._thread.start()

    def put(self, key: str, change: Work) -> None:
        """Ask for a change; returns at once."""
        with self._something:
            if self._changes.pop(key, None) is not None:
                self.dropped += 1
            self._changes[key] = change
            self._moved_on.set()
            self._something.notify_all()

    def settle(self, seconds: float = 30.0) -> bool:
        """Wait until everything is done, what can wait as well; False if it takes longer."""
        with self._something:
            self._awaited += 1
            self._something.notify_all()
            try:
                return self._something.wait_for(lambda: not (self._busy or self._changes), seconds)
            finally:
                self._awaited -= 1

    def stop(self) -> None:
        """End the thread after what it is doing."""
        with self._something:
            self._stopped = True
            self._moved_on.set()
            self._something.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(10.0)

    def _run(self) -> None:
        while self._wait():
            for change in self._take():
                self._do(change)
            self._do(self._refresh)
            self._do_later(time.monotonic())

    def _do_later(self, since: float) -> None:
        try:
            with cancellable(self._moved_on):
                for pause, work in self._later:
                    if not self._rests(since + pause):
                        return
                    self._do(work)
        except CancelledError:
            logger.debug("given up for something newer")

    def _rests(self, until: float) -> bool:
        """Whether nothing comes until then; at once if somebody waits for everything."""
        with self._something:
            self._something.wait_for(
                lambda: self._changes or self._stopped or self._awaited,
                timeout=max(until - time.monotonic(), 0.0),
            )
            return not (self._changes or self._stopped)

    def _wait(self) -> bool:
        with self._something:
            self._busy = False
            self._something.notify_all()
            self._something.wait_for(lambda: self._changes or self._stopped)
            self._busy = True
            return not self._stopped

    def _take(self) -> list[Work]:
        with self._something:
            changes = list(self._changes.values())
            self._changes.clear()
            if not self._stopped:
                self._moved_on.clear()
        return changes

    def _do(self, work: Work) -> None:
        try:
            work()
        except Exception as error:
            # One thing that goes wrong must not end the page, nor be told at every movement.
            text = shortened(f"{type(error).__name__}: {error}").partition("\n")[0]
            first = text not in self._told and len(self._told) < FAULTS
            self._told.add(text)
            level = logging.WARNING if first else logging.DEBUG
            debugged = logger.isEnabledFor(logging.DEBUG)
            logger.log(level, "the view could not do what was asked: %s", text, exc_info=debugged)
