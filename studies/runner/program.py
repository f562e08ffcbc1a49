"""A study as a program: its command, and how it ends when it cannot go on."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from casadi_ik.errors import CasadiIKError


def program(main: Callable[[], None]) -> None:
    """Run a study's `main`; bad input ends it with one line and exit code 2."""
    try:
        main()
    except CasadiIKError as error:
        sys.exit(_refused(str(error)))
    except KeyboardInterrupt:
        print("stopped; the same command goes on", file=sys.stderr)
        sys.exit(130)


def _refused(text: str) -> int:
    print(f"{Path(sys.argv[0]).name}: error: {text}", file=sys.stderr)
    return 2


def command(script: str, arguments: Sequence[str] | None) -> str:
    """The command that was run, as a shell takes it.

    Args:
        script: `__file__` of the study.
        arguments: What its `main` was given; None: the words of the process.
    """
    words = sys.argv[1:] if arguments is None else arguments
    return shlex.join(["python", f"studies/{Path(script).name}", *map(str, words)])
