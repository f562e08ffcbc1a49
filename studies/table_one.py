"""Qiu & Kermani 2021, Table I, with our methods beside it, and what the paper leaves open.

For each of the 12 shipped grasps the hand keeps its posture and the arm is drawn uniformly within
its limits; forward kinematics gives targets that are reachable by construction (their section
III). Every target is solved from the robot's home, with limits ignored and enforced::

    python studies/table_one.py                              # 100 arm configurations per grasp
    python studies/table_one.py --full --jobs 2              # 10,000, as in the paper
    python studies/table_one.py --full --methods hand-first  # some of the methods
    python studies/table_one.py --count 0                    # only the report on what is there
    python studies/table_one.py --methods enhanced-dls --set chain_damping=50 --out out/lambda_50
    dask scheduler & dask worker tcp://HOST:8786 &            # casadi-ik[dev] installed there
    python studies/table_one.py --full --dask tcp://HOST:8786

Stopped or killed it goes on where it was. The report (Markdown, HTML, figures, `metrics.json`)
says for every figure how many targets are behind it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from qiu_report import write_report
from qiu_settings import (
    METHODS,
    ablation_study,
    check_changes,
    readings_study,
    table_study,
)
from runner.report import command, program
from runner.study import Study, run

from casadi_ik.errors import InputError
from casadi_ik.logs import Keep

FULL = 10_000
ABLATION_BLOCK = 10


def changes_of(words: Sequence[str]) -> dict[str, Any]:
    """``NAME=VALUE`` words as a mapping; values as YAML reads them."""
    changes: dict[str, Any] = {}
    for word in words:
        name, sign, text = word.partition("=")
        if not (name and sign and text):
            raise InputError(f"--set: found {word!r}, expected NAME=VALUE")
        changes[name] = yaml.safe_load(text)
    return changes


def main(arguments: list[str] | None = None) -> None:
    """Run what is missing and write the report."""
    parser = argparse.ArgumentParser(description="Table I of Qiu & Kermani 2021.")
    parser.add_argument("--count", type=int, default=100, help="arm configurations per grasp")
    parser.add_argument(
        "--full", dest="count", action="store_const", const=FULL, help=f"--count {FULL}"
    )
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS, metavar="METHOD")
    parser.add_argument(
        "--ablation-count", type=int, default=0, help="arm configurations per grasp and choice"
    )
    parser.add_argument(
        "--set",
        dest="changes",
        nargs="+",
        default=[],
        metavar="NAME=VALUE",
        help="parameters of the methods that have them (a damping, a gain, a step cap, ...)",
    )
    parser.add_argument("--seed", type=int, default=2021)
    parser.add_argument("--block", type=int, default=100, help="targets per file of results")
    parser.add_argument(
        "--report", type=Path, default=Path("out/table_one/report"), help="folder of the report"
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes on this machine")
    parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster instead")
    parser.add_argument("--out", type=Path, default=Path("out/table_one"), help="results")
    parser.add_argument(
        "--log",
        type=float,
        metavar="SHARE",
        help="write an MCAP log per block: every iteration of all solves that failed or came near "
        "a singularity and of this share of all; totals of the others",
    )
    options = parser.parse_args(arguments)
    options.changes = changes_of(options.changes)
    check_changes(options.methods, options.changes)

    def studies(methods: Sequence[str], count: int, ablation_count: int) -> tuple[Study, ...]:
        seed, robots = options.seed, options.out / "robots"
        slow = [name for name in methods if name.startswith("original")]
        fast = [name for name in methods if name not in slow]
        block = options.block
        return (
            table_study("table", fast, count, seed, block, options.changes),
            table_study("originals", slow, count, seed, block, options.changes),
            ablation_study(robots, ablation_count, seed, min(options.block, ABLATION_BLOCK)),
            readings_study(ablation_count, seed, min(options.block, ABLATION_BLOCK)),
        )

    log = None if options.log is None else Keep(sample=options.log)
    for study in studies(options.methods, options.count, options.ablation_count):
        if study.count > 0 and study.settings:
            run(study, options.out / study.name, options.jobs, options.dask, log)
    rerun_command = command(__file__, arguments)
    write_report(studies(METHODS, options.count, 0), options.out, options.report, rerun_command)


if __name__ == "__main__":
    program(main)
