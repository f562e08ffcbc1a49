"""Shapes in exported URDF: pinocchio reads them back where they were."""

from __future__ import annotations

import numpy as np
import pinocchio
from capsule_arm import write_robot

import casadi_ik as ik


def test_shapes_come_back_from_the_urdf(tmp_path):
    robot = ik.load_robot(write_robot(tmp_path))
    text = robot.urdf()
    model = pinocchio.buildModelFromXML(text)
    found = pinocchio.buildGeomFromUrdfString(model, text, pinocchio.GeometryType.COLLISION)
    kinds = sorted(type(one.geometry).__name__ for one in found.geometryObjects)
    # Four capsules of a cylinder and two spheres each, a sphere, two boxes and a cylinder.
    assert kinds == ["Box"] * 2 + ["Cylinder"] * 5 + ["Sphere"] * 9
    box = next(one for one in found.geometryObjects if model.frames[one.parentFrame].name == "l2")
    place = (model.frames[box.parentFrame].placement.inverse() * box.placement).homogeneous
    solid = next(one for one in robot.description.shapes.solids if one.link == "l2")
    np.testing.assert_allclose(place, solid.pose, atol=1e-12)
    np.testing.assert_allclose(2 * np.asarray(box.geometry.halfSide), solid.size, atol=1e-12)
