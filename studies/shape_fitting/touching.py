"""Which links' shapes touch although the meshes they hold do not."""

from __future__ import annotations

from importlib import import_module
from itertools import combinations
from typing import Any

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.collision.distances import segment_distances
from casadi_ik.importing.capsules import FittedCapsule
from casadi_ik.importing.posture import Postures
from casadi_ik.importing.surfaces import Surface
from casadi_ik.robots.couplings import Coupling
from casadi_ik.robots.part import Part

coal: Any = import_module("coal")


SAMPLES = 2000
"""Random configurations, seed 0."""

ENOUGH = 100
"""Configurations in which capsules touch that are enough to say that meshes never do."""


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
