"""A copy of the package, for tests that add to it what a page of the docs says."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from processes import ROOT, python


def blocks(page: str, language: str = "python") -> list[str]:
    """The code blocks of a page of the docs."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def package_copy(folder: Path) -> Path:
    """The package, copied into a folder, with the shipped models beside it."""
    package = folder / "package" / "casadi_ik"
    shutil.copytree(ROOT / "casadi_ik", package, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "package" / "models").symlink_to(ROOT / "models")
    return package


def run_with(package: Path, script: str, argument: Path) -> None:
    """Run a script in a process that imports the copy.

    Raises:
        AssertionError: It failed; the message is what it said.
    """
    done = python("-c", script, argument, path=package.parent, cwd=package.parents[1])
    assert done.returncode == 0, done.stderr
