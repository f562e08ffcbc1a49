"""Public names of the package, and deprecated import paths of documented modules."""

from __future__ import annotations

import importlib
from types import ModuleType

import pytest
from processes import python

import casadi_ik as ik


def test_every_public_name_is_found():
    for name in ik.__all__:
        assert getattr(ik, name) is not None
        assert name in dir(ik)
    with pytest.raises(AttributeError):
        _ = ik.no_such_name


NEW_PATHS = {
    "adapters": "integrations",
    "adapters.ros2": "integrations.ros2",
    "answers": "solve",
    "answers.diagnosis": "solve.diagnosis",
    "answers.solution": "solve.solution",
    "arm_hand": "kinematics.arm_hand",
    "batches": "integrations",
    "batches.parts": "integrations.batches",
    "calibration": "papers.chandra.calibration",
    "datasets": "integrations.datasets",
    "differentiable": "integrations.differentiable",
    "grasps": "model",
    "papers.screw_control": "papers.chandra.screw_control",
    "papers.screw_tasks": "papers.chandra.screw_tasks",
    "registry": "solve.registry",
    "robots": "model",
    "solve.limits": "solve.looped_method",
    "viewing": "app.viewer",
    "views": "app.pictures",
}
"""Old path -> new path, both below `casadi_ik`, without adapters of frameworks."""


@pytest.mark.slow
def test_old_paths_give_the_modules_and_warnings():
    script = """
    import importlib, sys, warnings

    for old, new in zip(sys.argv[1::2], sys.argv[2::2]):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            module = importlib.import_module(f"casadi_ik.{old}")
        assert module is importlib.import_module(f"casadi_ik.{new}"), (old, new)
        assert any(issubclass(w.category, DeprecationWarning) for w in caught), old
    """
    done = python("-c", script, *(path for paths in NEW_PATHS.items() for path in paths))
    assert done.returncode == 0, done.stderr


def test_new_paths_give_no_warning():
    script = "import casadi_ik as ik; ik.load_robot('ar10'); ik.logs; ik.motion; ik.solve"
    done = python("-W", "error::DeprecationWarning:casadi_ik", "-c", script)
    assert done.returncode == 0, done.stderr


def test_public_submodules_are_modules():
    names = [name for name in ik.__all__ if isinstance(getattr(ik, name), ModuleType)]
    assert names == ["errors", "logs", "motion", "papers", "solve"]
    for name in names:
        assert importlib.import_module(f"casadi_ik.{name}") is getattr(ik, name)
