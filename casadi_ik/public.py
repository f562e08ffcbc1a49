"""The public names of casadi_ik, where each of them is; `casadi_ik` looks here for them."""

from casadi_ik import answers, errors, logs, motion, papers
from casadi_ik.answers.solution import BatchSolution, Solution
from casadi_ik.api import Solver
from casadi_ik.arm_hand import ArmHand, load_robot
from casadi_ik.collision.scene import Scene, load_scene
from casadi_ik.datasets import Candidates, load_candidates
from casadi_ik.errors import CasadiIKError
from casadi_ik.files.shipped import shipped_names
from casadi_ik.grasps import Contact, Grasp, Tolerance, load_grasp, shipped_grasps
from casadi_ik.grasps.pose import Free
from casadi_ik.problem.status import Status
from casadi_ik.registry import METHODS, register_method
from casadi_ik.touch.surface import Surface, load_surface

SUBMODULES = ("answers", "errors", "logs", "motion", "papers")
"""Where the other public names are."""

__all__ = [
    "METHODS",
    "ArmHand",
    "BatchSolution",
    "Candidates",
    "CasadiIKError",
    "Contact",
    "Free",
    "Grasp",
    "Scene",
    "Solution",
    "Solver",
    "Status",
    "Surface",
    "Tolerance",
    "answers",
    "errors",
    "load_candidates",
    "load_grasp",
    "load_robot",
    "load_scene",
    "load_surface",
    "logs",
    "motion",
    "papers",
    "register_method",
    "shipped_grasps",
    "shipped_names",
]
