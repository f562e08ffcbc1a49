"""The page on which contacts are dragged: the picture, the panel beside it, and what is solved."""

from __future__ import annotations

import io
import json
import logging
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import imageio.v3 as imageio
import numpy as np
import viser

from casadi_ik import palette
from casadi_ik.answers.solution import Alternative
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import CasadiIKError
from casadi_ik.grasps import Grasp, Tolerance
from casadi_ik.grasps.load import grasp_data
from casadi_ik.problem.request import CLEARANCE, PREFERENCES
from casadi_ik.problem.targets import LIMITS
from casadi_ik.registry import METHODS
from casadi_ik.viewing.drawn import (
    OBJECT,
    Drags,
    DrawnClosest,
    DrawnContacts,
    DrawnRobot,
    DrawnThings,
    look_at_robot,
    lowest,
    set_stage,
    usable,
)
from casadi_ik.viewing.newest import LOOKS, PAUSE, REST, Newest
from casadi_ik.viewing.request import Answer, Answerer, PageRequest, Settings, failed
from casadi_ik.viewing.words import bars, block, legend, table, verdict_block

logger = logging.getLogger(__name__)

LEGEND = (
    (palette.TARGET, "asked for: drag it"),
    (palette.MET, "reached"),
    (palette.MISSED, "missed: the nearest that can be reached"),
    (palette.OBJECT, "object"),
    (palette.NEAREST, "nearest to touching"),
)

PICTURE = (1000, 1600)
"""Height and width of a saved picture [pixels]."""

NOTHING = "nothing"

USES = ("point and normal", "point", "free")
"""What may be asked of a finger."""

PREFER = {
    "q0": "nearest to what is shown",
    "limits": "far from limits",
    "manipulability": "manipulability",
    "clearance": "clearance",
}
"""Which of several solutions, in words."""


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
        asked: PageRequest,
        q: Array,
        candidates: Mapping[str, Callable[[], tuple[PageRequest, Array]]] | None = None,
        solved: bool = True,
    ) -> None:
        """Draw everything and begin.

        Args:
            server: The page.
            robot: The robot.
            asked: What is asked first.
            q: (n,) where the robot is [rad or m].
            candidates: Other requests to choose from, by name: each gives it, and a start.
            solved: Whether the first request is solved at once; else q is judged.
        """
        self.server, self.robot, self.asked = server, robot, asked
        self._first = asked, q
        self._answerer = Answerer(robot)
        answer = self._answerer.solve if solved else self._answerer.judged
        answer(asked, q)  # what the first one takes is the loading of kernels
        self.answer = answer(asked, q)
        self._answered_for: PageRequest | None = asked
        self._listed_for: PageRequest | None = None
        self.solutions: tuple[Alternative, ...] = ()
        self._dragged, self._by_hand = "", not solved
        self._untold_since: float | None = None
        set_stage(server, asked.name or robot.name, lowest(asked.scene))
        look_at_robot(server, robot, self.answer.q)
        self._drawn = DrawnRobot(server, robot)
        drags = Drags(self.drag_control, self.drag_point, self.drag_normal, self.select)
        self._contacts = DrawnContacts(server, asked, drags)
        self._things = DrawnThings(server, asked, replace(drags, pose=self.drag_thing))
        self._closest = DrawnClosest(server)
        self.candidates = dict(candidates or {})
        self._panel = Panel(self, (*asked.held, *self._things.names))
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
            self._by_hand = True
            self.answer = self._answerer.judged(self.asked, q)

        self.work.put("motors", work)

    def change(
        self, key: str, change: Callable[[PageRequest], PageRequest], dragged: str = ""
    ) -> None:
        """Another request; of several changes of a key the newest counts.

        Args:
            key: What is changed.
            change: The request as it was to the request as it is.
            dragged: What the browser has moved already.
        """

        def work() -> None:
            self.asked = change(self.asked)
            self._dragged, self._by_hand = dragged, False

        self.work.put(key, work)

    def choose(self, name: str) -> None:
        """Another of the candidates."""
        self._begin("candidate", lambda: self.candidates[name]())

    def reset(self) -> None:
        """Back to what was asked first."""
        self._begin("reset", lambda: self._first)

    def _begin(self, key: str, request: Callable[[], tuple[PageRequest, Array]]) -> None:
        def work() -> None:
            self.asked, q = request()
            self.answer = self._answerer.judged(self.asked, q)
            self._by_hand, self._answered_for = False, None

        self.work.put(key, work)

    def show_solution(self, number: int) -> None:
        """One of the solutions, from 0."""

        def work() -> None:
            if number < len(self.solutions):
                chosen = self.solutions[number]
                self._by_hand = True
                found = self._answerer.judged(self.asked, chosen.q)
                word = "SOLVED" if found.success else found.headline
                self.answer = replace(found, headline=word)
                self._panel.tell_solution(number, chosen)

        self.work.put("solution", work)

    def select(self, name: str) -> None:
        """Give something its handles; "" takes them all away."""

        def work() -> None:
            self._contacts.select(name)
            self._things.select(name)
            self._panel.selected(name)

        self.work.put("selected", work)

    def stop(self) -> None:
        """End its thread."""
        self.work.stop()

    # What the thread does.

    def _refresh(self) -> None:
        if not self._by_hand and self.asked is not self._answered_for:
            try:
                self.answer = self._answerer.solve(self.asked, self.answer.q)
            except CasadiIKError as error:
                self.answer = failed(error, self.answer.q)
            self._answered_for = self.asked
            self.solutions = ()
        self.draw(self.answer)
        # Motors are shown when there is time for it, but never half a second after an answer.
        self._untold_since = self._untold_since or time.monotonic()
        if time.monotonic() - self._untold_since > 0.5:
            self._show_motors()

    def draw(self, answer: Answer) -> None:
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
        if self._by_hand or self.asked is self._listed_for:
            return
        try:
            found = self._answerer.every(self.asked, self.answer.q) if self.answer.success else ()
        except CasadiIKError:
            found = ()
        self.solutions, self._listed_for = found, self.asked
        self._panel.tell_solutions(found)

    def _show_motors(self) -> None:
        with self.server.atomic():
            self._panel.tell_motors(self.answer.q)
        self._untold_since = None


class Panel:
    """Everything beside the picture: verdict, settings, solutions, motors, files."""

    def __init__(self, page: GraspPage, names: Sequence[str]) -> None:
        """Build it.

        Args:
            page: Whose it is; told of everything that a person sets.
            names: What can be dragged.
        """
        self._page, self._gui = page, page.server.gui
        gui = self._gui
        self._verdict = gui.add_html(verdict_block(page.answer))
        self._drag = gui.add_dropdown(
            "Drag",
            (*names, NOTHING),
            hint="whose arrows and rings are shown; or click it, or drag ball and arrow themselves",
        )
        on_set(self._drag, lambda name: page.select("" if name == NOTHING else name))
        if page.candidates:
            on_set(gui.add_dropdown("Candidate", tuple(page.candidates)), page.choose)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Solve"):
            self._add_settings(page.asked.settings, page.asked.scene is not None)
            with gui.add_folder("Fingers", expand_by_default=False):
                self._add_fingers(page.asked)
        with tabs.add_tab("Solutions"):
            self._slider = gui.add_slider("Solution", 1, 2, 1, 1, disabled=True)
            on_set(self._slider, lambda number: page.show_solution(int(number) - 1))
            self._solution = gui.add_html(block("found when nothing moves"))
        with tabs.add_tab("Motors"):
            self._add_motors()
        with tabs.add_tab("Files"):
            self._add_files()
        gui.add_html(legend(LEGEND))

    # What is shown.

    def tell(self, answer: Answer) -> None:
        """Show a verdict."""
        self._verdict.content = verdict_block(answer)

    def selected(self, name: str) -> None:
        """Show what has handles."""
        if self._drag.value != (name or NOTHING):
            self._drag.value = name or NOTHING

    def tell_solutions(self, found: Sequence[Alternative]) -> None:
        """Show how many solutions there are."""
        self._slider.max = max(len(found), 2)
        self._slider.disabled = len(found) < 2
        self._slider.value = 1
        if found:
            self.tell_solution(0, found[0])
        else:
            self._solution.content = block("no solutions to go through")

    def tell_solution(self, number: int, one: Alternative) -> None:
        """Show what one of the solutions is like."""
        count, branch = len(self._page.solutions), one.branch
        rows = {"solution": f"{number + 1} of {count}", "hand posture": f"{one.posture + 1}"}
        if branch is not None:
            signs = {"shoulder": branch.shoulder, "elbow": branch.elbow, "wrist": branch.wrist}
            rows["arm branch"] = ", ".join(f"{n} {'+' if s > 0 else '−'}" for n, s in signs.items())
        if branch is not None and branch.swivel is not None and one.swivel is not None:
            start, end, here = np.rad2deg([*branch.swivel, one.swivel])
            rows["swivel"] = f"{(here + 180) % 360 - 180:.0f}°, free over {end - start:.0f}°"
        rows["limit margin"] = f"{100 * one.margin:.0f} %"
        if one.manipulability:
            rows["manipulability"] = f"{one.manipulability:.4f}"
        self._solution.content = block(table(rows.items()))

    def tell_motors(self, q: Array) -> None:
        """Show where motors and joints are."""
        low, high = self._ranges
        values = np.clip(q * self._scales, low, high)
        for slider, value, wide in zip(self._motors, values.tolist(), high - low, strict=True):
            if abs(slider.value - value) > 1e-6 * wide:
                slider.value = value
        robot = self._page.robot
        self._bars.content = bars(robot.description, robot.joints(q))

    # What is set.

    def _add_settings(self, settings: Settings, scene: bool) -> None:
        gui, page = self._gui, self._page
        words = {PREFER[one]: one for one in PREFERENCES if scene or one != CLEARANCE}
        method = gui.add_dropdown("Method", METHODS, initial_value=settings.method)
        prefer = gui.add_dropdown(
            "Prefer",
            tuple(words),
            initial_value=PREFER[settings.prefer],
            hint="which of several solutions; methods that cannot choose take no notice",
        )
        limits = gui.add_dropdown("Limits", LIMITS, initial_value=settings.limits)
        far, turned = 1e3 * settings.tolerance.position, np.rad2deg(settings.tolerance.angle)
        position = gui.add_number("Tolerance [mm]", far, min=0.001, max=100.0, step=0.1)
        angle = gui.add_number(
            "Tolerance [°]", round(float(turned), 6), min=0.001, max=180.0, step=0.1
        )

        def changed(_: Any) -> None:
            tolerance = Tolerance(1e-3 * float(position.value), float(np.deg2rad(angle.value)))
            wanted = words[str(prefer.value)]
            new = Settings(str(method.value), tolerance, str(limits.value), wanted)
            page.change("settings", lambda asked: replace(asked, settings=new))

        for one in (method, prefer, limits, position, angle):
            on_set(one, changed)
        on_press(gui.add_button("Reset", icon=None), lambda _: page.reset())

    def _add_fingers(self, asked: PageRequest) -> None:
        for finger, held in asked.held.items():
            now = USES[2] if not held.used else USES[0] if held.normal else USES[1]

            def changed(use: str, finger: str = finger) -> None:
                used, normal = use != USES[2], use == USES[0]
                self._page.change(f"use {finger}", lambda a: a.with_use(finger, used, normal))

            on_set(self._gui.add_dropdown(finger, USES, initial_value=now), changed)

    def _add_motors(self) -> None:
        gui, page, robot = self._gui, self._page, self._page.robot
        motors = robot.description.actuators
        self._scales = np.array([np.rad2deg(1.0) if m.unit == "rad" else 1e3 for m in motors])
        low, high = self._ranges = robot.lower * self._scales, robot.upper * self._scales
        values = np.clip(page.answer.q * self._scales, low, high)
        gui.add_html(block("Moved by hand, nothing is solved; drag a contact to solve again."))
        self._motors: list[Any] = []

        def moved(_: Any) -> None:
            q = usable([one.value for one in self._motors], len(self._motors)) / self._scales
            page.drag_motors(np.clip(q, robot.lower, robot.upper))

        with gui.add_folder("Motors", expand_by_default=True):
            for i, motor in enumerate(motors):
                name = f"{motor.name} [{'°' if motor.unit == 'rad' else 'mm'}]"
                first, last = float(low[i]), float(high[i])
                step = (last - first) / 1000 or 1e-6
                slider = gui.add_slider(name, first, last, step, float(values[i]))
                self._motors.append(slider)
                on_set(slider, moved)
        with gui.add_folder("Joints and their limits", expand_by_default=True):
            self._bars = gui.add_html("")
        self.tell_motors(page.answer.q)

    def _add_files(self) -> None:
        page, gui = self._page, self._gui
        grasp = gui.add_button("Save grasp (YAML)", icon=None)
        on_press(grasp, lambda client: save_grasp(client, page.asked.grasp, page.answer.success))
        picture = gui.add_button("Export picture (PNG)", icon=None)

        # The browser draws the picture and sends it: this waits for it, in a thread of its own.
        @picture.on_click
        def _(event: Any) -> None:
            save_picture(event.client, _file_name(page.asked.name or page.robot.name, "view"))


def on_set(handle: Any, do: Callable[[Any], None]) -> None:
    """Tell of a control's value when a person, not the program, has changed it."""

    @handle.on_update
    async def _(event: Any) -> None:
        if event.client is not None:
            do(handle.value)


def on_press(button: Any, do: Callable[[Any], None]) -> None:
    """Tell of a button that is pressed in a browser."""

    @button.on_click
    async def _(event: Any) -> None:
        do(event.client)


# Files that the page hands to the browser it is seen in.


def save_grasp(client: Any, grasp: Grasp, solved: bool) -> None:
    """Send a grasp file."""
    comment = "From a page on which contacts are dragged; " + ("solved." if solved else "unsolved.")
    name = _file_name(grasp.name, "grasp")
    text = grasp_text(grasp, comment).encode()
    client.send_file_download(f"{name}.yaml", text, save_immediately=True)


def save_picture(client: Any, name: str, patience: float = 20.0) -> None:
    """Send what a browser sees, drawn by it anew in print size, if it does draw in time [s]."""
    try:
        image = client.get_render(*PICTURE, transport_format="png", timeout=patience)
    except Exception as error:  # whatever it sends instead is read by imageio
        logger.debug("no picture: %s", error)
        return
    client.send_file_download(f"{name}.png", png(np.asarray(image)), save_immediately=True)


def png(image: np.ndarray) -> bytes:
    """An image (h, w, 3) or (h, w, 4) of bytes as a PNG file."""
    written = io.BytesIO()
    imageio.imwrite(written, image, extension=".png")
    return written.getvalue()


def _file_name(name: str, otherwise: str) -> str:
    return re.sub(r"\W+", "_", name) or otherwise


def grasp_text(grasp: Grasp, comment: str = "") -> str:
    """A grasp as YAML that `load_grasp` reads back to the last digit.

    Args:
        grasp: The grasp.
        comment: A line before it.
    """
    lines = [f"# {comment}"] if comment else []
    for key, value in grasp_data(grasp).items():
        if key == "contacts":
            lines.append("contacts:  # points [m] and outward normals of the pads, base frame")
            for finger, contact in value.items():
                lines += [f"  {_flow(finger)}:", *_lines(contact, "    ")]
        elif isinstance(value, dict):
            lines += [f"{key}:", *_lines(value, "  ")]
        else:
            lines.append(f"{key}: {_flow(value)}")
    return "\n".join(lines) + "\n"


def _lines(data: dict[str, Any], indent: str) -> list[str]:
    keys = {key: key if key.isidentifier() else _flow(key) for key in data}
    return [f"{indent}{keys[key]}: {_flow(value)}" for key, value in data.items()]


def _flow(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)
