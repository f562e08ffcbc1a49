"""Targets, methods, the engine that runs them, and the solutions they return."""

from casadi_ik.solve.diagnosis import Diagnosis, Reason
from casadi_ik.solve.solution import Alternative, ArmBranch, Choice, CollisionReport, Ranking
from casadi_ik.solve.status import Phase
from casadi_ik.solve.verdict import ContactVerdict, PalmVerdict

__all__ = [
    "Alternative",
    "ArmBranch",
    "Choice",
    "CollisionReport",
    "ContactVerdict",
    "Diagnosis",
    "PalmVerdict",
    "Phase",
    "Ranking",
    "Reason",
]
