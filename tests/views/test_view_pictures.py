"""The pictures: what is written on them, what is in them, and how they get into a file."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import matplotlib.colors as mcolors
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

import casadi_ik as ik
from casadi_ik.errors import InputError, PictureError
from casadi_ik.logs import EventKind, MethodRows, Table
from casadi_ik.views import draw_alternatives, draw_convergence, draw_solution, stage
from casadi_ik.views.captions import (
    MET_COLOR,
    MISSED_COLOR,
    NEAREST_COLOR,
    OBJECT_COLOR,
    TARGET_COLOR,
)
from casadi_ik.views.marks import contact_marks, target_place
from casadi_ik.views.picture import DARK, LIGHT, new_figure, save_picture
from casadi_ik.views.strips import events_strip

pytestmark = pytest.mark.opengl

COARSE = 40  # dots per inch


@pytest.fixture(autouse=True)
def coarse_floor(monkeypatch: pytest.MonkeyPatch) -> None:
    """The floor's shadow is a third of the time of a small picture, and nothing that is tested."""
    monkeypatch.setattr(stage, "TEXELS", 128)


def words(figure: Figure) -> str:
    texts = [text.get_text() for text in figure.texts]
    texts += [text.get_text() for axes in figure.axes for text in axes.texts]
    texts += [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    return "\n".join(texts)


def count(figure: Figure, color: str) -> int:
    """Pixels of about this colour in the two views."""
    hue = mcolors.rgb_to_hsv(mcolors.to_rgb(color))
    pixels = 0
    for axes in figure.axes:
        hsv = mcolors.rgb_to_hsv(np.clip(axes.images[0].get_array(), 0, 1))
        alike = np.abs(hsv[..., 0] - hue[0]) < 0.03
        pixels += int((alike & (hsv[..., 1] > 0.25) & (hsv[..., 2] > 0.6 * hue[2])).sum())
    return pixels


def test_the_picture_says_how_it_ended(robot, solution, grasp) -> None:
    figure = draw_solution(robot, solution, grasp, dpi=COARSE)
    text = words(figure)
    worst = max(contact.position_error for contact in solution.contacts.values())
    for part in ("cup", robot.name, "SOLVED", "enhanced-dls", f"{1e3 * worst:.2f} mm", "°"):
        assert part in text
    for finger in robot.fingers:
        assert finger in text
    assert len(figure.axes) == 2


def test_a_dark_page_has_a_picture_of_its_own(robot, solution, grasp) -> None:
    figure = draw_solution(robot, solution, grasp, dpi=20, dark=True)
    assert mcolors.to_hex(figure.get_facecolor()) == DARK.paper
    # Where nothing stands the picture is as dark as what it is on.
    assert mcolors.to_hex(figure.axes[1].images[0].get_array()[0, 0]) == DARK.paper
    written = [text.get_color() for text in figure.texts]
    assert {DARK.ink, DARK.faint} < set(written)
    assert LIGHT.ink not in written


def test_alternatives_are_drawn_side_by_side(robot, grasp) -> None:
    found = ik.Solver(robot).solve_all(grasp, limit=2)
    figure = draw_alternatives(robot, found, grasp, columns=2, dpi=COARSE)
    assert len(figure.axes) == 2
    for axes, each in zip(figure.axes, found, strict=True):
        start, end = each.branch.swivel
        assert f"elbow {'+' if each.branch.elbow > 0 else '−'}" in axes.get_title()
        assert f"swings {np.rad2deg(end - start):.0f}°" in axes.get_title()
    images = [axes.images[0].get_array() for axes in figure.axes]
    assert np.abs(images[0] - images[1]).max() > 0.3
    with pytest.raises(InputError, match="alternatives: found none"):
        draw_alternatives(robot, (), grasp)


def test_the_picture_shows_object_target_and_contacts(robot, solution, grasp) -> None:
    figure = draw_solution(robot, solution, grasp, dpi=COARSE)
    for color in (OBJECT_COLOR, TARGET_COLOR, MET_COLOR):
        assert count(figure, color) > 20
    assert count(figure, MISSED_COLOR) == 0
    without = dataclasses.replace(grasp, object="")
    assert count(draw_solution(robot, solution, without, dpi=COARSE), OBJECT_COLOR) == 0


def test_a_missed_grasp_is_red(robot, grasp) -> None:
    solver = ik.Solver(
        robot, "enhanced-dls", finger_step="closed-form", options={"max_iterations": 2}
    )
    solution = solver.solve(grasp)
    figure = draw_solution(robot, solution, grasp, dpi=COARSE)
    assert "ITERATION_LIMIT" in words(figure)
    assert "out of tolerance" in words(figure)
    assert count(figure, MISSED_COLOR) > 20
    assert count(figure, MET_COLOR) == 0


def test_free_fingers_and_normals_are_left_out(robot, solution, grasp) -> None:
    point = grasp.contacts["thumb"].point
    part = ik.Grasp({"thumb": ik.Contact(point)}, name="a point", object="no such thing")
    free = ik.ContactVerdict(np.nan, np.nan, True, ik.Tolerance())
    verdicts = dict.fromkeys(robot.fingers, free)
    verdicts["thumb"] = ik.ContactVerdict(1e-3, np.nan, True, ik.Tolerance())
    answer = dataclasses.replace(solution, contacts=verdicts)
    text = words(draw_solution(robot, answer, part, dpi=COARSE))
    assert "1.00 mm" in text
    assert "nan" not in text
    assert "finger_2" not in text


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
    asked = ik.Grasp(contacts)
    marks = contact_marks(robot, solution.q, asked, dict.fromkeys(robot.fingers, MET_COLOR))
    assert sum(color == TARGET_COLOR for _, color in marks) == solids * len(robot.fingers)
    assert sum(color == MET_COLOR for _, color in marks) == len(robot.fingers) * (
        3 if "tangent" in changed else 2
    )
    text = words(draw_solution(robot, solution, asked, dpi=COARSE))
    assert f"asked for: {legend}\n" in text


def test_a_direction_alone_is_drawn_where_the_fingertip_is(robot, solution) -> None:
    points, normals = robot.contacts(solution.q)
    asked = ik.Grasp(
        {name: ik.Contact(direction=normals[i]) for i, name in enumerate(robot.fingers)}
    )
    colors = dict.fromkeys(robot.fingers, MISSED_COLOR)
    arrows = [m for m, color in contact_marks(robot, solution.q, asked, colors)
              if color == TARGET_COLOR]  # fmt: skip
    for mesh, point, normal in zip(arrows, points, normals, strict=True):
        along = (mesh.points - point) @ normal
        assert along.min() > -1e-6
        assert along.max() == pytest.approx(0.03, abs=1e-4)
    figure = draw_solution(robot, solution, asked, dpi=COARSE)
    assert "asked for: pad normal\n" in words(figure)
    assert count(figure, TARGET_COLOR) > 20


def test_the_place_asked_for_is_the_nearest_that_a_contact_allows() -> None:
    point, tip = np.array([0.1, 0.2, 0.3]), np.array([0.5, 0.7, 0.9])
    assert (target_place(ik.Contact(point), tip) == point).all()
    np.testing.assert_allclose(
        target_place(ik.Contact(point, line=[0, 0, 2]), tip), [0.1, 0.2, 0.9]
    )
    np.testing.assert_allclose(
        target_place(ik.Contact(point, plane=[0, 0, 2]), tip), [0.5, 0.7, 0.3]
    )
    assert (target_place(ik.Contact(direction=[1, 0, 0]), tip) == tip).all()


def test_a_target_far_away_does_not_shrink_the_close_up(robot, solution, grasp) -> None:
    contacts = {
        name: ik.Contact(contact.point + np.array([5.0, 0, 0]), contact.normal)
        for name, contact in grasp.contacts.items()
    }
    missed = {name: ik.ContactVerdict(5.0, 0.0, False, ik.Tolerance()) for name in robot.fingers}
    far = draw_solution(
        robot,
        dataclasses.replace(solution, contacts=missed),
        dataclasses.replace(grasp, contacts=contacts, object_pose=None),
        dpi=COARSE,
    )
    image = far.axes[1].images[0].get_array()
    assert (image.min(axis=2) < 0.9).mean() > 0.1


def test_a_finger_the_robot_has_not_is_refused(robot, solution) -> None:
    with pytest.raises(InputError, match=r"contacts\.toe"):
        draw_solution(robot, solution, ik.Grasp({"toe": ik.Contact([0, 0, 1])}), dpi=COARSE)


def test_pictures_are_written_whole_at_their_size(robot, solution, grasp, log, tmp_path) -> None:
    jobs = [
        lambda: draw_solution(robot, solution, grasp, tmp_path / "grasp.png", dpi=COARSE),
        lambda: draw_solution(robot, solution, grasp, tmp_path / "again.png", dpi=COARSE),
        lambda: draw_convergence(log.iterations(), tmp_path / "convergence.png", dpi=COARSE),
    ]
    with ThreadPoolExecutor(3) as pool:
        for future in [pool.submit(job) for job in jobs]:
            future.result()
    assert imread(tmp_path / "grasp.png").shape[:2] == (264, 480)
    assert np.array_equal(imread(tmp_path / "grasp.png"), imread(tmp_path / "again.png"))
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["again.png", "convergence.png", "grasp.png"]


def test_what_cannot_be_written_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    figure = new_figure(1, 1, COARSE)
    missing = tmp_path / "no" / "such" / "folder.png"
    with pytest.raises(PictureError, match=r"folder\.png: cannot write the picture: No such file"):
        save_picture(figure, missing)
    with pytest.raises(PictureError, match="not a regular file"):
        save_picture(figure, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_failure_keeps_the_picture_that_was_there(tmp_path, monkeypatch) -> None:
    path = tmp_path / "old.png"
    path.write_bytes(b"old")

    def full(self: Path, data: bytes) -> int:
        with self.open("wb") as stream:
            stream.write(data[:10])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(PictureError, match=r"old\.png: .*No space left"):
        save_picture(new_figure(1, 1, COARSE), path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_convergence_draws_the_errors_in_millimetres_and_degrees(robot, log) -> None:
    iterations = log.iterations()
    figure = draw_convergence(iterations, dpi=COARSE)
    by_title = {axes.get_title(loc="left"): axes for axes in figure.axes}
    for title, field, factor in (
        ("distance to the contact [mm]", "position_error", 1e3),
        ("angle to the normal [deg]", "angle_error", np.rad2deg(1)),
    ):
        lines = {line.get_label(): line for line in by_title[title].lines}
        for column, finger in enumerate(robot.fingers):
            values = lines[finger.replace("_", " ")].get_ydata()
            expected = np.maximum(iterations.rows[field][:, column] * factor, 1e-6)
            np.testing.assert_allclose(values, expected, rtol=1e-6)
    bounds = [
        line.get_ydata()[0]
        for axes in by_title.values()
        for line in axes.lines
        if line.get_label() == "tolerance"
    ]
    np.testing.assert_allclose(bounds, [5.0, 3.0])
    assert "smallest singular value" in by_title
    assert "thumb reaching" in words(figure)
    assert "SOLVED" in words(figure)
    ever = np.bitwise_or.reduce(iterations.rows["limit_mask"])
    named = [label.get_text() for label in by_title["at a limit"].get_yticklabels()]
    assert named == [
        name.replace("_", " ") for bit, name in enumerate(robot.actuators) if ever >> bit & 1
    ]


def test_convergence_takes_a_tolerance_and_a_title(log) -> None:
    tolerance = ik.Tolerance(position=1e-3)
    figure = draw_convergence(log.iterations(), tolerance=tolerance, title="mine", dpi=COARSE)
    assert 1.0 in [line.get_ydata()[0] for line in figure.axes[0].lines]
    assert "mine" in words(figure)


def test_convergence_wants_one_solve(log) -> None:
    part = log.iterations().part
    none = dataclasses.replace(
        part, rows=part.rows[:0], solve_id=part.solve_id[:0], iteration=part.iteration[:0]
    )
    with pytest.raises(InputError, match="none to draw"):
        draw_convergence(Table("iteration", (none,)))
    two = dataclasses.replace(part, solve_id=np.arange(len(part)) % 2)
    with pytest.raises(InputError, match="several solves"):
        draw_convergence(Table("iteration", (two,)))


def test_headless_pictures_say_nothing_and_leave_pyplot_alone() -> None:
    code = (
        "import sys, casadi_ik as ik\n"
        "from casadi_ik.views import draw_solution\n"
        "robot, grasp = ik.load_robot('kuka_lwr_barrett'), ik.load_grasp('cup')\n"
        "solver = ik.Solver(robot, 'enhanced-dls', finger_step='closed-form')\n"
        f"draw_solution(robot, solver.solve(grasp), grasp, dpi={COARSE})\n"
        "import matplotlib.pyplot as plt\n"
        "sys.exit(len(plt.get_fignums()))"
    )
    headless = {name: value for name, value in os.environ.items() if name != "DISPLAY"}
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, env=headless
    )
    assert done.stdout + done.stderr == ""


@pytest.mark.parametrize("missing", ["matplotlib", "pyvista"])
def test_without_the_extra_the_error_says_what_to_install(missing: str) -> None:
    code = (
        f"import sys; sys.modules['{missing}'] = None\n"
        "import casadi_ik\n"
        "try: import casadi_ik.views\n"
        "except casadi_ik.CasadiIKError as error: print(type(error).__name__, error)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.startswith(f"MissingExtraError pictures need {missing},")
    assert "pip install casadi-ik[plots]" in done.stdout
    assert done.stdout.count("\n") == 1


def test_convergence_marks_events_and_draws_every_actuator(robot, log) -> None:
    events = log.events()
    figure = draw_convergence(log.iterations(), events=events, dpi=COARSE)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert "actuators [rad or m]" in titles
    actuators = figure.axes[titles.index("actuators [rad or m]")]
    assert len(actuators.lines) == len(robot.actuators)
    assert actuators.get_yscale() == "linear"


def test_the_strip_of_events_has_a_row_per_kind_and_jacobian() -> None:
    layout = np.dtype(
        [("value", "f8"), ("threshold", "f8"), ("joint_mask", "u4")]
        + [(name, "u1") for name in ("kind", "jacobian", "phase")]
    )
    rows = np.zeros(4, layout)
    rows["kind"] = [0, 0, 8, 6]
    rows["jacobian"] = [1, 2, 0, 0]
    labels = {
        "kind": tuple(kind.name for kind in EventKind),
        "jacobian": ("", "closed_chain", "thumb"),
        "joint_mask": (),
        "phase": ("",),
    }
    numbers = np.arange(4)
    part = MethodRows("made-up", rows, numbers * 0, numbers * 10, labels, {})
    strip = events_strip(Table("event", (part,)))
    assert {name: spans for name, (spans, _) in strip.rows.items()} == {
        "near singular closed chain": [(-0.5, 1.0)],
        "near singular thumb": [(9.5, 1.0)],
        "stall": [(19.5, 1.0)],
        "restart": [(29.5, 1.0)],
    }
    assert events_strip(None).rows == {}


def test_a_scene_is_drawn_with_what_touches_in_red(robot, grasp) -> None:
    """The ball over the cup is red, because the hand is in it, and the legend says how deep."""
    place = grasp.object_pose[:3, 3] + np.array([0.1, 0.0, 0.2])
    solids = {
        "table": {"kind": "box", "size": [2, 2, 0.04], "xyz": [0, 0, -0.02]},
        "ball": {"kind": "sphere", "radius": 0.16, "xyz": place},
    }
    scene = ik.Scene(solids)
    answer = ik.Solver(robot, scene=scene).solve(grasp, diagnose=False)
    assert answer.status is ik.Status.COLLISION
    figure = draw_solution(robot, answer, grasp, scene=scene, dpi=COARSE)
    assert f"and ball, {1e3 * answer.clearance:.1f} mm" in words(figure)
    plain = draw_solution(robot, answer, grasp, dpi=COARSE)
    assert count(figure, NEAREST_COLOR) > count(plain, NEAREST_COLOR) + 200
    assert "nearest" not in words(plain)
