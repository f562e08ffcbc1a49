"""The page on which contacts are dragged: what is asked, what is answered, what is drawn."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import viser

from casadi_ik import palette
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import CasadiIKError
from casadi_ik.importing.surfaces import Surface
from casadi_ik.solving.alternatives.finder import Alternative
from casadi_ik.viewing.answering import Answered, Answerer, failed
from casadi_ik.viewing.asked import Asked
from casadi_ik.viewing.drawn_closest import DrawnClosest
from casadi_ik.viewing.drawn_contacts import Drags, DrawnContacts
from casadi_ik.viewing.drawn_robot import DrawnRobot
from casadi_ik.viewing.drawn_things import OBJECT, DrawnThings, lowest
from casadi_ik.viewing.newest import LOOKS, PAUSE, REST, Newest
from casadi_ik.viewing.panel import Panel
from casadi_ik.viewing.robot_parts import robot_parts
from casadi_ik.viewing.stage import look_at_robot, set_stage

LATEST = 0.5
"""Motors are shown when there is time for it, but never so long after an answer [s]."""

LEGEND = (
    (palette.TARGET, "asked for: drag it"),
    (palette.MET, "reached"),
    (palette.MISSED, "missed: the nearest that can be reached"),
    (palette.OBJECT, "object"),
    (palette.NEAREST, "nearest to touching"),
)


class GraspPage:
    """A robot, a grasp, a scene; all of it belongs to the thread of `work`.

    Attributes:
        robot: The robot.
        asked: What is asked now.
        answer: What is shown.
        solutions: All solutions of what is asked, as far as they are found.
        work: What everything is done by.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        robot: ArmHand,
        asked: Asked,
        q: Array,
        meshes: Mapping[str, Surface] | None = None,
        candidates: Mapping[str, Callable[[], tuple[Asked, Array]]] | None = None,
        solved: bool = True,
    ) -> None:
        """Draw everything and begin.

        Args:
            server: The page.
            robot: The robot.
            asked: What is asked first.
            q: (n,) where the robot is [rad or m].
            meshes: What its files show, by link.
            candidates: Other questions to choose from, by name: each gives it, and a start.
            solved: Whether the first question is solved at once; else q is judged.
        """
        self.server, self.robot, self.asked = server, robot, asked
        self._first = asked, q
        self._answerer = Answerer(robot)
        answer = self._answerer.solve if solved else self._answerer.judged
        answer(asked, q)  # what the first one takes is the loading of kernels
        self.answer = answer(asked, q)
        self._answered_for: Asked | None = asked
        self._listed_for: Asked | None = None
        self.solutions: tuple[Alternative, ...] = ()
        self._dragged, self._forward = "", not solved
        self._untold_since: float | None = None
        set_stage(server, asked.name or robot.name, lowest(asked.scene))
        look_at_robot(server, robot, self.answer.q)
        self._drawn = DrawnRobot(server, robot, robot_parts(robot, meshes))
        self._contacts = DrawnContacts(
            server,
            asked,
            Drags(self.drag_control, self.drag_point, self.drag_normal, self.select),
        )
        self._things = DrawnThings(server, asked, self.drag_thing, self.select)
        self._closest = DrawnClosest(server)
        self.candidates = dict(candidates or {})
        names = (*asked.held, *self._things.names)
        self._panel = Panel(self, names, LEGEND)
        later = (PAUSE, self._show_motors), (REST, self._explain), (LOOKS, self._list_solutions)
        self.work = Newest(self._refresh, later)
        self.select(robot.fingers[0])

    # What a browser asks for: put down, and done when it is its turn.

    def drag_control(self, finger: str, pose: Array) -> None:
        """A contact dragged by its control to a (4, 4) pose."""
        self.change(finger, lambda asked: asked.with_control(finger, pose), finger)

    def drag_point(self, finger: str, point: Array) -> None:
        """A contact dragged by its ball to a point (3,)."""
        self.change(finger, lambda asked: asked.with_point(finger, point))

    def drag_normal(self, finger: str, normal: Array) -> None:
        """A contact turned by its arrow to face a way (3,)."""
        self.change(finger, lambda asked: asked.with_normal(finger, normal))

    def drag_thing(self, name: str, pose: Array) -> None:
        """The object or something in the scene dragged to a (4, 4) pose."""
        if name == OBJECT:
            self.change(name, lambda asked: asked.with_object(pose), name)
        else:
            self.change(name, lambda asked: asked.with_item(name, pose), name)

    def drag_motors(self, q: Array) -> None:
        """The motors set by hand to q (n,): nothing is solved."""

        def work() -> None:
            self._forward = True
            self.answer = self._answerer.judged(self.asked, q)

        self.work.put("motors", work)

    def change(self, key: str, change: Callable[[Asked], Asked], dragged: str = "") -> None:
        """Another question; of several changes of a key the newest counts.

        Args:
            key: What is changed.
            change: The question as it was to the question as it is.
            dragged: What the browser has moved already.
        """

        def work() -> None:
            self.asked = change(self.asked)
            self._dragged, self._forward = dragged, False

        self.work.put(key, work)

    def choose(self, name: str) -> None:
        """Another of the candidates."""

        def work() -> None:
            self.asked, q = self.candidates[name]()
            self.answer = self._answerer.judged(self.asked, q)
            self._forward = False

        self.work.put("candidate", work)

    def reset(self) -> None:
        """Back to what was asked first."""

        def work() -> None:
            self.asked, q = self._first
            self.answer = self._answerer.judged(self.asked, q)
            self._forward, self._answered_for = False, None

        self.work.put("reset", work)

    def show_solution(self, number: int) -> None:
        """One of the solutions, from 0."""

        def work() -> None:
            if number < len(self.solutions):
                chosen = self.solutions[number]
                self._forward = True
                self.answer = self._answerer.judged(self.asked, chosen.q)
                self._panel.tell_solution(number, chosen)

        self.work.put("solution", work)

    def select(self, name: str) -> None:
        """Give something its handles; "" takes them all away."""

        def work() -> None:
            self._contacts.select(name)
            self._things.select(name)
            self._panel.selected(name)

        self.work.put("selected", work)

    # What the thread does.

    def _refresh(self) -> None:
        if not self._forward and self.asked is not self._answered_for:
            try:
                self.answer = self._answerer.solve(self.asked, self.answer.q)
            except CasadiIKError as error:
                self.answer = failed(error, self.answer.q)
            self._answered_for = self.asked
            self.solutions = ()
        self.draw(self.answer)
        self._untold_since = self._untold_since or time.monotonic()
        if time.monotonic() - self._untold_since > LATEST:
            self._show_motors()

    def draw(self, answer: Answered) -> None:
        """Show an answer."""
        frames = dict(zip(self.robot.fingers, self.robot.contact_frames(answer.q), strict=True))
        with self.server.atomic():
            self._drawn.place(answer.q)
            self._contacts.place(self.asked, self._dragged)
            self._contacts.reach(self.asked, frames, answer.contacts)
            self._things.place(self.asked, self._dragged)
            closest = None if answer.closest is None else answer.closest[1]
            met = all(one.ok for one in answer.contacts.values())
            self._closest.place(closest, answer.clearance, told=met)
            self._panel.tell(answer)
        self.server.flush()
        self._dragged = ""

    def _explain(self) -> None:
        """What takes longer to find out than a drag may take."""
        if self.answer.unexplained and self.asked is self._answered_for:
            self.answer = self._answerer.explain(self.asked, self.answer.q)
            self.draw(self.answer)
            self._show_motors()

    def _list_solutions(self) -> None:
        """All solutions, once nothing moves."""
        if self._forward or self.asked is self._listed_for:
            return
        try:
            found = self._answerer.every(self.asked, self.answer.q) if self.answer.success else ()
        except CasadiIKError:
            found = ()
        self.solutions, self._listed_for = found, self.asked
        self._panel.tell_solutions(found)

    def _show_motors(self) -> None:
        with self.server.atomic():
            self._panel.tell_motors(self.answer.q, self.robot.joints(self.answer.q))
        self._untold_since = None

    def stop(self) -> None:
        """End its thread."""
        self.work.stop()
