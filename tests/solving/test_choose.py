"""Choice of the best of many grasps."""

from __future__ import annotations

from dataclasses import replace

import coal
import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik import errors

COUNT = 12


@pytest.fixture(scope="module")
def careful(robot) -> ik.Solver:
    return ik.Solver(robot, scene=ik.load_scene("table"))


@pytest.fixture(scope="module")
def cup() -> ik.Grasp:
    return ik.load_grasp("cup")


@pytest.fixture(scope="module")
def candidates(cup) -> list[ik.Grasp]:
    """Return grasps of the cup turned about it, in its frame; some of them are out of reach."""
    cup_in_frame = cup.in_object_frame()
    angles = np.linspace(0, 2 * np.pi, COUNT, endpoint=False)
    return [
        replace(cup_in_frame.at(rotated_pose(angle)), object_pose=np.eye(4)) for angle in angles
    ]


def rotated_pose(angle: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return pose


def scored(robot, q, prefer, q0):
    if prefer == "limits":
        half_range = (robot.upper - robot.lower) / 2
        return (np.minimum(q - robot.lower, robot.upper - q) / half_range).min(axis=1)
    return -np.linalg.norm((q - q0) / (robot.upper - robot.lower), axis=1)


@pytest.mark.parametrize("prefer", ["limits", "q0"])
def test_ranking_is_sorted_by_score(solver, robot, candidates, cup, prefer):
    ranked = solver.choose(candidates, cup.object_pose, robot.home, 20, prefer, per_candidate=None)
    q = np.stack([choice.solution.q for choice in ranked])
    scores = np.array([choice.score for choice in ranked])
    np.testing.assert_allclose(scores, scored(robot, q, prefer, robot.home), atol=1e-12)
    assert (np.diff(scores) <= 0).all()
    assert len(ranked) > 5
    # Single solves of the candidates are not better.
    single_rankings = [
        solver.choose([choice], cup.object_pose, robot.home, 1, prefer) for choice in candidates
    ]
    best = max(choice[0].score for choice in single_rankings if len(choice))
    assert ranked[0].score == pytest.approx(best, abs=1e-9)


def test_answers_solve_their_candidates_and_differ(solver, robot, candidates, cup):
    ranked = solver.choose(candidates, object_pose=cup.object_pose, limit=30)
    parts = []
    for choice in ranked:
        points, normals = candidates[choice.candidate].at(cup.object_pose).arrays(robot.fingers)
        position, angle = robot.errors(choice.solution.q, points, normals)
        assert (position <= 5e-3).all()
        assert (angle <= np.deg2rad(3)).all()
        assert robot.beyond_limits(choice.solution.q) <= 1e-9
        assert choice.solution.success
        parts.append(choice.solution.q / (robot.upper - robot.lower))
    for i, part in enumerate(parts):
        assert all(np.abs(part - other_part).max() >= 0.25 for other_part in parts[:i])
    assert ranked.answered + sum(ranked.failures.values()) == ranked.candidates == COUNT
    assert len(solver.choose(candidates, cup.object_pose, limit=3)) == 3
    alike = solver.choose(candidates, cup.object_pose, limit=200, apart=0)
    assert len(alike) == alike.answered >= len(ranked)


def test_per_candidate_limits_the_answers(solver, candidates, cup):
    for max_solutions, prefer in ((1, None), (2, None), (2, "manipulability"), (None, None)):
        ranked = solver.choose(
            candidates,
            cup.object_pose,
            limit=60,
            prefer=prefer,
            apart=0,
            per_candidate=max_solutions,
        )
        places = np.bincount([choice.candidate for choice in ranked])
        assert places.max() == max_solutions if max_solutions else places.max() > 2
        assert ranked.answered == np.count_nonzero(places)


def test_object_frame_candidates_match_moved_ones(solver, candidates, cup):
    placed = [candidate.at(cup.object_pose) for candidate in candidates]
    ranked_placed = solver.choose(placed)
    ranked_by_pose = solver.choose(candidates, object_pose=cup.object_pose)
    # Of candidates that are equal up to rounding, either may be first.
    scores = [
        [candidate.score for candidate in ranked] for ranked in (ranked_by_pose, ranked_placed)
    ]
    np.testing.assert_allclose(*scores, atol=1e-9)
    assert len(ranked_by_pose) == len(ranked_placed) > 3
    q_by_candidate = {candidate.candidate: candidate.solution.q for candidate in ranked_placed}
    for candidate in ranked_by_pose:
        np.testing.assert_allclose(
            candidate.solution.q, q_by_candidate[candidate.candidate], atol=1e-6
        )
    # A candidate with an object pose moves with it.
    ranked_moved = solver.choose(
        [cup, *candidates], object_pose=cup.object_pose, limit=50, apart=0, per_candidate=None
    )
    np.testing.assert_allclose(
        [candidate.score for candidate in ranked_moved if candidate.candidate == 0],
        [candidate.score for candidate in ranked_moved if candidate.candidate == 1],
        atol=1e-6,
    )


def test_answers_are_collision_free_for_coal(careful, robot, candidates, cup):
    ranked = careful.choose(candidates, object_pose=cup.object_pose, limit=20)
    assert len(ranked) >= 3
    shapes = robot.description.shapes.capsules
    table = ik.load_scene("table")
    (box, place) = table.items["table"].parts[0]
    pose = table.items["table"].pose @ place
    still = careful._engine.check.model.is_fixed
    for choice in ranked:
        assert choice.solution.clearance >= 0
        links = robot.links(choice.solution.q)
        for shape in shapes:
            if shape.covers >= 0 or still(shape.link):
                continue
            length = float(np.linalg.norm(shape.half_axis))
            turn = np.eye(3)
            if length:
                z = shape.half_axis / length
                side = np.cross(z, np.eye(3)[int(np.abs(z).argmin())])
                side /= np.linalg.norm(side)
                turn = np.column_stack([side, np.cross(z, side), z])
            link = links[shape.link]
            separation = coal.distance(
                coal.Capsule(shape.radius, 2 * length),
                coal.Transform3s(link[:3, :3] @ turn, link[:3, :3] @ shape.center + link[:3, 3]),
                coal.Box(*(2 * box.size)),
                coal.Transform3s(pose[:3, :3], pose[:3, 3]),
                coal.DistanceRequest(True),
                coal.DistanceResult(),
            )
            assert separation >= -1e-6, shape.link


def test_reasons_are_counted(robot, candidates, cup):
    ball = {"kind": "sphere", "radius": 0.3, "xyz": cup.object_pose[:3, 3].tolist()}
    solver = ik.Solver(robot, scene=ik.Scene({"balloon": ball}))
    far_pose = rotated_pose(0.0)
    far_pose[:3, 3] = [5.0, 0.0, 0.0]
    unreachable = replace(candidates[0].at(far_pose), object_pose=np.eye(4))
    ranked = solver.choose([*candidates, unreachable], cup.object_pose)
    assert len(ranked) == ranked.answered == 0
    assert sum(ranked.failures.values()) == COUNT + 1
    named = [reason for reason in ranked.failures if reason.startswith("COLLISION: ")]
    assert named
    assert all("balloon" in reason for reason in named)
    assert any(not reason.startswith("COLLISION") for reason in ranked.failures)
    assert "0 of 13 " in str(ranked)


def test_given_hand_ranks_the_arm_alone(solver, robot, rng):
    """The limit margin of the hand is the same for all answers."""
    hand = slice(7, None)
    q = robot.random(rng, 30)
    q[:, hand] = np.where(rng.random(q[:, hand].shape) < 0.3, robot.upper[hand], q[:, hand])
    grasps = [
        ik.Grasp(
            palm=robot.palm(q_row),
            posture=dict(zip(robot.actuators[hand], q_row[hand], strict=True)),
        )
        for q_row in q
    ]
    ranked = solver.choose(grasps, prefer="limits", limit=5)
    arms = np.stack([q_row.solution.q for q_row in ranked])[:, :7]
    half_range = (robot.upper - robot.lower)[:7] / 2
    margins = (np.minimum(arms - robot.lower[:7], robot.upper[:7] - arms) / half_range).min(axis=1)
    np.testing.assert_allclose([q_row.score for q_row in ranked], margins, atol=1e-12)
    assert ranked[0].score > 0.2
    assert len({q_row.candidate for q_row in ranked}) == 5


def test_custom_preference(solver, robot, candidates, cup):
    def straight(robot_asked: ik.ArmHand, q: np.ndarray) -> np.ndarray:
        assert robot_asked.name == robot.name
        return -np.abs(q[:, 0])

    ranked = solver.choose(candidates, cup.object_pose, prefer=straight, limit=5)
    np.testing.assert_allclose(
        [choice.score for choice in ranked], [-abs(choice.solution.q[0]) for choice in ranked]
    )
    usual = solver.choose(candidates, cup.object_pose, limit=5)
    assert ranked[0].score >= max(-abs(choice.solution.q[0]) for choice in usual)


def test_manipulability_and_clearance_rank(solver, careful, candidates, cup):
    for ranking_solver, prefer in ((solver, "manipulability"), (careful, "clearance")):
        scores = [
            c.score for c in ranking_solver.choose(candidates, cup.object_pose, prefer=prefer)
        ]
        assert scores == sorted(scores, reverse=True)
        assert scores
        assert scores[0] > 0


def test_grasps_with_different_fingers_rank_together(solver, candidates, cup):
    pinch = ik.Grasp(
        {name: candidates[0].contacts[name] for name in ("thumb", "finger_2")}, object=cup.object
    )
    ranked = solver.choose([*candidates, pinch], cup.object_pose, limit=100, apart=0)
    assert COUNT in {choice.candidate for choice in ranked}
    assert 0 in {choice.candidate for choice in ranked}


def test_bad_choices_are_refused(solver, robot, candidates, cup):
    skewed = np.eye(4)
    skewed[0, 0] = 2.0
    unknown = np.eye(4)
    unknown[0, 3] = np.nan
    for words, text in (
        ({"grasps": []}, r"^grasps: "),
        ({"object_pose": unknown}, "object_pose: holds NaN or infinity, expected finite numbers"),
        ({"object_pose": skewed}, "object_pose: the matrix is not a rotation"),
        ({"object_pose": np.zeros((3, 4))}, r"object_pose: found shape \(3, 4\)"),
        ({"prefer": "best"}, "prefer: found 'best', expected one of limits"),
        ({"prefer": "clearance"}, "prefer: 'clearance'.*scene"),
        ({"prefer": lambda _, q: q}, r"prefer: .*shape.*\(\d+,\)"),
        ({"prefer": lambda _, q: q[:, 0] * np.nan}, "prefer: .*NaN"),
        ({"limit": 0}, "limit: found 0, expected an integer >= 1"),
        ({"per_candidate": 0}, "per_candidate: found 0, expected an integer >= 1"),
        ({"apart": 2}, "apart: found 2, expected a number from 0 to 1"),
        ({"q0": [0.0]}, r"q0: found shape \(1,\)"),
        ({"grasps": [candidates[0], "cup"]}, r"grasps\[1\]: found str, expected a Grasp"),
    ):
        with pytest.raises(errors.InputError, match=text) as raised:
            solver.choose(**{"grasps": candidates, "object_pose": cup.object_pose} | words)
        assert "\n" not in str(raised.value)
    with pytest.raises(errors.UnsupportedError, match=r"method: 'thumb-first'.*'hand-first'"):
        ik.Solver(robot, "thumb-first", compiled=False).choose(candidates, cup.object_pose)


@pytest.mark.parametrize("name", ["ur5e+robotiq_2f85", "two_ur10e+panda_hand"])
@pytest.mark.parametrize("prefer", ["q0", "limits"])
def test_free_rotation_of_the_palm_is_searched(name, prefer):
    """Opposed fingertips leave a rotation free; no rotation scores better than the choice."""
    robot, rng = ik.load_robot(name), np.random.default_rng(2)
    solver = ik.Solver(robot)
    for q in robot.random(rng, 5):
        start = np.clip(q + rng.uniform(-0.3, 0.3, len(q)), robot.lower, robot.upper)
        points, normals = robot.contacts(q)
        scores = []
        for disturbance in (0.0, 1e-15):
            moved_points = points + disturbance * rng.standard_normal(points.shape)
            contacts = map(ik.Contact, moved_points, normals)
            grasp = ik.Grasp(dict(zip(robot.fingers, contacts, strict=True)))
            ranked = solver.choose([grasp], q0=start, prefer=prefer)
            scores.append(ranked[0].score)
        known_score = scored(robot, q[None], prefer, start)[0]
        assert min(scores) >= known_score - 1e-3
        assert np.ptp(scores) < 1e-3
        best = solver.solve_all(grasp, q0=start, prefer=prefer)[0]
        assert scored(robot, best.q[None], prefer, start)[0] >= known_score - 1e-3
