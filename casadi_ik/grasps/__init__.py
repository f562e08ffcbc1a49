"""What is to be touched: contacts, grasps and objects, numpy only."""

from casadi_ik.grasps.grasp import Contact, Grasp, Tolerance
from casadi_ik.grasps.load import load_grasp, shipped_grasps
from casadi_ik.grasps.objects import GraspObject, load_object
from casadi_ik.grasps.shapes import (
    BentCapsule,
    Box,
    Cylinder,
    EllipticCylinder,
    Shape,
    Sphere,
)

__all__ = [
    "BentCapsule",
    "Box",
    "Contact",
    "Cylinder",
    "EllipticCylinder",
    "Grasp",
    "GraspObject",
    "Shape",
    "Sphere",
    "Tolerance",
    "load_grasp",
    "load_object",
    "shipped_grasps",
]
