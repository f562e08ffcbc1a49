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

from casadi_ik.cli.outputs import OutputError, say
from casadi_ik.cli.table import Exit, parse
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
    with warnings.catch_warnings(), _stoppable(whole_process=argv is None):
        warnings.showwarning = _show_warning
        try:
            run, said = parse(sys.argv[1:] if argv is None else argv)
            with _size_limits(getattr(said, "size_limits", None)):
                answer = run(said)
            _show(answer.report)
            return answer.exit
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
            return Exit.BROKEN_PIPE


class Terminated(KeyboardInterrupt):
    """SIGTERM came: what handles Ctrl-C keeps or removes files as it does there."""


@contextmanager
def _stoppable(whole_process: bool) -> Iterator[None]:
    """Ctrl-C and SIGTERM raise in the block, once: what then tidies up is not disturbed again.

    A signal that the program around us handles or ignores is left alone.

    Args:
        whole_process: Whether nothing comes after the block but the end of the process, which is
            not disturbed either.
    """
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    main_thread = threading.current_thread() is threading.main_thread()
    ours = [one for one in usual if main_thread and signal.getsignal(one) is usual[one]]

    def stop(number: int, _: object) -> None:
        for one in ours:
            signal.signal(one, signal.SIG_IGN)
        raise Terminated if number == signal.SIGTERM else KeyboardInterrupt

    for one in ours:
        signal.signal(one, stop)
    try:
        yield
    finally:
        for one in ours if not whole_process else ():
            signal.signal(one, usual[one])


def _show(report: RenderableType) -> None:
    """Print a report; plain and 80 columns wide where stdout is no terminal.

    Raises:
        OutputError: It cannot be printed.
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
        raise OutputError(f"<stdout>: cannot be written: {error.strerror}") from error


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


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """A warning as one line, without the place in the code that Python adds."""
    say("warning", str(message))
