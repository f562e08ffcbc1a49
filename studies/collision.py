"""Free of collision: what a check costs, whether it is right, and what the choice finds.

*Check:* panda with an Allegro hand, a table and a cylinder; the same shapes and pairs by coal
through pinocchio and by MuJoCo, in one run. *Choice:* grasps of three robots anywhere on a table
with clutter, compared with a dense search of the solutions of each target. What is done is kept::

    python studies/collision.py --report studies/results/collision
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from collision_study.mink_peer import installed, solve_peer
from collision_study.oracles import CoalOracle, MuJoCoOracle
from collision_study.search import (
    BATCH,
    MICROMETRE,
    POSTURES,
    SAFE,
    TURNS,
    Piece,
    solve_piece,
    surroundings,
)
from runner.parts import read_parts, run_parts
from runner.report import (
    Metric,
    command,
    interval_text,
    markdown_table,
    mean_metric,
    program,
    publish,
    rate_metric,
)
from samplers import grasps_of

import casadi_ik as ik
from casadi_ik.collision.clearance import CollisionQuery, SceneCheck

ROBOTS = ("kuka_lwr_barrett", "panda+allegro_right", "ur5e+shadow")
CLUTTER = (0, 3, 8)
REPEATS = 7

SIZE = 50_000
"""Configurations of a part."""

MUJOCO_SHARE = 50
"""Interval of colliding configurations that coal checks too, in 1.4 ms each."""

SCENE = {
    "table": {"kind": "box", "size": [1.6, 1.6, 0.04], "xyz": [0.0, 0.0, -0.1]},
    "post": {"kind": "cylinder", "radius": 0.06, "length": 0.6, "xyz": [0.45, 0.25, 0.3]},
}

ROBOT = "panda+allegro_right"


PEER_ROBOTS, PEER_CLUTTER = ("kuka_lwr_barrett",), (0, 8)
PEERS = """
mink 1.3 with a collision limit for every pair that we check and our contacts as one task, set up as
in the comparison of solvers; one start from home, then evenly spread ones, up to 25 of 60 steps;
free by our check. It is a Python loop, as users run it, and is set up for contacts of all fingers,
so for this robot's grasps alone. *ours:* `Solver.solve` of the same targets,
one a call. A published figure, measured by others on a graphics processor and not comparable with
one core here: cuRobo's second version states 2.73 ms for a batch of 100 collision-free targets of a
Franka arm, 27 us a target, all solved.
"""


CHOICE = """
Grasps are placed at random positions on a table, each at {turns} random yaw angles, where the
contacts alone can be solved. *Clutter* is the number of boxes, cylinders and balls around them.
The grasps are the built-in ones of the robot, or those of {postures} random collision-free hands
around the ball that fits between their fingertips. *Found:* of the targets with a known
collision-free solution: one of hand-first, or of a dense search of {searched:,} solutions, each
nearest to a random configuration, with {safe:g} mm of clearance. Processor times per target
include everything until a solution is found or the target is given up; *batch:* {batch} targets
per call, those of a grasp repeated; *with an answer:* solved targets alone; *contacts alone:*
without a scene; *single:* one target, without a diagnosis.
"""


@dataclass(frozen=True)
class Part:
    """A part: "coal" (random configurations), "choice" (a position on a table) or "mink".

    Attributes:
        what: Which of them.
        piece: The place; of "coal" its number and seed count.
        size: Configurations, or targets of mink.
    """

    what: str
    piece: Piece
    size: int = 1

    @property
    def path(self) -> Path:
        """Path of its results."""
        piece = self.piece
        place = f"{piece.robot}-{piece.clutter}-{piece.number}-{piece.seed}-{piece.searched}"
        return Path(self.what) / f"{place}-{self.size}.json"


@cache
def the_check() -> tuple[ik.ArmHand, CollisionQuery, CoalOracle]:
    """Return the robot, its check and the same check with coal; built once per process."""
    robot = ik.load_robot(ROBOT)
    (grasp,) = grasps_of(robot, *robot.contacts(robot.home[None]))
    around = surroundings(SceneCheck(robot, ik.Scene(SCENE)), robot, grasp)
    return robot, around, CoalOracle(robot, around)


def solve(part: Part) -> dict[str, Any]:
    """Return the results of a part."""
    if part.what == "choice":
        return solve_piece(part.piece)
    if part.what == "mink":
        return solve_peer(part.piece, part.size)
    robot, around, coal = the_check()
    rng = np.random.default_rng([part.piece.seed, part.piece.number])
    q = robot.random(rng, part.size)
    free = around.free(q)
    other_samples = q[~free][: part.size // MUJOCO_SHARE]
    return {
        "checked": len(q),
        "free": int(free.sum()),
        "falsely_free": int(coal.penetrating(q[free], MICROMETRE).sum()),
        "others": len(other_samples),
        "falsely_touching": int((~coal.penetrating(other_samples, MICROMETRE)).sum()),
    }


def parts_of(options: argparse.Namespace) -> list[Part]:
    """Return all parts, alternating between amounts of clutter."""
    sizes = [min(SIZE, options.checked - start) for start in range(0, options.checked, SIZE)]
    parts = [
        Part("coal", Piece(ROBOT, 0, number, options.seed, 0), size)
        for number, size in enumerate(sizes)
    ]
    parts += [
        Part("choice", Piece(robot, clutter, number, options.seed, options.searched))
        for number in range(options.count)
        for robot in options.robot
        for clutter in CLUTTER
    ]
    if options.peer_targets and installed():
        parts += [
            Part("mink", Piece(robot, clutter, 0, options.seed, 0), options.peer_targets)
            for robot in PEER_ROBOTS
            if robot in options.robot
            for clutter in PEER_CLUTTER
        ]
    return parts


def least_time(call: Callable[[], object], count: int) -> float:
    """Microseconds of each of `count` configurations, the least of some repeats."""
    best = np.inf
    for _ in range(REPEATS):
        begin = time.process_time()
        call()
        best = min(best, time.process_time() - begin)
    return 1e6 * best / count


def check(count: int, timed: int, seed: int) -> tuple[list[list[str]], str]:
    """Rows on time, and a sentence on agreement with MuJoCo."""
    robot, around, coal = the_check()
    mujoco = MuJoCoOracle(robot, around)
    q = robot.random(np.random.default_rng(seed), max(count, timed))
    free, by_mujoco = around.free(q), mujoco.touching(q[:count], MICROMETRE)
    sentence = (
        f"MuJoCo, {len(by_mujoco)} others: called free though it sees a penetration beyond 1 um: "
        f"**{int((free[:count] & by_mujoco).sum())}**."
    )
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
    return rows, sentence


def agreement(done: list[dict[str, int]]) -> tuple[str, Metric]:
    """Return a sentence on the agreement with coal, and its metric."""
    keys = ("checked", "free", "others", "falsely_free", "falsely_touching")
    total = {key: sum(result[key] for result in done) for key in keys}
    table = the_check()[1].table
    sentence = (
        f"{total['checked']:,} random configurations of {ROBOT}, {len(table.pairs)} pairs of "
        f"{len(table.radii)} capsules and {len(table.solids)} solids; "
        f"{100 * total['free'] / max(total['checked'], 1):.1f} % are free. Called free though coal "
        f"sees a penetration beyond 1 um: **{total['falsely_free']}**. Called touching though coal "
        f"sees none: {total['falsely_touching']} of {total['others']:,}."
    )
    false, name = float(total["falsely_free"]), "collision/falsely_free"
    return sentence, Metric(name, false, "", "lower", np.nan, np.nan, total["checked"])


def peer_rows(done: Iterable[tuple[Part, dict[str, Any]]]) -> list[list[str]]:
    """Return the rows of mink."""
    rows = []
    for part, results in done:
        targets = results["targets"]
        times = [[1e3 * result[key] for result in targets] for key in ("seconds", "own")]
        cells = [part.piece.robot, f"{part.piece.clutter}", f"{len(targets)}"]
        cells += [f"{sum(result[key] for result in targets)}" for key in ("solved", "ours")]
        cells += [f"{np.mean(values):.1f}" for values in times]
        rows.append([*cells, f"{np.sum(times[0]) / np.sum(times[1]):.0f}"])
    return rows


def choice_row(
    robot: str, clutter: int, targets: list[dict[str, Any]], metrics: list[Metric]
) -> list[str]:
    """Return the row of a robot and clutter: completeness and times."""
    statuses = Counter(result["status"] for result in targets)
    solved, missed = statuses["SOLVED"], sum(result["missed"] for result in targets)
    name = f"collision/{robot}/{clutter}"
    rate = rate_metric(f"{name}/found", solved, solved + missed)
    batch = mean_metric(f"{name}/batch", [1e6 * result["batch"] for result in targets], "us")
    single = [1e6 * result["single"] for result in targets]
    answered = [1e6 * result["answered_time"] for result in targets if result["status"] == "SOLVED"]
    if answered:
        metrics.append(mean_metric(f"{name}/answered", answered, "us"))
    metrics += [rate, batch, mean_metric(f"{name}/single", single, "us")]
    return [
        robot,
        str(clutter),
        str(len(targets)),
        f"{100 * np.mean([result['blind'] for result in targets]):.0f}",
        f"{solved} of {solved + missed}",
        interval_text(rate, 2),
        ", ".join(f"{count} {status}" for status, count in statuses.most_common()),
        str(sum(result["false"] for result in targets)),
        f"{batch.value:.0f}",
        f"{np.mean(answered):.0f}" if answered else "",
        f"{1e6 * np.mean([result['blind_time'] for result in targets]):.0f}",
        f"{np.mean(single):.0f}",
        f"{np.median(single):.0f}",
    ]


def main(arguments: list[str] | None = None) -> None:
    """Measure and write the report."""
    parser = argparse.ArgumentParser(description="Checks and choices that touch nothing.")
    parser.add_argument("--checked", type=int, default=1_000_000, help="configurations, by coal")
    parser.add_argument("--timed", type=int, default=8192)
    parser.add_argument("--count", type=int, default=10, help="places, for every clutter")
    parser.add_argument("--searched", type=int, default=20_000, help="solutions of each target")
    parser.add_argument("--peer-targets", type=int, default=12, help="targets for mink of each")
    parser.add_argument("--robot", nargs="+", default=list(ROBOTS))
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--out", type=Path, default=Path("out/collision"), help="results")
    parser.add_argument(
        "--report", type=Path, default=Path("out/collision/report"), help="folder of the report"
    )
    parser.add_argument("--so-far", action="store_true", help="report what is done, run nothing")
    parser.add_argument("--title", default="Collision-free targets", help="title of the report")
    options = parser.parse_args(arguments)
    parts = parts_of(options)
    if not options.so_far:
        run_parts(solve, parts, options.out, jobs=options.jobs)
    done, codes = read_parts(options.out, parts)
    kinds = {
        what: [(part, results) for part, results in done if part.what == what]
        for what in ("coal", "choice", "mink")
    }
    agrees, falsely = agreement([results for _, results in kinds["coal"]])
    places: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for part, results in kinds["choice"]:
        places.setdefault((part.piece.robot, part.piece.clutter), []).extend(results["targets"])
    metrics = [falsely]
    rows = [
        choice_row(*place, place_results, metrics)
        for place, place_results in sorted(places.items())
        if place_results
    ]
    times, by_mujoco = check(min(options.checked, 20_000), options.timed, options.seed)
    left = len(parts) - len(done)
    heads = ["configurations", "distance [us]", "free? [us]", "coal, any [us]"]
    heads += ["coal, all distances [us]", "MuJoCo [us]", "coal / distance", "coal / free?"]
    solved, solvable = (
        sum(int(row[4].split(" of ")[i]) for row in rows) if rows else 0 for i in (0, 1)
    )
    result = f"Of {solvable:,} targets with a known collision-free solution, {solved:,} are solved."
    body = [
        "## Check",
        "Microseconds a configuration, kinematics included; one core of a busy machine, the least "
        f"of {REPEATS} repeats in one process, so the ratios count.",
        *(markdown_table([*heads, "MuJoCo / free?"], times), agrees, by_mujoco),
    ]
    heads = ["robot", "clutter", "targets", "free without a choice %", "found", "found %"]
    heads += ["status", "false by coal", "batch, mean [us]", "with an answer [us]"]
    heads += ["contacts alone [us]", "single, mean [us]", "median [us]"]
    texts = {"searched": options.searched, "safe": 1e3 * SAFE, "batch": BATCH}
    body += ["## Choice", CHOICE.format(turns=TURNS, postures=POSTURES, **texts)]
    body += [markdown_table(heads, rows), *([f"Not run yet: {left} parts."] if left else [])]
    heads = ["robot", "clutter", "targets", "free answers by mink", "ours"]
    heads += ["mink, mean [ms]", "ours, mean [ms]", "ratio"]
    peers = peer_rows(kinds["mink"])
    body += ["## Others", PEERS]
    body += [markdown_table(heads, peers) if peers else "Not run (`studies/peers.txt`)."]
    run_by, code = command(__file__, arguments), {"collision": codes or None}
    publish(options.title, result, body, options.report, run_by, code, metrics)


if __name__ == "__main__":
    program(main)
