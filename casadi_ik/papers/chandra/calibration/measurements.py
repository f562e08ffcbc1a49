"""Measured fingertip poses from CSV files and arrays, and simulated ones with outliers."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile import FunctionKernel
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import checked_quaternion
from casadi_ik.files.renamed_modules import warn_renamed
from casadi_ik.kinematics import dual_quaternion as dq
from casadi_ik.kinematics.screws import finger_chain
from casadi_ik.model.description import RobotDescription
from casadi_ik.papers.chandra.calibration.model import HandModel

POINT_COLUMNS = ("x", "y", "z")
"""Columns of the contact point."""

QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
"""Columns of the orientation of the contact frame."""

STROKE_SLACK = 1e-3
"""Largest violation of the limits by a reading, relative to the range of the actuator."""


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measured fingertip poses at known actuator positions.

    Attributes:
        fingers: (m,) name of the finger of each row.
        q: (m, n) actuator positions; home for actuators that do not move the finger [rad or m].
        poses: (m, 8) unit dual quaternions of the contact frames in the base frame.
        has_orientation: (m,) True if the orientation was also measured.
    """

    fingers: tuple[str, ...]
    q: Array
    poses: Array
    has_orientation: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.fingers)

    @property
    def turned(self) -> NDArray[np.bool_]:
        """Deprecated name of `has_orientation`."""
        warn_renamed("Measurements.turned", "Measurements.has_orientation")
        return self.has_orientation

    @property
    def measured_fingers(self) -> tuple[str, ...]:
        """Names of the measured fingers, without duplicates."""
        return tuple(dict.fromkeys(self.fingers))

    def rows(self, finger: str) -> NDArray[np.intp]:
        """Return the indices of the rows of a finger."""
        return np.flatnonzero([name == finger for name in self.fingers])


def read_measurements(path: Path, robot: RobotDescription) -> Measurements:
    """Read a CSV file.

    The header names the columns: ``finger``, the actuators that move the measured fingers [rad or
    m], ``x, y, z`` [m] of the contact point and, if the orientation was measured, the contact
    frame's unit quaternion ``qw, qx, qy, qz``; all in the robot's base frame. The quaternion may be
    left empty in a row.

    Args:
        path: The file.
        robot: Description of the measured robot.

    Raises:
        InputError: The file cannot be read or holds invalid values; the message names line and
            column.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            lines = [(i, row) for i, row in enumerate(csv.reader(stream, strict=True), 1) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else f"not CSV text: {error}"
        raise InputError(f"{path}: cannot be read: {reason}") from error
    if len(lines) < 2:
        raise InputError(f"{path}: holds no measurements, expected a header and rows")
    header = [name.strip() for name in lines[0][1]]
    _check_header(header, robot, path)
    moving = {name: finger_chain(robot, name).actuators for name in robot.finger_names}
    rows = [_row(line, header, cells, robot, moving, path) for line, cells in lines[1:]]
    return Measurements(
        tuple(row[0] for row in rows),
        np.array([row[1] for row in rows]),
        np.array([row[2] for row in rows]),
        np.array([row[3] for row in rows]),
    )


def write_measurements(measurements: Measurements, robot: RobotDescription, path: Path) -> None:
    """Write a CSV file that `read_measurements` reads.

    Raises:
        OSError: The file cannot be written.
    """
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["finger", *robot.actuator_names, *POINT_COLUMNS, *QUATERNION_COLUMNS])
        rows = zip(
            measurements.fingers,
            measurements.q,
            measurements.poses,
            measurements.has_orientation,
            strict=True,
        )
        for finger, q, pose, has_orientation in rows:
            point = np.array(dq.translation(ca.DM(pose))).ravel()
            quaternion = pose[:4].tolist() if has_orientation else [""] * 4
            writer.writerow([finger, *q.tolist(), *point.tolist(), *quaternion])


def _check_header(header: Sequence[str], robot: RobotDescription, path: Path) -> None:
    """Check the names of the columns.

    Raises:
        InputError: A column is unknown, missing or given twice.
    """
    columns = ("finger", *POINT_COLUMNS, *QUATERNION_COLUMNS, *robot.actuator_names)
    for name in header:
        if name not in columns:
            raise InputError(f"{path}:1: column {name!r} is unknown; expected {', '.join(columns)}")
        if header.count(name) > 1:
            raise InputError(f"{path}:1: column {name!r} appears twice")
    for name in ("finger", *POINT_COLUMNS):
        if name not in header:
            raise InputError(f"{path}:1: column {name!r} is missing")
    quaternion = [name for name in QUATERNION_COLUMNS if name in header]
    if quaternion and len(quaternion) < 4:
        raise InputError(
            f"{path}:1: found {', '.join(quaternion)}, expected all or none of qw,qx,qy,qz"
        )


def _row(
    line: int,
    header: Sequence[str],
    cells: Sequence[str],
    robot: RobotDescription,
    moving: Mapping[str, tuple[int, ...]],
    path: Path,
) -> tuple[str, Array, Array, bool]:
    """Return finger, q, pose, and True if the row has an orientation.

    Raises:
        InputError: A cell is missing or invalid.
    """
    if len(cells) != len(header):
        raise InputError(f"{path}:{line}: found {len(cells)} columns, expected {len(header)}")
    row = {name: cell.strip() for name, cell in zip(header, cells, strict=True)}
    finger = row["finger"]
    if finger not in robot.finger_names:
        raise InputError(
            f"{path}:{line}: finger: found {finger!r}, expected one of "
            + ", ".join(robot.finger_names)
        )

    def number(column: str) -> float:
        try:
            value = float(row[column])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(
                f"{path}:{line}: {column}: found {row[column]!r}, expected a finite number"
            )
        return value

    q = robot.home.copy()
    for index in moving[finger]:
        actuator = robot.actuators[index]
        if actuator.name not in row:
            raise InputError(f"{path}:1: column {actuator.name!r} is missing; it moves {finger!r}")
        value, slack = number(actuator.name), STROKE_SLACK * (actuator.upper - actuator.lower)
        if not actuator.lower - slack <= value <= actuator.upper + slack:
            raise InputError(
                f"{path}:{line}: {actuator.name}: found {value:g}, expected within "
                f"[{actuator.lower:g}, {actuator.upper:g}] {actuator.unit}"
            )
        q[index] = value
    point = np.array([number(column) for column in POINT_COLUMNS])
    has_orientation = any(row.get(column) for column in QUATERNION_COLUMNS)
    quaternion = np.array([1.0, 0, 0, 0])
    if has_orientation:
        quaternion = np.array([number(column) for column in QUATERNION_COLUMNS])
    unit = checked_quaternion(quaternion, f"{path}:{line}: qw..qz")
    pose = dq.from_quaternion(ca.DM(unit), ca.DM(point))
    return finger, q, np.array(pose).ravel(), has_orientation


def true_values(model: HandModel, rng: np.random.Generator) -> Array:
    """Draw parameters (k,) of a hand from the priors of its description.

    Args:
        model: The model; deviations are normal and clipped at 2.5 standard deviations.
        rng: Random number generator.
    """
    deviations = np.clip(rng.standard_normal(len(model.prior)), -2.5, 2.5)
    return model.nominal + model.prior * deviations


def simulate(
    model: HandModel,
    values: Array,
    finger: str,
    count: int,
    rng: np.random.Generator,
    *,
    noise: tuple[float, float] = (2e-4, np.deg2rad(0.5)),
    outliers: float = 0.0,
    factor: float = 20.0,
) -> Measurements:
    """Simulate noisy measurements of a fingertip at random actuator positions.

    Args:
        model: The model.
        values: (k,) true parameters.
        finger: Name of the measured finger.
        count: Number of poses.
        rng: Random number generator.
        noise: Standard deviations of a coordinate [m] and of an angle [rad].
        outliers: Fraction of the poses whose noise is multiplied by `factor`.
        factor: Factor of the noise of outliers.
    """
    robot = model.robot
    columns = list(finger_chain(robot, finger).actuators)
    q = np.tile(robot.home, (count, 1))
    q[:, columns] = rng.uniform(robot.lower[columns], robot.upper[columns], (count, len(columns)))
    scale = np.where(rng.random(count) < outliers, factor, 1.0)[:, None]
    shifts = noise[0] * scale * rng.standard_normal((count, 3))
    rotations = noise[1] * scale * rng.standard_normal((count, 3))
    (poses,) = _displaced()(model.poses(finger, q, values), rotations, shifts)
    return Measurements((finger,) * count, q, poses, np.ones(count, dtype=bool))


@cache
def _displaced() -> FunctionKernel:
    """Return a kernel that rotates a pose about its origin and translates it in the base frame."""
    pose, rotation, shift = ca.SX.sym("pose", 8), ca.SX.sym("turn", 3), ca.SX.sym("shift", 3)
    quaternion = dq.quaternion_multiply(dq.exp(rotation, ca.DM.zeros(3, 1))[:4], pose[:4])
    displaced = dq.from_quaternion(quaternion, dq.translation(pose) + shift)
    return FunctionKernel(ca.Function("displaced_pose", [pose, rotation, shift], [displaced]))
