"""What a page is asked to do, done in a thread of its own: of each thing only the newest.

Whoever drags sends twenty changes a second, whatever a solve takes. Each change has a key; one that
was not begun when another of its key comes is dropped. The thread that talks to the browsers only
ever puts a change down and goes on.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

logger = logging.getLogger(__name__)

Work = Callable[[], None]


class Newest:
    """A thread that does the newest change of every key, then draws, then what can wait."""

    def __init__(self, refresh: Work, later: tuple[Work, ...] = ()) -> None:
        """Start it.

        Args:
            refresh: Called after changes, once for all that were waiting.
            later: Called after that one by one, as long as nothing new comes.
        """
        self._refresh, self._later = refresh, later
        self._changes: dict[str, Work] = {}
        self._something = threading.Condition()
        self._busy = self._stopped = False
        self.dropped = 0
        self._thread = threading.Thread(target=self._run, name="casadi-ik view", daemon=True)
        self._thread.start()

    def put(self, key: str, change: Work) -> None:
        """Ask for a change; returns at once."""
        with self._something:
            if self._changes.pop(key, None) is not None:
                self.dropped += 1
            self._changes[key] = change
            self._something.notify_all()

    def settle(self, seconds: float = 30.0) -> bool:
        """Wait until everything is done; False if it takes longer."""
        with self._something:
            return self._something.wait_for(lambda: not (self._busy or self._changes), seconds)

    def stop(self) -> None:
        """End the thread after what it is doing."""
        with self._something:
            self._stopped = True
            self._something.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(10.0)

    def _run(self) -> None:
        while self._wait():
            changes = self._take()
            for change in changes:
                self._do(change)
            self._do(self._refresh)
            for work in self._later:
                with self._something:
                    if self._changes or self._stopped:
                        break
                self._do(work)

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
        return changes

    def _do(self, work: Work) -> None:
        try:
            work()
        except Exception:
            # One thing that goes wrong must not end the page.
            logger.exception("the view could not do what was asked")
