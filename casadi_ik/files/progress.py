"""How far something is, shown where a person looks on: on a terminal, or in a notebook."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

PATIENCE = 1.0
"""Seconds after which it is shown."""

SAID_EVERY = 10.0
"""Seconds between two lines where there is nothing to draw a bar on."""


@contextmanager
def progress(
    count: int,
    shown: bool = True,
    done: int = 0,
    say: Callable[[str], object] | None = None,
) -> Iterator[Callable[[int], None]]:
    """Show how far it is, as soon as that takes longer than a second.

    Args:
        count: Targets in all.
        shown: Whether it may be shown.
        done: Of those, done before.
        say: What is called with a line where there is neither a terminal nor a notebook, every ten
            seconds; None: nothing is said there.

    Yields:
        Moves it on by so many targets.
    """
    began = last = time.monotonic()
    total, drawn = done, None
    draw = _bar(count) if shown else None

    def move(more: int) -> None:
        nonlocal total, last, drawn
        total += more
        now = time.monotonic()
        rate = (total - done) / max(now - began, 1e-9)
        if draw is not None and now - began > PATIENCE:
            drawn = draw
            draw(total, rate)
        elif draw is None and say is not None and now - last > SAID_EVERY:
            last = now
            say(f"{total:,} of {count:,} targets, {rate:,.0f} a second{_left(count - total, rate)}")

    try:
        yield move
    finally:
        if drawn is not None:
            drawn(None, 0.0)


def _left(targets: int, rate: float) -> str:
    """How long the rest takes, in words."""
    if rate <= 0:
        return ""
    minutes, seconds = divmod(round(targets / rate), 60)
    if not minutes:
        return f", {seconds} s left"
    hours = f"{minutes // 60} h " if minutes >= 60 else ""
    return f", {hours}{minutes % 60} min left"


def _bar(count: int) -> Callable[[int | None, float], None] | None:
    """What draws a bar, and takes it away for None; None: there is nothing to draw on."""
    if _in_notebook():
        return _notebook(count)
    return _terminal(count) if is_interactive() else None


def is_interactive() -> bool:
    """Return whether there is a notebook or a terminal to show progress on."""
    return _in_notebook() or is_terminal(sys.stderr)


def is_terminal(stream: Any) -> bool:
    """Return whether a stream is a terminal.

    A program may have put any object with a `write` method in place of `sys.stderr`, or None.
    """
    return hasattr(stream, "isatty") and not getattr(stream, "closed", False) and stream.isatty()


def _in_notebook() -> bool:
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return type(shell).__name__ == "ZMQInteractiveShell"


def _notebook(count: int) -> Callable[[int | None, float], None]:
    from IPython.display import HTML, display

    handle: Any = None

    def draw(total: int | None, rate: float) -> None:
        nonlocal handle
        bar = f"<progress value={total} max={count}></progress>"
        shown = HTML("" if total is None else f"{bar} {total:,} of {count:,}, {rate:,.0f}/s")
        if handle is None:
            handle = display(shown, display_id=True)
        else:
            handle.update(shown)

    return draw


def _terminal(count: int) -> Callable[[int | None, float], None]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[speed]}")
    console = Console(file=sys.stderr)
    bar = Progress(*columns, TimeRemainingColumn(), console=console, transient=True)
    task = bar.add_task("", total=count, speed="")

    def draw(total: int | None, rate: float) -> None:
        if total is None:
            bar.stop()
            return
        bar.start()
        bar.update(task, completed=total, speed=f"{rate:,.0f}/s")

    return draw
