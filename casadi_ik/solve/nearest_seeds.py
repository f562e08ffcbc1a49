"""Seeds of the search for the configurations nearest to contacts that are out of reach.

A table of quasi-random arm postures is ranked for each target, as if the hand were rigid: the cost
of a palm pose is then linear in 16 features of the pose, so that one matrix product ranks all
postures. The best posture of each region of the joint space is a seed. The posture of each finger
is the best one of a table in the frame of the palm.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.codegen import c_struct
from casadi_ik.compile.function_kernel import memory
from casadi_ik.files.arrays import Array, Rows, spread_points
from casadi_ik.kinematics.arm_hand import ArmHand

TILE = 32
"""Number of rows in a tile of a table, see compile/runtime/nearest_search.c."""

MIN_RANGE = 1e-9
"""Lower bound of the ranges that scale travel [rad or m]."""

FingerGroupStruct = c_struct("finger_group", driver="nearest_search_job")


@dataclass(frozen=True)
class SeedSettings:
    """Sizes of the tables and numbers of seeds. Source: ``studies/best_effort.py``.

    Attributes:
        regions: Number of regions of the arm's joint space.
        region_samples: Number of arm postures in each region.
        regions_per_palm: Factor of the number of regions and seeds for a robot with several palms.
        finger_samples: Number of postures of each group of fingers that share motors.
        seeds: Number of seeds of each target, and additional ones per motor.
        candidates: Number of arm postures per seed for which the fingers are chosen.
    """

    regions: int = 128
    region_samples: int = 32
    regions_per_palm: int = 4
    finger_samples: int = 512
    seeds: tuple[int, int] = (32, 2)
    candidates: int = 2


SEED_SETTINGS = SeedSettings()


@dataclass(frozen=True, eq=False)
class FingerGroup:
    """Postures of fingers that share motors.

    Attributes:
        fingers: Indices of the fingers.
        motors: Indices in q of their motors.
        q: (m, motors) postures [rad or m].
        points: (m, fingers, 3) contact points in the palm frame [m].
        axes: (m, fingers, 3, 3) axes of the contact frames in the palm frame, in columns.
    """

    fingers: tuple[int, ...]
    motors: tuple[int, ...]
    q: Array
    points: Array
    axes: Array

    @property
    def features(self) -> NDArray[np.float32]:
        """(m / `TILE`, 13 fingers, `TILE`) squared point, point and axis rows of each finger."""
        count = len(self.q)
        axes = np.swapaxes(self.axes, 2, 3).reshape(count, len(self.fingers), 9)
        squares = (self.points**2).sum(axis=2, keepdims=True)
        return _in_tiles(np.concatenate([squares, self.points, axes], axis=2))


@dataclass(frozen=True, eq=False)
class SeedTables:
    """Tables of postures, as the C code of the search reads them.

    Attributes:
        members: Members of the job of the search.
        groups: Groups of fingers.
        n_seeds: Number of seeds of each target.
        n_candidates: Number of arm postures for which the fingers are chosen.
        max_rows: Size of the memory for the costs of rows.
        max_features: Size of the memory for coefficients.
        arrays: Arrays that must stay alive with the job.
    """

    members: dict[str, int]
    groups: tuple[FingerGroup, ...]
    n_seeds: int
    n_candidates: int
    max_rows: int
    max_features: int
    arrays: tuple[Any, ...]


class SeedTable:
    """Quasi-random arm postures by region, and postures of the fingers of one robot."""

    def __init__(self, robot: ArmHand, settings: SeedSettings = SEED_SETTINGS) -> None:
        """Store the robot; the tables are built at the first use."""
        self.robot, self._settings = robot, settings

    @cached_property
    def _finger_groups(self) -> tuple[FingerGroup, ...]:
        """Groups of fingers that share motors, each with its postures."""
        robot, count = self.robot, self._settings.finger_samples
        # The fingers of a multi-arm robot begin at its trunk.
        hand_motors = set(robot.description.hand_actuators)
        groups: list[tuple[set[int], set[int]]] = []
        for finger, name in enumerate(robot.fingers):
            finger_motors = robot.description.finger_actuators(name)
            fingers, motors = {finger}, hand_motors.intersection(finger_motors)
            for group in [group for group in groups if group[1] & motors]:
                groups.remove(group)
                fingers, motors = fingers | group[0], motors | group[1]
            groups.append((fingers, motors))
        palms = self._palms(robot.home[None])[0]
        result = []
        for group_fingers, group_motors in groups:
            fingers, motors = sorted(group_fingers), sorted(group_motors)
            samples = spread_points(count if motors else TILE, max(len(motors), 1))
            q = np.tile(robot.home, (len(samples), 1))
            lower, upper = robot.lower[motors], robot.upper[motors]
            q[:, motors] = lower + samples[:, : len(motors)] * (upper - lower)
            inverse = np.linalg.inv(palms[[self._palm_of_finger[i] for i in fingers]])
            frames = inverse @ robot.frames_at(q)[:, fingers]
            result.append(
                FingerGroup(
                    tuple(fingers),
                    tuple(motors),
                    q[:, motors],
                    frames[..., :3, 3],
                    frames[..., :3, :3],
                )
            )
        return tuple(result)

    @cached_property
    def _palm_of_finger(self) -> Rows:
        """(f,) number of the palm of each finger."""
        palm = np.zeros(len(self.robot.fingers), dtype=np.intp)
        for number, fingers in enumerate(self.robot.hands.values()):
            palm[list(fingers)] = number
        return palm

    def _palms(self, q: Array) -> Array:
        """Return the palm poses (m, s, 4, 4) at configurations (m, n)."""
        return np.stack([self.robot.palm(q, side) for side in self.robot.hands], axis=1)

    @cached_property
    def _arm_motors(self) -> list[int]:
        """Indices in q of the motors that move no finger relative to its palm."""
        finger_motors = {i for group in self._finger_groups for i in group.motors}
        return [i for i in range(len(self.robot.actuators)) if i not in finger_motors]

    @cached_property
    def _arms(self) -> tuple[Array, NDArray[np.float32]]:
        """Arm postures (m, motors), and features (m / `TILE`, 16 s, `TILE`) of their palms.

        Postures of a region are ``regions`` rows apart.
        """
        robot, settings, motors = self.robot, self._settings, self._arm_motors
        samples = spread_points(self._regions * settings.region_samples, max(len(motors), 1))
        samples = samples[_region_order(samples[:, : len(motors)], self._regions)]
        q = np.tile(robot.home, (len(samples), 1))
        lower, upper = robot.lower[motors], robot.upper[motors]
        q[:, motors] = lower + samples[:, : len(motors)] * (upper - lower)
        palms = self._palms(q)
        rotations, origins = palms[..., :3, :3], palms[..., :3, 3]
        parts = [
            (origins**2).sum(axis=2, keepdims=True),
            origins,
            np.einsum("msji,msj->msi", rotations, origins),
            rotations.reshape(*palms.shape[:2], 9),
        ]
        return q[:, motors], _in_tiles(np.concatenate(parts, axis=2))

    @cached_property
    def tables(self) -> SeedTables:
        """Tables of arm and finger postures."""
        robot, settings, palms = self.robot, self._settings, len(self.robot.hands)
        arm_postures, arm_features = self._arms
        groups = self._finger_groups if any(group.motors for group in self._finger_groups) else ()
        seeds, seeds_per_motor = settings.seeds
        n_seeds = (seeds + seeds_per_motor * len(robot.actuators)) * self._palm_factor
        n_candidates = min(settings.candidates * n_seeds if groups else n_seeds, self._regions)
        arrays = {
            "arm_features": arm_features,
            "arm_postures": np.ascontiguousarray(arm_postures, dtype=np.float32),
            "arm_motors": np.array(self._arm_motors, dtype=np.int64),
            "palm_of_finger": self._palm_of_finger.astype(np.int64),
            "home": robot.home.copy(),
            "ranges": np.maximum(robot.upper - robot.lower, MIN_RANGE),
        }
        finger_arrays = [
            (
                np.array(group.fingers, dtype=np.int64),
                np.array(group.motors, dtype=np.int64),
                group.features,
                np.ascontiguousarray(group.q, dtype=np.float32),
            )
            for group in groups
        ]
        structs = (FingerGroupStruct * max(len(groups), 1))(
            *(
                FingerGroupStruct(
                    *map(memory, arrays_of_group),
                    n_fingers=len(group.fingers),
                    n_motors=len(group.motors),
                    n_rows=len(group.q),
                )
                for group, arrays_of_group in zip(groups, finger_arrays, strict=True)
            )
        )
        members = {name: memory(array) for name, array in arrays.items()} | {
            "groups": ctypes.addressof(structs),
            "n_motors": len(robot.actuators),
            "n_fingers": len(robot.fingers),
            "n_palms": palms,
            "n_groups": len(groups),
            "n_arm_motors": len(self._arm_motors),
            "regions": self._regions,
            "n_samples": settings.region_samples,
            "n_candidates": n_candidates,
        }
        return SeedTables(
            members,
            groups,
            min(n_seeds, n_candidates),
            n_candidates,
            max(len(arm_postures) + self._regions, *(len(group.q) for group in groups), 0),
            max(16 * palms, *(13 * len(group.fingers) for group in groups), 0),
            (arrays, finger_arrays, structs),
        )

    @cached_property
    def _mean_hand(self) -> tuple[Array, Array]:
        """Mean points (1, f, 3) and axes (1, f, 3, 3), in rows, of the tables of the fingers."""
        fingers = len(self.robot.fingers)
        points, axes = np.zeros((1, fingers, 3)), np.zeros((1, fingers, 3, 3))
        for group in self._finger_groups:
            group_fingers = list(group.fingers)
            points[0, group_fingers] = group.points.mean(axis=0)
            axes[0, group_fingers] = np.swapaxes(group.axes.mean(axis=0), 1, 2)
        return points, axes

    def rigid_hand(self, count: int, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Return points (k or 1, f, 3) and axes (k or 1, f, 3, 3) of a rigid hand, palm frame.

        They are means of the fingers' tables, or those of fingers that are fixed; a single hand for
        all targets if no motor is fixed. Axes are in rows.

        Args:
            count: Number k of targets.
            lower: (n,) or (k, n) lower bounds of the motors [rad or m].
            upper: (n,) or (k, n) upper bounds of the motors [rad or m].
        """
        points, axes = self._mean_hand
        is_fixed = np.equal(lower, upper)
        if not is_fixed.any():
            return points, axes
        robot = self.robot
        is_fixed = np.broadcast_to(is_fixed, (count, len(robot.actuators)))
        points, axes = points.repeat(count, axis=0), axes.repeat(count, axis=0)
        q = np.tile(robot.home, (count, 1))
        np.copyto(q, lower, where=is_fixed)
        frames = np.linalg.inv(self._palms(q)[:, self._palm_of_finger]) @ robot.frames_at(q)
        for group in self._finger_groups:
            rows = np.flatnonzero(is_fixed[:, list(group.motors)].all(axis=1))
            fixed = np.ix_(rows, np.array(group.fingers))
            points[fixed] = frames[fixed][..., :3, 3]
            axes[fixed] = np.swapaxes(frames[fixed][..., :3, :3], 2, 3)
        return points, axes

    @cached_property
    def _palm_factor(self) -> int:
        return self._settings.regions_per_palm if len(self.robot.hands) > 1 else 1

    @property
    def _regions(self) -> int:
        return self._settings.regions * self._palm_factor


def _in_tiles(features: Array) -> NDArray[np.float32]:
    """Return the features (m, ...) of rows in tiles: (m / `TILE`, features, `TILE`)."""
    flat = features.reshape(len(features) // TILE, TILE, -1)
    return np.ascontiguousarray(np.swapaxes(flat, 1, 2), dtype=np.float32)


def _region_order(samples: Array, regions: int) -> Rows:
    """Return an order of samples (m, d) in which those of a region are ``regions`` rows apart.

    Regions of equal size result from repeated halves of the samples along one joint after the
    other.
    """
    parts, joint = [np.arange(len(samples))], 0
    while len(parts) < regions:
        column = samples[:, joint % max(samples.shape[1], 1)] if samples.shape[1] else None
        halves = []
        for part in parts:
            order = part if column is None else part[np.argsort(column[part], kind="stable")]
            halves += [order[: len(order) // 2], order[len(order) // 2 :]]
        parts, joint = halves, joint + 1
    return np.stack(parts, axis=1).reshape(-1)
