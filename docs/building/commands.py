"""Reference of the command line, from the parser itself."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Iterator

from casadi_ik.cli.parser import build_parser

WIDTH = "92"
"""Columns of usage lines."""


def command_line() -> str:
    """A section per command: what it does, its usage, what can be said, examples, exit codes."""
    os.environ["COLUMNS"] = WIDTH
    parts = []
    for parser, depth in _commands(build_parser(), 1):
        usage = parser.format_usage().removeprefix("usage: ").rstrip()
        parts += [
            f"{'#' * (depth + 1)} `{parser.prog}`",
            _text(parser.description or ""),
            f"```text\n{usage}\n```",
            *_arguments(parser),
        ]
        if parser.epilog:
            parts.append(f"```text\n{parser.epilog.rstrip()}\n```")
    return "\n\n".join(parts)


def _commands(
    parser: argparse.ArgumentParser, depth: int
) -> Iterator[tuple[argparse.ArgumentParser, int]]:
    """The commands below a parser, each before its own."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for one in action.choices.values():
                yield one, depth
                yield from _commands(one, depth + 1)


def _arguments(parser: argparse.ArgumentParser) -> Iterator[str]:
    """What can be said behind a command, as definitions."""
    for action in parser._actions:
        if isinstance(action, (argparse._HelpAction, argparse._SubParsersAction)):
            continue
        names = ", ".join(action.option_strings)
        metavar = action.metavar or ("" if action.nargs == 0 else action.dest)
        if isinstance(metavar, tuple):
            metavar = " ".join(metavar)
        more = " ..." if action.nargs in ("+", "*") else ""
        value = "" if action.nargs == 0 else f"{metavar}{more}"
        needed = " *(needed)*" if action.required and names else ""
        said = _text((action.help or "") % {"default": action.default, "prog": parser.prog})
        yield f"`{' '.join(filter(None, (names, value)))}`{needed}\n: {said}"


def _text(text: str) -> str:
    """Help as Markdown: what looks like an option, a file or a code of its own is code."""
    text = " ".join(text.split())
    parts = re.split(r"(`[^`]*`)", text)
    return (
        "".join(
            part if part.startswith("`") else re.sub(r"(?<![\w-])(--[a-z][\w-]*)", r"`\1`", part)
            for part in parts
        )
        .replace("<", r"\<")
        .replace("*", r"\*")
    )
