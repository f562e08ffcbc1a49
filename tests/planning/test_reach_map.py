"""Reachability maps: verdicts, files, and input that is refused."""

from dataclasses import replace

import numpy as np
import pytest
from commands import main
from scipy.spatial.transform import Rotation

import casadi_ik as ik
from casadi_ik.planning.reach.check import JointChain, pose_frames
from casadi_ik.planning.reach.decide import PalmReach, exact_family
from casadi_ik.planning.reach.reach_map import ReachMap

BOX = ([-0.9, -0.9, -0.2], [0.9, 0.9, 1.0])


@pytest.fixture(scope="module")
def solver():
    return ik.Solver(ik.load_robot("ur5e"))


@pytest.fixture(scope="module")
def reach(solver):
    return solver.reach_map(BOX, orientations=4, resolution=0.3)


def test_every_reachable_cell_has_a_witness(solver, reach):
    assert reach.meaning == "exact"
    assert sum(reach.counts.values()) == reach.status.size
    assert min(reach.counts["REACHABLE"], reach.counts["UNREACHABLE"]) > 50
    for position in np.flatnonzero(reach.share > 0)[:20]:
        is_reachable = reach.status[position] == "REACHABLE"
        palms = solver.robot.palm(reach.q[position][is_reachable])
        assert np.allclose(palms, reach.palms(position)[is_reachable], rtol=0, atol=1e-10)
    assert np.isnan(reach.q[reach.status != "REACHABLE"]).all()


def test_palm_poses_are_decided_like_cells(solver, reach):
    palms = np.concatenate([reach.palms(i) for i in range(0, len(reach.positions), 7)])
    listed = solver.reach_map(palms, keep_q=False)
    assert listed.q is None
    assert listed.shape == ()
    assert np.array_equal(listed.status[:, 0], reach.status[::7].ravel())


def test_verdicts_are_confirmed_independently_and_wrong_ones_are_rejected(solver, reach):
    check = reach.check(solver, 4)
    assert sorted(set(check.status)) == ["REACHABLE", "UNREACHABLE"]
    assert check.is_confirmed.all()
    assert np.array_equal(reach.status[tuple(check.cells.T)], check.status)
    # Every verdict is falsified: REACHABLE becomes UNREACHABLE, and the other way round.
    flipped = np.array([0, 2, 1], dtype=np.int8)[reach.code]
    q = np.broadcast_to(reach.q[reach.code == 1][0], reach.q.shape)
    forged = replace(reach, code=flipped, q=q).check(solver, 2, max_boxes=500)
    assert len(forged.cells) == 4
    assert not forged.is_confirmed.any()


def test_a_check_never_excludes_the_configuration_of_a_palm_pose():
    robot = ik.load_robot("kuka_lwr4")
    chain = JointChain(robot.description)
    configurations = robot.random(np.random.default_rng(0), 5)
    for q, palm in zip(configurations, robot.palm(configurations), strict=True):
        assert chain.is_reached(palm, q, 1e-10)
        for width in (1e-6, 0.05, 0.6):
            lower = np.maximum(q - width, chain.lower)[None]
            upper = np.minimum(q + 2 * width, chain.upper)[None]
            low, high, _ = chain.contract(lower, upper, pose_frames(palm, 1e-10))
            assert (low <= q).all()
            assert (q <= high).all()
            assert len(low) == 1


def test_few_palm_poses_are_open_within_tolerance(solver, reach):
    palms = np.concatenate([reach.palms(i) for i in range(0, len(reach.positions), 7)])
    tolerant = solver.reach_map(palms, meaning="within tolerance", keep_q=False)
    assert tolerant.counts["OPEN"] < 0.2 * len(palms)
    exact = reach.status[::7].ravel()
    assert not np.any((tolerant.status[:, 0] == "UNREACHABLE") & (exact == "REACHABLE"))


def test_no_pose_within_tolerance_of_a_reachable_one_is_refuted(solver):
    rng = np.random.default_rng(0)
    palms = solver.robot.palm(solver.robot.random(rng, 30))
    palms[:, :3, 3] += rng.uniform(-0.0028, 0.0028, (30, 3))
    angles = rng.uniform(-0.052, 0.052, 30)
    for palm, angle in zip(palms, angles, strict=True):
        palm[:3, :3] = palm[:3, :3] @ axis_turn(angle)
    family = exact_family(solver.robot)
    arm = PalmReach(solver.robot, family)
    assert not arm.refute_within(palms, ik.Tolerance(0.005, np.radians(3))).any()


def axis_turn(angle):
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def test_threads_give_the_same_map(solver, reach):
    repeated = solver.reach_map(BOX, orientations=4, resolution=0.3, jobs=2)
    assert np.array_equal(repeated.code, reach.code)
    assert np.array_equal(repeated.q, reach.q, equal_nan=True)


def test_maps_are_written_and_read(reach, tmp_path):
    reach.save(tmp_path / "map.npz")
    repeated = ReachMap.load(tmp_path / "map.npz")
    assert (repeated.robot, repeated.meaning, repeated.shape) == (
        reach.robot,
        reach.meaning,
        reach.shape,
    )
    assert np.array_equal(repeated.code, reach.code)
    reach.to_ply(tmp_path / "map.ply")
    data = (tmp_path / "map.ply").read_bytes()
    header, _, vertices = data.partition(b"end_header\n")
    assert f"element vertex {(reach.share > 0).sum()}".encode() in header
    assert len(vertices) == 19 * (reach.share > 0).sum()
    positions, share = reach.layer_shares("z", 0.4)
    assert positions.shape[:2] == share.shape == reach.shape[:2]
    with pytest.warns(DeprecationWarning, match="layer_shares"):
        assert np.array_equal(reach.slice("z", 0.4)[1], share)
    (tmp_path / "text.npz").write_text("no map")
    with pytest.raises(ik.errors.InputError, match=r"text\.npz"):
        ReachMap.load(tmp_path / "text.npz")


def test_an_arm_without_a_closed_form_has_witnesses_only():
    solver = ik.Solver(ik.load_robot("xarm6"), compiled=False)
    reach = solver.reach_map(([0.3, 0, 0.2], [0.6, 0.3, 0.5]), orientations=1, resolution=0.3)
    assert reach.meaning == "within tolerance, sampled"
    assert reach.counts["UNREACHABLE"] == 0
    assert reach.counts["REACHABLE"] > 0
    with pytest.raises(ik.errors.UnsupportedError, match="meaning"):
        solver.reach_map(BOX, meaning="exact")


def test_a_sampled_map_finds_what_the_solver_finds():
    """Palm poses far from the nearest reachable one are not tried; none of these has a solution."""
    robot = ik.load_robot("so101")
    solver, rng = ik.Solver(robot), np.random.default_rng(5)
    palms = robot.palm(robot.random(rng, 120))
    turns = np.concatenate([0.9 * np.deg2rad(3.0) * np.ones(60), np.pi * rng.random(60)])
    axes = rng.normal(size=(120, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    palms[:, :3, :3] = Rotation.from_rotvec(turns[:, None] * axes).as_matrix() @ palms[:, :3, :3]
    reach = solver.reach_map(palms)
    solved = solver.solve_palms(palms, robot.home).success
    np.testing.assert_array_equal(reach.status.ravel() == "REACHABLE", solved)
    assert solved[:60].all()
    assert not solved[60:].all()


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"region": ([0, 0, 0], [1, 1, 0])}, "region"),
        ({"region": [1.0, 2.0]}, "region"),
        ({"region": BOX, "resolution": 1e-4}, "resolution"),
        ({"region": BOX, "resolution": 0.0}, "resolution"),
        ({"region": BOX, "orientations": 0}, "orientations"),
        ({"region": BOX, "orientations": np.zeros((2, 4))}, "orientations"),
        ({"region": BOX, "meaning": "roughly"}, "meaning"),
    ],
)
def test_bad_input_is_refused(solver, arguments, name):
    with pytest.raises(ik.errors.InputError, match=rf"^{name}: .*expected"):
        solver.reach_map(**arguments)
    if name == "region":
        with pytest.raises(ik.errors.UnsupportedError, match="reach_map"):
            ik.Solver(ik.load_robot("allegro_right")).reach_map(BOX)


def test_the_command_writes_map_and_picture(tmp_path):
    box = ["--region", "0", "0", "0", "0.6", "0.6", "0.6", "--resolution", "0.3"]
    files = ["--out", str(tmp_path / "m.npz"), "--picture", str(tmp_path / "m.png")]
    assert main(["map", "ur5e", *box, "--orientations", "2", *files]) == 0
    assert ReachMap.load(tmp_path / "m.npz").shape == (3, 3, 3)
    assert (tmp_path / "m.png").stat().st_size > 1000
    flat = ["--region", "0", "0", "0", "0.6", "0.6", "0"]
    assert main(["map", "ur5e", *flat, "--out", str(tmp_path / "flat.npz")]) == 2
    assert not (tmp_path / "flat.npz").exists()
