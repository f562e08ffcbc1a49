"""The table of origins names every shipped arm and hand, and the sources that its file names."""

from __future__ import annotations

import re
import tomllib

import pytest
import yaml
from processes import ROOT
from write_notice import notice

PAGE = (ROOT / "docs" / "robots_origin.md").read_text()
ROBOTS, LICENCES = (
    dict(re.findall(r"^\| (\S+) \| (.*) \|$", part, re.MULTILINE))
    for part in PAGE.split("## Licences")
)
del LICENCES["source"], ROBOTS["robot"]
FILES = sorted(path for kind in ("arms", "hands") for path in (ROOT / "models" / kind).iterdir())


def test_every_robot_has_a_row():
    assert set(ROBOTS) == {f"`{path.stem}`" for path in FILES}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_row_names_the_sources_of_its_file(path):
    text = " ".join(" ".join(yaml.safe_load(path.read_text())["sources"].values()).split())
    licences = [x for x in LICENCES if re.search(rf"(?<![\w/-]){re.escape(x)}(?![\w-])", text)]
    assert ROBOTS[f"`{path.stem}`"].rpartition("| ")[2] == (", ".join(licences) or "assumed")


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_repository_with_a_commit_has_its_licence_listed(path):
    text = " ".join(" ".join(yaml.safe_load(path.read_text())["sources"].values()).split())
    named = re.findall(r"([A-Za-z0-9][\w.-]*/[A-Za-z][\w.-]*) at [0-9a-f]{7,}", text)
    assert set(named) <= set(LICENCES)


def test_every_licence_is_documented():
    assert not [name for name, text in LICENCES.items() if "not looked up" in text]


def test_notice_names_every_robot_with_its_licences():
    assert (ROOT / "NOTICE").read_text(encoding="utf-8") == notice()
    for path in FILES:
        assert f"\n{path.stem}: " in notice()
    files = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["license-files"]
    assert files == ["LICENSE", "NOTICE"]
