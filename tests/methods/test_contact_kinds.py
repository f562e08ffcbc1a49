"""Contacts of every kind with every method: solved, verified, logged, repeated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from toy_robots import PAPER_METHODS, near_home
from trace_checks import TraceRecorder

import casadi_ik as ik
from casadi_ik import logs

METHODS = ("hand-first", "thumb-first", "ipopt")
SIDE, UP = np.array([0.6, 0.0, 0.8]), np.array([0.0, 0.0, 1.0])
RADIUS = 9.5e-3
"""Radius of the pads of the Barrett hand [m]."""
TIGHT = ik.Tolerance(1e-4, 1e-3)


def frames(robot, seed=3):
    """Return contact frames (f, 4, 4) of a configuration near home."""
    return robot.contact_frames(near_home(robot, np.random.default_rng(seed), 1)[0])


def contact(kind: str, frame: np.ndarray) -> ik.Contact:
    """Return a contact that a fingertip at this frame meets, displaced where allowed."""
    point, normal, tangent = frame[:3, 3], frame[:3, 0], frame[:3, 1]
    across = np.cross(UP, SIDE)
    leaning = np.cos(0.6) * normal + np.sin(0.6) * tangent
    return {
        "point": lambda: ik.Contact(point),
        "point and normal": lambda: ik.Contact(point, normal),
        "pose": lambda: ik.Contact(point, normal, tangent=tangent),
        "line": lambda: ik.Contact(point + 0.03 * SIDE, line=SIDE),
        "line and normal": lambda: ik.Contact(point - 0.02 * SIDE, normal, line=SIDE),
        "plane": lambda: ik.Contact(point + 0.03 * across, plane=UP),
        "plane and pose": lambda: ik.Contact(
            point + 0.02 * across, normal, tangent=tangent, plane=UP
        ),
        "ball": lambda: ik.Contact(point + RADIUS * (leaning - normal), ball=leaning),
        "ball and normal": lambda: ik.Contact(
            point + RADIUS * (leaning - normal), normal, ball=leaning
        ),
        "direction": lambda: ik.Contact(direction=normal),
    }[kind]()


KINDS = (
    *("point", "point and normal", "pose", "line", "line and normal", "plane"),
    *("plane and pose", "ball", "ball and normal", "direction"),
)


def off(frame: np.ndarray, requested: ik.Contact) -> tuple[float, float]:
    """Return distance [m] and angle [rad] of a fingertip from a contact, NaN where free."""
    beside, angle = frame[:3, 3] - requested.point, np.nan
    distance = float(np.linalg.norm(beside))
    if requested.line is not None:
        distance = float(np.linalg.norm(beside - requested.line * (requested.line @ beside)))
    if requested.plane is not None:
        distance = abs(float(requested.plane @ beside))
    if requested.ball is not None:
        middle = frame[:3, 3] - RADIUS * frame[:3, 0]
        distance = float(np.linalg.norm(middle + RADIUS * requested.ball - requested.point))
    if requested.normal is not None:
        angle = float(np.arccos(np.clip(requested.normal @ frame[:3, 0], -1, 1)))
    if requested.tangent is not None:
        axes = np.stack(
            [requested.normal, requested.tangent, np.cross(requested.normal, requested.tangent)], 1
        )
        cosine = (np.trace(axes.T @ frame[:3, :3]) - 1) / 2
        angle = float(np.arccos(np.clip(cosine, -1, 1)))
    return distance, angle


def pinocchio_frames(oracle, q):
    """Return contact frames (f, 4, 4) by pinocchio from the written URDF."""
    poses, contact_frames = oracle.frames(q), []
    for finger in oracle.robot.description.fingers:
        pose = poses[f"{finger.name}_contact"]
        axes = [finger.normal, finger.tangent, np.cross(finger.normal, finger.tangent)]
        frame = pose.copy()
        frame[:3, :3] = pose[:3, :3] @ np.stack(axes, axis=1)
        contact_frames.append(frame)
    return np.array(contact_frames)


@pytest.fixture(scope="module")
def solvers(robot):
    """Solvers in the virtual machine, because every combination of kinds needs a kernel."""
    return {name: ik.Solver(robot, name, TIGHT, compiled=False) for name in METHODS}


def test_contact_frames_match_pinocchio(robot, coupled_robot, oracle, coupled_oracle, rng):
    for model, model_oracle in ((robot, oracle), (coupled_robot, coupled_oracle)):
        for q in model.random(rng, 5):
            np.testing.assert_allclose(
                model.contact_frames(q), pinocchio_frames(model_oracle, q), atol=1e-9
            )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("method", METHODS)
def test_every_kind_is_solved(robot, oracle, solvers, method, kind):
    """The thumb has that kind, the others point and normal; pinocchio verifies the answer."""
    at = frames(robot)
    contacts = {
        name: contact(kind if name == robot.thumb else "point and normal", frame)
        for name, frame in zip(robot.fingers, at, strict=True)
    }
    solution = solvers[method].solve(ik.Grasp(contacts))
    assert solution.success, solution
    frames_reached = pinocchio_frames(oracle, solution.q)
    for i, name in enumerate(robot.fingers):
        distance, angle = off(frames_reached[i], contacts[name])
        verdict = solution.contacts[name]
        np.testing.assert_allclose(verdict.position_error, distance, atol=1e-8)
        np.testing.assert_allclose(verdict.angle_error, angle, atol=1e-6)
        assert not distance > TIGHT.position
        assert not angle > TIGHT.angle


@pytest.mark.parametrize("free", ["finger", "normal", "thumb", "all normals", "all but one finger"])
@pytest.mark.parametrize(
    ("method", "tolerance", "min_solved"),
    [
        ("hand-first", ik.Tolerance(), 1),
        ("hand-first", ik.Tolerance(1e-6, 1e-6), 1),
        ("thumb-first", ik.Tolerance(), 0.93),
    ],
)
def test_free_components_have_no_rows(robot, rng, method, tolerance, min_solved, free):
    """Free components are solved, and the log has no error of them."""
    points, normals = robot.contacts(robot.random(rng, 120))
    rows, finger = np.arange(120), rng.integers(0, 3, 120)
    if free == "finger":
        points[rows, finger] = normals[rows, finger] = np.nan
    elif free == "normal":
        normals[rows, finger] = np.nan
    elif free == "thumb":
        thumb = robot.fingers.index(robot.thumb)
        points[:, thumb] = normals[:, thumb] = np.nan
    elif free == "all normals":
        normals[:] = np.nan
    else:
        points[:, :2] = normals[:, :2] = np.nan
    solver, recorder = ik.Solver(robot, method, tolerance), TraceRecorder()
    batch = solver.solve_batch(points, normals)
    assert batch.success.mean() >= min_solved
    assert batch.limits_ok.all()
    solver.solve_batch(points[:5], normals[:5], log=recorder)
    (block,) = recorder.blocks
    is_given = [
        np.repeat(~np.isnan(x[:5, :, 0]), block.batch.iterations, 0) for x in (points, normals)
    ]
    measured = np.isfinite(block.rows["position_error"]).any(axis=1)
    assert measured.any()
    for name, expected_mask in zip(("position_error", "angle_error"), is_given, strict=True):
        np.testing.assert_array_equal(
            np.isfinite(block.rows[name])[measured], expected_mask[measured]
        )


@pytest.mark.parametrize("method", METHODS)
def test_full_poses_of_all_fingers(robot, oracle, solvers, method):
    """All fingers have poses, more than the hand has joints for, taken from a configuration."""
    at = frames(robot)
    contacts = dict(zip(robot.fingers, (contact("pose", frame) for frame in at), strict=True))
    solution = solvers[method].solve(ik.Grasp(contacts))
    assert solution.success, solution
    for frame, goal in zip(pinocchio_frames(oracle, solution.q), at, strict=True):
        np.testing.assert_allclose(frame[:3, :3], goal[:3, :3], atol=2e-3)


@pytest.mark.parametrize("method", PAPER_METHODS)
def test_paper_methods_name_their_requirements(robot, method):
    points, normals, tangents = (frames(robot)[None, :, :3, i] for i in (3, 0, 1))
    solver = ik.Solver(robot, method, finger_step="closed-form", compiled=False)
    with pytest.raises(ik.errors.RowError, match=r"row 0 .*'thumb'"):
        solver.solve_batch(points, normals, tangents=tangents)
    with pytest.raises(ik.errors.RowError, match="points: row 0 "):
        solver.solve(ik.Grasp({"thumb": ik.Contact(direction=UP)}))


@pytest.mark.parametrize("method", METHODS)
def test_answers_are_independent_of_other_targets(robot, solvers, method):
    """The contact kinds of a target select its kernel, and its number the random numbers."""
    at = np.array([frames(robot, seed) for seed in range(4)])
    points, normals, tangents = at[..., :3, 3], at[..., :3, 0], at[..., :3, 1].copy()
    planes = np.full_like(points, np.nan)
    tangents[1], tangents[2, 1:], planes[3, 0] = np.nan, np.nan, UP
    arrays = {"tangents": tangents, "planes": planes}
    solver = solvers[method]
    batch = solver.solve_batch(points, normals, seed=3, **arrays)
    assert batch.success.all()
    blocks = [
        {"points": points[i : i + 1], "normals": normals[i : i + 1]}
        | {name: array[i : i + 1] for name, array in arrays.items()}
        for i in range(4)
    ]
    separate_answers = [block.solution for block in solver.solve_blocks(blocks, seed=3)]
    for i, answer in enumerate(separate_answers):
        np.testing.assert_array_equal(answer.q[0], batch.q[i])
        np.testing.assert_array_equal(answer.angle_error[0], batch.angle_error[i])
        assert answer.iterations[0] == batch.iterations[i]


def test_batch_of_directions_only(robot, solvers):
    """Directions are solved beside points and normals, with the answers of single grasps."""
    at = np.array([frames(robot, seed) for seed in range(3)])
    points, normals = at[..., :3, 3].copy(), at[..., :3, 0].copy()
    directions = np.full_like(normals, np.nan)
    directions[1, 0] = 2 * normals[1, 0]
    points[1, 0] = normals[1, 0] = np.nan
    solver = solvers["hand-first"]
    batch = solver.solve_batch(points, normals, directions=directions)
    assert batch.success.all()
    assert np.isnan(batch.position_error[1, 0])
    assert batch.angle_error[1, 0] < TIGHT.angle
    block = {"points": points, "normals": normals, "directions": directions}
    (streamed,) = solver.solve_blocks([block])
    np.testing.assert_array_equal(streamed.solution.q, batch.q)
    assert not streamed.faults
    contacts = {
        name: ik.Contact(points[1, i], normals[1, i]) for i, name in enumerate(robot.fingers) if i
    }
    grasp = ik.Grasp({robot.fingers[0]: ik.Contact(direction=directions[1, 0]), **contacts})
    single_solution = solver.solve(grasp)
    np.testing.assert_allclose(single_solution.q, batch.q[1], atol=1e-12)
    with pytest.raises(ik.errors.RowError, match=r"directions:.*1.*0"):
        solver.solve_batch(at[..., :3, 3], at[..., :3, 0], directions=directions)


def test_rows_of_a_log_belong_to_their_solves(robot, solvers, tmp_path: Path):
    """Targets of several kinds are solved in groups, but logged in their order."""
    at = np.array([frames(robot, seed) for seed in range(4)])
    points, normals, tangents = at[..., :3, 3], at[..., :3, 0], at[..., :3, 1].copy()
    tangents[[0, 2]] = np.nan
    path = tmp_path / "kinds.mcap"
    batch = solvers["hand-first"].solve_batch(points, normals, tangents=tangents, log=path)
    log = ik.logs.open(path)
    for i in range(4):
        solve = logs.one_solve(log, i)
        assert len(solve.rows) == batch.iterations[i]
        np.testing.assert_array_equal(solve.target_points, points[i])
        assert ("tangents" in solve.target_more) == (i % 2 == 1)
        if i % 2:
            np.testing.assert_allclose(solve.target_more["tangents"], tangents[i], atol=1e-15)


def test_log_contains_the_targets(robot, solvers, tmp_path: Path):
    """The logged target has the same answer when it is solved again."""
    kinds = dict(zip(robot.fingers, ("plane and pose", "line", "direction"), strict=True))
    grasp = ik.Grasp(
        {
            name: contact(kinds[name], frame)
            for name, frame in zip(robot.fingers, frames(robot), strict=True)
        }
    )
    path = tmp_path / "asked.mcap"
    first = solvers["ipopt"].solve(grasp, log=path)
    solve = logs.one_solve(ik.logs.open(path))
    expected_arrays = {
        "points": solve.target_points,
        "normals": solve.target_normals,
        **solve.target_more,
    }
    for name, contact_asked in grasp.contacts.items():
        row = robot.fingers.index(name)
        for vector in ("point", "normal", "tangent", "line", "plane", "ball"):
            vector_of_contact = getattr(contact_asked, vector)
            logged = expected_arrays.get(f"{vector}s", np.full((3, 3), np.nan))[row]
            np.testing.assert_array_equal(
                logged, np.full(3, np.nan) if vector_of_contact is None else vector_of_contact
            )
    free = np.isnan(solve.target_points[:, 0])
    vectors = {}
    for row, name in enumerate(robot.fingers):
        arrays = {
            key[:-1]: array[row]
            for key, array in solve.target_more.items()
            if not np.isnan(array[row]).any()
        }
        normal = solve.target_normals[row]
        if free[row]:
            vectors[name] = ik.Contact(direction=normal)
        else:
            vector_of_contact = None if np.isnan(normal).any() else normal
            vectors[name] = ik.Contact(solve.target_points[row], vector_of_contact, **arrays)
    second = solvers["ipopt"].solve(ik.Grasp(vectors))
    np.testing.assert_allclose(second.q, first.q, atol=1e-6)
    assert second.status == first.status


def test_unsolved_pose_is_explained(robot, oracle, solvers):
    """The diagnosis includes tangents: leaving one free is the remedy."""
    at = frames(robot)
    normals, tangents = at[:, :3, 0], at[:, :3, 1].copy()
    tangents[1] = np.cos(1.2) * tangents[1] + np.sin(1.2) * np.cross(normals[1], tangents[1])
    contacts = {
        name: ik.Contact(at[i, :3, 3], normals[i], tangent=tangents[i])
        for i, name in enumerate(robot.fingers)
    }
    solution = solvers["hand-first"].solve(ik.Grasp(contacts))
    assert not solution.success
    for i, frame in enumerate(pinocchio_frames(oracle, solution.q)):
        missed = solution.contacts[robot.fingers[i]]
        expected = off(frame, contacts[robot.fingers[i]])
        np.testing.assert_allclose((missed.position_error, missed.angle_error), expected, atol=1e-6)
    assert solution.diagnosis is not None
    assert solution.diagnosis.nearest["finger_2"].angle_error > 0.1
    assert ("normal", "finger_2") in [
        (item.part, item.finger) for item in solution.diagnosis.released
    ]


FILE = """\
robot: kuka_lwr_barrett
contacts:
  thumb: {{{thumb}}}
  finger_2: {{point: [0.5, 0.0, 0.6], normal: [0, 1, 0]}}
"""


@pytest.mark.parametrize(
    ("thumb", "expected"),
    [
        ("point: [0.5, 0.1, 0.6], normal: [0, -1, 0], tangent: [0, 0, 2]", {"tangent": UP}),
        ("point: [0.5, 0.1, 0.6], line: [0, 0, 3]", {"line": UP, "normal": None}),
        ("point: [0.5, 0.1, 0.6], plane: [0, 0, 1], normal: [0, -1, 0]", {"plane": UP}),
        ("point: [0.5, 0.1, 0.6], ball: [0, 0, 2]", {"ball": UP, "normal": None}),
        ("direction: [0, 0, 0.5]", {"normal": UP, "tangent": None}),
    ],
)
def test_grasp_files(tmp_path: Path, thumb, expected):
    path = tmp_path / "grasp.yaml"
    path.write_text(FILE.format(thumb=thumb))
    thumb_contact = ik.load_grasp(path).contacts["thumb"]
    for name, value in expected.items():
        np.testing.assert_array_equal(getattr(thumb_contact, name), value)
    assert np.isnan(thumb_contact.point).all() == ("direction" in thumb)


@pytest.mark.parametrize(
    ("thumb", "message"),
    [
        ("normal: [0, -1, 0]", "contacts.thumb.point: missing"),
        ("point: [0, 0, 1], tangent: [0, 0, 1]", "thumb.tangent: is given without a normal"),
        (
            "point: [0, 0, 1], normal: [0, -1, 0], tangent: [0, -1, 1]",
            r"thumb.tangent: found \[0.0, -0.7071\d+, 0.7071\d+\] at 45 deg to the normal",
        ),
        ("point: [0, 0, 1], line: [0, 0, 0]", "thumb.line: found .* expected a direction"),
        ("point: [0, 0, 1], line: [0, 0, 1], plane: [0, 0, 1]", "thumb.line and plane: found both"),
        ("point: [0, 0, 1], plane: [0, 0, 1], ball: [0, 0, 1]", "thumb.plane and ball: found both"),
        ("point: [0, 0, 1], direction: [0, 0, 1]", "thumb.direction: is given together with point"),
        ("point: [0, 0, 1], tangents: [0, 0, 1]", "tangents"),
    ],
)
def test_bad_grasp_files(tmp_path: Path, thumb, message):
    path = tmp_path / "grasp.yaml"
    path.write_text(FILE.format(thumb=thumb))
    with pytest.raises(ik.errors.DescriptionError, match=message) as caught:
        ik.load_grasp(path)
    assert str(path) in str(caught.value)


def test_bad_arrays(robot, solvers):
    """The error names row and finger."""
    usual = np.repeat(frames(robot)[None], 5, axis=0)
    points, normals, tangents = (usual[:, :, :3, i].copy() for i in (3, 0, 1))
    solver, lone = solvers["hand-first"], normals.copy()
    lone[4, 1] = np.nan

    def bad(value):
        return np.concatenate([tangents[:4], value])

    for arrays, facing, message in (
        (
            {"tangents": bad(tangents[4:] + 0.01 * normals[4:])},
            normals,
            "0: tangent: .* expected",
        ),
        ({"tangents": tangents}, lone, "1: tangent: is given without a normal"),
        ({"tangents": bad(np.where(tangents[4:] > 0, np.inf, tangents[4:]))}, normals, "finite"),
        ({"tangents": bad(0 * tangents[4:])}, normals, "0: tangent: .* not zero"),
        ({"lines": tangents, "planes": bad(tangents[4:])}, normals, "line and plane: found both"),
    ):
        with pytest.raises(ik.errors.RowError, match=message) as caught:
            solver.solve_batch(points, facing, **arrays)
        assert caught.value.row == (0 if "lines" in arrays else 4)
    with pytest.raises(ik.errors.InputError, match=r"tangents:.*\(5, 3\).*\(5, 3, 3\)"):
        solver.solve_batch(points, normals, tangents=tangents[..., 0])


def test_sliding_contacts_give_no_proof(robot, solvers):
    """The point is far out of reach, but the plane through it is not."""
    at = frames(robot)
    far_point = at[0, :3, 3] + [5.0, 5.0, 0.0]
    other_contacts = {
        name: ik.Contact(at[i, :3, 3], at[i, :3, 0]) for i, name in enumerate(robot.fingers) if i
    }
    for first, status in (
        (ik.Contact(far_point, at[0, :3, 0]), ik.Status.UNREACHABLE),
        (ik.Contact(far_point, at[0, :3, 0], plane=UP), ik.Status.SOLVED),
    ):
        grasp = ik.Grasp({**other_contacts, robot.fingers[0]: first})
        assert solvers["hand-first"].solve(grasp).status is status
