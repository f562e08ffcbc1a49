"""Which pairs of a robot and a scene are asked for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.collision.distances import nearest
from casadi_ik.collision.model import CollisionModel, own_solids
from casadi_ik.collision.scene import Scene
from casadi_ik.collision.table import Table
from casadi_ik.errors import DescriptionError


def pair_table(
    model: CollisionModel, scene: Scene, touched_by: Sequence[str], carried: bool = False
) -> Table:
    """The pairs of a robot and a scene.

    Args:
        model: The robot's shapes.
        scene: What stands about it.
        touched_by: Links that may touch what is grasped.
        carried: Whether what is grasped moves with the hand: then links that cannot move count.

    Raises:
        DescriptionError: The scene speaks of a link or a solid that is not there, or of one that
            stands in the robot's base.
    """
    links, known = model.links, set(model.robot.links) | set(scene.items)
    stated = {frozenset(one.links) for one in scene.touching}
    for key, named in (
        ("touching", [one.links for one in scene.touching]),
        ("margins", list(scene.margins)),
    ):
        for i, pair in enumerate(named):
            for name in sorted(set(pair) - known):
                raise DescriptionError(
                    f"{scene.name}: {key}[{i}].links: unknown {name!r}; known: "
                    + ", ".join([*scene.items, *model.robot.links])
                )
    solids, places, items = list(own_solids(model.robot)), [], []
    own = len(solids)
    pairs, offsets, margins, names = [], [], [], []
    count = len(model.capsules)
    for name, item in scene.items.items():
        usual = scene.margin if item.margin is None else item.margin
        for solid, place in item.parts:
            for i, link in enumerate(links):
                may = frozenset((link, name)) in stated
                # What cannot move is where it was put: no answer could change that.
                fixed = model.is_fixed(link) and not (carried and name == scene.grasped)
                if may or fixed or (name == scene.grasped and link in touched_by):
                    continue
                pairs.append((i, count + len(solids)))
                margin = scene.margins.get(frozenset((link, name)), usual)
                offsets.append(margin - scene.margin)
                margins.append(margin)
                names.append((link, name))
            solids.append(solid)
            places.append(place)
            items.append(name)
    for (i, j), offset in zip(model.pairs.tolist(), model.offsets.tolist(), strict=True):
        both = model.names(i, j)
        if frozenset(both) not in stated:
            margin = scene.margins.get(frozenset(both), scene.margin)
            pairs.append((i, j))
            offsets.append(offset + (margin - scene.margin))
            margins.append(margin)
            names.append(both)
    return Table(
        model.radii,
        model.halves,
        np.array(pairs, dtype=np.int32).reshape(-1, 2),
        np.array(offsets, dtype=float),
        own,
        tuple(solids),
        tuple(places),
        tuple(items),
        tuple(names),
        margins=np.array(margins, dtype=float),
        moving=model.moving,
    )


def check_base(model: CollisionModel, scene: Scene, placed: Array) -> None:
    """Refuse a scene with something in the robot's base: all would be in collision.

    A base's shapes are larger than the base, so that a table under it may touch them; what is
    deeper than a shape's radius is meant by nobody.

    Args:
        model: The robot's shapes.
        scene: The scene.
        placed: Where the shapes are, as `collision.model.placed` gives it.

    Raises:
        DescriptionError: The middle line of a shape of the base is inside a solid.
    """
    stated = {frozenset(one.links) for one in scene.touching}
    base = [i for i, link in enumerate(model.links) if model.is_fixed(link)]
    for name, item in scene.items.items():
        for i in base:
            if frozenset((model.links[i], name)) in stated:
                continue
            parts = item.parts
            pairs = [(i, len(model.links) + k) for k in range(len(parts))]
            table = Table(
                np.zeros(len(model.links)),
                model.halves,
                np.array(pairs, dtype=np.int32),
                np.zeros(len(pairs)),
                0,
                tuple(solid for solid, _ in parts),
                tuple(place for _, place in parts),
                (name,) * len(parts),
                ((model.links[i], name),) * len(parts),
            )
            depth = -float(nearest(placed[None], table.poses(scene.items), table).distance.min())
            if depth > 0:
                raise DescriptionError(
                    f"{scene.name}: solids.{name}: stands {1e3 * depth:.1f} mm inside "
                    f"{model.links[i]!r}, which cannot move; expected it beside the robot's base "
                    "(or the two under 'touching')"
                )
