"""Effort of the search for collision-free solutions."""

from __future__ import annotations

from dataclasses import dataclass


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
