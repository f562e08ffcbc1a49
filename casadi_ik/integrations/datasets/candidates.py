"""A sequence of candidate grasps with notes on how they were read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import overload

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.files.lazy_import import RecordReprMixin
from casadi_ik.model.grasp import Grasp

MIN_REPORTED_SHIFT = 1e-4
"""Smallest shift of a fingertip that is reported [m]."""


@dataclass(frozen=True, eq=False, repr=False)
class Candidates(RecordReprMixin, Sequence[Grasp]):
    """A sequence of grasps in the order of their file.

    Attributes:
        grasps: The grasps.
        rows: (k,) row numbers in the file.
        dropped: Number of invalid rows that were dropped.
        clipped: Number of rows with a joint that was clipped to its limits.
        shift: (k,) largest shift of a fingertip against the file in the palm frame [m]: by
            clipping, or by couplings of joints that are independent in the data.
        scale: Scale of the object relative to its mesh; None if the file does not state it.

    Example:
        >>> points, normals = robot.contacts(robot.random(np.random.default_rng(2), 20))
        >>> np.savez("targets.npz", points=points, normals=normals)
        >>> candidates = ik.load_candidates("targets.npz", robot)
        >>> print(candidates)
        20 candidates
        >>> candidates.dropped, candidates.clipped, candidates[3].name
        (0, 0, 'targets[3]')
    """

    grasps: tuple[Grasp, ...]
    rows: tuple[int, ...] = ()
    dropped: int = 0
    clipped: int = 0
    shift: Array = field(default_factory=lambda: np.zeros(0))
    scale: float | None = None

    def __post_init__(self) -> None:
        count = len(self.grasps)
        object.__setattr__(self, "rows", self.rows or tuple(range(count)))
        if not len(self.shift):
            object.__setattr__(self, "shift", np.zeros(count))

    def __len__(self) -> int:
        return len(self.grasps)

    def __iter__(self) -> Iterator[Grasp]:
        return iter(self.grasps)

    @overload
    def __getitem__(self, index: int) -> Grasp: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[Grasp, ...]: ...

    def __getitem__(self, index: int | slice) -> Grasp | tuple[Grasp, ...]:
        return self.grasps[index]

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on dropped, clipped and shifted rows."""
        total, notes = len(self) + self.dropped, []
        if self.dropped:
            notes.append(f"{self.dropped} of {total} rows dropped: invalid")
        if self.clipped:
            notes.append(f"{self.clipped} of {total} rows have joints clipped to their limits")
        shifts = 1e3 * self.shift[self.shift > MIN_REPORTED_SHIFT]
        if len(shifts):
            notes.append(
                f"fingertips of {len(shifts)} candidates shifted, as the hand's joints are limited "
                f"and coupled: median {np.median(shifts):.1f} mm, at most {shifts.max():.1f} mm"
            )
        return tuple(notes)

    def __str__(self) -> str:
        size = "" if self.scale is None else f" of an object of scale {self.scale:g}"
        return "\n".join([f"{len(self)} candidates{size}", *(f"  {note}" for note in self.notes)])
