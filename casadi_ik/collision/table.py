"""Which distances are asked for, as arrays: capsules of a robot, solids of a scene, their pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.collision.scene import Item
from casadi_ik.collision.solids import Solid


@dataclass(frozen=True, eq=False)
class Table:
    """What a distance kernel works on.

    Attributes:
        radii: (s,) radii of the robot's capsules [m].
        halves: (s,) half lengths of their segments [m].
        pairs: (p, 2) a capsule; another, or s + a solid.
        own: How many solids are the robot's own; they come first.
        offsets: (p,) how much farther than the scene's margin a pair has to be apart [m].
        solids: The solids.
        places: Pose (4, 4) of every other solid in its item's frame.
        items: Name of the item of every other solid.
        names: (p, 2) what each pair is called: links, or a link and an item.
        moving: Links that an arm may move while its palm stays.
        margins: (p,) what each pair has to be apart, beyond what its shapes may overlap [m].
    """

    radii: Array
    halves: Array
    pairs: NDArray[np.int32]
    offsets: Array
    own: int
    solids: tuple[Solid, ...]
    places: tuple[Array, ...]
    items: tuple[str, ...]
    names: tuple[tuple[str, str], ...]
    moving: frozenset[str] = frozenset()
    margins: Array = field(default_factory=lambda: np.zeros(0))
    _parted: dict[frozenset[str], tuple[Table, Table]] = field(
        default_factory=dict, init=False, repr=False
    )

    def poses(
        self, items: dict[str, Item], moved: str | None = None, to: Array | None = None
    ) -> Array:
        """(n, 12) rotation row by row and origin of every solid of a scene, or (k, n, 12).

        Args:
            items: Where things are, by name.
            moved: The item that is elsewhere in every row.
            to: (k, 4, 4) where it is.
        """
        found: list[Array] = []
        for place, name in zip(self.places, self.items, strict=True):
            pose = to if name == moved and to is not None else items[name].pose
            whole = pose @ place
            flat = np.concatenate(
                [whole[..., :3, :3].reshape(*whole.shape[:-2], 9), whole[..., :3, 3]], axis=-1
            )
            found.append(flat)
        if not found:
            return np.zeros((0, 12))
        return np.stack(np.broadcast_arrays(*found), axis=-2)

    @cached_property
    def for_driver(self) -> tuple[NDArray[np.void], Array]:
        """See `driver_rows`; made once."""
        return driver_rows(self.solids)

    @cached_property
    def held(self) -> Table:
        """The pairs whose distances follow from the hand and where its palm is."""
        return self.only(~self._swinging)

    @cached_property
    def swung(self) -> Table:
        """The pairs whose distances depend on the arm that holds the palm."""
        return self.only(self._swinging)

    @cached_property
    def of_robot(self) -> Table:
        """The pairs of the robot with itself."""
        return self.only(self._within)

    @cached_property
    def of_scene(self) -> Table:
        """The pairs of the robot with what stands about it."""
        return self.only(~self._within)

    def parted(self, links: frozenset[str]) -> tuple[Table, Table]:
        """The pairs that one of some links is in, and all others; worked out once."""
        if links not in self._parted:
            within = np.array([not links.isdisjoint(pair) for pair in self.names], dtype=bool)
            self._parted[links] = self.only(within), self.only(~within)
        return self._parted[links]

    @property
    def _swinging(self) -> NDArray[np.bool_]:
        return np.array([not self.moving.isdisjoint(pair) for pair in self.names], dtype=bool)

    @property
    def _within(self) -> NDArray[np.bool_]:
        return self.pairs[:, 1] < len(self.radii) + self.own

    def only(self, rows: NDArray[np.bool_]) -> Table:
        """The same with some of the pairs."""
        names = tuple(name for name, kept in zip(self.names, rows.tolist(), strict=True) if kept)
        return replace(
            self,
            pairs=np.ascontiguousarray(self.pairs[rows]),
            offsets=self.offsets[rows],
            names=names,
            margins=self.margins[rows],
        )


def driver_rows(solids: Sequence[Solid]) -> tuple[NDArray[np.void], Array]:
    """The solids (n, 7 of 8 bytes) and the planes (m, 4) as the driver has them."""
    form = np.dtype(
        [("kind", "<i8"), ("size", "<f8", 3), ("reach", "<f8"), ("first", "<i8"), ("planes", "<i8")]
    )
    rows = np.zeros(len(solids), dtype=form)
    first = 0
    for row, solid in zip(rows, solids, strict=True):
        row["kind"], row["size"], row["reach"] = int(solid.kind), solid.size, solid.reach
        row["first"], row["planes"] = first, len(solid.planes)
        first += len(solid.planes)
    return rows, np.concatenate([np.zeros((0, 4)), *(solid.planes for solid in solids)])
