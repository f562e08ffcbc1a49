"""A grasped object may be a mesh, or several convex parts that form one object."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from make_grasp_sets import made

import casadi_ik as ik
from casadi_ik import model as grasps

ROBOT = "panda+allegro_right"


def _box(size: tuple[float, float, float], at: tuple[float, float, float]) -> trimesh.Trimesh:
    box: Any = trimesh.creation.box(size)
    box.apply_translation(at)
    return box


def _arch() -> list[trimesh.Trimesh]:
    """Write a handle in convex pieces: two posts and a beam around a hole of 1 by 1."""
    posts = [_box((0.2, 0.2, 1.0), (side * 0.6, 0.0, 0.0)) for side in (-1, 1)]
    return [*posts, _box((1.4, 0.2, 0.2), (0.0, 0.0, 0.6))]


def _written(path: Path, parts: list[trimesh.Trimesh]) -> Path:
    mesh: Any = trimesh.util.concatenate(parts)
    mesh.export(path)
    return path


def _grasp_file(folder: Path, thumb_at: np.ndarray) -> Path:
    """Write a file of one grasp whose thumb is at a point of the object frame."""
    path = folder / "set.npy"
    arrays = {
        "trans": np.zeros((1, 3)),
        "rot": np.eye(3)[None],
        "joint_angles": np.full((1, 16), 0.4),
    }
    np.save(path, np.array(arrays, dtype=object))
    point = ik.load_candidates(path, ROBOT, take="contacts")[0].contacts["thumb"].point
    arrays["trans"] = (thumb_at - point)[None]
    np.save(path, np.array(arrays, dtype=object))
    return path


@pytest.mark.parametrize("kind", ["obj", "stl", "ply"])
def test_mesh_distances_match_the_solid(kind: str, tmp_path: Path) -> None:
    """Two touching boxes are one solid: the space between them is inside, a hole is outside."""
    halves = [_box((0.1, 0.12, 0.08), (side * 0.05, 0.0, 0.0)) for side in (-1, 1)]
    body = grasps.load_object(
        _written(tmp_path / f"a.{kind}", [_box((0.2, 0.12, 0.08), (0, 0, 0))])
    )
    two = grasps.load_object(_written(tmp_path / f"b.{kind}", halves))
    points = np.random.default_rng(0).uniform(-0.15, 0.15, (300, 3))
    exact = grasps.Box(size=(0.2, 0.12, 0.08), source="").signed_distance(points)
    assert body.signed_distance(points) == pytest.approx(exact, abs=1e-7)
    assert two.signed_distance(points) == pytest.approx(exact, abs=1e-7)
    assert len(ik.Scene().holding(two.name, np.eye(4)).items[two.name].parts) == 2
    handle = grasps.load_object(_written(tmp_path / f"c.{kind}", _arch()))
    assert handle.signed_distance([0.0, 0.0, 0.0]) == pytest.approx(0.5)
    assert handle.signed_distance([0.6, 0.0, 0.1]) == pytest.approx(-0.1)
    assert handle.normal([0.45, 0.0, 0.0]) == pytest.approx([-1, 0, 0], abs=1e-7)


def test_pads_touch_the_mesh(tmp_path: Path) -> None:
    """A mesh is its surface, not its convex hull; several files form one object."""
    mesh = _written(tmp_path / "handle.obj", _arch())
    files = [_written(tmp_path / f"{i}.stl", [part]) for i, part in enumerate(_arch())]
    path = _grasp_file(tmp_path, 0.1 * np.array([0.49, 0.0, 0.0]))
    scaled_source = f"{mesh}@0.1"
    (grasp,) = ik.load_candidates(path, ROBOT, take="contacts", grasped=scaled_source)
    contact = grasp.contacts["thumb"]
    assert contact.point == pytest.approx([0.05, 0.0, 0.0], abs=1e-6)
    assert contact.normal == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    assert grasp.object == scaled_source
    large = _grasp_file(tmp_path, np.array([0.495, 0.0, 0.0]))
    (grasp_set,) = ik.load_candidates(large, ROBOT, take="contacts", grasped=files)
    assert grasp_set.contacts["thumb"].point == pytest.approx([0.5, 0.0, 0.0], abs=1e-6)
    within = _grasp_file(tmp_path, np.zeros(3))
    with pytest.raises(ik.errors.DescriptionError, match=r"10.*handle.obj"):
        ik.load_candidates(within, ROBOT, take="contacts", grasped=mesh)


def test_mesh_takes_the_scale_of_the_data(tmp_path: Path) -> None:
    written = made("bodex_allegro", tmp_path)  # obj_scale 0.06
    ball: Any = trimesh.creation.icosphere(3, 1.0)
    ball.export(tmp_path / "ball.obj")
    candidates = ik.load_candidates(written.path, written.robot, grasped=tmp_path / "ball.obj")
    assert {grasp.object for grasp in candidates} == {f"{tmp_path / 'ball.obj'}@0.06"}
    assert grasps.load_object(candidates[0].object).signed_distance(
        [0.0, 0.0, 0.1]
    ) == pytest.approx(0.04, abs=1e-4)


def test_collisions_with_convex_parts(robot: ik.ArmHand, tmp_path: Path) -> None:
    """The arm passes through a handle, but not through the hull of the handle."""
    _written(tmp_path / "handle.obj", _arch())
    names = [_written(tmp_path / f"{i}.stl", [part]).name for i, part in enumerate(_arch())]
    grasp = ik.load_grasp("cup")
    q = robot.home
    elbow = robot.links(q)["lwr_link_4"]
    clear: dict[str, float] = {}
    for name, expected_words in {
        "hull": "{kind: mesh, file: handle.obj",
        "parts": "{kind: mesh, file: handle.obj, parts: true",
        "files": f"{{kind: mesh, file: {names}",
        "object": f"{{kind: object, object: {tmp_path / 'handle.obj'}",
    }.items():
        path = tmp_path / "scene.yaml"
        path.write_text(f"solids:\n  handle: {expected_words}, xyz: {elbow[:3, 3].tolist()}}}\n")
        scene = ik.load_scene(path)
        assert len(scene.items["handle"].parts) == (1 if name == "hull" else 3)
        check = ik.Solver(robot, scene=scene).check(q, grasp)
        assert check is not None
        clear[name] = float(check.distance[0])
    assert clear["hull"] < 0 < clear["parts"]
    assert clear["files"] == pytest.approx(clear["parts"])
    assert clear["object"] == pytest.approx(clear["parts"])
    holding_scene = ik.Scene().holding(f"{tmp_path / 'handle.obj'}@0.1", elbow)
    assert len(holding_scene.items[holding_scene.grasped or ""].parts) == 3


def test_an_object_file_with_a_mesh(tmp_path: Path) -> None:
    _written(tmp_path / "handle.obj", _arch())
    text = (
        "name: handle\ndescription: A handle.\nframe: the mesh's\n"
        "shape: {kind: mesh, file: FILE, scale: FACTOR, source: mine}\n"
        "mass: {value: 0.1 kg, source: mine}\nsources: {mine: made here}\n"
    )
    path = tmp_path / "handle.yaml"
    path.write_text(text.replace("FILE", "[handle.obj]").replace("FACTOR", "0.1"))
    body = grasps.load_object(path)
    assert (body.name, body.mass) == ("handle", 0.1)
    assert body.signed_distance([0.0, 0.0, 0.0]) == pytest.approx(0.05)
    assert len(ik.Scene().holding(str(path), np.eye(4)).items[str(path)].parts) == 3
    for file, factor, says in (
        ("no.obj", "1", r"handle\.yaml: shape\.file: no such file"),
        ("[]", "1", r"shape\.file: found none, expected at least one"),
        ("handle.obj", "0", r"shape\.scale: found 0, expected > 0"),
    ):
        path.write_text(text.replace("FILE", file).replace("FACTOR", factor))
        with pytest.raises(ik.errors.DescriptionError, match=says) as caught:
            grasps.load_object(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(
        ik.errors.DescriptionError, match="found factor 'two', expected a number > 0"
    ):
        grasps.load_object(f"{tmp_path / 'handle.obj'}@two")


def test_flat_part_is_thin_and_flat_mesh_is_refused(tmp_path: Path) -> None:
    sheet = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2], [1, 3, 2]])
    two_parts, sheet_file = _written(tmp_path / "a.stl", [*_arch(), sheet]), tmp_path / "b.stl"
    scene = ik.Scene({"a": {"kind": "mesh", "file": str(two_parts), "parts": True}})
    extents = [np.ptp(solid.mesh()[0], axis=0).min() for solid, _ in scene.items["a"].parts]
    assert len(extents) == 4
    assert min(extents) == pytest.approx(1e-3, rel=1e-3)
    _written(sheet_file, [sheet])
    with pytest.raises(ik.errors.DescriptionError, match=r"points are coplanar"):
        ik.Scene({"a": {"kind": "mesh", "file": str(sheet_file), "parts": True}})
