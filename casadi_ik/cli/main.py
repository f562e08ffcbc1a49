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
from typing import TYPE_CHECKING

from casadi_ik.cli.answer import Exit
from casadi_ik.cli.outputs import OutputError
from casadi_ik.cli.parser import build_parser
from casadi_ik.cli.say import say
from casadi_ik.errors import CasadiIKError, printable
from casadi_ik.files.limits import VARIABLE

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
    with warnings.catch_warnings(), _terminated_like_interrupted():
        warnings.showwarning = _show_warning
        try:
            return _run(argv)
        except CasadiIKError as error:
            say("error", str(error))
            return Exit.BAD_INPUT
        except Terminated:
            say("error", "terminated")
            return Exit.TERMINATED
        except KeyboardInterrupt:
            say("error", "interrupted")
            return Exit.INTERRUPTED
        except BrokenPipeError:
            _abandon_stdout()
            return Exit.BROKEN_PIPE


class Terminated(KeyboardInterrupt):
    """SIGTERM came: what handles Ctrl-C keeps or removes files as it does there."""


@contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """Raise `Terminated` on SIGTERM inside the block, unless the program around us handles it."""

    def terminate(*_: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once is enough
        raise Terminated

    ours = (
        threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    )
    if ours:
        signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _run(argv: Sequence[str] | None) -> Exit:
    try:
        arguments = build_parser().parse_args(argv)
    except SystemExit:  # --help and --version have been printed
        if sys.stdout is not None:
            sys.stdout.flush()
        raise
    with _limits(getattr(arguments, "size_limits", None)):
        answer = arguments.run(arguments)
    try:
        _show(answer.report)
    except BrokenPipeError:
        raise
    except OSError as error:
        _abandon_stdout()
        raise OutputError(f"<stdout>: cannot be written: {error.strerror}") from error
    return answer.exit


@contextmanager
def _limits(factor: float | None) -> Iterator[None]:
    """All limits of files times a factor meanwhile, in what is started as well."""
    before = os.environ.get(VARIABLE)
    if factor is not None:
        os.environ[VARIABLE] = repr(factor)
    try:
        yield
    finally:
        if factor is not None:
            del os.environ[VARIABLE]
        if before is not None:
            os.environ[VARIABLE] = before


def _show(report: RenderableType) -> None:
    """Print a report; plain and 80 columns wide where stdout is no terminal."""
    if sys.stdout is None:  # closed by the shell: >&-
        return
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

    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    console = Terminal(markup=False, emoji=False, highlight=False)
    console.print(report, crop=False)
    sys.stdout.flush()


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """A warning as one line, without the place in the code that Python adds."""
    say("warning", str(message))


def _abandon_stdout() -> None:
    """Point stdout nowhere, so that the interpreter's own flush at exit has nothing to say."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)
