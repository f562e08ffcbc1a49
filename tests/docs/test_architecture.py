"""The page on architecture names existing files, and its limits of additions hold."""

from __future__ import annotations

import re

from processes import ROOT

PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


def rows(title: str) -> list[list[str]]:
    """Return the cells of the first table below a heading, without its header."""
    section = PAGE.split(f"## {title}\n", 1)[1].split("\n## ", 1)[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_solve_spans_at_most_eight_files() -> None:
    files = [re.sub("`", "", row[0]) for row in rows("How a target is processed")]
    assert 1 < len(files) <= 8
    for file in files:
        assert (ROOT / file).is_file(), file


def test_additions_take_the_named_files() -> None:
    additions = rows("Adding to it")
    assert len(additions) >= 9
    for kind, max_files, files, _ in additions:
        named = files.split(" · ")
        assert len(named) <= max(int(max_files), 1), kind
        for file in re.findall(r"`([^`]+\.(?:py|c))`", files):
            assert (ROOT / "casadi_ik" / file).is_file(), f"{kind}: {file}"


def test_every_folder_is_in_the_table_of_rooms() -> None:
    rooms = " ".join(row[0] for row in rows("Rooms"))
    for path in (ROOT / "casadi_ik").iterdir():
        if path.is_dir() and (path / "__init__.py").is_file():
            assert f"`{path.name}`" in rooms, path.name
