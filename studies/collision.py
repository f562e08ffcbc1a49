"""Free of collision: what a check costs, whether it is right, and what the choice finds.

*Check:* panda with an Allegro hand, a table and a cylinder; the same shapes and pairs by coal
through pinocchio and by MuJoCo, in one run. *Choice:* grasps of three robots anywhere on a table
with clutter, compared with a dense search of the solutions of each target. What is done is kept::

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
from collision_study.falsely_free import ROBOT, SIZE, Part, solve_part, the_check
from collision_study.goals import HEADS
from collision_study.goals import rows as goal_rows
from collision_study.mink_peer import PeerPiece, installed, solve_peer
from collision_study.oracles import MuJoCoOracle
from collision_study.search import BATCH, MICROMETRE, POSTURES, SAFE, TURNS, Piece, solve_piece
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

ROBOTS = ("kuka_lwr_barrett", "panda+allegro_right", "ur5e+shadow")
CLUTTER = (0, 3, 8)
REPEATS = 7

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
"""What is known of others."""


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


def parts(options: argparse.Namespace) -> list[Part]:
    """The random configurations that coal checks too, in parts."""
    starts = range(0, options.checked, SIZE)
    sizes = [min(SIZE, options.checked - start) for start in starts]
    return [Part(number, options.seed, size) for number, size in enumerate(sizes)]


def agreement(options: argparse.Namespace) -> tuple[str, list[Metric]]:
    """A sentence on agreement with coal, and its figures."""
    paths = [_path(part, options.out) for part in parts(options)]
    done = [json.loads(path.read_text(encoding="utf-8")) for path in paths if path.exists()]
    total = {key: sum(one[key] for one in done) for key in ("checked", "free", "others")}
    false, touching = (
        sum(one[key] for one in done) for key in ("falsely_free", "falsely_touching")
    )
    table = the_check()[1].table
    sentence = (
        f"{total['checked']:,} random configurations of {ROBOT}, {len(table.pairs)} pairs of "
        f"{len(table.radii)} capsules and {len(table.solids)} solids; "
        f"{100 * total['free'] / max(total['checked'], 1):.1f} % are free. Called free though coal "
        f"sees a penetration beyond 1 um: **{false}**. Called touching though coal sees none: "
        f"{touching} of {total['others']:,}."
    )
    name = "collision/falsely_free"
    return sentence, [Metric(name, false, "", "lower", np.nan, np.nan, total["checked"])]


def pieces(options: argparse.Namespace) -> list[Piece]:
    """What is asked for, so that what is done so far is as much of every clutter."""
    return [
        Piece(robot, clutter, number, options.seed, options.searched)
        for number in range(options.count)
        for robot in options.robot
        for clutter in CLUTTER
    ]


def peer_pieces(options: argparse.Namespace) -> list[PeerPiece]:
    """What mink is asked; nothing where it is not installed."""
    if not options.peer_targets or not installed():
        return []
    return [
        PeerPiece(Piece(robot, clutter, 0, options.seed, 0), options.peer_targets)
        for robot in PEER_ROBOTS
        if robot in options.robot
        for clutter in PEER_CLUTTER
    ]


def peers(options: argparse.Namespace) -> str:
    """The table of what mink did."""
    rows = []
    for asked in peer_pieces(options):
        path = _path(asked, options.out)
        if not path.exists():
            continue
        targets = json.loads(path.read_text(encoding="utf-8"))["targets"]
        times = [[1e3 * one[key] for one in targets] for key in ("seconds", "own")]
        rows.append(
            [
                asked.piece.robot,
                str(asked.piece.clutter),
                str(len(targets)),
                str(sum(one["solved"] for one in targets)),
                str(sum(one["ours"] for one in targets)),
                *(f"{np.mean(one):.1f}" for one in times),
                f"{np.sum(times[0]) / np.sum(times[1]):.0f}",
            ]
        )
    heads = ["robot", "clutter", "targets", "free answers by mink", "ours"]
    heads += ["mink, mean [ms]", "ours, mean [ms]", "ratio"]
    return markdown_table(heads, rows) if rows else "mink is not installed (extra `peers`)."


def _path(piece: Piece | Part | PeerPiece, folder: Path) -> Path:
    if isinstance(piece, PeerPiece):
        asked = piece.piece
        name = f"mink-{asked.robot}-{asked.clutter}-{asked.seed}-{piece.targets}"
        return folder / f"{name}.json"
    if isinstance(piece, Part):
        return folder / f"coal-{piece.number}-{piece.seed}-{piece.size}.json"
    name = f"{piece.robot}-{piece.clutter}-{piece.number}-{piece.seed}-{piece.searched}"
    return folder / f"{name}.json"


def run(options: argparse.Namespace) -> None:
    """Solve the pieces that have not been."""
    every = [*pieces(options), *parts(options), *peer_pieces(options)]
    todo = [piece for piece in every if not _path(piece, options.out).exists()]
    options.out.mkdir(parents=True, exist_ok=True)
    with backend(options.jobs, None):
        parallel = joblib.Parallel(return_as="generator_unordered")
        results: Any = parallel(joblib.delayed(solved)(piece) for piece in todo)
        for piece, found in results:
            path = _path(piece, options.out)
            part = path.with_suffix(".part")
            part.write_text(json.dumps(found), encoding="utf-8")
            part.replace(path)


def solved(
    piece: Piece | Part | PeerPiece,
) -> tuple[Piece | Part | PeerPiece, dict[str, Any]]:
    """A piece, and what came of it."""
    if isinstance(piece, PeerPiece):
        found = solve_peer(piece)
    else:
        found = solve_part(piece) if isinstance(piece, Part) else solve_piece(piece)
    return piece, {"code": code_version(), **found}


def choices(
    options: argparse.Namespace,
) -> tuple[list[list[str]], list[list[str]], list[Metric], str]:
    """Rows on completeness and time by clutter, on goals, figures, and what code they are of."""
    rows, goals, metrics, codes = [], [], list[Metric](), set[str]()
    for robot in options.robot:
        for clutter in CLUTTER:
            paths = [_path(p, options.out) for p in pieces(options)]
            mine = [p for p in paths if p.name.startswith(f"{robot}-{clutter}-") and p.exists()]
            done = [json.loads(path.read_text(encoding="utf-8")) for path in mine]
            codes |= {one["code"] for one in done}
            targets = [target for one in done for target in one["targets"]]
            if targets:
                rows.append(_row(robot, clutter, targets, metrics))
                goals += goal_rows(robot, clutter, targets)
    return rows, goals, metrics, ", ".join(sorted(codes))


def _left(options: argparse.Namespace) -> str:
    """What was asked for and has not been run."""
    left = [p for p in pieces(options) if not _path(p, options.out).exists()]
    named = (f"{p.robot} with clutter {p.clutter}, place {p.number}" for p in left)
    return f"Not run yet: {'; '.join(named)}." if left else ""


def _row(
    robot: str, clutter: int, targets: list[dict[str, Any]], metrics: list[Metric]
) -> list[str]:
    statuses = Counter(one["status"] for one in targets)
    found, missed = statuses["SOLVED"], sum(one["missed"] for one in targets)
    name = f"collision/{robot}/{clutter}"
    rate = rate_metric(f"{name}/found", found, found + missed)
    batch = mean_metric(f"{name}/batch", [1e6 * one["batch"] for one in targets], "us")
    single = [1e6 * one["single"] for one in targets]
    answered = [1e6 * one["answered_time"] for one in targets if one["status"] == "SOLVED"]
    if answered:
        metrics.append(mean_metric(f"{name}/answered", answered, "us"))
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
        f"{np.mean(answered):.0f}" if answered else "",
        f"{1e6 * np.mean([one['blind_time'] for one in targets]):.0f}",
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
    options = parser.parse_args(arguments)
    if not options.so_far:
        run(options)
    found, goals, metrics, codes = choices(options)
    agrees, more = agreement(options)
    times, by_mujoco = check(min(options.checked, 20_000), options.timed, options.seed)
    heads = ["configurations", "distance [us]", "free? [us]", "coal, any [us]"]
    heads += ["coal, all distances [us]", "MuJoCo [us]", "coal / distance", "coal / free?"]
    parts = [
        "Microseconds a configuration, kinematics included; one core of a busy machine, the least "
        f"of {REPEATS} repeats in one process, so the ratios count.",
        "## Check",
        markdown_table([*heads, "MuJoCo / free?"], times),
        agrees,
        by_mujoco,
    ]
    heads = ["robot", "clutter", "targets", "free without a choice %", "found", "found %"]
    heads += ["status", "false by coal", "batch, mean [us]", "with an answer [us]"]
    heads += ["contacts alone [us]", "single, mean [us]", "median [us]"]
    parts += [
        "## Choice",
        f"Grasps at random places of a table, each turned {TURNS} times about the vertical, where "
        "contacts alone can be solved, with so many boxes, cylinders and balls about. Grasps are "
        f"the robot's shipped ones, or of {POSTURES} random hands that do not touch themselves, "
        "about the ball that fits between their fingertips. *Found:* of those that have a free "
        f"answer: one was found, or a dense search of {options.searched:,} solutions, each nearest "
        f"to a random posture, finds one with {1e3 * SAFE:g} mm to spare. Processor time of a "
        "target with everything that is looked at until it is free or given up; *batch:* "
        f"{BATCH} targets a call, those of a grasp again and again; *with an answer:* the same of "
        "these alone; *contacts alone:* without a scene; *single:* one, without a diagnosis.",
        markdown_table(heads, found),
        _left(options),
        "## Goals",
        markdown_table(HEADS, goals),
        "## Others",
        PEERS,
        peers(options),
        "## Where this comes from",
        f"`{command(__file__, arguments)}`",
        provenance({"collision": codes or None}),
        f"Seed {options.seed}.",
    ]
    write_page("Free of collision", parts, options.report)
    write_metrics([*more, *metrics], options.report / "metrics.json")


if __name__ == "__main__":
    program(main)
