"""How far a batch is: a bar on a terminal, elsewhere a line now and then."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TimeRemainingColumn,
)
from rich.text import Text

from casadi_ik.cli.say import say

EVERY = 10.0
"""Seconds from one line to the next."""


@contextmanager
def progress(count: int, done: int = 0) -> Iterator[Callable[[int], None]]:
    """A bar with rate and remaining time; calling what it yields moves it on by so many targets.

    Args:
        count: Targets in all.
        done: Of those, solved before.
    """
    console = Console(file=sys.stderr)
    if not console.is_terminal:
        yield _Lines(count, done)
        return
    parts = BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn()
    with Progress(*parts, console=console, transient=True) as bar:
        task = bar.add_task("", total=count, completed=done)
        yield lambda solved: bar.advance(task, solved)


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text("" if task.speed is None else f"{task.speed:,.0f}/s")


class _Lines:
    """Says on stderr every `EVERY` seconds how many targets are solved."""

    def __init__(self, count: int, done: int) -> None:
        self._count, self._done, self._before = count, done, done
        self._began = self._said = time.monotonic()

    def __call__(self, solved: int) -> None:
        self._done += solved
        now = time.monotonic()
        if now - self._said < EVERY:
            return
        self._said = now
        rate = (self._done - self._before) / (now - self._began)
        text = f"{self._done:,} of {self._count:,} targets, {rate:,.0f} a second"
        if rate > 0:
            text += f", {duration_left((self._count - self._done) / rate)} left"
        say("progress", text)


def duration_left(seconds: float) -> str:
    """Seconds as hours, minutes and seconds, the first two that count."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
