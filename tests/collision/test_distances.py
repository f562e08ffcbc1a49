"""Distances compared with coal: what coal reports as penetrating is never free."""

from __future__ import annotations

import numpy as np
import pytest
from capsule_arm import SCENE, write_robot
from coal_oracle import described, distance, in_scene
from collision_queries import query_at

import casadi_ik as ik
from casadi_ik.collision.clearance import CollisionQuery
from casadi_ik.collision.distances import levers

MICROMETRE = 1e-6


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> ik.ArmHand:
    return ik.load_robot(write_robot(tmp_path_factory.mktemp("three")))


def surroundings(robot: ik.ArmHand, scene: ik.Scene, compiled: bool = True) -> CollisionQuery:
    return query_at(ik.Solver(robot, scene=scene, compiled=compiled), robot.home)


def by_coal(robot: ik.ArmHand, q: np.ndarray, names: set[frozenset[str]]) -> np.ndarray:
    """Return the smallest signed distance of each pair of names (k, pairs) [m]."""
    shapes, scene = described(robot), in_scene()
    links = robot.links(q)
    distances = {name: np.full(len(q), np.inf) for name in names}
    for i, (link, shape, pose) in enumerate(shapes):
        obstacles = [(n, s, None, p) for n, (s, p) in scene.items()]
        obstacles += [(n, s, p, None) for n, s, p in shapes[i + 1 :]]
        for name, solid, place, fixed in obstacles:
            key = frozenset((link, name))
            if key not in distances:
                continue
            for row in range(len(q)):
                pose_of_obstacle = fixed if place is None else links[name][row] @ place
                separation = distance(shape, links[link][row] @ pose, solid, pose_of_obstacle)
                distances[key][row] = min(distances[key][row], separation)
    return distances


def test_distances_match_coal_and_are_conservative(robot, rng):
    around = surroundings(robot, ik.Scene(SCENE))
    q = robot.random(rng, 300)
    names = [frozenset(pair) for pair in around.table.names]
    all_distances = around.kernel.all_distances(q, around.poses, around.table)
    theirs = by_coal(robot, q, set(names))
    solids = {"palm", "l2", "base"}  # described as boxes and a cylinder
    for name in set(names):
        ours = all_distances[:, [i for i, obstacle in enumerate(names) if obstacle == name]].min(
            axis=1
        )
        coals = theirs[name]
        is_apart = coals > 0
        # Distances are conservative where coal reports a gap, and agree on penetration.
        assert (ours[is_apart] <= coals[is_apart] + MICROMETRE).all(), name
        assert (ours[~is_apart] <= MICROMETRE).all(), name
        if not (name & solids) and "block" not in name:
            np.testing.assert_allclose(
                ours[is_apart], coals[is_apart], atol=2e-6, err_msg=str(name)
            )
        if len(name & solids) == 1 and not (name & set(SCENE)):
            # Distances of capsules to boxes and cylinders of the robot itself are exact, too.
            np.testing.assert_allclose(
                ours[is_apart], coals[is_apart], atol=2e-6, err_msg=str(name)
            )


def test_hull_planes_round_off_little(robot, rng):
    around = surroundings(robot, ik.Scene({"block": SCENE["block"]}))
    q = robot.random(rng, 200)
    rows = np.array([{"l3", "block"} == set(pair) for pair in around.table.names])
    ours = around.kernel.all_distances(q, around.poses, around.table)[:, rows].min(axis=1)
    coals = by_coal(robot, q, {frozenset(("l3", "block"))})[frozenset(("l3", "block"))]
    is_near = (coals > 0) & (coals < 0.2)
    assert is_near.sum() > 15
    assert (coals - ours)[is_near].max() < 0.02 * 0.24


def test_virtual_machine_gives_the_same_distances(robot, rng):
    compiled = surroundings(robot, ik.Scene(SCENE))
    plain = surroundings(robot, ik.Scene(SCENE), compiled=False)
    q = robot.random(rng, 100)
    tables = compiled.table, plain.table
    assert tables[0].names == tables[1].names
    all_distances = [
        checker.kernel.all_distances(q, checker.poses, checker.table)
        for checker in (compiled, plain)
    ]
    np.testing.assert_allclose(all_distances[0], all_distances[1], atol=3e-7)
    minima, pair_indices = compiled.kernel.min_distances(q, compiled.poses, compiled.table)
    np.testing.assert_array_equal(minima, all_distances[0].min(axis=1))
    np.testing.assert_array_equal(pair_indices, all_distances[0].argmin(axis=1))


@pytest.mark.parametrize("name", ["three", "ar10"])
def test_distances_change_at_most_by_the_displacement_bound(robot, rng, name):
    """Robot with revolute, prismatic and coupled joints."""
    robot, scene = (
        (robot, ik.Scene(SCENE)) if name == "three" else (ik.load_robot(name), ik.Scene())
    )
    around = surroundings(robot, scene, compiled=False)
    longest = levers(robot.description, around.table)
    for size in (1e-3, 0.1):
        q = robot.random(rng, 60)
        q_next = np.clip(
            q + size * (robot.upper - robot.lower) * rng.normal(size=q.shape),
            robot.lower,
            robot.upper,
        )
        distances_before, after = (
            around.kernel.all_distances(x, around.poses, around.table) for x in (q, q_next)
        )
        bound = np.abs(q_next - q) @ longest.T
        assert (np.abs(after - distances_before) <= bound + MICROMETRE).all()
        has_moved = bound > 1e-5
        assert (np.abs(after - distances_before)[has_moved] / bound[has_moved]).max() > 0.5, (
            "far too cautious"
        )


def test_nan_is_not_free(robot):
    around = surroundings(robot, ik.Scene(SCENE))
    q = np.full((1, len(robot.actuators)), np.nan)
    assert not around.check(q).free[0]
    assert not around.free(q)[0]
