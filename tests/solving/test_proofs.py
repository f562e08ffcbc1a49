"""Targets are unreachable only with a proof, never when reachable, and proofs can be verified."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robot_variants import derived_robot
from toy_robots import grasp_of, moved_targets, write_coupled_robot
from toy_robots import replace as put

import casadi_ik as ik
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.couplings import COUPLING_ROWS, Interval
from casadi_ik.model.couplings import Polynomial
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.proofs.boxes import box_contacts
from casadi_ik.solve.proofs.contact_tests import PointInPalm, pair_rows
from casadi_ik.solve.proofs.premises import arm_cones
from casadi_ik.solve.proofs.proof import Proof, ProofKind
from casadi_ik.solve.proofs.prove import PROVER_EFFORT, Prover

pytestmark = pytest.mark.usefixtures("usual_flags")


ROBOTS = ["kuka_lwr_barrett", "kuka_lwr_barrett_coupled", "ar10", "baxter_ar10"]


def batch_of_targets(
    targets: tuple[Array, Array], position: float, angle: float, limits: bool
) -> TargetBatch:
    return TargetBatch(*targets, ik.Tolerance(position, angle), limits)


def wrongly(robot: ik.ArmHand, prover: Prover, q: Array, problems: TargetBatch) -> int:
    """Return the number of proofs that would refute a box of hands around the hand of q."""
    places = robot.joints(q) | dict(zip(robot.actuators, q.T, strict=True))
    proofs = prover.prove(problems, prover.space.from_positions(places, problems))
    return sum(proof is not None for proof in proofs)


@pytest.fixture(scope="module", params=ROBOTS)
def any_robot(request: pytest.FixtureRequest) -> ik.ArmHand:
    return ik.load_robot(request.param)


@pytest.fixture(scope="module")
def prover(robot: ik.ArmHand) -> Prover:
    return Prover(robot.description)


@pytest.mark.parametrize("tolerance", [1e-12, 1e-6, 5e-3, 2e-2])
@pytest.mark.parametrize("limits", [True, False])
def test_reachable_targets_are_not_disproved(
    any_robot: ik.ArmHand, tolerance: float, limits: bool
) -> None:
    rng = np.random.default_rng(1)
    q = any_robot.random(rng, 12)
    chance = rng.random(q.shape)
    q[4:] = np.where(chance < 0.2, any_robot.lower, np.where(chance > 0.8, any_robot.upper, q))[4:]
    if not limits:
        turning = np.array([a.unit == "rad" for a in any_robot.description.actuators])
        q[:, turning] = rng.uniform(-9, 9, (12, turning.sum()))
    angle = 10 * tolerance
    # Contacts that can be reached only because of the tolerance.
    part = rng.choice([0.0, 0.9, 0.99]) if tolerance > 1e-9 else 0.0
    targets = moved_targets(any_robot.contacts(q), rng, part * tolerance, part * angle)
    problems = batch_of_targets(targets, tolerance, angle, limits)
    assert wrongly(any_robot, Prover(any_robot.description), q, problems) == 0


@settings(max_examples=15)
@given(
    place=st.lists(st.floats(0, 1), min_size=14, max_size=14),
    part=st.floats(0, 0.99),
    seed=st.integers(0, 2**32 - 1),
)
def test_targets_within_tolerance_are_not_disproved(
    robot: ik.ArmHand, prover: Prover, place: list[float], part: float, seed: int
) -> None:
    q = robot.lower + np.array(place) * (robot.upper - robot.lower)
    rng = np.random.default_rng(seed)
    targets = moved_targets(robot.contacts(q[None]), rng, part * 5e-3, part * np.deg2rad(3))
    assert (
        wrongly(robot, prover, q[None], batch_of_targets(targets, 5e-3, np.deg2rad(3), True)) == 0
    )


def test_wrong_hand_is_refuted(robot: ik.ArmHand, prover: Prover) -> None:
    """The refutation works: boxes around another hand are refuted."""
    q = robot.random(np.random.default_rng(8), 40)
    problems = batch_of_targets(robot.contacts(q), 5e-3, np.deg2rad(3), True)
    assert wrongly(robot, prover, q[::-1], problems) >= 38


def test_full_search_disproves_no_reachable_target(robot: ik.ArmHand, prover: Prover) -> None:
    q = robot.random(np.random.default_rng(9), 4)
    assert (
        prover.prove(batch_of_targets(robot.contacts(q), 5e-3, np.deg2rad(3), True)) == [None] * 4
    )


def rolling_targets(robot: ik.ArmHand, q: Array, rng: np.random.Generator) -> TargetBatch:
    """Return contacts that rolling pads reach at q (k, n), as far as the tolerance of 5 mm."""
    frames = robot.frames_at(q)
    _, balls = moved_targets((frames[..., :3, 3], frames[..., :3, 0]), rng, 0.0, 0.7)
    radii = np.array([finger.radius for finger in robot.description.fingers])[:, None]
    points = frames[..., :3, 3] + radii * (balls - frames[..., :3, 0])
    points, _ = moved_targets((points, balls), rng, 0.99 * 5e-3, 0.0)
    tolerance, free = ik.Tolerance(5e-3, np.deg2rad(3)), np.full_like(points, np.nan)
    return TargetBatch(points, free, tolerance, True, extra_vectors={"balls": balls})


@pytest.mark.parametrize("name", ["panda+allegro_right", "ur5e+leap", "shadow"])
def test_proofs_hold_for_rolling_pads(name: str) -> None:
    """Reachable contacts of rolling pads are not disproved, and contacts beyond reach are."""
    robot, rng = ik.load_robot(name), np.random.default_rng(3)
    q = robot.random(rng, 12)
    q = q[robot.beyond_limits(q) <= 0]
    prover, problems = Prover(robot.description), rolling_targets(robot, q, rng)
    assert wrongly(robot, prover, q, problems) == 0
    proofs = prover.prove(replace(problems.rows(slice(0, 3)), points=problems.points[:3] + 1.5))
    assert all(proof is not None for proof in proofs)
    assert proofs[0] is not None
    assert proofs[0].check(robot)
    # The same points with pads that need not roll are another target.
    assert not proofs[0].check(robot, replace(proofs[0].target, extra_vectors={}))
    sliding = {"planes": proofs[0].target.extra_vectors["balls"]}
    target = replace(proofs[0].target, extra_vectors=sliding)
    assert not replace(proofs[0], target=target).sealed().check(robot)


@pytest.mark.parametrize(
    ("name", "offset"),
    [("panda+allegro_right", [1.5, 0.0, 0.0]), ("two_pandas+allegro", [0.0, 0.0, 5.0])],
)
def test_rolling_pads_beyond_reach_are_unreachable(name: str, offset: list[float]) -> None:
    robot = ik.load_robot(name)
    solver = ik.Solver(robot)
    q = robot.home[None]
    reachable = rolling_targets(robot, q, np.random.default_rng(4))
    balls, points = reachable.extra_vectors["balls"], reachable.points + offset
    batch = solver.solve_batch(points, reachable.normals, balls=balls, diagnose=True)
    assert batch.status_names == ["UNREACHABLE"]
    grasp = ik.Grasp(
        {
            finger: ik.Contact(points[0, i], ball=balls[0, i])
            for i, finger in enumerate(robot.fingers)
        }
    )
    solution = solver.solve(grasp)
    assert solution.status is ik.Status.UNREACHABLE
    assert solution.diagnosis is not None
    assert solution.diagnosis.proof is not None
    assert solution.diagnosis.proof.check(robot)


def test_ignored_limits_and_tiny_tolerances_give_no_proof(robot: ik.ArmHand) -> None:
    rng = np.random.default_rng(4)
    q = rng.uniform(-np.pi, np.pi, (40, len(robot.actuators)))
    free = ik.Solver(robot, limits="ignore")
    assert "UNREACHABLE" not in free.solve_batch(*robot.contacts(q), diagnose=True).status_names
    strict = ik.Solver(robot, tolerance=ik.Tolerance(1e-12, 1e-12))
    targets = robot.contacts(robot.random(rng, 20))
    assert "UNREACHABLE" not in strict.solve_batch(*targets, diagnose=True).status_names


def polynomial_robot(folder: Path) -> ik.ArmHand:
    """Return a hand bent by a cam, where the joint reverses within the range of the motor."""
    path = write_coupled_robot(folder)
    put(
        folder / "parts" / "hand.yaml",
        "coupling: {kind: linear, of: left_3, ratio: -0.5, offset: 0.05}",
        "coupling: {kind: polynomial, of: left_3, coefficients: [0.05, -0.3, 0.4, -0.1]}",
    )
    return ik.load_robot(path)


@pytest.mark.parametrize(
    "make_robot",
    [
        lambda folder: ik.load_robot(write_coupled_robot(folder)),
        lambda folder: derived_robot(folder, wrist_offset=0.045),
        polynomial_robot,
    ],
    ids=["coupled", "bent", "cam"],
)
def test_coupled_mechanisms_and_other_arms(tmp_path: Path, make_robot) -> None:
    """Robots have chains of couplings, a prismatic thumb, or an arm without a closed form."""
    robot = make_robot(tmp_path)
    rng, prover = np.random.default_rng(5), Prover(robot.description)
    q = robot.random(rng, 200)
    q = q[robot.beyond_limits(q) <= 0][:16]
    targets = robot.contacts(q)
    for limits in (True, False):
        assert wrongly(robot, prover, q, batch_of_targets(targets, 1e-9, 1e-9, limits)) == 0
    centre = targets[0].mean(axis=1, keepdims=True)
    for points in (targets[0] + 5.0, centre + 9 * (targets[0] - centre)):
        proofs = prover.prove(batch_of_targets((points, targets[1]), 5e-3, 0.05, True))
        assert all(proof is not None for proof in proofs)
        assert all(proof.check(robot) for proof in proofs[:4])


@settings(max_examples=200, deadline=None)
@given(
    coefficients=st.lists(st.floats(-9, 9), min_size=2, max_size=6),
    ends=st.lists(st.floats(-4, 4), min_size=2, max_size=2),
)
def test_polynomial_bounds_hold(coefficients: list[float], ends: list[float]) -> None:
    """Both arithmetics give bounds, which are sharp for short intervals."""
    low, high = sorted(ends)
    value = COUPLING_ROWS[Polynomial].bounds(
        coupling := Polynomial("a", tuple(coefficients)), *map(np.atleast_1d, (low, high))
    )
    interval = COUPLING_ROWS[Polynomial].interval(coupling, Interval(ca.SX(low), ca.SX(high)))
    graph = [float(ca.evalf(end)) for end in (interval.lower, interval.upper)]
    values = coupling.joint_position(np.linspace(low, high, 101))
    for lower_bound, upper_bound in (graph, (value[0][0], value[1][0])):
        assert lower_bound <= values.min()
        assert values.max() <= upper_bound
    # The width of a monomial over the interval bounds the loss.
    size = sum(abs(c) * k * 4.0 ** (k - 1) for k, c in enumerate(coefficients))
    for lower_bound, upper_bound in (graph, (value[0][0], value[1][0])):
        assert upper_bound - lower_bound <= 4 * size * (high - low) + 1e-9 * (10 + size)


def impossible(robot: ik.ArmHand) -> dict[str, tuple[Array, Array]]:
    points, normals = robot.contacts(robot.random(np.random.default_rng(6), 12))
    centre = points.mean(axis=1, keepdims=True)
    return {
        "far": (points + np.array([1.8, 0, 0]), normals),
        "apart": (centre + 6 * (points - centre), normals),
        "shoulder": (points - centre + np.array([0, 0, 0.31]), normals),
    }


def test_proofs_can_be_verified(robot: ik.ArmHand, prover: Prover) -> None:
    kinds = set()
    for targets in impossible(robot).values():
        problems = batch_of_targets(targets, 5e-3, np.deg2rad(3), True)
        proofs = [proof for proof in prover.prove(problems) if proof is not None]
        assert len(proofs) >= 11
        for proof in proofs[:2]:
            assert proof.check(robot)
            assert proof.check(robot, proof.target)
            kinds.add(proof.kind)
    assert kinds == {ProofKind.HAND, ProofKind.REACH}


def test_finger_of_a_fixed_hand() -> None:
    robot = ik.load_robot("ar10")
    points, normals = robot.contacts(robot.home)
    points[2] += [0, 0.05, 0.05]
    (proof,) = Prover(robot.description).prove(
        batch_of_targets((points[None], normals[None]), 5e-3, np.deg2rad(3), True)
    )
    assert proof is not None
    assert (proof.kind, proof.fingers) == (ProofKind.FINGER, (robot.fingers[2],))
    assert proof.check(robot)


def test_corrupted_proof_fails(robot: ik.ArmHand, prover: Prover) -> None:
    """A changed proof fails also when it is sealed again."""
    targets = impossible(robot)
    separation, shoulder = (
        prover.prove(batch_of_targets(targets[name], 5e-3, np.deg2rad(3), True))[0]
        for name in ("apart", "shoulder")
    )
    assert isinstance(separation, Proof)
    assert isinstance(shoulder, Proof)
    loose = tuple(ik.Tolerance(1.0, 3.0) for _ in robot.fingers)
    tight = tuple(ik.Tolerance(1e-4, 1e-4) for _ in robot.fingers)
    reachable = batch_of_targets(robot.contacts(robot.home[None]), 5e-3, np.deg2rad(3), True)
    assert not replace(separation, tolerance=loose).sealed().check(robot)
    assert not replace(separation, tolerance=tight).sealed().check(robot)
    assert not replace(separation, fingers=()).sealed().check(robot)
    assert not replace(separation, fingers=("nobody",)).sealed().check(robot)
    assert not replace(separation, target=reachable).sealed().check(robot)
    assert not separation.check(robot, reachable)
    # Without the arm, contacts in the shoulder are valid.
    assert not replace(shoulder, kind=ProofKind.HAND).sealed().check(robot)


def test_every_number_of_a_proof_matters(robot: ik.ArmHand, prover: Prover) -> None:
    points, normals = robot.contacts(robot.random(np.random.default_rng(10), 20))
    normals[:, 0] *= -1
    proofs = prover.prove(batch_of_targets((points, normals), 5e-3, np.deg2rad(3), True))
    proof = next(proof for proof in proofs if proof is not None and proof.boxes > 1)
    assert proof.check(robot)
    assert not replace(proof, boxes=proof.boxes + 2).check(robot)
    assert not replace(proof, seal="").check(robot)


def test_shoulder_in_the_palm_frame(robot: ik.ArmHand, prover: Prover) -> None:
    """The palm is nearer than the elbow bends: before, half a million boxes did not prove it."""
    points = [[0.077, 0.033, 0.422], [-0.098, -0.059, 0.317], [-0.037, 0.008, 0.542]]
    normals = np.array([[-0.849, -0.424, 0.316], [0.462, -0.108, 0.88], [0.013, 0.06, -0.998]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    target = np.array([points]), normals[None]
    (proof,) = prover.prove(batch_of_targets(target, 5e-3, np.deg2rad(3), True))
    assert proof is not None
    assert proof.kind is ProofKind.REACH
    assert proof.boxes < 2000
    assert proof.check(robot)


def test_box_bounds_hold_inside_the_box(robot: ik.ArmHand, prover: Prover) -> None:
    """Return rows of contact pairs and of shoulder and wrist, some nearly feasible."""
    rng = np.random.default_rng(3)
    bounds, closest = _bounds(prover), 0.0
    for _ in range(300):
        q = robot.random(rng, 1)
        tolerance = 10.0 ** rng.uniform(-6, -2), 10.0 ** rng.uniform(-5, -1)
        points, normals = moved_targets(robot.contacts(q), rng, *tolerance)
        problems = batch_of_targets((points, normals), *tolerance, True)
        places = robot.joints(q) | dict(zip(robot.actuators, q.T, strict=True))
        (positions,) = prover.space.from_positions(places, problems)
        lower, upper = prover.space.box(problems)
        half_width = (upper - lower) * 10.0 ** rng.uniform(-3, -0.5)
        middle = positions + rng.uniform(-1, 1, len(positions)) * half_width
        tolerances = np.tile(tolerance, (3, 1)), np.ones((3, 2))
        low, high = np.maximum(middle - half_width, lower), np.minimum(middle + half_width, upper)
        values, widths, ends = (
            np.array(part).ravel() for part in bounds(low, high, points[0], normals[0], *tolerances)
        )
        assert (np.abs(values) <= widths).all()
        closest = max(closest, float((np.abs(values) / widths).max()))
        palm, wrist = robot.palm(q[0]), prover._arm.wrist
        distance = np.linalg.norm(palm[:3, 3] + palm[:3, :3] @ wrist - prover._arm.shoulder)
        assert ends[0] <= distance <= ends[1]
    assert closest > 0.8


def _bounds(prover: Prover) -> ca.Function:
    """Return values and widths of the rows, and the ends of the distance of shoulder and wrist."""
    h = len(prover.space.coordinates)
    shapes = {"lower": (h, 1), "upper": (h, 1), "points": (3, 3), "normals": (3, 3)}
    shapes |= {"tolerance": (3, 2), "constrained": (3, 2)}
    p = {name: ca.SX.sym(name, *shape) for name, shape in shapes.items()}
    p["depths"] = ca.SX(3, 1)
    ranges = prover.space.intervals(p["lower"], p["upper"])
    contacts = box_contacts(prover.space, ranges, (p["upper"] - p["lower"]) / 2, p, True)
    rows = [row for a, b in combinations(contacts, 2) for row in pair_rows(a, b)]
    point_in_palm = PointInPalm.from_point(contacts, ca.SX(ca.DM(prover._arm.shoulder)))
    min_distance, max_distance, _ = point_in_palm.distances(ca.SX(ca.DM(prover._arm.wrist)))
    outputs = [ca.vertcat(*(getattr(row, name) for row in rows)) for name in ("value", "width")]
    return ca.Function(
        "bounds", [p[name] for name in shapes], [*outputs, ca.vertcat(min_distance, max_distance)]
    )


@pytest.mark.slow
def test_limits_of_shoulder_and_wrist_are_part_of_the_reach(
    robot: ik.ArmHand, prover: Prover
) -> None:
    """Return palms that need a wrist 0.8 rad beyond its limit."""
    rng = np.random.default_rng(12)
    q, wrist = robot.random(rng, 8), robot.actuators.index("lwr_joint_6")
    q[:, wrist] = robot.upper[wrist] + 0.8
    problems = batch_of_targets(robot.contacts(q), 1e-3, np.deg2rad(0.5), True)
    proofs = [proof for proof in prover.prove(problems) if proof is not None]
    assert proofs
    assert {proof.kind for proof in proofs} == {ProofKind.REACH}
    assert proofs[0].check(robot)
    cones = arm_cones(robot.description)
    assert cones is not None
    np.testing.assert_allclose(cones.cosines(problems), np.cos(np.deg2rad(120)), atol=1e-6)


def test_unproved_targets_are_not_unreachable(
    robot: ik.ArmHand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lines state the best answer, the number of starts and the likely reason as such."""
    solver = ik.Solver(robot)
    monkeypatch.setattr(
        solver._engine.diagnostician._prover,
        "prove",
        lambda problems, max_boxes: [None] * len(problems),
    )
    points, normals = ik.load_grasp("cup").arrays(robot.fingers)
    solution = solver.solve(grasp_of(robot, points - [1, 0, 0], normals))
    assert solution.status is ik.Status.NOT_FOUND
    diagnosis = solution.diagnosis
    assert diagnosis is not None
    assert (diagnosis.proof, diagnosis.established) == (None, False)
    assert diagnosis.searches > 2
    assert diagnosis.lines[0] == f"likely: {ik.solve.Reason.REACH}"
    assert any(line.startswith("not proved; no solution from") for line in diagnosis.lines)


def test_near_misses_use_few_boxes(robot: ik.ArmHand, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only small boxes exclude these targets; each took a quarter of a second."""
    solver, boxes = ik.Solver(robot), []
    prove = solver._engine.diagnostician._prover.prove

    def noted(problems: TargetBatch, max_boxes: Array) -> list[Proof | None]:
        boxes.extend(max_boxes.tolist())
        return prove(problems, max_boxes=max_boxes)

    monkeypatch.setattr(solver._engine.diagnostician._prover, "prove", noted)
    rng = np.random.default_rng(2)
    points, normals = robot.contacts(robot.random(rng, 10))
    solver.solve_batch(*moved_targets((points, normals), rng, 1e-2, 0.11), diagnose=True)
    points[0, 0] += 0.2
    solver.solve_batch(points[:1], normals[:1], diagnose=True)
    assert boxes[-1] == PROVER_EFFORT.max_boxes
    assert min(boxes) < PROVER_EFFORT.max_boxes / 4


def test_log_codes_are_stable() -> None:
    assert [status.name for status in sorted(ik.Status)] == [
        *("INVALID", "RUNNING", "SOLVED", "STALLED", "ITERATION_LIMIT", "UNREACHABLE", "NOT_FOUND"),
        *("COLLISION", "NEAREST"),
    ]
