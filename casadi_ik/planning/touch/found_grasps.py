"""Grasps found for an object, and their robustness."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np

from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.numbers import checked_integer, checked_number
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Grasp
from casadi_ik.planning.touch.robustness import random_displacements, robustness
from casadi_ik.planning.touch.surface import Surface
from casadi_ik.solve.solution import Solution

POSE_ANGLE_ERROR = float(np.deg2rad(3.0))
"""Typical angle error of an object's pose from a camera [rad]."""


@dataclass(frozen=True, eq=False)
class FoundGrasp:
    """A grasp that the arm-hand can reach and hold.

    Attributes:
        grasp: Contacts in the base frame, with the object's name and pose, the posture of the hand,
            and the hand before it closes (`pregrasp`) and as it squeezes (`squeeze`).
        solution: Solution in the scene.
        load: Weight held by friction in the worst of six directions per newton of squeeze (sum of
            the normal forces). The displacement of the object, as pads roll and motors yield like
            springs, reduces it: by half at 20 mm or 30 deg [N/N].
        closure: Load in the worst direction of forces and torques (about the centre of the object,
            divided by half its size); positive for force closure [N/N].
        score: Score of the ranking; higher is better.
        forces: Force (3,) of each fingertip on the object that squeezes it, base frame. The object
            stays at rest, and resists any pull best. The normal components sum to 1 N.
        most_squeeze: Maximum sum of normal forces within the efforts of the motors [N]; inf if the
            robot's description has no `effort` of its joints.
    """

    grasp: Grasp
    solution: Solution
    load: float
    closure: float
    score: float
    forces: Mapping[str, Array]
    most_squeeze: float = np.inf

    @property
    def q(self) -> Array:
        """(n,) configuration of the grasp, the goal of `Solver.reach`."""
        return self.solution.q

    @property
    def clearance(self) -> float | None:
        """Smallest distance between bodies that must not touch [m]."""
        return self.solution.clearance

    @property
    def pregrasp(self) -> Grasp | None:
        """Palm and posture before the hand closes; None if every opening collides."""
        return self.grasp.pregrasp


@dataclass(frozen=True, eq=False)
class FoundGrasps(Sequence[FoundGrasp]):
    """Distinct grasps of an object, best first.

    Attributes:
        entries: The grasps, which are the elements of this sequence.
        counts: Number of candidates that passed each stage, in order.
        prefer: Name of the ranking.
        time: Processor time [s].
        reason: Stage that no candidate passed and its likely cause; "" if there are grasps.
        robot: The robot.
        surface: Surface of the object.
        mu: Friction coefficient.
    """

    entries: tuple[FoundGrasp, ...]
    counts: Mapping[str, int]
    prefer: str
    time: float
    reason: str
    robot: ArmHand
    surface: Surface
    mu: float

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[FoundGrasp]:
        return iter(self.entries)

    @overload
    def __getitem__(self, index: int) -> FoundGrasp: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[FoundGrasp, ...]: ...

    def __getitem__(self, index: int | slice) -> FoundGrasp | tuple[FoundGrasp, ...]:
        return self.entries[index]

    @property
    def grasps(self) -> tuple[Grasp, ...]:
        """The grasps, for `Solver.choose`."""
        return tuple(entry.grasp for entry in self.entries)

    def robustness(
        self,
        position: float = 5e-3,
        angle: float = POSE_ANGLE_ERROR,
        hold: tuple[float, float] | None = None,
        samples: int = 64,
        seed: int = 0,
    ) -> Array:
        """Return the fraction of object displacements at which each grasp closes on the object.

        The palm moves to its planned pose, and each finger closes until it touches the object.

        Args:
            position: Displacement of the object, in random directions [m].
            angle: Rotation of the object, about random axes [rad].
            hold: Mass [kg] that the contacts have to hold, and the squeeze [N], as for
                `Solver.grasps_of`; None: the contacts have to be force-closed.
            samples: Number of displacements of each grasp.
            seed: Seed of the random directions.

        Returns:
            (k,) fraction of displacements at which each grasp closes.

        Raises:
            InputError: A number is negative or infinite, there is no sample, or `hold` is invalid.

        Example:
            >>> pose = np.eye(4)
            >>> pose[:3, 3] = [0.55, 0.1, 0.2]
            >>> gripper = ik.Solver(ik.load_robot("panda+panda_hand"))
            >>> found = gripper.grasps_of(ik.load_surface("tomato_soup_can"), pose, limit=3)
            >>> found.robustness(position=0.0, angle=0.0, samples=1)
            array([1., 1., 1.])
        """
        position = checked_number(position, "robustness: position", "a length [m] >= 0", 0.0)
        angle = checked_number(angle, "robustness: angle", "an angle [rad] >= 0", 0.0)
        samples = checked_integer(samples, "robustness: samples", 1)
        seed, hold = checked_integer(seed, "robustness: seed", 0), checked_hold(hold)
        displacements = random_displacements(position, angle, samples, seed, self.surface.middle)
        fractions = [
            robustness(self.robot, self.surface, entry.grasp, entry.q, self.mu, displacements, hold)
            for entry in self
        ]
        return np.array(fractions)

    @property
    def lines(self) -> tuple[str, ...]:
        """Lines of the summary."""
        lines = [f"{len(self)} distinct grasps in {self.time:.2f} s of processor time"]
        lines += [f"  {number:>9,} {stage}" for stage, number in self.counts.items()]
        lines += [f"{self.surface.name}: {note}" for note in self.surface.notes]
        if self.reason:
            return (*lines, f"none: {self.reason}")
        lines.append(f"best by {self.prefer}:")
        for rank, entry in enumerate(self.entries[:10], 1):
            clearance = entry.clearance
            suffix = "" if clearance is None else f", clearance {1e3 * clearance:.1f} mm"
            score = "" if self.prefer == "load" else f"{self.prefer} {entry.score:.4g}, "
            lines.append(f"  {rank:>2}. {score}load {entry.load:.3f} N/N{suffix}")
        return tuple(lines)

    def __str__(self) -> str:
        return "\n".join(self.lines)

    def __repr__(self) -> str:
        return f"<FoundGrasps: {len(self)} by {self.prefer}>"


def checked_hold(hold: Any) -> tuple[float, float] | None:
    """Return the validated mass [kg] and squeeze [N], or None.

    Raises:
        InputError: `hold` is not a pair of positive numbers.
    """
    if hold is None:
        return None
    expected = "a mass [kg] and a squeeze [N], both > 0"
    try:
        mass, squeeze = hold
    except (TypeError, ValueError) as error:
        raise InputError(f"hold: found {hold!r}, expected {expected}") from error
    smallest = float(np.finfo(float).tiny)
    return (
        checked_number(mass, "hold", expected, smallest),
        checked_number(squeeze, "hold", expected, smallest),
    )
