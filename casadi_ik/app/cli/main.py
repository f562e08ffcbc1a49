"""Entry point: one command in, an exit code out."""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, ClassVar

from casadi_ik.errors import CasadiIKError, printable

if TYPE_CHECKING:
    from rich.console import RenderableType


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments behind the program's name; None takes those of the process.

    Returns:
        0 done or solved, 1 a valid problem not solved, 2 bad input (one line on stderr),
        130 interrupted, 143 terminated, 141 the reader of stdout went away. What no one foresaw is
        raised.
    """
    with _Signals(whole_process=argv is None) as signals:
        try:
            return _run(sys.argv[1:] if argv is None else argv)
        except KeyboardInterrupt as stopped:
            signals.over = True
            terminated = isinstance(stopped, Terminated)
            word = "terminated" if terminated else "interrupted"
            print(f"casadi-ik: error: {word}", file=sys.stderr)  # noqa: T201
            return 128 + (signal.SIGTERM if terminated else signal.SIGINT)


def _run(words: Sequence[str]) -> int:
    # Here, so that Ctrl-C while they are imported is said in one line, too.
    from casadi_ik.app.cli.outputs import say
    from casadi_ik.app.cli.table import Exit, parse

    def show_warning(message: Warning | str, *_: object, **__: object) -> None:
        """A warning as one line, without the place in the code that Python adds."""
        say("warning", str(message))

    with warnings.catch_warnings():
        warnings.showwarning = show_warning
        try:
            run, said = parse(words)
            with _size_limits(getattr(said, "size_limits", None)):
                answer = run(said)
            _show(answer.report)
            if answer.after is not None:
                answer.after()
            return answer.exit
        except CasadiIKError as error:
            say("error", str(error))
            return Exit.BAD_INPUT
        except BrokenPipeError:
            return Exit.BROKEN_PIPE


class Terminated(KeyboardInterrupt):
    """SIGTERM came: what handles Ctrl-C keeps or removes files as it does there."""


class _Signals:
    """Ctrl-C and SIGTERM raise inside the block, until it is over; a second SIGTERM does not.

    A signal that the program around us handles or ignores is left alone. One that comes while
    CasADi is at work waits: what is raised while it converts arguments is swallowed there, or taken
    for a wrong argument.

    Attributes:
        over: Whether nothing is to be stopped any more: the block is about to be left.
    """

    USUAL: ClassVar = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}

    def __init__(self, whole_process: bool) -> None:
        """Take whether nothing comes after the block but the end of the process."""
        self.over = False
        self._terminated = False
        self._waiting: threading.Timer | None = None
        self._whole_process = whole_process
        main_thread = threading.current_thread() is threading.main_thread()
        self._ours = [one for one, of in self.USUAL.items() if signal.getsignal(one) is of]
        self._ours = self._ours if main_thread else []

    def __enter__(self) -> _Signals:
        for one in self._ours:
            signal.signal(one, self._stop)
        return self

    def __exit__(self, *_: object) -> None:
        if self._waiting is not None:
            self._waiting.cancel()
        # Where a handler is left, Python has the default back before the process has ended.
        ignored = self.over and self._whole_process
        for one in self._ours:
            signal.signal(one, signal.SIG_IGN if ignored else self.USUAL[one])

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self.over or (self._terminated and number == signal.SIGTERM):
            return
        while frame is not None:
            if frame.f_globals.get("__name__") == "casadi.casadi":
                self._waiting = threading.Timer(0.02, signal.raise_signal, [number])
                self._waiting.daemon = True
                self._waiting.start()
                return
            frame = frame.f_back
        if number == signal.SIGTERM:
            self._terminated = True
            raise Terminated
        raise KeyboardInterrupt


def _show(report: RenderableType) -> None:
    """Print a report; plain and 80 columns wide where stdout is no terminal.

    Raises:
        CasadiIKError: It cannot be printed.
        BrokenPipeError: Whoever read it went away.
    """
    if sys.stdout is None:  # closed by the shell: >&-
        return
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    try:
        if isinstance(report, str):
            sys.stdout.write(report)
        else:
            _render(report)
        sys.stdout.flush()
    except BrokenPipeError:
        _abandon_stdout()
        raise
    except OSError as error:
        _abandon_stdout()
        raise CasadiIKError(f"<stdout>: cannot be written: {error.strerror}") from error


def _render(report: RenderableType) -> None:
    from rich.console import Console, ConsoleOptions
    from rich.segment import Segment

    class Terminal(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

        def render(
            self, renderable: RenderableType, options: ConsoleOptions | None = None
        ) -> Iterable[Segment]:
            """Names may come from any file: none of them writes to the terminal what it likes."""
            for segment in super().render(renderable, options):
                yield segment if segment.control else segment._replace(text=printable(segment.text))

    Terminal(markup=False, emoji=False, highlight=False).print(report, crop=False)


def _abandon_stdout() -> None:
    """Point stdout nowhere, so that the interpreter's own flush at exit has nothing to say."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)


@contextmanager
def _size_limits(factor: float | None) -> Iterator[None]:
    """All limits of files times a factor meanwhile, in what is started as well."""
    from casadi_ik.files.limits import LIMITS_VARIABLE

    before = os.environ.get(LIMITS_VARIABLE)
    if factor is not None:
        os.environ[LIMITS_VARIABLE] = repr(factor)
    try:
        yield
    finally:
        if factor is not None:
            del os.environ[LIMITS_VARIABLE]
        if before is not None:
            os.environ[LIMITS_VARIABLE] = before
