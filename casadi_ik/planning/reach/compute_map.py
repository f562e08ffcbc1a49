"""Computation of reachability maps: palm poses of an arm, or object poses of a grasp."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from copy import copy
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.collision.scene import Scene
from casadi_ik.errors import InputError, UnsupportedError
from casadi_ik.files.arrays import Array, Bools, spread_points
from casadi_ik.files.input_checks import checked_pose, checked_rotations
from casadi_ik.files.progress import progress
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.arms.recognise import describe_arm
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.pose import Free
from casadi_ik.planning.object_pose import place_targets
from casadi_ik.planning.reach.decide import (
    REACH_PARAMETERS,
    Meaning,
    PalmReach,
    Reachability,
    exact_family,
    reaches,
    with_home_hand,
)
from casadi_ik.planning.reach.reach_map import ReachMap, grid_poses, palm_tolerance
from casadi_ik.solve.engine import SolveOptions
from casadi_ik.solve.hand_postures import broadcast_postures
from casadi_ik.solve.status import Status

MAX_MEMORY = 2e9
"""Default of the memory that a map may take [bytes]."""

MAX_HAND_BOXES = 200
"""Maximum number of boxes of hand postures in the proof that an object pose is unreachable.

Ten times as many refute 3 % more object poses of a Barrett hand in three times the time.
"""


def reach_map(
    solver: Any,
    region: ArrayLike | None = None,
    orientations: int | ArrayLike = 32,
    resolution: float = 0.05,
    meaning: str | None = None,
    keep_q: bool = True,
    jobs: int = 1,
    max_memory: float = MAX_MEMORY,
    contacts: Grasp | None = None,
    scene: Scene | None = None,
) -> ReachMap:
    """Return a map of the palm poses, or of the object poses, that the robot can reach.

    Every palm pose is REACHABLE (arm positions are found and checked by forward kinematics),
    UNREACHABLE (proved by interval bounds that are rounded outward) or OPEN (neither). With a
    scene, a palm pose that is reached only in collision is COLLIDING.

    Args:
        solver: A `Solver`.
        region: Lower and upper corner (2, 3) of a box of palm positions [m], base frame; or palm
            poses (k, 4, 4). None: a box around the palms of random configurations. With
            `contacts`, these are the poses of the object.
        orientations: Number of orientations, which are spread evenly over all rotations; or
            rotations (m, 3, 3). Ignored for poses.
        resolution: Largest distance between neighbouring positions [m].
        meaning: "exact": verdicts hold for the palm pose itself, within 1e-10. "within tolerance":
            verdicts hold for poses within the tolerance of the solver, which is tried where the
            intervals decide nothing. None: "exact" for an arm with an exact closed form; for other
            arms "within tolerance, sampled": the solver is tried, and nothing is UNREACHABLE.
        keep_q: Whether to keep the witnesses.
        jobs: Number of threads.
        max_memory: Largest memory of the map [bytes].
        contacts: Grasp whose object is moved over the region; without an object pose, its contacts
            are in the frame of the object. The solver decides each pose of the object for arm and
            hand together, and proofs refute poses. None: the map is one of palm poses.
        scene: Obstacles, base frame. The witness of a REACHABLE pose is then free of collision,
            with the hand in its home posture if there are no `contacts`. None: the scene of the
            solver.

    Raises:
        InputError: The region has no volume, the resolution would take more memory than allowed,
            or another argument has an invalid value.
        UnsupportedError: The robot has no arm or several arms, "exact" is requested for an arm
            without an exact closed form, or a scene for a robot without shapes.

    Example:
        >>> reach = solver.reach_map(([0.3, -0.2, 0.3], [0.7, 0.2, 0.5]), resolution=0.1)
        >>> reach.meaning, reach.counts["OPEN"]
        (<Meaning.EXACT: 'exact'>, 0)
    """
    robot = solver.robot
    if scene is not None:
        solver = with_scene(solver, scene)
    decider: PoseDecider
    if contacts is None:
        decider = PalmDecider(solver, meaning)
    else:
        decider = ObjectDecider(solver, contacts, meaning)
    if region is None:
        region = reachable_box(robot)
    kept_joints = decider.joints if keep_q else 0
    positions, rotations, shape = _cells(region, orientations, resolution, kept_joints, max_memory)
    count = len(rotations) if shape else 1
    code = np.zeros(len(positions) * count, dtype=np.int8)
    q = np.full((len(code), kept_joints), np.nan) if keep_q else None
    step = max(REACH_PARAMETERS.chunk_size // count, 1)
    chunks = [slice(first, first + step) for first in range(0, len(positions), step)]

    def decide(rows: slice) -> None:
        poses = grid_poses(positions, rotations, shape, rows)
        cells = slice(rows.start * count, rows.start * count + len(poses))
        code[cells], witnesses = decider.decide(poses)
        if q is not None:
            q[cells] = witnesses

    if chunks:
        decide(slice(0, 1))  # compiles the kernels before threads share them
    with progress(len(code)) as advance, ThreadPoolExecutor(max(jobs, 1)) as threads:
        for rows, _ in zip(chunks, threads.map(decide, chunks), strict=True):
            advance(min(rows.stop, len(positions)) * count - rows.start * count)
    return ReachMap(
        robot.name,
        decider.meaning,
        positions,
        rotations,
        shape,
        code.reshape(len(positions), count),
        None if q is None else q.reshape(len(positions), count, -1),
    )


def with_scene(solver: Any, scene: Scene | None) -> Any:
    """Return the solver with another scene; None: without one.

    Raises:
        InputError: The scene is not a `Scene`.
        UnsupportedError: The robot has no shapes.
        DescriptionError: The scene does not fit the robot.
    """
    if solver.scene is scene:
        return solver
    return type(solver)(**{**solver._init_args, "scene": scene})


class PoseDecider(Protocol):
    """Decision of poses.

    Attributes:
        meaning: Meaning of the verdicts.
        joints: Number of joint positions of a witness.
    """

    meaning: Meaning
    joints: int

    def decide(self, poses: Array) -> tuple[NDArray[np.int8], Array]:
        """Return verdicts (k,) about poses (k, 4, 4), and witnesses (k, joints)."""
        ...


class PalmDecider:
    """Decision of palm poses by the closed form of the arm and by the solver."""

    def __init__(self, solver: Any, meaning: str | None = None) -> None:
        """Store the solver.

        Raises:
            InputError: The meaning is unknown.
            UnsupportedError: See `reach_map`.
        """
        robot = solver.robot
        robot.description.require_single_hand("reach_map")
        if not robot.description.arm_actuators:
            raise UnsupportedError(
                f"reach_map: {robot.name} has no arm; expected a robot with an arm"
            )
        family = exact_family(robot)
        if meaning not in (None, Meaning.EXACT, Meaning.WITHIN_TOLERANCE):
            raise InputError(
                f"meaning: found {meaning!r}, "
                f"expected {Meaning.EXACT!s} or {Meaning.WITHIN_TOLERANCE!s}"
            )
        if family is None and meaning == Meaning.EXACT:
            raise UnsupportedError(
                f"meaning: {robot.name} has no exact closed form "
                f"({describe_arm(robot.description)}); expected {Meaning.WITHIN_TOLERANCE!s}"
            )
        self._solver, self._plain_solver = solver, with_scene(solver, None)
        self._columns = list(robot.description.arm_actuators)
        self.joints = len(self._columns)
        self._arm: PalmReach | None = None
        if family is not None:
            enforce_limits = solver.limits == "enforce"
            self._arm = PalmReach(robot, family, enforce_limits, solver._engine.compiled)
        self._is_exact = family is not None and meaning != Meaning.WITHIN_TOLERANCE
        self._tolerance = None if self._is_exact else palm_tolerance(solver)
        kind = Meaning.EXACT if self._is_exact else Meaning.WITHIN_TOLERANCE
        self.meaning = Meaning.SAMPLED if family is None else kind

    def with_solver(self, solver: Any) -> PalmDecider:
        """Return the decision with a solver that differs in the poses of its obstacles."""
        decider = copy(self)
        decider._solver = solver
        return decider

    def decide(self, poses: Array) -> tuple[NDArray[np.int8], Array]:
        """Return verdicts (k,) about palm poses (k, 4, 4), and witnesses (k, joints) [rad]."""
        code = np.zeros(len(poses), dtype=np.int8)
        witnesses = np.full((len(poses), self.joints), np.nan)
        if self._arm is not None:
            decision = self._arm.decide(poses, self._tolerance)
            code, witnesses = decision.code, decision.q
        if self._tolerance is not None:
            undecided = np.flatnonzero(code == Reachability.OPEN)
            solved, arms = self._solve(self._plain_solver, poses[undecided])
            code[undecided[solved]] = Reachability.REACHABLE
            witnesses[undecided[solved]] = arms[solved]
            if self._arm is not None:
                remaining = undecided[~solved]
                is_refuted = self._arm.refute_within(poses[remaining], self._tolerance)
                code[remaining[is_refuted]] = Reachability.UNREACHABLE
        if self._solver.scene is not None:
            rows = np.flatnonzero(code == Reachability.REACHABLE)
            is_free, arms = self._without_collisions(poses[rows], witnesses[rows])
            code[rows[~is_free]] = Reachability.COLLIDING
            witnesses[rows] = np.where(is_free[:, None], arms, np.nan)
        return code, witnesses

    def _without_collisions(self, palms: Array, arms: Array) -> tuple[Bools, Array]:
        """Return (k,) True for palm poses with collision-free arms, and these arms (k, a).

        Witnesses in collision are replaced by those of the collision-free search, which reach the
        palm pose as exactly as the meaning requires.
        """
        solver, robot = self._solver, self._solver.robot
        if not len(palms):
            return np.zeros(0, dtype=bool), arms
        hands = broadcast_postures(robot, robot.home, len(palms))
        query = solver._engine.collision_query(solver._target_builder.from_palms(palms, hands))
        is_free = query.free(with_home_hand(robot, arms))
        rows = np.flatnonzero(~is_free)
        is_solved, free_arms = self._solve(solver, palms[rows])
        if self._is_exact and len(rows):
            rotation, origin = palms[rows, :3, :3], palms[rows, :3, 3]
            is_solved &= reaches(robot, free_arms, rotation, origin)
        arms = arms.copy()
        arms[rows[is_solved]] = free_arms[is_solved]
        is_free[rows[is_solved]] = True
        return is_free, arms

    def _solve(self, solver: Any, palms: Array) -> tuple[Bools, Array]:
        """Return (k,) True where the solver reaches palm poses, and the arms (k, a)."""
        is_solved = np.zeros(len(palms), dtype=bool)
        arms = np.full((len(palms), self.joints), np.nan)
        rows = np.arange(len(palms))
        if self._arm is None and len(rows):
            # The solver needs many restarts without a closed form: 100 times longer.
            rows = np.flatnonzero(~self._is_out_of_reach(solver, palms))
        if len(rows):
            batch = solver.solve_palms(palms[rows], solver.robot.home)
            is_solved[rows], arms[rows] = batch.success, batch.q[:, self._columns]
        return is_solved, arms

    def _is_out_of_reach(self, solver: Any, palms: Array) -> Bools:
        """Return (k,) True where the nearest configuration is far outside the tolerances."""
        hands = broadcast_postures(solver.robot, solver.robot.home, len(palms))
        targets = solver._target_builder.from_palms(palms, hands)
        engine = solver._engine.engine_for(targets)
        return engine.best_effort_run.is_out_of_reach(targets)


class ObjectDecider:
    """Decision of object poses at which arm and hand can take a grasp, by solver and proofs."""

    def __init__(self, solver: Any, contacts: Grasp, meaning: str | None = None) -> None:
        """Store the grasp.

        Raises:
            InputError: The grasp or the meaning is invalid.
        """
        if not isinstance(contacts, Grasp):
            raise InputError(f"contacts: found {contacts!r}, expected a Grasp")
        if isinstance(contacts.object_pose, Free):
            raise InputError(
                "contacts: the object pose is Free; expected a grasp in the object frame"
            )
        if meaning not in (None, Meaning.WITHIN_TOLERANCE):
            raise InputError(
                f"meaning: found {meaning!r}, expected {Meaning.WITHIN_TOLERANCE!s}, which all "
                "maps with contacts have"
            )
        self.meaning = Meaning.CONTACTS
        self.joints = len(solver.robot.actuators)
        self._solver = solver
        self._target = solver._target_builder.from_grasps([contacts.in_object_frame()])

    def decide(self, poses: Array) -> tuple[NDArray[np.int8], Array]:
        """Return verdicts (k,) about object poses (k, 4, 4), and witnesses (k, joints)."""
        engine = self._solver._engine
        targets = place_targets(self._target, poses)
        batch = self._solver._single_restart_engine.solve(targets, SolveOptions())
        q, status = batch.q.copy(), batch.status.copy()
        unsolved = np.flatnonzero(status != Status.SOLVED)
        if len(unsolved):
            batch = engine.solve(targets.rows(unsolved), SolveOptions())
            q[unsolved], status[unsolved] = batch.q, batch.status
        code = np.zeros(len(poses), dtype=np.int8)
        code[status == Status.SOLVED] = Reachability.REACHABLE
        code[status == Status.COLLISION] = Reachability.COLLIDING
        unsolved = np.flatnonzero(code == Reachability.OPEN)
        if len(unsolved):
            budget = np.full(len(unsolved), MAX_HAND_BOXES)
            proofs = engine.diagnostician.prove(targets.rows(unsolved), budget)
            is_refuted = np.array([proof is not None for proof in proofs])
            code[unsolved[is_refuted]] = Reachability.UNREACHABLE
        q[code != Reachability.REACHABLE] = np.nan
        return code, q


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
