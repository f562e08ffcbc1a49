"""Reference of public names from their docstrings."""

from __future__ import annotations

import enum
import inspect
import re
from pathlib import Path

from sphinx.domains.python import PyObject

import casadi_ik

PARTS = re.compile(r"^<!-- here: api-pages (.*?) ?-->$", re.MULTILINE)
FOLDER = Path(__file__).parents[1] / "reference"


def documented(*names: str) -> str:
    """Return the directives of autodoc for names such as "Solver" or "logs.open"."""
    blocks = []
    for name in names:
        target = public_object(name)
        if inspect.isclass(target):
            options = [":members:"]
            if issubclass(target, BaseException):
                options = [":show-inheritance:"]
            elif issubclass(target, enum.Enum):
                options += [":undoc-members:", f":exclude-members: {_inherited(target)}"]
            elif issubclass(target, (tuple, str)):
                pass
            else:
                options.append(":inherited-members:")
            lines = [f".. autoclass:: casadi_ik.{name}", *("   " + option for option in options)]
        elif callable(target):
            lines = [f".. autofunction:: casadi_ik.{name}"]
        else:
            lines = [f".. autodata:: casadi_ik.{name}", "   :no-value:"]
        blocks.append("\n".join(lines))
    return "```{eval-rst}\n" + "\n\n".join(blocks) + "\n```"


def pages_of(*names: str) -> str:
    """Return a table of names, linked to their pages, with their summaries."""
    rows = ["| | |", "|---|---|"]
    for name in names:
        target = public_object(name)
        text = inspect.getdoc(target) if not isinstance(target, tuple) else "Names of the methods."
        first = (text or "").split("\n\n")[0].replace("\n", " ").replace("|", r"\|")
        first = re.sub(r"`([^`]+)`", r"{py:obj}`\1`", first)
        rows.append(f"| [`{name}`](names/{name}.md) | {first} |")
    pages = [f"{name} <names/{name}>" for name in names]
    return "\n".join([*rows, "", "```{toctree}", ":hidden:", "", *pages, "```"])


def write_pages(_app: object) -> None:
    """Write a page for every name of an `api-pages` line of the reference; keep unchanged files."""
    folder = FOLDER / "names"
    folder.mkdir(exist_ok=True)
    texts = [page.read_text(encoding="utf-8") for page in FOLDER.glob("*.md")]
    names = {name for text in texts for listed in PARTS.findall(text) for name in listed.split()}
    for page in folder.glob("*.md"):
        if page.stem not in names:
            page.unlink()
    for name in names:
        page, text = folder / f"{name}.md", f"# {name}\n\n<!-- here: api {name} -->\n"
        if not page.is_file() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")


def public_object(name: str) -> object:
    """Return the object of a public name of casadi_ik."""
    target: object = casadi_ik
    for part in name.split("."):
        target = getattr(target, part)
    return target


def _inherited(target: type[enum.Enum]) -> str:
    defined = set(vars(target))
    return ", ".join(sorted(name for name in dir(target) if name not in defined and name[0] != "_"))


def readable_types(
    _app: object, _kind: str, _name: str, _object: object, _: object, lines: list[str]
) -> None:
    """Remove trailing underscores of types in docstrings, which would become links."""
    lines[:] = [line.replace("np.bool_]", "np.bool]") for line in lines]


def short_signature(
    _app: object,
    _kind: str,
    _name: str,
    _object: object,
    _: object,
    signature: str | None,
    returns: str | None,
) -> tuple[str, str | None] | None:
    """Return a signature with short names of arrays and `...` for computed defaults."""

    def shorten(text: str) -> str:
        text = re.sub(r"(?:~?\w+\.)*TypeAliasForwardRef\('(\w+)'\)", r"\1", text)
        return text.replace("<factory>", "...")

    return None if signature is None else (shorten(signature), returns and shorten(returns))


def label_attributes() -> None:
    """Label instance variables "Attributes", as the docstrings do."""
    for field in PyObject.doc_field_types:
        if field.name == "variable":
            field.label = "Attributes"
