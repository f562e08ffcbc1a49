"""Texts with marks, such as @PREFIX@, for what differs."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib import resources

MARK = re.compile("@([A-Z_]+)@")


def filled(name: str, substitutes: Mapping[str, str]) -> str:
    """The text of `templates/<name>` with every mark replaced.

    Raises:
        KeyError: A mark stands for nothing.
    """
    text = (resources.files("casadi_ik.exporting") / "templates" / name).read_text(encoding="utf-8")
    return MARK.sub(lambda mark: substitutes[mark[1]], text)
