"""Grasps found for an object, and their robustness to errors of the object's pose."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import checked_integer, checked_number
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.pose import inverse
from casadi_ik.planning.touch.hand_table import HandTable
from casadi_ik.planning.touch.hands import HandCandidates
from casadi_ik.planning.touch.strength import friction_wrenches, grasp_strengths, narrowed_friction
from casadi_ik.planning.touch.surface import Surface
from casadi_ik.solve.solution import Solution

POSE_ANGLE_ERROR = float(np.deg2rad(3.0))
"""Typical angle error of an object's pose from a camera [rad]."""


@dataclass(frozen=True, eq=False)
class FoundGrasp:
    """A grasp with which the arm-hand can reach and hold an object.

    Attributes:
        grasp: Contacts in the base frame, with the object's name and pose, the posture of the hand,
            and the hand before it closes (`pregrasp`) and as it squeezes (`squeeze`).
        solution: Solution in the scene.
        load: Weight held by friction in the worst of six directions per newton of squeeze (sum of
            the normal forces) [N/N]. Pads that roll and motors that yield like springs let the
            object move, which reduces the load: by half at 20 mm or 30 deg.
        closure: Load in the worst direction of forces and torques (about the centre of the object,
            divided by half its size); positive for force closure [N/N].
        score: Score of the ranking; higher is better.
        forces: Squeezing force (3,) of each fingertip on the object, base frame. These forces are
            in balance and best resist a pull in any direction; their normal components sum to 1 N.
        most_squeeze: Maximum sum of normal forces within the efforts of the motors [N]; inf if the
            robot's description gives no `effort` for its joints.
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
            samples: Number of displacements, the same ones for every grasp.
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


OPENING_TRAVEL, CLOSING_TRAVEL, PATH_POSITIONS = 0.020, 0.020, 33
"""Travel of fingertips before and beyond their contacts [m], and number of positions on it."""

MAX_FACE_LEAN = float(np.deg2rad(45.0))
"""Maximum angle between pad normal and inward surface normal at which a flat pad touches with its
face [rad]."""


def robustness(
    robot: ArmHand,
    surface: Surface,
    grasp: Grasp,
    q: Array,
    mu: float,
    displacements: Array,
    hold: tuple[float, float] | None = None,
) -> float:
    """Return the fraction of object displacements at which the hand closes on the object.

    The palm stays at its planned pose. Each finger of the grasp closes from `OPENING_TRAVEL` before
    its contact until it touches or is `CLOSING_TRAVEL` beyond it. The hand closes if the resulting
    contacts are force-closed and, if `hold` is given, hold the mass. Fingers that share a motor are
    treated independently.

    Args:
        robot: The robot.
        surface: Surface of the object.
        grasp: The grasp, with the pose of the object.
        q: (n,) configuration of the grasp.
        mu: Friction coefficient.
        displacements: (k, 4, 4) displacements of the object, in its frame.
        hold: Mass [kg] that the contacts have to hold, and the squeeze [N]; None: the contacts
            have to be force-closed.
    """
    table, pose = HandTable.for_robot(robot), grasp.known_pose
    assert pose is not None
    palm = inverse(pose) @ robot.palm(q)
    hand = q[table.motors][None]
    touches = np.array([[name in grasp.contacts for name in robot.fingers]])
    hands = HandCandidates(palm[None], hand, touches)
    openings = np.linspace(OPENING_TRAVEL, -CLOSING_TRAVEL, PATH_POSITIONS)
    path = np.concatenate([table.opened(hands, float(opening)).hand for opening in openings])
    points, normals, linear, angular = table.pads(path)
    fingers = np.flatnonzero(touches[0])
    # Axes: k displacements, s positions on the path, c fingers of the grasp, m motors.
    # Jacobians (s, c, 3, m) in the planned frame of the object.
    linear, angular = (palm[:3, :3] @ jacobian[:, fingers] for jacobian in (linear, angular))
    motors = [robot.description.actuators[i] for i in table.motors]
    # Points (s, c, 3) in the planned frame of the object, then (k, s, c, 3) in the displaced
    # frames.
    points = points[:, fingers] @ palm[:3, :3].T + palm[:3, 3]
    normals = normals[:, fingers] @ palm[:3, :3].T
    inverses = np.linalg.inv(displacements)
    tips = np.einsum("kij,scj->ksci", inverses[:, :3, :3], points)
    tips += inverses[:, None, None, :3, 3]
    faces = np.einsum("kij,scj->ksci", inverses[:, :3, :3], normals)
    height = surface.foot(tips)[0] - table.radii[fingers]
    penetrates = height <= 0
    first = penetrates.argmax(axis=1)  # (k, c)
    meets = penetrates.any(axis=1) & (first > 0)
    # Of the positions before and after the contact, take the one that is nearer to the surface.
    previous = np.maximum(first - 1, 0)
    previous_is_nearer = np.abs(_at_position(height, previous)) < np.abs(
        _at_position(height, first)
    )
    position = np.where(previous_is_nearer, previous, first)
    contacts = surface.nearest(_at_position(tips, position))
    inward = -contacts.normal
    lean = np.arccos(np.clip((_at_position(faces, position) * inward).sum(axis=-1), -1, 1))
    meets &= lean < MAX_FACE_LEAN + table.roll[fingers]
    is_closed = np.zeros(len(displacements), dtype=bool)
    # Displacements at which the same fingers touch are evaluated together.
    for pattern in np.unique(meets, axis=0):
        rows = np.flatnonzero((meets == pattern).all(axis=1))
        if pattern.sum() < 2:
            continue
        index, columns = position[rows][:, pattern], np.flatnonzero(pattern)
        points, normals = (values[rows][:, pattern] for values in (contacts.point, inward))
        friction = narrowed_friction(mu, contacts.normal_spread[rows][:, pattern])
        radii = np.broadcast_to(table.radii[fingers[columns]], index.shape)
        rotations = inverses[rows, None, :3, :3]
        jacobians = rotations @ linear[index, columns]
        jacobians += np.cross(
            rotations @ angular[index, columns], (radii[..., None] * normals)[..., None], axis=2
        )
        length = surface.size / 2
        strength = grasp_strengths(
            friction_wrenches(points, normals, friction, surface.middle, length),
            points - surface.middle,
            normals,
            radii,
            jacobians,
            motors,
            mu,
            hold,
        )
        is_closed[rows] = strength.holds(hold)
    return float(is_closed.mean())


def _at_position(values: NDArray[Any], position: NDArray[np.intp]) -> NDArray[Any]:
    """Return the values (k, c, ...) of (k, s, c, ...) at positions (k, c) of the second axis."""
    k, c = position.shape
    return values[np.arange(k)[:, None], position, np.arange(c)]


def random_displacements(
    position: float, angle: float, samples: int, seed: int, middle: Array
) -> Array:
    """Return (k, 4, 4) displacements by a distance and an angle in random directions.

    Args:
        position: Distance [m].
        angle: Angle of the rotation about the centre of the object [rad].
        samples: Number of displacements, k.
        seed: Seed of the directions.
        middle: (3,) centre of the object [m].
    """
    rng = np.random.default_rng(seed)
    directions, axes = rng.normal(size=(2, samples, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    x, y, z = (axes / np.linalg.norm(axes, axis=1, keepdims=True)).T
    skew = np.zeros((samples, 3, 3))
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -z, y, -x
    skew -= skew.swapaxes(1, 2)
    displacements = np.tile(np.eye(4), (samples, 1, 1))
    displacements[:, :3, :3] += np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew
    displacements[:, :3, 3] = position * directions + middle - displacements[:, :3, :3] @ middle
    return displacements
