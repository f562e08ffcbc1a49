"""The panel beside the picture of a grasp: verdict, settings, solutions, motors, files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.grasps import Tolerance
from casadi_ik.problem.problems import LIMITS
from casadi_ik.problem.questions import CLEARANCE, PREFERENCES
from casadi_ik.registry import METHODS
from casadi_ik.solving.alternatives.finder import Alternative
from casadi_ik.viewing.answering import Answered
from casadi_ik.viewing.asked import Asked, Settings
from casadi_ik.viewing.files import picture_name, save_grasp, save_picture
from casadi_ik.viewing.motors import Motors
from casadi_ik.viewing.stage import legend
from casadi_ik.viewing.words import block, verdict_block

if TYPE_CHECKING:
    from casadi_ik.viewing.grasp_page import GraspPage

NOTHING = "nothing"
USES = ("point and normal", "point", "free")
"""What may be asked of a finger."""


class Panel:
    """Everything beside the picture."""

    def __init__(
        self, page: GraspPage, names: Sequence[str], colors: Sequence[tuple[str, str]]
    ) -> None:
        """Build it.

        Args:
            page: Whose it is; told of everything.
            names: What can be dragged.
            colors: What colours mean.
        """
        self._page, gui = page, page.server.gui
        self._verdict = gui.add_html(verdict_block(page.answer))
        self._drag = gui.add_dropdown(
            "Drag",
            (*names, NOTHING),
            hint="whose arrows and rings are shown; or click it, or drag ball and arrow themselves",
        )
        self._on(self._drag, lambda: page.select(self._chosen_name()))
        if page.candidates:
            chooser = gui.add_dropdown("Candidate", tuple(page.candidates))
            self._on(chooser, lambda: page.choose(str(chooser.value)))
        tabs = gui.add_tab_group()
        with tabs.add_tab("Solve"):
            self._add_settings(page.asked.settings, page.asked.scene is not None)
            with gui.add_folder("What is asked of", expand_by_default=False):
                self._add_fingers(page.asked)
        with tabs.add_tab("Solutions"):
            self._add_solutions()
        with tabs.add_tab("Motors"):
            self._motors = Motors(page)
        with tabs.add_tab("Files"):
            self._add_files()
        gui.add_html(legend(colors))

    # What is shown.

    def tell(self, answer: Answered) -> None:
        """Show a verdict."""
        self._verdict.content = verdict_block(answer)

    def selected(self, name: str) -> None:
        """Show what has handles."""
        if self._drag.value != (name or NOTHING):
            self._drag.value = name or NOTHING

    def tell_solutions(self, found: Sequence[Alternative]) -> None:
        """Show how many solutions there are."""
        count = len(found)
        self._slider.max = max(count - 1, 1)
        self._slider.disabled = count < 2
        self._slider.value = 0
        if count:
            self.tell_solution(0, found[0])
        else:
            self._solution.content = block("no solutions to go through")

    def tell_solution(self, number: int, one: Alternative) -> None:
        """Show what one of the solutions is like."""
        count = len(self._page.solutions)
        rows = {"solution": f"{number + 1} of {count}", "hand posture": f"{one.posture + 1}"}
        if one.branch is not None:
            signs = ("shoulder", one.branch.shoulder), ("elbow", one.branch.elbow)
            rows["arm branch"] = ", ".join(
                f"{name} {'+' if sign > 0 else '−'}"
                for name, sign in (*signs, ("wrist", one.branch.wrist))
            )
        if one.branch is not None and one.branch.swivel is not None and one.swivel is not None:
            start, end, here = np.rad2deg([*one.branch.swivel, one.swivel])
            rows["swivel"] = f"{here:.0f}° in {start:.0f}° to {end:.0f}°"
        rows["room to limits"] = f"{100 * one.margin:.0f} % of half a range"
        if one.manipulability:
            rows["manipulability"] = f"{one.manipulability:.4f}"
        text = "".join(f"<tr><td>{k}</td><td><b>{v}</b></td></tr>" for k, v in rows.items())
        self._solution.content = block(f'<table style="width:100%">{text}</table>')

    def tell_motors(self, q: Array, joints: Mapping[str, float]) -> None:
        """Show where motors and joints are."""
        self._motors.tell(q, joints)

    # What is set.

    def _add_settings(self, settings: Settings, scene: bool) -> None:
        gui = self._page.server.gui
        method = gui.add_dropdown("Method", METHODS, initial_value=settings.method)
        prefers = tuple(one for one in PREFERENCES if scene or one != CLEARANCE)
        prefer = gui.add_dropdown(
            "Prefer",
            prefers,
            initial_value=settings.prefer,
            hint="q0: nearest to what is shown; methods that cannot choose take no notice",
        )
        limits = gui.add_dropdown("Limits", LIMITS, initial_value=settings.limits)
        position = gui.add_number(
            "Tolerance [mm]", 1e3 * settings.tolerance.position, min=0.001, max=100.0, step=0.1
        )
        angle = gui.add_number(
            "Tolerance [°]",
            round(float(np.rad2deg(settings.tolerance.angle)), 6),
            min=0.001,
            max=180.0,
            step=0.1,
        )
        again = gui.add_button("Back to the beginning", icon=None)

        def changed() -> None:
            tolerance = Tolerance(1e-3 * float(position.value), float(np.deg2rad(angle.value)))
            new = Settings(str(method.value), tolerance, str(limits.value), str(prefer.value))
            self._page.change("settings", lambda asked: replace(asked, settings=new))

        for one in (method, prefer, limits, position, angle):
            self._on(one, changed)

        @again.on_click
        async def _(_: Any) -> None:
            self._page.reset()

    def _add_solutions(self) -> None:
        gui = self._page.server.gui
        self._slider = gui.add_slider("Solution", 0, 1, 1, 0, disabled=True)
        self._on(self._slider, lambda: self._page.show_solution(int(self._slider.value)))
        self._solution = gui.add_html(block("found when nothing moves"))

    def _add_fingers(self, asked: Asked) -> None:
        gui = self._page.server.gui
        for finger, held in asked.held.items():
            now = USES[2] if not held.used else USES[0] if held.normal else USES[1]
            use = gui.add_dropdown(finger, USES, initial_value=now)

            def changed(finger: str = finger, use: Any = use) -> None:
                used, normal = use.value != USES[2], use.value == USES[0]
                self._page.change(f"use {finger}", lambda a: a.with_use(finger, used, normal))

            self._on(use, changed)

    def _add_files(self) -> None:
        page, gui = self._page, self._page.server.gui
        grasp = gui.add_button("Save grasp (YAML)", icon=None)
        picture = gui.add_button("Export picture (PNG)", icon=None)

        @grasp.on_click
        async def _(event: Any) -> None:
            save_grasp(event.client, page.asked.grasp, page.answer.success)

        # The browser draws the picture and sends it: this waits for it, in a thread of its own.
        @picture.on_click
        def _(event: Any) -> None:
            save_picture(event.client, picture_name(page.asked.name or page.robot.name))

    def _chosen_name(self) -> str:
        return "" if self._drag.value == NOTHING else str(self._drag.value)

    def _on(self, handle: Any, do: Any) -> None:
        """Do something when a person, not the program, has changed a value."""

        @handle.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                do()
