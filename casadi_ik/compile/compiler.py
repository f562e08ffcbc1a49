"""C compilers: discovery, flags, and compilation of one file to a shared library."""

from __future__ import annotations

import contextlib
import errno
import importlib.util
import os
import shlex
import shutil
import signal
import subprocess
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from casadi_ik.compile.cancellation import SLICE, stop_if_cancelled
from casadi_ik.errors import KernelError
from casadi_ik.files.progress import is_terminal

# No contraction: fused multiply-adds would change iterates compared with the virtual machine. errno
# of math functions is not read; without it, sqrt is one instruction with the same result. All
# symbols except entry points are hidden, so that they cannot replace functions of libc.
FLAGS = ("-fPIC", "-shared", "-ffp-contract=off", "-fno-math-errno", "-fvisibility=hidden")

LEVEL = ("-O2",)
"""Optimization level. With -O1, compilation takes 75 % of the time and `fast` is 6 to 8 % slower;
results are the same bit for bit."""

CANDIDATES = ("cc", "gcc", "clang")

ZIG = ("-m", "ziglang", "cc", "-mcpu=baseline", "-fno-sanitize=all")
"""Arguments of the compiler in the Python package ziglang: portable code, as gcc generates."""

SHOWN_ERROR_LINES, SHOWN_CHARACTERS = 3, 200
"""Maximum number of lines, and of characters per line, of a compiler's errors in a message."""

DISK_FULL_CODES = (errno.ENOSPC, errno.EDQUOT) if hasattr(errno, "EDQUOT") else (errno.ENOSPC,)

MIN_FREE_BYTES = 2**20
"""Free space below which a failed compilation counts as a full disk [bytes]."""


class NoCompilerWarning(RuntimeWarning):
    """Warning that kernels run in CasADi's virtual machine for lack of a compiler, and are slow."""


class UnloadableError(KernelError):
    """A compiled library cannot be loaded."""


@dataclass(frozen=True)
class Compiler:
    """A working C compiler.

    Attributes:
        command: Absolute path, and the arguments in `CC`.
        version: First line of the output of `--version`.
        flags: Flags of every compilation.
    """

    command: tuple[str, ...]
    version: str
    flags: tuple[str, ...] = FLAGS

    @property
    def identity(self) -> str:
        """Text that identifies the produced code, apart from the source."""
        return "\n".join((*self.command, self.version, *LEVEL, *self.flags))

    def build(self, source: Path, library: Path) -> None:
        """Compile one C file to a shared library.

        Args:
            source: Path of the C file.
            library: Path of the library; temporary files of the compiler are in the same folder.

        Raises:
            KernelError: Compiling failed; the message has the first lines of the compiler's errors.
            OSError: The disk is full.
            KeyboardInterrupt: Ctrl-C reached the compiler.
            CancelledError: The work of this thread is cancelled.
        """
        command = [*self.command, *LEVEL, *self.flags, "-o", str(library), str(source), "-lm"]
        environment = {"TMPDIR": str(library.parent), "LC_ALL": "C"}
        try:
            done = _run(command, os.environ | environment)
        except OSError as error:
            raise KernelError(f"compiler {self.command[0]} cannot be run: {error}") from error
        if done.returncode == 0 and library.is_file():
            return
        if done.returncode == -signal.SIGINT:
            raise KeyboardInterrupt
        if _disk_is_full(library.parent, done.stderr):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(library.parent))
        lines = done.stderr.splitlines()
        errors = [line for line in lines if "error" in line.lower()] or lines or ["no message"]
        complaint = "; ".join(line[:SHOWN_CHARACTERS] for line in errors[:SHOWN_ERROR_LINES])
        ended = (
            f"failed with {_describe_exit(done.returncode)}"
            if done.returncode
            else "produced no library"
        )
        raise KernelError(
            f"compiler {self} {ended} "
            f"(set CC to another compiler, or CC=none to use none): {complaint}"
        )

    def __str__(self) -> str:
        return shlex.join(self.command)[:SHOWN_CHARACTERS]


def _run(
    command: Sequence[str], environment: Mapping[str, str]
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, or until the work of this thread is cancelled."""
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        env=environment,
    )
    with process:
        try:
            while True:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    output, complaint = process.communicate(timeout=SLICE)
                    break
                stop_if_cancelled()
        except BaseException:
            process.kill()
            raise
    return subprocess.CompletedProcess(command, process.returncode, output, complaint)


def _describe_exit(code: int) -> str:
    """Describe how a process ended."""
    try:
        return signal.Signals(-code).name if code < 0 else f"exit code {code}"
    except ValueError:
        return f"exit code {code}"


def _disk_is_full(directory: Path, complaint: str) -> bool:
    """Return True if a compiler failed because the disk is full."""
    if any(os.strerror(code) in complaint for code in DISK_FULL_CODES):
        return True
    return shutil.disk_usage(directory).free < MIN_FREE_BYTES


def find_compiler() -> Compiler | None:
    """Return the compiler of the environment; None if there is none.

    If the environment variable `CC` (command and arguments) is set, only it is tried; otherwise cc,
    gcc and clang on the path, then the Python package ziglang (extra `compiler`). A `CC` that does
    not exist (`CC=none`) selects the virtual machine. `CASADI_IK_CFLAGS` is appended to the flags.
    """
    return _find_cached(
        os.environ.get("CC", ""),
        os.environ.get("PATH", ""),
        os.environ.get("CASADI_IK_CFLAGS", ""),
    )


@lru_cache(maxsize=16)
def _find_cached(cc: str, path: str, flags: str) -> Compiler | None:
    """Return the compiler of one environment; cached, since it starts processes."""
    try:
        extra_flags = shlex.split(flags)
    except ValueError as error:
        raise KernelError(f"CASADI_IK_CFLAGS={flags[:SHOWN_CHARACTERS]!r}: {error}") from error
    try:
        commands = [shlex.split(cc)] if cc.strip() else [[name] for name in CANDIDATES] + _zig()
    except ValueError:  # a quotation without an end
        return None
    for words in commands:
        program = shutil.which(words[0], path=path)
        if program is None:
            continue
        version = _version((program, *words[1:]))
        if version is not None:
            return Compiler((program, *words[1:]), version, flags=(*FLAGS, *extra_flags))
    return None


def _quotation_hint() -> str:
    """Return a hint for CC if it is the path of a program and has a blank, or an open quotation."""
    cc = os.environ.get("CC", "").strip()
    try:
        words = shlex.split(cc)
    except ValueError as error:
        return f" ({str(error).lower()})"
    pieces = cc.split(" ")
    for count in range(2, len(pieces) + 1 if len(words) > 1 else 0):
        program = " ".join(pieces[:count])
        if Path(program).is_file():
            return f'; quote the path for its blank: CC="{shlex.quote(program)}"'
    return ""


def _zig() -> list[list[str]]:
    """Return the command of ziglang, if it is installed."""
    is_installed = importlib.util.find_spec("ziglang") is not None and bool(sys.executable)
    return [[sys.executable, *ZIG]] if is_installed else []


def _version(command: tuple[str, ...]) -> str | None:
    """Return the first line of `--version`; None if the program does not run (a stub on macOS)."""
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


def warn_no_compiler(problem: str = "") -> None:
    """Warn once per process that kernels run in the virtual machine.

    Args:
        problem: The reason; "": there is no compiler.
    """
    global _warned
    if _warned:
        return
    _warned = True
    reason = problem or (
        f"CC={os.environ['CC'][:SHOWN_CHARACTERS]!r} does not run{_quotation_hint()}"
        if os.environ.get("CC", "").strip()
        else (
            f"none of {', '.join(CANDIDATES)} is on the path; "
            "pip install 'casadi-ik[compiler]' brings one"
        )
    )
    warnings.warn(
        f"no C compiler ({reason}): casadi_ik runs in CasADi's virtual machine, with the same "
        "results but about 20 times slower, batches 60 times",
        NoCompilerWarning,
        stacklevel=2,
    )


POLICY = "CASADI_IK_COMPILE"
BACKGROUND, WAIT = "background", "wait"


def waits_for_compiler() -> bool:
    """Return True if the first solve of a robot waits for the compiler.

    Raises:
        KernelError: The environment variable has another value.
    """
    policy = os.environ.get(POLICY) or BACKGROUND
    if policy not in (BACKGROUND, WAIT):
        raise KernelError(
            f"{POLICY}={policy[:SHOWN_CHARACTERS]!r}: expected {BACKGROUND} or {WAIT}"
        )
    return policy == WAIT


def print_note(text: str) -> None:
    """Write a line about a compilation to stderr; to terminals only if the caller waits for it."""
    stream = sys.stderr
    if stream is not None and (not waits_for_compiler() or is_terminal(stream)):
        print(text, file=stream, flush=hasattr(stream, "flush"))


def announce(name: str, size: int) -> None:
    """Print the name of a kernel and its expected compile time, if that exceeds 2 s.

    Args:
        name: Name of the kernel.
        size: Length of its C text [characters].
    """
    # Measured: 150,000 to 280,000 characters of C per second.
    if (seconds := size / 200_000) >= 2.0:
        print_note(f"compiling {name} (about {seconds:.0f} s, once per machine)")
