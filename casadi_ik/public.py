"""The public names of casadi_ik, where each of them is; `casadi_ik` looks here for them."""

from casadi_ik import logs, papers
from casadi_ik.answers.diagnosis import Diagnosis, Reason
from casadi_ik.answers.solution import BatchSolution, Choice, CollisionReport, Ranking, Solution
from casadi_ik.api import Solver
from casadi_ik.arm_hand import ArmHand, load_robot
from casadi_ik.collision.scene import Scene, load_scene
from casadi_ik.datasets import Candidates, load_candidates
from casadi_ik.errors import CasadiIKError
from casadi_ik.files.shipped import shipped_names
from casadi_ik.grasps import Contact, Grasp, Tolerance, load_grasp, shipped_grasps
from casadi_ik.motion.follower import Follower, FollowState, FollowStatus
from casadi_ik.motion.motion import Motion
from casadi_ik.motion.reach import Approach, Reach, ReachStatus
from casadi_ik.motion.retarget import Retargeter, load_retarget
from casadi_ik.motion.track import Jump, Track
from casadi_ik.problem.status import Phase, Status
from casadi_ik.problem.trajectory import Trajectory
from casadi_ik.problem.verdict import ContactVerdict, PalmVerdict
from casadi_ik.registry import METHODS, register_method
from casadi_ik.solving.alternatives.branches import ArmBranch
from casadi_ik.solving.alternatives.finder import Alternative

__all__ = [
    "METHODS",
    "Alternative",
    "Approach",
    "ArmBranch",
    "ArmHand",
    "BatchSolution",
    "Candidates",
    "CasadiIKError",
    "Choice",
    "CollisionReport",
    "Contact",
    "ContactVerdict",
    "Diagnosis",
    "FollowState",
    "FollowStatus",
    "Follower",
    "Grasp",
    "Jump",
    "Motion",
    "PalmVerdict",
    "Phase",
    "Ranking",
    "Reach",
    "ReachStatus",
    "Reason",
    "Retargeter",
    "Scene",
    "Solution",
    "Solver",
    "Status",
    "Tolerance",
    "Track",
    "Trajectory",
    "load_candidates",
    "load_grasp",
    "load_retarget",
    "load_robot",
    "load_scene",
    "logs",
    "papers",
    "register_method",
    "shipped_grasps",
    "shipped_names",
]
