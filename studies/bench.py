"""Timings on this machine, by turns with another checkout of the package if one is named.

::

    python studies/bench.py                                    # everything that is quick
    python studies/bench.py --part batch fast --robots ur5e+shadow --against ../other
    python studies/bench.py --against ../other --limit 1.25                # exit code 1 if slower
    python studies/bench.py --part first-use export logs --report out/bench
    python studies/bench.py --part peers --robots panda+allegro_right      # studies/peers.txt
    python studies/bench.py --part view --page out/page/index.html         # needs Chromium

Every package measured has a process of its own that runs the same code (`bench_parts.py`, public
names only) with the same targets; the two take turns, and of all turns the least counts. Machines
differ and are noisy: quote ratios.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from bench_parts import ABROAD, CASES
from bench_solves import SHARED, Case
from rich.console import Console
from runner.parts import code_version
from runner.report import command, commit, markdown_table, program, publish

from casadi_ik.errors import InputError

ROBOTS = ("kuka_lwr_barrett", "panda+allegro_right", "ur5e+shadow", "xarm6+leap")
USUAL = ("batch", "fast", "single", "scene", "follow")

OLDEST = "e4d962a7"
"""Oldest revision of the package that the benchmark was run against."""

INTRODUCTION = """
Least of {turns} turns; processor time of the measured thread, verdicts included, unless the row
says otherwise. Counts are of the answers that were timed. Load of the machine at the end: {load}.
"""

AGAINST = """
*other* is the package at commit `{other}`, measured by turns by the same code. *ratio:* least time
here over least time there; *by turns:* the median of the ratios of single turns.
"""


class Worker:
    """A process that measures one package."""

    def __init__(self, package: Path, targets: str) -> None:
        """Start it; a package is a folder that holds `casadi_ik`, another one is for targets."""
        self.package = package
        environment = os.environ | {"PYTHONPATH": str(package), SHARED: targets}
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("bench_parts.py"))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
            cwd=package,
        )

    def measure(self, case: Case) -> dict[str, float] | None:
        """Measure a case once; return quantities by name, None if it is not possible."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        line = ""
        with suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(case) + "\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        if not line:
            raise InputError(
                f"{self.package}: the process that measures {' '.join(map(str, case))} ended; "
                f"expected a package with the public names of revision {OLDEST} or later"
            )
        answer = json.loads(line)
        if "error" in answer:
            Console(stderr=True).print(
                f"{self.package}: {' '.join(map(str, case))}: {answer['error']}"
            )
        return answer.get("found")

    def stop(self) -> None:
        """End the process."""
        with suppress(BrokenPipeError):
            self._process.communicate("")


@contextmanager
def worker(package: Path, targets: str) -> Iterator[Worker]:
    """Start a worker and stop it at the end of the context."""
    if not (package / "casadi_ik").is_dir():
        raise InputError(f"--against: found no folder casadi_ik in {package}, expected a checkout")
    started = Worker(package.resolve(), targets)
    try:
        yield started
    finally:
        started.stop()


def measured(
    cases: list[Case], package: Worker, reference_package: Worker | None, turns: int
) -> Iterator[tuple[Case, list[dict[str, float]], list[dict[str, float]]]]:
    """Cases with what every turn found here, and there."""
    for case in cases:
        own_results, theirs = list[dict[str, float]](), list[dict[str, float]]()
        for turn in range(1 if case[0] in ABROAD else turns):
            sides = [
                (package, own_results),
                *([(reference_package, theirs)] if reference_package else []),
            ]
            # Who is first in a turn is second in the next.
            for side, results in sides if turn % 2 == 0 else reversed(sides):
                if (values := side.measure(case)) is not None:
                    results.append(values)
        yield case, own_results, theirs


def rows_of(
    case: Case, own_results: list[dict[str, float]], theirs: list[dict[str, float]]
) -> Iterator[list[str]]:
    """Return a row for each quantity of a case."""
    label = " ".join(map(str, case[2:]))
    for name in own_results[0] if own_results else ():
        best = min(values[name] for values in own_results)
        cells = [case[0], str(case[1]), label, name, _number(best)]
        reference_values = [values[name] for values in theirs if name in values]
        if reference_values:
            reference_best = min(reference_values)
            paired = [
                values[name] / reference
                for values, reference in zip(own_results, reference_values, strict=False)
                if reference
            ]
            middle = sorted(paired)[len(paired) // 2] if paired else float("nan")
            ratio = best / reference_best if reference_best else float("nan")
            ratios = [f"{ratio:.3f}", f"{middle:.3f}"] if reference_best or best else ["", ""]
            cells += [_number(reference_best), *ratios]
        elif theirs:
            cells += ["", "", ""]
        yield cells


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def main(arguments: list[str] | None = None) -> None:
    """Measure, print, and write the report if one is asked for."""
    parser = argparse.ArgumentParser(description="Timings on this machine.")
    parser.add_argument("--part", nargs="+", choices=CASES, default=USUAL, help=", ".join(CASES))
    parser.add_argument("--robots", nargs="+", default=ROBOTS)
    parser.add_argument("--count", type=int, default=4000, help="targets of a batch")
    parser.add_argument("--turns", type=int, default=7, help="of every measurement")
    parser.add_argument("--against", type=Path, help="folder of another checkout of the package")
    parser.add_argument(
        "--limit", type=float, help="largest ratio of times to --against; above: exit code 1"
    )
    parser.add_argument("--page", type=Path, default=Path(), help="of view: index.html (make page)")
    parser.add_argument("--report", type=Path, help="folder of the report")
    options = parser.parse_args(arguments)
    cases = [
        (part, *words)
        for part in options.part
        for words in CASES[part](list(options.robots), options.count, str(options.page.resolve()))
    ]
    console, rows = Console(), list[list[str]]()
    heads = ["part", "robot", "of", "quantity", "here"]
    heads += ["other", "ratio", "by turns"] if options.against else []
    with ExitStack() as stack:
        targets = stack.enter_context(tempfile.TemporaryDirectory(prefix="casadi_ik-bench-"))
        package = stack.enter_context(worker(Path(__file__).resolve().parents[1], targets))
        reference_package = (
            stack.enter_context(worker(options.against, targets)) if options.against else None
        )
        for case, own_results, theirs in measured(cases, package, reference_package, options.turns):
            for row in rows_of(case, own_results, theirs):
                rows.append(row)
                console.print("  ".join(row), soft_wrap=True, highlight=False)
    slow = slower_rows(rows, options.limit) if options.limit and options.against else []
    if options.report:
        load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
        parts = [INTRODUCTION.format(turns=options.turns, load=load)]
        parts += [AGAINST.format(other=commit(options.against))] if options.against else []
        parts += [markdown_table(heads, rows)]
        # Folders of this machine say nothing to a reader.
        run_by = command(__file__, arguments)
        for folder, name in ((options.against, "CHECKOUT"), (options.report, "REPORT")):
            run_by = run_by.replace(str(folder), name)
        result = main_result(rows, options.turns)
        publish("Benchmark", result, parts, options.report, run_by, {"bench": code_version()})
    if slow:
        sys.exit(
            "\n".join(f"slower than --limit {options.limit:g}: {' '.join(row)}" for row in slow)
        )


def main_result(rows: list[list[str]], turns: int) -> str:
    """Return the sentence on the ratios to the other checkout, or on the number of quantities."""
    times = [row for row in rows if "us" in row[3].split() and len(row) > 5 and row[-1]]
    if not times:
        return f"The least of {turns} turns is stated for {len(rows)} quantities."
    times.sort(key=lambda row: float(row[-1]))
    middle, last = times[len(times) // 2], times[-1]
    return (
        f"The median of the {len(times)} paired ratios of times is {middle[-1]}, and the largest "
        f"is {last[-1]} ({', '.join(cell for cell in last[:4] if cell)})."
    )


def slower_rows(rows: list[list[str]], limit: float) -> list[list[str]]:
    """Return the rows of times [us] whose median ratio exceeds a limit."""
    times = [row for row in rows if "us" in row[3].split() and row[-1]]
    return [row for row in times if float(row[-1]) > limit]


if __name__ == "__main__":
    program(main)
