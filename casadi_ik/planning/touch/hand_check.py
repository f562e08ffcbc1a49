"""Collision check of hands with an object and a scene, before the arm is solved."""

from __future__ import annotations

from typing import Any

import numpy as np

from casadi_ik.collision.clearance import CollisionQuery, SceneCheck
from casadi_ik.collision.distances import PairTable, pose_row
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.model.pose import inverse
from casadi_ik.planning.touch.hand_table import HandTable, rigid_transforms
from casadi_ik.planning.touch.hands import HandCandidates, TouchParameters
from casadi_ik.planning.touch.surface import Grid


class HandCheck:
    """Collision check of hands with the object, the scene and themselves, without the arm.

    The arm stays at home and the obstacles are moved relative to the palm, so that the collision
    kernel of the solver is usable before the arm is solved.
    """

    def __init__(
        self, table: HandTable, check: SceneCheck, pose: Array, tables: dict[bytes, Any]
    ) -> None:
        """Initialise the check from the scene of a solver.

        Args:
            table: Table of the hand.
            check: Check of the scene in which the object is grasped.
            pose: (4, 4) pose of the object in the base frame.
            tables: Cache of grids and pair tables, shared between poses of the same object.
        """
        self.table, self.check, self.pose, self._tables = table, check, pose, tables
        self._all_pairs = check.table(check.scene, frozenset()).hand_pairs
        rows = self._all_pairs.poses(check.scene.items)
        self._items = rigid_transforms(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:])
        self.shapes = table.shape(check)

    def grids(self, low: Array, high: Array, parameters: TouchParameters) -> tuple[Grid, Grid]:
        """Return the distance grids of the object and of the scene, in the object's frame.

        Args:
            low: (3,) lower corner of the object [m].
            high: (3,) upper corner of the object [m].
            parameters: Sizes of the cells.
        """
        scene, size = self.check.scene, float((high - low).max())
        if OBJECT_GRID not in self._tables:
            solids = scene.items[str(scene.grasped)].parts
            step = max(parameters.object_cell, size / parameters.max_cells)
            margin = max(float(self.standoffs(of_object=True).max(initial=0.0)), 0.0) + 2 * step
            self._tables[OBJECT_GRID] = Grid.from_solids(solids, low - margin, high + margin, step)
        reach = sum(
            float(np.abs(segments[..., :3]).max(initial=0.0))
            for segments in (self.shapes.capsules, self.shapes.fixed)
        )
        obstacles = [
            (solid, inverse(self.pose) @ item.pose @ pose)
            for item in scene.items.values()
            if item.name != scene.grasped
            for solid, pose in item.parts
        ]
        step = max(parameters.scene_cell, (size + 2 * reach) / parameters.max_cells)
        return self._tables[OBJECT_GRID], Grid.from_solids(
            obstacles, low - reach, high + reach, step
        )

    def standoffs(self, of_object: bool) -> Array:
        """Return the minimum distances (c,) between capsule axes of the hand and solids [m].

        Args:
            of_object: True for distances from the object, False for distances from the scene.
        """
        pairs, shapes = self._all_pairs, self.shapes
        first = len(pairs.radii) + pairs.n_robot_solids
        is_grasped = np.array(
            [name == self.check.scene.grasped for name in pairs.items], dtype=bool
        )
        is_selected = pairs.pairs[:, 1] >= first
        solids = pairs.pairs[is_selected, 1] - first
        is_selected[is_selected] = is_grasped[solids] == of_object
        min_distance = np.full(len(pairs.radii), -np.inf)
        np.maximum.at(min_distance, pairs.pairs[is_selected, 0], pairs.offsets[is_selected])
        return (min_distance + pairs.radii + self.check.scene.margin)[shapes.numbers]

    def __call__(self, hands: HandCandidates) -> Bools:
        """Return (k,) True for hands that are free of collision."""
        q = self.table.configuration(hands.hand)
        world = self.table.palm @ inverse(self.pose @ hands.palm)
        is_free = np.zeros(len(hands), dtype=bool)
        code = hands.touches @ (1 << np.arange(hands.touches.shape[1]))
        for value in set(code.tolist()):
            rows = np.flatnonzero(code == value)
            table = self._pairs_for(hands.touches[rows[0]])
            poses = pose_row(world[rows, None] @ self._items)
            query = CollisionQuery(self.check.kernel, table, poses, self.check.scene.margin)
            is_free[rows] = query.free(q[rows])
        return is_free

    def arm_is_free(self, q: Array) -> Bools:
        """Return (k,) True for configurations (k, n) whose arm is free of collision."""
        check = self.check
        table = check.table(check.scene, frozenset()).arm_pairs
        query = CollisionQuery(
            check.kernel, table, table.poses(check.scene.items), check.scene.margin
        )
        return query.free(q)

    def _pairs_for(self, touches: Bools) -> PairTable:
        """Return the pairs to check: the fingertips in `touches` (f,) may touch the object."""
        key = touches.tobytes()
        if key not in self._tables:
            names = zip(self.table.robot.fingers, touches, strict=True)
            pads = [self.check.finger_bodies[name] for name, may_touch in names if may_touch]
            touching_links, grasped = frozenset[str]().union(*pads), self.check.scene.grasped
            checked = [
                not (pair[1] == grasped and pair[0] in touching_links)
                for pair in self._all_pairs.names
            ]
            self._tables[key] = self._all_pairs.select(np.array(checked, dtype=bool))
        return self._tables[key]


OBJECT_GRID = b"object"
"""Key of the object's grid in the cache of a `HandCheck`."""
