"""What the pages tell people to type and to write: commands that exist, files that are accepted."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

import casadi_ik as ik
from casadi_ik import public
from casadi_ik.cli.lists import schema_of
from casadi_ik.cli.table import COMMANDS, GROUPS, load

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"^    (casadi-ik .*)$", re.MULTILINE)


def commands(text: str) -> Iterator[str]:
    """Lines that begin with the program, continued ones joined."""
    for language, body in BLOCK.findall(text):
        if language in ("", "sh"):
            lines = body.replace("\\\n", " ").splitlines()
            yield from (line for line in lines if line.startswith("casadi-ik "))
    yield from INDENTED.findall(BLOCK.sub("", text))


def fault(line: str) -> str:
    """What is wrong with a command, or ""."""
    words, name = shlex.split(line, comments=True)[1:], ""
    while words and name in GROUPS:
        if words[0] == "COMMAND":
            return ""
        name = f"{name} {words[0]}".strip()
        if name not in COMMANDS:
            return f"no command {words[0]!r}"
        words.pop(0)
    options = () if name in GROUPS else load(name).options
    known = {"--help", "--version", "--no-diagnose", *(option.name for option in options)}
    unknown = [word for word in words if re.match(r"--[a-z]", word) and word not in known]
    return f"no option {unknown[0]}" if unknown else ""


def yaml_blocks(text: str) -> Iterator[Any]:
    for language, body in BLOCK.findall(text):
        if language == "yaml" and "..." not in body:
            yield yaml.safe_load(body)


def kind_of(data: Any) -> str:
    """Which file it is, as far as it is a whole one."""
    keys = set(data) if isinstance(data, dict) else set()
    if "contacts" in keys:
        return "grasp"
    if "solids" in keys:
        return "scene"
    return "robot" if {"name", "hand"} <= keys else ""


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_commands_exist(page: Path) -> None:
    wrong = {line: fault(line) for line in commands(page.read_text()) if fault(line)}
    assert not wrong


def test_files_are_accepted() -> None:
    seen = []
    for page in PAGES:
        for data in yaml_blocks(page.read_text()):
            if kind := kind_of(data):
                errors = list(jsonschema.Draft7Validator(schema_of(kind)).iter_errors(data))
                assert not errors, f"{page.name}: {errors[0].message}"
                seen.append(kind)
    assert len(seen) >= 6
    assert set(seen) == {"grasp", "scene", "robot"}


def test_faults_are_seen() -> None:
    assert not fault("casadi-ik solve cup --scene table  # free")
    assert fault("casadi-ik solved cup") == "no command 'solved'"
    assert fault("casadi-ik log why cup.mcap --scene table") == "no option --scene"
    assert sum(1 for page in PAGES for _ in commands(page.read_text())) > 40


def test_every_public_name_is_on_a_page_of_the_reference() -> None:
    shown = []
    for page in (ROOT / "docs" / "reference").glob("*.md"):
        for names in re.findall(r"^<!-- here: api (.*) -->$", page.read_text(), re.MULTILINE):
            shown += names.split()
    names = set(ik.__all__) - set(public.SUBMODULES)
    for module in set(public.SUBMODULES) - {"errors"}:
        names |= {f"{module}.{name}" for name in getattr(ik, module).__all__}
    names -= {"CasadiIKError"}  # with the other errors, by their module
    assert sorted(name for name in shown if not name.startswith("errors.")) == sorted(names)
