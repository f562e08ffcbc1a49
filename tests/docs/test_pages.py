"""Commands, Python code and files of the pages are valid, and run in the order of each page."""

from __future__ import annotations

import contextlib
import importlib
import io
import re
import shlex
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import jsonschema
import pytest
import yaml
from commands import COMMANDS, GROUPS, load, main, schema_of
from processes import ROOT

import casadi_ik as ik

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))

from building.speed import label, means

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"^    (casadi-ik .*)$", re.MULTILINE)
FILE_NAME = re.compile(r"# (\w+\.yaml)\b")
"""First line of a YAML block that readers save."""

WITH_OUTPUT = re.compile(r"^```python\n((?:(?!```).)*)^```\n\n```text\n(.*?)^```", re.M | re.S)
"""Python block with its output."""

NOT_PASTED = {
    "add_a_method",
    "add_a_coupling",
    "add_a_shape",
    "add_an_arm_family",
    "your_robot",
}
"""Pages whose Python blocks belong into modules and have tests of their own; that of
`your_robot` stands between commands and is run with them."""

GRASP = re.compile(r"^( *)contacts:.*\n(?:\1 +\w+: +\{point.*\n)+", re.MULTILINE)
"""Grasp in a docstring."""

STEP = re.compile(
    r"^```python\n(?P<python>.*?)^```|^```sh\n.*?^```|^```.*?^```|^    casadi-ik [^\n]*$",
    re.M | re.S,
)
"""Steps of a page that a reader takes in order."""

INPUT = re.compile(r"\.(urdf|xml|xacro|npz|npy|pt|parquet|mcap|yaml|json|csv)$|/$")
"""Names of files that a command reads."""

NOT_RUN = ("view", "follow", "completion")
"""Commands that run until they are stopped, or need a recording of a hand."""


def commands(text: str) -> Iterator[str]:
    """Return the lines that start with the program, with their continuation lines."""
    for language, body in BLOCK.findall(text):
        if language in ("", "sh"):
            lines = body.replace("\\\n", " ").splitlines()
            yield from (line for line in lines if line.startswith("casadi-ik "))
    yield from INDENTED.findall(BLOCK.sub("", text))


def fault(line: str) -> str:
    """Return the fault of a command, or ""."""
    words, name = shlex.split(line, comments=True)[1:], ""
    while words and name in GROUPS:
        if words[0] == "COMMAND":
            return ""
        name = f"{name} {words[0]}".strip()
        if name not in COMMANDS:
            return f"no command {words[0]!r}"
        words.pop(0)
    options = () if name in GROUPS else load(name).options
    option_names = {"--help", "--version", "--no-diagnose", *(option.name for option in options)}
    unknown = [word for word in words if re.match(r"--[a-z]", word) and word not in option_names]
    return f"no option {unknown[0]}" if unknown else ""


def yaml_blocks(text: str) -> Iterator[Any]:
    for language, body in BLOCK.findall(text):
        if language == "yaml" and "..." not in body:
            yield yaml.safe_load(body)


def kind_of(data: Any) -> str:
    """Return the kind of a complete file."""
    keys = set(data) if isinstance(data, dict) else set()
    for key, kind in (("candidates", "candidates"), ("contacts", "grasp"), ("solids", "scene")):
        if key in keys:
            return kind
    return "robot" if {"name", "hand"} <= keys else ""


def python_blocks(page: Path) -> list[str]:
    text = page.read_text(encoding="utf-8")
    return [body for language, body in BLOCK.findall(text) if language == "python"]


def printed(block: str, names: dict[str, Any]) -> str:
    """Return the output of a block."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile(block, "page", "exec"), names)
    return out.getvalue()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder in which the lines of a page run."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    sys.modules.pop("make_grasp_sets", None)
    return tmp_path


def save_files(page: Path, folder: Path) -> None:
    """Write the YAML blocks whose first line is a file name, and the sets that a tool generates."""
    for language, body in BLOCK.findall(page.read_text(encoding="utf-8")):
        name = FILE_NAME.match(body)
        if language == "yaml" and name:
            (folder / name[1]).write_text(body, encoding="utf-8")
    if "make_grasp_sets" in page.read_text():
        sets = importlib.import_module("make_grasp_sets")
        (folder / "sets").mkdir()
        for name in ("getagrip_allegro", "dexgraspnet_shadow"):
            sets.made(name, folder / "sets")


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_commands_exist(page: Path) -> None:
    wrong = {line: fault(line) for line in commands(page.read_text()) if fault(line)}
    assert not wrong


def test_files_are_accepted() -> None:
    examined = []
    for page in PAGES:
        for data in yaml_blocks(page.read_text()):
            if kind := kind_of(data):
                errors = list(jsonschema.Draft7Validator(schema_of(kind)).iter_errors(data))
                assert not errors, f"{page.name}: {errors[0].message}"
                examined.append(kind)
    assert len(examined) >= 7
    assert set(examined) == {"grasp", "scene", "robot", "candidates"}


def test_wrong_commands_are_detected() -> None:
    assert not fault("casadi-ik solve cup --scene table  # free")
    assert fault("casadi-ik solved cup") == "no command 'solved'"
    assert fault("casadi-ik log why cup.mcap --scene table") == "no option --scene"
    assert sum(1 for page in PAGES for _ in commands(page.read_text())) > 40


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if python_blocks(page) and page.stem not in NOT_PASTED],
    ids=lambda path: path.stem,
)
def test_python_blocks_run(page: Path, folder: Path) -> None:
    """Every block runs alone, or after the first one of its page."""
    save_files(page, folder)
    first, *later_blocks = python_blocks(page)
    namespace: dict[str, Any] = {}
    outputs = {first: printed(first, namespace)}
    for block in later_blocks:
        outputs[block] = printed(block, dict(namespace))
    for block, text in WITH_OUTPUT.findall(page.read_text(encoding="utf-8")):
        assert outputs[block] == text


def grasps_shown() -> Iterator[tuple[str, dict[str, Any]]]:
    """Return every grasp in YAML on a page, in a docstring or in a help text, and its location."""
    for page in PAGES:
        for data in yaml_blocks(page.read_text()):
            kind = kind_of(data)
            for item in data["candidates"] if kind == "candidates" else [data] * (kind == "grasp"):
                yield page.name, {"robot": data["robot"]} | item
    for source in sorted((ROOT / "casadi_ik").rglob("*.py")):
        for match in GRASP.finditer(source.read_text(encoding="utf-8")):
            if "..." not in match[0]:
                yield source.name, {"robot": "kuka_lwr_barrett"} | yaml.safe_load(match[0])


@pytest.mark.slow
def test_every_grasp_on_the_pages_is_solved(tmp_path: Path) -> None:
    grasps_on_pages = list(grasps_shown())
    assert len(grasps_on_pages) >= 5
    for source, data in grasps_on_pages:
        path = tmp_path / "shown.yaml"
        path.write_text(yaml.safe_dump(data), encoding="utf-8")
        grasp = ik.load_grasp(path)
        solution = ik.Solver(ik.load_robot(grasp.robot)).solve(grasp)
        assert solution.success, f"{source}: {solution.status.name}"


def without_pictures(words: list[str]) -> list[str]:
    """Return arguments without pictures, which tests/views covers."""
    words_left = list(words)
    for name in ("--picture", "--picture-dark", "--animation"):
        if name in words_left:
            del words_left[words_left.index(name) : words_left.index(name) + 2]
    return words_left


def missing(words: list[str]) -> bool:
    """Return whether a command reads files that the reader has to provide."""
    values_of_options = [
        word
        for previous, word in pairwise(["", *words])
        if not previous.startswith("--out") and previous != "--log"
    ]
    return any(
        word.isupper() or (INPUT.search(word) and not Path(word).exists())
        for word in values_of_options
    )


def gone_through(page: Path, folder: Path) -> list[str]:
    """Run a page from top to bottom and return its commands."""
    save_files(page, folder)
    text, names, done = page.read_text(encoding="utf-8"), {}, []
    for match in STEP.finditer(text):
        if match["python"]:
            printed(match["python"], names)
        for line in commands(match[0]):
            words = without_pictures(shlex.split(line, comments=True)[1:])
            if words[0] in NOT_RUN or missing(words) or words == ["import", "my_robot.yaml"]:
                continue
            unsolved = re.match(
                r"\n*```text\n(UNREACHABLE|NOT_FOUND|COLLISION)", text[match.end() :]
            )
            assert main(words) == (1 if unsolved else 0), line
            done.append(line)
    return done


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "count"),
    [
        ("README", 1),
        ("first_grasp", 6),
        ("your_robot", 3),
        ("choosing", 2),
        ("motion", 1),
        ("logs", 9),
    ],
)
def test_step_by_step_pages_run(page: str, count: int, folder: Path) -> None:
    """Commands, Python code and files run in the order of the page."""
    path = next(candidate for candidate in PAGES if candidate.stem == page)
    assert len(gone_through(path, folder)) >= count


def test_readme_is_short_and_correct(folder: Path) -> None:
    text = PAGES[0].read_text(encoding="utf-8")
    assert text.count("\n") <= 120
    cells = [c for line in text.splitlines() if line.startswith("|") for c in line.split("|")]
    assert max(len(cell.split()) for cell in cells) <= 20
    assert ", ".join(f"{name} {label(mean)}" for name, mean in means().items()) in text


LINK = re.compile(r"\]\(([^)#]+)(?:#[^)]*)?\)|(?:src|srcset)=\"([^\"]+)\"")
"""Targets of links and pictures."""

PUBLISHED = {
    "https://casadi-ik.github.io/casadi_ik/": ".md",
    "https://raw.githubusercontent.com/casadi-ik/casadi_ik/main/": "",
    "https://github.com/casadi-ik/casadi_ik/blob/main/": "",
}
"""Addresses of the site and of files, and the extension of their sources."""


def test_links_of_the_readme_are_absolute_and_name_files_of_the_repository() -> None:
    """Package indexes show only the README, so that its links are absolute."""
    targets = [a or b for a, b in LINK.findall(PAGES[0].read_text(encoding="utf-8"))]
    assert len(targets) > 20
    for target in targets:
        base = next(base for base in PUBLISHED if target.startswith(base))
        path = target.removeprefix(base)
        if PUBLISHED[base]:
            path = path.replace(".html", PUBLISHED[base])
        assert (ROOT / path).is_file(), target


def test_every_notebook_opens_in_colab() -> None:
    page = (ROOT / "docs" / "notebooks.md").read_text(encoding="utf-8")
    names = re.findall(r"colab\.research\.google\.com/github/[^)]*/(notebooks/[^)]*)\)", page)
    assert names == [
        f"notebooks/{path.name}" for path in sorted((ROOT / "notebooks").glob("*.ipynb"))
    ]


def test_pages_install_no_unpublished_package() -> None:
    """Until the packages of this project are published, they are installed from a checkout."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert not re.search(r"(pip install|uv add|conda install) casadi-ik(-kernels)?\b", text), (
            page
        )


def test_every_public_name_is_on_a_page_of_the_reference() -> None:
    listed = []
    for page in (ROOT / "docs" / "reference").glob("*.md"):
        for names in re.findall(
            r"^<!-- here: api(?:-pages)? (.*) -->$", page.read_text(), re.MULTILINE
        ):
            listed += names.split()
    submodules = {name for name in ik.__all__ if isinstance(getattr(ik, name), ModuleType)}
    names = set(ik.__all__) - submodules
    for module in submodules - {"errors"}:
        names |= {f"{module}.{name}" for name in getattr(ik, module).__all__}
    names -= {"CasadiIKError"}  # with the other errors, by their module
    assert sorted(name for name in listed if not name.startswith("errors.")) == sorted(names)
