"""Somebody's macros and MJCF are read by a process of its own, which may die of them."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

from casadi_ik.errors import DescriptionError, MissingExtraError
from casadi_ik.files.limits import LIMITS, RAISED, limit
from casadi_ik.robots.robot_files import foreign

MACROS = "xacro"
MODEL = "mujoco"


def confined(what: str, path: Path) -> bytes:
    """What a file becomes.

    Args:
        what: `MACROS`: the text with its macros expanded. `MODEL`: MuJoCo's model as it saves one.
        path: The file.

    Raises:
        DescriptionError: It cannot be read, asks for what is not done, or for too much.
        MissingExtraError: xacro or MuJoCo is not installed.
    """
    if find_spec(what) is None:
        noun = "has xacro macros" if what == MACROS else "is MJCF"
        raise MissingExtraError(f"{path}: {noun}; to read it: pip install 'casadi-ik[{what}]'")
    seconds, doing = limit(LIMITS.reader_seconds), "expand" if what == MACROS else "read"
    limits = (seconds, limit(LIMITS.reader_memory), limit(LIMITS.reader_output))
    # Not the script's folder, whose modules are called as some of others are.
    script, place = Path(foreign.__file__).resolve(), path.resolve()
    command = [sys.executable, "-P", str(script), what, str(place), *map(str, limits)]
    known = os.pathsep.join(str(Path(one).resolve()) for one in sys.path)
    try:
        with tempfile.TemporaryDirectory() as folder:  # MuJoCo keeps a log where it runs
            done = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                cwd=folder,
                env=os.environ | {"PYTHONPATH": known},
                timeout=LIMITS.reader_patience * seconds,
                check=False,
            )
    except subprocess.TimeoutExpired:
        code, said = 1, b""
    except (OSError, ValueError) as error:
        raise DescriptionError(f"{path}: no process to read it: {error}") from error
    else:
        code, said = done.returncode, done.stdout
    if code == 0:
        return said
    reason = f"takes more than {seconds} s of computing or {limits[1] >> 20} MiB {RAISED}"
    if code == foreign.REFUSED:
        reason = " ".join(said.decode(errors="replace").split())
    raise DescriptionError(f"{path}: {what} cannot {doing} it: {reason}")
