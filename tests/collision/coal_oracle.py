"""The shapes and pairs of a robot in coal, as an oracle for distances."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
from capsule_arm import SCENE
from scipy.spatial.transform import Rotation

import casadi_ik as ik


def described(robot: ik.ArmHand) -> list[tuple[str, Any, np.ndarray]]:
    """Return link, shape and (4, 4) pose in the link of every described shape."""
    shapes = robot.description.shapes
    solids: list[tuple[str, Any, np.ndarray]] = []
    for capsule in shapes.capsules:
        if capsule.covers < 0:
            length = float(np.linalg.norm(capsule.half_axis))
            pose = np.eye(4)
            pose[:3, 3] = capsule.center
            if length:
                pose[:3, :3] = frame_along(capsule.half_axis / length)
            solids.append((capsule.link, coal.Capsule(capsule.radius, 2 * length), pose))
    for solid in shapes.solids:
        x, y, z = solid.size.tolist()
        shape = coal.Box(x, y, z) if solid.kind == "box" else coal.Cylinder(x, y)
        solids.append((solid.link, shape, solid.pose))
    return solids


def frame_along(axis: np.ndarray) -> np.ndarray:
    """Return a (3, 3) rotation whose z axis is the given axis."""
    side = np.cross(axis, np.eye(3)[int(np.abs(axis).argmin())])
    side /= np.linalg.norm(side)
    return np.column_stack([side, np.cross(axis, side), axis])


def in_scene() -> dict[str, tuple[Any, np.ndarray]]:
    """Return the shapes of the scene with their poses."""
    solids: dict[str, tuple[Any, np.ndarray]] = {}
    for name, entry in SCENE.items():
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("xyz", entry.get("rpy", (0, 0, 0))).as_matrix()
        pose[:3, 3] = entry["xyz"]
        match entry["kind"]:
            case "box":
                shape = coal.Box(*entry["size"])
            case "sphere":
                shape = coal.Sphere(entry["radius"])
            case "cylinder":
                shape = coal.Cylinder(entry["radius"], entry["length"])
            case "capsule":
                shape = coal.Capsule(entry["radius"], entry["length"])
            case "half-space":
                shape = coal.Halfspace(np.array([0, 0, 1.0]), 0.0)
            case _:
                model = coal.BVHModelOBBRSS()
                points = np.array(entry["points"])
                model.beginModel(0, len(points))
                model.addVertices(points)
                model.endModel()
                model.buildConvexHull(True, "Qt")
                shape = model.convex
        solids[name] = shape, pose
    return solids


def distance(solid: Any, at_one: np.ndarray, other_solid: Any, at_other: np.ndarray) -> float:
    """Return the signed distance [m]."""
    request, result = coal.DistanceRequest(True), coal.DistanceResult()
    places = (coal.Transform3s(pose[:3, :3], pose[:3, 3]) for pose in (at_one, at_other))
    first, second = places
    return float(coal.distance(solid, first, other_solid, second, request, result))
