"""Candidates that were read, and what became of the rows of their file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, overload

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.errors import DescriptionError
from casadi_ik.grasps import Grasp

Invalid = Literal["error", "drop", "clip"]
"""What becomes of a row that the hand cannot take."""

INVALIDS = ("error", "drop", "clip")

NOTICED = 1e-4
"""A fingertip that was shifted less than this [m] counts as where it was."""


@dataclass(frozen=True, eq=False)
class Candidates(Sequence[Grasp]):
    """Grasps of a file, in its order; itself a sequence of them.

    Attributes:
        grasps: The grasps.
        rows: (k,) their numbers in the file.
        dropped: How many rows of the file were left out, as they are invalid.
        clipped: How many have a joint that was beyond its limits, and is at them now.
        shift: (k,) how far the fingertip that is moved farthest is from where the file has it [m],
            in the frame of the palm: by clipping, or since joints are coupled that are free in the
            data.
        scale: By what factor the object is larger than its mesh; None: the file does not say.

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
    def __getitem__(self, place: int) -> Grasp: ...

    @overload
    def __getitem__(self, place: slice) -> tuple[Grasp, ...]: ...

    def __getitem__(self, place: int | slice) -> Grasp | tuple[Grasp, ...]:
        return self.grasps[place]

    @property
    def notes(self) -> tuple[str, ...]:
        """What became of rows that could not be taken as they are, in short lines."""
        whole, found = len(self) + self.dropped, []
        if self.dropped:
            found.append(f"{self.dropped} of {whole} rows left out: invalid")
        if self.clipped:
            found.append(f"{self.clipped} of {whole} rows have joints put at their limits")
        moved = 1e3 * self.shift[self.shift > NOTICED]
        if len(moved):
            found.append(
                f"fingertips of {len(moved)} candidates shifted, as the hand's joints are limited "
                f"and coupled: median {np.median(moved):.1f} mm, at most {moved.max():.1f} mm"
            )
        return tuple(found)

    def __str__(self) -> str:
        size = "" if self.scale is None else f" of an object of scale {self.scale:g}"
        return "\n".join([f"{len(self)} candidates{size}", *(f"  {note}" for note in self.notes)])


def kept_rows(
    where: str,
    rows: Sequence[int],
    faults: Mapping[int, str],
    beyond: Mapping[int, str],
    invalid: Invalid,
) -> NDArray[np.intp]:
    """Places of the rows that are taken.

    Args:
        where: File, for messages.
        rows: Their numbers in the file.
        faults: What is wrong with a row, by its number.
        beyond: What is beyond its limits in a row, by its number.
        invalid: What becomes of these: "clip" takes rows that are beyond limits only.

    Raises:
        DescriptionError: There are invalid rows that are not to be left out, or none is left.
    """
    bad = {**({} if invalid == "clip" else beyond), **faults}
    if bad and (invalid != "drop" or len(bad) == len(rows)):
        first = min(bad)
        clips = invalid == "error" and set(beyond) - set(faults)
        more = ", 'clip' puts joints at their limits" if clips else ""
        wayout = f"; invalid='drop' leaves such rows out{more} (--invalid)"
        raise DescriptionError(
            f"{where}: row {first}: {bad[first]}; {len(bad)} of {len(rows)} rows are invalid"
            f"{'' if invalid == 'drop' else wayout}"
        )
    return np.array([i for i, row in enumerate(rows) if row not in bad], dtype=np.intp)
