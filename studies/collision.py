"""Free of collision: what a check costs, whether it is right, and what the choice finds.

*Check:* panda with an Allegro hand, a table and a cylinder; the same shapes and pairs by coal
through pinocchio and by MuJoCo, in one run. *Choice:* the shipped grasps anywhere on a table with
clutter, compared with a dense search of the solutions of each target::

    python studies/collision.py --report studies/results/collision
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from collision_study.oracles import CoalOracle, MuJoCoOracle
from collision_study.search import MICROMETRE, SAFE, TURNS, Piece, solve_piece, surroundings
from rich.console import Console
from runner import (
    Metric,
    command,
    interval_text,
    markdown_table,
    mean_metric,
    program,
    provenance,
    rate_metric,
    write_metrics,
    write_page,
)
from runner.cluster import backend
from runner.results import code_version

import casadi_ik as ik
from casadi_ik.problem.clearance import SceneCheck

SCENE = {
    "table": {"kind": "box", "size": [1.6, 1.6, 0.04], "xyz": [0.0, 0.0, -0.1]},
    "post": {"kind": "cylinder", "radius": 0.06, "length": 0.6, "xyz": [0.45, 0.25, 0.3]},
}
CLUTTER = (0, 3, 8)
REPEATS = 7


def least_time(call: Callable[[], object], count: int) -> float:
    """Microseconds of each of `count` configurations, the least of some repeats."""
    best = np.inf
    for _ in range(REPEATS):
        begin = time.process_time()
        call()
        best = min(best, time.process_time() - begin)
    return 1e6 * best / count


def check(count: int, timed: int, seed: int) -> tuple[list[list[str]], list[str]]:
    """Rows on time, and sentences on agreement."""
    robot = ik.load_robot("panda+allegro_right")
    rng = np.random.default_rng(seed)
    points, normals = (each[0] for each in robot.contacts(robot.random(rng, 1)))
    names = zip(robot.fingers, points, normals, strict=True)
    grasp = ik.Grasp({name: ik.Contact(point, normal) for name, point, normal in names})
    around = surroundings(SceneCheck(robot, ik.Scene(SCENE)), robot, grasp)
    coal, mujoco = CoalOracle(robot, around), MuJoCoOracle(robot, around)
    q = robot.random(rng, count)
    free = around.free(q)
    begin = time.perf_counter()
    theirs = coal.penetrating(q, MICROMETRE)
    console = Console()
    console.print(f"coal: {count} in {time.perf_counter() - begin:.0f} s")
    false_free = int((free & theirs).sum())
    false_hit = int((~free & ~theirs).sum())
    by_mujoco = mujoco.touching(q[: min(count, 20000)], MICROMETRE)
    some = slice(0, len(by_mujoco))
    sentences = [
        f"{count} random configurations, seed {seed}, {len(around.table.pairs)} pairs of "
        f"{len(around.table.radii)} capsules and {len(around.table.solids)} solids; "
        f"{100 * free.mean():.1f} % are free. Called free though coal sees a penetration beyond "
        f"1 um: **{false_free}**. Called touching though coal sees none: {false_hit} "
        f"({100 * false_hit / max(int((~theirs).sum()), 1):.2f} % of what is free for coal).",
        f"MuJoCo, {len(by_mujoco)} of them: called free though it sees a penetration beyond 1 um: "
        f"**{int((free[some] & by_mujoco).sum())}**.",
    ]
    part = q[:timed]
    frees = part[free[:timed]]
    rows = []
    for name, some_q in (("random", part), ("free", frees)):
        ours = least_time(lambda x=some_q: around.check(x), len(some_q))
        quick = least_time(lambda x=some_q: around.free(x), len(some_q))
        few = some_q[:400]
        pin_any = least_time(lambda x=few: coal.run(x), len(few))
        pin_all = least_time(lambda x=few: coal.distances(x), len(few))
        mj = least_time(lambda x=few: mujoco.run(x), len(few))
        rows.append(
            [
                name,
                *(f"{v:.2f}" for v in (ours, quick, pin_any, pin_all, mj)),
                f"{pin_all / ours:.0f}",
                f"{pin_any / quick:.0f}",
                f"{mj / quick:.1f}",
            ]
        )
    return rows, sentences


def pieces(options: argparse.Namespace) -> list[Piece]:
    """What is asked for, so that what is done so far is as much of every clutter."""
    return [
        Piece(robot, clutter, number, options.seed, options.searched)
        for number in range(options.count)
        for robot in options.robot
        for clutter in CLUTTER
    ]


def _path(piece: Piece, folder: Path) -> Path:
    name = f"{piece.robot}-{piece.clutter}-{piece.number}-{piece.seed}-{piece.searched}"
    return folder / f"{name}.json"


def run(options: argparse.Namespace) -> None:
    """Solve the pieces that have not been."""
    todo = [piece for piece in pieces(options) if not _path(piece, options.out).exists()]
    options.out.mkdir(parents=True, exist_ok=True)
    with backend(options.jobs, None):
        parallel = joblib.Parallel(return_as="generator_unordered")
        for piece, found in parallel(joblib.delayed(solved)(piece) for piece in todo):
            path = _path(piece, options.out)
            part = path.with_suffix(".part")
            part.write_text(json.dumps(found), encoding="utf-8")
            part.replace(path)


def solved(piece: Piece) -> tuple[Piece, dict[str, Any]]:
    """A piece, and what came of it."""
    return piece, {"code": code_version(), **solve_piece(piece)}


def choices(options: argparse.Namespace) -> tuple[list[list[str]], list[Metric], str]:
    """Rows on completeness and time by clutter, the figures, and what code they are of."""
    rows, metrics, codes = [], list[Metric](), set[str]()
    for robot in options.robot:
        for clutter in CLUTTER:
            paths = [_path(p, options.out) for p in pieces(options)]
            mine = [p for p in paths if p.name.startswith(f"{robot}-{clutter}-") and p.exists()]
            done = [json.loads(path.read_text(encoding="utf-8")) for path in mine]
            codes |= {one["code"] for one in done}
            targets = [target for one in done for target in one["targets"]]
            if targets:
                rows.append(_row(robot, clutter, targets, metrics))
    return rows, metrics, ", ".join(sorted(codes))


def _row(
    robot: str, clutter: int, targets: list[dict[str, Any]], metrics: list[Metric]
) -> list[str]:
    statuses = Counter(one["status"] for one in targets)
    found, missed = statuses["SOLVED"], sum(one["missed"] for one in targets)
    name = f"collision/{robot}/{clutter}"
    rate = rate_metric(f"{name}/found", found, found + missed)
    batch = mean_metric(f"{name}/batch", [1e6 * one["batch"] for one in targets], "us")
    single = [1e6 * one["single"] for one in targets]
    metrics += [rate, batch, mean_metric(f"{name}/single", single, "us")]
    return [
        robot,
        str(clutter),
        str(len(targets)),
        f"{100 * np.mean([one['blind'] for one in targets]):.0f}",
        f"{found} of {found + missed}",
        interval_text(rate, 2),
        ", ".join(f"{count} {status}" for status, count in statuses.most_common()),
        str(sum(one["false"] for one in targets)),
        f"{batch.value:.0f}",
        f"{np.mean(single):.0f}",
        f"{np.median(single):.0f}",
    ]


def main(arguments: list[str] | None = None) -> None:
    """Measure and write the report."""
    parser = argparse.ArgumentParser(description="Checks and choices that touch nothing.")
    parser.add_argument("--checked", type=int, default=200_000, help="configurations checked")
    parser.add_argument("--timed", type=int, default=8192)
    parser.add_argument("--count", type=int, default=10, help="places, for every clutter")
    parser.add_argument("--searched", type=int, default=20_000, help="solutions of each target")
    parser.add_argument("--robot", nargs="+", default=["kuka_lwr_barrett"], help="with grasps")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--out", type=Path, default=Path("out/collision"), help="results")
    parser.add_argument(
        "--report", type=Path, default=Path("out/collision/report"), help="folder of the report"
    )
    options = parser.parse_args(arguments)
    run(options)
    found, metrics, codes = choices(options)
    times, sentences = check(options.checked, options.timed, options.seed)
    heads = ["configurations", "distance [us]", "free? [us]", "coal, any [us]"]
    heads += ["coal, all distances [us]", "MuJoCo [us]", "coal / distance", "coal / free?"]
    parts = [
        "Microseconds a configuration, kinematics included; one core of a busy machine, the least "
        f"of {REPEATS} repeats in one process, so the ratios count.",
        "## Check",
        markdown_table([*heads, "MuJoCo / free?"], times),
        *sentences,
    ]
    heads = ["robot", "clutter", "targets", "free without a choice %", "found", "found %"]
    heads += ["status", "false by coal", "batch, mean [us]", "single, mean [us]", "median [us]"]
    parts += [
        "## Choice",
        f"The robot's shipped grasps at random places of a table, each turned {TURNS} times about "
        "the vertical, where contacts alone can be solved, with so many boxes, cylinders and balls "
        "about. *Found:* of those that have a free answer: one was found, or a dense search of "
        f"{options.searched} solutions, each nearest to a random posture, finds one with "
        f"{1e3 * SAFE:g} mm to spare. Processor time of a target with everything that is looked at "
        f"until it is free or given up; *batch:* {TURNS} targets a call, *single:* one, without a "
        "diagnosis.",
        markdown_table(heads, found),
        "## Where this comes from",
        f"`{command(__file__, arguments)}`",
        provenance({"collision": codes or None}),
        f"Seed {options.seed}.",
    ]
    write_page("Free of collision", parts, options.report)
    write_metrics(metrics, options.report / "metrics.json")


if __name__ == "__main__":
    program(main)
