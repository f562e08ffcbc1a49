"""Fingers: chains of joints from the palm to a contact frame."""

from __future__ import annotations

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import DescriptionError
from casadi_ik.files.reading import Frame, Vector, frame_matrix
from casadi_ik.robots.checks import known_link, unique
from casadi_ik.robots.description import Finger, frozen
from casadi_ik.robots.flat import FlatJoints
from casadi_ik.robots.part import HandPart

ALONG = 0.995
"""Cosine with the normal above which the contact frame's x axis is no tangent."""


def the_fingers(
    names: list[str], thumb: str | None, hand: HandPart, flat: FlatJoints, where: str
) -> tuple[Finger, ...]:
    """The fingers that a robot uses.

    Args:
        names: Their names in order.
        thumb: The one placed first, if there is one.
        hand: The hand.
        flat: All joints of the robot.
        where: The robot's file, for messages.

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    unique(names, f"{where}: fingers")
    if not names:
        raise DescriptionError(f"{where}: fingers: found none, expected at least one")
    asked = [("fingers", name) for name in names]
    if thumb is not None:
        asked.append(("thumb", thumb))
    for key, name in asked:
        if name not in hand.pads:
            raise DescriptionError(
                f"{where}: {key}: {hand.name} has no finger {name!r}; it has "
                + ", ".join(hand.pads)
            )
    if thumb is not None and thumb not in names:
        raise DescriptionError(f"{where}: thumb: {thumb!r} is not among the fingers")
    return tuple(_finger(name, hand, flat) for name in names)


def _finger(name: str, hand: HandPart, flat: FlatJoints) -> Finger:
    entry = hand.pads[name]
    where = f"{hand.where}: fingers.{name}"
    link = known_link(entry.link, hand.root, hand.joints, f"{where}.link")
    length = float(np.linalg.norm(entry.normal))
    if not length > 1e-9:
        raise DescriptionError(f"{where}.normal: is zero, expected a direction")
    link, pose = flat.places[link]
    chain: list[str] = []
    by_child = {joint.child: joint for joint in flat.joints}
    while link in by_child and link not in (flat.places[hand.root][0], hand.tip_link):
        if by_child[link].type != "fixed":
            chain.append(by_child[link].name)
        link = by_child[link].parent
    if not chain and hand.actuators:
        raise DescriptionError(
            f"{where}.link: no joint moves {entry.link!r} against the palm {hand.tip_link!r}"
        )
    normal = np.asarray(entry.normal, dtype=float) / length
    return Finger(
        name,
        flat.places[entry.link][0],
        frozen(pose @ frame_matrix(Frame(entry.xyz, entry.rpy))),
        frozen(normal),
        tuple(chain[::-1]),
        frozen(_tangent(entry.tangent, normal, where)),
    )


def _tangent(given: Vector | None, normal: Array, where: str) -> Array:
    """The pad's second axis (3,): what is given, else x (y if the normal is along x)."""
    along = given
    if given is None:
        along = (1.0, 0.0, 0.0) if abs(normal[0]) < ALONG else (0.0, 1.0, 0.0)
    across = np.asarray(along, dtype=float)
    across = across - normal * (normal @ across)
    length = float(np.linalg.norm(across))
    if not length > 1e-3 * float(np.linalg.norm(np.asarray(along))):
        raise DescriptionError(
            f"{where}.tangent: found {list(along or ())}, expected a direction across the normal"
        )
    return across / length
