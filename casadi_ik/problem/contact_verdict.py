"""How well one finger meets its contact, and a palm its pose."""

from __future__ import annotations

from dataclasses import dataclass

from casadi_ik.grasps import Tolerance


@dataclass(frozen=True)
class ContactVerdict:
    """How well one finger meets its contact.

    Attributes:
        position_error: Distance from the contact point [m]; NaN if the finger is free.
        angle_error: Angle from the normal [rad]; NaN if it is free.
        ok: Within tolerance (what is free is).
        tolerance: What it was compared with.

    Example:
        >>> verdict = solution.contacts["thumb"]
        >>> verdict.ok, verdict.position_error < verdict.tolerance.position
        (True, True)
    """

    position_error: float
    angle_error: float
    ok: bool
    tolerance: Tolerance


@dataclass(frozen=True)
class PalmVerdict:
    """How well the palm is where it was asked.

    Attributes:
        position_error: Distance of its origin [m].
        angle_error: Angle between its frame and the wanted one [rad].
        ok: Within the largest tolerance of the fingers.

    Example:
        >>> motors = [name for name in robot.actuators if name.startswith("bh_")]
        >>> posture = dict(zip(motors, robot.home[-len(motors):]))
        >>> palm = solver.solve(ik.Grasp(palm=robot.palm(robot.home), posture=posture)).palm
        >>> palm.ok, palm.position_error < 1e-6
        (True, True)
    """

    position_error: float
    angle_error: float
    ok: bool
