r"""How near does `best_effort` come to targets out of reach, and how long does it take?

Targets of arms are poses of random configurations that are moved away from the base and turned;
those of hands are contacts that are moved away from the base, so that none can be reached. The
reference is the best of a search with many more seeds, of random starts that descend to a local
minimum, and of the answer itself::

    OPENBLAS_NUM_THREADS=1 python studies/best_effort.py --report studies/results/best_effort
    python studies/best_effort.py --robots ur5e panda --count 2000 --starts 512

A run that is killed continues where it stopped.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from runner.parts import read_parts, run_parts
from runner.report import Metric, command, markdown_table, median_metric, program, publish
from scipy.spatial.transform import Rotation

import casadi_ik as ik
from casadi_ik.files.arrays import Array
from casadi_ik.solve.nearest import NearestSearch, NearestSettings
from casadi_ik.solve.nearest_seeds import SeedSettings

FIVE_AXES = "viperx_300s"
"""Arm whose fourth motor is fixed, so that it has the five axes of small arms."""

ROBOTS = (
    "so101",
    FIVE_AXES,
    "ur5e",
    "iiwa14",
    "panda",
    "kuka_lwr_barrett",
    "panda+allegro_right",
    "panda+shadow",
    "g1+dex3",
)
EXCESSES = (0.001, 0.005, 0.02, 0.1)
"""Distances by which targets are beyond the reach of random configurations [m]."""

TURNS = (0.0, 2.0, 10.0, 45.0)
"""Angles by which poses are turned about random axes [deg]."""

THOROUGH = NearestSettings(
    seeds=SeedSettings(regions=1024, seeds=(512, 0)), race_steps=20, finalists=(128, 0)
)
"""Settings of the search of the reference."""

SINGLE_CALLS = 100
"""Number of targets whose search is timed alone."""

REACH_SAMPLES = 20_000
"""Number of configurations from which the reach of a robot is estimated."""

SAME_GAP, WORSE_GAP = 1e-6, 1e-2
"""Relative excesses over the distance of the reference that the report counts."""

WORSE_BY = 1e-3
"""Excess of the root of the distance that the report counts [m of position tolerance]."""

TIMES = ("search", "single", "warm", "total", "call")
"""Keys of the measured times."""

INTRODUCTION = """
Targets of arms are poses: position and the full orientation. Contacts of random configurations are
moved away from the base until their centre is 1, 5, 20 or 100 mm beyond the farthest centre of
{samples:,} random configurations; poses are also turned by 0, 2, 10 or 45 degrees. The fourth motor
of the {five_axes} is fixed. *Above the best*: the distance (the sum of squared errors, each divided
by its tolerance) exceeds that of the reference by more than this part; *1 mm*: the root of the
distance, times the position tolerance, exceeds it by more than 1 mm. The reference is the best of
the answer, of a search with 512 seeds and of {starts} random starts that descend to local minima.
It is not proved to be the minimum. *Search*: processor time of one core for a target in a batch,
without the solve that fails first; *single*: for a search of one target in one call, which includes
the overhead of Python; *warm*: of one descent from the previous answer; *total*: of a target in a
batch with the solve that fails; *call*: of `Solver.solve` with `best_effort=True` for one target.
"""


@dataclass(frozen=True)
class Part:
    """Targets that are solved in one call.

    Attributes:
        robot: Name of the robot.
        number: Number of the part.
        size: Number of targets.
        starts: Number of random starts of the reference.
        seed: Seed of the targets.
    """

    robot: str
    number: int
    size: int
    starts: int
    seed: int

    @property
    def path(self) -> Path:
        """Path of the results."""
        name = f"{self.number:05d}-{self.size}-{self.starts}-{self.seed}.json"
        return Path("best_effort") / self.robot / name


def targets_of(
    robot: ik.ArmHand, rng: np.random.Generator, count: int
) -> tuple[Array, Array, dict[str, Any]]:
    """Return contacts (count, f, 3), normals, and tangents of poses, out of a robot's reach."""
    samples = robot.contacts(robot.random(np.random.default_rng(0), REACH_SAMPLES))[0].mean(axis=1)
    reach = np.linalg.norm(samples, axis=1).max() + rng.choice(EXCESSES, count)
    frames = robot.contact_frames(robot.random(rng, count))
    points = frames[..., :3, 3]
    centres = points.mean(axis=1)
    distances = np.linalg.norm(centres, axis=1)
    points = points + ((reach / distances - 1)[:, None] * centres)[:, None]
    if len(robot.fingers) > 1:
        return points, frames[..., :3, 0], {}
    axes = rng.normal(size=(count, 3))
    axes *= (np.radians(rng.choice(TURNS, count)) / np.linalg.norm(axes, axis=1))[:, None]
    rotated = Rotation.from_rotvec(axes).as_matrix()[:, None] @ frames[..., :3, :3]
    return points, rotated[..., 0], {"tangents": rotated[..., 1]}


def grasp_of(
    robot: ik.ArmHand, points: Array, normals: Array, tangents: dict[str, Array]
) -> ik.Grasp:
    """Return the grasp of a row of `targets_of`."""
    contacts = {}
    for i, finger in enumerate(robot.fingers):
        tangent = tangents["tangents"][i] if tangents else None
        contacts[finger] = ik.Contact(points[i], normals[i], tangent=tangent)
    return ik.Grasp(contacts)


def solve(part: Part) -> dict[str, Any]:
    """Solve a part, and its reference."""
    robot = ik.load_robot(part.robot)
    solver, rng = ik.Solver(robot), np.random.default_rng([part.seed, part.number])
    points, normals, tangents = targets_of(robot, rng, part.size)
    fixed = {robot.actuators[3]: float(robot.home[3])} if part.robot == FIVE_AXES else None
    options: dict[str, Any] = {"fixed": fixed, "best_effort": True}
    for limit in (2, 100):  # a first use compiles the kernels of single rows and of lanes
        first: dict[str, Any] = {name: array[:limit] for name, array in tangents.items()}
        solver.solve_batch(points[:limit], normals[:limit], **options, **first)
    begin = time.process_time()
    batch = solver.solve_batch(points, normals, **options, **tangents)
    total = (time.process_time() - begin) / part.size
    rows = np.flatnonzero(batch.status == ik.Status.NEAREST)
    vectors: dict[str, Any] = {name: array[rows] for name, array in tangents.items()}
    targets = solver._target_builder.from_arrays(points[rows], normals[rows], vectors, fixed=fixed)
    search: NearestSearch = solver._engine.engine_for(targets).nearest_search
    home, owner = np.tile(robot.home, (len(rows), 1)), np.arange(len(rows))
    begin = time.process_time()
    search.find(targets, home)
    seconds = (time.process_time() - begin) / len(rows)
    distance = search.distances(targets, owner, batch.q[rows])
    reference = distance.copy()
    candidates = [search.with_settings(THOROUGH).find(targets, home).q]
    first_rows = range(min(SINGLE_CALLS, len(rows)))
    singles = [targets.rows(slice(i, i + 1)) for i in first_rows]
    begin = time.process_time()
    for target in singles:
        search.find(target, home[:1])
    single = (time.process_time() - begin) / len(singles)
    singles = [
        target.starting_at(batch.q[rows[i]]) for i, target in zip(first_rows, singles, strict=True)
    ]
    begin = time.process_time()
    for target in singles:
        search.descend(target)
    warm = (time.process_time() - begin) / len(singles)
    grasps = [
        grasp_of(robot, points[row], normals[row], {k: v[row] for k, v in tangents.items()})
        for row in rows[: len(singles)]
    ]
    begin = time.process_time()
    for grasp in grasps:
        solver.solve(grasp, fixed=fixed, diagnose=False, best_effort=True)
    call = (time.process_time() - begin) / len(grasps)
    candidates += [
        search.descend(targets.starting_at(robot.random(rng, len(rows))), is_local=False)
        for _ in range(part.starts)
    ]
    for q in candidates:
        reference = np.minimum(reference, search.distances(targets, owner, q))
    gap = distance / reference - 1
    tolerance = float(targets.position_tolerance.max())
    excess = tolerance * (np.sqrt(distance) - np.sqrt(reference))
    return {
        "nearest": len(rows),
        "same": int((gap <= SAME_GAP).sum()),
        "worse": int((gap > WORSE_GAP).sum()),
        "worse_by": int((excess > WORSE_BY).sum()),
        "search": seconds,
        "single": single,
        "warm": warm,
        "total": total,
        "call": call,
    }


def report(
    done: Sequence[tuple[Part, dict[str, Any]]], starts: int
) -> tuple[str, str, list[Metric]]:
    """Return the result sentence, the table and the metrics of the report."""
    rows, metrics, near_shares, slowdowns = [], list[Metric](), [1.0], list[float]()
    for robot in dict.fromkeys(part.robot for part, _ in done):
        results = [result for part, result in done if part.robot == robot]
        keys = ("nearest", "same", "worse", "worse_by")
        count, n_same, n_worse, n_worse_by = (sum(item[key] for item in results) for key in keys)
        times = {key: [1e6 * item[key] for item in results] for key in TIMES}
        shares = [
            f"{100 * part / max(count, 1):.2f}" for part in (count - n_same, n_worse, n_worse_by)
        ]
        medians = [f"{np.median(values):.0f}" for values in times.values()]
        slowdowns.append(float(np.median(times["single"]) / np.median(times["search"])))
        near_shares.append(1 - n_worse / max(count, 1))
        rows.append([robot, f"{count:,}", *shares, *medians])
        metrics.append(median_metric(f"best_effort/{robot}/time", times["search"], "us"))
    heads = ["robot", "targets", "above the best by 1e-6 %", "by 1e-2 %", "by 1 mm %"]
    heads += [f"{key} [us]" for key in TIMES]
    text = INTRODUCTION.format(samples=REACH_SAMPLES, starts=starts, five_axes=FIVE_AXES)
    result = (
        f"For every robot, at least {100 * min(near_shares):.1f} % of the answers are within "
        f"{100 * WORSE_GAP:g} % of the best distance known. A search of one target takes "
        f"{min(slowdowns):.1f} to {max(slowdowns):.1f} times as long as in a batch."
    )
    return result, f"{text}\n{markdown_table(heads, rows)}", metrics


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description="Nearest configurations of targets out of reach.")
    parser.add_argument("--robots", nargs="+", default=ROBOTS, help="names of robots")
    parser.add_argument("--count", type=int, default=2000, help="targets of every robot")
    parser.add_argument("--block", type=int, default=500, help="targets solved in one call")
    parser.add_argument("--starts", type=int, default=64, help="random starts of the reference")
    parser.add_argument("--seed", type=int, default=0, help="seed of the targets")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster instead")
    parser.add_argument("--out", type=Path, default=Path("out"), help="results by part")
    parser.add_argument("--report", type=Path, help="folder (default: OUT/report)")
    options = parser.parse_args(arguments)
    block = min(options.block, options.count)
    parts = [
        Part(robot, number, block, options.starts, options.seed)
        for number in range(-(-options.count // block))
        for robot in options.robots
    ]
    run_parts(solve, parts, options.out, jobs=options.jobs, dask=options.dask)
    done, codes = read_parts(options.out, parts)
    result, text, metrics = report(done, options.starts)
    publish(
        "Nearest configurations of targets out of reach",
        result,
        [text],
        options.report or options.out / "report",
        command(__file__, arguments),
        {"best_effort": codes},
        metrics,
    )


if __name__ == "__main__":
    program(main)
