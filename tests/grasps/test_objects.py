"""Objects: shipped files load, shapes keep their geometry, bad files are named clearly."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik import model as grasps

NAMES = [name for name in ik.shipped_names("objects") if name != "golf_ball"]
"""Objects with shipped grasps; a golf ball is too small for most hands."""

SHAPES: tuple[grasps.Shape, ...] = (
    grasps.Sphere(diameter=0.08, source="x"),
    grasps.Cylinder(diameter=0.06, height=0.1, source="x"),
    grasps.EllipticCylinder(width=0.09, depth=0.05, height=0.12, source="x"),
    grasps.EllipticCylinder(width=0.03, depth=0.12, height=0.07, source="x"),
    grasps.Box(size=(0.04, 0.09, 0.17), source="x"),
    grasps.BentCapsule(diameter=0.036, length=0.19, width=0.069, source="x"),
)

GOOD = """\
name: ball
description: a ball
frame: origin in the middle
shape: {kind: sphere, diameter: 60 mm, source: list}
mass: {value: 0.1 kg, source: list}
sources: {list: somewhere}
"""


def test_every_kind_of_shape_is_tested():
    assert {type(shape) for shape in SHAPES} == set(get_args(grasps.Shape))


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(7).uniform(-0.15, 0.15, (400, 3))


def shape_id(shape: grasps.Shape) -> str:
    return type(shape).__name__


@pytest.mark.parametrize("name", NAMES)
def test_shipped_object(name: str) -> None:
    item = grasps.load_object(name)
    assert isinstance(item, grasps.GraspObject)
    assert item.name == name
    assert 0.01 < item.mass < 1.2
    assert {"list", "primitive"} <= set(item.sources)
    vertices, _ = item.mesh()
    extent = np.ptp(vertices, axis=0)
    assert np.all((extent > 0.03) & (extent < 0.26))
    assert np.abs(item.signed_distance(vertices)).max() < 1e-12


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("cup", (0.055, 0.055, 0.060)),
        ("apple", (0.075, 0.075, 0.075)),
        ("banana", (0.190, 0.069, 0.036)),
        ("cracker_box", (0.060, 0.158, 0.210)),
        ("tomato_soup_can", (0.066, 0.066, 0.101)),
        ("bleach_cleanser", (0.098, 0.065, 0.250)),
        ("mustard_bottle", (0.085, 0.050, 0.175)),
        ("potted_meat_can", (0.097, 0.050, 0.082)),
    ],
)
def test_published_dimensions(name: str, size: tuple[float, float, float]) -> None:
    # The tips of the banana are round, so that its bounding box follows the geometry of the tube.
    vertices, _ = grasps.load_object(name).mesh(256)
    np.testing.assert_allclose(
        np.ptp(vertices, axis=0), size, atol=3e-3 if name == "banana" else 5e-5
    )


@pytest.mark.parametrize("shape", SHAPES, ids=shape_id)
def test_normal_is_the_gradient_of_the_distance(shape: grasps.Shape, points: np.ndarray) -> None:
    step = 1e-6
    gradient = np.stack(
        [
            (shape.signed_distance(points + step * e) - shape.signed_distance(points - step * e))
            / (2 * step)
            for e in np.eye(3)
        ],
        axis=1,
    )
    error = np.abs(gradient - shape.normal(points)).max(axis=1)
    # Inside, the distance has ridges, where the difference quotient straddles two faces.
    assert np.quantile(error, 0.98) < 1e-6


@pytest.mark.parametrize("shape", SHAPES, ids=shape_id)
def test_distance_leads_to_the_surface(shape: grasps.Shape, points: np.ndarray) -> None:
    distance, normal = shape.signed_distance(points), shape.normal(points)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-12)
    foot = points - distance[:, None] * normal
    assert np.abs(shape.signed_distance(foot)).max() < 1e-12
    assert np.any(distance < 0)
    assert np.any(distance > 0)


@pytest.mark.parametrize("shape", SHAPES, ids=shape_id)
def test_distance_is_the_distance_to_the_mesh(shape: grasps.Shape, points: np.ndarray) -> None:
    vertices, faces = shape.mesh(96)
    # The nearest of points spread over all triangles is within one spacing of the distance.
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    weights = [(i / 12, j / 12) for i in range(13) for j in range(13 - i)]
    cloud = np.concatenate([a + u * (b - a) + v * (c - a) for u, v in weights])
    spacing = 0.012
    sample = points[:25]
    nearest = np.array([np.linalg.norm(cloud - p, axis=1).min() for p in sample])
    assert np.abs(np.abs(shape.signed_distance(sample)) - nearest).max() < spacing
    assert np.all(nearest >= np.abs(shape.signed_distance(sample)) - 1e-4)


@pytest.mark.parametrize("shape", SHAPES, ids=shape_id)
def test_mesh_is_closed_and_faces_outward(shape: grasps.Shape) -> None:
    vertices, faces = shape.mesh(48)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    directed = {(int(i), int(j)) for i, j in edges}
    assert len(directed) == len(edges)
    assert all((j, i) in directed for i, j in directed)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0
    rng = np.random.default_rng(3)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    is_inside = shape.signed_distance(rng.uniform(low, high, (20000, 3))) < 0
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert volume == pytest.approx(is_inside.mean() * np.prod(high - low), rel=0.04)


@pytest.mark.parametrize("shape", SHAPES, ids=shape_id)
def test_single_points_and_the_centre(shape: grasps.Shape) -> None:
    assert shape.signed_distance([0.0, 0.0, 0.0]).shape == ()
    assert shape.signed_distance([0.0, 0.0, 0.0]) < 0
    normal = shape.normal([0.0, 0.0, 0.0])
    assert normal.shape == (3,)
    assert np.linalg.norm(normal) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("old", "new", "key", "says"),
    [
        ("diameter: 60 mm", "diameter: -60 mm", "shape.diameter", "found -0.06, expected > 0"),
        ("diameter: 60 mm", "diameter: .nan", "shape.diameter", "finite number"),
        ("diameter: 60 mm", "diameter: wide", "shape.diameter", "`float`"),
        ("diameter: 60 mm", "radius: 30 mm", "shape", "diameter"),
        ("kind: sphere", "kind: blob", "shape.kind", "blob"),
        ("0.1 kg", "0 kg", "mass.value", "found 0, expected > 0"),
        ("source: list}\nmass", "source: guess}\nmass", "shape.source", "guess"),
        ("value: 0.1 kg, source: list", "value: 0.1 kg, source: ''", "mass.source", "empty"),
        ("name: ball", "name: ball\ncolour: red", "(top level)", "colour"),
        ("frame: origin in the middle\n", "", "(top level)", "frame"),
        ("name: ball", "name: ball\nname: again", "", "appears twice"),
        ("name: ball", "name: [ball", "", "not valid YAML"),
        (
            "{kind: sphere, diameter: 60 mm,",
            "{kind: bent-capsule, diameter: 36 mm, length: 190 mm, width: 30 mm,",
            "shape.width",
            "between the diameter",
        ),
        ("{kind: sphere, diameter: 60 mm,", "{kind: box, size: [1, 2],", "shape.size", "length"),
    ],
)
def test_bad_object_file(tmp_path: Path, old: str, new: str, key: str, says: str) -> None:
    path = tmp_path / "ball.yaml"
    assert old in GOOD
    path.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(ik.errors.DescriptionError) as caught:
        grasps.load_object(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert key in message
    assert says in message
    assert "\n" not in message


def test_good_object_file(tmp_path: Path) -> None:
    path = tmp_path / "ball.yaml"
    path.write_text(GOOD)
    item = grasps.load_object(path)
    assert item.shape == grasps.Sphere(diameter=0.06, source="list")
    assert item.signed_distance([[0.04, 0, 0], [0, 0, 0]]) == pytest.approx([0.01, -0.03])


def test_unknown_object() -> None:
    with pytest.raises(ik.errors.UnknownNameError, match=r"'teapot'.*apple"):
        grasps.load_object("teapot")
    with pytest.raises(ik.errors.DescriptionError, match="no such file"):
        grasps.load_object("nowhere/teapot.yaml")
