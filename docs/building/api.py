"""Reference of public names from their docstrings."""

from __future__ import annotations

import enum
import inspect
import re

from sphinx.domains.python import PyObject

import casadi_ik

PAGES = {
    "answers": "#answers",
    "errors": "errors.md",
    "logs": "logs.md",
    "motion": "#motion",
    "papers": "../slider_hands.md",
}
"""Where submodules are described."""


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


def found(name: str) -> object:
    """A public name's object: of casadi_ik, its logs or its errors."""
    thing: object = casadi_ik
    for part in name.split("."):
        thing = getattr(thing, part)
    return thing


def index_of_names() -> str:
    """Every public name with the first sentence of its docstring."""
    rows = ["| name | |", "|---|---|"]
    for name in sorted(casadi_ik.__all__, key=str.lower):
        thing = found(name)
        text = inspect.getdoc(thing) if not isinstance(thing, tuple) else "Names of the methods."
        first = (text or "").split("\n\n")[0].replace("\n", " ").replace("|", r"\|")
        page = f"[`{name}`]({PAGES[name]})" if inspect.ismodule(thing) else ""
        rows.append(f"| {page or f'{{py:obj}}`~casadi_ik.{name}`'} | {first} |")
    return "\n".join(rows)


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
