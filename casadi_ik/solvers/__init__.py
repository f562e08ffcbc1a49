"""Loops, phases, status and verdicts."""

from casadi_ik.solvers.alternatives import PREFERENCES, Alternative
from casadi_ik.solvers.arm_branches import ArmBranch
from casadi_ik.solvers.contact_verdict import ContactVerdict
from casadi_ik.solvers.diagnosis import Diagnosis, Reason
from casadi_ik.solvers.engine import Engine
from casadi_ik.solvers.problem import LIMITS, Problems, Tolerance, fixed_array, target_arrays
from casadi_ik.solvers.questions import Questions, tolerances_by_finger
from casadi_ik.solvers.recorder import Recorder
from casadi_ik.solvers.registry import METHODS, build_method, method_options, method_summary
from casadi_ik.solvers.solution import BatchSolution, Solution
from casadi_ik.solvers.stepper import SteppedMethod, Stepper
from casadi_ik.solvers.stream import SolvedBlock, Stream
from casadi_ik.solvers.tracking import Jump, Track, travel_limits
from casadi_ik.steps.status import Phase, Status

__all__ = [
    "LIMITS",
    "METHODS",
    "PREFERENCES",
    "Alternative",
    "ArmBranch",
    "BatchSolution",
    "ContactVerdict",
    "Diagnosis",
    "Engine",
    "Jump",
    "Phase",
    "Problems",
    "Questions",
    "Reason",
    "Recorder",
    "Solution",
    "SolvedBlock",
    "Status",
    "SteppedMethod",
    "Stepper",
    "Stream",
    "Tolerance",
    "Track",
    "build_method",
    "fixed_array",
    "method_options",
    "method_summary",
    "target_arrays",
    "tolerances_by_finger",
    "travel_limits",
]
