"""Reference of the command line, from the table of commands."""

from __future__ import annotations

import re

from casadi_ik.app.cli.options import PROGRAM, Option
from casadi_ik.app.cli.table import COMMANDS, GROUPS, load, usage


def command_line() -> str:
    """A section per command: what it does, its usage, what can be said, examples, exit codes."""
    parts = []
    for name in COMMANDS:
        found = None if name in GROUPS else load(name)
        first, _, rest = found.text if found else GROUPS[name].partition("\n\n")
        parts += [f"{'#' * (name.count(' ') + 2)} `{PROGRAM} {name}`", _text(first)]
        if found:
            parts.append(f"```text\n{usage(name, found)}\n```")
            parts += [_option(option) for option in found.options]
        if rest:
            parts.append(f"```text\n{rest.rstrip()}\n```")
    return "\n\n".join(parts)


def _option(option: Option) -> str:
    """An option as a definition."""
    needed = " *(needed)*" if option.needed else ""
    return f"`{option.said}`{needed}\n: {_text(option.text)}"


def _text(text: str) -> str:
    """Help as Markdown: what looks like an option, a file or a code of its own is code."""
    parts = re.split(r"(`[^`]*`)", " ".join(text.split()))
    return (
        "".join(
            part if part.startswith("`") else re.sub(r"(?<![\w-])(--[a-z][\w-]*)", r"`\1`", part)
            for part in parts
        )
        .replace("<", r"\<")
        .replace("*", r"\*")
    )
