"""Public names of the package, and deprecated import paths of documented modules."""

from __future__ import annotations

import importlib
from types import ModuleType

import pytest
from processes import python

import casadi_ik as ik
from casadi_ik.files.renamed_modules import NEW_PATHS


def test_every_public_name_is_found():
    for name in ik.__all__:
        assert getattr(ik, name) is not None
        assert name in dir(ik)
    with pytest.raises(AttributeError):
        _ = ik.no_such_name


FRAMEWORKS = {"adapters.isaac_teleop", "adapters.lerobot"}
"""Adapters whose frameworks are not installed for tests."""


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
    names = [name for name in NEW_PATHS if name not in FRAMEWORKS]
    done = python("-c", script, *(path for name in names for path in (name, NEW_PATHS[name])))
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
