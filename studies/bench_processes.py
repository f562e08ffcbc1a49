"""Measurements of `bench.py` that use other processes, files, peers, or a browser."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from bench_solves import TOLERANCES, Quantities, batch, clock, fast, sampled_contacts
from samplers import suits

import casadi_ik as ik

PROBES = Path(__file__).parent / "probes"
"""Programs beside those that are measured; `stack.c` marks the stack of a solve."""

OF_FILE = 200_000
"""Targets of a file of many."""


def memory(robot: str, count: int) -> Callable[[], Quantities]:
    """Measure the growth of memory over many solves in blocks, after a tenth of them."""
    resource = importlib.import_module("resource")
    solver = ik.Solver(ik.load_robot(robot))

    def peak() -> float:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10

    def measure() -> Quantities:
        rng, tenth = np.random.default_rng(0), count // 10
        grown = list[float]()
        for _ in range(10):
            blocks = [solver.robot.contacts(solver.robot.random(rng, tenth))]
            for _ in solver.solve_blocks(blocks):
                pass
            grown.append(peak())
        return {"peak MB": grown[-1], "grown MB": grown[-1] - grown[0]}

    return measure


def large_batch(robot: str, count: int) -> Callable[[], Quantities]:
    """`casadi-ik batch --resume` of a folder of files on two processes: rate and memory."""
    psutil = importlib.import_module("psutil")
    arm_hand = ik.load_robot(robot)
    folder = Path(tempfile.mkdtemp(prefix="casadi_ik-bench-"))
    targets, solved = folder / "targets", folder / "solved"
    targets.mkdir()
    for number in range(-(-count // OF_FILE)):
        rng, size = np.random.default_rng([0, number]), min(OF_FILE, count - number * OF_FILE)
        points, normals = arm_hand.contacts(arm_hand.random(rng, size))
        np.savez(targets / f"targets-{number:05d}.npz", points=points, normals=normals)
    words = [str(targets), "--robot", robot, "--resume", "--jobs", "2", "--out", str(solved)]

    def memory_of(process: Any) -> float:
        total = 0.0
        for member in (process, *process.children(recursive=True)):
            with contextlib.suppress(psutil.Error):
                total += member.memory_full_info().uss / 2**20
        return total

    def measure() -> Quantities:
        time_before, quantities, peak_memory = _children(), Quantities(), [0.0]
        with clock(quantities, "us a target (wall)", count, wall=True):
            command = [sys.executable, "-m", "casadi_ik", "batch", *words]
            process = psutil.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            while process.poll() is None:
                peak_memory.append(memory_of(process))
                time.sleep(0.5)
        parts = [np.load(path)["success"] for path in sorted(solved.glob("part-*.npz"))]
        missed = count - sum(int(part.sum()) for part in parts)
        time_each = 1e6 * (_children() - time_before) / count
        later = float(np.median(peak_memory[len(peak_memory) // 2 :]))
        memory = {"peak MB, not shared": max(peak_memory), "MB in the second half": later}
        return quantities | {"us a target (all processes)": time_each, "missed": missed} | memory

    return measure


FIRST = {
    "single": "solver.solve(grasp)",
    "fast": "solver.fast()(points, normals)",
    "batch": "solver.solve_batch(*(np.tile(a, (8, 1, 1)) for a in (points, normals)))",
    "scene": "solver = ik.Solver(robot, scene=ik.Scene({'table': TABLE})); "
    "solver.choose([grasp], q0=robot.home)",
}
"""First request of a new process: a program."""

PROGRAM = """
import time
import numpy as np
begin = time.perf_counter()
import casadi_ik as ik
imported = time.perf_counter()
robot = ik.load_robot({robot!r})
solver = ik.Solver(robot, {method!r})
points, normals = robot.contacts(robot.home)
contacts = zip(robot.fingers, points, normals)
grasp = ik.Grasp({{name: ik.Contact(p, n) for name, p, n in contacts}})
# An arm stands on it; a body's pelvis and what hangs from it have room above.
below = 1.5 if robot.description.sides else 0.0
TABLE = {{"kind": "box", "size": [2, 2, 0.04], "xyz": [0, 0, -0.02 - below]}}
{ask}
print(imported - begin, time.perf_counter() - imported)
"""


def first_use(robot: str, ask: str, method: str) -> Callable[[], Quantities]:
    """Measure a new process until its first solution, with an empty and with a full cache."""

    def measure() -> Quantities:
        with tempfile.TemporaryDirectory() as place:
            program = PROGRAM.format(robot=robot, method=method, ask=FIRST[ask])

            def run() -> tuple[float, float, float]:
                time_before = _children()
                environment = os.environ | {"CASADI_IK_CACHE": place}
                text = subprocess.run(
                    [sys.executable, "-c", program],
                    env=environment,
                    capture_output=True,
                    text=True,
                    check=True,
                ).stdout
                imported, answered = map(float, text.split())
                return imported, answered, _children() - time_before

            _, cold, cpu = run()
            imported, warm, _ = run()
        times = {"empty cache s (wall)": cold, "empty cache s (all processes)": cpu}
        return times | {"full cache s (wall)": warm, "import s (wall)": imported}

    return measure


def _children() -> float:
    return sum(os.times()[2:4])


def export(robot: str, target: str, *flags: str) -> Callable[[], Quantities]:
    """Measure the exported solver, built with the compiler of the machine."""
    folder = Path(tempfile.mkdtemp(prefix="casadi_ik-bench-")) / "solver"
    words = [robot, "--out", str(folder), "--target", target, "--prefix", "arm", *flags]
    _run(sys.executable, "-m", "casadi_ik", "export", *words)
    if target == "wasm":
        quantities = {"bytes": float(sum(path.stat().st_size for path in folder.glob("*.wasm")))}

        def in_node() -> Quantities:
            times = json.loads(_run("node", "test.mjs", folder=folder))
            return quantities | {"us in node (wall, median)": times["median"]}

        node = subprocess.run(["node", "--version"], capture_output=True).returncode == 0
        return in_node if node else lambda: quantities
    _run("make", folder=folder)
    table = _run("size", "-t", "build/libarm.a", folder=folder).splitlines()[1:]
    texts = {line.split()[5]: int(line.split()[0]) for line in table}
    tables = sum(size for name, size in texts.items() if "tables" in name)
    total_bytes = next(size for name, size in texts.items() if name.startswith("(TOTALS)"))
    (folder / "stack.c").write_text((PROBES / "stack.c").read_text())
    real = "-DREAL=float" if "--single" in flags else "-DREAL=double"
    flags_of = (real, "-O2", "-Iinclude", "-Itest", "stack.c", "build/libarm.a", "-lm", "-pthread")
    _run("cc", *flags_of, "-o", "build/stack", folder=folder)
    stack, solver = map(float, _run("build/stack", folder=folder).split())
    sizes = {"stack bytes": stack, "solver bytes": solver}

    def measure() -> Quantities:
        output = json.loads(_run("build/bench", "2", "20000", folder=folder))
        times = {"us": output["cpu_mean"], "99.9 % us (wall)": output["p99.9"]}
        return times | {"code bytes": total_bytes - tables, "table bytes": float(tables)} | sizes

    return measure


def _run(*words: str, folder: Path | None = None) -> str:
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(words)}: {done.stdout}{done.stderr}")
    return done.stdout


def logs(robot: str, method: str, compression: str, count: int) -> Callable[[], Quantities]:
    """Measure a batch with and without a log, the size of the log, and reading it."""
    settings: dict[str, Any] = {}
    if method != "hand-first":
        settings, count = {"finger_step": "closed-form", "limits": "ignore"}, max(count // 25, 12)
    solver = ik.Solver(ik.load_robot(robot), method, **settings)
    targets = sampled_contacts(
        solver.robot, "grasps" if suits(solver.robot, "grasps") else "random", count
    )
    path = Path(tempfile.mkdtemp(prefix="casadi_ik-bench-")) / "bench.mcap"
    iterations = int(solver.solve_batch(*targets).iterations.sum())

    def logged(quantities: Quantities, name: str, **options: Any) -> None:
        begun = time.process_time()
        with clock(quantities, f"{name} us a solve (wall)", count, wall=True):
            solver.solve_batch(*targets, **options)
        quantities[f"{name} us a solve (all threads)"] = 1e6 * (time.process_time() - begun) / count

    def measure() -> Quantities:
        quantities: Quantities = {"iterations": float(iterations)}
        logged(quantities, "without")
        logged(quantities, "logged", log=path, compression=compression)
        quantities["bytes an iteration"] = path.stat().st_size / iterations
        log = ik.logs.open(path)
        with clock(quantities, "read us an iteration", iterations):
            table = log.iterations()
        with clock(quantities, "to polars us an iteration", iterations):
            table.frame()
        sampled = ik.logs.Keep(sample=0.01)
        logged(quantities, "sampled", log=path, compression=compression, keep=sampled)
        return quantities

    return measure


def peer(
    robot: str, sampler: str, tolerance: str, name: str, count: int
) -> Callable[[], Quantities]:
    """Measure another solver on the same targets with restarts; see `peers`."""
    peers = importlib.import_module("peers")
    arm_hand = ik.load_robot(robot)
    targets = sampled_contacts(arm_hand, sampler, count)
    ours = batch(robot, sampler, tolerance, count)
    single_calls, fine = fast(robot, count), TOLERANCES[tolerance]

    def measure() -> Quantities:
        run = peers.run_peer(name, arm_hand, targets, fine)
        mean = 1e6 * float(run.times.mean())
        batch_time, fast_time = (
            min(measure_call()["us"] for _ in range(5)) for measure_call in (ours, single_calls)
        )
        quantities = {"us": mean, "99 % us": 1e6 * float(np.quantile(run.times, 0.99))}
        quantities |= {"over our batch": mean / batch_time, "over our fast": mean / fast_time}
        return quantities | {"solved %": 100 * run.solved, "first start %": 100 * run.first}

    return measure


def view(page: str, painted: bool, flow: bool) -> Callable[[], Quantities]:
    """Measure the latency of the viewer in a browser; see `bench_view`."""
    return partial(importlib.import_module("bench_view").measure, page, painted, flow)
