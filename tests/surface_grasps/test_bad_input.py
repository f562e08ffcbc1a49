"""Arguments of a wrong type or value raise errors of the package; meshes come in several forms."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from touch_cases import PLACE

import casadi_ik as ik
from casadi_ik import errors

BOX = trimesh.creation.box((0.05, 0.06, 0.1))


@pytest.fixture(scope="module")
def solver():
    return ik.Solver(ik.load_robot("panda+panda_hand"))


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """Folder for the meshes of a test."""
    monkeypatch.setenv("CASADI_IK_CACHE", str(tmp_path))


@pytest.mark.parametrize(
    "options",
    [
        {name: value}
        for name, values in {
            "mu": ["0.5", None, (0.5, 0.6), True, np.nan, -0.5, 1e300, 1e-300, 10**400, [0.5]],
            "hold": [
                5,
                "ab",
                (0.2,),
                (0.2, 18, 1),
                ("a", 18),
                (0.2, np.inf),
                (0.2, None),
                [[1, 2]],
            ],
            "seed": ["1", None, 1.5, -1, (1, 2), np.nan],
            "prefer": [None, 3, ["load"], np.zeros(3), "best"],
            "fingers": ["3", None, 2.5, 1],
            "limit": ["3", None, 2.5, 0],
            "among": ["3", None, 2.5, 0],
            "pose": ["here", np.eye(3), 5],
            "q0": ["home", [1, 2], np.full(9, np.nan)],
        }.items()
        for value in values
    ],
    ids=str,
)
def test_questions_of_wrong_type_or_value(solver, options):
    with pytest.raises(errors.InputError):
        solver.grasps_of("tomato_soup_can", **{"pose": PLACE, **options})


@pytest.mark.parametrize(
    "source",
    [
        None,
        5,
        np.zeros((4, 3)),
        np.zeros((2, 3, 3)),
        (BOX.vertices,),
        (BOX.vertices, "faces"),
        (BOX.vertices, BOX.faces.astype(float)),
        (BOX.vertices, BOX.faces + 1),
        (BOX.vertices[:, :2], BOX.faces),
        (BOX.vertices * np.nan, BOX.faces),
        (BOX.vertices, np.zeros((0, 3), dtype=int)),
        (None, None),
        [[[0, 0, 0], [1]], [[0, 1, 2]]],
        trimesh.PointCloud(BOX.vertices),
    ],
    ids=lambda source: type(source).__name__,
)
def test_surfaces_that_are_not_meshes(solver, source):
    with pytest.raises(errors.InputError, match="surface: found"):
        ik.load_surface(source)
    with pytest.raises(errors.InputError, match="surface: found"):
        solver.grasps_of(source, PLACE)


@pytest.mark.parametrize("name", ["no_such_object", "no_such_file.stl", "", Path("missing.obj")])
def test_unknown_object_names_are_refused(solver, name):
    with pytest.raises((errors.UnknownNameError, errors.DescriptionError)):
        solver.grasps_of(name, PLACE)


@pytest.mark.parametrize(
    "options",
    [
        *({"scale": value} for value in ("x", None, 0, -1.0, np.nan, np.inf, [1.0])),
        *({"seed": value} for value in ("x", None, -1, 1.5)),
        {"parameters": 5},
    ],
    ids=str,
)
def test_wrong_options_of_surfaces(options):
    with pytest.raises(errors.InputError):
        ik.load_surface((BOX.vertices, BOX.faces), **options)


@pytest.mark.parametrize(
    "options", [{"position": "x"}, {"angle": None}, {"samples": 1.5}, {"seed": -1}, {"hold": 3}]
)
def test_wrong_displacements(solver, options):
    grasps = solver.grasps_of("tomato_soup_can", PLACE, limit=1, among=1)
    with pytest.raises(errors.InputError):
        grasps.robustness(**options)


@pytest.mark.parametrize(
    "prefer",
    [
        lambda robot, q: 1 / 0,
        lambda robot, q: "best",
        lambda robot, q: q,
        lambda robot, q: q[:, 0] * np.nan,
    ],
)
def test_non_ranking_functions_are_refused(solver, prefer):
    with pytest.raises(errors.InputError, match="prefer"):
        solver.grasps_of("tomato_soup_can", PLACE, limit=1, among=1, prefer=prefer)


@pytest.mark.slow
@pytest.mark.parametrize(
    "source",
    [BOX, (BOX.vertices, BOX.faces), [BOX.vertices.tolist(), BOX.faces.tolist()]],
    ids=["trimesh", "arrays", "lists"],
)
def test_meshes_without_a_file_are_grasped(solver, tmp_path, source):
    BOX.export(tmp_path / "box.off", digits=17)
    surface = ik.load_surface(source)
    np.testing.assert_allclose(surface.points, ik.load_surface(tmp_path / "box.off").points)
    assert ik.load_surface(source).name == surface.name
    grasps = solver.grasps_of(source, PLACE, limit=2, among=2)
    assert len(grasps) == 2
    assert all(solver.solve(grasp.grasp, q0=grasp.q).success for grasp in grasps)
    half_size = ik.load_surface(source, scale=0.5)
    assert half_size.size == pytest.approx(surface.size / 2, rel=1e-3)
