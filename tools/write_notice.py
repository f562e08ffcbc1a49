"""The file NOTICE: origin of the built-in robots and licences of the sources.

    python tools/write_notice.py

writes it from the tables of docs/robots_origin.md. Wheel and source archive contain it.
"""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

ROOT = Path(__file__).parents[1]

HEADER = """casadi_ik
Copyright (c) 2026, the casadi_ik developers
BSD 3-Clause License, see LICENSE

The descriptions of robots in models/ (in the wheel: casadi_ik/models/) were written for this
project: dimensions, axes, ranges, velocities, and capsules and boxes fitted to the shape of each
link. They contain no file, mesh or picture of others. This file names the sources with which the
numbers of each robot were compared, or to which shapes were fitted, and the licences that these
sources state. The key `sources` of each description names file and commit. Trade marks belong to
the makers of the robots, who are not connected with this project.
"""


def notice() -> str:
    """Return the text of the file."""
    page = (ROOT / "docs" / "robots_origin.md").read_text(encoding="utf-8")
    robot_part, licence_part = page.split("## Licences")
    robots = re.findall(r"^\| `(\S+)` \| (.*?) \| (.*?) \|$", robot_part, re.MULTILINE)
    licences = re.findall(r"^\| (\S+/?\S*) \| (.*) \|$", licence_part, re.MULTILINE)
    licence_of = {name: text for name, text in licences if name != "source"}
    parts = [HEADER]
    for name, title, sources in robots:
        lines = [f"{name}: {title}"]
        for source in sources.split(", "):
            licence = licence_of.get(source)
            lines.append(f"- {source}: {licence}" if licence else f"- {source}")
        parts.append("\n".join(map(_wrapped, lines)) + "\n")
    return "\n".join(parts)


def _wrapped(line: str) -> str:
    indent = "  " if line.startswith("- ") else ""
    return textwrap.fill(line.replace("`", ""), 96, subsequent_indent=indent)


if __name__ == "__main__":
    (ROOT / "NOTICE").write_text(notice(), encoding="utf-8")
