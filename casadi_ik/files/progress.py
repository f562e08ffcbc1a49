"""Progress bars for terminals and notebooks, and progress lines for other streams."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

FIRST_DRAW_DELAY = 1.0
"""Time after which a bar appears [s]."""

LINE_INTERVAL = 10.0
"""Time between two progress lines where no bar can be drawn [s]."""


@contextmanager
def progress(
    count: int,
    visible: bool = True,
    done: int = 0,
    say: Callable[[str], object] | None = None,
) -> Iterator[Callable[[int], None]]:
    """Show the progress of work that takes longer than a second.

    Args:
        count: Total number of targets.
        visible: False to draw no bar.
        done: Number of targets that are done already.
        say: Function that is called with a progress line every ten seconds where there is neither a
            terminal nor a notebook; None for no lines.

    Yields:
        A function that advances the progress by a number of targets.
    """
    began = last_line = time.monotonic()
    total, visible_bar = done, None
    draw = _bar(count) if visible else None

    def advance(targets: int) -> None:
        nonlocal total, last_line, visible_bar
        total += targets
        time_now = time.monotonic()
        rate = (total - done) / max(time_now - began, 1e-9)
        if draw is not None and time_now - began > FIRST_DRAW_DELAY:
            visible_bar = draw
            draw(total, rate)
        elif draw is None and say is not None and time_now - last_line > LINE_INTERVAL:
            last_line = time_now
            time_left = _time_left(count - total, rate)
            say(f"{total:,} of {count:,} targets, {rate:,.0f} a second{time_left}")

    try:
        yield advance
    finally:
        if visible_bar is not None:
            visible_bar(None, 0.0)


def _time_left(targets: int, rate: float) -> str:
    """Return the remaining time as text, "" if it is unknown."""
    if rate <= 0:
        return ""
    minutes, seconds = divmod(round(targets / rate), 60)
    if not minutes:
        return f", {seconds} s left"
    hours = f"{minutes // 60} h " if minutes >= 60 else ""
    return f", {hours}{minutes % 60} min left"


def _bar(count: int) -> Callable[[int | None, float], None] | None:
    """Return a function that draws a bar, or removes it for None; None if no bar can be drawn."""
    if _in_notebook():
        return _notebook(count)
    return _terminal(count) if is_interactive() else None


def is_interactive() -> bool:
    """Return True in a notebook, or if stderr is a terminal."""
    return _in_notebook() or is_terminal(sys.stderr)


def is_terminal(stream: Any) -> bool:
    """Return True if a stream is a terminal.

    Programs may replace `sys.stderr` by any object with a `write` method, or by None.
    """
    return hasattr(stream, "isatty") and not getattr(stream, "closed", False) and stream.isatty()


def _in_notebook() -> bool:
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return type(shell).__name__ == "ZMQInteractiveShell"


def _notebook(count: int) -> Callable[[int | None, float], None]:
    """Return a function that draws a progress bar in a notebook, or clears it (None)."""
    from IPython.display import HTML, display

    handle: Any = None

    def draw(total: int | None, rate: float) -> None:
        nonlocal handle
        bar = f"<progress value={total} max={count}></progress>"
        html = HTML("" if total is None else f"{bar} {total:,} of {count:,}, {rate:,.0f}/s")
        if handle is None:
            handle = display(html, display_id=True)
        else:
            handle.update(html)

    return draw


def _terminal(count: int) -> Callable[[int | None, float], None]:
    """Return a function that draws a progress bar on stderr, or removes it (None)."""
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
