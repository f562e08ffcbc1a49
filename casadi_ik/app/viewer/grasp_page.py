"""The page on which an object or its contacts are dragged, and arm and hand follow."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from casadi_ik.api import METHODS
from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import lowest, meshes_of, object_of
from casadi_ik.app.viewer.access import Server
from casadi_ik.app.viewer.candidates import CandidateList, Candidates
from casadi_ik.app.viewer.page import LOOKS, PAUSE, REST, DraggedPage, in_turn
from casadi_ik.app.viewer.panel import (
    Q_FORMATS,
    bars,
    block,
    copied_from,
    file_name,
    grasp_text,
    legend,
    on_press,
    on_set,
    parts_of,
    q_text,
    results_block,
    save_picture,
    save_text,
    table,
    verdict_block,
)
from casadi_ik.app.viewer.request import (
    OBJECT,
    Answer,
    Answerer,
    PageRequest,
    Settings,
    failed,
    request_of,
)
from casadi_ik.app.viewer.viser_scene import (
    Camera,
    DrawnClosest,
    DrawnRobot,
    Ghosts,
    Handles,
    Tips,
    cameras,
    light_lamp,
    usable,
)
from casadi_ik.collision.scene import Scene, load_scene
from casadi_ik.errors import CasadiIKError
from casadi_ik.files.arrays import Array
from casadi_ik.files.shipped import shipped_names
from casadi_ik.kinematics.arm_hand import ArmHand, load_robot
from casadi_ik.model.grasp import Tolerance
from casadi_ik.model.load_grasp import load_grasp, shipped_grasps
from casadi_ik.model.targets import LIMIT_MODES
from casadi_ik.solve.request import CLEARANCE, PREFERENCES
from casadi_ik.solve.solution import Alternative

LEGEND = (
    (palette.TARGET, "asked for"),
    (palette.MET, "reached"),
    (palette.MISSED, "missed"),
    (palette.OBJECT, "object"),
    (palette.NEAREST, "smallest clearance"),
)

NOTHING = "nothing"

USES = ("point and normal", "point", "free")
"""What may be asked of a finger."""

PREFER = {
    "q0": "nearest to what is shown",
    "limits": "far from limits",
    "manipulability": "high manipulability",
    "clearance": "large clearance",
}
"""Which of several solutions, in words."""

SKINS = ("bodies", "collision shapes")

MOST_GHOSTS = 10


class GraspPage(DraggedPage):
    """A robot, a grasp, a scene.

    Attributes:
        answer: What is shown.
        solutions: All solutions of what is asked, as far as they are found.
        candidates: Other requests to choose from.
        offered: What is seen of them; None: there are none.
    """

    def __init__(
        self,
        server: Server,
        robot: ArmHand,
        asked: PageRequest,
        q: Array,
        candidates: Candidates | None = None,
        solved: bool = True,
        dark: bool = False,
    ) -> None:
        """Solve, draw everything and begin.

        Args:
            server: What serves it.
            robot: The robot.
            asked: What is asked first.
            q: (n,) where the robot is [rad or m].
            candidates: Other requests to choose from.
            solved: Whether the first request is solved at once; else q is judged.
            dark: Whether the page is dark.
        """
        self._answerer = Answerer(robot)
        answer = self._answerer.solve if solved else self._answerer.judged
        answer(asked, q)  # what the first one takes is the loading of kernels
        self.answer = answer(asked, q)
        floor = lowest(robot, asked.scene)
        super().__init__(server, robot, asked, asked.name or robot.name, floor, dark)
        self._first_q, self.candidates = q, dict(candidates or {})
        self._answered_for: PageRequest | None = asked
        self._listed_for: PageRequest | None = None
        self.solutions: tuple[Alternative, ...] = ()
        self._by_hand, self._ghostly, self.beside = not solved, False, NOTHING
        self._untold_since: float | None = None
        self._whole = self.cameras()["Robot"]
        next(iter(self.cameras().values())).show(server)
        light_lamp(server, self._whole)
        self._drawn = DrawnRobot(server, robot)
        self._handles, self._tips = Handles(server, asked, self), Tips(server, asked)
        self._closest = DrawnClosest(server)
        self._ghosts = Ghosts(server, robot)
        self._other: tuple[DrawnRobot, Handles, Tips] | None = None
        self._panel = Panel(self, self._handles.names)
        self.offered = self._panel.candidates
        self.begin((PAUSE, self._show_motors), (REST, self._explain), (LOOKS, self._list_solutions))
        first = OBJECT if OBJECT in self._handles.names else robot.fingers[0]
        self.select("" if self.candidates else first)  # handles would hide what is chosen from

    def cameras(self) -> dict[str, Camera]:
        """By name from where robot and object are seen as they stand now."""
        thing, pose = object_of(self.asked.object), self.asked.object_pose
        things = [] if thing is None or pose is None else [thing.at(pose)]
        return cameras(self.robot, self.answer.q, things)

    @in_turn
    def drag_motors(self, q: Array) -> None:
        """The motors set by hand to q (n,): nothing is solved."""
        self._by_hand = True
        self.answer = self._answerer.judged(self.asked, q)

    @in_turn
    def choose(self, name: str) -> None:
        """Another of the candidates."""
        self.remember()
        one, now = self.candidates[name], self.asked
        q = self.robot.home if one.q is None else one.q
        self.restore((request_of(self.robot, one.grasp, q, now.scene, now.settings), q))

    @in_turn
    def open(
        self, robot: str | None = None, grasp: str | None = None, scene: str | None = None
    ) -> None:
        """Another robot, grasp or scene by its name; "" is none.

        A robot comes with the first of its grasps, or as it stands at home.
        """
        try:
            page = self._opened(robot, grasp, scene)
        except CasadiIKError as error:
            for client in self.server.get_clients().values():
                client.add_notification("Cannot be opened", str(error), color="red")
            return
        self.opened(page)

    def _opened(self, robot: str | None, grasp: str | None, scene: str | None) -> GraspPage:
        body = self.robot if robot is None else load_robot(robot)
        asked, q = self.asked, self.answer.q
        if robot is not None:
            grasp = next(iter(shipped_grasps(robot)), "")
        around = asked.scene if scene is None else load_scene(scene) if scene else None
        if grasp is not None:
            given, q = (load_grasp(grasp) if grasp else None), body.home
            asked = request_of(body, given, None, around, asked.settings)
        else:
            asked = replace(asked, scene=around)
        self.ended = True
        self.server.scene.reset()
        self.server.gui.reset()
        page = GraspPage(self.server, body, asked, q, None, solved=True, dark=self.dark)
        self.work.stop()
        return page

    @in_turn
    def show_solution(self, number: int) -> None:
        """One of the solutions, from 0."""
        if number < len(self.solutions):
            chosen = self.solutions[number]
            self._by_hand = True
            found = self._answerer.judged(self.asked, chosen.q)
            word = "SOLVED" if found.success else found.headline
            self.answer = replace(found, headline=word)
            self._panel.tell_solution(number, chosen)

    @in_turn
    def show_ghosts(self, on: bool) -> None:
        """Show all solutions at once, or one."""
        self._ghostly = on
        self._draw_ghosts()

    @in_turn
    def compare(self, method: str) -> None:
        """Show beside it what another method answers to the same request; "nothing": none."""
        self.beside = method

    @in_turn
    def show_skin(self, name: str) -> None:
        """Draw the robot by its bodies, or by what collisions are checked with."""
        self._drawn.skin(name)

    # What the thread does.

    def changed_by_hand(self) -> None:
        """What is asked changes, so it is solved."""
        self._by_hand = False

    def selected(self, name: str) -> None:
        """Show what has handles."""
        self._handles.select(name)
        self._panel.selected(name)

    def state(self) -> tuple[PageRequest, Array]:
        """What is asked, and where the robot is."""
        return self.asked, self.answer.q

    def restore(self, state: tuple[PageRequest, Array]) -> None:
        """Go back to a state."""
        self.asked, q = state
        self.answer = self._answerer.judged(self.asked, q)
        self._by_hand, self._answered_for = False, None

    def refresh(self) -> None:
        """Solve if it is asked for, and draw."""
        if not self._by_hand and self.asked is not self._answered_for:
            try:
                self.answer = self._answerer.solve(self.asked, self.answer.q)
            except CasadiIKError as error:
                self.answer = failed(error, self.answer.q)
            self._answered_for = self.asked
            self.solutions = ()
            self._ghosts.show(())
        self.draw(self.answer)
        # Motors are shown when there is time for it, but never half a second after an answer.
        self._untold_since = self._untold_since or time.monotonic()
        if time.monotonic() - self._untold_since > 0.5:
            self._show_motors()

    def draw(self, answer: Answer) -> None:
        """Show an answer."""
        frames = self._frames(answer.q)
        with self.server.atomic():
            self._drawn.place(answer.q)
            self._handles.place(self.asked, self._dragged)
            self._tips.place(self.asked, frames, answer.contacts)
            if self.offered is not None:
                self.offered.place(self.asked.object_pose)
            closest = None if answer.closest is None else answer.closest[1]
            met = all(one.ok for one in answer.contacts.values())
            self._closest.place(closest, answer.clearance, told=met)
            self._panel.tell(answer)
        self.server.flush()
        self._dragged = ""

    def _frames(self, q: Array) -> dict[str, Array]:
        return dict(zip(self.robot.fingers, self.robot.contact_frames(q), strict=True))

    def _explain(self) -> None:
        """What takes longer to find out than a drag may take."""
        if self.answer.unexplained and self.asked is self._answered_for:
            self.answer = self._answerer.explain(self.asked, self.answer.q)
            self.draw(self.answer)
            self._show_motors()
        self._show_beside()

    def _show_beside(self) -> None:
        """What another method answers, to the right of the robot."""
        if self.beside == NOTHING:
            if self._other is not None:
                self.server.scene.remove_by_name("/beside")
                self._other = None
                self._panel.tell_beside(None)
            return
        settings = replace(self.asked.settings, method=self.beside)
        asked = replace(self.asked, settings=settings)
        try:
            answer = self._answerer.solve(asked, self._first_q)
        except CasadiIKError as error:
            answer = failed(error, self.answer.q)
        if self._other is None:
            camera, name = self._whole, "/beside"
            frame = self.server.scene.add_frame(name, show_axes=False)
            right = np.array([-camera.view[1], camera.view[0], 0.0])
            frame.position = 1.6 * camera.radius * right / np.linalg.norm(right)
            self._other = (
                DrawnRobot(self.server, self.robot, f"{name}/robot"),
                Handles(self.server, replace(asked, scene=None), None, name),
                Tips(self.server, asked, name),
            )
        drawn, handles, tips = self._other
        drawn.place(answer.q)
        handles.place(asked)
        tips.place(asked, self._frames(answer.q), answer.contacts)
        self._panel.tell_beside(answer)

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
        self._draw_ghosts()

    def _draw_ghosts(self) -> None:
        """Green far from limits, yellow, red at one."""
        seen = self.solutions[:MOST_GHOSTS] if self._ghostly else ()
        ghosts = [(one.q, palette.shade(one.margin, (0.0, 0.15, 0.4))) for one in seen]
        self._ghosts.show(ghosts)

    def _show_motors(self) -> None:
        with self.server.atomic():
            self._panel.tell_motors(self.answer.q)
        self._untold_since = None


@lru_cache(maxsize=1)
def robots_offered() -> tuple[str, ...]:
    """Shipped arm-hands and bodies, and those that shipped grasps are for."""
    of_grasps = {load_grasp(name).robot for name in shipped_names("grasps")}
    return tuple(sorted(of_grasps.union(shipped_names("arm_hands"), shipped_names("bodies"))))


class Panel:
    """Everything beside the picture: verdict, what is dragged, results, settings, files."""

    def __init__(self, page: GraspPage, names: Sequence[str]) -> None:
        """Build it.

        Args:
            page: Whose it is; told of everything that a person sets.
            names: What can be dragged.
        """
        self._page, self._gui = page, page.server.gui
        self.candidates: CandidateList | None = None
        gui = self._gui
        self._verdict = gui.add_html(verdict_block(page.answer))
        self._drag = gui.add_dropdown(
            "Drag", (*names, NOTHING), hint="or click it, or drag ball and arrow themselves"
        )
        on_set(self._drag, lambda name: page.select("" if name == NOTHING else name))
        page.add_steps()
        camera = gui.add_button_group("Camera", tuple(page.cameras()))
        on_press(camera, lambda client: page.cameras()[str(camera.value)].on(client))
        tabs = gui.add_tab_group()
        if page.candidates:
            with tabs.add_tab("Candidates"):
                self.candidates = CandidateList(page, page.candidates)
        with tabs.add_tab("Results"):
            self._results = gui.add_html(results_block(page.answer))
            with gui.add_folder("Solutions", expand_by_default=False):
                self._slider = gui.add_slider("Solution", 1, 2, 1, 1, disabled=True)
                on_set(self._slider, lambda number: page.show_solution(int(number) - 1))
                ghosts = gui.add_checkbox(
                    "All at once", False, hint="green: far from limits; red: at one"
                )
                on_set(ghosts, page.show_ghosts)
                self._solution = gui.add_html(block("found when nothing moves"))
            gui.add_html(legend(LEGEND))
            self._beside = gui.add_html("")
        with tabs.add_tab("Solve"):
            self._add_settings(page.asked.settings, page.asked.scene is not None)
        with tabs.add_tab("Motors"):
            self._add_motors()
        with tabs.add_tab("Files"):
            self._add_files()

    # What is shown.

    def tell(self, answer: Answer) -> None:
        """Show a verdict."""
        self._verdict.content = verdict_block(answer)
        self._results.content = results_block(answer)

    def tell_beside(self, answer: Answer | None) -> None:
        """Show what another method answers."""
        found = "" if answer is None else verdict_block(answer) + results_block(answer)
        self._beside.content = found

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
        # More digits would not fit in the box.
        self._exact = q * self._scales
        self._shown = np.clip(np.round(self._exact, 1), *self._ranges)
        for slider, value in zip(self._motors, self._shown.tolist(), strict=True):
            if slider.value != value:
                slider.value = value
        robot = self._page.robot
        self._bars.content = bars(robot.description, robot.joints(q))
        units = [motor.unit for motor in robot.description.actuators]
        self._q.content = copied_from(q_text(robot.actuators, q, units, str(self._form.value)))

    # What is set.

    def _add_settings(self, settings: Settings, scene: bool) -> None:
        gui, page = self._gui, self._page
        words = {PREFER[one]: one for one in PREFERENCES if scene or one != CLEARANCE}
        method = gui.add_dropdown("Method", METHODS, initial_value=settings.method)
        prefer = gui.add_dropdown(
            "Choose the",
            tuple(words),
            initial_value=PREFER[settings.prefer],
            hint="which of several solutions; methods that cannot choose take no notice",
        )
        limits = gui.add_dropdown("Limits", LIMIT_MODES, initial_value=settings.limits)
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
        beside = gui.add_dropdown(
            "Beside it", (NOTHING, *METHODS), hint="another method's answer to the same request"
        )
        on_set(beside, lambda name: page.compare(str(name)))
        with gui.add_folder("Fingers", expand_by_default=False):
            for finger, held in page.asked.held.items():
                self._add_finger(finger, USES[2] if not held.used else USES[not held.normal])

    def _add_finger(self, finger: str, now: str) -> None:
        def changed(use: str) -> None:
            used, normal = use != USES[2], use == USES[0]
            self._page.change(f"use {finger}", lambda a: a.with_use(finger, used, normal))

        on_set(self._gui.add_dropdown(finger, USES, initial_value=now), changed)

    def _add_motors(self) -> None:
        gui, page, robot = self._gui, self._page, self._page.robot
        motors = robot.description.actuators
        self._scales = np.array([np.rad2deg(1.0) if m.unit == "rad" else 1e3 for m in motors])
        # Sliders have their ends written beside them.
        low = np.ceil(10 * robot.lower * self._scales) / 10
        high = np.maximum(np.floor(10 * robot.upper * self._scales) / 10, low + 0.1)
        self._ranges = low, high
        values = np.clip(page.answer.q * self._scales, low, high)
        self._form = gui.add_dropdown("q as", Q_FORMATS)
        self._q = gui.add_html("")
        on_set(self._form, lambda _: page.work.put("form", lambda: None))
        gui.add_html(block("Moved by hand, nothing is solved; drag a contact to solve again."))
        sliders: dict[int, Any] = {}

        def moved(_: Any) -> None:
            values = usable([one.value for one in self._motors], len(self._motors))
            q = np.where(values == self._shown, self._exact, values) / self._scales
            page.drag_motors(np.clip(q, robot.lower, robot.upper))

        few = len(motors) < 24
        for part, places in parts_of(robot.description).items():
            with gui.add_folder(part.capitalize(), expand_by_default=few):
                for i in places:
                    name = motors[i].name.removeprefix(f"{part.partition(' ')[0]}_")
                    name += " [°]" if motors[i].unit == "rad" else " [mm]"
                    ends = float(low[i]), float(high[i])
                    sliders[i] = gui.add_slider(name, *ends, 0.1, float(values[i]))
                    on_set(sliders[i], moved)
        self._motors = [sliders[i] for i in range(len(motors))]
        with gui.add_folder("Joints and their limits", expand_by_default=few):
            self._bars = gui.add_html("")
        self.tell_motors(page.answer.q)

    def _add_files(self) -> None:
        page, gui, robot = self._page, self._gui, self._page.robot
        names = tuple(dict.fromkeys((robot.name, *robots_offered())))
        on_set(gui.add_dropdown("Robot", names), lambda name: page.open(robot=str(name)))
        own = page.asked.name or "at home"
        grasps = tuple(dict.fromkeys((own, *shipped_grasps(robot.name), "at home")))
        on_set(
            gui.add_dropdown("Grasp", grasps),
            lambda name: page.open(grasp="" if name == "at home" else str(name)),
        )
        scene = page.asked.scene
        here = "none" if scene is None else scene.name
        scenes = tuple(dict.fromkeys((here, "none", *shipped_names("scenes"))))
        on_set(
            gui.add_dropdown("Scene", scenes),
            lambda name: page.open(scene="" if name == "none" else str(name)),
        )
        if meshes_of(robot.description):  # else its bodies are what collisions are checked with
            on_set(gui.add_dropdown("Robot as", SKINS), page.show_skin)
        page.add_dark()
        on_press(gui.add_button("Save grasp (YAML)", icon=None), self._save_grasp)
        if isinstance(scene, Scene):
            on_press(gui.add_button("Save scene (YAML)", icon=None), self._save_scene)
        picture = gui.add_button("Export picture (PNG)", icon=None)

        # The browser draws the picture and sends it: this waits for it, in a thread of its own.
        @picture.on_click
        def _(event: Any) -> None:
            save_picture(event.client, file_name(page.asked.name or page.robot.name, "view"))

    def _save_grasp(self, client: Any) -> None:
        page = self._page
        how = "solved." if page.answer.success else "unsolved."
        text = grasp_text(page.asked.grasp, f"From a page on which contacts are dragged; {how}")
        save_text(client, f"{file_name(page.asked.name, 'grasp')}.yaml", text)

    def _save_scene(self, client: Any) -> None:
        scene = self._page.asked.scene
        assert scene is not None
        save_text(client, f"{file_name(scene.name, 'scene')}.yaml", scene.text())
