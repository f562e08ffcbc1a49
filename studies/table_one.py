"""Qiu & Kermani 2021, Table I, with our methods beside it, and what the paper leaves open.

For each of the 12 shipped grasps the hand keeps its posture and the arm is drawn uniformly within
its limits; forward kinematics gives targets that are reachable by construction (their section
III). Every target is solved from the robot's home, with limits ignored and enforced::

    python studies/table_one.py                              # 100 arm configurations per grasp
    python studies/table_one.py --full --jobs 2              # 10,000, as in the paper
    python studies/table_one.py --full --methods hand-first  # some of the methods
    python studies/table_one.py --count 0                    # only the report on what is there
    dask scheduler & PYTHONPATH=studies dask worker tcp://HOST:8786 &
    python studies/table_one.py --full --dask tcp://HOST:8786

Stopped or killed it goes on where it was. The report (Markdown, HTML, figures, `metrics.json`)
says for every figure how many targets are behind it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from qiu_table.report import write_report
from qiu_table.settings import METHODS, ablation_study, readings_study, table_study
from runner import add_run_arguments, run_from

FULL = 10_000


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
    parser.add_argument("--seed", type=int, default=2021)
    parser.add_argument("--block", type=int, default=100, help="targets per file of results")
    parser.add_argument(
        "--report", type=Path, default=Path("out/table_one/report"), help="folder of the report"
    )
    add_run_arguments(parser, "out/table_one")
    options = parser.parse_args(arguments)
    common = (options.seed, options.block)
    changes = (
        readings_study(options.ablation_count, *common),
        ablation_study(options.out / "robots", options.ablation_count, *common),
    )
    run_from(options, table_study(tuple(options.methods), options.count, *common), *changes)
    whole = (
        table_study(METHODS, FULL, *common),
        readings_study(FULL, *common),
        ablation_study(options.out / "robots", FULL, *common),
    )
    write_report(whole, options.out, options.report)


if __name__ == "__main__":
    main()
