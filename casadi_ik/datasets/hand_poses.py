"""Poses and postures of a hand, as a data set has them: checked, whatever file they are from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array, Bools
from casadi_ik.errors import DescriptionError

FAR = 5.0
"""A hand farther from its object than this [m] is one in millimetres."""

LARGE = 4 * np.pi
"""A joint that is turned farther than this [rad] is one in degrees."""

SKEW = 2e-3
"""How far a rotation may be from one: data sets keep four bytes a number."""


@dataclass(frozen=True, eq=False)
class HandPoses:
    """k grasps by one hand.

    A row that is none (numbers that are not finite or in other units, no rotation) is among
    `faults`; its numbers are zeros, and its rotation is none.

    Attributes:
        where: File and key, for messages.
        position: (k, 3) origin of the hand's frame in the object's [m].
        rotation: (k, 3, 3) its axes, exact rotations.
        joints: (k, m) joint positions [rad or m].
        names: Of the joints as the file calls them; none: the order of the hand's description.
        objects: What each grasp is of, as the file calls it; none: all are of one thing.
        scales: By what factor the object of each grasp is larger than its mesh; none: not said.
        rows: (k,) their numbers in the file.
        faults: What is wrong with a row, by its number in the file.
        pregrasp: The same hands before they close; None: not said.
        squeeze: The same hands as they squeeze; None: not said.
    """

    where: str
    position: Array
    rotation: Array
    joints: Array
    names: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()
    scales: tuple[float, ...] = ()
    rows: tuple[int, ...] = ()
    faults: Mapping[int, str] = field(default_factory=dict)
    pregrasp: HandPoses | None = None
    squeeze: HandPoses | None = None

    def __post_init__(self) -> None:
        """Check what is given.

        Raises:
            DescriptionError: No grasps, or another number of poses than postures.
        """
        count = len(self.position)
        shapes = {"position": (count, 3), "rotation": (count, 3, 3)}
        for name, shape in shapes.items():
            found = getattr(self, name).shape
            if found != shape:
                self._fail(f"{name}: found shape {found}, expected {shape}")
        if not count:
            self._fail("found no grasps, expected at least one")
        if self.joints.ndim != 2 or len(self.joints) != count:
            self._fail(f"joints: found shape {self.joints.shape}, expected ({count}, joints)")
        object.__setattr__(self, "rows", self.rows or tuple(range(count)))
        faults = {**self._faults(), **self.faults}
        for stage in ("pregrasp", "squeeze"):
            other = getattr(self, stage)
            if other is not None:
                faults = {row: f"{stage}: {text}" for row, text in other.faults.items()} | faults
        object.__setattr__(self, "faults", faults)

    def of(self, name: str | None) -> HandPoses:
        """The grasps of one thing.

        Args:
            name: What the file calls it; None: there is only one.

        Raises:
            DescriptionError: There are several, or none of that name.
        """
        if name is None and len(set(self.objects)) <= 1:
            return self
        known = sorted(set(self.objects))
        said = f"{len(known)} objects ({', '.join(known[:3])}{', ...' if known[3:] else ''})"
        if name is None:
            self._fail(f"found grasps of {said}, expected one; say which (of)")
        if name not in known:
            self._fail(f"of: found {name!r}, expected one of {said}")
        kept = self.select(np.flatnonzero(np.array(self.objects) == name))
        return replace(kept, where=f"{self.where}: {name}")

    def of_scale(self, scale: float | None) -> HandPoses:
        """The grasps of one size of the object.

        Args:
            scale: Which; None: there is only one.

        Raises:
            DescriptionError: There are several, or none of that size.
        """
        if not self.scales:
            if scale is not None:
                self._fail(f"scale: found {scale:g}, but the file says of no size")
            return self
        digits = np.array([float(f"{one:.5g}") for one in self.scales])
        sizes, counts = np.unique(digits, return_counts=True)
        pairs = zip(sizes, counts, strict=True)
        said = f"{len(sizes)} sizes (scale {', '.join(f'{s:g}: {n} rows' for s, n in pairs)})"
        if scale is None:
            if len(sizes) > 1:
                self._fail(f"found grasps of {said}, expected one; say which (scale, --scale)")
            return self
        kept = np.flatnonzero(np.isclose(digits, scale, rtol=1e-4, atol=0.0))
        if not len(kept):
            self._fail(f"scale: found {scale:g}, expected one of {said}")
        return self.select(kept)

    def select(self, kept: NDArray[np.intp]) -> HandPoses:
        """Some of the grasps, by their places."""

        def some(values: tuple[Any, ...]) -> tuple[Any, ...]:
            return tuple(values[i] for i in kept) if values else ()

        rows = some(self.rows)
        return replace(
            self,
            position=self.position[kept],
            rotation=self.rotation[kept],
            joints=self.joints[kept],
            objects=some(self.objects),
            scales=some(self.scales),
            rows=rows,
            faults={row: text for row, text in self.faults.items() if row in rows},
            pregrasp=None if self.pregrasp is None else self.pregrasp.select(kept),
            squeeze=None if self.squeeze is None else self.squeeze.select(kept),
        )

    def _faults(self) -> dict[int, str]:
        """What is wrong with rows; these are zeros from now on, and rotations exact."""
        found: dict[int, str] = {}

        def note(bad: Bools, texts: Callable[[int], str]) -> None:
            for i in np.flatnonzero(bad):
                found.setdefault(self.rows[i], texts(int(i)))

        for name in ("position", "rotation", "joints"):
            finite = np.isfinite(getattr(self, name)).reshape(len(self.position), -1).all(axis=1)
            text = f"{name}: holds NaN or infinity, expected finite numbers"
            note(np.asarray(~finite), lambda _, text=text: text)
        away = np.linalg.norm(self.position, axis=1)
        note(
            away > FAR,
            lambda i: (
                f"position: found {away[i]:.4g} m from the object, expected at most {FAR:g} m "
                "(numbers in mm?)"
            ),
        )
        note(
            np.asarray((np.abs(self.joints) > LARGE).any(axis=1)),
            lambda _: (
                "joints: found angles beyond two turns, expected radians (numbers in degrees?)"
            ),
        )
        whole = np.array([row not in found for row in self.rows])
        rotation = np.where(whole[:, None, None], self.rotation, np.eye(3))
        left, _, right = np.linalg.svd(rotation)
        exact = left @ right
        off = np.abs(exact - rotation).reshape(len(exact), -1).max(axis=1)
        note(
            (off > SKEW) | (np.linalg.det(exact) < 0),
            lambda _: "rotation: its columns are no rotation, expected a rigid pose",
        )
        whole = np.array([row not in found for row in self.rows])
        object.__setattr__(self, "rotation", np.where(whole[:, None, None], exact, np.eye(3)))
        for name in ("position", "joints"):
            object.__setattr__(self, name, np.where(whole[:, None], getattr(self, name), 0.0))
        return found

    def _fail(self, problem: str) -> NoReturn:
        raise DescriptionError(f"{self.where}: {problem}")

    @property
    def poses(self) -> Array:
        """(k, 4, 4)."""
        poses = np.tile(np.eye(4), (len(self.position), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = self.rotation, self.position
        return poses


def of_fixed_axes(angles: Array) -> Array:
    """(k, 3, 3) rotations about fixed axes by (k, 3) roll, pitch, yaw [rad], as URDF has them."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(angles).T, np.cos(angles).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def of_two_columns(columns: Array) -> Array:
    """(k, 3, 3) rotations of (k, 6) two columns, from whose right angle both are as far as before.

    Their sum and their difference are at a right angle whatever they are. Columns that are none, or
    the same, become NaN. After `robust_compute_rotation_matrix_from_ortho6d` of GenDexGrasp.
    """

    def unit(vectors: Array) -> Array:
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    with np.errstate(invalid="ignore", divide="ignore"):
        first, second = unit(columns[:, :3]), unit(columns[:, 3:])
        middle, across = unit(first + second), unit(first - second)
        first, second = unit(middle + across), unit(middle - across)
    return np.stack([first, second, np.cross(first, second)], axis=2)
