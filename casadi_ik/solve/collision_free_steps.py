"""Effort of the search for collision-free solutions, and its random steps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array, spread_steps
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.targets import TargetBatch, Tolerance
from casadi_ik.solve.subproblems import LocalRefinement, SubproblemSolver, carry_palms, side_palms


@dataclass(frozen=True)
class CollisionFreeParameters:
    """Effort of the search for collision-free solutions.

    Attributes:
        chunk_size: Number of targets that are searched together.
        restarts: Maximum number of restarts whose hand postures are tried.
        min_hand_difference: Hands are duplicates if every motor differs by less than this
            [fraction of its range]; duplicates have the same arms.
        trunk_stages: For a multi-arm robot, the number of trunks per target in each stage, and the
            maximum number of combinations of its hands for which these trunks are tried. Each stage
            is followed by the hands of one restart.
        random_arms: Number of random starts per target for an arm without a closed form.
        escape_steps: Standard deviations of successive random steps around the least-penetrating
            solution [fraction of the motors' ranges].
        step_samples: Number of random directions per step; the result with the largest clearance is
            selected. For a robot with one arm, and for a multi-arm robot.
            Source: `studies/bench.py --part clutter`, a KUKA LWR with a Barrett hand, alternating
            with commit 508e6b5, which solves 472 of 650 targets: with 4, 8 and 12 directions it is
            473, 481 and 490, in 0.95, 1.04 and 1.11 times the time.
        hand_steps: Steps of the hand motors of a multi-arm robot [fraction of their ranges].
            Source: for two Pandas with Allegro hands, these steps take 1.5 to 1.6 ms per target;
            `escape_steps` would take 1.9 to 2.5 ms, because they need more `contact_steps`.
        contact_steps: Steps of contacts [fraction of their tolerances], tried where steps of
            motors yield no collision-free solution.
        contact_tolerance: Tolerance of the displaced contacts [fraction of the original one].
        pool_size: For a multi-arm robot, number of least-penetrating solutions of a target around
            which trunk and arms move in the last stage.
        carry_steps: Steps of trunk and arms around these solutions [fraction of the motors'
            ranges], each with the maximum penetration for which it is tried [m].
            Source: of 300 targets of a G1 with Dex3 hands that are given hands without
            self-collision, 211 got a collision-free solution without these steps and 248 with
            them; a search of 6,000 solutions found 16 of those 37 and no other. Of 100 targets
            with arbitrary hands 7 got one; with `contact_steps`, 38 got one.
        max_penetration: Maximum penetration [m] for which steps of hands, and of arms without a
            closed form, are tried.
        escape_depths: For an arm with a closed form, the maximum penetration [m] for which each of
            `escape_steps` is tried: of the robot, and of the hand in self-collision unless a hand
            is limited by the scene. A target all of whose hands exceed the first self-penetration
            is given up after one restart.
            Source: of a KUKA LWR with a Barrett hand these steps free 48 of 1,778 targets of
            `studies/collision.py` and 41 of 2,000 of `studies/bench.py`. A first step of 0.3 (of
            whose results one in seven meets the contacts), and one of 0.2 with eight steps and
            depths of 20, 18, 15, 12, 9, 6, 4 and 2 mm, free 50 and 43 in 1.9 and 1.1 times the
            time.
        diagnosed_hands: Number of hands with the largest clearance that are checked for the reason
            of a collision.
        min_range: Substitute for the range of a motor without a range [rad or m].
    """

    chunk_size: int = 256
    restarts: int = 3
    min_hand_difference: float = 0.02
    trunk_stages: tuple[tuple[int, int], ...] = ((4, 1), (12, 2), (48, 4), (192, 8), (768, 16))
    random_arms: int = 24
    escape_steps: tuple[float, ...] = (0.15, 0.1, 0.1, 0.1, 0.1, 0.05, 0.05)
    step_samples: tuple[int, int] = (12, 24)
    hand_steps: tuple[float, ...] = (0.3, 0.2, 0.1, 0.1, 0.1, 0.1, 0.05, 0.05)
    contact_steps: tuple[float, ...] = (
        *(1, 0.7, 0.5, 0.5, 0.35, 0.35),
        *(0.25, 0.25, 0.18, 0.18, 0.12, 0.12),
    )
    contact_tolerance: float = 0.5
    pool_size: int = 16
    carry_steps: tuple[tuple[float, float], ...] = (
        (0.2, 0.08),
        (0.2, 0.04),
        (0.1, 0.03),
        (0.1, 0.02),
        (0.1, 0.015),
        (0.05, 0.01),
        (0.05, 0.006),
        (0.05, 0.004),
    )
    max_penetration: float = 0.02
    escape_depths: tuple[tuple[float, float], ...] = (
        (0.020, 0.006),
        (0.010, 0.003),
        (0.008, 0.002),
        (0.006, 0.001),
        (0.004, 0.001),
        (0.003, 0.001),
        (0.002, 0.001),
    )
    diagnosed_hands: int = 4
    min_range: float = 1e-9


COLLISION_FREE_PARAMETERS = CollisionFreeParameters()


class RandomSteps:
    """Random steps of motors and contacts, each followed by a fit to the contacts.

    All methods return only configurations that solve their targets. The random numbers depend on
    the seed and the number of the step, not on the targets.

    Attributes:
        robot: The robot.
        samples: Number of random directions of a step.
        ranges: (n,) positive ranges of the motors [rad or m].
    """

    def __init__(self, subproblems: SubproblemSolver, targets: TargetBatch) -> None:
        """Store the solver of subproblems and k targets."""
        self.robot = robot = subproblems.robot
        is_multi_arm = bool(robot.description.sides)
        self.samples = COLLISION_FREE_PARAMETERS.step_samples[is_multi_arm]
        self.ranges = np.maximum(robot.upper - robot.lower, COLLISION_FREE_PARAMETERS.min_range)
        self._subproblems, self._targets = subproblems, targets
        self._limits = subproblems.limits(targets)

    @cached_property
    def _refinement(self) -> LocalRefinement:
        return LocalRefinement(self._subproblems, self._targets)

    def select_solved(
        self, q: Array, target_index: NDArray[np.intp]
    ) -> tuple[Array, NDArray[np.intp]]:
        """Select the configurations that meet their targets."""
        if not len(q):
            return q, target_index
        targets = self._targets.rows(target_index)
        solved = self._subproblems.solved(targets, q, targets.enforce_limits)
        return q[solved], target_index[solved]

    def step_contacts(
        self, q: Array, rows: NDArray[np.intp], number: int
    ) -> tuple[Array, NDArray[np.intp]]:
        """Displace the contacts of solutions at random within their tolerances, and fit to them.

        Args:
            q: (k, n) solutions.
            rows: (k,) indices of their targets.
            number: Index into `contact_steps`.
        """
        samples, size = self.samples, COLLISION_FREE_PARAMETERS.contact_steps[number]
        target_index, starts = np.repeat(rows, samples), np.repeat(q, samples, axis=0)
        targets, contacts = self._targets.rows(target_index), self.robot.contacts(starts)
        random, displaced = np.random.default_rng([self._targets.seed, number]), []
        target_contacts = (
            (targets.points, targets.position_tolerance),
            (targets.normals, targets.angle_tolerance),
        )
        for actual, (target, tolerance) in zip(contacts, target_contacts, strict=True):
            steps = np.tile(random.standard_normal((samples, *actual.shape[1:])), (len(rows), 1, 1))
            offset = (actual - target) / tolerance[:, None] + size * steps
            offset /= np.maximum(1.0, np.linalg.norm(offset, axis=2, keepdims=True))
            displaced.append(target + offset * tolerance[:, None])
        points = displaced[0]
        normals = displaced[1] / np.linalg.norm(displaced[1], axis=2, keepdims=True)
        factor = COLLISION_FREE_PARAMETERS.contact_tolerance
        tolerances = tuple(
            Tolerance(factor * tolerance.position, factor * tolerance.angle)
            for tolerance in targets.tolerances
        )
        shifted = replace(targets, points=points, normals=normals, tolerance=tolerances)
        configurations = LocalRefinement(self._subproblems, shifted).run(
            np.arange(len(target_index)), starts
        )
        return self.select_solved(configurations, target_index)

    def step_motors(
        self, q: Array, rows: NDArray[np.intp], motors: list[int] | slice, number: int, size: float
    ) -> tuple[Array, NDArray[np.intp]]:
        """Displace motors of solutions at random, and fit to the contacts.

        Args:
            q: (k, n) solutions.
            rows: (k,) indices of their targets.
            motors: Motors that are displaced.
            number: Number of the step, which selects its random directions.
            size: Standard deviation [fraction of the motors' ranges].
        """
        target_index = np.repeat(rows, self.samples)
        ranges = self.ranges[motors]
        random = np.random.default_rng([self._targets.seed, number])
        steps = random.standard_normal((self.samples, len(ranges)))
        starts = np.repeat(q, self.samples, axis=0)
        starts[:, motors] += size * ranges * np.tile(steps, (len(rows), 1))
        configurations = self._refinement.run(
            target_index, self._limits.select_rows(target_index).clip(starts)
        )
        return self.select_solved(configurations, target_index)

    def step_trunk_and_arms(
        self,
        q: Array,
        target_index: NDArray[np.intp],
        rank: NDArray[np.intp],
        number: int,
        size: float,
    ) -> tuple[Array, NDArray[np.intp]]:
        """Displace trunk and arms of a multi-arm robot at random; the palms stay in place.

        Args:
            q: (m, n) solutions.
            target_index: (m,) indices of their targets.
            rank: (m,) rank of each solution among those of its target.
            number: Number of the step, which selects its random directions.
            size: Standard deviation [fraction of the motors' ranges].
        """
        moving = np.setdiff1d(np.arange(len(self.ranges)), self.robot.description.hand_actuators)
        rows = np.repeat(np.arange(len(q)), self.samples)
        q, target_index = q[rows], target_index[rows]
        starts, random = q.copy(), np.random.default_rng([self._targets.seed, number])
        steps = random.standard_normal(
            (COLLISION_FREE_PARAMETERS.pool_size, self.samples, len(moving))
        )
        starts[:, moving] += size * self.ranges[moving] * steps[rank].reshape(-1, len(moving))
        starts = self._limits.select_rows(target_index).clip(starts)
        palms = side_palms(self.robot, q)
        configurations = carry_palms(
            self._subproblems, self._targets, starts, palms, target_index, False
        )
        return self.select_solved(configurations, target_index)

    def sample_arms(self, q: Array, rows: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
        """Solve targets from random arms; every second start has the hand posture of q.

        Args:
            q: (k, n) configurations of all targets.
            rows: Indices of the targets that are solved.
        """
        count = COLLISION_FREE_PARAMETERS.random_arms
        hand = list(self.robot.description.hand_actuators)
        target_index = np.repeat(rows, count)
        numbers = np.array([self._targets.row_number(int(row)) for row in rows])
        starts = np.concatenate(_shifted_samples(self.robot, self._targets.seed, numbers, count))
        starts[::2, hand] = q[target_index[::2]][:, hand]
        starts = self._limits.select_rows(target_index).clip(starts)
        return self.select_solved(self._refinement.run(target_index, starts), target_index)


def _shifted_samples(robot: ArmHand, seed: int, numbers: NDArray[np.intp], count: int) -> Array:
    """Sample configurations within the limits for each target, independently of its batch.

    All targets use the same random samples, shifted cyclically by the number of the target.

    Args:
        robot: The robot.
        seed: Seed of the samples.
        numbers: (k,) numbers of the targets.
        count: Number of samples per target.

    Returns:
        (k, count, n) configurations.
    """
    samples = np.random.default_rng(seed).random((count, len(robot.lower)))
    shift = numbers[:, None] * spread_steps(len(robot.lower))
    fraction = (samples + shift[:, None]) % 1.0
    return robot.lower + fraction * (robot.upper - robot.lower)
