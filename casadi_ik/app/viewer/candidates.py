"""Candidate grasps on a page: drawn as rods from palm to contacts, with filters and a list."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import Drawable
from casadi_ik.app.drawing.surfaces import Shape, ball, join_surfaces, mesh_shape, rod
from casadi_ik.app.viewer.access import Server
from casadi_ik.app.viewer.panel import block, on_set
from casadi_ik.app.viewer.viser_scene import add_drawable, quaternions
from casadi_ik.files.arrays import Array
from casadi_ik.integrations.importing.meshes import IndexedMesh
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.pose import inverse
from casadi_ik.planning.touch.found_grasps import FoundGrasp

INITIAL_COUNT = 20
"""Number of candidates that are shown initially."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A candidate grasp.

    Attributes:
        grasp: The grasp; None: the contacts of the robot at q.
        q: (n,) Configuration of the grasp [rad or m]; None: not solved yet, so not drawn.
        load: Largest weight per newton of squeeze [N/N]; None: unknown.
        clearance: Smallest clearance [m]; None: unknown.
    """

    grasp: Grasp | None
    q: Array | None = None
    load: float | None = None
    clearance: float | None = None


Candidates = Mapping[str, Candidate | FoundGrasp]
"""Candidates by name, the best first."""


class CandidateList:
    """The candidates of a page: marks in the scene, and controls to filter and choose."""

    def __init__(
        self,
        server: Server,
        robot: ArmHand,
        object_pose: Array | None,
        candidates: Candidates,
        on_choose: Callable[[str], None],
    ) -> None:
        """Draw the candidates that are shown initially.

        Args:
            server: Server of the page.
            robot: The robot.
            object_pose: (4, 4) Initial pose of the object; None: there is no object.
            candidates: Candidates by name, the best first.
            on_choose: Callback that receives the name of the chosen candidate.
        """
        self._server, self._on_choose = server, on_choose
        self._candidates = dict(candidates)
        self._bounds = {"load": -np.inf, "clearance": -np.inf, "max_count": INITIAL_COUNT}
        self._chosen_name = next(iter(self._candidates))
        self._frame = server.scene.add_frame("/candidates", show_axes=False)
        self._initial_pose = np.eye(4) if object_pose is None else object_pose
        self._meshes: dict[str, Any] = {}
        loads = [
            candidate.load for candidate in self._candidates.values() if candidate.load is not None
        ]
        for i, (name, candidate) in enumerate(self._candidates.items()):
            tripod = _tripods(robot, candidate)
            if not tripod:
                continue
            relative_load = (
                0.5 if candidate.load is None or not loads else candidate.load / max(*loads, 1e-9)
            )
            mark = Drawable(
                "candidate", mesh_shape(join_surfaces(tripod)), palette.shade(relative_load)
            )
            node = f"/candidates/{i}"
            mesh = add_drawable(server, node, mark, cast_shadow=False, visible=False)
            self._meshes[name] = mesh

            @mesh.on_click
            async def _(_: Any, name: str = name) -> None:
                self.choose(name)

        self._add_controls()
        self.filter()

    @property
    def shown_names(self) -> tuple[str, ...]:
        """Names of the candidates that pass the filter, the best first."""
        bounds, count = self._bounds, int(self._bounds["max_count"])
        names = [
            name
            for name, candidate in self._candidates.items()
            if (candidate.load is None or candidate.load >= bounds["load"])
            and (candidate.clearance is None or candidate.clearance >= bounds["clearance"])
        ]
        return tuple(names[:count])

    def update(self, pose: Array | None) -> None:
        """Move all candidates with the object to its (4, 4) pose."""
        if pose is not None:
            displacement = pose @ inverse(self._initial_pose)
            self._frame.position, self._frame.wxyz = (
                displacement[:3, 3],
                quaternions(displacement[:3, :3]),
            )

    def choose(self, name: str) -> None:
        """Choose a candidate by name."""
        self._chosen_name = name
        self._on_choose(name)
        self.filter()

    def filter(self, **bounds: float) -> None:
        """Change the filter.

        Args:
            bounds: Lower bounds of `load` [N/N] and `clearance` [m], and `max_count`; omitted
                bounds are unchanged.
        """
        self._bounds |= bounds
        names = self.shown_names
        with self._server.atomic():
            for name, mesh in self._meshes.items():
                mesh.visible = name in names and name != self._chosen_name
            options = names or (self._chosen_name,)
            self._list.options = options
            if self._chosen_name in options:
                self._list.value = self._chosen_name
            candidate = self._candidates[self._chosen_name]
            details = [] if candidate.load is None else [f"load {candidate.load:.3f} N/N"]
            details += (
                []
                if candidate.clearance is None
                else [f"clearance {1e3 * candidate.clearance:.1f} mm"]
            )
            summary = f"<b>{len(names)}</b> of {len(self._candidates)} shown"
            self._summary.content = block("<br>".join([summary, *details]))

    def _add_controls(self) -> None:
        gui = self._server.gui
        self._list = gui.add_dropdown(
            "Candidate", tuple(self._candidates), hint="or click its tripod on the object"
        )
        on_set(self._list, lambda name: self.choose(str(name)))
        count = len(self._candidates)
        max_count_slider = gui.add_slider("Best", 1, max(count, 2), 1, min(INITIAL_COUNT, count))
        on_set(max_count_slider, lambda value: self.filter(max_count=value))
        for key, label, scale in (("load", "Load ≥", 1.0), ("clearance", "Clearance ≥ [mm]", 1e3)):
            values = [getattr(candidate, key) for candidate in self._candidates.values()]
            finite_values = [scale * value for value in values if value is not None]
            if len(finite_values) > 1 and max(finite_values) > min(finite_values):
                low, high = (
                    np.floor(100 * min(finite_values)) / 100,
                    np.ceil(100 * max(finite_values)) / 100,
                )
                slider = gui.add_slider(label, float(low), float(high), 0.01, float(low))
                on_set(slider, lambda value, key=key, s=scale: self.filter(**{key: value / s}))
        self._summary = gui.add_html("")


def _tripods(robot: ArmHand, candidate: Candidate | FoundGrasp) -> list[IndexedMesh]:
    """Return rods from each palm to its contacts, with balls at their ends."""
    contacts = {} if candidate.grasp is None else candidate.grasp.contacts
    if candidate.q is None or not all(
        np.isfinite(contact.point).all() for contact in contacts.values()
    ):
        return []
    shapes: list[Shape] = []
    for side, fingers in robot.hands.items():
        names = [robot.fingers[i] for i in fingers]
        tips = [contacts[name].point for name in names if name in contacts]
        palm = robot.palm(candidate.q, side)[:3, 3]
        shapes += [shape for tip in tips for shape in (rod(palm, tip, 0.0009), ball(0.003, tip))]
        shapes += [ball(0.0045, palm)] if tips else []
    return [shape.surface for shape in shapes]
