"""Found grasps in a picture, on a page, and from the command line."""

from __future__ import annotations

import numpy as np
import pytest
from commands import main
from PIL import Image

import casadi_ik as ik
from casadi_ik.app import pictures as views
from casadi_ik.app import viewer as viewing

ROBOT, PLACE = "panda+panda_hand", ("0.5", "0.1", "0.051", "0", "0", "0")
GRASP_COMMAND = ("grasp", "tomato_soup_can", "--robot", ROBOT, "--scene", "table", "--limit", "6")


@pytest.fixture(scope="module")
def solver():
    return ik.Solver(ik.load_robot(ROBOT), scene=ik.load_scene("table"))


@pytest.fixture(scope="module")
def grasps(solver):
    pose = np.eye(4)
    pose[:3, 3] = [float(number) for number in PLACE[:3]]
    return solver.grasps_of(ik.load_surface("tomato_soup_can"), pose, limit=6, among=6)


@pytest.mark.opengl
def test_picture_has_a_panel_per_grasp(solver, grasps, tmp_path):
    path = tmp_path / "best.png"
    figure = views.draw_grasps(solver.robot, grasps, path, scene=solver.scene, most=4)
    assert len(figure.axes) == 4
    assert f"load {grasps[0].load:.2f}" in figure.axes[0].get_title()
    image = np.asarray(Image.open(path))[..., :3]
    for axes in figure.axes:  # there is something in every panel
        (panel,) = axes.images
        assert np.asarray(panel.get_array()).std() > 0.05
    assert image.std() > 10


def test_empty_picture_is_refused(solver):
    with pytest.raises(ik.errors.InputError, match="found:"):
        views.draw_grasps(solver.robot, [])


@pytest.mark.opengl
def test_command_writes_picture_and_page(tmp_path, capsys, view):
    out, picture = tmp_path / "found.npz", tmp_path / "best.png"
    words = [*GRASP_COMMAND, "--object-pose", *PLACE, "--out", str(out), "--picture", str(picture)]
    assert main(words) == 0
    output = capsys.readouterr().out
    assert "6 FOUND" in output
    assert str(out) in output
    assert str(picture) in output
    assert Image.open(picture).width > 1000
    page = view(str(out), "--scene", "table").page
    assert len(page.candidate_list.shown_names) == 6
    loads = np.load(out)["load"]
    page.candidate_list.filter(load=float(loads[2]))
    assert len(page.candidate_list.shown_names) == 3
    page.candidate_list.choose(page.candidate_list.shown_names[1])
    assert page.work.settle(300)
    np.testing.assert_allclose(page.result.q, np.load(out)["q"][1], atol=1e-3)


def test_failed_search_writes_nothing(tmp_path, capsys):
    out = tmp_path / "found.npz"
    far_pose = ("5", "0", "0.051", "0", "0", "0")
    assert main([*GRASP_COMMAND, "--object-pose", *far_pose, "--out", str(out)]) == 1
    output = capsys.readouterr().out
    assert "NONE FOUND" in output
    assert "found.npz" not in output
    assert not out.exists()


def test_a_page_filters_by_load_and_clearance(solver, grasps):
    viewer = viewing.view_found(solver.robot, grasps, scene=solver.scene)
    try:
        offered, page = viewer.page.candidate_list, viewer.page
        clear = sorted(grasp.clearance for grasp in grasps)[3]
        offered.filter(clearance=clear)
        assert len(offered.shown_names) == 3
        offered.filter(max_count=1)
        assert len(offered.shown_names) == 1
        offered.choose(offered.shown_names[0])
        assert page.work.settle(300)
        assert page.result.success
        assert page.result.clearance >= clear - 1e-4
    finally:
        viewer.stop()
