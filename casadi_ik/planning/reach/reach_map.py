"""Reachability maps: verdicts about palm poses on a grid."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import InputError, UnsupportedError, os_errors
from casadi_ik.files.arrays import Array
from casadi_ik.files.renamed_modules import warn_renamed
from casadi_ik.files.writing import atomic_write
from casadi_ik.model.grasp import Tolerance
from casadi_ik.planning.reach.check import MAX_BOXES, JointChain, MapCheck
from casadi_ik.planning.reach.decide import (
    REACH_PARAMETERS,
    Meaning,
    Reachability,
)
from casadi_ik.solve.target_files import import_polars


@dataclass(frozen=True, eq=False, repr=False)
class ReachMap:
    """Verdicts about the palm poses of a grid: every position with every orientation.

    A map of an array of palm poses has one position per palm pose and no grid. In a map with
    contacts, object poses take the place of palm poses.

    Attributes:
        robot: Name of the robot.
        meaning: Meaning of the verdicts.
        positions: (g, 3) positions of the palm in the base frame [m].
        rotations: (m, 3, 3) orientations of the palm; (g, 3, 3) without a grid.
        shape: Numbers of positions along x, y and z; empty without a grid.
        code: (g, m) verdicts, see `Reachability`; (g, 1) without a grid.
        q: (g, m, a) arm positions that reach the palm pose [rad] (witnesses), or positions of all
            actuators with contacts; NaN unless REACHABLE; None if they are not kept.

    Example:
        >>> reach = solver.reach_map(([0.3, -0.2, 0.3], [0.7, 0.2, 0.5]), orientations=8)
        >>> reach.share.shape == (len(reach.positions),)
        True
    """

    robot: str
    meaning: Meaning
    positions: Array
    rotations: Array
    shape: tuple[int, ...]
    code: NDArray[np.int8]
    q: Array | None = None

    def __repr__(self) -> str:
        counts = ", ".join(f"{count:,} {name}" for name, count in self.counts.items())
        return f"<ReachMap of {self.robot}: {counts}, {self.meaning}>"

    @property
    def status(self) -> NDArray[np.str_]:
        """(g, m) verdicts by name."""
        return np.array([verdict.name for verdict in Reachability])[self.code]

    @property
    def counts(self) -> dict[str, int]:
        """Number of poses by verdict; COLLIDING only if there is such a pose."""
        numbers = np.bincount(self.code.ravel(), minlength=len(Reachability))
        counts = {verdict.name: int(numbers[verdict]) for verdict in Reachability}
        if not counts["COLLIDING"]:
            del counts["COLLIDING"]
        return counts

    @cached_property
    def share(self) -> Array:
        """(g,) share of the orientations that are reachable at each position."""
        return (self.code == Reachability.REACHABLE).mean(axis=1)

    @cached_property
    def open_share(self) -> Array:
        """(g,) share of the orientations that are open at each position."""
        return (self.code == Reachability.OPEN).mean(axis=1)

    def palms(self, position: int) -> Array:
        """Return the palm poses (m, 4, 4) of a position."""
        return grid_poses(self.positions, self.rotations, self.shape, slice(position, position + 1))

    def layer_shares(self, axis: str = "z", value: float | None = None) -> tuple[Array, Array]:
        """Return positions and shares of the layer of the grid nearest to a coordinate.

        Args:
            axis: "x", "y" or "z".
            value: Coordinate [m]; None: the middle of the grid.

        Returns:
            Positions (r, c, 3) [m] and shares (r, c) of the reachable orientations.

        Raises:
            InputError: The map has no grid, or the axis does not exist.
        """
        if not self.shape:
            raise InputError("layer_shares: the map has no grid; expected a map of a region")
        if axis not in ("x", "y", "z"):
            raise InputError(f"axis: found {axis!r}, expected x, y or z")
        number = "xyz".index(axis)
        positions = self.positions.reshape(*self.shape, 3)
        coordinates = np.moveaxis(positions, number, 0)[:, 0, 0, number]
        center = (coordinates[0] + coordinates[-1]) / 2
        layer = int(np.argmin(np.abs(coordinates - (center if value is None else value))))
        share = self.share.reshape(self.shape)
        return np.take(positions, layer, number), np.take(share, layer, number)

    def slice(self, axis: str = "z", value: float | None = None) -> tuple[Array, Array]:
        """Return `layer_shares`; deprecated name."""
        warn_renamed("ReachMap.slice", "ReachMap.layer_shares")
        return self.layer_shares(axis, value)

    def check(
        self, solver: Any, count: int = 20, seed: int = 0, max_boxes: int = MAX_BOXES
    ) -> MapCheck:
        """Check random cells by code that the map was not computed with.

        The check of an UNREACHABLE cell is a proof by another method, see
        `casadi_ik.planning.reach.check`. REACHABLE cells are checked by the forward kinematics of
        that module if the meaning is exact and the map has witnesses.

        Args:
            solver: Solver with the robot, the limits and the tolerances of the map.
            count: Largest number of UNREACHABLE and of REACHABLE cells.
            seed: Seed of the choice.
            max_boxes: Number of boxes of joint positions after which an UNREACHABLE cell is not
                confirmed.

        Raises:
            InputError: The map belongs to another robot.
            UnsupportedError: The arm has a joint that is not revolute or has no motor, or the map
                is one of object poses.
        """
        robot = solver.robot
        if self.meaning == Meaning.CONTACTS:
            raise UnsupportedError("check: the map is of object poses; expected one of palm poses")
        if robot.name != self.robot:
            raise InputError(f"solver: robot is {robot.name!r}; expected {self.robot!r}")
        chain = JointChain(robot.description, solver.limits == "enforce")
        rng = np.random.default_rng(seed)
        radius = rotation_radius = REACH_PARAMETERS.exact
        if self.meaning != Meaning.EXACT:
            tolerance = palm_tolerance(solver)
            radius += tolerance.position
            rotation_radius += 2 * np.sin(min(tolerance.angle, np.pi) / 2)
        unreachable = np.argwhere(self.code == Reachability.UNREACHABLE)
        unreachable = unreachable[rng.permutation(len(unreachable))[:count]]
        is_confirmed = [
            chain.is_refuted(self.palms(row)[column], radius, rotation_radius, max_boxes)
            for row, column in unreachable.tolist()
        ]
        reachable = np.argwhere(self.code == Reachability.REACHABLE)
        reachable = reachable[rng.permutation(len(reachable))[:count]]
        if self.q is None or self.meaning != Meaning.EXACT:
            reachable = reachable[:0]
        else:
            is_confirmed += [
                chain.is_reached(self.palms(row)[column], self.q[row, column], radius)
                for row, column in reachable.tolist()
            ]
        cells = np.concatenate([unreachable, reachable])
        return MapCheck(cells, self.status[tuple(cells.T)], np.array(is_confirmed, dtype=bool))

    def save(self, path: str | PathLike[str]) -> None:
        """Write the map as .npz.

        Raises:
            InputError: The file cannot be written.
        """
        arrays: dict[str, Any] = {
            "robot": self.robot,
            "meaning": str(self.meaning),
            "positions": self.positions,
            "rotations": self.rotations,
            "shape": np.array(self.shape, dtype=np.int64),
            "code": self.code,
            "verdicts": [verdict.name for verdict in Reachability],
        }
        if self.q is not None:
            arrays["q"] = self.q
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, **arrays)
        with os_errors(f"{path}: cannot be written", InputError), atomic_write(Path(path)) as part:
            part.write_bytes(buffer.getvalue())

    @classmethod
    def load(cls, path: str | PathLike[str]) -> ReachMap:
        """Read a map that `save` wrote.

        Raises:
            InputError: The file cannot be read or is not a map.
        """
        try:
            with np.load(path, allow_pickle=False) as arrays:
                return cls(
                    str(arrays["robot"]),
                    Meaning(str(arrays["meaning"])),
                    arrays["positions"],
                    arrays["rotations"],
                    tuple(arrays["shape"].tolist()),
                    arrays["code"],
                    arrays.get("q"),
                )
        except (OSError, KeyError, ValueError, TypeError) as error:
            raise InputError(f"{path}: is not a map: {error}; expected a file of `save`") from error

    def to_parquet(self, path: str | PathLike[str]) -> None:
        """Write a table with a row per palm pose.

        The columns are position, rotation matrix (r00 to r22), verdict and witness.

        Raises:
            MissingExtraError: Polars is not installed.
            InputError: The file cannot be written.
        """
        polars = import_polars()
        count = self.code.shape[1]
        columns: dict[str, Any] = {
            axis: np.repeat(self.positions[:, i], count) for i, axis in enumerate("xyz")
        }
        rotations = self.rotations
        if self.shape:
            rotations = np.tile(rotations, (len(self.positions), 1, 1))
        for i in range(3):
            for j in range(3):
                columns[f"r{i}{j}"] = rotations[:, i, j]
        columns["status"] = self.status.ravel()
        if self.q is not None:
            q = self.q.reshape(-1, self.q.shape[-1])
            columns |= {f"q{i}": q[:, i] for i in range(q.shape[1])}
        with os_errors(f"{path}: cannot be written", InputError), atomic_write(Path(path)) as part:
            polars.DataFrame(columns).write_parquet(part)

    def to_ply(self, path: str | PathLike[str]) -> None:
        """Write the positions that are reachable in some orientation as a point cloud (PLY).

        The property `share` is the share of the reachable orientations; the colour shows it from
        blue (few) to yellow (all).

        Raises:
            InputError: The file cannot be written.
        """
        rows = np.flatnonzero(self.share > 0)
        columns = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("share", "<f4")]
        columns += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
        vertices = np.zeros(len(rows), dtype=columns)
        share = self.share[rows]
        for i, axis in enumerate("xyz"):
            vertices[axis] = self.positions[rows, i]
        vertices["share"] = share
        colors = FEW + share[:, None] * (ALL - FEW)
        for i, name in enumerate(("red", "green", "blue")):
            vertices[name] = np.round(colors[:, i])
        names = {"<f4": "float", "u1": "uchar"}
        header = [
            "ply",
            "format binary_little_endian 1.0",
            f"element vertex {len(rows)}",
            *(f"property {names[kind]} {name}" for name, kind in columns),
            "end_header\n",
        ]
        with os_errors(f"{path}: cannot be written", InputError), atomic_write(Path(path)) as part:
            part.write_bytes("\n".join(header).encode() + vertices.tobytes())


FEW, ALL = np.array([52.0, 84.0, 168.0]), np.array([250.0, 209.0, 60.0])
"""Colours of positions with few and with all orientations reachable, RGB."""


def grid_poses(positions: Array, rotations: Array, shape: tuple[int, ...], rows: slice) -> Array:
    """Return the palm poses (k, 4, 4) of some positions."""
    selected = positions[rows]
    count = len(rotations) if shape else 1
    poses = np.zeros((len(selected), count, 4, 4))
    poses[:, :, :3, :3] = rotations if shape else rotations[rows][:, None]
    poses[:, :, :3, 3] = selected[:, None]
    poses[:, :, 3, 3] = 1
    return poses.reshape(-1, 4, 4)


def palm_tolerance(solver: Any) -> Tolerance:
    """Return the largest tolerance of any finger, which palm poses have."""
    tolerances = list(solver.tolerances.values()) or [Tolerance()]
    return Tolerance(
        max(item.position for item in tolerances), max(item.angle for item in tolerances)
    )
