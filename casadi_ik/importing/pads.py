"""Where a finger's pad is: a point on its skin and the way it faces, from shapes and joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.importing.fingers import Branch
from casadi_ik.importing.posture import Postures
from casadi_ik.importing.surfaces import Surface, together
from casadi_ik.robots.description import Joint

PARALLEL = 0.7
"""Cosine above which two joints of a finger bend it the same way."""

TILT = np.cos(np.deg2rad(45.0))
"""The skin may be tilted so far from where the finger bends to."""

SURE = 0.05
"""Relative difference of distances above which they say which way a finger closes."""


@dataclass(frozen=True, eq=False)
class Pad:
    """A guessed contact frame.

    Attributes:
        link: The link.
        point: (3,) in the link's frame [m].
        normal: (3,) outward, unit, in the link's frame.
        how: How it was found, for a comment.
    """

    link: str
    point: Array
    normal: Array
    how: str


def guess_pads(
    postures: Postures, palm: str, branches: list[Branch], surfaces: dict[str, Surface]
) -> list[Pad]:
    """A pad for every finger."""
    middle = postures.middle()
    poses = postures.poses(middle)
    bodies = [_body(postures, branch, surfaces) for branch in branches]
    tips = [
        _apply(poses[branch.chain[index].child], tip)
        for branch, (_, tip, index) in zip(branches, bodies, strict=True)
    ]
    pads: list[Pad] = []
    for i, branch in enumerate(branches):
        others = [tip for j, tip in enumerate(tips) if j != i]
        meeting = np.mean(others, axis=0) if others else poses[palm][:3, 3]
        pads.append(_pad(postures, branch, bodies[i], meeting))
    return pads


Body = tuple[Surface | None, Array, int]
"""The shape of the last phalanx in its moving link's frame, a point at its end, and which of the
chain's joints moves it."""


def _body(postures: Postures, branch: Branch, surfaces: dict[str, Surface]) -> Body:
    rest = postures.poses({})
    for index in reversed(range(len(branch.chain))):
        joint = branch.chain[index]
        inverse = np.linalg.inv(rest[joint.child])
        parts = [
            surfaces[link].moved(inverse @ rest[link])
            for link in postures.rigid(joint.child)
            if link in surfaces
        ]
        whole = together(parts)
        if whole is not None and len(whole.points):
            return whole, _end(whole, joint), index
    joint = branch.chain[-1]
    place = (np.linalg.inv(rest[joint.child]) @ rest[branch.link])[:3, 3]
    if np.linalg.norm(place) < 3e-3:  # no frame of a tip: as long as most of the phalanx before
        before = rest[branch.chain[-2].child] if len(branch.chain) > 1 else np.eye(4)
        step = rest[joint.child][:3, 3] - before[:3, 3]
        place = 0.8 * rest[joint.child][:3, :3].T @ step
    return None, place, len(branch.chain) - 1


def _end(body: Surface, joint: Joint) -> Array:
    """The end of the last phalanx: as far from its joint as the shape goes, in its middle."""
    u = _long_way(body, joint)
    along = body.points @ u
    far = body.points[along > 0.6 * along.max()] if along.max() > 0 else body.points
    middle = (far.min(axis=0) + far.max(axis=0)) / 2
    return middle + (along.max() - middle @ u) * u


def _long_way(body: Surface, joint: Joint) -> Array:
    """Unit direction from the joint to the middle of the phalanx, across the joint's axis."""
    way = _across(body.centroid(), joint.axis)
    if np.linalg.norm(way) < 3e-3:
        flat = body.points - np.outer(body.points @ joint.axis, joint.axis)
        way = flat[np.argmax(np.linalg.norm(flat, axis=1))]
    return _unit(way, np.array([0.0, 0.0, 1.0]))


def _pad(postures: Postures, branch: Branch, body: Body, meeting: Array) -> Pad:
    shape, end, index = body
    joint = branch.chain[index]
    sign, why = _closing(postures, branch, index, end, meeting)
    if joint.type == "prismatic":
        normal, u = sign * joint.axis, _unit(_across(end, joint.axis), _any_across(joint.axis))
    else:
        u = _long_way(shape, joint) if shape is not None else _across(end, joint.axis)
        u = _unit(u, _any_across(joint.axis))
        normal = sign * np.cross(joint.axis, u)
    if shape is None:
        point, how = end, "the file has no shapes: the point is the tip's frame or a guess of it"
    else:
        point, how, radius = _skin(shape, u, normal)
        faced = shape.facing(point, radius, normal)
        if joint.type != "prismatic":
            faced = _unit(_across(faced, joint.axis), normal)
        if faced @ normal > TILT:
            normal = faced
    rest = postures.poses({})
    pose = np.linalg.inv(rest[branch.link]) @ rest[joint.child]
    link = branch.link
    if not np.isfinite(pose).all() or postures.moving_link(link) != joint.child:
        link, pose = joint.child, np.eye(4)
    return Pad(link, _apply(pose, point), pose[:3, :3] @ normal, f"{how}; {why}")


def _skin(shape: Surface, u: Array, normal: Array) -> tuple[Array, str, float]:
    """The point of the shape over the middle of the fingertip, on the side the normal shows.

    Also how it was found, and within what distance the skin counts as the pad.
    """
    side = np.cross(u, normal)
    along = shape.points @ u
    length = float(along.max())
    far = shape.points[along >= length - 0.4 * max(length, float(np.ptp(along)))]
    height = float(np.ptp(far @ normal))
    back = min(max(height / 2, 0.1 * length), 0.5 * max(length, 1e-3))
    there = (far @ side).min(), (far @ side).max()
    start = (length - back) * u + float(np.mean(there)) * side
    reach = float(np.abs(shape.points).max()) * 4 + 0.1
    hit = shape.hit(start + reach * normal, -normal)
    if hit is not None:
        how = f"where a ray meets the shape {1e3 * back:.1f} mm before the tip's end"
        return hit, how, back / 2
    flat = start - (start @ normal) * normal
    there = flat + float((far @ normal).max()) * normal
    return there, "no ray meets the shape: its farthest point", 0.0


def _closing(
    postures: Postures, branch: Branch, index: int, end: Array, meeting: Array
) -> tuple[float, str]:
    """Which way the last joint turns when the finger closes, and how that was decided."""
    joint = branch.chain[index]
    middle = postures.middle()
    poses = postures.poses(middle)
    axis = poses[joint.child][:3, :3] @ joint.axis
    bending: dict[str, float] = {}
    for one in branch.chain[: index + 1]:
        if one.type == joint.type:
            cosine = float(poses[one.child][:3, :3] @ one.axis @ axis)
            if abs(cosine) > PARALLEL:
                bending[one.name] = np.sign(cosine)
    base = next(one for one in branch.chain if one.name in bending)

    def tip(sign: float) -> tuple[Array, Array]:
        values = dict(middle)
        for name, way in bending.items():
            one = postures.joints[name]
            values[name] = one.upper if way * sign > 0 else one.lower
        found = postures.poses(values)
        return _apply(found[joint.child], end), found[base.child][:3, 3]

    (plus, root), (minus, _) = tip(1.0), tip(-1.0)
    if len(bending) > 1:
        lengths = float(np.linalg.norm(plus - root)), float(np.linalg.norm(minus - root))
        if abs(lengths[0] - lengths[1]) > SURE * max(lengths):
            return (1.0 if lengths[0] < lengths[1] else -1.0), "faces the way the finger bends"
    here = poses[joint.child]
    place = _apply(here, end)
    way = axis if joint.type == "prismatic" else np.cross(axis, place - here[:3, 3])
    sign = 1.0 if way @ (meeting - place) >= 0 else -1.0
    return sign, "faces the other fingers"


def _apply(pose: Array, point: Array) -> Array:
    return pose[:3, :3] @ point + pose[:3, 3]


def _across(vector: Array, axis: Array) -> Array:
    return vector - (vector @ axis) * axis


def _any_across(axis: Array) -> Array:
    across: Array = np.asarray(np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))]), dtype=float)
    return _unit(across, axis)


def _unit(vector: Array, otherwise: Array) -> Array:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-9 else otherwise
