"""Tables of the benchmark: on the terminal and as Markdown, with the machine they are from."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from rich.console import Console
from rich.table import Table

PACKAGES = (
    "casadi-ik",
    "casadi",
    "numpy",
    "pin",
    "proxsuite",
    "scipy",
    "placo",
    "pin-pink",
    "mink",
    "mujoco",
    "daqp",
)


@dataclass(frozen=True)
class Section:
    """One table.

    Attributes:
        title: What is measured.
        columns: Headings.
        rows: Cells, as text.
        note: How, in a sentence or two.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""

    def show(self) -> None:
        """Print it."""
        table = Table(*self.columns, title=self.title, caption=self.note)
        for row in self.rows:
            table.add_row(*row)
        Console().print(table)

    def markdown(self) -> str:
        """It as Markdown."""
        lines = [f"## {self.title}", "", self.note, ""] if self.note else [f"## {self.title}", ""]
        lines += ["| " + " | ".join(self.columns) + " |", "|---" * len(self.columns) + "|"]
        lines += ["| " + " | ".join(row) + " |" for row in self.rows]
        return "\n".join(lines)


def write_report(
    path: Path, command: str, sections: Sequence[Section], title: str = "Benchmark"
) -> None:
    """Write all sections with command, date, machine and versions."""
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    head = [
        f"# {title}",
        "",
        f"`{command}`, {datetime.now(UTC):%Y-%m-%d}. {_processor()}, {os.cpu_count()} cores, "
        f"{platform.system()}, Python {platform.python_version()}; load at the end {load}.",
        "",
        "Machines differ and are noisy: quote the ratios, not the microseconds. Where it says CPU, "
        "the time is that of the measured thread alone, as little disturbed by others as can be.",
        "",
        ", ".join(f"{name} {found}" for name in PACKAGES if (found := _version(name))) + ".",
        "",
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    text = "\n".join(head) + "\n" + "\n\n".join(section.markdown() for section in sections) + "\n"
    path.write_text(text, encoding="utf-8")


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
