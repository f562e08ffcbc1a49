"""Ten million targets in one batch: how long, how much memory, and what a thousand million take.

Files of random targets are written, and solved by the command that a user would take
(`casadi-ik batch --resume`), part by part. While it runs, the memory of all its processes is looked
at. The study may be killed and goes on where it stopped; with `--kill` it kills the command itself
once, after so many seconds, and goes on::

    python studies/ten_million.py --folder out/ten_million --report studies/results/ten_million
    python studies/ten_million.py --count 40000 --file 10000 --folder out/few --kill 3
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from runner import command, markdown_table, provenance, write_page

import casadi_ik as ik
from casadi_ik.files.writing import written_whole
from casadi_ik.problem.status import Status

LOOK = 1.0
"""Between two looks at memory and parts [s]."""

OFTEN = 10
"""Looks after which a run's figures so far are stored."""

CLUSTER, LARGE = 100, 1_000_000_000
"""Machines and targets of the arithmetic."""

INTRODUCTION = """
Robot {robot}, {count:,} random arms and hands within limits (seed {seed}), 5 mm / 3 deg, default
method. {files} files of {file:,} targets, solved by

    casadi-ik batch TARGETS --robot {robot} --resume --jobs {jobs} --out SOLVED

on {cores} cores. The command ran {runs} time(s){killed}; what a run that was killed had finished
was not solved again.
"""


def write_targets(robot: ik.ArmHand, folder: Path, options: argparse.Namespace) -> None:
    """The files that are missing, each with a seed of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(math.ceil(options.count / options.file)):
        path = folder / f"targets-{number:05d}.npz"
        if path.exists():
            continue
        count = min(options.file, options.count - number * options.file)
        rng = np.random.default_rng([options.seed, number])
        points, normals = robot.contacts(robot.random(rng, count))
        made = path.with_suffix(".made.npz")
        np.savez(made, points=points, normals=normals)
        made.rename(path)


def resident(pid: int) -> int:
    """Bytes of memory that a process and all below it have to themselves (Linux)."""
    children: dict[int, list[int]] = {}
    size: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            stat = (entry / "stat").read_text().rpartition(")")[2].split()
            # What is shared (libraries, mostly) would be counted once for each process.
            pages = (entry / "statm").read_text().split()
        except OSError:
            continue
        children.setdefault(int(stat[1]), []).append(int(entry.name))
        size[int(entry.name)] = (int(pages[1]) - int(pages[2])) * os.sysconf("SC_PAGE_SIZE")
    total, left = 0, [pid]
    while left:
        one = left.pop()
        total += size.get(one, 0)
        left += children.get(one, [])
    return total


def solve(
    options: argparse.Namespace,
    targets: Path,
    kill: float | None,
    keep: Callable[[dict[str, Any]], None],
) -> dict[str, Any]:
    """Run the command once: seconds, CPU seconds, and [seconds, parts, bytes] on the way.

    Args:
        options: Of the study.
        targets: Folder of files.
        kill: After so many seconds [s]; None: not.
        keep: Is given what there is so far, every now and then: the study may be killed, too.
    """
    solved = options.folder / "solved"
    words = ["-m", "casadi_ik", "batch", str(targets), "--robot", options.robot, "--resume"]
    words += ["--jobs", str(options.jobs), "--out", str(solved)]
    begun, before = time.monotonic(), os.times()
    looks: list[list[float]] = []
    said = (options.folder / "said.txt").open("a")
    # A session of its own: what is killed is the command with all its workers.
    process = subprocess.Popen(
        [sys.executable, *words], stdout=said, stderr=said, start_new_session=True
    )
    killed = False
    try:
        while process.poll() is None:
            time.sleep(LOOK)
            spent = time.monotonic() - begun
            parts = len(list(solved.glob("part-*.npz"))) if solved.is_dir() else 0
            looks.append([round(spent, 1), parts, resident(process.pid)])
            if len(looks) % OFTEN == 0:
                keep({"seconds": spent, "cpu": math.nan, "killed": True, "looks": looks})
            if kill is not None and spent > kill:
                os.killpg(process.pid, signal.SIGKILL)
                killed = True
                process.wait()
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        said.close()
    if process.returncode not in (0, 1) and not killed:
        raise SystemExit((options.folder / "said.txt").read_text()[-2000:])
    after = os.times()
    cpu = (
        after.children_user + after.children_system - before.children_user - before.children_system
    )
    return {"seconds": looks[-1][0] if looks else 0.0, "cpu": cpu, "killed": killed, "looks": looks}


def ends(solved: Path) -> dict[str, int]:
    """How many answers ended in which way; part by part, so that memory stays what it is."""
    found: dict[str, int] = {}
    for path in sorted(solved.glob("part-*.npz")):
        with np.load(path) as part:
            for name, number in zip(*np.unique(part["status"], return_counts=True), strict=True):
                found[str(name)] = found.get(str(name), 0) + int(number)
    return found


def flat(looks: list[list[float]], fraction: slice) -> float:
    """Median of the memory [MB] over a part of a run."""
    count = len(looks)
    start, stop, _ = fraction.indices(100)
    some = looks[count * start // 100 : max(count * stop // 100, count * start // 100 + 1)]
    return float(np.median([look[2] for look in some])) / 1e6


def report(options: argparse.Namespace, runs: list[dict[str, Any]], words: list[str]) -> None:
    """Write it."""
    found = ends(options.folder / "solved")
    count, seconds = sum(found.values()), sum(run["seconds"] for run in runs)
    cpu = float(np.nansum([run["cpu"] for run in runs]))
    rate = count / seconds
    last = max(runs, key=lambda run: len(run["looks"]))["looks"]
    solved = found.get(Status.SOLVED.name.lower(), found.get(Status.SOLVED.name, 0))
    memory = [
        [name, f"{flat(last, part):.0f}"]
        for name, part in (
            ("10 % to 30 % of the longest run", slice(10, 30)),
            ("40 % to 60 %", slice(40, 60)),
            ("70 % to 90 %", slice(70, 90)),
        )
    ]
    peak = max(look[2] for run in runs for look in run["looks"]) / 1e6
    hours = LARGE / rate / CLUSTER / 3600
    parts = [
        INTRODUCTION.format(
            robot=options.robot,
            count=options.count,
            seed=options.seed,
            files=math.ceil(options.count / options.file),
            file=options.file,
            jobs=options.jobs,
            cores=os.cpu_count(),
            runs=len(runs),
            killed=", killed once" if any(run["killed"] for run in runs) else "",
        ),
        markdown_table(
            ["", ""],
            [
                ["targets answered", f"{count:,}"],
                ["solved", f"{solved:,} ({100 * solved / count:.4f} %)"],
                *([f"ended {name}", f"{n:,}"] for name, n in sorted(found.items()) if n != solved),
                ["time by the clock", f"{seconds:,.0f} s"],
                ["CPU time of all processes", f"{cpu:,.0f} s"],
                ["targets a second", f"{rate:,.0f}"],
                ["time a target, by the clock", f"{1e6 * seconds / count:.1f} us"],
                ["CPU time a target", f"{1e6 * cpu / count:.1f} us"],
            ],
        ),
        "## Memory of all processes, without what is shared\n",
        markdown_table(["", "MB (median)"], [*memory, ["largest", f"{peak:.0f}"]]),
        f"## A thousand million targets\n\nParts know nothing of each other, so {CLUSTER} such "
        f"machines (`--dask ADDRESS`) take {LARGE:,} / ({rate:,.0f} a second x {CLUSTER}) = "
        f"**{hours:.2f} hours** where the network keeps up: a target is 48 bytes a finger to them, "
        "an answer 8 bytes a motor, 16 a finger and some 40 beside from them. That is arithmetic, "
        "not a measurement.",
        f"Made by `{command(__file__, words)}`.",
        provenance({"casadi_ik": version("casadi-ik")}),
    ]
    write_page("Ten million targets", parts, options.report)


def main(arguments: list[str] | None = None) -> None:
    """Write targets, solve what is missing, report."""
    words = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(description="Ten million targets in one batch.")
    parser.add_argument("--robot", default="kuka_lwr_barrett")
    parser.add_argument("--count", type=int, default=10_000_000, help="targets")
    parser.add_argument("--file", type=int, default=200_000, help="targets of a file")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kill", type=float, help="kill the command once, after so many seconds")
    parser.add_argument("--folder", type=Path, default=Path("out/ten_million"))
    parser.add_argument("--report", type=Path, help="folder (default: FOLDER/report)")
    options = parser.parse_args(words)
    options.report = options.report or options.folder / "report"
    targets, known = options.folder / "targets", options.folder / "runs.json"
    write_targets(ik.load_robot(options.robot), targets, options)
    runs: list[dict[str, Any]] = json.loads(known.read_text()) if known.exists() else []
    kill = options.kill if not runs else None
    while not runs or runs[-1]["killed"]:
        earlier = list(runs)

        def keep(run: dict[str, Any], earlier: list[dict[str, Any]] = earlier) -> None:
            with written_whole(known) as made:
                made.write_text(json.dumps([*earlier, run]))

        runs.append(solve(options, targets, kill, keep))
        keep(runs[-1])
        kill = None
    report(options, runs, list(words))


if __name__ == "__main__":
    main()
