"""Capsules for a shipped arm or hand, fitted to somebody's meshes, written into its description.

    python studies/fit_shapes.py KIND NAME FILE.urdf [--names "WHAT THE FILE IS"]

The file's joints are found again by their axes at zero, so its names and frames do not matter.
Links that touch in every one of many random configurations may touch; so may those whose capsules
do and whose meshes never.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import coal
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.collision.distances import segment_distances
from casadi_ik.files.reading import read
from casadi_ik.files.shipped import resolve
from casadi_ik.importing.boxes import FittedBox, fit_boxes
from casadi_ik.importing.capsules import FittedCapsule, cut, excess, fit
from casadi_ik.importing.posture import Postures
from casadi_ik.importing.surfaces import Surface, link_surfaces
from casadi_ik.robots.collision import BoxEntry, capsules_of
from casadi_ik.robots.couplings import Coupling
from casadi_ik.robots.described_parts import arm_part, hand_part
from casadi_ik.robots.part import Part
from casadi_ik.robots.robot_files.read import read_tree
from casadi_ik.robots.robot_files.tree import RobotTree, TreeJoint
from casadi_ik.robots.schema import ArmFile, HandFile

SAMPLES = 2000
"""Random configurations, seed 0."""

ENOUGH = 100
"""Configurations in which capsules touch that are enough to say that meshes never do."""

LARGE = 0.13
"""Links longer than this [m] may have more capsules than `SMALL`."""

SMALL = 2
"""Capsules of a small link, at the most."""

ALIKE = 2e-4
"""Axes that differ by less [m, or as unit vectors] are one."""

GRID = 1e4
"""Numbers are written in steps of a tenth of a millimetre."""


@dataclass(frozen=True, eq=False)
class Axis:
    """A joint's line at zero."""

    joint: str
    parent: str
    child: str
    point: Array
    way: Array


def main() -> None:
    """Fit and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kind", choices=("arms", "hands"))
    parser.add_argument("name")
    parser.add_argument("file", type=Path)
    parser.add_argument("--names", default="")
    parser.add_argument("--most", type=int, default=4)
    parser.add_argument("--without", nargs="*", default=[], help="links of the file to leave out")
    given = parser.parse_args()
    path = resolve(given.name, given.kind)
    kind, build = (ArmFile, arm_part) if given.kind == "arms" else (HandFile, hand_part)
    part: Any = build(read(path, kind)[0], path)
    surfaces = in_our_links(part, given.file, set(given.without))
    fitted = {
        link: held(
            one.points[one.triangles],
            given.most if _large(one) else SMALL,
            given.kind == "hands" and link == part.root,
        )
        for link, one in surfaces.items()
    }
    standing = {
        link: capsules + capsules_for(boxes) for link, (capsules, boxes, _) in fitted.items()
    }
    touching = may_touch(part, standing, surfaces)
    write(path, fitted, touching, given.names or given.file.name)
    count = sum(len(found) + len(boxes) for found, boxes, _ in fitted.values())
    worst = max(beyond for _, _, beyond in fitted.values())
    for link, (capsules, boxes, beyond) in fitted.items():
        print(f"  {link}: {len(capsules)} + {len(boxes)}, {1e3 * beyond:.0f} mm")
    print(f"{given.name}: {len(fitted)} links, {count} shapes, at most {1e3 * worst:.0f} mm beyond")
    print("  without:", [x for x in Postures(part).poses({}) if x not in fitted])
    for links, reason in touching:
        print("  ", links, reason)


def held(
    triangles: Array, most: int, flat: bool
) -> tuple[list[FittedCapsule], list[FittedBox], float]:
    """Capsules that hold a mesh, or boxes where it may be flat and they hold it closer; the excess.

    Fingers come near a palm, so there flat sides matter; elsewhere capsules are quicker.
    """
    capsules, beyond = fit(triangles, most)
    boxes = fit_boxes(triangles) if flat else []
    if boxes:
        closer = excess(boxes, cut(triangles).reshape(-1, 3))
        if closer < beyond:
            return [], boxes, closer
    return [rounded(one) for one in capsules], [], beyond


def capsules_for(boxes: list[FittedBox]) -> list[FittedCapsule]:
    """The capsules that stand for boxes between links."""
    found = []
    for one in boxes:
        entry = box_entry(one)
        found += [FittedCapsule(m - h, m + h, r) for m, h, r in capsules_of(entry)]
    return found


def box_entry(one: FittedBox) -> BoxEntry:
    """A box in steps of a tenth of a millimetre, no smaller."""
    size = np.ceil(one.size * GRID + 1.1) / GRID
    center = np.round(one.center * GRID) / GRID
    rpy = np.round(roll_pitch_yaw(one.rotation), 4)
    if np.any(rpy):  # what rounding may turn it by
        size = np.ceil((size + 1e-4 * np.linalg.norm(size)) * GRID) / GRID
    return BoxEntry(size=tuple(size), xyz=tuple(center), rpy=tuple(rpy))


def _large(surface: Surface) -> bool:
    return float(np.ptp(surface.points, axis=0).max()) > LARGE


def in_our_links(part: Part, file: Path, without: set[str]) -> dict[str, Surface]:
    """The file's shapes by our link, in its frame."""
    tree = read_tree(file)
    theirs = tree_poses(tree)
    ours = Postures(part).poses({})
    our_axes = [
        Axis(j.name, j.parent, j.child, ours[j.child][:3, 3], ours[j.child][:3, :3] @ j.axis)
        for j in part.joints
        if j.type != "fixed"
    ]
    best: tuple[int, dict[str, TreeJoint], Array] = (-1, {}, np.eye(4))
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    for link in tree.links:
        for turn in (np.eye(4), half_turn):
            base = turn @ np.linalg.inv(theirs[link])
            matched = match(part, our_axes, tree, theirs, base)
            if len(matched) > best[0]:
                best = (len(matched), matched, base)
    count, matched, base = best
    if count < len(our_axes):
        missing = [axis.joint for axis in our_axes if axis.joint not in matched]
        print(f"  joints not found in {file.name}: {missing}")
    parents = {joint.name: joint for joint in part.joints}
    holder = {matched[name].child: parents[name].child for name in matched}
    # The root's own body: all that is fixed to what the first joints hang on.
    first = next(j for j in part.joints if j.name in matched)
    body = rigid(tree, matched[first.name].parent)
    for link in sorted(body - without):
        holder.setdefault(link, part.root)
    changed = True
    while changed:
        changed = False
        for joint in tree.joints:
            if (
                joint.type == "fixed"
                and joint.parent in holder
                and joint.child not in {*holder, *without}
            ):
                holder[joint.child] = holder[joint.parent]
                changed = True
    found, missing = link_surfaces(file, list(holder))
    for line in missing:
        print("  ", line)
    parts: dict[str, list[Surface]] = {}
    for link, surface in found.items():
        pose = np.linalg.inv(ours[holder[link]]) @ base @ theirs[link]
        if len(surface.triangles):
            parts.setdefault(holder[link], []).append(surface.moved(pose))
    joined = {}
    for link in ours:
        if link in parts:
            points = [one.points for one in parts[link]]
            starts = np.cumsum([0, *(len(one) for one in points[:-1])])
            triangles = [one.triangles + n for one, n in zip(parts[link], starts, strict=True)]
            joined[link] = Surface(np.concatenate(points), np.concatenate(triangles))
    return joined


def rigid(tree: RobotTree, link: str) -> set[str]:
    """All links of a body."""
    body, grown = {link}, True
    while grown:
        more = {j.child for j in tree.joints if j.type == "fixed" and j.parent in body}
        more |= {j.parent for j in tree.joints if j.type == "fixed" and j.child in body}
        grown = not more <= body
        body |= more
    return body


def tree_poses(tree: RobotTree) -> dict[str, Array]:
    """Poses of the file's links at zero."""
    poses = {tree.root: np.eye(4)}
    for joint in tree.joints:
        poses[joint.child] = poses[joint.parent] @ joint.placement
    return poses


def match(
    part: Part, axes: list[Axis], tree: RobotTree, theirs: dict[str, Array], base: Array
) -> dict[str, TreeJoint]:
    """By our joint the file's, below that of the joint before."""
    by_child = {joint.child: joint for joint in part.joints}
    found: dict[str, TreeJoint] = {}
    for axis in axes:
        above: str | None = axis.parent
        while above in by_child and by_child[above].name not in found:
            above = by_child[above].parent
        start = found[by_child[above].name].child if above in by_child else tree.root
        for joint in tree.below(start):
            pose = base @ theirs[joint.child]
            if joint.type == "fixed" or joint in found.values():
                continue
            way = pose[:3, :3] @ joint.axis
            off = axis.point - pose[:3, 3]
            off = off - (off @ axis.way) * axis.way
            turned = min(np.abs(way - axis.way).max(), np.abs(way + axis.way).max())
            if turned < 5e-3 and np.linalg.norm(off) < 20 * ALIKE:
                found[axis.joint] = joint
                break
    return found


def rounded(one: FittedCapsule) -> FittedCapsule:
    """The same in steps of a tenth of a millimetre, no smaller."""
    first, last = np.round(one.first * GRID) / GRID, np.round(one.last * GRID) / GRID
    return FittedCapsule(first, last, math.ceil(one.radius * GRID + 0.9) / GRID)


def random_values(part: Part, rng: np.random.Generator) -> dict[str, float]:
    """Positions of all joints, couplings minded where they are of one joint or motor."""
    motors = {one.name: rng.uniform(one.lower, one.upper) for one in part.actuators}
    values: dict[str, float] = {}

    def value(name: str) -> float:
        joint = next((j for j in part.joints if j.name == name), None)
        if joint is None or joint.coupling is None:
            return motors[name]
        coupling: Coupling = joint.coupling
        return float(coupling.followed(np.array([value(coupling.of)]))[0])

    for joint in part.joints:
        if joint.type != "fixed":
            values[joint.name] = value(joint.name)
    return values


def may_touch(
    part: Part, capsules: dict[str, list[FittedCapsule]], surfaces: dict[str, Surface]
) -> list[tuple[tuple[str, str], str]]:
    """Pairs of links of the part that may touch, and why."""
    postures, rng = Postures(part), np.random.default_rng(0)
    poses = [postures.poses(random_values(part, rng)) for _ in range(SAMPLES)]
    bodies = {part.root: part.root}
    neighbours = set()
    for joint in part.joints:
        parent = bodies[joint.parent]
        bodies[joint.child] = parent if joint.type == "fixed" else joint.child
        neighbours.add(frozenset((parent, bodies[joint.child])))
    segments = {}
    for link, found in capsules.items():
        stacked = np.stack([pose[link] for pose in poses])
        ends = [
            np.einsum("kij,j->ki", stacked, np.append(p, 1.0))[:, :3]
            for one in found
            for p in (one.first, one.last)
        ]
        array = np.stack(ends, axis=1).reshape(SAMPLES, len(found), 2, 3)
        middle, half = array.mean(axis=2), (array[:, :, 1] - array[:, :, 0]) / 2
        segments[link] = np.concatenate([middle, half], axis=2)
    meshes: dict[str, Any] = {}
    found = []
    for one, other in combinations(capsules, 2):
        if bodies[one] == bodies[other] or frozenset((bodies[one], bodies[other])) in neighbours:
            continue
        least = np.full(SAMPLES, np.inf)
        for i, a in enumerate(capsules[one]):
            for j, b in enumerate(capsules[other]):
                apart = segment_distances(segments[one][:, i], segments[other][:, j])
                least = np.minimum(least, apart - a.radius - b.radius)
        hit = np.flatnonzero(least < 0)
        if len(hit) == SAMPLES:
            reason = f"their shapes touch in all of {SAMPLES} random configurations, seed 0"
            found.append(((one, other), reason))
        elif len(hit) >= ENOUGH:
            touching = sum(
                meshes_touch(meshes, surfaces, poses[row], one, other) for row in hit[:300].tolist()
            )
            if not touching:
                reason = (
                    f"their shapes touch in {len(hit)} of {SAMPLES} random configurations, seed 0, "
                    "their meshes in none"
                )
                found.append(((one, other), reason))
    return found


def meshes_touch(
    meshes: dict[str, Any], surfaces: dict[str, Surface], pose: dict[str, Array], a: str, b: str
) -> bool:
    """Whether the meshes of two links meet."""
    for link in (a, b):
        if link not in meshes:
            model = coal.BVHModelOBBRSS()
            surface = surfaces[link]
            model.beginModel(len(surface.triangles), len(surface.points))
            model.addVertices(np.asarray(surface.points, dtype=float))
            triangles = coal.StdVec_Triangle()
            for t in surface.triangles.tolist():
                triangles.append(coal.Triangle(*t))
            model.addTriangles(np.asarray(surface.triangles))
            model.endModel()
            meshes[link] = model
    request, result = coal.CollisionRequest(), coal.CollisionResult()
    places = [coal.Transform3s(pose[x][:3, :3], pose[x][:3, 3]) for x in (a, b)]
    return bool(coal.collide(meshes[a], places[0], meshes[b], places[1], request, result))


def write(
    path: Path,
    fitted: dict[str, tuple[list[FittedCapsule], list[FittedBox], float]],
    touching: list[tuple[tuple[str, str], str]],
    names: str,
) -> None:
    """Put ``collision:`` at the end of a description, and its source."""
    text = path.read_text(encoding="utf-8")
    text = text.split("\ncollision:", 1)[0].rstrip("\n") + "\n"
    source = (
        f"  shapes: \"Fitted by studies/fit_shapes.py to the shapes of {names}: a link's mesh is "
        "held by its capsules, which stand out beyond it by at most what is called excess. "
        'Assumption: rounded up to 0.1 mm."\n'
    )
    lines = text.split("\n")
    lines = without_source(lines)
    at = lines.index("sources:") + 1
    while lines[at].startswith("  "):
        at += 1
    lines[at:at] = wrapped(source)
    out = ["\n".join(lines).rstrip("\n"), "", "collision:", "  source: shapes", "  links:"]
    for link, (found, boxes, beyond) in fitted.items():
        out.append(f"    {link}:")
        stated = f"excess: {1e3 * math.ceil(1e3 * beyond) / 1e3:g} mm"
        for one in found:
            numbers = [
                f"[{', '.join(f'{1e3 * v:.1f} mm' for v in end + 0.0)}]"
                for end in (one.first, one.last)
            ]
            radius = f"{1e3 * one.radius:.1f} mm"
            if np.allclose(one.first, one.last):
                out.append(
                    f"      - {{kind: sphere, center: {numbers[0]}, radius: {radius}, {stated}}}"
                )
            else:
                out.append(f"      - {{kind: capsule, ends: [{numbers[0]},")
                out.append(f"         {numbers[1]}], radius: {radius}, {stated}}}")
        for one in map(box_entry, boxes):
            size, xyz = (
                ", ".join(f"{1e3 * v + 0.0:.1f} mm" for v in values)
                for values in (one.size, one.xyz)
            )
            turn = f", rpy: [{', '.join(f'{v + 0.0:g}' for v in one.rpy)}]" if any(one.rpy) else ""
            out.append(f"      - {{kind: box, size: [{size}],")
            out.append(f"         xyz: [{xyz}]{turn}, {stated}}}")
    if touching:
        out.append("  touching:")
        for links, reason in touching:
            out.append(f"    - links: [{links[0]}, {links[1]}]")
            out.append(f"      reason: {reason}")
    path.write_text("\n".join(out) + "\n", encoding="utf-8")


def roll_pitch_yaw(rotation: Array) -> Array:
    """(3,) angles about the fixed axes [rad]."""
    r = rotation
    return np.array(
        [
            math.atan2(r[2, 1], r[2, 2]),
            math.atan2(-r[2, 0], math.hypot(r[0, 0], r[1, 0])),
            math.atan2(r[1, 0], r[0, 0]),
        ]
    )


def without_source(lines: list[str]) -> list[str]:
    """A description's lines without an earlier source of shapes."""
    if not any(line.startswith("  shapes: ") for line in lines):
        return lines
    start = next(i for i, line in enumerate(lines) if line.startswith("  shapes: "))
    end = start + 1
    while lines[end].startswith("    "):
        end += 1
    return lines[:start] + lines[end:]


def wrapped(text: str) -> list[str]:
    """A source in lines of at most 98 characters."""
    lines, line = [], " "
    for word in text.split():
        if len(line) + 1 + len(word) > 98:
            lines.append(line)
            line = "   "
        line += f" {word}"
    return [*lines, line]


if __name__ == "__main__":
    main()
