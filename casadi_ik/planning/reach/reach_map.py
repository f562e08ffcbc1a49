"""Reachability maps: verdicts about palm poses on a grid."""

from __future__ import annotations

import io
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.errors import InputError, UnsupportedError, os_errors
from casadi_ik.files.arrays import Array, spread_points
from casadi_ik.files.input_checks.poses import checked_pose, checked_rotations
from casadi_ik.files.progress import progress
from casadi_ik.files.renamed_modules import warn_renamed
from casadi_ik.files.writing import atomic_write
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.arms.recognise import describe_arm
from casadi_ik.model.grasp import Tolerance
from casadi_ik.planning.reach.check import MAX_BOXES, JointChain, MapCheck
from casadi_ik.planning.reach.decide import (
    REACH_PARAMETERS,
    Meaning,
    PalmReach,
    Reachability,
    exact_family,
)
from casadi_ik.solve.target_files import import_polars

MAX_MEMORY = 2e9
"""Default of the memory that a map may take [bytes]."""


@dataclass(frozen=True, eq=False, repr=False)
class ReachMap:
    """Verdicts about the palm poses of a grid: every position with every orientation.

    A map of an array of palm poses has one position per palm pose and no grid.

    Attributes:
        robot: Name of the robot.
        meaning: Meaning of the verdicts.
        positions: (g, 3) positions of the palm in the base frame [m].
        rotations: (m, 3, 3) orientations of the palm; (g, 3, 3) without a grid.
        shape: Numbers of positions along x, y and z; empty without a grid.
        code: (g, m) verdicts, see `Reachability`; (g, 1) without a grid.
        q: (g, m, a) arm positions that reach the palm pose [rad] (witnesses), NaN unless
            REACHABLE; None if they are not kept.

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
        """Number of palm poses by verdict."""
        numbers = np.bincount(self.code.ravel(), minlength=len(Reachability))
        return {verdict.name: int(numbers[verdict]) for verdict in Reachability}

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
        return _poses(self.positions, self.rotations, self.shape, slice(position, position + 1))

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
            UnsupportedError: The arm has a joint that is not revolute or has no motor.
        """
        robot = solver.robot
        if robot.name != self.robot:
            raise InputError(f"solver: robot is {robot.name!r}; expected {self.robot!r}")
        chain = JointChain(robot.description, solver.limits == "enforce")
        rng = np.random.default_rng(seed)
        radius = rotation_radius = REACH_PARAMETERS.exact
        if self.meaning != Meaning.EXACT:
            tolerance = _palm_tolerance(solver)
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


def reach_map(
    solver: Any,
    region: ArrayLike | None = None,
    orientations: int | ArrayLike = 32,
    resolution: float = 0.05,
    meaning: str | None = None,
    keep_q: bool = True,
    jobs: int = 1,
    max_memory: float = MAX_MEMORY,
) -> ReachMap:
    """Return a map of the palm poses that the arm can reach.

    Every palm pose is REACHABLE (arm positions are found and checked by forward kinematics),
    UNREACHABLE (proved by interval bounds that are rounded outward) or OPEN (neither). Collisions
    are not considered.

    Args:
        solver: A `Solver`.
        region: Lower and upper corner (2, 3) of a box of palm positions [m], base frame; or palm
            poses (k, 4, 4). None: a box around the palms of random configurations.
        orientations: Number of orientations, which are spread evenly over all rotations; or
            rotations (m, 3, 3). Ignored for palm poses.
        resolution: Largest distance between neighbouring positions [m].
        meaning: "exact": verdicts hold for the palm pose itself, within 1e-10. "within tolerance":
            verdicts hold for poses within the tolerance of the solver, which is tried where the
            intervals decide nothing. None: "exact" for an arm with an exact closed form; for other
            arms "within tolerance, sampled": the solver is tried, and nothing is UNREACHABLE.
        keep_q: Whether to keep the witnesses.
        jobs: Number of threads.
        max_memory: Largest memory of the map [bytes].

    Raises:
        InputError: The region has no volume, the resolution would take more memory than allowed,
            or another argument has an invalid value.
        UnsupportedError: The robot has no arm or several arms, or "exact" is requested for an arm
            without an exact closed form.

    Example:
        >>> reach = solver.reach_map(([0.3, -0.2, 0.3], [0.7, 0.2, 0.5]), resolution=0.1)
        >>> reach.meaning, reach.counts["OPEN"]
        (<Meaning.EXACT: 'exact'>, 0)
    """
    robot = solver.robot
    description = robot.description
    description.require_single_hand("reach_map")
    if not description.arm_actuators:
        raise UnsupportedError(f"reach_map: {robot.name} has no arm; expected a robot with an arm")
    family = exact_family(robot)
    if meaning not in (None, Meaning.EXACT, Meaning.WITHIN_TOLERANCE):
        raise InputError(
            f"meaning: found {meaning!r}, "
            f"expected {Meaning.EXACT!s} or {Meaning.WITHIN_TOLERANCE!s}"
        )
    if family is None and meaning == Meaning.EXACT:
        raise UnsupportedError(
            f"meaning: {robot.name} has no exact closed form ({describe_arm(description)}); "
            f"expected {Meaning.WITHIN_TOLERANCE!s}"
        )
    if region is None:
        region = reachable_box(robot)
    kept_joints = len(description.arm_actuators) if keep_q else 0
    positions, rotations, shape = _cells(region, orientations, resolution, kept_joints, max_memory)
    count = len(rotations) if shape else 1
    code = np.zeros(len(positions) * count, dtype=np.int8)
    q = np.full((len(code), kept_joints), np.nan) if keep_q else None
    is_exact = family is not None and meaning != Meaning.WITHIN_TOLERANCE
    enforce_limits = solver.limits == "enforce"
    arm = None
    if family is not None:
        arm = PalmReach(robot, family, enforce_limits, solver._engine.compiled)
    tolerance = None if is_exact else _palm_tolerance(solver)
    step = max(REACH_PARAMETERS.chunk_size // count, 1)
    chunks = [slice(first, first + step) for first in range(0, len(positions), step)]

    def decide(rows: slice) -> None:
        palms = _poses(positions, rotations, shape, rows)
        cells = slice(rows.start * count, rows.start * count + len(palms))
        witnesses = np.full((len(palms), len(description.arm_actuators)), np.nan)
        if arm is not None:
            decision = arm.decide(palms, tolerance)
            code[cells], witnesses = decision.code, decision.q
        if not is_exact:
            undecided = np.flatnonzero(code[cells] == Reachability.OPEN)
            solved, arms = _solve(solver, palms[undecided])
            code[cells][undecided[solved]] = Reachability.REACHABLE
            witnesses[undecided[solved]] = arms
            if arm is not None and tolerance is not None:
                remaining = undecided[~solved]
                refuted = remaining[arm.refute_within(palms[remaining], tolerance)]
                code[cells][refuted] = Reachability.UNREACHABLE
        if q is not None:
            q[cells] = witnesses

    if arm is not None and chunks:
        decide(slice(0, 1))  # compiles the kernels before threads share them
    with progress(len(code)) as advance, ThreadPoolExecutor(max(jobs, 1)) as threads:
        for rows, _ in zip(chunks, threads.map(decide, chunks), strict=True):
            advance(min(rows.stop, len(positions)) * count - rows.start * count)
    kind = Meaning.EXACT if is_exact else Meaning.WITHIN_TOLERANCE
    return ReachMap(
        robot.name,
        Meaning.SAMPLED if family is None else kind,
        positions,
        rotations,
        shape,
        code.reshape(len(positions), count),
        None if q is None else q.reshape(len(positions), count, -1),
    )


def spread_rotations(count: int) -> Array:
    """Return rotations (count, 3, 3) that are spread evenly over all rotations (Shoemake 1992)."""
    u = spread_points(count, 3)
    angles = 2 * np.pi * u[:, 1:]
    a, b = np.sqrt(1 - u[:, 0]), np.sqrt(u[:, 0])
    x, y = a * np.sin(angles[:, 0]), a * np.cos(angles[:, 0])
    z, w = b * np.sin(angles[:, 1]), b * np.cos(angles[:, 1])
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def box_region(region: ArrayLike, name: str = "region") -> Array:
    """Return the corners (2, 3) of a box.

    Raises:
        InputError: The corners are not six finite numbers, or the box has no volume.
    """
    try:
        corners = np.asarray(region, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: is not an array of numbers: {error}; expected (2, 3)") from error
    if corners.shape != (2, 3) or not np.isfinite(corners).all():
        raise InputError(
            f"{name}: found shape {corners.shape}, expected two corners (2, 3) of finite numbers"
        )
    if not (corners[1] > corners[0]).all():
        size = (corners[1] - corners[0]).tolist()
        raise InputError(f"{name}: has no volume, its size is {size}; expected upper above lower")
    return corners


def reachable_box(robot: ArmHand) -> Array:
    """Return the corners (2, 3) of a box around the palms of random configurations [m]."""
    palms = robot.palm(robot.random(np.random.default_rng(0), 2000))[:, :3, 3]
    lower, upper = palms.min(axis=0), palms.max(axis=0)
    margin = 0.05 * (upper - lower) + 0.01
    return np.array([lower - margin, upper + margin])


def _cells(
    region: ArrayLike,
    orientations: int | ArrayLike,
    resolution: float,
    kept_joints: int,
    max_memory: float,
) -> tuple[Array, Array, tuple[int, ...]]:
    """Return positions, rotations and the shape of the grid, which is empty for palm poses."""
    if np.ndim(region) == 3 or (np.ndim(region) == 2 and np.shape(region) == (4, 4)):
        palms = checked_pose(region, "region").reshape(-1, 4, 4)
        _check_memory(len(palms), kept_joints, max_memory, "region")
        return palms[:, :3, 3].copy(), palms[:, :3, :3].copy(), ()
    corners = box_region(region)
    if not isinstance(resolution, int | float) or not 0 < resolution < np.inf:
        raise InputError(f"resolution: found {resolution!r}, expected a length > 0 [m]")
    if isinstance(orientations, int | np.integer):
        if orientations < 1:
            raise InputError(f"orientations: found {orientations}, expected a number >= 1")
        rotations = spread_rotations(min(int(orientations), 10**7))
    else:
        matrices = np.asarray(orientations, dtype=float)
        if matrices.ndim != 3 or matrices.shape[1:] != (3, 3) or not len(matrices):
            raise InputError(
                f"orientations: found shape {matrices.shape}, expected a number, or (m, 3, 3)"
            )
        rotations = checked_rotations(matrices, "orientations")
    counts = np.ceil((corners[1] - corners[0]) / resolution - 1e-9) + 1
    _check_memory(float(counts.prod()) * len(rotations), kept_joints, max_memory, "resolution")
    shape = tuple(int(count) for count in counts)
    axes = [np.linspace(low, high, count) for low, high, count in zip(*corners, shape, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid, rotations, shape


def _check_memory(cells: float, kept_joints: int, max_memory: float, name: str) -> None:
    memory = cells * (1 + 8 * kept_joints)  # a byte for a verdict, eight for a joint position
    if memory > max_memory:
        raise InputError(
            f"{name}: {cells:.3g} palm poses take {memory / 1e9:.3g} GB, expected at most "
            f"{max_memory / 1e9:.3g} GB (max_memory); a coarser resolution, fewer orientations"
            f"{' or keep_q=False' if kept_joints else ''} takes less"
        )


def _poses(positions: Array, rotations: Array, shape: tuple[int, ...], rows: slice) -> Array:
    """Return the palm poses (k, 4, 4) of some positions."""
    selected = positions[rows]
    count = len(rotations) if shape else 1
    poses = np.zeros((len(selected), count, 4, 4))
    poses[:, :, :3, :3] = rotations if shape else rotations[rows][:, None]
    poses[:, :, :3, 3] = selected[:, None]
    poses[:, :, 3, 3] = 1
    return poses.reshape(-1, 4, 4)


def _palm_tolerance(solver: Any) -> Tolerance:
    """Return the largest tolerance of any finger, which palm poses have."""
    tolerances = list(solver.tolerances.values()) or [Tolerance()]
    return Tolerance(
        max(item.position for item in tolerances), max(item.angle for item in tolerances)
    )


def _solve(solver: Any, palms: Array) -> tuple[NDArray[np.bool_], Array]:
    """Return (k,) whether the solver reaches palm poses, and the arms of those it reaches."""
    columns = list(solver.robot.description.arm_actuators)
    if not len(palms):
        return np.zeros(0, dtype=bool), np.zeros((0, len(columns)))
    batch = solver.solve_palms(palms, solver.robot.home)
    return batch.success, batch.q[batch.success][:, columns]
