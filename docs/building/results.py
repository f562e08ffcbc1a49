"""The table of studies: what each asks, and of which day and commit its report is."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[2]


def results_table() -> str:
    """A Markdown table with a row per report in studies/results."""
    rows = ["| study | report of | commit |", "|---|---|---|"]
    folder = ROOT / "studies" / "results"
    for report in sorted([*folder.rglob("report.md"), *folder.rglob("README.md")]):
        day, commit = _last_change(report)
        name = report.parent.relative_to(folder).as_posix()
        link = os.path.relpath(report, ROOT / "docs")
        rows.append(f"| [{title(report)}]({link}) `{name}` | {day} | {commit} |")
    return "\n".join(rows)


def title(page: Path) -> str:
    """The first heading of a page."""
    lines = page.read_text().splitlines()
    return next((line[2:].strip() for line in lines if line.startswith("# ")), page.parent.name)


def _last_change(path: Path) -> tuple[str, str]:
    """Day and commit of a file's last change; dashes outside a repository."""
    command = ["git", "log", "-1", "--format=%cs %h", "--", str(path)]
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "-", "-"
    day, _, commit = done.stdout.strip().partition(" ")
    # Hyphens at which no line is broken.
    return day.replace("-", "\u2011") or "-", f"`{commit}`" if commit else "-"
