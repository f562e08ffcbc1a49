"""Page on which the object or its contacts are dragged while arm and hand are solved."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from casadi_ik.api import METHODS
from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import ground_height, object_drawable
from casadi_ik.app.drawing.visual_meshes import visual_meshes
from casadi_ik.app.viewer.access import Server
from casadi_ik.app.viewer.camera import Camera, add_lamp, cameras
from casadi_ik.app.viewer.candidates import CandidateList, Candidates
from casadi_ik.app.viewer.comparison import ComparisonView
from casadi_ik.app.viewer.page import (
    IDLE_DELAY,
    LONG_IDLE_DELAY,
    SHORT_DELAY,
    InteractivePage,
    on_page_thread,
)
from casadi_ik.app.viewer.panel import (
    Q_FORMATS,
    bars,
    block,
    copyable_text,
    file_name,
    grasp_text,
    legend,
    motors_by_part,
    on_press,
    on_set,
    q_text,
    results_block,
    save_picture,
    save_text,
    table,
    verdict_block,
)
from casadi_ik.app.viewer.request import (
    OBJECT_ITEM,
    PageRequest,
    RequestSolver,
    Settings,
    SolveResult,
    invalid_result,
    request_of,
)
from casadi_ik.app.viewer.viser_scene import (
    ClearanceLine,
    FingertipMarks,
    GhostRobots,
    Handles,
    RobotView,
    finite_numbers,
    frames_by_finger,
)
from casadi_ik.collision.scene import Scene, load_scene
from casadi_ik.errors import CasadiIKError
from casadi_ik.files.arrays import Array
from casadi_ik.files.shipped import shipped_names
from casadi_ik.kinematics.arm_hand import ArmHand, load_robot
from casadi_ik.model.grasp import Tolerance
from casadi_ik.model.load_grasp import load_grasp, shipped_grasps
from casadi_ik.model.targets import CLEARANCE, LIMIT_MODES, PREFERENCES
from casadi_ik.solve.solution import Alternative

GRASP_LEGEND = (
    (palette.TARGET, "target"),
    (palette.MET, "reached"),
    (palette.MISSED, "missed"),
    (palette.OBJECT, "object"),
    (palette.NEAREST, "smallest clearance"),
)

NO_SELECTION = "none"

CONTACT_USES = ("point and normal", "point", "free")
"""Constraints of a finger's contact."""

PREFERENCE_LABELS = {
    "q0": "nearest to the current configuration",
    "limits": "large limit margin",
    "manipulability": "high manipulability",
    "clearance": "large clearance",
}
"""Labels of the preferences among solutions."""

GEOMETRIES = ("visual", "collision")

MAX_GHOSTS = 10


class GraspPage(InteractivePage):
    """A page with a robot, a grasp and a scene.

    Attributes:
        result: Displayed result.
        solutions: Solutions of the request; empty until they are listed.
        candidates: Candidate grasps by name.
        candidate_list: Marks and controls of the candidates; None without candidates.
        compared_method: Method whose solution is displayed next to the robot; "none": none.
    """

    def __init__(
        self,
        server: Server,
        robot: ArmHand,
        request: PageRequest,
        q: Array,
        candidates: Candidates | None = None,
        solve_first: bool = True,
        dark: bool | None = None,
    ) -> None:
        """Solve the request, draw everything and start the worker thread.

        Args:
            server: Server of the page.
            robot: The robot.
            request: Initial request.
            q: (n,) Initial configuration [rad or m].
            candidates: Candidate grasps by name.
            solve_first: True to solve the initial request; False to check and show q.
            dark: Use the dark theme; None: follow the browser.
        """
        self._request_solver = RequestSolver(robot)
        evaluate = self._request_solver.solve if solve_first else self._request_solver.check
        evaluate(request, q)  # loads the kernels, which the displayed time excludes
        self.result = evaluate(request, q)
        floor = ground_height(robot, request.scene)
        super().__init__(server, robot, request, request.name or robot.name, floor, dark)
        self._first_q, self.candidates = q, dict(candidates or {})
        self._solved_request: PageRequest | None = request
        self._listed_request: PageRequest | None = None
        self.solutions: tuple[Alternative, ...] = ()
        self._is_q_fixed, self._ghosts_visible, self.compared_method = (
            not solve_first,
            False,
            NO_SELECTION,
        )
        self._motors_outdated_since: float | None = None
        self._robot_camera = self.cameras()["Robot"]
        next(iter(self.cameras().values())).show(server)
        add_lamp(server, self._robot_camera)
        self._robot_view = RobotView(server, robot)
        self._handles, self._tips = Handles(server, request, self), FingertipMarks(server, request)
        self._closest = ClearanceLine(server)
        self._ghosts = GhostRobots(server, robot)
        self._comparison = ComparisonView(server, robot, self._robot_camera)
        self._panel = SettingsPanel(self, self._handles.names)
        self.candidate_list = self._panel.candidates
        self.start(
            (SHORT_DELAY, self._show_motors),
            (IDLE_DELAY, self._explain),
            (LONG_IDLE_DELAY, self._list_solutions),
        )
        initial_selection = OBJECT_ITEM if OBJECT_ITEM in self._handles.names else robot.fingers[0]
        # Handles would hide the candidates.
        self.select("" if self.candidates else initial_selection)

    def cameras(self) -> dict[str, Camera]:
        """Return viewpoints by name for the current poses of robot and object."""
        object_shape, pose = object_drawable(self.request.object), self.request.object_pose
        objects = [] if object_shape is None or pose is None else [object_shape.transformed(pose)]
        return cameras(self.robot, self.result.q, objects)

    @on_page_thread
    def drag_motors(self, q: Array) -> None:
        """Set the motors to q (n,) without solving."""
        self._is_q_fixed = True
        self.result = self._request_solver.check(self.request, q)

    @on_page_thread
    def choose(self, name: str) -> None:
        """Show a candidate."""
        self.push_undo()
        candidate, current = self.candidates[name], self.request
        q = self.robot.home if candidate.q is None else candidate.q
        self.restore(
            (request_of(self.robot, candidate.grasp, q, current.scene, current.settings), q)
        )

    @on_page_thread
    def open(
        self, robot: str | None = None, grasp: str | None = None, scene: str | None = None
    ) -> None:
        """Open another robot, grasp or scene by name; "": none.

        A robot opens with its first shipped grasp, or at home.
        """
        try:
            page = self._new_page(robot, grasp, scene)
        except CasadiIKError as error:
            for client in self.server.get_clients().values():
                client.add_notification("Cannot open", str(error), color="red")
            return
        self.on_replaced(page)

    def _new_page(self, robot: str | None, grasp: str | None, scene: str | None) -> GraspPage:
        new_robot = self.robot if robot is None else load_robot(robot)
        request, q = self.request, self.result.q
        if robot is not None:
            grasp = next(iter(shipped_grasps(robot)), "")
        new_scene = request.scene if scene is None else load_scene(scene) if scene else None
        if grasp is not None:
            new_grasp, q = (load_grasp(grasp) if grasp else None), new_robot.home
            request = request_of(new_robot, new_grasp, None, new_scene, request.settings)
        else:
            request = replace(request, scene=new_scene)
        self.is_stopped = True
        self.server.scene.reset()
        self.server.gui.reset()
        page = GraspPage(self.server, new_robot, request, q, dark=self.dark)
        self.work.stop()
        return page

    @on_page_thread
    def show_solution(self, index: int) -> None:
        """Show the solution with an index."""
        if index < len(self.solutions):
            solution = self.solutions[index]
            self._is_q_fixed = True
            result = self._request_solver.check(self.request, solution.q)
            headline = "SOLVED" if result.success else result.headline
            self.result = replace(result, headline=headline)
            self._panel.show_solution(index, solution)

    @on_page_thread
    def show_ghosts(self, visible: bool) -> None:
        """Show all solutions at once, or only the current solution."""
        self._ghosts_visible = visible
        self._draw_ghosts()

    @on_page_thread
    def compare(self, method: str) -> None:
        """Show the solution of another method next to the robot; "none": none."""
        self.compared_method = method

    @on_page_thread
    def show_geometry(self, name: str) -> None:
        """Draw the robot by its visual or its collision geometry."""
        self._robot_view.show_geometry(name)

    # Called on the worker thread.

    def on_request_change(self) -> None:
        """Solve the next request instead of keeping q."""
        self._is_q_fixed = False

    def show_selection(self, name: str) -> None:
        """Show the handles of the selected item."""
        self._handles.select(name)
        self._panel.show_selection(name)

    def state(self) -> tuple[PageRequest, Array]:
        """Return the request and the configuration."""
        return self.request, self.result.q

    def restore(self, state: tuple[PageRequest, Array]) -> None:
        """Restore a state."""
        self.request, q = state
        self.result = self._request_solver.check(self.request, q)
        self._is_q_fixed, self._solved_request = False, None

    def refresh(self) -> None:
        """Solve the request if it has changed, and draw the result."""
        if not self._is_q_fixed and self.request is not self._solved_request:
            try:
                self.result = self._request_solver.solve(self.request, self.result.q)
            except CasadiIKError as error:
                self.result = invalid_result(error, self.result.q)
            self._solved_request = self.request
            self.solutions = ()
            self._ghosts.show(())
        self.draw(self.result)
        # Motors are shown when the page is idle, but at most half a second after a result.
        self._motors_outdated_since = self._motors_outdated_since or time.monotonic()
        if time.monotonic() - self._motors_outdated_since > 0.5:
            self._show_motors()

    def draw(self, result: SolveResult) -> None:
        """Draw a result."""
        frames = frames_by_finger(self.robot, result.q)
        with self.server.atomic():
            self._robot_view.update(result.q)
            self._handles.update(self.request, self._dragged)
            self._tips.update(self.request, frames, result.verdicts)
            if self.candidate_list is not None:
                self.candidate_list.update(self.request.object_pose)
            closest = None if result.closest is None else result.closest[1]
            is_met = all(verdict.ok for verdict in result.verdicts.values())
            self._closest.update(closest, result.clearance, show_label=is_met)
            self._panel.show_result(result)
        self.server.flush()
        self._dragged = ""

    def _explain(self) -> None:
        """Diagnose a failed solve, which takes too long during a drag."""
        if self.result.needs_diagnosis and self.request is self._solved_request:
            self.result = self._request_solver.explain(self.request, self.result.q)
            self.draw(self.result)
            self._show_motors()
        self._show_comparison()

    def _show_comparison(self) -> None:
        """Show or hide the solution of another method."""
        if self.compared_method == NO_SELECTION:
            if self._comparison.is_visible:
                self._comparison.hide()
                self._panel.show_comparison(None)
            return
        settings = replace(self.request.settings, method=self.compared_method)
        request = replace(self.request, settings=settings)
        try:
            result = self._request_solver.solve(request, self._first_q)
        except CasadiIKError as error:
            result = invalid_result(error, self.result.q)
        self._comparison.show(request, result)
        self._panel.show_comparison(result)

    def _list_solutions(self) -> None:
        """List all solutions while the page is idle."""
        if self._is_q_fixed or self.request is self._listed_request:
            return
        try:
            solutions = (
                self._request_solver.solve_all(self.request, self.result.q)
                if self.result.success
                else ()
            )
        except CasadiIKError:
            solutions = ()
        self.solutions, self._listed_request = solutions, self.request
        self._panel.show_solutions(solutions)
        self._draw_ghosts()

    def _draw_ghosts(self) -> None:
        """Draw solutions in colours from red at a limit to green at a large limit margin."""
        solutions = self.solutions[:MAX_GHOSTS] if self._ghosts_visible else ()
        ghosts = [
            (solution.q, palette.shade(solution.margin, (0.0, 0.15, 0.4))) for solution in solutions
        ]
        self._ghosts.show(ghosts)

    def _show_motors(self) -> None:
        with self.server.atomic():
            self._panel.show_motors(self.result.q)
        self._motors_outdated_since = None


@lru_cache(maxsize=1)
def shipped_robots() -> tuple[str, ...]:
    """Return the names of shipped robots with hands, and of robots of shipped grasps."""
    grasp_robots = {load_grasp(name).robot for name in shipped_names("grasps")}
    return tuple(sorted(grasp_robots.union(shipped_names("arm_hands"), shipped_names("bodies"))))


class SettingsPanel:
    """Panel of the page: verdict, selection, results, settings and files."""

    def __init__(self, page: GraspPage, names: Sequence[str]) -> None:
        """Build the panel.

        Args:
            page: The page, which handles the changes by the user.
            names: Names of the draggable items.
        """
        self._page, self._gui = page, page.server.gui
        self.candidates: CandidateList | None = None
        gui = self._gui
        self._verdict = gui.add_html(verdict_block(page.result))
        self._drag = gui.add_dropdown(
            "Drag",
            (*names, NO_SELECTION),
            hint="or click an item; drag a ball or an arrow directly",
        )
        on_set(self._drag, lambda name: page.select("" if name == NO_SELECTION else name))
        page.add_undo_buttons()
        camera = gui.add_button_group("Camera", tuple(page.cameras()))
        on_press(camera, lambda client: page.cameras()[str(camera.value)].apply(client))
        tabs = gui.add_tab_group()
        if page.candidates:
            with tabs.add_tab("Candidates"):
                self.candidates = CandidateList(
                    page.server,
                    page.robot,
                    page.request.object_pose,
                    page.candidates,
                    page.choose,
                )
        with tabs.add_tab("Results"):
            self._results = gui.add_html(results_block(page.result))
            with gui.add_folder("Solutions", expand_by_default=False):
                self._slider = gui.add_slider("Solution", 1, 2, 1, 1, disabled=True)
                on_set(self._slider, lambda number: page.show_solution(int(number) - 1))
                ghosts = gui.add_checkbox(
                    "Show all", False, hint="green: large limit margin; red: at a limit"
                )
                on_set(ghosts, page.show_ghosts)
                self._solution = gui.add_html(block("listed while the page is idle"))
            gui.add_html(legend(GRASP_LEGEND))
            self._comparison_html = gui.add_html("")
        with tabs.add_tab("Solve"):
            self._add_settings(page.request.settings, page.request.scene is not None)
        with tabs.add_tab("Motors"):
            self._add_motors()
        with tabs.add_tab("Files"):
            self._add_files()

    # Display.

    def show_result(self, result: SolveResult) -> None:
        """Show a result."""
        self._verdict.content = verdict_block(result)
        self._results.content = results_block(result)

    def show_comparison(self, result: SolveResult | None) -> None:
        """Show the result of another method."""
        content = "" if result is None else verdict_block(result) + results_block(result)
        self._comparison_html.content = content

    def show_selection(self, name: str) -> None:
        """Show the name of the selected item."""
        if self._drag.value != (name or NO_SELECTION):
            self._drag.value = name or NO_SELECTION

    def show_solutions(self, solutions: Sequence[Alternative]) -> None:
        """Show the number of solutions, and the first solution."""
        self._slider.max = max(len(solutions), 2)
        self._slider.disabled = len(solutions) < 2
        self._slider.value = 1
        if solutions:
            self.show_solution(0, solutions[0])
        else:
            self._solution.content = block("no solutions")

    def show_solution(self, index: int, solution: Alternative) -> None:
        """Show the properties of a solution."""
        count, branch = len(self._page.solutions), solution.branch
        rows = {"solution": f"{index + 1} of {count}", "hand posture": f"{solution.posture + 1}"}
        if branch is not None:
            signs = {"shoulder": branch.shoulder, "elbow": branch.elbow, "wrist": branch.wrist}
            rows["arm branch"] = ", ".join(f"{n} {'+' if s > 0 else '−'}" for n, s in signs.items())
        if branch is not None and branch.swivel is not None and solution.swivel is not None:
            start, end, swivel = np.rad2deg([*branch.swivel, solution.swivel])
            rows["swivel"] = f"{(swivel + 180) % 360 - 180:.0f}°, free over {end - start:.0f}°"
        rows["limit margin"] = f"{100 * solution.margin:.0f} %"
        if solution.manipulability:
            rows["manipulability"] = f"{solution.manipulability:.4f}"
        self._solution.content = block(table(rows.items()))

    def show_motors(self, q: Array) -> None:
        """Show the positions of motors and joints."""
        # The box has space for one decimal.
        self._exact_values = q * self._scales
        self._shown_values = np.clip(np.round(self._exact_values, 1), *self._ranges)
        for slider, value in zip(self._motors, self._shown_values.tolist(), strict=True):
            if slider.value != value:
                slider.value = value
        robot = self._page.robot
        self._bars.content = bars(robot.description, robot.joints(q))
        units = [motor.unit for motor in robot.description.actuators]
        self._q.content = copyable_text(q_text(robot.actuators, q, units, str(self._form.value)))

    # Controls.

    def _add_settings(self, settings: Settings, has_scene: bool) -> None:
        gui, page = self._gui, self._page
        preference_of_label = {
            PREFERENCE_LABELS[name]: name for name in PREFERENCES if has_scene or name != CLEARANCE
        }
        method = gui.add_dropdown("Method", METHODS, initial_value=settings.method)
        prefer = gui.add_dropdown(
            "Prefer",
            tuple(preference_of_label),
            initial_value=PREFERENCE_LABELS[settings.prefer],
            hint="preference among several solutions; ignored by methods without preferences",
        )
        limits = gui.add_dropdown("Limits", LIMIT_MODES, initial_value=settings.limits)
        position_tolerance, angle_tolerance = (
            1e3 * settings.tolerance.position,
            np.rad2deg(settings.tolerance.angle),
        )
        position = gui.add_number(
            "Tolerance [mm]", position_tolerance, min=0.001, max=100.0, step=0.1
        )
        angle = gui.add_number(
            "Tolerance [°]", round(float(angle_tolerance), 6), min=0.001, max=180.0, step=0.1
        )

        def changed(_: Any) -> None:
            tolerance = Tolerance(1e-3 * float(position.value), float(np.deg2rad(angle.value)))
            preference = preference_of_label[str(prefer.value)]
            new = Settings(str(method.value), tolerance, str(limits.value), preference)
            page.change("settings", lambda request: replace(request, settings=new))

        for control in (method, prefer, limits, position, angle):
            on_set(control, changed)
        comparison = gui.add_dropdown(
            "Compare with", (NO_SELECTION, *METHODS), hint="solution of another method"
        )
        on_set(comparison, lambda name: page.compare(str(name)))
        with gui.add_folder("Fingers", expand_by_default=False):
            for finger, contact in page.request.contacts.items():
                self._add_finger(
                    finger,
                    CONTACT_USES[2]
                    if not contact.is_used
                    else CONTACT_USES[not contact.uses_normal],
                )

    def _add_finger(self, finger: str, initial_use: str) -> None:
        def changed(use: str) -> None:
            is_used, uses_normal = use != CONTACT_USES[2], use == CONTACT_USES[0]
            self._page.change(f"use {finger}", lambda a: a.with_use(finger, is_used, uses_normal))

        on_set(self._gui.add_dropdown(finger, CONTACT_USES, initial_value=initial_use), changed)

    def _add_motors(self) -> None:
        gui, page, robot = self._gui, self._page, self._page.robot
        motors = robot.description.actuators
        self._scales = np.array([np.rad2deg(1.0) if m.unit == "rad" else 1e3 for m in motors])
        # Limits are rounded inwards because sliders display them.
        lower = np.ceil(10 * robot.lower * self._scales) / 10
        upper = np.maximum(np.floor(10 * robot.upper * self._scales) / 10, lower + 0.1)
        self._ranges = lower, upper
        values = np.clip(page.result.q * self._scales, lower, upper)
        self._form = gui.add_dropdown("Copy as", Q_FORMATS)
        self._q = gui.add_html("")
        on_set(self._form, lambda _: page.work.submit("form", lambda: None))
        gui.add_html(block("Motors move without solving; drag a contact to solve again."))
        sliders: dict[int, Any] = {}

        def on_motor_change(_: Any) -> None:
            values = finite_numbers([slider.value for slider in self._motors], len(self._motors))
            q = np.where(values == self._shown_values, self._exact_values, values) / self._scales
            page.drag_motors(np.clip(q, robot.lower, robot.upper))

        expand = len(motors) < 24
        for part, indices in motors_by_part(robot.description).items():
            with gui.add_folder(part.capitalize(), expand_by_default=expand):
                for i in indices:
                    name = motors[i].name.removeprefix(f"{part.partition(' ')[0]}_")
                    name += " [°]" if motors[i].unit == "rad" else " [mm]"
                    limits = float(lower[i]), float(upper[i])
                    sliders[i] = gui.add_slider(name, *limits, 0.1, float(values[i]))
                    on_set(sliders[i], on_motor_change)
        self._motors = [sliders[i] for i in range(len(motors))]
        with gui.add_folder("Joints and their limits", expand_by_default=expand):
            self._bars = gui.add_html("")
        self.show_motors(page.result.q)

    def _add_files(self) -> None:
        page, gui, robot = self._page, self._gui, self._page.robot
        names = tuple(dict.fromkeys((robot.name, *shipped_robots())))
        on_set(gui.add_dropdown("Robot", names), lambda name: page.open(robot=str(name)))
        current_grasp = page.request.name or "at home"
        grasps = tuple(dict.fromkeys((current_grasp, *shipped_grasps(robot.name), "at home")))
        on_set(
            gui.add_dropdown("Grasp", grasps),
            lambda name: page.open(grasp="" if name == "at home" else str(name)),
        )
        scene = page.request.scene
        current_scene = "none" if scene is None else scene.name
        scenes = tuple(dict.fromkeys((current_scene, "none", *shipped_names("scenes"))))
        on_set(
            gui.add_dropdown("Scene", scenes),
            lambda name: page.open(scene="" if name == "none" else str(name)),
        )
        if visual_meshes(robot.description).by_link:  # otherwise both geometries are the same
            on_set(gui.add_dropdown("Show robot as", GEOMETRIES), page.show_geometry)
        page.add_theme_switch()
        on_press(gui.add_button("Save grasp (YAML)", icon=None), self._save_grasp)
        if isinstance(scene, Scene):
            on_press(gui.add_button("Save scene (YAML)", icon=None), self._save_scene)
        picture = gui.add_button("Export picture (PNG)", icon=None)

        # A synchronous callback runs in its thread, so it may wait for the browser to render.
        @picture.on_click
        def _(event: Any) -> None:
            save_picture(event.client, file_name(page.request.name or page.robot.name, "view"))

    def _save_grasp(self, client: Any) -> None:
        page = self._page
        status = "solved." if page.result.success else "unsolved."
        text = grasp_text(page.request.grasp, f"Saved from the casadi_ik viewer; {status}")
        save_text(client, f"{file_name(page.request.name, 'grasp')}.yaml", text)

    def _save_scene(self, client: Any) -> None:
        scene = self._page.request.scene
        assert scene is not None
        save_text(client, f"{file_name(scene.name, 'scene')}.yaml", scene.text())
