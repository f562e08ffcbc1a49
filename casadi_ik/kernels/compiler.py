"""The machine's C compiler."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import warnings
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from casadi_ik.errors import KernelError

# No contraction: with fused multiply-adds the iterates would differ from the VM's. Errno of sqrt
# and friends is never read, and without it they are single instructions of the same value. All
# but the driver is hidden, so that a function named like one of libc cannot be taken for it.
FLAGS = ("-O2", "-fPIC", "-shared", "-ffp-contract=off", "-fno-math-errno", "-fvisibility=hidden")

CANDIDATES = ("cc", "gcc", "clang")

SHOWN_ERROR_LINES = 5


class NoCompilerWarning(RuntimeWarning):
    """There is no C compiler: kernels run in CasADi's virtual machine, about ten times slower."""


@dataclass(frozen=True)
class Compiler:
    """A C compiler that answered.

    Attributes:
        command: Absolute path, then arguments of `CC` if it had any.
        version: The first line of its `--version`.
        flags: Flags of every compilation.
    """

    command: tuple[str, ...]
    version: str
    flags: tuple[str, ...] = FLAGS

    @property
    def identity(self) -> str:
        """What decides the produced code, apart from the source."""
        return "\n".join((*self.command, self.version, *self.flags))

    def build(self, source: Path, library: Path) -> None:
        """Compile one C file to a shared library.

        Raises:
            KernelError: The compiler refused; the message has the first lines of its complaint.
        """
        command = [*self.command, *self.flags, "-o", str(library), str(source), "-lm"]
        try:
            done = subprocess.run(command, capture_output=True, text=True, errors="replace")
        except OSError as error:
            raise KernelError(f"compiler {self.command[0]} cannot be run: {error}") from error
        if done.returncode == 0 and library.is_file():
            return
        lines = done.stderr.splitlines()
        errors = [line for line in lines if "error" in line.lower()] or lines
        complaint = "\n  ".join(errors[:SHOWN_ERROR_LINES])
        raise KernelError(
            f"compiler {shlex.join(self.command)} failed with exit code {done.returncode} "
            "(CC=... names another compiler, CC=none does without):\n"
            f"  {complaint}"
        )


def find_compiler() -> Compiler | None:
    """The compiler of the environment, or None.

    The environment variable `CC` (command and arguments) counts alone if it is set; otherwise the
    first of cc, gcc, clang on the path. A `CC` that does not exist (`CC=none`) is a way to ask for
    the virtual machine. `CASADI_IK_CFLAGS` is appended to the flags.
    """
    return _find(
        os.environ.get("CC", ""),
        os.environ.get("PATH", ""),
        os.environ.get("CASADI_IK_CFLAGS", ""),
    )


@lru_cache(maxsize=16)
def _find(cc: str, path: str, flags: str) -> Compiler | None:
    """`find_compiler` for one environment, remembered because it starts processes."""
    for words in [shlex.split(cc)] if cc.strip() else [[name] for name in CANDIDATES]:
        program = shutil.which(words[0], path=path)
        if program is None:
            continue
        version = _version((program, *words[1:]))
        if version is not None:
            return Compiler((program, *words[1:]), version, flags=(*FLAGS, *shlex.split(flags)))
    return None


def _version(command: tuple[str, ...]) -> str | None:
    """The first line of `--version`, None if the program does not run (macOS has such a stub)."""
    try:
        done = subprocess.run(
            [*command, "--version"], capture_output=True, text=True, errors="replace", timeout=30
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    if done.returncode != 0:
        return None
    return done.stdout.partition("\n")[0]


_warned = False


def warn_no_compiler() -> None:
    """Say once per process that kernels run in the virtual machine."""
    global _warned
    if _warned:
        return
    _warned = True
    found = (
        f"CC={os.environ['CC']!r} does not run"
        if os.environ.get("CC", "").strip()
        else (f"none of {', '.join(CANDIDATES)} is on the path")
    )
    warnings.warn(
        f"no C compiler ({found}): casadi_ik runs in CasADi's virtual machine, with the same "
        "results but about ten times slower",
        NoCompilerWarning,
        stacklevel=2,
    )
