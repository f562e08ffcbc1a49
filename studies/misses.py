r"""Does `hand-first` miss targets that can be reached? Any robots, samplers and tolerances.

Targets are the contacts of configurations within limits, so all of them are reachable; of noisy
contacts a minimax program says whether they are. Two of the robots are made up, with limits of
followers that are narrower than their motors'::

    python studies/misses.py                                        # 10,000 of every kind
    python studies/misses.py --count 200000 --seed 1 --jobs 2       # twelve millions in all
    python studies/misses.py --robots ar10 --sampler limits         # a part of it
    python studies/misses.py --sampler climb --minutes 30           # towards the hardest
    python studies/misses.py --robots pairs --sampler random limits singular --fingers all 3 \
        --count 300 --ratio                                         # every arm with every hand
    python studies/misses.py --robots kuka_lwr_barrett --sampler noise --noise 4 2 \
        --tolerance default
    python studies/misses.py --robots catalogue --sampler tolerances # wide and narrow tolerances

A run that is killed goes on where it stopped. Every miss is listed with its configuration.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from missed_targets import (
    KINDS_OF_CONTACTS,
    REFERENCE,
    ROBOTS,
    Climb,
    parts_of,
    robots_of,
    search,
    solve,
    tolerance_of,
)
from misses_report import write_report
from runner.parts import run_parts
from runner.report import (
    command,
    program,
)
from samplers import SAMPLERS

USUAL = ("random", "one-arm", "corners", "limits", "singular")


def main(arguments: list[str] | None = None) -> None:
    """Solve what is missing and write the report."""
    parser = argparse.ArgumentParser(description="Search for reachable targets that are missed.")
    parser.add_argument(
        "--robots",
        nargs="+",
        default=ROBOTS,
        help="names; pairs, tour, or catalogue",
    )
    kinds = (*SAMPLERS, *KINDS_OF_CONTACTS, "climb")
    parser.add_argument("--sampler", nargs="+", default=USUAL, choices=kinds, metavar="SAMPLER",
                        help=", ".join(kinds))  # fmt: skip
    parser.add_argument(
        "--tolerance", nargs="+", default=("default", "1e-6"), help="default, T or METRES,RADIANS"
    )
    parser.add_argument(
        "--fingers", nargs="+", default=("all",), help="all, a number from the thumb on, A+B"
    )
    parser.add_argument("--count", type=int, default=10_000, help="targets of every kind")
    parser.add_argument("--block", type=int, default=10_000, help="targets solved in one call")
    parser.add_argument("--seed", type=int, default=0, help="of the targets")
    parser.add_argument(
        "--minutes", type=float, default=1.0, help="of climbing, all robots together"
    )
    parser.add_argument(
        "--noise", type=float, nargs=2, default=(4.0, 2.0), metavar=("MM", "DEG"),
        help="standard deviation of noisy contacts",
    )  # fmt: skip
    parser.add_argument("--looked", type=int, default=10, help="missed noisy targets for Ipopt")
    parser.add_argument("--ratio", action="store_true", help=f"times over those of {REFERENCE}")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster instead")
    parser.add_argument("--out", type=Path, default=Path("out/misses"), help="counts by block")
    parser.add_argument("--report", type=Path, help="folder (default: OUT/report)")
    parser.add_argument(
        "--title", default="Reachable targets that are missed", help="title of the report"
    )
    options = parser.parse_args(arguments)
    options.report = options.report or options.out / "report"
    for text in options.tolerance:
        tolerance_of(text)
    run_parts(solve, parts_of(options), options.out, jobs=options.jobs, dask=options.dask)
    if "climb" in options.sampler:
        robots = robots_of(options.robots)
        seconds_each = 60 * options.minutes * options.jobs / len(robots)
        searches = [Climb(robot, seconds_each, options) for robot in robots]
        run_parts(search, searches, options.out, jobs=options.jobs, title="seconds of climbing")
    write_report(options, command(__file__, arguments))


if __name__ == "__main__":
    program(main)
