"""Table I of Qiu & Kermani 2021: what the paper prints, methods, readings, every open choice."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from runner.study import Setting, Study, TargetSet
from samplers import grasp_arms

import casadi_ik as ik
from casadi_ik.errors import InputError
from casadi_ik.files.shipped import models_folder
from casadi_ik.solve.registry import option_names


@dataclass(frozen=True)
class Printed:
    """A cell of Table I.

    Attributes:
        success: Success rate [%] of 10,000 arm configurations.
        time: Mean time over solved cases [s] (MATLAB r2019b, i5-6400).
        iterations: Mean iterations over solved cases.
    """

    success: float
    time: float
    iterations: float


PRINTED = ("enhanced-sdls", "original-sdls", "enhanced-dls", "original-dls")


def _table_one() -> dict[str, dict[str, Printed]]:
    table: dict[str, dict[str, Printed]] = {}
    with (Path(__file__).parent / "qiu_table_one.csv").open(encoding="utf-8") as file:
        for name, method, *values in list(csv.reader(file))[1:]:
            table.setdefault(name, {})[method] = Printed(*map(float, values))
    return table


TABLE_I = _table_one()
"""By shipped grasp and method. Printed as "Can", `tomato_soup_can` is a guess: which of the YCB
cans it is the paper does not say. Time and iterations of its enhanced DLS are printed the wrong way
round (215.26 s, 0.6122 iterations)."""


def printed_mean(method: str) -> Printed:
    """Mean of a method's printed objects."""
    cells = [cells[method] for cells in TABLE_I.values()]
    count = len(cells)
    return Printed(
        sum(cell.success for cell in cells) / count,
        sum(cell.time for cell in cells) / count,
        sum(cell.iterations for cell in cells) / count,
    )


ROBOT = "kuka_lwr_barrett"
METHODS = tuple(
    name
    for name in (
        "enhanced-dls",
        "enhanced-sdls",
        "original-dls",
        "original-sdls",
        "thumb-first",
        "hand-first",
    )
    if name in ik.METHODS
)
LIMITS = ("ignore", "enforce")
CLOSED_FORM = {"finger_step": "closed-form"}
"""Root of eq. (5) for the enhanced methods; Ipopt agrees to 1e-9."""

PALM = {False: "", True: ", palm first"}
ORDER = {"per-finger": "finger by finger", "points-first": "points before normals"}

LAMBDA_150 = float(np.sqrt(150.0))
"""Damping if 150 is what stands in the normal matrix."""


def targets() -> tuple[TargetSet, ...]:
    """Return the twelve grasps."""
    return tuple(
        TargetSet(name, partial(grasp_arms, grasp=name)) for name in ik.shipped_grasps(ROBOT)
    )


def table_study(
    name: str,
    methods: Sequence[str],
    count: int,
    seed: int,
    block: int,
    changes: Mapping[str, Any] | None = None,
) -> Study:
    """Table I: methods with limits ignored and enforced.

    Args:
        name: Of the study.
        methods: Their names.
        count: Targets per grasp.
        seed: Of the targets.
        block: Targets per block.
        changes: Parameters that differ from their defaults, for every method that has them.

    Raises:
        InputError: No method has such a parameter.
    """
    options_of_methods = {method: _options_of(method, changes or {}) for method in methods}
    unused = set(changes or {}).difference(*options_of_methods.values())
    if methods and unused:
        raise InputError(
            f"--set: no method of {', '.join(methods)} has {', '.join(sorted(unused))}"
        )
    settings = tuple(
        Setting(
            f"{method} {limits}",
            method,
            limits,
            (CLOSED_FORM if method.startswith("enhanced") else {}) | options_of_methods[method],
        )
        for method in methods
        for limits in LIMITS
    )
    return Study(name, ROBOT, targets(), settings, count, seed, block)


def check_changes(methods: Sequence[str], changes: Mapping[str, Any]) -> None:
    """Refuse a parameter that none of the methods has.

    Raises:
        InputError: There is one.
    """
    unused = sorted(set(changes).difference(*map(option_names, methods)))
    if unused:
        raise InputError(f"--set: none of {', '.join(methods)} has {', '.join(unused)}")


def _options_of(method: str, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the changes for which a method has a parameter."""
    return {name: value for name, value in changes.items() if name in option_names(method)}


def readings_study(count: int, seed: int, block: int) -> Study:
    """Return all readings of "the methods without the enhancement", without limits."""
    settings = []
    for steps in ("dls", "sdls"):
        for name, options in _readings():
            if not (steps == "sdls" and options["projection"] == "stacked"):
                key = f"original-{steps}, {name}"
                settings.append(Setting(key, f"original-{steps}", "ignore", options))
    return Study("readings", ROBOT, targets(), tuple(settings), count, seed, block)


def _readings() -> Iterator[tuple[str, dict[str, object]]]:
    """Names and options; a sum or a stack has neither an order nor projectors."""
    for projection in ("successive", "augmented"):
        for projectors in ("exact", "damped"):
            for palm in (False, True):
                for order in ("per-finger", "points-first"):
                    name = f"{projection}, {projectors} projectors{PALM[palm]}, {ORDER[order]}"
                    yield (
                        name,
                        {
                            "projection": projection,
                            "projectors": projectors,
                            "palm_task": palm,
                            "order": order,
                        },
                    )
    for projection, name in (("stacked", "one stacked task"), ("none", "plain sum")):
        for palm in (False, True):
            yield f"{name}{PALM[palm]}", {"projection": projection, "palm_task": palm}


def ablation_study(folder: Path, count: int, seed: int, block: int) -> Study:
    """`enhanced-dls` and `enhanced-sdls` with one choice changed, limits ignored.

    Args:
        folder: Where the robot with the palm frame on the mounting face is written.
        count: Targets per grasp.
        seed: Of the targets.
        block: Targets per block.
    """
    both: dict[str, dict[str, object]] = {
        "as in the table": {},
        "errors by rotation vector, not Euler angles": {"palm_error": "rotation-vector"},
        "J_cc of the palm, not of link 6": {"platform": "palm"},
        "no arm joint counted to the thumb": {"borrowed": 0},
        "virtual joint's weight 1, not 10": {"virtual_weight": 1.0},
        "virtual joint's weight 100": {"virtual_weight": 100.0},
        "no palm-orientation task": {"palm_task": False},
        "no closed chain": {"closed_chain": False},
        "palm's position and orientation stacked": {"chain_tasks": "stacked"},
        "step cap 0.3 rad": {"step_cap": 0.3},
        "step cap 0.05 rad": {"step_cap": 0.05},
        "thumb reaching waits 3 iterations, not 10": {"reaching_patience": 3},
        "thumb reaching waits 50 iterations": {"reaching_patience": 50},
    }
    dls: dict[str, dict[str, object]] = {
        "lambda^2 = 150 in the closed chain": {"chain_damping": LAMBDA_150},
        "lambda = 50 in the closed chain": {"chain_damping": 50.0},
        "lambda = 450 in the closed chain": {"chain_damping": 450.0},
        "lambda = 0.1 in thumb reaching": {"reaching_damping": 0.1},
        "lambda = 10 in thumb reaching": {"reaching_damping": 10.0},
        "stacked, lambda 20, step cap 0.05 rad": {
            "chain_tasks": "stacked",
            "chain_damping": 20.0,
            "step_cap": 0.05,
        },
    }
    settings = [
        Setting(f"enhanced-{steps}, {name}", f"enhanced-{steps}", "ignore", CLOSED_FORM | change)
        for steps, changes in (("dls", both | dls), ("sdls", both))
        for name, change in changes.items()
    ]
    face = str(on_mounting_face(folder))
    for method in ("enhanced-dls", "enhanced-sdls"):
        settings += [
            Setting(
                f"{method}, hand start {proximal}-{distal} deg",
                method,
                "ignore",
                CLOSED_FORM,
                start=hand_start(proximal, distal),
            )
            for proximal, distal in ((40, 15), (60, 20), (75, 15), (120, 10))
        ]
        key = f"{method}, palm frame on the mounting face"
        settings.append(Setting(key, method, "ignore", CLOSED_FORM, robot=face))
    return Study("ablation", ROBOT, targets(), tuple(settings), count, seed, block)


def hand_start(proximal: float, distal: float) -> dict[str, float]:
    """Return a start with the given flexions of all fingers [deg] instead of 90 and 10."""
    return {
        f"bh_{finger}_{joint}": float(np.radians(value))
        for finger in ("thumb", "finger_2", "finger_3")
        for joint, value in (("proximal", proximal), ("distal", distal))
    }


def on_mounting_face(folder: Path) -> Path:
    """Write the robot whose palm frame sits where the hand is mounted; returns its file."""
    models = models_folder()
    hand = (models / "hands" / "barrett_bh8_280.yaml").read_text(encoding="utf-8")
    raised = "xyz: [0, 0, 80 mm], "
    if hand.count(raised) != 1:
        raise ValueError(f"the Barrett's palm frame is no longer given by {raised!r}")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "hand.yaml").write_text(hand.replace(raised, ""), encoding="utf-8")
    text = (models / "arm_hands" / f"{ROBOT}.yaml").read_text(encoding="utf-8")
    path = folder / f"{ROBOT}.yaml"
    path.write_text(text.replace("hand: barrett_bh8_280", "hand: hand.yaml"), encoding="utf-8")
    return path
