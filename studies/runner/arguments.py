"""The arguments all studies share."""

from __future__ import annotations

import argparse
from pathlib import Path

from casadi_ik.logs import Keep
from runner.run import run
from runner.study import Study


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
        help="scheduler of a Dask cluster that solves instead; its workers need this folder and "
        "PYTHONPATH=studies",
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
