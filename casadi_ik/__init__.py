"""Arm-hand inverse kinematics from fingertip contacts: fast, exact and explained."""

from casadi_ik import logs
from casadi_ik.api import Solver
from casadi_ik.arm_hand import ArmHand, load_robot
from casadi_ik.errors import CasadiIKError
from casadi_ik.files.shipped import shipped_names
from casadi_ik.grasps import Contact, Grasp, Tolerance, load_grasp, shipped_grasps
from casadi_ik.solvers import (
    METHODS,
    Alternative,
    ArmBranch,
    BatchSolution,
    ContactVerdict,
    Diagnosis,
    Jump,
    Phase,
    Reason,
    Solution,
    Status,
    Track,
)

__all__ = [
    "METHODS",
    "Alternative",
    "ArmBranch",
    "ArmHand",
    "BatchSolution",
    "CasadiIKError",
    "Contact",
    "ContactVerdict",
    "Diagnosis",
    "Grasp",
    "Jump",
    "Phase",
    "Reason",
    "Solution",
    "Solver",
    "Status",
    "Tolerance",
    "Track",
    "load_grasp",
    "load_robot",
    "logs",
    "shipped_grasps",
    "shipped_names",
]
