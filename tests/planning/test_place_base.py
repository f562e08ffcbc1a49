"""Base placement: the count is witnessed, the bound holds, bad input is refused."""

import json

import numpy as np
import pytest
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


@pytest.mark.parametrize(
    ("grasps", "region", "name"),
    [
        (np.eye(4)[None], ik.Free([0, 0, 0, 0.1, 0, 0], [0, 0, 0, 0.2, 0, 0]), "region"),
        (np.eye(4)[None], ([1, 0, 0], [0, 0, 0]), "region"),
        (np.eye(4)[None], [1, 2], "region"),
        (np.eye(4), BOX, "grasps"),
        ([ik.load_grasp("cup")], BOX, "grasps"),
    ],
)
def test_bad_input_is_refused(solver, grasps, region, name):
    with pytest.raises(ik.errors.InputError, match=rf"^{name}: .*expected"):
        solver.place_base(grasps, region)
