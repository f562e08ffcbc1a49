"""Pages that several tests use; each is built once."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import casadi_ik as ik
from casadi_ik.viewing import Viewer, view_grasp


@pytest.fixture(scope="session")
def cup_viewer(robot: ik.ArmHand) -> Iterator[Viewer]:
    """The cup on the shipped robot, a table about it."""
    viewer = view_grasp(robot, ik.load_grasp("cup"), scene=ik.load_scene("table"))
    yield viewer
    viewer.stop()


@pytest.fixture
def cup(cup_viewer: Viewer) -> Iterator[Viewer]:
    """The same, as it was at the beginning."""
    cup_viewer.page.reset()
    assert cup_viewer.page.work.settle()
    yield cup_viewer
    cup_viewer.page.work.settle()
