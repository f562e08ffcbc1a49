"""Requests of a page, and how they are answered: solved, and told why not where they cannot be.

A request is contacts that hang on controls, an object, a scene and settings.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np

from casadi_ik.api import METHODS, Solver
from casadi_ik.app.drawing.drawables import with_object
from casadi_ik.app.drawing.surfaces import facing
from casadi_ik.collision.clearance import Closest, closest_points
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import CasadiIKError, UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import POINT_CONSTRAINTS, Contact, Grasp, Tolerance
from casadi_ik.model.pose import inverse
from casadi_ik.solve.request import CLEARANCE, Request, tolerances_by_finger
from casadi_ik.solve.solution import Alternative, Solution
from casadi_ik.solve.status import Status
from casadi_ik.solve.verdict import ContactVerdict, judge

OBJECT = "object"
"""What the object is called among the things that can be moved."""

NOT_MET = "NOT MET"
"""Said of a configuration that has not all it is asked for."""

TOUCHES = "Contacts and limits are met, but something collides; looking for a way out."
MISSES = "The nearest that was found; why follows when the mouse rests."
"""Said until it is known why nothing answers."""


@dataclass(frozen=True)
class Settings:
    """How it is solved.

    Attributes:
        method: One of `METHODS`.
        tolerance: When a contact counts as reached.
        limits: "enforce" or "ignore".
        prefer: Which of several solutions; "q0": the one nearest to what is shown.
    """

    method: str = METHODS[0]
    tolerance: Tolerance = field(default_factory=Tolerance)
    limits: str = "enforce"
    prefer: str = "q0"


@dataclass(frozen=True, eq=False)
class Held:
    """A contact that moves with a control.

    Attributes:
        contact: In the control's frame.
        control: (4, 4) where the control is, base frame.
        used: Whether the contact is asked for.
        normal: Whether its normal is.
    """

    contact: Contact
    control: Array
    used: bool = True
    normal: bool = True

    @cached_property
    def placed(self) -> Contact:
        """The contact in the base frame, with what is asked of it."""
        found = self.contact.at(self.control)
        if self.normal or not np.isfinite(found.point).all():
            return found
        places = {name: getattr(found, name) for name in POINT_CONSTRAINTS}
        return Contact(found.point, tolerance=found.tolerance, **places)


@dataclass(frozen=True, eq=False)
class PageRequest:
    """A question; moved things give another one.

    Attributes:
        held: Contact by finger, of all fingers of the robot that may have one.
        name: What the grasp is called.
        robot: Name or path of the robot.
        object: Name of the object that is grasped; "" if there is none.
        object_pose: (4, 4) where it is; None if there is none.
        scene: What stands about the robot; None: nothing is checked.
        settings: How it is solved.
    """

    held: Mapping[str, Held]
    name: str = ""
    robot: str = ""
    object: str = ""
    object_pose: Array | None = None
    scene: Scene | None = None
    settings: Settings = Settings()

    @cached_property
    def grasp(self) -> Grasp:
        """The grasp; at least one finger is used."""
        contacts = {name: one.placed for name, one in self.held.items() if one.used}
        return Grasp(contacts, self.robot, self.name, self.object, self.object_pose)

    @property
    def places(self) -> dict[str, Array]:
        """(4, 4) poses of all that can be moved, by name: contacts, the object, items."""
        found = {finger: one.control for finger, one in self.held.items()}
        if self.object_pose is not None:
            found[OBJECT] = self.object_pose
        items = {} if self.scene is None else self.scene.items
        return {name: item.pose for name, item in items.items()} | found

    def moved(self, name: str, pose: Array) -> PageRequest:
        """One of them at another (4, 4) pose; the object takes all contacts along.

        Raises:
            CasadiIKError: There is no such thing.
        """
        if name in self.held:
            return self._held(name, replace(self.held[name], control=pose))
        if name != OBJECT or self.object_pose is None:
            return replace(self, scene=(self.scene or Scene()).moved(name, pose))
        step = pose @ inverse(self.object_pose)
        held = {
            finger: replace(one, control=_rigid(step @ one.control))
            for finger, one in self.held.items()
        }
        return replace(self, held=held, object_pose=pose)

    def with_point(self, finger: str, point: Array) -> PageRequest:
        """A contact moved to a point (3,) [m], facing as before."""
        pose = self.held[finger].control.copy()
        pose[:3, 3] = point
        return self.moved(finger, pose)

    def with_normal(self, finger: str, normal: Array) -> PageRequest:
        """A contact turned so that its control's x axis, its normal, faces another way (3,)."""
        pose = self.held[finger].control
        return self.moved(finger, facing(pose[:3, 3], normal, pose[:3, :3]))

    def with_use(self, finger: str, used: bool, normal: bool) -> PageRequest:
        """A finger taken in or left free; as it is if it is the last one that is used."""
        changed = self._held(finger, replace(self.held[finger], used=used, normal=normal))
        return changed if any(one.used for one in changed.held.values()) else self

    def _held(self, finger: str, one: Held) -> PageRequest:
        return replace(self, held={**self.held, finger: one})


def request_of(
    robot: ArmHand,
    grasp: Grasp | None,
    q: Array | None,
    scene: Scene | None = None,
    settings: Settings | None = None,
) -> PageRequest:
    """The first question of a page.

    Args:
        robot: The robot.
        grasp: What is asked; None: the contacts that are reached at q.
        q: (n,) where the robot is [rad or m]; None: at home.
        scene: What stands about.
        settings: How it is solved.

    Raises:
        InputError: The grasp has a finger that the robot has not.
    """
    frames = robot.contact_frames(robot.configuration(q))
    given = {} if grasp is None else dict(grasp.contacts)
    if grasp is not None:
        grasp.arrays(robot.fingers)
    held: dict[str, Held] = {}
    for finger, frame in zip(robot.fingers, frames, strict=True):
        contact = given.get(finger)
        used = contact is not None or grasp is None
        contact = contact or Contact(frame[:3, 3], frame[:3, 0])
        place = contact.point if np.isfinite(contact.point).all() else frame[:3, 3]
        ways = (contact.normal, contact.ball, frame[:3, 0])
        normal = next(way for way in ways if way is not None)
        control = facing(place, normal, frame[:3, :3])
        if contact.normal is None and all(
            getattr(contact, name) is None for name in POINT_CONSTRAINTS
        ):
            # Its normal is at hand if it is wanted after all.
            whole = Contact(place, normal, contact.tolerance)
            held[finger] = Held(whole.at(inverse(control)), control, used, normal=False)
        else:
            held[finger] = Held(contact.at(inverse(control)), control, used)
    found = PageRequest(held, robot=robot.name, scene=scene, settings=settings or Settings())
    if grasp is None:
        return found
    return replace(found, name=grasp.name, object=grasp.object, object_pose=grasp.object_pose)


def _rigid(pose: Array) -> Array:
    """A pose without what rounding has added to its rotation over many steps."""
    u, _, vt = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = u @ vt
    return pose


# Answers.


@dataclass(frozen=True, eq=False)
class Answer:
    """What is shown.

    Attributes:
        q: (n,) where the robot is: the solution, or what is nearest to one [rad or m].
        success: Whether that is one.
        headline: How it ended, in a word or two.
        contacts: Verdict by finger, on q.
        lines: Why not, and what would help; empty if it is solved.
        clearance: Of q [m]; None where nothing is checked.
        closest: The nearest pair's names and points; None where there is none.
        seconds: The solve took.
        how: Method, iterations and such in a line.
        unexplained: Whether why not has to be found out yet.
        checked: Whether collisions are checked: there is a scene.
    """

    q: Array
    success: bool
    headline: str
    contacts: dict[str, ContactVerdict]
    lines: tuple[str, ...] = ()
    clearance: float | None = None
    closest: tuple[tuple[str, str], Closest] | None = None
    seconds: float = 0.0
    how: str = ""
    unexplained: bool = False
    checked: bool = True

    @property
    def sentence(self) -> str:
        """All that in one sentence."""
        if self.lines:
            return self.lines[0]
        missed = [name for name, one in self.contacts.items() if not one.ok]
        if missed:
            return f"{' and '.join(missed)} missed, or a joint is beyond a limit."
        if self.clearance is None:
            return "Every contact is reached" + (
                "." if self.checked else "; collision not checked."
            )
        word = "reached" if self.clearance >= 0 else "reached, but something collides"
        return f"Every contact is {word}; clearance {1e3 * self.clearance:.1f} mm."


class Answerer:
    """Solves what is asked about one robot; keeps its solvers."""

    def __init__(self, robot: ArmHand) -> None:
        """Take the robot."""
        self.robot = robot
        self._solver = lru_cache(maxsize=16)(self._built)
        self._in_scene: tuple[Settings, Scene, Solver] | None = None

    def solver(self, asked: PageRequest) -> Solver:
        """The solver for a question; one in the scene of the last is that one with things moved.

        Raises:
            CasadiIKError: The scene or the method does not fit the robot.
        """
        settings, scene = asked.settings, asked.scene
        if scene is None:
            return self._solver(settings, None)
        if self._in_scene is None or not _alike(self._in_scene, settings, scene):
            solver = self._solver(settings, scene)
        else:
            _, before, solver = self._in_scene
            for name, item in scene.items.items():
                if item is not before.items[name]:
                    solver = solver.moved(name, item.pose)
        self._in_scene = settings, scene, solver
        return solver

    def solve(self, asked: PageRequest, q: Array, diagnose: bool = False) -> Answer:
        """The answer nearest to q, or the preferred one, or the nearest to one that was found.

        Why there is none takes up to a second to find out: `explain` tells.

        Raises:
            CasadiIKError: The question is malformed.
        """
        solution = self._preferred(asked, q, diagnose)
        shown = solution.q
        if solution.diagnosis is not None and solution.status is not Status.COLLISION:
            shown = solution.diagnosis.q
        if not np.isfinite(shown).all():
            shown = q
        words = f"{solution.method} · {counted(solution.iterations, 'iteration')}"
        if solution.restarts:
            words += f" · {counted(solution.restarts, 'restart')}"
        missed = not (diagnose or solution.success or solution.status is Status.COLLISION)
        return replace(
            self.judged(asked, shown),
            success=solution.success,
            headline=NOT_MET if missed else solution.status.name.replace("_", " "),
            lines=why_not(solution),
            seconds=solution.time,
            how=words,
            unexplained=not (diagnose or solution.success),
        )

    def explain(self, asked: PageRequest, q: Array) -> Answer:
        """The same with why a grasp is not solved and what would help.

        What is shown stays if nothing nearer is found: of several that are equally near, the arm
        does not go to another when the mouse rests.

        Raises:
            CasadiIKError: The question is malformed.
        """
        found, shown = self.solve(asked, q, diagnose=True), self.judged(asked, q)
        if found.success or _missed(shown) > 1.02 * _missed(found):
            return found
        kept = {name: getattr(shown, name) for name in ("contacts", "clearance", "closest")}
        return replace(found, q=q, **kept)

    def judged(self, asked: PageRequest, q: Array) -> Answer:
        """How a configuration meets what is asked."""
        tolerances = tolerances_by_finger(asked.settings.tolerance, self.robot.fingers)
        enforced = asked.settings.limits == "enforce"
        targets = Request(self.robot, tolerances, enforced).of_grasps([asked.grasp], None)
        verdict = judge(self.robot, targets, q[None])
        contacts = {
            finger: ContactVerdict(
                float(verdict.position_error[0, i]),
                float(verdict.angle_error[0, i]),
                bool(verdict.ok[0, i]),
                targets.tolerances[i],
            )
            for i, finger in enumerate(self.robot.fingers)
        }
        found = Answer(q, bool(verdict.solved(enforced)[0]), "", contacts, checked=False)
        if asked.scene is not None:
            found = self._clear(asked, found)
        return replace(found, headline="MET" if found.success else NOT_MET)

    def every(self, asked: PageRequest, q: Array) -> tuple[Alternative, ...]:
        """All solutions, by arm branch, swivel and hand posture; none from other methods."""
        try:
            return self.solver(asked).solve_all(asked.grasp, 64, asked.settings.prefer, q)
        except UnsupportedError:
            return ()

    def _clear(self, asked: PageRequest, found: Answer) -> Answer:
        """What is judged, with how far it is from touching something."""
        clear = self.solver(asked).check(found.q, asked.grasp)
        pair = None if clear is None else clear.pair(0)
        if asked.scene is None or clear is None or pair is None:
            return replace(found, checked=True)
        points = closest_points(self.robot, found.q, with_object(asked.scene, asked.grasp), pair)
        return replace(
            found,
            success=found.success and bool(clear.free[0]),
            clearance=float(clear.distance[0]),
            closest=None if points is None else (pair, points),
            checked=True,
        )

    def _preferred(self, asked: PageRequest, q: Array, diagnose: bool) -> Solution:
        solver, prefer = self.solver(asked), asked.settings.prefer
        if prefer == CLEARANCE and asked.scene is None:
            prefer = "q0"
        try:
            return solver.solve(asked.grasp, q, prefer=prefer, diagnose=diagnose)
        except UnsupportedError:
            # A method that cannot choose takes the solution it comes to.
            return solver.solve(asked.grasp, q, diagnose=diagnose)

    def _built(self, settings: Settings, scene: Scene | None) -> Solver:
        return Solver(self.robot, settings.method, settings.tolerance, settings.limits, scene=scene)


def counted(number: int, what: str) -> str:
    """A number of things in words."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _missed(answer: Answer) -> float:
    """By how much the worst contact is missed, in tolerances."""
    parts = [0.0]
    for one in answer.contacts.values():
        parts += [
            one.position_error / one.tolerance.position,
            one.angle_error / one.tolerance.angle,
        ]
    return float(np.nanmax(parts))


def why_not(solution: Solution) -> tuple[str, ...]:
    """Why a grasp is not solved, in short lines."""
    if solution.success:
        return ()
    if solution.collision is not None:
        return solution.collision.lines
    if solution.diagnosis is not None:
        return solution.diagnosis.lines
    return (TOUCHES if solution.status is Status.COLLISION else MISSES,)


def _alike(known: tuple[Settings, Scene, Solver], settings: Settings, scene: Scene) -> bool:
    """Whether a solver differs from the one wanted in nothing but where things stand."""
    solved_by, before, _ = known
    return (
        replace(solved_by, prefer=settings.prefer) == settings
        and before.items.keys() == scene.items.keys()
        and before.margin == scene.margin
        and all(before.items[name].parts is one.parts for name, one in scene.items.items())
    )


def failed(error: CasadiIKError, q: Array) -> Answer:
    """What is shown of a question that cannot be asked."""
    return Answer(q, False, "NOT ASKED", {}, (str(error),))
