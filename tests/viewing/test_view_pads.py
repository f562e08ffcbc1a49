"""Guessed pads corrected by dragging, and the written corrections."""

from __future__ import annotations

import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import main

import casadi_ik as ik


def test_dragged_pads_round_trip(pads: Any, description: Path) -> None:
    page = pads.page
    robot_before = ik.load_robot(description)
    points, normals = robot_before.contacts(robot_before.home)
    pose = page.request.contacts["first"].control.copy()
    pose[:3, 3] += [0.001, 0.002, 0.003]
    page.drag("first", pose)
    page.drag_normal("second", np.array([0.1, -0.9, 0.3]))
    page.save()
    assert page.work.settle(300)
    assert page.message == "saved to my_hand.yaml: first, second"
    after = ik.load_robot(description)
    points_after, faced = after.contacts(after.home)
    assert np.allclose(points_after[0], points[0] + [0.001, 0.002, 0.003], atol=1e-6)
    assert np.allclose(points_after[1], points[1], atol=1e-6)
    assert np.allclose(faced[0], normals[0], atol=1e-6)
    assert np.allclose(faced[1], np.array([0.1, -0.9, 0.3]) / np.sqrt(0.91), atol=1e-6)
    text = description.read_text()
    assert "# corrected by hand; the guess was: where a ray meets the shape\n  first:" in text
    assert "  # corrected by hand\n  second:" in text
    for text_kept in ("# Made by somebody", "# a comment that stays", "fingers:  # xyz [m]"):
        assert text_kept in text
    assert page.changed_fingers == []


def test_pad_snaps_to_the_skin(pads: Any) -> None:
    page = pads.page
    page.snap_to_surface("first")
    assert page.work.settle(300)
    assert page.message == ""
    pad = page.pads(page.request)["first"]
    # The box of the last phalanx is 16 mm thick, so that its side is 8 mm from the middle.
    assert abs(pad.point[1]) == pytest.approx(0.008, abs=1e-6)
    assert np.allclose(np.abs(pad.normal), [0, 1, 0], atol=1e-6)
    # Without a change, the message states the reason.
    page.snap_to_surface("first")
    assert page.work.settle(300)
    assert page.message.startswith("first: ")
    page.reset()
    assert page.work.settle(300)
    assert page.changed_fingers == []


def test_unstated_pads_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other_file = tmp_path / "other.yaml"
    other_file.write_text("name: other\nhand: barrett_bh8_280\nfingers: [thumb]\n")
    assert main(["view", "--pads", str(other_file)]) == 2
    error_text = capsys.readouterr().err
    assert "other.yaml: fingers: " in error_text
    assert error_text.count("\n") == 1


def test_page_follows_the_theme_of_the_first_browser(pads: Any) -> None:
    assert not pads.page.dark
    for theme in ("dark", "light"):  # a second browser does not change the page
        with urllib.request.urlopen(f"{pads.url}theme/{theme}") as response:
            assert response.status == 200
        assert pads.page.dark
