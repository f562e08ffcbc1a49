"""Published grasps of a hand in the air: what an arm and a table leave of them.

The grasps are samples of DexGraspNet (Wang et al. 2023), of its repository: files of `data/dataset`
and, named alike, the meshes `data/meshdata/*/coacd/decomposed.obj` of it, in a folder::

    git clone https://github.com/PKU-EPIC/DexGraspNet        # at bdb423c
    python studies/public_grasps.py FOLDER

FOLDER has NAME.npy and NAME.obj of each object. Every size of an object is put on the table at the
poses of the study `touch`; what is done is kept.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runner.figures import RESULTS
from runner.parts import add_part_options, complete_parts
from runner.report import (
    Metric,
    command,
    markdown_table,
    program,
    publish,
    rate_metric,
)
from runner.study import robot_of, standing

import casadi_ik as ik

ROBOT = "ur5e+shadow"
POSES = ((0, 0.0), (1, 0.7), (2, 2.1))
"""An object's axis that is up, see `standing`, and its yaw on the table [rad]; as in `touch`."""

SIZES = (0.06, 0.08, 0.1, 0.12, 0.15)
"""Scales of objects in DexGraspNet."""

INTRODUCTION = """
{total} grasps of a Shadow hand from DexGraspNet's repository, of {objects} objects in five sizes
each, at three poses on the table: 0.5 m before a UR5e, 0.1 m aside. *Reached*: the arm takes the
palm there; joints beyond the hand's limits are put at them. *Over the table*: and nothing of arm
and hand touches the table or itself. *Free*: nor the object, other than with fingertips (the palm
and other links of many published grasps press against it, which is no fault of theirs). *Found*:
`grasps_of` for the same object, size and pose, asked for {limit} that are force-closed, reached and
free. Times are processor times of one thread, the object's scene and the hand's table being made.
"""

PUBLISHED = """
BODex publishes over 49 grasps a second on a GPU (RTX 3090), of hands in the air, of which over 75 %
hold in MuJoCo, with Shadow, Allegro and LEAP (Chen et al. 2025, arXiv 2412.16490, abstract, which
gives about 40 % for a network that learned from DexGraspNet). Its grasps are not in a repository
that this study could read. The figures are not like for like: other objects, criteria and machines.
"""


@dataclass(frozen=True)
class Cell:
    """An object of a size at a pose.

    Attributes:
        mesh: Path of its mesh.
        scale: The size, as the data call it.
        pose: Number of the pose.
        limit: How many grasps are asked for.
        seed: Of all random numbers.
    """

    mesh: str
    scale: float
    pose: int
    limit: int
    seed: int
    size: int = 1

    @property
    def path(self) -> Path:
        """Path of its results."""
        settings = f"{self.scale:g}-{self.pose}-{self.limit}-{self.seed}.json"
        return Path(Path(self.mesh).stem) / settings


def solve(cell: Cell) -> dict[str, Any]:
    """Solve the published grasps of a cell, and compute new ones."""
    mesh, robot = Path(cell.mesh), robot_of(ROBOT)
    surface = ik.load_surface(mesh, scale=cell.scale, seed=cell.seed)
    axis, yaw = POSES[cell.pose]
    pose, table = standing(surface, yaw, axis), ik.Solver(robot, scene=ik.load_scene("table"))
    data: dict[str, Any] = {"scale": cell.scale, "invalid": "clip"}
    grasps = ik.load_candidates(mesh.with_suffix(".npy"), robot, **data)
    around = ik.load_candidates(mesh.with_suffix(".npy"), robot, grasped=mesh, **data)
    settings: dict[str, Any] = {"object_pose": pose, "limit": len(grasps)}
    free = table.choose(around, **settings)
    causes_of_failure = Counter[str]()
    for cause, count in free.failures.items():
        causes_of_failure["COLLISION with the object" if mesh.name in cause else cause] += count
    sought: dict[str, Any] = {"limit": cell.limit, "among": cell.limit, "seed": cell.seed}
    table.grasps_of(surface, pose, limit=1, among=1)  # the object's scene, the hand's table
    computed = table.grasps_of(surface, pose, **sought)
    return {
        "grasps": len(grasps),
        "reached": ik.Solver(robot).choose(grasps, **settings).answered,
        "table": table.choose(grasps, **settings).answered,
        "free": free.answered,
        "why": dict(causes_of_failure),
        "found": len(computed),
        "time": computed.time,
    }


def main(arguments: list[str] | None = None) -> None:
    """Solve and write the report."""
    parser = argparse.ArgumentParser(description="Published grasps, with an arm and a table.")
    parser.add_argument("data", type=Path, help="folder of NAME.npy and NAME.obj")
    parser.add_argument("--limit", type=int, default=100, help="grasps of an object at a pose")
    add_part_options(parser, "public_grasps", RESULTS / "public_grasps")
    options = parser.parse_args(arguments)
    cells = [
        Cell(str(mesh), scale, pose, options.limit, options.seed)
        for mesh in sorted(options.data.glob("*.obj"))
        for scale in SIZES
        for pose in range(len(POSES))
    ]
    results = complete_parts(solve, cells, options, "objects at poses")
    done = results.done
    rows, metrics = [], list[Metric]()
    for mesh in sorted({cell.mesh for cell, _ in done}):
        results_of_mesh = [result for cell, result in done if cell.mesh == mesh]
        total = {
            key: sum(result[key] for result in results_of_mesh)
            for key in results_of_mesh[0]
            if key != "why"
        }
        name = Path(mesh).stem.rsplit("-", 1)[0]
        shares = [
            f"{total[key]} ({total[key] / total['grasps']:.0%})"
            for key in ("reached", "table", "free")
        ]
        found_count = sum(result["found"] > 0 for result in results_of_mesh)
        metrics.append(
            rate_metric(f"public_grasps/{name}/found", found_count, len(results_of_mesh))
        )
        rows.append(
            [
                name,
                str(total["grasps"]),
                *shares,
                str(total["found"]),
                f"{found_count} of {len(results_of_mesh)}",
                f"{total['found'] / total['time']:.0f}",
            ]
        )
    heads = [
        "object",
        "published, at poses",
        "reached",
        "over the table",
        "free",
        "found",
        "sizes and poses with some",
        "found a second",
    ]
    causes = sum((Counter(result["why"]) for _, result in done), Counter[str]())
    total = sum(result["grasps"] for _, result in done) // len(POSES)
    text = INTRODUCTION.format(total=total, objects=len(rows), limit=options.limit)
    free, placed = (sum(int(row[i].split()[0]) for row in rows) for i in (4, 1))
    result = (
        f"{100 * free / max(placed, 1):.0f} % of the published grasps can be used by an arm at a "
        "table without collision."
    )
    parts = [text, markdown_table(heads, rows), "## What is in the way"]
    parts += [
        markdown_table(
            ["first pair that touches, or status", "published grasps"],
            [[a, str(n)] for a, n in causes.most_common(12)],
        )
    ]
    parts += [*results.note, "## As published", PUBLISHED]
    run_by, code = command(__file__, arguments), {"public grasps": results.codes}
    heading = "Published grasps with an arm and a table"
    publish(heading, result, parts, options.out, run_by, code, metrics)


if __name__ == "__main__":
    program(main)
