"""The table of studies: what each asks, and of which day and commit its report is."""

from __future__ import annotations

import os
import re
import subprocess
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "studies" / "results"


def results_table() -> str:
    """A Markdown table with a row per report in studies/results."""
    rows = ["| report | date | commit |", "|---|---|---|"]
    for report in _reports():
        day, commit = _last_change(report)
        name = report.parent.relative_to(FOLDER).as_posix()
        link = os.path.relpath(report, ROOT / "docs")
        rows.append(f"| [{titles()[name]}]({link}) | {day} | {commit} |")
    return "\n".join(rows)


def _reports() -> list[Path]:
    found = [*FOLDER.rglob("report.md"), *FOLDER.rglob("README.md")]
    return sorted(found, key=lambda report: report.parent)


@cache
def titles() -> dict[str, str]:
    """The heading of every report by its folder's name; of several alike, with what differs."""
    found: dict[str, str] = {}
    for report in _reports():
        lines = report.read_text(encoding="utf-8").splitlines()
        heading = next((line[2:].strip() for line in lines if line.startswith("# ")), "")
        name = report.parent.relative_to(FOLDER).as_posix()
        taken = not heading or heading in found.values()
        words = name.rpartition("/")[2].replace("_", " ")
        found[name] = f"{heading} ({words})".lstrip() if taken else heading
    return found


def retitled(docname: str, text: str) -> str:
    """A report under the title that tells it from others."""
    name = docname.removeprefix("studies/results/").rpartition("/")[0]
    return re.sub(r"^# .*$", lambda _: f"# {titles()[name]}", text, count=1, flags=re.MULTILINE)


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
