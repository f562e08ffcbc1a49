"""Candidates on a page: each a tripod from palm to contacts, filtered, and taken by a click."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import Drawable
from casadi_ik.app.drawing.surfaces import Shape, ball, joined, mesh_of, rod
from casadi_ik.app.viewer.panel import block, on_set
from casadi_ik.app.viewer.viser_scene import add_drawable, quaternions
from casadi_ik.files.arrays import Array
from casadi_ik.integrations.importing.surfaces import Surface
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.pose import inverse
from casadi_ik.planning.touch.grasps import FoundGrasp

if TYPE_CHECKING:
    from casadi_ik.app.viewer.grasp_page import GraspPage

AT_FIRST = 20
"""So many are shown before somebody filters."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A grasp to choose from; one that `Solver.grasps_of` has found is such as it is.

    Attributes:
        grasp: What is asked; None: what q reaches.
        q: (n,) where it is reached [rad or m]; None: it is not solved yet, and not drawn.
        load: What it holds per newton of squeeze; None: not known.
        clearance: Smallest distance of a pair that must not touch [m]; None: not known.
    """

    grasp: Grasp | None
    q: Array | None = None
    load: float | None = None
    clearance: float | None = None


Candidates = Mapping[str, Candidate | FoundGrasp]
"""By name."""


class CandidateList:
    """The candidates of a page: what is drawn of them, and the controls that filter them."""

    def __init__(self, page: GraspPage, candidates: Candidates) -> None:
        """Draw those that are shown at first.

        Args:
            page: Whose they are; told of the one that is taken.
            candidates: The best first.
        """
        self._page, self._all = page, dict(candidates)
        self._bounds = {"load": -np.inf, "clearance": -np.inf, "most": AT_FIRST}
        self._taken = next(iter(self._all))
        server = page.server
        self._frame = server.scene.add_frame("/candidates", show_axes=False)
        place = page.asked.object_pose
        self._origin = np.eye(4) if place is None else place
        self._meshes: dict[str, Any] = {}
        loads = [one.load for one in self._all.values() if one.load is not None]
        for i, (name, one) in enumerate(self._all.items()):
            tripod = _tripods(page.robot, one)
            if not tripod:
                continue
            part = 0.5 if one.load is None or not loads else one.load / max(*loads, 1e-9)
            mark = Drawable("candidate", mesh_of(joined(tripod)), palette.shade(part))
            node = f"/candidates/{i}"
            mesh = add_drawable(server, node, mark, cast_shadow=False, visible=False)
            self._meshes[name] = mesh

            @mesh.on_click
            async def _(_: Any, name: str = name) -> None:
                self.take(name)

        self._add_controls()
        self.filter()

    @property
    def shown(self) -> tuple[str, ...]:
        """Names of those that pass the filter, the best first."""
        least, most = self._bounds, int(self._bounds["most"])
        found = [
            name
            for name, one in self._all.items()
            if (one.load is None or one.load >= least["load"])
            and (one.clearance is None or one.clearance >= least["clearance"])
        ]
        return tuple(found[:most])

    def place(self, pose: Array | None) -> None:
        """Move all with the object to its (4, 4) pose."""
        if pose is not None:
            moved = pose @ inverse(self._origin)
            self._frame.position, self._frame.wxyz = moved[:3, 3], quaternions(moved[:3, :3])

    def take(self, name: str) -> None:
        """Show the robot in one of them."""
        self._taken = name
        self._page.choose(name)
        self.filter()

    def filter(self, **bounds: float) -> None:
        """Show others.

        Args:
            bounds: The least `load` [N/N] or `clearance` [m], how many at `most`; what is not
                given is as before.
        """
        self._bounds |= bounds
        shown = self.shown
        with self._page.server.atomic():
            for name, mesh in self._meshes.items():
                mesh.visible = name in shown and name != self._taken
            options = shown or (self._taken,)
            self._list.options = options
            if self._taken in options:
                self._list.value = self._taken
            one = self._all[self._taken]
            words = [] if one.load is None else [f"load {one.load:.3f} N/N"]
            words += [] if one.clearance is None else [f"clearance {1e3 * one.clearance:.1f} mm"]
            about = f"<b>{len(shown)}</b> of {len(self._all)} shown"
            self._told.content = block("<br>".join([about, *words]))

    def _add_controls(self) -> None:
        gui = self._page.server.gui
        self._list = gui.add_dropdown(
            "Candidate", tuple(self._all), hint="or click its tripod on the object"
        )
        on_set(self._list, lambda name: self.take(str(name)))
        count = len(self._all)
        most = gui.add_slider("Best", 1, max(count, 2), 1, min(AT_FIRST, count))
        on_set(most, lambda value: self.filter(most=value))
        for key, label, scale in (("load", "Load ≥", 1.0), ("clearance", "Clearance ≥ [mm]", 1e3)):
            values = [getattr(one, key) for one in self._all.values()]
            known = [scale * value for value in values if value is not None]
            if len(known) > 1 and max(known) > min(known):
                low, high = np.floor(100 * min(known)) / 100, np.ceil(100 * max(known)) / 100
                slider = gui.add_slider(label, float(low), float(high), 0.01, float(low))
                on_set(slider, lambda value, key=key, s=scale: self.filter(**{key: value / s}))
        self._told = gui.add_html("")


def _tripods(robot: ArmHand, one: Candidate | FoundGrasp) -> list[Surface]:
    """Rods from the palm of every hand to its contacts, a ball at each; none if one is nowhere."""
    contacts = {} if one.grasp is None else one.grasp.contacts
    if one.q is None or not all(np.isfinite(contact.point).all() for contact in contacts.values()):
        return []
    shapes: list[Shape] = []
    for side, fingers in robot.hands.items():
        names = [robot.fingers[i] for i in fingers]
        tips = [contacts[name].point for name in names if name in contacts]
        palm = robot.palm(one.q, side)[:3, 3]
        shapes += [shape for tip in tips for shape in (rod(palm, tip, 0.0009), ball(0.003, tip))]
        shapes += [ball(0.0045, palm)] if tips else []
    return [shape.surface for shape in shapes]
