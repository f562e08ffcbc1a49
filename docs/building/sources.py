"""The role `src`: a name of the package, linked to its source on the site.

{src}`kinematics.se3.log_so3` fails the build if the package has no such name.
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
    """Role for names of the package, without the prefix `casadi_ik.`."""

    def run(self) -> tuple[list[nodes.Node], list[nodes.system_message]]:
        """Return the name as code, linked to its first line.

        Raises:
            ExtensionError: The package has no such name.
        """
        module, path, line = located(self.text, self.env.docname)
        self.env.metadata[self.env.docname].setdefault("sources", {})[module] = path
        up = "../" * self.env.docname.count("/")
        target = f"{up}{FOLDER}/{module}.html#L-{line}"
        literal = nodes.literal("", self.text, classes=["src"])
        return [nodes.reference("", "", literal, refuri=target, internal=True)], []


def located(name: str, docname: str) -> tuple[str, str, int]:
    """Return module, file and line of a name of the package.

    Raises:
        ExtensionError: The package has no such name.
    """
    parts = f"casadi_ik.{name}".split(".")
    for count in range(len(parts), 0, -1):
        try:
            module = importlib.import_module(".".join(parts[:count]))
            break
        except ModuleNotFoundError:
            continue
    target_object: Any = module
    try:
        for part in parts[count:]:
            module_like = inspect.ismodule(target_object)
            target_object = (
                getattr(target_object, part)
                if module_like
                else inspect.getattr_static(target_object, part)
            )
    except AttributeError as error:
        raise ExtensionError(f"{docname}: src: casadi_ik has no {name}") from error
    target_object = (
        target_object.fget
        if isinstance(target_object, property)
        else getattr(target_object, "func", target_object)
    )
    code = not inspect.ismodule(target_object) and (
        inspect.isclass(target_object) or inspect.isfunction(target_object)
    )
    line = inspect.getsourcelines(target_object)[1] if code else 1
    return module.__name__, str(inspect.getsourcefile(module)), line


def _pages(app: Sphinx) -> Iterator[tuple[str, dict[str, str], str]]:
    """Yield a page for each referenced module."""
    sources: dict[str, str] = {}
    for metadata in app.env.metadata.values():
        sources |= metadata.get("sources", {})
    style = HtmlFormatter(lineanchors="L", anchorlinenos=False, cssclass="highlight")
    for module, path in sorted(sources.items()):
        body = highlight(Path(path).read_text(encoding="utf-8"), PythonLexer(), style)
        title = module
        yield (
            f"{FOLDER}/{module}",
            {"title": title, "body": f"<h1>{title}</h1>\n{body}"},
            "page.html",
        )


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.add_role("src", Source())
    app.connect("html-collect-pages", _pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
