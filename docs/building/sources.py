"""The role `src`: what computes an equation, by name, linked to its text on the site.

{src}`kinematics.se3.log_so3` fails the build if the package has no such thing.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docutils import nodes
from pygments import highlight
from pygments.formatters import HtmlFormatter
from pygments.lexers import PythonLexer
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.util.docutils import SphinxRole

FOLDER = "_source"


class Source(SphinxRole):
    """Names something of the package, without the `casadi_ik.` before it."""

    def run(self) -> tuple[list[nodes.Node], list[nodes.system_message]]:
        """The name as code, a link to its first line.

        Raises:
            ExtensionError: There is no such thing.
        """
        module, path, line = located(self.text, self.env.docname)
        self.env.metadata[self.env.docname].setdefault("sources", {})[module] = path
        up = "../" * self.env.docname.count("/")
        target = f"{up}{FOLDER}/{module}.html#L-{line}"
        shown = nodes.literal("", self.text, classes=["src"])
        return [nodes.reference("", "", shown, refuri=target, internal=True)], []


def located(name: str, where: str) -> tuple[str, str, int]:
    """Module, file and line of something in the package.

    Raises:
        ExtensionError: There is no such thing.
    """
    parts = f"casadi_ik.{name}".split(".")
    for count in range(len(parts), 0, -1):
        try:
            module = importlib.import_module(".".join(parts[:count]))
            break
        except ModuleNotFoundError:
            continue
    thing: Any = module
    try:
        for part in parts[count:]:
            module_like = inspect.ismodule(thing)
            thing = getattr(thing, part) if module_like else inspect.getattr_static(thing, part)
    except AttributeError as error:
        raise ExtensionError(f"{where}: src: casadi_ik has no {name}") from error
    thing = thing.fget if isinstance(thing, property) else getattr(thing, "func", thing)
    code = not inspect.ismodule(thing) and (inspect.isclass(thing) or inspect.isfunction(thing))
    line = inspect.getsourcelines(thing)[1] if code else 1
    return module.__name__, str(inspect.getsourcefile(module)), line


def _pages(app: Sphinx) -> Iterator[tuple[str, dict[str, str], str]]:
    """A page for each module that is named anywhere."""
    found: dict[str, str] = {}
    for about in app.env.metadata.values():
        found |= about.get("sources", {})
    style = HtmlFormatter(lineanchors="L", anchorlinenos=False, cssclass="highlight")
    for module, path in sorted(found.items()):
        body = highlight(Path(path).read_text(encoding="utf-8"), PythonLexer(), style)
        title = module
        yield (
            f"{FOLDER}/{module}",
            {"title": title, "body": f"<h1>{title}</h1>\n{body}"},
            "page.html",
        )


def setup(app: Sphinx) -> dict[str, bool]:
    """Tell Sphinx of it."""
    app.add_role("src", Source())
    app.connect("html-collect-pages", _pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
