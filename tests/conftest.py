"""Fixtures of all tests: robots, oracles, a browser."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from browser import CHROMIUM, Browser
from hypothesis import settings
from toy_robots import copy_shipped_robot, write_coupled_robot

import casadi_ik as ik

if TYPE_CHECKING:
    from pinocchio_oracle import PinocchioRobot

REFERENCE = re.compile(r"^ *(?:import|from) (?:pinocchio|coal)(?:_oracle)?\b", re.MULTILINE)
"""Test modules that compare with other libraries (extra `reference`)."""

# Half the time of the tests was the compiler's. Without optimisation it takes 0.4 of that, and not
# a bit of a result is another (`test_optimisation_changes_no_bit`, of kernels and of hand-first).
# What solves much takes the usual flags: `usual_flags`.
os.environ.setdefault("CASADI_IK_CFLAGS", "-O0")
# Every answer is from compiled code, also that of the first solve.
os.environ.setdefault("CASADI_IK_COMPILE", "wait")

# Durations of examples have no meaning on a busy machine.
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Ignore modules that compare with pinocchio and coal where these are not installed."""
    if collection_path.suffix != ".py" or find_spec("pinocchio") is not None:
        return None
    return True if REFERENCE.search(collection_path.read_text(encoding="utf-8")) else None


def pytest_report_header() -> str:
    """Report the comparisons that are left out."""
    return "" if find_spec("pinocchio") else "no pinocchio: comparisons with it are left out"


@pytest.fixture(scope="session")
def robot() -> ik.ArmHand:
    """Shipped KUKA LWR 4+ with the Barrett hand."""
    return ik.load_robot("kuka_lwr_barrett")


@pytest.fixture(scope="session")
def solver(robot: ik.ArmHand) -> ik.Solver:
    """Hand-first solver with default options."""
    return ik.Solver(robot)


@pytest.fixture(scope="session")
def ar10() -> ik.ArmHand:
    """Shipped AR10 hand: ten sliders, no arm."""
    return ik.load_robot("ar10")


@pytest.fixture(scope="session")
def coupled_robot(tmp_path_factory: pytest.TempPathFactory) -> ik.ArmHand:
    """Small robot with every kind of coupling and joint."""
    return ik.load_robot(write_coupled_robot(tmp_path_factory.mktemp("coupled")))


@pytest.fixture(scope="session")
def oracle(robot: ik.ArmHand) -> PinocchioRobot:
    """Shipped robot in pinocchio, from the written URDF."""
    pytest.importorskip("pinocchio")
    from pinocchio_oracle import PinocchioRobot

    return PinocchioRobot(robot)


@pytest.fixture(scope="session")
def coupled_oracle(coupled_robot: ik.ArmHand) -> PinocchioRobot:
    """Coupled robot in pinocchio, from the written URDF."""
    pytest.importorskip("pinocchio")
    from pinocchio_oracle import PinocchioRobot

    return PinocchioRobot(coupled_robot)


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """Chromium for all tests of a process; tests are skipped without it."""
    if CHROMIUM is None:
        pytest.skip("no Chromium (on Debian: apt-get install chromium)")
    with Browser() as started:
        yield started


@pytest.fixture
def view() -> Iterator[Callable[..., Any]]:
    """Function that opens the viewer of `casadi-ik view` without waiting for its end."""
    from commands import view_of

    with ExitStack() as stack:

        def open_page(*words: str) -> Any:
            viewer = view_of(*words)
            stack.callback(viewer.stop)
            return viewer

        yield open_page


@pytest.fixture(scope="module")
def usual_flags() -> Iterator[None]:
    """Set the compiler flags of users, for tests with many solves."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("CASADI_IK_CFLAGS", raising=False)
        yield


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers that are the same in every run."""
    return np.random.default_rng(20211121)


@pytest.fixture
def own_robot(tmp_path: Path) -> Path:
    """Copy of the shipped descriptions that tests may change."""
    return copy_shipped_robot(tmp_path)


LONGEST = "test_page_works_in_a_browser"
"""Test of several minutes. It starts first, so that no process waits for it at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest test first; skip tests that draw without OpenGL, except in CI."""
    items.sort(key=lambda item: item.name != LONGEST)
    drawing = [item for item in items if item.get_closest_marker("opengl")]
    if drawing and "CI" not in os.environ and not _has_opengl():
        for item in drawing:
            item.add_marker(pytest.mark.skip(reason="no OpenGL (on Linux: install libegl1)"))


def _has_opengl() -> bool:
    """Return whether OpenGL works, tested in another process because VTK may abort it."""
    program = "from casadi_ik.app.pictures.scene3d import Scene3D; Scene3D().close()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "cannot import name" not in done.stderr, done.stderr
    return done.returncode == 0
