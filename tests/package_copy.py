"""Copy of the package, for tests that follow the additions of the docs."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from processes import ROOT, python


def blocks(page: str, language: str = "python") -> list[str]:
    """Return the code blocks of a page of the docs."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def package_copy(folder: Path) -> Path:
    """Copy the package into a folder, with the shipped models beside it."""
    package = folder / "package" / "casadi_ik"
    shutil.copytree(ROOT / "casadi_ik", package, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "package" / "models").symlink_to(ROOT / "models")
    return package


def run_with(package: Path, script: str, argument: Path) -> None:
    """Run a script in a process that imports the copy.

    Raises:
        AssertionError: The script failed; the message is its output.
    """
    done = python("-c", script, argument, path=package.parent, cwd=package.parents[1])
    assert done.returncode == 0, done.stderr
