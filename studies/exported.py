"""What does an exported solver take: time, stack, memory, code; and one call in Python beside it?

The shipped robot's solver is exported, built with the machine's compiler, and solves random
targets one by one; the same from Python by `Solver.fast`, `Solver.solve` and in a batch, all by
turns; and as WebAssembly in node and in Chromium where these are there. With `--scene` solids the
same once more for a solver that checks collisions; with `--single` single precision beside double,
and nothing else::

    python studies/exported.py --report out/exported
    python studies/exported.py --single --report out/exported_single
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib.metadata import version
from pathlib import Path
from threading import Thread

import exported_goals as goals
import numpy as np
from runner import markdown_table, provenance, write_page

import casadi_ik as ik
from casadi_ik.exporting.project import c_project, write_folder
from casadi_ik.exporting.wasm import wasm_project

TURNS = 5
CALLS = 2000
"""Calls of a turn."""

STACK = """
#define _DEFAULT_SOURCE
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <string.h>
#include "arm.h"
#include "targets.h"
static arm_solver solver;
static unsigned char stack[1 << 20] __attribute__((aligned(4096)));
static REAL points[3 * ARM_FINGERS], normals[3 * ARM_FINGERS];
static void *work(void *given) {
  int i, k;
  for (i = 0; i < TARGETS; ++i) {
    for (k = 0; k < 3 * ARM_FINGERS; ++k) {
      points[k] = (REAL) targets[i].points[k];
      normals[k] = (REAL) targets[i].normals[k];
    }
    arm_solve(&solver, points, normals, 0);
  }
  return given;
}
int main(void) {
  pthread_attr_t attributes;
  pthread_t thread;
  size_t least = 0;
  memset(stack, 0xa5, sizeof stack);
  arm_init(&solver);
  pthread_attr_init(&attributes);
  pthread_attr_setstack(&attributes, stack, sizeof stack);
  if (pthread_create(&thread, &attributes, work, 0)) return 1;
  pthread_join(thread, 0);
  while (least < sizeof stack && stack[least] == 0xa5) ++least;
  printf("%zu %zu\\n", sizeof stack - least, sizeof solver);
  return 0;
}
"""

IN_PAGE = """<!doctype html><script type=module>
import { Solver, Status } from "./arm.js";
const targets = await (await fetch("targets.json")).json();
const solver = await Solver.load();
let wrong = 0;
for (const one of targets) {
  const answer = solver.solve(one.points, one.normals, one.q0 ?? undefined);
  wrong += one.status !== answer.status || one.q.some((v, i) => !Object.is(v, answer.q[i]));
}
// The clock ticks in tenths of a millisecond: lots of solves are timed, each of other targets.
const easy = targets.filter((one) => one.status === Status.SOLVED), lots = [];
for (let lot = 0, i = 0; lot < 400; ++lot) {
  const begun = performance.now();
  for (let k = 0; k < 50; ++k, ++i) {
    const one = easy[i % easy.length];
    solver.solve(one.points, one.normals, one.q0 ?? undefined);
  }
  lots.push((1e3 * (performance.now() - begun)) / 50);
}
globalThis.done = { wrong, median: lots.sort((a, b) => a - b)[200] };
</script>"""

INTRODUCTION = """
Robot kuka_lwr_barrett, random arms and hands within limits, 5 mm / 3 deg, one target a call. CPU
time is that of the measured thread alone, the smallest mean of {turns} turns; times by the clock on
the wall have in them whatever else the machine did (load at the end {load}).
"""


def run(*command: str, folder: Path) -> str:
    """Run a command; what it prints."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: {done.stdout}{done.stderr}")
    return done.stdout


def built(
    robot: ik.ArmHand, folder: Path, capacity: int | None = None, single: bool = False
) -> Path:
    """The exported project, built; with a scene if that is to hold so many solids."""
    project = folder / ("c" if capacity is None else "c_scene")
    write_folder(project, c_project(robot, "arm", capacity, single))
    run("make", folder=project)
    return project


def tail_of(name: str, said: dict[str, float]) -> list[str]:
    """A row of the table of times."""
    keys = ("mean", "median", "p99.9", "max")
    return [name, f"{said['targets']:,}", *(f"{said[key]:.1f}" for key in keys)]


def sizes(project: Path, real: str = "double") -> dict[str, int]:
    """Bytes of code, tables, solver and stack."""
    table = run("size", "-t", "build/libarm.a", folder=project).splitlines()[1:]
    texts = {line.split()[5]: int(line.split()[0]) for line in table}
    tables = sum(size for name, size in texts.items() if "tables" in name)
    whole = next(size for name, size in texts.items() if name.startswith("(TOTALS)"))
    (project / "stack.c").write_text(STACK)
    flags = [
        f"-DREAL={real}",
        "-O2",
        "-Iinclude",
        "-Itest",
        "stack.c",
        "build/libarm.a",
        "-lm",
        "-pthread",
    ]
    run("cc", *flags, "-o", "build/stack", folder=project)
    stack, solver = map(int, run("build/stack", folder=project).split())
    return {
        "code (and its constants)": whole - tables,
        "lookup tables (constant)": tables,
        "a solver's struct": solver,
        "stack of a solve": stack,
    }


def by_turns(ways: dict[str, Callable[[], float]], turns: int) -> dict[str, float]:
    """The smallest of several figures of each way."""
    found: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(turns):
        for name, measure in ways.items():
            found[name].append(measure())
    return {name: min(values) for name, values in found.items()}


def timed(call: Callable[[int], object], count: int) -> float:
    """CPU time of a call [us]."""
    begun = time.thread_time()
    for i in range(count):
        call(i)
    return 1e6 * (time.thread_time() - begun) / count


def python_ways(robot: ik.ArmHand, count: int) -> dict[str, Callable[[], float]]:
    """CPU time a target [us] of a batch, of `fast` and of `solve`."""
    solver, rng = ik.Solver(robot), np.random.default_rng(3)
    points, normals = robot.contacts(robot.random(rng, count))
    grasps = [
        ik.Grasp({n: ik.Contact(points[i, f], normals[i, f]) for f, n in enumerate(robot.fingers)})
        for i in range(count)
    ]
    fast = solver.fast()
    solver.solve_batch(points, normals)
    solver.solve(grasps[0])
    return {
        "Python, batch": lambda: timed(lambda _: solver.solve_batch(points, normals), 1) / count,
        "Python, Solver.fast": lambda: timed(lambda i: fast(points[i], normals[i]), count),
        "Python, Solver.solve": lambda: timed(lambda i: solver.solve(grasps[i]), count),
    }


def tail(robot: ik.ArmHand, calls: int) -> list[float]:
    """Mean, 99.9th percentile and largest time [us] of calls of `fast`, clock on the wall."""
    fast, rng = ik.Solver(robot).fast(), np.random.default_rng(4)
    times = []
    for start in range(0, calls, 50_000):
        points, normals = robot.contacts(robot.random(rng, min(50_000, calls - start)))
        for point, normal in zip(points, normals, strict=True):
            begun = time.perf_counter()
            fast(point, normal)
            times.append(time.perf_counter() - begun)
    us = 1e6 * np.array(times)
    return [us.mean(), float(np.median(us)), float(np.quantile(us, 0.999)), us.max()]


def in_wasm(robot: ik.ArmHand, folder: Path) -> dict[str, float]:
    """Median time of a solve [us] as WebAssembly, the smallest of three runs, where it runs."""
    if importlib.util.find_spec("ziglang") is None:
        return {}
    module, found = folder / "wasm", {}
    write_folder(module, wasm_project(robot, "arm"))
    if shutil.which("node"):
        runs = [run("node", "test.mjs", folder=module) for _ in range(3)]
        found["WebAssembly in node (median, wall)"] = min(
            json.loads(text)["median"] for text in runs
        )
    medians = in_chromium(module)
    if medians:
        found["WebAssembly in Chromium (median of lots, wall)"] = min(medians)
    return found


class Quiet(SimpleHTTPRequestHandler):
    """Serves files, and says nothing of it."""

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        """Nothing."""


def in_chromium(module: Path) -> list[float]:
    """The same in a browser, three times; nothing where there is none."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    try:
        chromium = importlib.import_module("browser")
    except ModuleNotFoundError:
        return []
    finally:
        del sys.path[0]
    if chromium.CHROMIUM is None:
        return []
    (module / "bench.html").write_text(IN_PAGE)
    # Browsers load no modules from disk.
    handler = partial(Quiet, directory=str(module))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        try:
            with chromium.Browser() as browser:
                found = []
                for _ in range(3):
                    page = browser.open(f"http://127.0.0.1:{server.server_port}/bench.html")
                    said = page.wait("globalThis.done", 120)
                    if said["wrong"]:
                        raise SystemExit(f"Chromium: {said['wrong']} answers differ")
                    found.append(float(said["median"]))
                return found
        finally:
            server.shutdown()


def compare_precisions(options: argparse.Namespace) -> None:
    """The report of `exported_single`."""
    single = importlib.import_module("exported_single")
    with tempfile.TemporaryDirectory() as place:
        parts = single.compared(Path(place), options.targets, options.seconds, options.turns)
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    parts.append(f"Load of the machine at the end: {load}.")
    parts.append(provenance({"casadi_ik": version("casadi-ik")}))
    write_page("A solver in single precision", parts, options.report)


def main(arguments: list[str] | None = None) -> None:
    """Measure and write the report."""
    parser = argparse.ArgumentParser(description="Time, stack, memory, code of an exported solver.")
    parser.add_argument(
        "--seconds", type=float, default=300, help="of a C benchmark of 1e6 targets, at most"
    )
    parser.add_argument("--calls", type=int, default=1_000_000, help="of fast, for its tail")
    parser.add_argument("--scene", type=int, metavar="CAPACITY", help="measure that, too")
    parser.add_argument("--turns", type=int, default=TURNS)
    parser.add_argument("--report", type=Path, default=Path("out/exported"), help="folder")
    parser.add_argument("--single", action="store_true", help="single beside double precision")
    parser.add_argument("--targets", type=int, default=10_000, help="of a row of that comparison")
    options = parser.parse_args(arguments)
    if options.single:
        compare_precisions(options)
        return
    robot = ik.load_robot("kuka_lwr_barrett")
    with tempfile.TemporaryDirectory() as place:
        project = built(robot, Path(place))
        bytes_of = sizes(project)

        def in_c() -> float:
            return json.loads(run("build/bench", "2", "20000", folder=project))["cpu_mean"]

        cpu = by_turns({"plain C": in_c, **python_ways(robot, CALLS)}, options.turns)
        long = json.loads(run("build/bench", f"{options.seconds}", folder=project))
        cpu |= in_wasm(robot, Path(place))
        walls = [tail_of("plain C", long)]
        if options.scene is not None:
            checked = built(robot, Path(place), options.scene)
            bytes_of |= {
                f"with a scene of {options.scene}: {name}": size
                for name, size in sizes(checked).items()
            }
            text = run("build/bench", f"{options.seconds}", folder=checked)
            walls.append(tail_of("plain C, nothing about, itself checked", json.loads(text)))
    rows = list(walls)
    measured = tail(robot, options.calls)
    calls = [f"{options.calls:,}", *(f"{value:.1f}" for value in measured)]
    rows.append(["Python, Solver.fast", *calls])
    batch = cpu["Python, batch"]
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    parts = [
        INTRODUCTION.format(turns=options.turns, load=load),
        "## CPU time of a solve",
        markdown_table(
            ["", "us", "over a batch's"],
            [[name, f"{value:.1f}", f"{value / batch:.2f}"] for name, value in cpu.items()],
        ),
        f"## The tail, by the clock on the wall [us]\n\n{long['solved']:,} of {long['targets']:,} "
        "solved in C.",
        markdown_table(["", "targets", "mean", "median", "99.9th percentile", "largest"], rows),
        "## Bytes",
        markdown_table(["", "bytes"], [[name, f"{size:,}"] for name, size in bytes_of.items()]),
        "## Goals",
        markdown_table(
            goals.HEADS, goals.rows(robot, cpu, measured, next(iter(bytes_of.values())))
        ),
        provenance({"casadi_ik": version("casadi-ik")}),
    ]
    write_page("An exported solver", parts, options.report)


if __name__ == "__main__":
    main()
