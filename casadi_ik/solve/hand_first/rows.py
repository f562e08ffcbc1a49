"""Entry points of the loop of hand-first for parts of a search.

Diagnoses, alternatives and the collision-free search fit single hand postures, refine
configurations, or carry palms to given poses. The functions return states and parameters of the
loop for `HandSearch.run_rows`; the bounds, tolerances and weights in the parameters may be changed
before.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.compile.layout import Layout
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.search import ARM_SEARCH
from casadi_ik.kinematics.contact_fit import initial_lm_state
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.hand_first.state import Stage
from casadi_ik.solve.method import HandSearch


def hand_rows(
    method: HandSearch,
    targets: TargetBatch,
    postures: Array,
    palm_numbers: ArrayLike = 0.0,
) -> tuple[Array, Array]:
    """Return states and parameters of solves that try a single hand posture each.

    Args:
        method: The method.
        targets: k targets.
        postures: (k, hand) hand postures [rad or m].
        palm_numbers: (k,) numbers that select the palm pose where contacts leave the palm free.
    """
    states, parameters = method.rows(targets, postures[:, None], skip_q0=True)
    last = method.options.candidates - 1
    fields: dict[str, ArrayLike] = {"candidate": last, "palm_number": palm_numbers}
    if method.robot.sides:
        # Each side has a single seed, its part of the posture.
        fields["first_candidate"] = last
    _assign(method.step.layouts.state, states, fields)
    return states, parameters


def fit_hands_again(method: HandSearch, states: Array) -> None:
    """Let states of solves that ended with a hand fit continue it."""
    _assign(method.step.layouts.state, states, {"phase": Stage.HAND_FIT} | initial_lm_state())


def refinement_rows(method: HandSearch, targets: TargetBatch, q: Array) -> tuple[Array, Array]:
    """Return states and parameters of solves that refine all motors from q (k, n)."""
    hand = np.zeros((len(targets), len(method.robot.hand_actuators)))
    states, parameters = hand_rows(method, targets.starting_at(q), hand)
    start_refinement(method, states, q)
    return states, parameters


def start_refinement(method: HandSearch, states: Array, q: Array) -> None:
    """Let states refine all motors from q (k, n)."""
    fields = {"phase": Stage.REFINEMENT, "q": q, "best_q": q} | initial_lm_state()
    _assign(method.step.layouts.state, states, fields)


def palm_rows(
    method: HandSearch, targets: TargetBatch, q: Array, palms: Array, places_arms: ArrayLike
) -> tuple[Array, Array]:
    """Return states and parameters of solves that only carry the palms of a multi-arm robot.

    Trunk and arms move from q until the palms have the given poses. If the poses are not reached,
    all motors are refined from there, because the contacts may still be within tolerance.

    Args:
        method: The method.
        targets: k targets.
        q: (k, n) start configurations with the hand postures [rad or m].
        palms: (k, s, 4, 4) palm poses that meet the contacts with these postures.
        places_arms: (k,) whether the arms are placed in closed form instead, with the trunk of q;
            a solve ends at q if some arm does not reach its palm pose.
    """
    hands = q[:, list(method.robot.hand_actuators)]
    states, parameters = hand_rows(method, targets.starting_at(q), hands)
    first_stages = np.where(places_arms, float(Stage.ARM_PLACEMENT), float(Stage.TRUNK))
    fields: dict[str, ArrayLike] = {
        "q": q,
        "best_q": q,
        "phase": first_stages,
        "meets_contacts": 1.0,
        "arm_margin": ARM_SEARCH.no_margin,
    }
    for side in range(len(method.robot.sides)):
        fields[f"palm_rotation_{side}"] = palms[:, side, :3, :3].reshape(-1, 9)
        fields[f"palm_origin_{side}"] = palms[:, side, :3, 3]
    _assign(method.step.layouts.state, states, fields)
    _assign(method.step.layouts.parameters, parameters, {"palms_only": 1.0})
    return states, parameters


def _assign(layout: Layout, rows: Array, fields: Mapping[str, ArrayLike]) -> None:
    """Set fields of rows (k, size), each to a number, to (k,) numbers or to (k, m) rows."""
    for name, value in fields.items():
        values = np.asarray(value, dtype=float)
        rows[:, layout.slice(name)] = values[:, None] if values.ndim == 1 else values
