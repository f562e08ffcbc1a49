"""Robots, grasps and objects as frozen data; NumPy only, no CasADi."""

from casadi_ik.model.couplings import Coupling, FourBar, LeadScrew, Linear, Polynomial
from casadi_ik.model.description import Finger, RobotDescription
from casadi_ik.model.grasp import Contact, Grasp, Tolerance
from casadi_ik.model.joints import Actuator, Joint
from casadi_ik.model.load_grasp import load_grasp, shipped_grasps
from casadi_ik.model.load_robot import load_description
from casadi_ik.model.objects import GraspObject, load_object
from casadi_ik.model.shapes import (
    BentCapsule,
    Box,
    Cylinder,
    EllipticCylinder,
    Shape,
    Sphere,
)
from casadi_ik.model.write_urdf import to_urdf

__all__ = [
    "Actuator",
    "BentCapsule",
    "Box",
    "Contact",
    "Coupling",
    "Cylinder",
    "EllipticCylinder",
    "Finger",
    "FourBar",
    "Grasp",
    "GraspObject",
    "Joint",
    "LeadScrew",
    "Linear",
    "Polynomial",
    "RobotDescription",
    "Shape",
    "Sphere",
    "Tolerance",
    "load_description",
    "load_grasp",
    "load_object",
    "shipped_grasps",
    "to_urdf",
]
