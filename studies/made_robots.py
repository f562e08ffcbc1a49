"""Robots that no parameter of a method was chosen for: made up, of kinds that are not shipped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from casadi_ik.files.shipped import models_folder

Row = tuple[list[Any], list[Any], list[Any]]
"""Of a joint: place [m] and turn [rad] in the link before, limits."""

SEVEN_AXES: tuple[Row, ...] = (
    ([0, 0, 0.333], [0, 0, 0], [-2.9, 2.9]),
    ([0, 0, 0], ["-90 deg", 0, 0], [-1.76, 1.76]),
    ([0, -0.316, 0], ["90 deg", 0, 0], [-2.9, 2.9]),
    ([0.0825, 0, 0], ["90 deg", 0, 0], [-3.07, -0.07]),
    ([-0.0825, 0.384, 0], ["-90 deg", 0, 0], [-2.9, 2.9]),
    ([0, 0, 0], ["90 deg", 0, 0], [-0.02, 3.75]),
    ([0.088, 0, 0], ["90 deg", 0, 0], [-2.9, 2.9]),
)
"""Offset elbow and wrist: no closed form."""

SIX_AXES: tuple[Row, ...] = (
    ([0, 0, 0.16], [0, 0, 0], [-3.1, 3.1]),
    ([0, 0.13, 0], ["-90 deg", 0, 0], [-2.6, 2.6]),
    ([0.42, 0, -0.12], [0, 0, 0], [-2.8, 2.8]),
    ([0.39, 0, 0.1], [0, 0, 0], [-3.1, 3.1]),
    ([0, 0.1, 0], ["-90 deg", 0, 0], [-3.1, 3.1]),
    ([0, -0.09, 0], ["90 deg", 0, 0], [-3.1, 3.1]),
)
"""Three parallel axes amid it: no elbow to swing."""

FINGERS = {"first": 0.045, "second": 0.0, "third": -0.045}
"""Where the roots of the fingers stand across the palm [m]."""

MADE = ("seven_axes_four_fingers", "six_axes_coupled_barrett")


def made_robot(name: str, folder: Path) -> Path:
    """Write one of `MADE`; the path of its file."""
    folder.mkdir(parents=True, exist_ok=True)
    if name == MADE[0]:
        rows, flange, hand, thumb = SEVEN_AXES, 0.107, _four_fingers(), "thumb"
    else:
        path = models_folder() / "hands" / "barrett_bh8_280_coupled.yaml"
        rows, flange, hand = SIX_AXES, 0.08, yaml.safe_load(path.read_text(encoding="utf-8"))
        thumb = "thumb"
        for joint in hand["joints"]:
            if joint["name"].endswith("distal"):
                # Narrower than what the motor could do: limits of a follower count.
                joint["limits"] = ["4 deg", "40 deg"]
    whole = {"name": name, "arm": f"{name}_arm.yaml", "hand": hand, "thumb": thumb}
    whole["fingers"] = list(hand["fingers"])
    _write(folder / f"{name}_arm.yaml", _arm(rows, flange))
    _write(folder / f"{name}.yaml", whole)
    return folder / f"{name}.yaml"


def _arm(rows: tuple[Row, ...], flange: float) -> dict[str, Any]:
    links = ["arm_0", *(f"arm_{i}" for i in range(1, len(rows) + 1))]
    joints = [
        _joint(f"axis_{i + 1}", links[i], links[i + 1], [0, 0, 1], row)
        for i, row in enumerate(rows)
    ]
    tip = {"link": links[-1], "xyz": [0, 0, flange], "source": "made"}
    return {"name": "made_arm", "root": "arm_0", "tip": tip, "joints": joints} | _SOURCES


def _four_fingers() -> dict[str, Any]:
    """Sixteen motors: each finger turns about itself and bends three times."""
    joints: list[dict[str, Any]] = []
    fingers: dict[str, Any] = {}
    roots: dict[str, Row] = {
        name: ([0, across, 0.095], [0, 0, 0], [-0.47, 0.47]) for name, across in FINGERS.items()
    }
    roots["thumb"] = ([0, 0.02, 0.01], [0, "95 deg", "20 deg"], [0.26, 1.4])
    for name, root in roots.items():
        links = ["palm", *(f"{name}_{i}" for i in range(1, 5))]
        bends: list[Row] = [
            ([0, 0, 0.016], [0, 0, 0], [-0.19, 1.61]),
            ([0, 0, 0.054], [0, 0, 0], [-0.17, 1.7]),
            ([0, 0, 0.038], [0, 0, 0], [-0.22, 1.61]),
        ]
        axes = [[0, 0, 1] if name != "thumb" else [-1, 0, 0], *([[0, 1, 0]] * 3)]
        for i, (axis, row) in enumerate(zip(axes, [root, *bends], strict=True)):
            joints.append(_joint(f"{name}_joint_{i}", links[i], links[i + 1], axis, row))
        tip = {"link": links[-1], "xyz": [0.01, 0, 0.03], "normal": [1, 0, 0.3], "source": "made"}
        fingers[name] = tip
    palm = {"link": "palm", "xyz": [0.02, 0, 0.06], "source": "made"}
    hand = {"name": "four_fingers", "root": "palm", "palm": palm, "joints": joints}
    return hand | {"fingers": fingers} | _SOURCES


_SOURCES = {"sources": {"made": "made up for studies, after the dimensions of common robots"}}


def _joint(name: str, parent: str, child: str, axis: list[int], row: Row) -> dict[str, Any]:
    place, turn, limits = row
    origin = {"xyz": place, "rpy": turn}
    entry = {"name": name, "parent": parent, "child": child, "axis": axis, "origin": origin}
    return entry | {"limits": limits, "source": "made"}


def _write(path: Path, data: dict[str, Any]) -> None:
    part = path.with_suffix(".part")
    part.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    part.replace(path)
