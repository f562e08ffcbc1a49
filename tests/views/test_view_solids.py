"""What is drawn: closed surfaces; a body that follows the robot; a camera that shows it."""

from __future__ import annotations

import numpy as np
import pytest

from casadi_ik.views.camera import camera_at
from casadi_ik.views.floor import floor_image
from casadi_ik.views.render import Layer, render
from casadi_ik.views.robot_body import robot_body
from casadi_ik.views.solids import Solid, arrow, ball, capsule, drum, rounded_prism
from casadi_ik.views.viewpoint import close_view, whole_view

AXIS = np.array([0.3, -0.5, 0.8])


def volume(solid: Solid) -> float:
    a, b, c = (solid.vertices[solid.faces[:, i]] for i in range(3))
    return float(np.einsum("ti,ti->", a, np.cross(b, c)) / 6)


SOLIDS = {
    "ball": (ball([1, 2, 3], 0.1, "red"), 4 / 3 * np.pi * 1e-3),
    "capsule": (
        capsule([0, 0, 0], AXIS, 0.1, "red"),
        np.pi * 1e-2 * np.linalg.norm(AXIS) + 4 / 3 * np.pi * 1e-3,
    ),
    "drum": (drum([0, 0, 1], AXIS, 0.1, 0.5, "red"), np.pi * 1e-2 * 0.5),
    "prism": (
        rounded_prism([[0, 0], [1, 0], [0, 1]], np.eye(4), -0.5, 0.5, 0.1, "red"),
        0.5 + 0.1 * (2 + np.sqrt(2)) + np.pi * 0.01,
    ),
    "arrow": (arrow([0, 0, 0], AXIS, 1.0, 0.05, "red"), None),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_solids_are_closed_and_outward(name: str) -> None:
    solid, expected = SOLIDS[name]
    edges = np.concatenate([solid.faces[:, [i, (i + 1) % 3]] for i in range(3)])
    there = {tuple(edge) for edge in edges.tolist()}
    assert len(there) == len(edges)
    assert there == {(b, a) for a, b in there}
    if expected is None:
        assert volume(solid) > 0
    else:
        assert volume(solid) == pytest.approx(expected, rel=0.03)


def test_fingertips_of_the_body_touch_their_contacts(robot) -> None:
    for q in robot.random(np.random.default_rng(1), 5):
        points, normals = robot.contacts(q)
        hand = np.concatenate([solid.vertices for solid in robot_body(robot, q).hand])
        gaps = np.linalg.norm(hand[None] - points[:, None], axis=2).min(axis=1)
        assert (gaps < 1.5e-3).all()
        tips = robot_body(robot, q).hand[-len(points) :]
        for tip, point, normal in zip(tips, points, normals, strict=True):
            assert ((tip.vertices - point) @ normal).max() < 1e-3  # nothing beyond the pad


def test_the_body_stands_on_the_floor(robot) -> None:
    body = robot_body(robot, robot.home)
    assert min(solid.vertices[:, 2].min() for solid in body.arm) > -1e-9


def test_the_camera_shows_all_points_within_its_margins() -> None:
    points = np.random.default_rng(2).normal(size=(30, 3))
    camera = camera_at(0.7, 0.3, points, (200, 120), (0.1, 0.05))
    seen = camera.project(points)
    assert seen[:, 0].min() >= 20 - 1e-9
    assert seen[:, 0].max() <= 180 + 1e-9
    assert seen[:, 1].min() >= 6 - 1e-9
    assert seen[:, 1].max() <= 114 + 1e-9
    nearer = camera.project(points + 0.1 * camera.towards)
    np.testing.assert_allclose(nearer[:, :2], seen[:, :2], atol=1e-9)
    np.testing.assert_allclose(nearer[:, 2], seen[:, 2] - 0.1)
    assert camera.towards @ [np.cos(0.7), np.sin(0.7), 0] == pytest.approx(np.cos(0.3))


def test_the_close_view_sets_the_fingertips_apart(robot, solution) -> None:
    azimuth, elevation = close_view(robot, solution.q)
    points, _ = robot.contacts(solution.q)
    camera = camera_at(azimuth, elevation, points, (100, 100))
    flat = (points @ np.stack([camera.right, camera.up]).T)[:, None]
    gaps = np.linalg.norm(flat - flat.swapaxes(0, 1), axis=2)[np.triu_indices(3, 1)]
    assert gaps.min() > 0.015


def test_the_whole_view_is_on_the_side_of_the_close_one() -> None:
    target = np.array([-0.8, 0.1, 0.4])
    for azimuth in np.linspace(0, 2 * np.pi, 9).tolist():
        view = whole_view(target, (azimuth, 0.1))
        assert np.cos(view[0] - azimuth) > -0.5
    assert whole_view(np.array([0, 0, 1.0]), (0.3, 0.1))[0] == 0.3


def test_the_nearer_solid_hides_the_other() -> None:
    near, far = ball([1, 0, 0], 0.2, "#ff0000"), ball([-1, 0, 0], 0.2, "#0000ff")
    camera = camera_at(0.0, 0.0, [[0, 0.3, 0.3], [0, -0.3, -0.3]], (41, 41))
    for solids in ([near, far], [far, near]):
        red, _, blue = render(camera, [Layer(solids)])[20, 20]
        assert red > 2 * blue
    behind = camera_at(np.pi, 0.0, [[0, 0.3, 0.3], [0, -0.3, -0.3]], (41, 41))
    red, _, blue = render(behind, [Layer([near, far])])[20, 20]
    assert blue > 2 * red


def test_layers_blend_and_hidden_marks_show_as_ghosts() -> None:
    front, mark = ball([1, 0, 0], 0.2, "#808080"), ball([0, 0, 0], 0.1, "#ff0000")
    camera = camera_at(0.0, 0.0, [[0, 0.3, 0.3], [0, -0.3, -0.3]], (41, 41))

    def redness(ghost: float) -> float:
        pixel = render(camera, [Layer([front]), Layer([mark], 1.0, ghost)])[20, 20]
        return float(pixel[0] - pixel[1])

    assert redness(0.0) == pytest.approx(0.0, abs=1e-9)
    assert redness(0.3) < redness(0.9)
    assert np.allclose(render(camera, [Layer([])]), 1.0)


def test_the_floor_has_the_shadow_below_the_body() -> None:
    thing = [ball([0, 0, 0.5], 0.1, "red")]
    camera = camera_at(0.0, 0.8, [[-0.5, -0.5, 0], [0.5, 0.5, 0.6]], (80, 80))
    image = floor_image(camera, thing, 0.0)
    x, y, _ = camera.project([0.0, 0.0, 0.0])
    assert image[int(y), int(x)] < image.max() - 0.15
    assert image.max() <= 1.0
    # Seen from the horizon there is no floor, and what is below it throws no shadow on it.
    level = camera_at(0.0, 0.0, [[0, -0.5, 0], [0, 0.5, 0.6]], (80, 80))
    assert floor_image(level, [ball([0, 0, -0.5], 0.1, "red")], 0.0).min() == 1.0
