"""What `bench.py` measures; as a program the process that measures one version of the package.

A case is a part's name, a robot and more words or numbers; of it a measurement is made ready once
and then called turn by turn. Public names of the package only: other versions run this, too.
"""

from __future__ import annotations

import contextlib
import importlib
import inspect
import json
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from samplers import SAMPLERS, grasps_of, random_arm_targets, suits

import casadi_ik as ik

PROBES = Path(__file__).parent / "probes"
"""Programs beside those that are measured; `stack.c` marks the stack of a solve."""

SHARED = "CASADI_IK_BENCH_TARGETS"
"""Variable of the environment: the folder of targets that all processes of a run share."""

Quantities = dict[str, float]
Case = tuple[Any, ...]
Targets = tuple[Any, Any]

TOLERANCES = {"5mm": ik.Tolerance(), "1e-6": ik.Tolerance(1e-6, 1e-6)}
WARM = 300
"""Targets solved before times are taken, at most."""

OF_FILE = 200_000
"""Targets of a file of many."""

FAST, SINGLE = 1000, 200
"""Calls of a turn."""

SCENE = {
    "table": {"kind": "box", "size": [1.6, 1.6, 0.04], "xyz": [0.0, 0.0, -0.1]},
    "post": {"kind": "cylinder", "radius": 0.06, "length": 0.6, "xyz": [0.45, 0.25, 0.3]},
}
CANDIDATES, OF_OBJECT = 50, 500
"""Candidates of a choice: those of a scene's batch, and in an object's frame."""

CYCLES, PERIOD = 500, 1e-3
"""Number of cycles of a follower, and their length [s]."""


def shared(name: str, make: Callable[[], Any]) -> Any:
    """Return a folder that the first caller fills for all processes of a run."""
    folder = os.environ.get(SHARED)
    if folder is None:
        return make()
    path = Path(folder) / f"{name}.pickle"
    if not path.exists():
        path.write_bytes(pickle.dumps(make()))
    return pickle.loads(path.read_bytes())


def sampled_contacts(robot: ik.ArmHand, sampler: str, count: int) -> Targets:
    """Contacts of a sampler, the same in every process."""

    def draw() -> Targets:
        return robot.contacts(SAMPLERS[sampler][1](robot, np.random.default_rng(0), count))

    return shared(f"{robot.name}-{sampler}-{count}", draw)


@contextlib.contextmanager
def clock(quantities: Quantities, name: str, count: int, wall: bool = False) -> Any:
    """Processor time of this thread (or time on the wall) of what is done, by its count [us]."""
    timer = time.perf_counter if wall else time.thread_time
    begun = timer()
    yield
    quantities[name] = 1e6 * (timer() - begun) / count


def batch(robot: str, sampler: str, tolerance: str, count: int) -> Callable[[], Quantities]:
    """`solve_batch`, a target."""
    solver = ik.Solver(ik.load_robot(robot), tolerance=TOLERANCES[tolerance])
    targets = sampled_contacts(solver.robot, sampler, count)
    solver.solve_batch(*(array[:WARM] for array in targets))
    solver.solve_batch(*targets)

    def measure() -> Quantities:
        quantities: Quantities = {}
        with clock(quantities, "us", count):
            solved = solver.solve_batch(*targets)
        return quantities | {"missed": float((~solved.success).sum())}

    return measure


def fast(robot: str, count: int) -> Callable[[], Quantities]:
    """`Solver.fast`, a call."""
    solver = ik.Solver(ik.load_robot(robot))
    targets = list(zip(*sampled_contacts(solver.robot, "random", count), strict=True))
    call, home = solver.fast(), solver.robot.home
    for points, normals in targets:
        call(points, normals, home)

    def measure() -> Quantities:
        quantities: Quantities = {}
        with clock(quantities, "us", count):
            for points, normals in targets:
                call(points, normals, home)
        return quantities

    return measure


def single(robot: str, count: int) -> Callable[[], Quantities]:
    """`Solver.solve`, a call."""
    solver = ik.Solver(ik.load_robot(robot))
    grasps = grasps_of(solver.robot, *sampled_contacts(solver.robot, "random", count))

    def measure() -> Quantities:
        quantities: Quantities = {}
        with clock(quantities, "us", count):
            for grasp in grasps:
                solver.solve(grasp)
        return quantities

    measure()
    return measure


def scene(robot: str, count: int) -> Callable[[], Quantities]:
    """Batch and choice among a table and a post, and all solutions without them.

    Several answers of a candidate count in the choice: code that knows no other way is compared.
    """
    solver = ik.Solver(ik.load_robot(robot), scene=ik.Scene(SCENE))
    plain = ik.Solver(solver.robot)
    targets = sampled_contacts(solver.robot, "random", count)
    grasps = grasps_of(solver.robot, *(array[:CANDIDATES] for array in targets))
    home = solver.robot.home
    has_limit = "per_candidate" in inspect.signature(solver.choose).parameters
    any_number: dict[str, Any] = {"per_candidate": None} if has_limit else {}

    def measure() -> Quantities:
        quantities: Quantities = {}
        with clock(quantities, "batch us", count):
            solved = solver.solve_batch(*targets)
        with clock(quantities, "choose us a candidate", CANDIDATES):
            ranked = solver.choose(grasps, q0=home, **any_number)
        with clock(quantities, "solve_all us", 5):
            for grasp in grasps[:5]:
                plain.solve_all(grasp)
        counts = {"not free": float((~solved.success).sum()), "answered": float(ranked.answered)}
        return quantities | counts

    measure()
    return measure


def clutter(robot: str, place: int) -> Callable[[], Quantities]:
    """Solve every third grasp of a place of the collision study, in batches of 256."""
    arm_hand = ik.load_robot(robot)

    def placed() -> list[Any]:
        search = importlib.import_module("collision_study.search")
        pieces = [search.Piece(robot, clutter, place, 3, 0) for clutter in (0, 3, 8)]
        return [case for piece in pieces for case in list(search.targets_at(piece))[::3]]

    cases = []
    for solids, name, points, normals, poses in shared(f"{robot}-clutter-{place}", placed):
        indices = np.arange(256) % len(points)
        targets = {
            "points": points[indices],
            "normals": normals[indices],
            "object_pose": poses[indices],
        }
        solver = ik.Solver(arm_hand, scene=ik.Scene(solids, grasped=name))
        solver.solve_batch(**targets)
        cases.append((solver, targets, len(points)))

    def measure() -> Quantities:
        seconds, solved, count = 0.0, 0, 0
        for solver, targets, size in cases:
            begun = time.thread_time()
            batch = solver.solve_batch(**targets)
            seconds += (time.thread_time() - begun) * size / len(batch.q)
            solved, count = solved + int(batch.success[:size].sum()), count + size
        return {"us": 1e6 * seconds / count, "solved": float(solved), "targets": float(count)}

    return measure


def choose(robot: str, grasp_kind: str, around: str) -> Callable[[], Quantities]:
    """Choosing among grasps in an object's frame, hands at random about it, from any side."""
    arm_hand, rng = ik.load_robot(robot), np.random.default_rng(0)
    solver = ik.Solver(arm_hand, scene=ik.Scene(SCENE) if around == "scene" else None)
    pose, q = np.eye(4), arm_hand.random(rng, OF_OBJECT)
    pose[:3, 3] = 0.5, 0.1, 0.3
    turns = np.linalg.qr(rng.normal(size=(OF_OBJECT, 3, 3)))[0]
    turns[:, :, 0] *= np.linalg.det(turns)[:, None]
    points, normals = arm_hand.contacts(q)
    palms, middle = arm_hand.palm(q), points.mean(axis=1, keepdims=True)
    # Turned about the middle of the fingertips, which is put where the object is.
    palms[:, :3, 3] = ((palms[:, None, :3, 3] - middle) @ turns)[:, 0]
    palms[:, :3, :3] = np.swapaxes(turns, 1, 2) @ palms[:, :3, :3]
    moving = {i for name in arm_hand.fingers for i in arm_hand.description.finger_actuators(name)}
    postures = [{arm_hand.actuators[i]: float(row[i]) for i in moving} for row in q]
    grasps = grasps_of(arm_hand, (points - middle) @ turns, normals @ turns)
    if grasp_kind == "palms":
        grasps = [ik.Grasp(palm=p, posture=h) for p, h in zip(palms, postures, strict=True)]

    def measure() -> Quantities:
        quantities: Quantities = {}
        with clock(quantities, "us a candidate", OF_OBJECT):
            ranked = solver.choose(grasps, pose, arm_hand.home)
        return quantities | {"answered": float(ranked.answered)}

    measure()
    return measure


def follow(robot: str) -> Callable[[], Quantities]:
    """Measure a cycle of a follower of a slow motion."""
    solver = ik.Solver(ik.load_robot(robot))
    arm_hand, rng = solver.robot, np.random.default_rng(0)
    middle, half_range = (
        (arm_hand.lower + arm_hand.upper) / 2,
        (arm_hand.upper - arm_hand.lower) / 2,
    )
    directions = rng.uniform(-0.1, 0.1, (2, len(middle))) * half_range
    turn = np.linspace(0, 0.5, CYCLES)[:, None]
    path = middle + directions[0] * np.sin(turn) + directions[1] * turn**2
    targets = list(zip(*arm_hand.contacts(path), strict=True))

    def measure() -> Quantities:
        quantities, follower = Quantities(), solver.follow(path[0], PERIOD)
        with clock(quantities, "us", CYCLES):
            for points, normals in targets:
                follower(points, normals)
        return quantities

    measure()
    return measure


def diagnosis(robot: str, kind: str, count: int) -> Callable[[], Quantities]:
    """Measure the cost of a diagnosis for unsolved targets."""
    solver, rng = ik.Solver(ik.load_robot(robot)), np.random.default_rng(0)
    points, normals = sampled_contacts(solver.robot, "random", count)
    if kind == "far":
        points = points + np.array([1.5, 0.0, 0.0])
    elif kind == "moved":
        points = points + rng.normal(0, 0.03, points.shape)
    else:
        normals = normals + rng.normal(0, 0.5, normals.shape)
        normals = normals / np.linalg.norm(normals, axis=2, keepdims=True)
    left = ~solver.solve_batch(points, normals, diagnose=True).success
    targets = points[left], normals[left]

    def measure() -> Quantities:
        quantities: Quantities = {}
        with clock(quantities, "solve us", len(targets[0])):
            solver.solve_batch(*targets)
        with clock(quantities, "with reason us", len(targets[0])):
            solver.solve_batch(*targets, diagnose=True)
        return quantities | {"not solved": float(left.sum())}

    return measure


def methods(robot: str, method: str, step: str) -> Callable[[], Quantities]:
    """Measure an iteration of a method on built-in grasps."""
    arm_hand = ik.load_robot(robot)
    solver = ik.Solver(arm_hand, method, finger_step=step or None)
    iterations = 1 if step == "ipopt" else 10
    names = ik.shipped_grasps(robot)[: 2 if step == "ipopt" else None]
    targets = random_arm_targets(arm_hand, names, iterations, np.random.default_rng(0))
    total = int(solver.solve_batch(*targets).iterations.sum())

    def measure() -> Quantities:
        quantities: Quantities = {}
        with clock(quantities, "us an iteration", total):
            solver.solve_batch(*targets)
        return quantities | {"iterations": float(total)}

    return measure


def threads(robot: str, count: int) -> Callable[[], Quantities]:
    """Two threads and one, time on the wall."""
    solver = ik.Solver(ik.load_robot(robot))
    targets = sampled_contacts(solver.robot, "random", count)
    solver.solve_batch(*targets)

    def measure() -> Quantities:
        quantities: Quantities = {}
        for jobs in (1, 2):
            with clock(quantities, f"jobs={jobs} us (wall)", count, wall=True):
                solver.solve_batch(*targets, jobs=jobs)
        return quantities

    return measure


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


MEASUREMENTS: dict[str, Callable[..., Callable[[], Quantities]]] = {
    "batch": batch,
    "fast": fast,
    "single": single,
    "scene": scene,
    "clutter": clutter,
    "choose": choose,
    "follow": follow,
    "diagnosis": diagnosis,
    "methods": methods,
    "threads": threads,
    "memory": memory,
    "many": large_batch,
    "first-use": first_use,
    "export": export,
    "logs": logs,
    "peers": peer,
    "view": view,
}

ABROAD = ("first-use", "memory", "many", "peers", "view")
"""Measured once."""


def _samplers(robot: str) -> list[str]:
    other_robot = ik.load_robot(robot)
    return [name for name in ("random", "grasps", "limits") if suits(other_robot, name)]


def _batches(robots: list[str], count: int, _: str) -> list[Case]:
    return [
        (robot, sampler, tolerance, count)
        for robot in robots
        for sampler in _samplers(robot)
        for tolerance in TOLERANCES
    ]


def _methods(*_: Any) -> list[Case]:
    steps = {name: ("closed-form", "ipopt") for name in ik.METHODS if name.startswith("enhanced")}
    other_methods = [name for name in ik.METHODS if name not in ("hand-first", "ipopt")]
    return [
        ("kuka_lwr_barrett", name, step)
        for name in other_methods
        for step in steps.get(name, ("",))
    ]


def _peers(robots: list[str], count: int, _: str) -> list[Case]:
    names = importlib.import_module("peers").installed()
    return [
        (robot, sampler, tolerance, name, min(count, 60))
        for robot in robots
        for sampler in _samplers(robot)[:2]
        for tolerance in TOLERANCES
        for name in names
    ]


CASES: dict[str, Callable[[list[str], int, str], list[Case]]] = {
    "batch": _batches,
    "fast": lambda robots, *_: [(robot, FAST) for robot in robots],
    "single": lambda robots, *_: [(robot, SINGLE) for robot in robots],
    "scene": lambda robots, count, _: [(robot, min(count, 200)) for robot in robots],
    "clutter": lambda robots, *_: [(robot, place) for robot in robots for place in range(4)],
    "choose": lambda robots, *_: [
        (robot, grasp_kind, around)
        for robot in robots
        for grasp_kind in ("palms", "contacts")
        for around in ("free", "scene")
    ],
    "follow": lambda robots, *_: [(robot,) for robot in robots],
    "diagnosis": lambda robots, *_: [
        (robot, kind, 60) for robot in robots for kind in ("far", "moved", "turned")
    ],
    "methods": _methods,
    "threads": lambda robots, count, _: [(robot, 4 * count) for robot in robots],
    "memory": lambda robots, count, _: [(robot, 50 * count) for robot in robots[:1]],
    "many": lambda robots, count, _: [(robot, count) for robot in robots],
    "first-use": lambda robots, *_: [
        (robot, ask, "hand-first") for robot in robots for ask in FIRST
    ],
    "export": lambda robots, *_: [
        (robot, *words)
        for robot in robots
        for words in (("c",), ("c", "--single"), ("c", "--scene", "8"), ("wasm",))
    ],
    "logs": lambda _, count, __: [
        ("kuka_lwr_barrett", method, compression, count)
        for method in ("hand-first", "enhanced-dls")
        for compression in ("zstd", "lz4", "none")
    ],
    "peers": _peers,
    "view": lambda _, __, page: [
        (place, painted, flow)
        for place in ("server", *([page] if Path(page).is_file() else []))
        for painted, flow in ((True, False), (False, False), (False, True))
    ],
}
"""The cases of every part, behind its name, from robots, targets of a batch, and the page without
a server."""


@cache
def _ready(case: Case) -> Callable[[], Quantities]:
    return MEASUREMENTS[case[0]](*case[1:])


def serve() -> None:
    """Measure cases as they come, a line of JSON each."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no answer
    for line in sys.stdin:
        try:
            output: dict[str, Any] = {"found": _ready(tuple(json.loads(line)))()}
        except Exception as error:
            output = {"error": f"{type(error).__name__}: {error}"[:300]}
        answers.write(json.dumps(output) + "\n")
        answers.flush()


if __name__ == "__main__":
    serve()
