"""What was aimed at, what was reached, and where it was not, why."""

from __future__ import annotations

from typing import Any

import numpy as np
from runner import markdown_table

from moving_study.choosing import CANDIDATES
from moving_study.one_path import STEPS

Rows = dict[str, list[dict[str, Any]]]

CYCLE = {"panda+allegro_right": (50.0, 200.0), "kuka_lwr_barrett": (25.0, None)}
"""Most of a cycle, and of its 99th percentile [us]."""

CHOICE = {"no": 50.0, "yes": 200.0}
"""Most for choosing, without a scene and with one [ms]."""

TRACK = 0.2
"""Most for a known path [s]."""

DEARER = (
    "{what} of the arm is looked at, not the first answer alone: "
    "{ratio:.1f} times a plain batch of as many, of which a target takes {plain:.0f} us here"
)


def goal_table(
    paths: Rows,
    times: dict[str, list[float]],
    tracks: Rows,
    choices: Rows,
    lost: Rows,
) -> str:
    """The table, from the figures of the study.

    Args:
        paths: Figures of every path, by robot.
        times: CPU seconds of calls, by robot.
        tracks: Of known paths, by robot.
        choices: Of choosing, by robot.
        lost: Of the paths that were lost, by robot.
    """
    rows: list[list[str]] = []

    def add(goal: str, robot: str, reached: str, met: bool, why: str) -> None:
        rows.append([goal, robot, reached, "yes" if met else "no", "" if met else why])

    for robot, some in choices.items():
        for one in some:
            scene = "with table and bottle" if one["scene"] == "yes" else "without a scene"
            most, spent = CHOICE[one["scene"]], 1e3 * one["seconds"]
            every = "every branch and swivel"
            why = DEARER.format(
                what=every if one["given"] == "palms" else f"every hand that fits, {every}",
                ratio=one["seconds"] / one["plain"],
                plain=1e6 * one["plain"] / CANDIDATES,
            )
            goal = f"{CANDIDATES} {one['given']} {scene}: {most:.0f} ms"
            add(goal, robot, f"{spent:.0f} ms", spent <= most, why)
    for robot, limits in CYCLE.items():
        if robot not in times:
            continue
        for part, most in zip((50, 99), limits, strict=True):
            if most is None:
                continue
            spent = 1e6 * float(np.percentile(times[robot], part))
            name = "cycle" if part == 50 else "cycle, 99th percentile"
            why = "Python, numpy and the step in C take that long on this machine"
            add(f"{name}: {most:.0f} us", robot, f"{spent:.0f} us", spent <= most, why)
    for robot, some in paths.items():
        most = max(row[f"{way}_velocity"] for row in some for way in ("smooth", "leaping"))
        add("velocity within limits, always", robot, f"{most:.6f}", most <= 1 + 1e-9, "")
        short = [row for row in some if row["met"] < 1]
        eased = sum(max(one["faster"]) > one["met"] for one in lost[robot])
        whole = sum(max(one["faster"]) == 1 for one in lost[robot])
        why = (
            f"of {len(short)} lost paths {whole} are met wholly and {eased - whole} longer by "
            "motors with higher limits: in the follower's posture theirs do not suffice"
        )
        reached = f"{len(some) - len(short)} of {len(some)} paths"
        add("within tolerance where reachable", robot, reached, not short, why)
        spent = float(np.median([one["time"] for one in tracks[robot]]))
        why = f"{1e6 * spent / STEPS:.0f} us a grasp, reading and verdict of each among them"
        add(
            f"{STEPS} grasps known before: {TRACK:g} s",
            robot,
            f"{spent:.2f} s",
            spent <= TRACK,
            why,
        )
    return markdown_table(["goal", "robot", "reached", "met", "why not"], rows)
