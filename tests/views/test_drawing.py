"""Drawings: closed surfaces, bodies that follow the robot, and cameras that show them."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
import pyvista as pv

import casadi_ik as ik
from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import (
    Drawable,
    bodies_at,
    close_view,
    contact_marks,
    ground_height,
    nearest_target_point,
    view_axes,
    visual_bodies,
)
from casadi_ik.app.drawing.surfaces import ball, drum, ring, rod
from casadi_ik.app.pictures import draw_solution, show
from casadi_ik.app.pictures.scene3d import Scene3D

pytestmark = pytest.mark.opengl

AXIS = np.array([0.3, -0.5, 0.8])
ORIGIN = np.zeros(3)
BESIDE = np.array([1.0, 0, 0])

SHAPES = {
    "capsule": (
        rod(ORIGIN, AXIS, 0.1),
        np.pi * 1e-2 * np.linalg.norm(AXIS) + 4 / 3 * np.pi * 1e-3,
    ),
    "ball": (ball(0.1), 4 / 3 * np.pi * 1e-3),
    "drum": (drum(BESIDE, AXIS, 0.1, 0.5), np.pi * 1e-2 * 0.5),
    "ring": (ring(BESIDE, AXIS, 0.1, 0.02), 2 * np.pi**2 * 0.1 * 1e-4),
}


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_are_closed_and_of_their_size(name: str) -> None:
    shape, expected = SHAPES[name]
    surface = shape.surface
    poly_data = pv.PolyData.from_regular_faces(surface.points, surface.triangles)
    assert poly_data.n_open_edges == 0
    corners = surface.points[surface.triangles]  # outwards: the volume is positive
    volume = np.linalg.det(corners - surface.points.mean(axis=0)).sum() / 6
    assert volume == pytest.approx(expected, rel=0.05)


def test_fingertips_of_the_body_touch_their_contacts(robot) -> None:
    for q in robot.random(np.random.default_rng(1), 5):
        points, normals = robot.contacts(q)
        pads = [body_part for body_part in bodies_at(robot, q) if body_part.role == "pad"]
        for body_part, point, normal in zip(pads, points, normals, strict=True):
            corners = body_part.surface.points
            assert np.linalg.norm(corners - point, axis=1).min() < 1.5e-3
            assert ((corners - point) @ normal).max() < 1e-3  # nothing beyond the pad


def test_a_link_without_a_shape_is_rods_to_what_it_carries() -> None:
    body = ik.load_robot("two_pandas+allegro")
    trunk, links = body.description.trunk_link, body.links(body.home)
    assert trunk not in {capsule.link for capsule in body.description.shapes.capsules}
    rods = [
        capsule.transformed(links[trunk]).surface.points
        for capsule in visual_bodies(body)
        if capsule.frame == trunk
    ]
    for side in ("left", "right"):
        for end in (links[trunk], links[f"{side}_panda_base"]):
            distances = np.linalg.norm(np.concatenate(rods) - end[:3, 3], axis=1)
            assert distances.min() < 0.036


@pytest.mark.parametrize(
    ("name", "arm", "hand"),
    [
        ("kuka_lwr_barrett", {"lwr_base", "lwr_link_3"}, {"bh_base"}),
        ("g1+dex3", {"pelvis", "torso_link", "left_elbow_link"}, {"left_dex3_base"}),
        ("allegro_right", set(), {"allegro_base"}),
    ],
)
def test_links_are_of_the_arm_or_of_a_hand(name: str, arm: set[str], hand: set[str]) -> None:
    roles = {
        body_part.frame: body_part.role
        for body_part in visual_bodies(ik.load_robot(name))
        if body_part.role != "pad"
    }
    assert {link for link in arm | hand if roles[link] == "arm"} == arm


@pytest.mark.parametrize("name", ["kuka_lwr_barrett", "g1+dex3"])
def test_the_ground_is_below_all_of_a_robot(name: str) -> None:
    robot = ik.load_robot(name)
    body = bodies_at(robot, robot.home)
    heights = [body_part.surface.points[:, 2].min() for body_part in body]
    assert -2e-3 < ground_height(robot) - min(heights) < 0
    scene = ik.Scene({"pit": {"kind": "box", "size": [1, 1, 1], "xyz": [0, 0, -3]}})
    assert ground_height(robot, scene) == pytest.approx(-3.501)


@pytest.mark.parametrize(
    ("changed", "legend", "solids"),
    [
        ({}, "contact, pad normal", 2),
        ({"normal": None}, "contact", 1),
        ({"tangent": 1}, "contact, pad normal, second axis (shorter)", 3),
        ({"line": 2}, "line (rod), pad normal", 2),
        ({"plane": 0}, "plane (ring), pad normal", 2),
    ],
)
def test_every_kind_of_contact_has_its_marks(robot, solution, changed, legend, solids) -> None:
    frames = robot.contact_frames(solution.q)
    contacts = {}
    for frame, finger in zip(frames, robot.fingers, strict=True):
        vectors = {"normal": frame[:3, 0]}
        for name, axis in changed.items():
            vectors[name] = None if axis is None else frame[:3, axis]
        contacts[finger] = ik.Contact(frame[:3, 3] + 0.01 * frame[:3, 1], **vectors)
    grasp = ik.Grasp(contacts)
    marks = contact_marks(robot, solution.q, grasp, dict.fromkeys(robot.fingers, palette.MET))
    assert sum(mark.role == "target" for mark in marks) == solids * len(robot.fingers)
    assert {mark.color for mark in marks if mark.role == "reached"} == {palette.MET}
    (words, *_) = draw_solution(robot, solution, grasp, dpi=40).legends[0].get_texts()
    assert words.get_text() == f"target: {legend}"


def test_the_place_asked_for_is_the_nearest_that_a_contact_allows() -> None:
    point, tip = np.array([0.1, 0.2, 0.3]), np.array([0.5, 0.7, 0.9])
    assert (nearest_target_point(ik.Contact(point), tip) == point).all()
    np.testing.assert_allclose(
        nearest_target_point(ik.Contact(point, line=[0, 0, 2]), tip), [0.1, 0.2, 0.9]
    )
    np.testing.assert_allclose(
        nearest_target_point(ik.Contact(point, plane=[0, 0, 2]), tip), [0.5, 0.7, 0.3]
    )
    assert (nearest_target_point(ik.Contact(direction=[1, 0, 0]), tip) == tip).all()


@pytest.fixture
def stage():
    with closing(Scene3D()) as scene_3d:
        yield scene_3d


def test_the_camera_shows_all_points_within_its_margins(stage) -> None:
    points = np.random.default_rng(2).normal(size=(30, 3))
    stage.aim((0.7, 0.3), points, (200, 120), (0.1, 0.05))
    pixels = stage.project(points)
    assert pixels[:, 0].min() >= 20 - 1e-6
    assert pixels[:, 0].max() <= 180 + 1e-6
    assert pixels[:, 1].min() >= 6 - 1e-6
    assert pixels[:, 1].max() <= 114 + 1e-6
    right, up, towards = view_axes((0.7, 0.3))
    assert towards @ [np.cos(0.7), np.sin(0.7), 0] == pytest.approx(np.cos(0.3))
    np.testing.assert_allclose(stage.project(points + towards), pixels, atol=1e-6)
    pixel_shift = stage.project(points + 0.1 * right + 0.1 * up) - pixels
    assert (pixel_shift * [1, -1] > 1).all()


def test_what_is_drawn_is_where_it_is_projected_to(stage) -> None:
    points = np.array([[0.0, 0.2, 0.3], [0.1, -0.4, 0.2]])
    stage.add("ball", [Drawable("ball", ball(0.02, points[0]), "#ff0000")])
    stage.aim((0.3, 0.4), points, (121, 81), (0.2, 0.2))
    image = stage.render()
    rows, columns = np.nonzero(image[..., 3] > 0.5)
    x, y = stage.project(points)[0]
    assert (columns.mean() + 0.5, rows.mean() + 0.5) == pytest.approx((x, y), abs=0.6)


def test_the_floor_has_the_shadow_below_the_body(stage) -> None:
    drawables = [Drawable("ball", ball(0.1, (0.2, 0.3, 0.5)), "#ff0000")]
    stage.add_floor(0.0, drawables)
    stage.aim((0.4, 0.8), [[-0.5, 0, 0], [0.5, 0, 0], [0, -0.5, 0], [0, 0.5, 0]], (80, 80))
    image = stage.render("floor")
    dark = 1 - image[..., 0]
    x, y = stage.project([[0.2, 0.3, 0.0]])[0]
    assert dark[int(y), int(x)] > 0.2
    x, y = stage.project([[0.2, -0.08, 0.0]])[0]
    assert 0.0 < dark[int(y), int(x)] < 0.12


def test_the_close_view_sets_the_fingertips_apart(robot, solution) -> None:
    points, _ = robot.contacts(solution.q)
    flat = (points @ view_axes(close_view(robot, solution.q))[:2].T)[:, None]
    gaps = np.linalg.norm(flat - flat.swapaxes(0, 1), axis=2)[np.triu_indices(3, 1)]
    assert gaps.min() > 0.015


def test_show_gives_a_plotter_to_export(robot, grasp, tmp_path) -> None:
    plotter = show(robot, robot.home, grasp, window=False)
    plotter.export_gltf(str(tmp_path / "robot.gltf"))
    plotter.close()
    assert (tmp_path / "robot.gltf").stat().st_size > 100_000
    show(robot, robot.home, window=False).close()
    with pytest.raises(ik.errors.InputError):
        show(robot, np.zeros(3), window=False)


def test_without_opengl_there_is_an_error_and_no_crash(monkeypatch) -> None:
    monkeypatch.setattr("pyvista.Plotter", NoOpenGL)
    with pytest.raises(ik.errors.PictureError, match="no OpenGL"):
        Scene3D()


class NoOpenGL:
    """Plotter on a machine without X, EGL and OSMesa."""

    def __init__(self, **_) -> None:
        self.render_window = self

    def Initialize(self) -> None:
        pass

    def IsCurrent(self) -> bool:
        return False
