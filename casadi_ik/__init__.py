"""Arm-hand inverse kinematics from fingertip contacts: fast, exact and explained."""

from casadi_ik import logs
from casadi_ik.api import Solver
from casadi_ik.arm_hand import ArmHand, load_robot
from casadi_ik.control import ScrewControl
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
from casadi_ik.solvers.trajectory import Trajectory
from casadi_ik.steps.screw_objectives import ScrewTask

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
    "ScrewControl",
    "ScrewTask",
    "Solution",
    "Solver",
    "Status",
    "Tolerance",
    "Track",
    "Trajectory",
    "load_grasp",
    "load_robot",
    "logs",
    "shipped_grasps",
    "shipped_names",
]
