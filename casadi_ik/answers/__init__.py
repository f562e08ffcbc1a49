"""What a user gets: solutions and their verdicts, several solutions, rankings, diagnoses."""

from casadi_ik.answers.diagnosis import Diagnosis, Reason
from casadi_ik.answers.solution import Alternative, ArmBranch, Choice, CollisionReport, Ranking
from casadi_ik.problem.status import Phase
from casadi_ik.problem.verdict import ContactVerdict, PalmVerdict

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
