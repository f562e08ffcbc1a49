"""Requests of a page (contacts with handles, object, scene, settings) and their solution."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np

from casadi_ik.api import METHODS, Solver
from casadi_ik.app.drawing.drawables import scene_with_object
from casadi_ik.app.drawing.surfaces import pose_with_x_axis
from casadi_ik.collision.clearance import ClosestPoints, closest_points
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import CasadiIKError, UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import POINT_CONSTRAINTS, Contact, Grasp, Tolerance
from casadi_ik.model.pose import inverse
from casadi_ik.model.targets import CLEARANCE
from casadi_ik.solve.solution import Alternative, Solution
from casadi_ik.solve.status import Status
from casadi_ik.solve.target_builder import TargetBuilder, tolerances_by_finger
from casadi_ik.solve.verdict import ContactVerdict, judge

OBJECT_ITEM = "object"
"""Name of the object among the draggable items."""

NOT_MET = "NOT MET"
"""Headline when a contact or limit is violated."""

COLLISION_HINT = "Contacts and limits are met, but something collides; searching for a remedy."
NEAREST_HINT = "Nearest configuration; the diagnosis follows when the mouse rests."
"""Explanations that are shown until the diagnosis is available."""


@dataclass(frozen=True)
class Settings:
    """Solver settings of a page.

    Attributes:
        method: One of `METHODS`.
        tolerance: Tolerance of contacts.
        limits: "enforce" or "ignore".
        prefer: Preference among solutions; "q0": nearest to the configuration shown.
    """

    method: str = METHODS[0]
    tolerance: Tolerance = field(default_factory=Tolerance)
    limits: str = "enforce"
    prefer: str = "q0"


@dataclass(frozen=True, eq=False)
class DraggableContact:
    """A contact attached to a drag handle.

    Attributes:
        contact: Contact in the frame of the handle.
        control: (4, 4) Pose of the handle in the base frame.
        is_used: The contact is part of the grasp.
        uses_normal: The normal of the contact is constrained.
    """

    contact: Contact
    control: Array
    is_used: bool = True
    uses_normal: bool = True

    @cached_property
    def in_base(self) -> Contact:
        """Contact in the base frame, without its normal unless that is constrained."""
        contact = self.contact.transformed(self.control)
        if self.uses_normal or not np.isfinite(contact.point).all():
            return contact
        poses = {name: getattr(contact, name) for name in POINT_CONSTRAINTS}
        return Contact(contact.point, tolerance=contact.tolerance, **poses)


@dataclass(frozen=True, eq=False)
class PageRequest:
    """An immutable request; a drag produces a new one.

    Attributes:
        contacts: Contacts by finger, for all fingers of the robot.
        name: Name of the grasp.
        robot: Name or path of the robot.
        object: Name of the grasped object; "" if there is none.
        object_pose: (4, 4) Pose of the object; None if there is none.
        scene: Obstacles; None: collisions are not checked.
        settings: Solver settings.
    """

    contacts: Mapping[str, DraggableContact]
    name: str = ""
    robot: str = ""
    object: str = ""
    object_pose: Array | None = None
    scene: Scene | None = None
    settings: Settings = Settings()

    @cached_property
    def grasp(self) -> Grasp:
        """Grasp of the fingers in use, at least one."""
        used_contacts = {
            name: contact.in_base for name, contact in self.contacts.items() if contact.is_used
        }
        return Grasp(used_contacts, self.robot, self.name, self.object, self.object_pose)

    @property
    def poses(self) -> dict[str, Array]:
        """(4, 4) Poses by name of contacts, the object and scene items."""
        poses = {finger: contact.control for finger, contact in self.contacts.items()}
        if self.object_pose is not None:
            poses[OBJECT_ITEM] = self.object_pose
        items = {} if self.scene is None else self.scene.items
        return {name: item.pose for name, item in items.items()} | poses

    def with_pose(self, name: str, pose: Array) -> PageRequest:
        """Return the request with one item at a (4, 4) pose; contacts move with the object.

        Raises:
            CasadiIKError: The item does not exist.
        """
        if name in self.contacts:
            return self._with_contact(name, replace(self.contacts[name], control=pose))
        if name != OBJECT_ITEM or self.object_pose is None:
            return replace(self, scene=(self.scene or Scene()).moved(name, pose))
        displacement = pose @ inverse(self.object_pose)
        contacts = {
            finger: replace(contact, control=_orthonormalised(displacement @ contact.control))
            for finger, contact in self.contacts.items()
        }
        return replace(self, contacts=contacts, object_pose=pose)

    def with_point(self, finger: str, point: Array) -> PageRequest:
        """Return the request with a contact translated to a point (3,) [m]."""
        pose = self.contacts[finger].control.copy()
        pose[:3, 3] = point
        return self.with_pose(finger, pose)

    def with_normal(self, finger: str, normal: Array) -> PageRequest:
        """Return the request with a contact rotated to a normal (3,), the x axis of its handle."""
        pose = self.contacts[finger].control
        return self.with_pose(finger, pose_with_x_axis(pose[:3, 3], normal, pose[:3, :3]))

    def with_use(self, finger: str, is_used: bool, uses_normal: bool) -> PageRequest:
        """Return the request with a finger used or freed; one finger stays in use."""
        contact = replace(self.contacts[finger], is_used=is_used, uses_normal=uses_normal)
        request = self._with_contact(finger, contact)
        return request if any(contact.is_used for contact in request.contacts.values()) else self

    def _with_contact(self, finger: str, contact: DraggableContact) -> PageRequest:
        return replace(self, contacts={**self.contacts, finger: contact})


def request_of(
    robot: ArmHand,
    grasp: Grasp | None,
    q: Array | None,
    scene: Scene | None = None,
    settings: Settings | None = None,
) -> PageRequest:
    """Return the initial request of a page.

    Args:
        robot: The robot.
        grasp: The grasp; None: the contacts of the robot at q.
        q: (n,) Configuration [rad or m]; None: home.
        scene: Obstacles.
        settings: Solver settings.

    Raises:
        InputError: The grasp names a finger that the robot does not have.
    """
    frames = robot.contact_frames(robot.configuration(q))
    target_contacts = {} if grasp is None else dict(grasp.contacts)
    if grasp is not None:
        grasp.arrays(robot.fingers)
    contacts: dict[str, DraggableContact] = {}
    for finger, frame in zip(robot.fingers, frames, strict=True):
        contact = target_contacts.get(finger)
        is_used = contact is not None or grasp is None
        contact = contact or Contact(frame[:3, 3], frame[:3, 0])
        position = contact.point if np.isfinite(contact.point).all() else frame[:3, 3]
        candidate_normals = (contact.normal, contact.ball, frame[:3, 0])
        normal = next(candidate for candidate in candidate_normals if candidate is not None)
        control = pose_with_x_axis(position, normal, frame[:3, :3])
        if contact.normal is None and all(
            getattr(contact, name) is None for name in POINT_CONSTRAINTS
        ):
            # The normal is stored so that it can be switched on later.
            full_contact = Contact(position, normal, contact.tolerance)
            local = full_contact.transformed(inverse(control))
            contacts[finger] = DraggableContact(local, control, is_used, uses_normal=False)
        else:
            contacts[finger] = DraggableContact(
                contact.transformed(inverse(control)), control, is_used
            )
    request = PageRequest(contacts, robot=robot.name, scene=scene, settings=settings or Settings())
    if grasp is None:
        return request
    return replace(request, name=grasp.name, object=grasp.object, object_pose=grasp.object_pose)


def _orthonormalised(pose: Array) -> Array:
    """Remove from a pose the skew that rounding accumulates over many drags."""
    u, _, vt = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = u @ vt
    return pose


# Results.


@dataclass(frozen=True, eq=False)
class SolveResult:
    """A configuration to show, and its verdict.

    Attributes:
        q: (n,) The solution, or the nearest configuration [rad or m].
        success: q solves the request.
        headline: Status in one or two words.
        verdicts: Verdict of q by finger.
        reasons: Reasons for a failure and remedies; empty if the request is solved.
        clearance: Clearance of q [m]; None if it was not computed.
        closest: Names and nearest points of the closest pair of shapes, if there is one.
        solve_time: Duration of the solve [s].
        summary: Method, iterations and restarts in a line.
        needs_diagnosis: The reasons for the failure are not known yet.
        collision_checked: The request has a scene, so collisions are checked.
    """

    q: Array
    success: bool
    headline: str
    verdicts: dict[str, ContactVerdict]
    reasons: tuple[str, ...] = ()
    clearance: float | None = None
    closest: tuple[tuple[str, str], ClosestPoints] | None = None
    solve_time: float = 0.0
    summary: str = ""
    needs_diagnosis: bool = False
    collision_checked: bool = True

    @property
    def sentence(self) -> str:
        """Summary of the result in one sentence."""
        if self.reasons:
            return self.reasons[0]
        missed = [name for name, verdict in self.verdicts.items() if not verdict.ok]
        if missed:
            return f"{' and '.join(missed)} missed, or a joint limit is exceeded."
        if self.clearance is None:
            return "Every contact is reached" + (
                "." if self.collision_checked else "; collision not checked."
            )
        outcome = "reached" if self.clearance >= 0 else "reached, but something collides"
        return f"Every contact is {outcome}; clearance {1e3 * self.clearance:.1f} mm."


class RequestSolver:
    """A solver of requests for one robot, with a cache of solvers by settings and scene."""

    def __init__(self, robot: ArmHand) -> None:
        """Store the robot."""
        self.robot = robot
        self._solver = lru_cache(maxsize=16)(self._new_solver)
        self._scene_solver: tuple[Settings, Scene, Solver] | None = None

    def solver(self, request: PageRequest) -> Solver:
        """Return the solver of a request; moved scene items are updated in the previous solver.

        Raises:
            CasadiIKError: The scene or the method does not fit the robot.
        """
        settings, scene = request.settings, request.scene
        if scene is None:
            return self._solver(settings, None)
        if self._scene_solver is None or not _only_poses_differ(
            self._scene_solver, settings, scene
        ):
            solver = self._solver(settings, scene)
        else:
            _, previous_scene, solver = self._scene_solver
            for name, item in scene.items.items():
                if item is not previous_scene.items[name]:
                    solver = solver.moved(name, item.pose)
        self._scene_solver = settings, scene, solver
        return solver

    def solve(self, request: PageRequest, q: Array, diagnose: bool = False) -> SolveResult:
        """Return the solution nearest to q or preferred, or else the nearest configuration.

        A diagnosis needs up to a second; `explain` adds it later.

        Raises:
            CasadiIKError: The request is malformed.
        """
        solution = self._solve_with_preference(request, q, diagnose)
        q_shown = solution.q
        if solution.diagnosis is not None and solution.status is not Status.COLLISION:
            q_shown = solution.diagnosis.q
        if not np.isfinite(q_shown).all():
            q_shown = q
        summary = f"{solution.method} · {count_text(solution.iterations, 'iteration')}"
        if solution.restarts:
            summary += f" · {count_text(solution.restarts, 'restart')}"
        has_violation = not (diagnose or solution.success or solution.status is Status.COLLISION)
        return replace(
            self.check(request, q_shown),
            success=solution.success,
            headline=NOT_MET if has_violation else solution.status.name.replace("_", " "),
            reasons=failure_reasons(solution),
            solve_time=solution.time,
            summary=summary,
            needs_diagnosis=not (diagnose or solution.success),
        )

    def explain(self, request: PageRequest, q: Array) -> SolveResult:
        """Return the result with the reasons for a failure and possible remedies.

        The displayed configuration changes only if the diagnosis finds a nearer configuration, so
        that the arm does not switch between equivalent configurations while the mouse rests.

        Raises:
            CasadiIKError: The request is malformed.
        """
        diagnosed, current = self.solve(request, q, diagnose=True), self.check(request, q)
        if diagnosed.success or _worst_error(current) > 1.02 * _worst_error(diagnosed):
            return diagnosed
        return replace(
            diagnosed,
            q=q,
            verdicts=current.verdicts,
            clearance=current.clearance,
            closest=current.closest,
        )

    def check(self, request: PageRequest, q: Array) -> SolveResult:
        """Return the verdict of a configuration without solving."""
        tolerances = tolerances_by_finger(request.settings.tolerance, self.robot.fingers)
        enforced = request.settings.limits == "enforce"
        targets = TargetBuilder(self.robot, tolerances, enforced).from_grasps([request.grasp])
        verdict = judge(self.robot, targets, q[None])
        verdicts = {
            finger: ContactVerdict(
                float(verdict.position_error[0, i]),
                float(verdict.angle_error[0, i]),
                bool(verdict.ok[0, i]),
                targets.tolerances[i],
            )
            for i, finger in enumerate(self.robot.fingers)
        }
        result = SolveResult(
            q, bool(verdict.solved(enforced)[0]), "", verdicts, collision_checked=False
        )
        if request.scene is not None:
            result = self._with_clearance(request, result)
        return replace(result, headline="MET" if result.success else NOT_MET)

    def solve_all(self, request: PageRequest, q: Array) -> tuple[Alternative, ...]:
        """Return all solutions by arm branch, swivel and hand posture; empty for other methods."""
        try:
            return self.solver(request).solve_all(request.grasp, 64, request.settings.prefer, q)
        except UnsupportedError:
            return ()

    def _with_clearance(self, request: PageRequest, result: SolveResult) -> SolveResult:
        """Add the clearance and the closest pair of shapes to a result."""
        clearance = self.solver(request).check(result.q, request.grasp)
        pair = None if clearance is None else clearance.pair(0)
        if request.scene is None or clearance is None or pair is None:
            return replace(result, collision_checked=True)
        points = closest_points(
            self.robot, result.q, scene_with_object(request.scene, request.grasp), pair
        )
        return replace(
            result,
            success=result.success and bool(clearance.free[0]),
            clearance=float(clearance.distance[0]),
            closest=None if points is None else (pair, points),
            collision_checked=True,
        )

    def _solve_with_preference(self, request: PageRequest, q: Array, diagnose: bool) -> Solution:
        solver, prefer = self.solver(request), request.settings.prefer
        if prefer == CLEARANCE and request.scene is None:
            prefer = "q0"
        try:
            return solver.solve(request.grasp, q, prefer=prefer, diagnose=diagnose)
        except UnsupportedError:
            # The method does not support preferences.
            return solver.solve(request.grasp, q, diagnose=diagnose)

    def _new_solver(self, settings: Settings, scene: Scene | None) -> Solver:
        return Solver(self.robot, settings.method, settings.tolerance, settings.limits, scene=scene)


def count_text(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is 1."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _worst_error(result: SolveResult) -> float:
    """Return the largest contact error relative to its tolerance."""
    relative_errors = [0.0]
    for verdict in result.verdicts.values():
        relative_errors += [
            verdict.position_error / verdict.tolerance.position,
            verdict.angle_error / verdict.tolerance.angle,
        ]
    return float(np.nanmax(relative_errors))


def failure_reasons(solution: Solution) -> tuple[str, ...]:
    """Return the reasons for a failure in short lines."""
    if solution.success:
        return ()
    if solution.collision is not None:
        return solution.collision.lines
    if solution.diagnosis is not None:
        return solution.diagnosis.lines
    return (COLLISION_HINT if solution.status is Status.COLLISION else NEAREST_HINT,)


def _only_poses_differ(
    entry: tuple[Settings, Scene, Solver], settings: Settings, scene: Scene
) -> bool:
    """Return True if a cached solver fits but for the poses of scene items and the preference."""
    solver_settings, solver_scene, _ = entry
    return (
        replace(solver_settings, prefer=settings.prefer) == settings
        and solver_scene.items.keys() == scene.items.keys()
        and solver_scene.margin == scene.margin
        and all(solver_scene.items[name].parts is item.parts for name, item in scene.items.items())
    )


def invalid_result(error: CasadiIKError, q: Array) -> SolveResult:
    """Return the result of a request that cannot be solved."""
    return SolveResult(q, False, "INVALID REQUEST", {}, (str(error),))
