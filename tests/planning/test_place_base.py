"""Base placement: the count is witnessed, the bound holds, bad input is refused."""

import json

import numpy as np
import pytest
from collision_queries import query_at
from commands import main

import casadi_ik as ik

BOX = ([-0.6, -0.6, 0.0], [0.6, 0.6, 0.0])


@pytest.fixture(scope="module")
def solver():
    return ik.Solver(ik.load_robot("ur5e"))


@pytest.fixture(scope="module")
def palms(solver):
    """Palm poses that the arm reaches from a base at x = 0.2, y = -0.1, yaw = 0.5."""
    robot = solver.robot
    base = np.eye(4)
    c, s = np.cos(0.5), np.sin(0.5)
    base[:2, :2], base[:2, 3] = [[c, -s], [s, c]], [0.2, -0.1]
    return base @ robot.palm(robot.random(np.random.default_rng(2), 60))


def test_the_count_is_witnessed_and_below_the_bound(solver, palms):
    place = solver.place_base(palms, BOX, resolution=0.1, max_time=20.0)
    assert place.count <= place.upper_bound <= len(palms)
    # The bound holds for the base from which the palm poses were made.
    assert place.upper_bound == len(palms)
    assert place.count > 0.8 * len(palms)
    witnesses = place.pose @ solver.robot.palm(place.q[place.reached])
    assert np.allclose(witnesses, palms[place.reached], rtol=0, atol=1e-9)
    assert place.counts.max() == place.count
    assert (np.abs(place.bases[:, :2]) <= 0.6).all()


def test_a_bound_below_the_number_of_palms_is_proved(solver, palms):
    far = palms.copy()
    far[::2, 0, 3] += 2.5  # no base reaches both halves
    place = solver.place_base(far, BOX, resolution=0.1, max_time=20.0)
    assert place.count <= place.upper_bound < len(far)


def test_base_and_arms_are_free_of_collision(solver, palms):
    robot = solver.robot
    size, center = [1.0, 1.0, 1.0], [0.5, -0.1, -0.3]
    scene = ik.Scene({"block": {"kind": "box", "size": size, "xyz": center}})
    free = solver.place_base(palms, BOX, resolution=0.3, prefer="center")
    place = solver.place_base(palms, BOX, resolution=0.3, scene=scene)
    assert 0 < place.count <= free.count <= place.upper_bound
    # The base is not within the block; palm poses and the block are in the world frame.
    assert (np.abs(place.base[:2] - center[:2]) > 0.5).any()
    block = np.eye(4)
    block[:3, 3] = center
    enclosing = ik.Scene({"block": {"kind": "box", "size": [9, 9, 9], "xyz": center}})
    with pytest.raises(ik.errors.InputError, match="scene"):
        solver.place_base(palms[:2], np.zeros((2, 3)), scene=enclosing)
    seen = ik.Solver(robot, scene=scene.moved("block", np.linalg.inv(place.pose) @ block))
    assert query_at(seen, robot.home).free(place.q[place.reached]).all()
    assert np.allclose(place.pose @ robot.palm(place.q[place.reached]), palms[place.reached])


def test_a_preference_decides_among_equal_bases(solver, palms):
    few, robot = palms[:5], solver.robot

    def margin(place):
        limits = np.minimum(place.q - robot.lower, robot.upper - place.q)
        return (limits / (robot.upper - robot.lower)).min(axis=1).mean()

    plain, limits, center = (
        solver.place_base(few, BOX, resolution=0.3, prefer=prefer)
        for prefer in (None, "limits", "center")
    )
    assert plain.count == limits.count == center.count == 5
    assert margin(limits) > margin(plain)
    assert np.linalg.norm(center.base[:3]) <= np.linalg.norm(plain.base[:3])
    assert len(plain.bases_reaching(5)) > 0
    with pytest.raises(ik.errors.InputError, match="prefer"):
        solver.place_base(few, BOX, prefer="speed")


def test_grasps_have_a_palm_pose_by_their_contacts():
    solver = ik.Solver(ik.load_robot("kuka_lwr_barrett"))
    cup = ik.load_grasp("cup")
    place = solver.place_base([cup], ([-0.3, -0.3, 0], [0.3, 0.3, 0]), resolution=0.3)
    assert place.count == 1


def test_the_command_writes_the_placement(palms, tmp_path):
    np.savez(tmp_path / "palms.npz", palms=palms[:10])
    out = tmp_path / "place.json"
    region = ["--region", "-0.3", "-0.3", "0", "0.3", "0.3", "0", "--resolution", "0.3"]
    code = main(
        ["place-base", str(tmp_path / "palms.npz"), "--robot", "ur5e", *region, "--out", str(out)]
    )
    assert code == 0
    data = json.loads(out.read_text())
    assert data["count"] == sum(data["reached"]) <= data["upper_bound"] <= 10
    # Without a region, and with configurations instead of palm poses.
    np.savez(tmp_path / "found.npz", q=ik.load_robot("ur5e").random(np.random.default_rng(0), 4))
    words = [str(tmp_path / "found.npz"), "--robot", "ur5e", "--resolution", "0.5"]
    assert main(["place-base", *words, "--out", str(out)]) == 0
    assert json.loads(out.read_text())["count"] == 4


@pytest.mark.parametrize(
    ("grasps", "region", "name"),
    [
        (np.eye(4)[None], ik.Free([0, 0, 0, 0.1, 0, 0], [0, 0, 0, 0.2, 0, 0]), "region"),
        (np.eye(4)[None], ([1, 0, 0], [0, 0, 0]), "region"),
        (np.eye(4)[None], [1, 2], "region"),
        (np.eye(4), BOX, "grasps"),
        ([np.eye(4), ik.load_grasp("cup")], BOX, "grasps"),
    ],
)
def test_bad_input_is_refused(solver, grasps, region, name):
    with pytest.raises(ik.errors.InputError, match=rf"^{name}: .*expected"):
        solver.place_base(grasps, region)
