"""Deprecated names, and old import paths of documented modules: both warn until version 0.3."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from types import CodeType, ModuleType

NEW_PATHS = {
    "adapters": "integrations",
    "adapters.isaac_teleop": "integrations.isaac_teleop",
    "adapters.lerobot": "integrations.lerobot",
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
"""Old path -> new path, both below `casadi_ik`."""

REMOVED_IN = "0.3"
"""Version of the package without the old paths."""

_PACKAGE = __name__.partition(".")[0]


class RenamedModuleFinder:
    """Import hook that finds a module under its old path."""

    def find_spec(
        self,
        name: str,
        path: Sequence[str] | None = None,  # noqa: ARG002 - the interface of meta path finders
        target: ModuleType | None = None,  # noqa: ARG002
    ) -> ModuleSpec | None:
        """Return the spec of a renamed module; None for every other name."""
        package, _, old = name.partition(".")
        if package != _PACKAGE or old not in NEW_PATHS:
            return None
        new = f"{_PACKAGE}.{NEW_PATHS[old]}"
        warnings.warn(
            f"{name} is now {new}; the old path is removed in version {REMOVED_IN}",
            DeprecationWarning,
            stacklevel=2,
        )
        return ModuleSpec(name, _RenamedModuleLoader(new))


class _RenamedModuleLoader(Loader):
    """Loader that returns the module of the new path."""

    def __init__(self, new: str) -> None:
        self.new = new

    def create_module(self, spec: ModuleSpec) -> ModuleType:  # noqa: ARG002
        """Import the module under its new path and put it under the old one."""
        module = importlib.import_module(self.new)
        self._spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Restore the spec of the new path; the module has been executed there."""
        module.__spec__ = self._spec

    def get_code(self, name: str) -> CodeType | None:  # noqa: ARG002
        """Return the code of the module, for `python -m` with the old path."""
        spec = importlib.util.find_spec(self.new)
        loader = spec.loader if spec else None
        return loader.get_code(self.new) if loader else None  # type: ignore[union-attr]


def install() -> None:
    """Make the old import paths work; called once by the package."""
    sys.meta_path.insert(0, RenamedModuleFinder())  # type: ignore[arg-type]


def warn_renamed(old: str, new: str) -> None:
    """Warn the caller of a deprecated method or property.

    Args:
        old: Deprecated name.
        new: Name to use instead.
    """
    warnings.warn(f"{old} is deprecated; use {new}", DeprecationWarning, stacklevel=3)
