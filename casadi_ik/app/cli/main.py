"""Entry point of the command line: signals, output to the terminal, exit codes."""

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
    from argparse import Namespace as Arguments

    from rich.console import RenderableType


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments after the name of the program; None means those of the process.

    Returns:
        0 done or solved, 1 valid problem not solved, 2 bad input (one line on stderr),
        130 interrupted, 143 terminated, 141 reader of stdout gone. Unexpected errors are raised.
    """
    with _Signals(whole_process=argv is None) as signals:
        try:
            return _run(sys.argv[1:] if argv is None else argv)
        except KeyboardInterrupt as error:
            signals.is_finished = True
            is_sigterm = isinstance(error, Terminated)
            reason = "terminated" if is_sigterm else "interrupted"
            print(f"casadi-ik: error: {reason}", file=sys.stderr)  # noqa: T201
            return 128 + (signal.SIGTERM if is_sigterm else signal.SIGINT)


def _run(words: Sequence[str]) -> int:
    # Imported after the signal handlers are installed, so that Ctrl-C during the import also ends
    # in one line.
    """Run a command and return its exit code."""
    from casadi_ik.app.cli.outputs import print_message
    from casadi_ik.app.cli.table import Exit, parse

    def show_warning(message: Warning | str, *_: object, **__: object) -> None:
        """Print a warning as one line, without the source line that Python adds."""
        print_message("warning", str(message))

    with warnings.catch_warnings():
        warnings.showwarning = show_warning
        try:
            run, args = parse(words)
            with _environment(args):
                result = run(args)
                _show(result.report)
                if result.epilogue is not None:
                    result.epilogue()
            return result.exit
        except CasadiIKError as error:
            print_message("error", str(error))
            return Exit.BAD_INPUT
        except BrokenPipeError:
            return Exit.BROKEN_PIPE


class Terminated(KeyboardInterrupt):
    """Exception raised on SIGTERM.

    It is a KeyboardInterrupt, so that code that removes its files on Ctrl-C also does so on
    SIGTERM.
    """


class _Signals:
    """Context manager that turns Ctrl-C and the first SIGTERM into exceptions.

    Signals that the calling program handles or ignores are not changed. A signal that arrives while
    CasADi code runs is delayed: CasADi swallows an exception raised while it converts arguments, or
    reports it as a wrong argument.

    Attributes:
        is_finished: True once the command has ended; further signals are ignored.
    """

    DEFAULT_HANDLERS: ClassVar = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
    }

    def __init__(self, whole_process: bool) -> None:
        """Initialise; `whole_process` is True if the process ends after the block."""
        self.is_finished = False
        self._terminated = False
        self._delayed: threading.Timer | None = None
        self._whole_process = whole_process
        main_thread = threading.current_thread() is threading.main_thread()
        self._handled = [
            number
            for number, default in self.DEFAULT_HANDLERS.items()
            if main_thread and signal.getsignal(number) is default
        ]

    def __enter__(self) -> _Signals:
        for number in self._handled:
            signal.signal(number, self._stop)
        return self

    def __exit__(self, *_: object) -> None:
        if self._delayed is not None:
            self._delayed.cancel()
        # Python restores the default handlers before the process ends; a signal after that would
        # change the exit code, so signals are ignored from here on.
        is_ignored = self.is_finished and self._whole_process
        for number in self._handled:
            default = self.DEFAULT_HANDLERS[number]
            signal.signal(number, signal.SIG_IGN if is_ignored else default)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt, but only once CasADi has returned to its caller."""
        if self.is_finished or (self._terminated and number == signal.SIGTERM):
            return
        while frame is not None:
            if frame.f_globals.get("__name__") == "casadi.casadi":
                self._delayed = threading.Timer(0.02, signal.raise_signal, [number])
                self._delayed.daemon = True
                self._delayed.start()
                return
            frame = frame.f_back
        if number == signal.SIGTERM:
            self._terminated = True
            raise Terminated
        raise KeyboardInterrupt


def _show(report: RenderableType) -> None:
    """Print a report; without colours and 80 columns wide unless stdout is a terminal.

    Raises:
        CasadiIKError: stdout cannot be written.
        BrokenPipeError: The reader of stdout has closed it.
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
    """Print the parts of a report on stdout."""
    from rich.console import Console, ConsoleOptions
    from rich.segment import Segment

    class Terminal(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

        def render(
            self, renderable: RenderableType, options: ConsoleOptions | None = None
        ) -> Iterable[Segment]:
            """Escape control characters, which names from untrusted files may contain."""
            for segment in super().render(renderable, options):
                yield segment if segment.control else segment._replace(text=printable(segment.text))

    Terminal(markup=False, emoji=False, highlight=False).print(report, crop=False)


def _abandon_stdout() -> None:
    """Redirect stdout to the null device, so that the flush at exit does not fail again."""
    null_device = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null_device, sys.stdout.fileno())
    os.close(null_device)


@contextmanager
def _environment(args: Arguments) -> Iterator[None]:
    """Set the environment variables of options, also for child processes."""
    from casadi_ik.app.drawing import MESHES_VARIABLE
    from casadi_ik.files.limits import LIMITS_VARIABLE

    changes: dict[str, str] = {}
    if (factor := getattr(args, "size_limits", None)) is not None:
        changes[LIMITS_VARIABLE] = repr(factor)
    if not getattr(args, "meshes", True):
        changes[MESHES_VARIABLE] = "off"
    previous = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in previous.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
