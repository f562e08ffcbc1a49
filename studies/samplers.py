"""Configurations whose contacts are the targets of studies: reachable by construction.

A sampler draws (count, n) configurations of any robot. Public names of the package are used only,
so that the same targets can be given to another version of it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

import casadi_ik as ik

Array = NDArray[np.float64]

Sampler = Callable[[ik.ArmHand, np.random.Generator, int], Array]

DRAWS = 32
"""Arms of which the one nearest to a singularity is taken."""

AMID = 0.6
"""Position of the arm of random hands, as a fraction of its range."""

NUDGE = 1e-6
"""Difference [rad or m] from which slopes are taken."""

LENGTH = 0.1
"""Length that weighs metres against radians [m]."""


def random_hands(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Draw every actuator uniformly within its limits."""
    return robot.random(rng, count)


def hands_on_one_arm(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Random hands on an arm amid its limits: what a hand can do is what is tried."""
    q = robot.random(rng, count)
    arm = _arm(robot)
    q[:, arm] = (robot.lower + AMID * (robot.upper - robot.lower))[arm]
    return q


def corners(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Draw every actuator at its lower limit, at its upper limit or anywhere."""
    q, choice = robot.random(rng, count), rng.integers(0, 3, (count, len(robot.lower)))
    return np.where(choice == 0, robot.lower, np.where(choice == 1, robot.upper, q))


def near_limits(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Likewise, within 1 deg of the limit; a slider within a fiftieth of its stroke."""
    q = robot.random(rng, count)
    turning = [actuator.unit == "rad" for actuator in robot.description.actuators]
    widest = np.where(turning, np.radians(1), (robot.upper - robot.lower) / 50)
    distance_to_limit = rng.uniform(0, np.minimum(widest, robot.upper - robot.lower), q.shape)
    choice = rng.integers(0, 3, q.shape)
    return np.where(
        choice == 0,
        robot.lower + distance_to_limit,
        np.where(choice == 1, robot.upper - distance_to_limit, q),
    )


def singular_arms(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Hands at corners on arms that are the nearest to singular of several."""
    q, arm = corners(robot, rng, count), _arm(robot)
    if not arm:
        return q
    draws = robot.random(rng, count * DRAWS)
    smallest = palm_slopes(robot, draws).reshape(count, DRAWS)
    configurations = draws.reshape(count, DRAWS, -1)[np.arange(count), smallest.argmin(axis=1)]
    q[:, arm] = configurations[:, arm]
    return q


def shipped_hands(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Hands of the robot's shipped grasps, one after the other, on random arms."""
    names = ik.shipped_grasps(robot.name)
    parts = [grasp_arms(robot, rng, -(-count // len(names)), name) for name in names]
    return np.stack(parts, axis=1).reshape(-1, len(robot.actuators))[:count]


def aligned_arms(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Elbow straight, shoulder or wrist aligned, or all of them; to 1e-3 ... 1e-9 rad.

    For arms of seven joints whose first, third and fifth axes meet the one before in a shoulder,
    an elbow and a wrist.
    """
    return _aligned(robot, rng, robot.random(rng, count))


def shipped_hands_on_aligned_arms(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Hands of three parallel fingers leave a freedom, and such arms hardly any."""
    return _aligned(robot, rng, shipped_hands(robot, rng, count))


def near_limits_on_aligned_arms(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Hands near their limits on arms near a singularity."""
    return _aligned(robot, rng, near_limits(robot, rng, count))


SAMPLERS: dict[str, tuple[str, Sampler]] = {
    "random": ("random hands", random_hands),
    "one-arm": ("hands on one arm", hands_on_one_arm),
    "corners": ("corners", corners),
    "limits": ("near limits", near_limits),
    "singular": ("corners on near-singular arms", singular_arms),
    "grasps": ("shipped grasps", shipped_hands),
    "aligned": ("aligned arms", aligned_arms),
    "aligned-grasps": ("shipped grasps on aligned arms", shipped_hands_on_aligned_arms),
    "aligned-limits": ("near limits on aligned arms", near_limits_on_aligned_arms),
}
"""Title and sampler by option."""


def suits(robot: ik.ArmHand, sampler: str) -> bool:
    """Return whether a sampler supports a robot (built-in grasps, seven joints through zero)."""
    if sampler.endswith("grasps") and not (ik.shipped_grasps(robot.name) and _arm(robot)):
        return False
    if not sampler.startswith("aligned"):
        return True
    middle = [1, 3, 5]
    straight = (robot.lower[middle] < -0.01).all() and (robot.upper[middle] > 0.01).all()
    return len(_arm(robot)) == 7 and bool(straight)


def grasp_arms(robot: ik.ArmHand, rng: np.random.Generator, count: int, grasp: str) -> Array:
    """Return configurations with the hand posture of a grasp and uniformly random arms.

    As in Qiu & Kermani 2021, section III: "for each hand configuration, randomly generate 10,000
    arm configurations that are uniformly distributed within the arm's joint limits".

    Args:
        robot: The robot.
        rng: Source of the arm configurations.
        count: Arm configurations.
        grasp: A shipped grasp.

    Returns:
        (count, n) configurations.
    """
    q = robot.random(rng, count)
    for actuator, value in _posture(grasp):
        q[:, robot.actuators.index(actuator)] = value
    return q


def random_arm_targets(
    robot: ik.ArmHand, names: tuple[str, ...], count: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Contacts of `grasp_arms` of several grasps.

    Returns:
        points [m] and normals, (len(names) * count, f, 3), grasp by grasp.
    """
    return robot.contacts(np.concatenate([grasp_arms(robot, rng, count, name) for name in names]))


def noisy(
    points: Array, normals: Array, rng: np.random.Generator, metres: float, angle: float
) -> tuple[Array, Array]:
    """Contacts (k, f, 3) with Gaussian noise on every coordinate; unit normals."""
    points = points + rng.normal(0, metres, points.shape)
    normals = normals + rng.normal(0, angle, normals.shape)
    return points, normals / np.linalg.norm(normals, axis=2, keepdims=True)


def displaced(
    points: Array, normals: Array, rng: np.random.Generator, metres: float, angle: float
) -> tuple[Array, Array]:
    """Return contacts (k, f, 3) displaced by a distance, and normals rotated by an angle.

    Args:
        points: (k, f, 3) contact points [m].
        normals: (k, f, 3) unit normals.
        rng: Source of the directions and of the rotation axes, which are uniform.
        metres: Displacement of every point [m].
        angle: Rotation of every normal [rad].
    """
    shift, axis = rng.normal(size=points.shape), rng.normal(size=normals.shape)
    axis -= (axis * normals).sum(axis=2, keepdims=True) * normals
    points = points + metres * shift / np.linalg.norm(shift, axis=2, keepdims=True)
    axis /= np.linalg.norm(axis, axis=2, keepdims=True)
    return points, normals * np.cos(angle) + np.cross(axis, normals) * np.sin(angle)


def finger_sets(robot: ik.ArmHand, names: list[str]) -> dict[str, list[int]]:
    """Places in `robot.fingers` of those that have a contact, by name of the set.

    Args:
        robot: The robot.
        names: "all", a number of fingers from the thumb on, or names joined by plus signs; sets
            that a robot cannot have, or has already, are left out.
    """
    all_fingers = list(range(len(robot.fingers)))
    thumb = robot.description.named_thumb
    first = robot.fingers.index(thumb) if thumb else 0
    sets: dict[str, list[int]] = {}
    for word in names:
        if word == "all":
            selected = all_fingers
        elif word.isdigit():
            selected = sorted([first, *(f for f in all_fingers if f != first)][: int(word)])
        else:
            selected = [i for i, name in enumerate(robot.fingers) if name in word.split("+")]
        if selected and selected not in sets.values():
            sets[word] = selected
    return sets


def grasps_of(robot: ik.ArmHand, points: Array, normals: Array) -> list[ik.Grasp]:
    """Contacts (k, f, 3) as grasps."""
    return [
        ik.Grasp({n: ik.Contact(*c) for n, *c in zip(robot.fingers, p, m, strict=True)})
        for p, m in zip(points, normals, strict=True)
    ]


def smooth_path(robot: ik.ArmHand, seed: int, count: int, period: float, share: float) -> Array:
    """(count, n) sums of slow sines about a posture, within limits, that begin at rest.

    Args:
        robot: The robot.
        seed: Of the path.
        count: Of its postures.
        period: Time between two of them [s].
        share: Most of any motor's velocity, and of the acceleration that reaches it in 0.25 s.
    """
    rng = np.random.default_rng(seed)
    middle, half_range = (robot.lower + robot.upper) / 2, (robot.upper - robot.lower) / 2
    centre = middle + 0.4 * half_range * rng.uniform(-1, 1, len(middle))
    # From rest: the first half second passes slowly.
    share_of_time = np.minimum(period * np.arange(count) / 0.5, 1.0)
    time = np.cumsum(period * share_of_time**2 * (3 - 2 * share_of_time))[:, None]
    path = np.zeros((count, len(middle)))
    for _ in range(3):
        rate = rng.uniform(0.2, 1.0, len(middle))
        path += np.sin(2 * np.pi * rate * time + rng.uniform(0, 2 * np.pi, len(middle)))
    margin = np.minimum(robot.upper - centre, centre - robot.lower)
    path *= 0.5 * margin / np.abs(path).max(axis=0)
    stated = np.array([actuator.velocity for actuator in robot.description.actuators])
    limits = np.where(np.isfinite(stated), stated, robot.upper - robot.lower)
    speed = (np.abs(np.diff(path, axis=0)) / (period * limits)).max(axis=0)
    change = (np.abs(np.diff(path, 2, axis=0)) / (period**2 * limits / 0.25)).max(axis=0)
    return centre + path * np.minimum(1.0, share / np.maximum(speed, change))


def palm_slopes(robot: ik.ArmHand, q: Array) -> Array:
    """(k,) smallest singular value of how the palm moves with the arm, metres by `LENGTH`."""
    pose = robot.palm(q)
    rows = []
    for column in _arm(robot):
        shifted = q.copy()
        shifted[:, column] += NUDGE
        change = (robot.palm(shifted) - pose) / NUDGE
        rotation = change[:, :3, :3] @ pose[:, :3, :3].transpose(0, 2, 1)
        turn = np.stack([rotation[:, 2, 1], rotation[:, 0, 2], rotation[:, 1, 0]], axis=1)
        rows.append(np.concatenate([change[:, :3, 3] / LENGTH, turn], axis=1))
    return np.linalg.svd(np.stack(rows, axis=2), compute_uv=False)[:, -1]


def contact_slopes(robot: ik.ArmHand, q: Array) -> Array:
    """(k,) smallest singular value of how all contacts move with all motors, elbow aside.

    Where it is small the contacts hardly tell where the motors are. An arm of more than six joints
    moves without moving the palm; that motion is not counted.
    """
    points, normals = robot.contacts(q)
    columns = []
    ranges = robot.upper - robot.lower
    for column in range(q.shape[1]):
        shifted = q.copy()
        step = NUDGE * min(1.0, float(ranges[column]))
        shifted[:, column] += step
        shifted_contacts = robot.contacts(shifted)
        scale = min(1.0, float(ranges[column])) / step
        change = [
            (shifted_contacts[0] - points) / LENGTH * scale,
            (shifted_contacts[1] - normals) * scale,
        ]
        columns.append(np.concatenate([part.reshape(len(q), -1) for part in change], axis=1))
    values = np.linalg.svd(np.stack(columns, axis=2), compute_uv=False)
    spare = max(len(_arm(robot)) - 6, 0)
    # A point and a direction are five numbers.
    return values[:, min(q.shape[1] - spare, 5 * len(robot.fingers)) - 1]


def _arm(robot: ik.ArmHand) -> list[int]:
    return list(robot.description.arm_actuators)


def _aligned(robot: ik.ArmHand, rng: np.random.Generator, q: Array) -> Array:
    arm, count = _arm(robot), len(q)
    configurations = robot.random(rng, count)
    off = rng.normal(0, 1e-3, (count, 3)) * 10.0 ** -rng.integers(0, 6, (count, 1))
    pair = rng.integers(0, 4, count)
    for j, column in enumerate((1, 3, 5)):
        rows = (pair == j) | (pair == 3)
        configurations[rows, column] = off[rows, j]
    q[:, arm] = configurations[:, arm]
    return q


@cache
def _posture(grasp: str) -> tuple[tuple[str, float], ...]:
    return tuple(ik.load_grasp(grasp).posture.items())
