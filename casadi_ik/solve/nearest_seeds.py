"""Seeds of the search for the configurations nearest to contacts that are out of reach.

A table of quasi-random arm postures is ranked for each target, as if the hand were rigid: the cost
of a palm pose is then linear in 16 features of the pose, so that one matrix product ranks all
postures. The best posture of each region of the joint space is a seed. The posture of each finger
is the best one of a table in the frame of the palm.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array, Rows, spread_points
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import LENGTH
from casadi_ik.model.targets import TargetBatch


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
        chunk_size: Number of targets whose costs are in memory at the same time.
    """

    regions: int = 128
    region_samples: int = 32
    regions_per_palm: int = 4
    finger_samples: int = 512
    seeds: tuple[int, int] = (32, 2)
    candidates: int = 2
    chunk_size: int = 32


SEED_SETTINGS = SeedSettings()


@dataclass(frozen=True, eq=False)
class ContactGoals:
    """Points and axes of k targets, with the weights of their squared errors.

    Attributes:
        points: (k, f, 3) points [m]; 0 where free.
        axes: (k, f, 3, 3) axes of the contact frames in columns; 0 where free.
        point_weights: (k, f) weights of squared distances [1/m^2].
        axis_weights: (k, f, 3) weights of squared differences of the axes.
    """

    points: Array
    axes: Array
    point_weights: Array
    axis_weights: Array

    @classmethod
    def of(cls, targets: TargetBatch, weights: Array) -> ContactGoals:
        """Return the goals of targets.

        Args:
            targets: k targets.
            weights: (k, f, 2) weights of position and orientation residuals.
        """
        normals = targets.normals
        tangents = targets.extra_vectors.get("tangents", np.full_like(normals, np.nan))
        axes = np.stack([normals, tangents, np.cross(normals, tangents)], axis=3)
        has_tangent = ~np.isnan(tangents[..., 0])
        # As the rows of a contact frame, see `kinematics.contacts`.
        shares = np.where(has_tangent[..., None], 0.5, [1.0, 0.0, 0.0])
        return cls(
            np.nan_to_num(targets.points),
            np.nan_to_num(axes),
            np.where(np.isnan(targets.points[..., 0]), 0.0, (weights[..., 0] / LENGTH) ** 2),
            np.where(np.isnan(normals[..., :1]), 0.0, weights[..., 1:] ** 2 * shares),
        )

    def rows(self, rows: Rows | slice) -> ContactGoals:
        """Return the goals of some targets."""
        return ContactGoals(
            self.points[rows], self.axes[rows], self.point_weights[rows], self.axis_weights[rows]
        )


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

    @cached_property
    def features(self) -> NDArray[np.float32]:
        """(13 fingers, m) squared point, point and axes of each finger."""
        count = len(self.q)
        parts = [
            (self.points**2).sum(axis=2, keepdims=True),
            self.points,
            self.axes.reshape(count, len(self.fingers), 9),
        ]
        return np.concatenate(parts, axis=2).reshape(count, -1).T.astype(np.float32)

    def nearest(self, goals: ContactGoals) -> tuple[Rows, Array]:
        """Return the nearest posture of each of k goals in the palm frame, and its cost (k,).

        The cost omits terms that do not depend on the posture.
        """
        fingers, count = list(self.fingers), len(goals.points)
        point_weights = goals.point_weights[:, fingers, None]
        axes = goals.axis_weights[:, fingers, None, :] * goals.axes[:, fingers]
        parts = [
            point_weights,
            -2 * point_weights * goals.points[:, fingers],
            -2 * axes.reshape(count, len(fingers), 9),
        ]
        costs = np.concatenate(parts, axis=2).reshape(count, -1).astype(np.float32) @ self.features
        best = costs.argmin(axis=1)
        return best, costs[np.arange(count), best].astype(float)


class SeedTable:
    """Quasi-random arm postures by region, and postures of the fingers of one robot."""

    def __init__(self, robot: ArmHand, settings: SeedSettings = SEED_SETTINGS) -> None:
        """Store the robot; the tables are built at the first use."""
        self._robot, self._settings = robot, settings

    @cached_property
    def _finger_groups(self) -> tuple[FingerGroup, ...]:
        """Groups of fingers that share motors, each with its postures."""
        robot, count = self._robot, self._settings.finger_samples
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
            samples = spread_points(count if motors else 1, max(len(motors), 1))
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
        palm = np.zeros(len(self._robot.fingers), dtype=np.intp)
        for number, fingers in enumerate(self._robot.hands.values()):
            palm[list(fingers)] = number
        return palm

    def _palms(self, q: Array) -> Array:
        """Return the palm poses (m, s, 4, 4) at configurations (m, n)."""
        return np.stack([self._robot.palm(q, side) for side in self._robot.hands], axis=1)

    @cached_property
    def _arm_motors(self) -> list[int]:
        """Indices in q of the motors that move no finger relative to its palm."""
        finger_motors = {i for group in self._finger_groups for i in group.motors}
        return [i for i in range(len(self._robot.actuators)) if i not in finger_motors]

    @cached_property
    def _arms(self) -> tuple[Array, Array, NDArray[np.float32]]:
        """Arm postures (m, n), their palms (m, s, 4, 4) and features (16 s, m), by region.

        Postures of a region are ``regions`` rows apart.
        """
        robot, settings, motors = self._robot, self._settings, self._arm_motors
        regions = settings.regions * self._palm_factor
        samples = spread_points(regions * settings.region_samples, max(len(motors), 1))
        order = _regions(samples[:, : len(motors)], regions)
        samples = samples[order]
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
        features = np.concatenate(parts, axis=2).reshape(len(q), -1)
        return q, palms, features.T.astype(np.float32)

    def find(
        self, targets: TargetBatch, weights: Array, lower: Array, upper: Array
    ) -> tuple[Rows, Array]:
        """Return target indices (m,) and seeds (m, n) of k targets.

        Args:
            targets: k targets.
            weights: (k, f, 2) weights of position and orientation residuals.
            lower: (n,) or (k, n) lower bounds of the motors [rad or m].
            upper: (n,) or (k, n) upper bounds of the motors [rad or m].
        """
        goals = ContactGoals.of(targets, weights)
        points, axes = self._rigid_hand(len(targets), lower, upper)
        size, seeds = self._settings.chunk_size, []
        for start in range(0, len(targets), size):
            rows = slice(start, start + size)
            seeds.append(self._find(goals.rows(rows), points[rows], axes[rows]))
        owner = np.repeat(np.arange(len(targets)), seeds[0].shape[1])
        return owner, np.concatenate(seeds).reshape(len(owner), -1)

    def _rigid_hand(self, count: int, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Return points (k, f, 3) and axes (k, f, 3, 3) of a rigid hand in the palm frame.

        They are means of the fingers' tables, or those of fingers that are fixed.
        """
        robot, fingers = self._robot, len(self._robot.fingers)
        points, axes = np.zeros((count, fingers, 3)), np.zeros((count, fingers, 3, 3))
        for group in self._finger_groups:
            group_fingers = list(group.fingers)
            points[:, group_fingers] = group.points.mean(axis=0)
            axes[:, group_fingers] = group.axes.mean(axis=0)
        is_fixed = np.broadcast_to(lower == upper, (count, len(robot.actuators)))
        if is_fixed.any():
            q = np.tile(robot.home, (count, 1))
            np.copyto(q, lower, where=is_fixed)
            palms = self._palms(q)[:, self._palm_of_finger]
            frames = np.linalg.inv(palms) @ robot.frames_at(q)
            for group in self._finger_groups:
                group_fingers = list(group.fingers)
                rows = np.flatnonzero(is_fixed[:, list(group.motors)].all(axis=1))
                fixed = np.ix_(rows, np.array(group_fingers))
                points[fixed], axes[fixed] = frames[fixed][..., :3, 3], frames[fixed][..., :3, :3]
        return points, axes

    def _find(self, goals: ContactGoals, points: Array, axes: Array) -> Array:
        """Return the seeds (k, s, n) of some targets."""
        settings, (arms, palms, features) = self._settings, self._arms
        costs = (self._coefficients(goals, points, axes).astype(np.float32) @ features).reshape(
            len(points), settings.region_samples, -1
        )
        lowest = costs.min(axis=1)
        seed_count = settings.seeds[0] + settings.seeds[1] * len(self._robot.actuators)
        seed_count *= self._palm_factor
        factor = settings.candidates if self._has_free_fingers else 1
        regions = _smallest(lowest, factor * seed_count)
        target = np.arange(len(points))[:, None]
        sample = costs[target, :, regions].argmin(axis=2)
        arm = sample * lowest.shape[1] + regions
        seeds = arms[arm]
        if not self._has_free_fingers:
            return seeds
        total = self._choose_fingers(goals, palms[arm], seeds)
        return seeds[target, _smallest(total, seed_count)]

    @cached_property
    def _palm_factor(self) -> int:
        return self._settings.regions_per_palm if len(self._robot.hands) > 1 else 1

    @cached_property
    def _has_free_fingers(self) -> bool:
        return any(group.motors for group in self._finger_groups)

    def _coefficients(self, goals: ContactGoals, points: Array, axes: Array) -> Array:
        """Return the coefficients (k, 16 s) of the costs of rigid hands, without constants."""
        count, palms = len(points), len(self._robot.hands)
        coefficients = np.zeros((count, palms, 16))
        rotation = np.einsum("kf,kfi,kfj->kfij", goals.point_weights, goals.points, points)
        rotation += np.einsum("kfa,kfia,kfja->kfij", goals.axis_weights, goals.axes, axes)
        for palm in range(palms):
            fingers = self._palm_of_finger == palm
            weights = goals.point_weights[:, fingers]
            row = coefficients[:, palm]
            row[:, 0] = weights.sum(axis=1)
            row[:, 1:4] = -2 * np.einsum("kf,kfi->ki", weights, goals.points[:, fingers])
            row[:, 4:7] = 2 * np.einsum("kf,kfi->ki", weights, points[:, fingers])
            row[:, 7:] = -2 * rotation[:, fingers].sum(axis=1).reshape(count, 9)
        return coefficients.reshape(count, -1)

    def _choose_fingers(self, goals: ContactGoals, palms: Array, seeds: Array) -> Array:
        """Set the fingers of seeds (k, m, n) at palms (k, m, s, 4, 4); return costs (k, m)."""
        k, m = seeds.shape[:2]
        palms = palms.reshape(k * m, *palms.shape[2:])[:, self._palm_of_finger]
        rotations, origins = palms[..., :3, :3], palms[..., :3, 3]
        goals = goals.rows(np.repeat(np.arange(k), m))
        offsets = goals.points - origins
        in_palm = ContactGoals(
            np.einsum("kfji,kfj->kfi", rotations, offsets),
            np.swapaxes(rotations, 2, 3) @ goals.axes,
            goals.point_weights,
            goals.axis_weights,
        )
        costs = (goals.point_weights * (offsets**2).sum(axis=2)).sum(axis=1)
        flat = seeds.reshape(k * m, -1)
        for group in self._finger_groups:
            best, cost = group.nearest(in_palm)
            flat[:, group.motors] = group.q[best]
            costs += cost
        seeds[...] = flat.reshape(seeds.shape)
        return costs.reshape(k, m)


def _smallest(values: Array, count: int) -> Rows:
    """Return the columns of the smallest values of each row of (k, m), in order: (k, count)."""
    count = min(count, values.shape[1])
    if count < values.shape[1]:
        columns = np.argpartition(values, count, axis=1)[:, :count]
    else:
        columns = np.tile(np.arange(count), (len(values), 1))
    order = np.argsort(np.take_along_axis(values, columns, axis=1), axis=1, kind="stable")
    return np.take_along_axis(columns, order, axis=1)


def _regions(samples: Array, regions: int) -> Rows:
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
