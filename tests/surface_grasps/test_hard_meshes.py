"""Meshes that are double-sided, fine, in many pieces, or with very unequal triangles."""

import re
import sys

import numpy as np
import pytest
import trimesh
from touch_cases import PLACE

import casadi_ik as ik
from casadi_ik import errors


@pytest.fixture(scope="module")
def solver():
    return ik.Solver(ik.load_robot("panda+panda_hand"), scene=ik.load_scene("table"))


def saved(folder, mesh):
    mesh.export(folder / "mesh.stl")
    return folder / "mesh.stl"


def cylinder():
    return trimesh.creation.cylinder(0.033, 0.1, sections=64)


@pytest.mark.parametrize("order", ["sides in turn", "reverse first", "shuffled"])
def test_double_sided_meshes_are_used_once(tmp_path, solver, order):
    mesh = cylinder()
    front, back = mesh.faces, mesh.faces[:, ::-1]
    both = {
        "sides in turn": np.stack([front, back], axis=1).reshape(-1, 3),
        "reverse first": np.concatenate([back, front]),
        "shuffled": np.random.default_rng(0).permutation(np.concatenate([front, back])),
    }[order]
    path = saved(tmp_path, trimesh.Trimesh(mesh.vertices, both, process=False))
    surface = ik.load_surface(path)
    drawn_mesh = trimesh.Trimesh(*surface.object.mesh(), process=False)
    assert len(drawn_mesh.faces) == len(mesh.faces)
    assert drawn_mesh.is_winding_consistent
    assert drawn_mesh.volume == pytest.approx(mesh.volume)
    radial = surface.points * [1, 1, 0]
    side = np.abs(surface.points[:, 2]) < 0.049
    assert ((surface.faces * radial).sum(axis=1)[side] > 0).all()
    assert surface.object.signed_distance([0.0, 0.0, 0.0]) == pytest.approx(-0.033, abs=1e-4)
    assert surface.notes
    assert len(solver.grasps_of(surface, PLACE, limit=5, among=5)) == 5


def test_touching_bodies_are_not_double_sided(tmp_path):
    boxes = [trimesh.creation.box((0.04, 0.04, 0.04)) for _ in range(2)]
    boxes[1].apply_translation([0.04, 0, 0])
    surface = ik.load_surface(saved(tmp_path, trimesh.util.concatenate(boxes)))
    assert len(surface.object.mesh()[1]) == 24
    assert not surface.notes


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="memory is limited by RLIMIT_AS")
def test_fine_meshes_need_little_memory(tmp_path, solver):
    import resource

    path = saved(tmp_path, trimesh.creation.icosphere(6, 0.034))
    memory_before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    surface = ik.load_surface(path)
    assert len(surface.corners) == 81_920
    grasps = solver.grasps_of(surface, PLACE, limit=5, among=5)
    assert len(grasps) == 5
    assert all(solver.solve(grasp.grasp, q0=grasp.q).success for grasp in grasps)
    kilobyte = 1 if sys.platform == "linux" else 1 / 1024
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory_before) * kilobyte
    assert grown < 1.5e6  # 25 GB with a plane for each face of the hull


@pytest.mark.slow
def test_hulls_of_fine_meshes_enclose_them(tmp_path):
    fine = trimesh.creation.icosphere(5, 0.034)
    (item,) = ik.Scene().holding(str(saved(tmp_path, fine)), np.eye(4)).items.values()
    ((solid, pose),) = item.parts
    distance = solid.distance(fine.vertices - pose[:3, 3])
    assert len(solid.planes) < 2000
    assert distance.max() < 1e-8  # STL has single precision
    assert distance.min() > -0.004 * 0.034


@pytest.mark.slow
def test_many_pieces_are_answered(tmp_path, solver):
    body, rng = [cylinder()], np.random.default_rng(0)
    for angle in rng.uniform(0, 2 * np.pi, 199):
        pimple = trimesh.creation.icosphere(1, 0.002)
        pimple.apply_translation([0.033 * np.cos(angle), 0.033 * np.sin(angle), 0.048])
        body.append(pimple)
    surface = ik.load_surface(saved(tmp_path, trimesh.util.concatenate(body)))
    assert len(solver.grasps_of(surface, PLACE, limit=3, among=3)) == 3


@pytest.mark.slow
def test_hint_for_too_many_pieces_suffices(tmp_path, monkeypatch):
    pieces = []
    for place in np.ndindex(12, 12, 8):
        piece = trimesh.creation.box((2e-3,) * 3)
        piece.apply_translation(4e-3 * np.array(place))
        pieces.append(piece)
    path = saved(tmp_path, trimesh.util.concatenate(pieces))
    with pytest.raises(errors.DescriptionError, match="1152") as refused:
        ik.load_surface(path)
    hint = re.search(r"CASADI_IK_LIMITS=(\d+)", str(refused.value))
    assert hint is not None
    monkeypatch.setenv("CASADI_IK_LIMITS", hint[1])
    assert len(ik.load_surface(path).points)


def test_huge_triangles_beside_a_speck(tmp_path, solver):
    speck = trimesh.creation.icosphere(2, 0.003)
    wall = trimesh.Trimesh(
        [[0.01, 0, 0], [1.5, 0.3, 0], [0.02, 1.5, 0.1], [0.02, 1.5, -0.1]], [[0, 1, 2], [0, 2, 3]]
    )
    surface = ik.load_surface(saved(tmp_path, trimesh.util.concatenate([speck, wall])))
    grasps = solver.grasps_of(surface, PLACE, limit=3, among=3)
    assert len(grasps) or grasps.reason


def test_small_objects_have_fewer_samples(tmp_path):
    small = ik.load_surface(saved(tmp_path, trimesh.creation.icosphere(2, 0.003)))
    assert 500 <= len(small.points) < 2000
    usual = ik.load_surface(saved(tmp_path, cylinder()))
    assert len(usual.points) == 6000
