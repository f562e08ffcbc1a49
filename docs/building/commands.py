"""Reference of the command line, from the table of commands."""

from __future__ import annotations

import re

from casadi_ik.app.cli.options import PROGRAM, Option
from casadi_ik.app.cli.table import COMMANDS, GROUPS, load, usage


def command_line() -> str:
    """Return a section per command: summary, usage, options, examples, exit codes."""
    parts = []
    for name in COMMANDS:
        command = None if name in GROUPS else load(name)
        summary, _, details = command.doc_parts if command else GROUPS[name].partition("\n\n")
        parts += [f"{'#' * (name.count(' ') + 2)} `{PROGRAM} {name}`", _text(summary)]
        if command:
            parts.append(f"```text\n{usage(name, command)}\n```")
            parts += [_option(option) for option in command.options]
        if details:
            parts.append(f"```text\n{details.rstrip()}\n```")
    return "\n\n".join(parts)


def _option(option: Option) -> str:
    """Return an option as a Markdown definition."""
    required = " *(required)*" if option.required else ""
    return f"`{option.syntax}`{required}\n: {_text(option.help_text)}"


def _text(text: str) -> str:
    """Return help as Markdown with options as code."""
    parts = re.split(r"(`[^`]*`)", " ".join(text.split()))
    return (
        "".join(
            part if part.startswith("`") else re.sub(r"(?<![\w-])(--[a-z][\w-]*)", r"`\1`", part)
            for part in parts
        )
        .replace("<", r"\<")
        .replace("*", r"\*")
    )
