"""Pictures of grasps: contents, labels, and complete files."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import matplotlib.colors as mcolors
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from processes import python

import casadi_ik as ik
from casadi_ik import errors
from casadi_ik.app import pictures as views
from casadi_ik.app.drawing import palette

pytestmark = pytest.mark.opengl


def words(figure: Figure) -> str:
    texts = [text.get_text() for text in figure.texts]
    texts += [text.get_text() for axes in figure.axes for text in axes.texts]
    texts += [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    return "\n".join(texts)


def count(figure: Figure, color: str) -> int:
    """Return the number of pixels of about this colour in both views."""
    hue = mcolors.rgb_to_hsv(mcolors.to_rgb(color))
    pixels = 0
    for axes in figure.axes:
        hsv = mcolors.rgb_to_hsv(np.clip(axes.images[0].get_array(), 0, 1))
        alike = np.abs(hsv[..., 0] - hue[0]) < 0.03
        pixels += int((alike & (hsv[..., 1] > 0.25) & (hsv[..., 2] > 0.6 * hue[2])).sum())
    return pixels


def test_the_picture_says_how_it_ended(robot, solution, grasp) -> None:
    figure = views.draw_solution(robot, solution, grasp, dpi=40)
    text = words(figure)
    worst = max(contact.position_error for contact in solution.contacts.values())
    for part in ("cup", robot.name, "SOLVED", "enhanced-dls", f"{1e3 * worst:.2f} mm", "°"):
        assert part in text
    for finger in robot.fingers:
        assert finger in text
    assert len(figure.axes) == 2


def test_a_dark_page_has_a_picture_of_its_own(robot, solution, grasp) -> None:
    figure = views.draw_solution(robot, solution, grasp, dpi=20, dark=True)
    assert mcolors.to_hex(figure.get_facecolor()) == palette.DARK_PAPER
    # Without shapes the picture has the colour of its background.
    assert mcolors.to_hex(figure.axes[1].images[0].get_array()[0, 0]) == palette.DARK_PAPER
    written = [text.get_color() for text in figure.texts]
    assert {palette.DARK_INK, palette.DARK_FAINT} < set(written)
    assert palette.INK not in written


def test_alternatives_are_drawn_side_by_side(robot, grasp) -> None:
    solutions = ik.Solver(robot).solve_all(grasp, limit=2)
    figure = views.draw_alternatives(robot, solutions, grasp, columns=2, dpi=40)
    assert len(figure.axes) == 2
    for axes, solution in zip(figure.axes, solutions, strict=True):
        start, end = solution.branch.swivel
        assert f"elbow {'+' if solution.branch.elbow > 0 else '−'}" in axes.get_title()
        assert f"swivel range {np.rad2deg(end - start):.0f}°" in axes.get_title()
    images = [axes.images[0].get_array() for axes in figure.axes]
    assert np.abs(images[0] - images[1]).max() > 0.3
    with pytest.raises(errors.InputError, match="alternatives:"):
        views.draw_alternatives(robot, (), grasp)


def test_the_picture_shows_object_target_and_contacts(robot, solution, grasp) -> None:
    figure = views.draw_solution(robot, solution, grasp, dpi=40)
    for color in (palette.OBJECT, palette.TARGET, palette.MET):
        assert count(figure, color) > 20
    assert count(figure, palette.MISSED) == 0
    without_object = dataclasses.replace(grasp, object="")
    assert count(views.draw_solution(robot, solution, without_object, dpi=40), palette.OBJECT) <= 5


def test_a_missed_grasp_is_red(robot, grasp) -> None:
    solver = ik.Solver(
        robot, "enhanced-dls", finger_step="closed-form", options={"max_iterations": 2}
    )
    solution = solver.solve(grasp)
    figure = views.draw_solution(robot, solution, grasp, dpi=40)
    assert "ITERATION_LIMIT" in words(figure)
    assert "out of tolerance" in words(figure)
    assert count(figure, palette.MISSED) > 20
    assert count(figure, palette.MET) == 0


def test_free_fingers_and_normals_are_left_out(robot, solution, grasp) -> None:
    point = grasp.contacts["thumb"].point
    part = ik.Grasp({"thumb": ik.Contact(point)}, name="a point", object="no such thing")
    free = ik.solve.ContactVerdict(np.nan, np.nan, True, ik.Tolerance())
    verdicts = dict.fromkeys(robot.fingers, free)
    verdicts["thumb"] = ik.solve.ContactVerdict(1e-3, np.nan, True, ik.Tolerance())
    answer = dataclasses.replace(solution, contacts=verdicts)
    text = words(views.draw_solution(robot, answer, part, dpi=40))
    assert "1.00 mm" in text
    assert "nan" not in text
    assert "finger_2" not in text


def test_a_target_far_away_does_not_shrink_the_close_up(robot, solution, grasp) -> None:
    contacts = {
        name: ik.Contact(contact.point + np.array([5.0, 0, 0]), contact.normal)
        for name, contact in grasp.contacts.items()
    }
    missed = {
        name: ik.solve.ContactVerdict(5.0, 0.0, False, ik.Tolerance()) for name in robot.fingers
    }
    far_picture = views.draw_solution(
        robot,
        dataclasses.replace(solution, contacts=missed),
        dataclasses.replace(grasp, contacts=contacts, object_pose=None),
        dpi=40,
    )
    image = far_picture.axes[1].images[0].get_array()
    assert (image.min(axis=2) < 0.9).mean() > 0.1


def test_a_finger_the_robot_has_not_is_refused(robot, solution) -> None:
    with pytest.raises(errors.InputError, match=r"contacts\.toe"):
        views.draw_solution(robot, solution, ik.Grasp({"toe": ik.Contact([0, 0, 1])}), dpi=40)


def test_pictures_are_written_whole_at_their_size(robot, solution, grasp, log, tmp_path) -> None:
    jobs = [
        lambda: views.draw_solution(robot, solution, grasp, tmp_path / "grasp.png", dpi=40),
        lambda: views.draw_solution(robot, solution, grasp, tmp_path / "again.png", dpi=40),
        lambda: views.draw_convergence(log.iterations(), tmp_path / "convergence.png", dpi=40),
    ]
    with ThreadPoolExecutor(3) as pool:
        for future in [pool.submit(job) for job in jobs]:
            future.result()
    assert imread(tmp_path / "grasp.png").shape[:2] == (264, 480)
    assert np.array_equal(imread(tmp_path / "grasp.png"), imread(tmp_path / "again.png"))
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["again.png", "convergence.png", "grasp.png"]


def test_headless_pictures_say_nothing_and_leave_pyplot_alone() -> None:
    code = (
        "import sys, casadi_ik as ik\n"
        "from casadi_ik.app.pictures import draw_solution\n"
        "robot, grasp = ik.load_robot('kuka_lwr_barrett'), ik.load_grasp('cup')\n"
        "solver = ik.Solver(robot, 'enhanced-dls', finger_step='closed-form')\n"
        "draw_solution(robot, solver.solve(grasp), grasp, dpi=40)\n"
        "import matplotlib.pyplot as plt\n"
        "sys.exit(len(plt.get_fignums()))"
    )
    done = python("-c", code, check=True, env={"DISPLAY": ""})
    assert done.stdout + done.stderr == ""


@pytest.mark.parametrize(
    ("module", "extra", "missing"),
    [("pictures", "plots", "matplotlib"), ("pictures", "plots", "pyvista"),
     ("viewer", "view", "viser")],
)  # fmt: skip
def test_without_the_extra_the_error_says_what_to_install(
    module: str, extra: str, missing: str
) -> None:
    code = (
        f"import sys; sys.modules['{missing}'] = sys.modules['trimesh'] = None\n"
        "import casadi_ik\n"
        f"try: import casadi_ik.app.{module}\n"
        "except casadi_ik.CasadiIKError as error: print(type(error).__name__, error)"
    )
    done = python("-c", code, check=True)
    assert done.stdout.startswith("MissingExtraError ")
    assert f"{missing} " in done.stdout
    assert f"pip install 'casadi-ik[{extra}]'" in done.stdout
    assert done.stdout.count("\n") == 1


def test_a_scene_is_drawn_with_what_touches_in_red(robot, grasp) -> None:
    """A ball over the cup is red, and the legend states how deep the hand penetrates it."""
    place = grasp.object_pose[:3, 3] + np.array([0.1, 0.0, 0.2])
    solids = {
        "table": {"kind": "box", "size": [2, 2, 0.04], "xyz": [0, 0, -0.02]},
        "ball": {"kind": "sphere", "radius": 0.16, "xyz": place},
    }
    scene = ik.Scene(solids)
    answer = ik.Solver(robot, scene=scene).solve(grasp, diagnose=False)
    assert answer.status is ik.Status.COLLISION
    figure = views.draw_solution(robot, answer, grasp, scene=scene, dpi=40)
    assert f"and ball, {1e3 * answer.clearance:.1f} mm" in words(figure)
    plain = views.draw_solution(robot, answer, grasp, dpi=40)
    assert count(figure, palette.NEAREST) > count(plain, palette.NEAREST) + 200
    assert "nearest" not in words(plain)


def test_what_cannot_be_written_is_one_line_and_leaves_what_was_there(
    robot, solution, grasp, tmp_path, monkeypatch
) -> None:
    def draw(path):
        return views.draw_solution(robot, solution, grasp, path, dpi=20)

    missing = tmp_path / "no" / "such" / "folder.png"
    with pytest.raises(errors.PictureError, match=r"folder\.png: .*No such"):
        draw(missing)
    with pytest.raises(errors.PictureError, match="not a regular file"):
        draw(tmp_path)
    assert list(tmp_path.iterdir()) == []
    path = tmp_path / "old.png"
    path.write_bytes(b"old")

    def full(self, data: bytes) -> int:
        with self.open("wb") as stream:
            stream.write(data[:10])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(errors.PictureError, match=r"old\.png: .*No space left"):
        draw(path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
