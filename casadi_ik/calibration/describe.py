"""A calibrated robot as a description: one YAML file with the hand's new numbers in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import yaml

from casadi_ik.calibration.estimate import Calibration
from casadi_ik.calibration.model import tilted
from casadi_ik.errors import InputError
from casadi_ik.files.reading import Frame, frame_matrix, read_yaml
from casadi_ik.files.shipped import resolve
from casadi_ik.robots.load import load_description
from casadi_ik.symbolic.couplings import joint_positions
from casadi_ik.symbolic.se3 import exp_so3, matrix_to_rpy

TAG = "calibration"
"""Source of the numbers that were estimated."""

GRID = 201
"""Positions per stroke at which a coupled joint's range is looked for."""

MARGIN = 1e-3
"""By which a widened joint limit lies beyond what the strokes allow [rad]."""


def write_description(
    calibration: Calibration, robot: str | Path, path: Path, origin: str = ""
) -> None:
    """Write the robot with its estimated numbers; the hand stands in the same file.

    A joint limit that the calibrated couplings pass within their actuator's stroke is widened to
    it, since such limits follow from the stroke.

    Args:
        calibration: The estimate.
        robot: The robot it was made for, a shipped name or a path.
        path: The file to write.
        origin: Where the data are from, for the list of sources.

    Raises:
        InputError: The robot's joints are not described in our own files.
        OSError: The file cannot be written.
    """
    top_path = resolve(robot, "arm_hands")
    top = read_yaml(top_path)
    if any(isinstance(part, dict) and "file" in part for part in top.values()):
        raise InputError(
            f"{top_path}: a calibrated robot is written joint by joint, but this one's joints are "
            "in files of others"
        )
    if isinstance(top["hand"], str):
        top["hand"] = read_yaml(resolve(top["hand"], "hands", beside=top_path))
    if top.get("arm") is not None and Path(top["arm"]).suffix:
        top["arm"] = str(resolve(top["arm"], "arms", beside=top_path).resolve())
    hand = top["hand"]
    hand["sources"][TAG] = (
        f"Estimated from {len(calibration.weights)} measured fingertip poses{origin and ' in '}"
        f"{origin}."
    )
    values = zip(calibration.parameters, calibration.values.tolist(), strict=True)
    by_owner: dict[tuple[str, str], dict[str, float]] = {}
    for parameter, value in values:
        by_owner.setdefault((parameter.owner, parameter.part), {})[parameter.key] = value
    joints = {joint["name"]: joint for joint in hand["joints"]}
    for (owner, part), numbers in by_owner.items():
        entry = joints[owner] if part in ("coupling", "origin", "axis") else hand["fingers"][owner]
        _PARTS[part](entry, numbers)
        if TAG not in entry["source"].split():
            entry["source"] += f" {TAG}"
    _write(top, path)
    _widen(joints, {owner for (owner, part) in by_owner if part == "coupling"}, path)
    _write(top, path)


def _coupling(entry: dict[str, Any], numbers: dict[str, float]) -> None:
    entry["coupling"] |= numbers


def _origin(entry: dict[str, Any], numbers: dict[str, float]) -> None:
    entry["origin"] = entry.get("origin", {}) | {"xyz": [numbers[key] for key in "xyz"]}


def _axis(entry: dict[str, Any], numbers: dict[str, float]) -> None:
    axis = np.asarray(entry["axis"], dtype=float)
    turned = tilted(axis / np.linalg.norm(axis), ca.DM([numbers["1"], numbers["2"]]))
    entry["axis"] = np.array(turned).ravel().tolist()


def _tip(entry: dict[str, Any], numbers: dict[str, float]) -> None:
    entry["xyz"] = [numbers[key] for key in "xyz"]


def _turn(entry: dict[str, Any], numbers: dict[str, float]) -> None:
    before = frame_matrix(Frame(rpy=tuple(entry.get("rpy", (0.0, 0.0, 0.0)))))[:3, :3]
    after = ca.DM(before) @ exp_so3(ca.DM([numbers[key] for key in "xyz"]))
    entry["rpy"] = np.array(matrix_to_rpy(after)).ravel().tolist()


_PARTS = {"coupling": _coupling, "origin": _origin, "axis": _axis, "tip": _tip, "turn": _turn}


def _widen(joints: dict[str, dict[str, Any]], names: set[str], path: Path) -> None:
    """Let the limits of some coupled joints include what their actuators' strokes allow."""
    robot = load_description(path)
    q = ca.SX.sym("q", len(robot.actuators))
    positions = ca.Function("joints", [q], [joint_positions(robot, q)])
    # A triangle or a four-bar hangs on one actuator, so all strokes can be gone through at once.
    strokes = np.linspace(*robot.strokes, GRID)
    ranges = np.array(positions(strokes.T))
    for joint, values in zip(robot.movable, ranges, strict=True):
        if joint.name in names and joint.coupling is not None and joint.coupling.slope is None:
            low, high = float(values.min()), float(values.max())
            joints[joint.name]["limits"] = [
                joint.lower if low >= joint.lower else low - MARGIN,
                joint.upper if high <= joint.upper else high + MARGIN,
            ]


def _write(data: dict[str, Any], path: Path) -> None:
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)
    path.write_text(text, encoding="utf-8")
