"""Hands at solved configurations: their contacts, force closure and strength."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array
from casadi_ik.model.pose import inverse
from casadi_ik.planning.touch.candidates import Generator, fingertip_pads, tip_contacts
from casadi_ik.planning.touch.hands import HandCandidates
from casadi_ik.planning.touch.strength import (
    MIN_CLOSURE_LOAD,
    GraspStrengths,
    closure_load,
    friction_wrenches,
    grasp_strengths,
    narrowed_friction,
)

CLOSURE_FRICTION = float(np.cos(np.pi / 8))
"""Factor of the friction coefficient in tests of force closure.

Friction cones reduced by this factor lie within every pyramid of eight or more edges that is
inscribed in the full cones, so that tests with any such pyramid agree.
"""


def at_configurations(
    generator: Generator, hands: HandCandidates, q: Array, pose: Array
) -> HandCandidates:
    """Return the hands at solved configurations, with their contacts.

    Args:
        generator: Generator of the candidates.
        hands: Hands before the arm was solved; only `touches` is used.
        q: (k, n) solved configurations.
        pose: (4, 4) pose of the object in the base frame.
    """
    table = generator.table
    palm = inverse(pose) @ table.robot.palm(q)
    solved = replace(hands, palm=palm, hand=np.take(q, table.motors, axis=1), contacts=None)
    return replace(
        solved,
        tips=fingertip_pads(table, solved).points,
        contacts=tip_contacts(table, generator.surface, solved),
    )


def confirmed_rows(generator: Generator, hands: HandCandidates, mu: float) -> NDArray[np.intp]:
    """Return the rows of hands whose contacts meet the limits and are force-closed."""
    assert hands.contacts is not None
    is_accepted = hands.contacts.accepted(generator.parameters, generator.table.roll)
    rows = np.flatnonzero((is_accepted | ~hands.touches).all(axis=1))
    load = closure_load(contact_wrenches(generator, hands.rows(rows), CLOSURE_FRICTION * mu))
    return rows[load > MIN_CLOSURE_LOAD]


def values_of_contacts(hands: HandCandidates, values: Array) -> Array:
    """Return the values (k, c, ...) at contacts, from values (k, f, ...) by finger."""
    return values[hands.touches].reshape(len(hands), -1, *values.shape[2:])


def contact_wrenches(generator: Generator, hands: HandCandidates, mu: float) -> Array:
    """Return the wrenches (k, 6, g) of the edges of the friction cones of hands."""
    assert hands.contacts is not None
    surface, contacts = generator.surface, hands.contacts
    foot, inward, normal_spread = (
        values_of_contacts(hands, values)
        for values in (contacts.foot, contacts.inward, contacts.normal_spread)
    )
    return friction_wrenches(
        foot, inward, narrowed_friction(mu, normal_spread), surface.middle, surface.size / 2
    )


def hand_strengths(
    generator: Generator, hands: HandCandidates, mu: float, hold: tuple[float, float] | None
) -> GraspStrengths:
    """Return the strength of the grasps of hands."""
    assert hands.contacts is not None
    table, surface, robot = generator.table, generator.surface, generator.table.robot
    _, _, linear, angular = table.pads(hands.hand)
    foot, inward, direction = (
        values_of_contacts(hands, values)
        for values in (hands.contacts.foot, hands.contacts.inward, hands.contacts.direction)
    )
    radii = table.radii[np.nonzero(hands.touches)[1]].reshape(len(hands), -1)
    rotation = hands.palm[:, None, :3, :3]
    angular, linear = (rotation @ values_of_contacts(hands, values) for values in (angular, linear))
    # The contact of a ball pad is a radius away from its centre.
    jacobians = linear + np.cross(angular, (radii[..., None] * direction)[..., None], axis=2)
    return grasp_strengths(
        contact_wrenches(generator, hands, mu),
        foot - surface.middle,
        inward,
        radii,
        jacobians,
        [robot.description.actuators[i] for i in table.motors],
        mu,
        hold,
    )
