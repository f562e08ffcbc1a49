"""Fixtures of the tests of grasps of surfaces."""

import pytest
import trimesh
from touch_cases import PLACE, solver_of, surface_of


@pytest.fixture(scope="session")
def surface(tmp_path_factory):
    can = trimesh.creation.cylinder(0.033, 0.1, sections=128)
    return surface_of(tmp_path_factory.mktemp("touch"), can)


@pytest.fixture(scope="session", params=["panda+panda_hand", "panda+allegro_right"])
def grasps_found(request, surface):
    solver = solver_of(request.param)
    return solver, solver.grasps_of(surface, PLACE, limit=12, among=12, seed=1)
