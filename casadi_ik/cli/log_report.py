"""`casadi-ik log report`: a study's log as one page."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Group
from rich.text import Text

from casadi_ik import logs
from casadi_ik.cli.answer import Answer
from casadi_ik.cli.outputs import check_outputs, write_output
from casadi_ik.cli.question import located
from casadi_ik.cli.report import files
from casadi_ik.errors import MissingExtraError


def report(arguments: argparse.Namespace) -> Answer:
    """Write the page.

    Raises:
        LogError: A file is missing, damaged or no log of casadi_ik.
        MissingExtraError: matplotlib is not installed.
        OutputError: The page cannot be written.
    """
    with located("log report", (MissingExtraError,)):
        from casadi_ik.views.report import study_page
    path = Path(arguments.file)
    log = logs.open(path)
    check_outputs([("--out", arguments.out)], inputs=[path])
    page = study_page(log, arguments.title or path.stem, arguments.most)
    write_output(arguments.out, "--out", lambda part: part.write_text(page, encoding="utf-8"))
    count = sum(len(part) for part in log.solves().parts)
    return Answer(Group(Text(f"  {count} solves"), *files([("page", arguments.out)])))
