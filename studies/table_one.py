"""Qiu & Kermani 2021, Table I, with our methods beside it, and what the paper leaves open.

For each of the 12 shipped grasps the hand keeps its posture and the arm is drawn uniformly within
its limits; forward kinematics gives targets that are reachable by construction (their section
III). Every target is solved from the robot's home, with limits ignored and enforced::

    python studies/table_one.py                              # 100 arm configurations per grasp
    python studies/table_one.py --full --jobs 2              # 10,000, as in the paper
    python studies/table_one.py --full --methods hand-first  # some of the methods
    python studies/table_one.py --count 0                    # only the report on what is there
    python studies/table_one.py --methods enhanced-dls --set chain_damping=50 --out out/lambda_50
    dask scheduler & dask worker tcp://HOST:8786 &            # casadi-ik[studies] installed there
    python studies/table_one.py --full --dask tcp://HOST:8786

Stopped or killed it goes on where it was. The report (Markdown, HTML, figures, `metrics.json`)
says for every figure how many targets are behind it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from qiu_table.report import write_report
from qiu_table.settings import (
    METHODS,
    ablation_study,
    check_changes,
    readings_study,
    table_study,
)
from runner import Changes, Study, add_run_arguments, command, program, run_from

FULL = 10_000
ABLATION_BLOCK = 10


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
        default={},
        action=Changes,
        metavar="NAME=VALUE",
        help="parameters of the methods that have them (a damping, a gain, a step cap, ...)",
    )
    parser.add_argument("--seed", type=int, default=2021)
    parser.add_argument("--block", type=int, default=100, help="targets per file of results")
    parser.add_argument(
        "--report", type=Path, default=Path("out/table_one/report"), help="folder of the report"
    )
    add_run_arguments(parser, "out/table_one")
    options = parser.parse_args(arguments)
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

    run_from(options, *studies(options.methods, options.count, options.ablation_count))
    again = command(__file__, arguments)
    write_report(studies(METHODS, options.count, 0), options.out, options.report, again)


if __name__ == "__main__":
    program(main)
