"""From a surface to grasps that arm and hand can make: how many, how fast, and why there are none.

Every object stands on the table, half a metre before the arm; every grasp that is found is given to
`Solver.solve` in the scene once more::

    python studies/touch.py
    python studies/touch.py --robots panda+allegro_right --objects cup mug --limit 200
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.progress import track
from runner.figures import RESULTS
from runner.report import (
    Metric,
    command,
    markdown_table,
    median_metric,
    program,
    provenance,
    rate_metric,
    write_metrics,
    write_page,
)
from runner.study import robot_of, standing

import casadi_ik as ik

ROBOTS = (
    "panda+allegro_right",
    "ur5e+shadow",
    "panda+leap",
    "kuka_lwr_barrett",
    "panda+unitree_dex3",
    "panda+panda_hand",
    "ur10e+robotiq_2f85",
)
TURNS = (0.0, 0.7, 2.1)
"""Yaws of an object on the table [rad]."""

INTRODUCTION = """
Objects are those that are shipped, standing on the table at three yaws, 0.5 m before the arm's base
and 0.1 m aside. Asked for are {limit} distinct, force-closed grasps (friction 0.5) of as many
fingertips as the hand has, three at most. *First*: processor time until at least one is found, the
hand's table not counted. *Confirmed*: `Solver.solve` in the scene, from the posture found, solves
the grasp. Times are processor times of one thread of this machine.
"""


def main(arguments: list[str] | None = None) -> None:
    """Find grasps and write the report."""
    parser = argparse.ArgumentParser(description="Grasps of surfaces.")
    parser.add_argument("--robots", nargs="+", default=ROBOTS)
    parser.add_argument("--objects", nargs="+", default=ik.shipped_names("objects"))
    parser.add_argument("--limit", type=int, default=100, help="grasps of an object at a pose")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=RESULTS / "touch")
    options = parser.parse_args(arguments)
    surfaces = {name: ik.load_surface(name, seed=options.seed) for name in options.objects}
    rows, metrics, reasons = [], list[Metric](), []
    for robot in options.robots:
        solver = ik.Solver(robot_of(robot), scene=ik.load_scene("table"))
        solver.grasps_of(
            surfaces[options.objects[0]], standing(surfaces[options.objects[0]], 0.0), limit=1
        )
        counts, times, firsts, loads, confirmed = [], [], [], [], []
        for name, turn in track([(n, t) for n in options.objects for t in TURNS], robot):
            surface = surfaces[name]
            pose = standing(surface, turn)
            first = solver.grasps_of(surface, pose, limit=1, seed=options.seed)
            found = solver.grasps_of(surface, pose, limit=options.limit, seed=options.seed)
            counts.append(len(found))
            if not len(found):
                reasons.append([robot, name, f"{turn:g}", found.reason])
                continue
            firsts.append(1e3 * first.time)
            times.append(len(found) / found.time)
            loads.append(found[0].load)
            confirmed += [solver.solve(one.grasp, q0=one.q).success for one in found]
        some = rate_metric(f"touch/{robot}/found", sum(map(bool, counts)), len(counts))
        rate = median_metric(f"touch/{robot}/rate", times, "1/s", "higher")
        early = median_metric(f"touch/{robot}/first", firsts, "ms")
        sure = rate_metric(f"touch/{robot}/confirmed", int(sum(confirmed)), len(confirmed))
        strength = median_metric(f"touch/{robot}/load", loads, "N/N", "higher")
        metrics += [some, rate, early, sure, strength]
        cells = [robot, f"{sum(map(bool, counts))} of {len(counts)}", str(sum(counts))]
        cells += [f"{rate.value:.0f}", f"{early.value:.0f}", f"{strength.value:.2f}"]
        rows.append([*cells, f"{int(sum(confirmed))} of {len(confirmed)}"])
    heads = ["robot", "objects and poses with grasps", "grasps", "a second, median"]
    heads += ["first [ms], median", "best load, median [N/N]", "confirmed"]
    parts = [INTRODUCTION.format(limit=options.limit), markdown_table(heads, rows)]
    if reasons:
        parts += ["## None found", markdown_table(["robot", "object", "yaw", "why"], reasons)]
    made = command(__file__, arguments)
    parts += ["## Where this comes from", f"`{made}`", provenance({})]
    write_page("Grasps of surfaces", parts, options.out)
    write_metrics(metrics, options.out / "metrics.json")


if __name__ == "__main__":
    program(main)
