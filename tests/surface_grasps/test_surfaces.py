"""Surfaces of meshes: samples, orientation, and meshes that are refused."""

import numpy as np
import pytest
import trimesh
from touch_cases import PLACE, solver_of, surface_of

import casadi_ik as ik
from casadi_ik import errors


def test_samples_lie_on_the_surface_and_face_outwards(surface):
    radius = np.linalg.norm(surface.points[:, :2], axis=1)
    rim = np.abs(surface.points[:, 2]) > 0.05 - 1e-9
    side = surface.fits_pad & ~rim
    assert np.abs(radius[~rim] - 0.033).max() < 5e-5  # flat facets
    outward = (surface.normals[side, :2] * surface.points[side, :2]).sum(axis=1) / radius[side]
    assert outward.min() > 0.995
    near_edge = ~rim & (np.abs(surface.points[:, 2]) > 0.048)
    assert not surface.fits_pad[near_edge].any()


def test_inverted_mesh_is_flipped_and_reported(tmp_path, surface):
    mesh = trimesh.creation.cylinder(0.033, 0.1, sections=128)
    mesh.invert()
    turned_surface = surface_of(tmp_path, mesh)
    assert ((turned_surface.faces * turned_surface.points).sum(axis=1) > 0).all()
    assert len(turned_surface.notes) == 1
    assert not surface.notes
    grasps_found = solver_of("panda+panda_hand").grasps_of(turned_surface, PLACE, limit=3, among=3)
    assert len(grasps_found) == 3
    assert turned_surface.notes[0] in str(grasps_found)


def test_open_mesh_is_accepted_and_reported(tmp_path):
    mesh = trimesh.creation.cylinder(0.033, 0.1, sections=128)
    mesh.update_faces(mesh.triangles_center[:, 2] < 0.049)
    opened = surface_of(tmp_path, mesh)
    assert [note for note in opened.notes if "128" in note] == list(opened.notes) != []
    assert len(solver_of("panda+panda_hand").grasps_of(opened, PLACE, limit=3, among=3)) == 3


def test_inconsistent_triangles_are_refused(tmp_path):
    mesh = trimesh.creation.cylinder(0.033, 0.1, sections=128)
    faces = np.array(mesh.faces)
    faces[::2] = faces[::2, ::-1]
    mixed = trimesh.Trimesh(mesh.vertices, faces, process=False)
    with pytest.raises(errors.InputError, match=r"orientation at .* of .* edges"):
        surface_of(tmp_path, mixed)


def test_sheets_and_specks_are_refused(tmp_path):
    sheet = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.1]], [[0, 1, 2]])
    with pytest.raises(errors.InputError, match="found a flat sheet"):
        surface_of(tmp_path, sheet)
    with pytest.raises(errors.InputError, match="1e-06"):
        surface_of(tmp_path, trimesh.creation.box((1e-6, 1e-6, 1e-6)))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("# nothing\n", "the mesh is empty; expected triangles"),
        ("v 0 0 0\nv nan 1 0\nv 0 1 1\nf 1 2 3\n", "a vertex is not finite"),
        ("v 0 0 0\nv inf 1 0\nv 0 1 1\nf 1 2 3\n", "a vertex is not finite"),
    ],
)
def test_non_meshes_are_refused(tmp_path, text, expected):
    (tmp_path / "mesh.obj").write_text(text)
    with pytest.raises(errors.DescriptionError, match=expected):
        ik.load_surface(tmp_path / "mesh.obj")


@pytest.mark.slow
def test_many_triangles_are_sampled(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=7, radius=0.035)
    assert len(ball.faces) > 300_000
    surface = surface_of(tmp_path, ball)
    assert surface.fits_pad.all()
    assert np.abs(np.linalg.norm(surface.points, axis=1) - 0.035).max() < 1e-5


def test_millimetres_are_detected(tmp_path):
    with pytest.raises(errors.InputError, match=r"scale=0\.001"):
        surface_of(tmp_path, trimesh.creation.cylinder(33, 100))
    grasps_found = ik.load_surface(tmp_path / "mesh.stl", scale=0.001)
    assert grasps_found.size == pytest.approx(0.137, abs=2e-3)


def test_changed_mesh_file_is_detected(tmp_path):
    solver, path = solver_of("panda+panda_hand"), tmp_path / "part.stl"
    for part in (trimesh.creation.icosphere(3, 0.03), trimesh.creation.box((0.05, 0.09, 0.11))):
        part.export(path)
        grasps_found = solver.grasps_of(ik.load_surface(path), PLACE, limit=5, among=5)
        assert len(grasps_found) == 5
        fresh = solver_of("panda+panda_hand")
        for grasp in grasps_found:
            assert fresh.solve(grasp.grasp, q0=grasp.q).success
