"""Reference of public names from their docstrings."""

from __future__ import annotations

import enum
import inspect
import re
from pathlib import Path

from sphinx.domains.python import PyObject

import casadi_ik

HERE = re.compile(r"^<!-- here: api-pages (.*?) ?-->$", re.MULTILINE)
FOLDER = Path(__file__).parents[1] / "reference"


def documented(*names: str) -> str:
    """What autodoc is told to show: "Solver", "logs.open", "errors.InputError"."""
    blocks = []
    for name in names:
        thing = found(name)
        if inspect.isclass(thing):
            options = [":members:"]
            if issubclass(thing, BaseException):
                options = [":show-inheritance:"]
            elif issubclass(thing, enum.Enum):
                options += [":undoc-members:", f":exclude-members: {_inherited(thing)}"]
            elif issubclass(thing, (tuple, str)):
                pass
            else:
                options.append(":inherited-members:")
            lines = [f".. autoclass:: casadi_ik.{name}", *("   " + option for option in options)]
        elif callable(thing):
            lines = [f".. autofunction:: casadi_ik.{name}"]
        else:
            lines = [f".. autodata:: casadi_ik.{name}", "   :no-value:"]
        blocks.append("\n".join(lines))
    return "```{eval-rst}\n" + "\n\n".join(blocks) + "\n```"


def pages_of(*names: str) -> str:
    """Names with the first sentences of their docstrings, linked to a page each."""
    rows = ["| | |", "|---|---|"]
    for name in names:
        thing = found(name)
        text = inspect.getdoc(thing) if not isinstance(thing, tuple) else "Names of the methods."
        first = (text or "").split("\n\n")[0].replace("\n", " ").replace("|", r"\|")
        first = re.sub(r"`([^`]+)`", r"{py:obj}`\1`", first)
        rows.append(f"| [`{name}`](names/{name}.md) | {first} |")
    pages = [f"{name} <names/{name}>" for name in names]
    return "\n".join([*rows, "", "```{toctree}", ":hidden:", "", *pages, "```"])


def write_pages(_app: object) -> None:
    """A page for every name in an `api-pages` of the reference, if it is not there as it is."""
    folder = FOLDER / "names"
    folder.mkdir(exist_ok=True)
    texts = [page.read_text(encoding="utf-8") for page in FOLDER.glob("*.md")]
    names = {name for text in texts for listed in HERE.findall(text) for name in listed.split()}
    for page in folder.glob("*.md"):
        if page.stem not in names:
            page.unlink()
    for name in names:
        page, text = folder / f"{name}.md", f"# {name}\n\n<!-- here: api {name} -->\n"
        if not page.is_file() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")


def found(name: str) -> object:
    """A public name's object: of casadi_ik, its logs or its errors."""
    thing: object = casadi_ik
    for part in name.split("."):
        thing = getattr(thing, part)
    return thing


def _inherited(thing: type[enum.Enum]) -> str:
    own = set(vars(thing))
    return ", ".join(sorted(name for name in dir(thing) if name not in own and name[0] != "_"))


def readable(
    _app: object, _what: str, _name: str, _thing: object, _: object, lines: list[str]
) -> None:
    """Types stand in the text as they are, where an underscore at an end would be a link."""
    lines[:] = [line.replace("np.bool_]", "np.bool]") for line in lines]


def in_words(
    _app: object,
    _what: str,
    _name: str,
    _thing: object,
    _: object,
    said: str | None,
    gives: str | None,
) -> tuple[str, str | None] | None:
    """A signature as it stands in the source: short names of arrays, defaults that are made."""

    def plain(text: str) -> str:
        text = re.sub(r"(?:~?\w+\.)*TypeAliasForwardRef\('(\w+)'\)", r"\1", text)
        return text.replace("<factory>", "...")

    return None if said is None else (plain(said), gives and plain(gives))


def call_them_attributes() -> None:
    """Docstrings say "Attributes", so the pages do."""
    for field in PyObject.doc_field_types:
        if field.name == "variable":
            field.label = "Attributes"
