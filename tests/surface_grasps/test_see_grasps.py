"""Found grasps in a picture, on a page, and from the command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from commands import main
from PIL import Image

import casadi_ik as ik

ROBOT = "panda+allegro_right"
PLACE = ("0.5", "0.1", "0.051", "0", "0", "0")
GRASP_COMMAND = (
    *("grasp", "tomato_soup_can", "--robot", ROBOT),
    *("--scene", "table", "--limit", "6"),
)


@pytest.fixture(scope="module")
def grasp_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six grasps of a can on a table."""
    path = tmp_path_factory.mktemp("see") / "found.npz"
    assert main([*GRASP_COMMAND, "--object-pose", *PLACE, "--out", str(path)]) == 0
    return path


def test_written_grasps_are_solved_at_their_configurations(grasp_file):
    stored = np.load(grasp_file)
    arrays = {name: stored[name] for name in ("points", "normals", "balls") if name in stored}
    solver = ik.Solver(ik.load_robot(ROBOT), scene=ik.load_scene("table"))
    batch = solver.solve_batch(**arrays, q0=stored["q"])
    assert batch.success.all()
    np.testing.assert_allclose(batch.q, stored["q"], atol=1e-9)
    assert np.nanmax(batch.position_error) < 1e-9


@pytest.mark.opengl
def test_command_writes_a_picture(tmp_path, capsys):
    out, picture = tmp_path / "found.npz", tmp_path / "best.png"
    words = [*GRASP_COMMAND, "--object-pose", *PLACE, "--out", str(out), "--picture", str(picture)]
    assert main(words) == 0
    output = capsys.readouterr().out
    for part in ("6 FOUND", str(out), str(picture)):
        assert part in output
    image = np.asarray(Image.open(picture))[..., :3]
    assert image.shape[1] > 1000
    for panel in np.array_split(image[len(image) // 3 : 2 * len(image) // 3], 3, axis=1):
        assert panel.std() > 10  # no panel is empty


def test_a_page_filters_and_shows_grasps(grasp_file, view):
    page, stored = view(str(grasp_file), "--scene", "table").page, np.load(grasp_file)
    offered = page.candidate_list
    assert len(offered.shown_names) == 6
    offered.filter(load=float(stored["load"][2]))
    assert len(offered.shown_names) == 3
    offered.choose(offered.shown_names[1])
    assert page.work.settle(300)
    np.testing.assert_allclose(page.result.q, stored["q"][1], atol=1e-3)
    clear = float(np.sort(stored["clearance"])[3])
    offered.filter(load=0.0, clearance=clear)
    assert len(offered.shown_names) == 3
    offered.filter(max_count=1)
    assert len(offered.shown_names) == 1
    offered.choose(offered.shown_names[0])
    assert page.work.settle(300)
    assert page.result.success
    assert page.result.clearance >= clear - 1e-4


def test_failed_search_writes_nothing(tmp_path, capsys):
    out = tmp_path / "found.npz"
    far_pose = ("5", "0", "0.051", "0", "0", "0")
    assert main([*GRASP_COMMAND, "--object-pose", *far_pose, "--out", str(out)]) == 1
    output = capsys.readouterr().out
    assert "NONE FOUND" in output
    assert "found.npz" not in output
    assert not out.exists()
