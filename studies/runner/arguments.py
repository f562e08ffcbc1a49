"""The arguments all studies share."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from casadi_ik.logs import Keep
from runner.run import run
from runner.study import Study


class Changes(argparse.Action):
    """Collects ``NAME=VALUE`` words into a mapping; values as YAML reads them."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        """Add the words of one use of the argument."""
        found = dict(getattr(namespace, self.dest) or {})
        for word in values or ():
            name, sign, text = str(word).partition("=")
            if not (name and sign and text):
                parser.error(f"{option_string}: found {word!r}, expected NAME=VALUE")
            found[name] = yaml.safe_load(text)
        setattr(namespace, self.dest, found)


def add_run_arguments(parser: argparse.ArgumentParser, folder: str) -> None:
    """Add what decides how and where a study runs.

    Args:
        parser: The study's parser.
        folder: Where results go unless said.
    """
    parser.add_argument("--jobs", type=int, default=1, help="processes on this machine")
    parser.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="scheduler of a Dask cluster that solves instead; scheduler and workers need "
        "casadi-ik[studies] installed and nothing else",
    )
    parser.add_argument(
        "--out", type=Path, default=Path(folder), help="results; a run goes on where one stopped"
    )
    parser.add_argument(
        "--log",
        type=float,
        metavar="SHARE",
        help="write an MCAP log per block: every iteration of all solves that failed or came near "
        "a singularity and of this share of all; totals of the others",
    )


def run_from(options: argparse.Namespace, *studies: Study) -> None:
    """Run studies as the arguments say, each in a folder of its own below ``--out``."""
    keep = None if options.log is None else Keep(sample=options.log)
    for study in studies:
        if study.count > 0 and study.settings:
            run(study, options.out / study.name, options.jobs, options.dask, keep)
