"""Arm-hand inverse kinematics from fingertip contacts: fast, exact and explained."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from casadi_ik.files import renamed_modules

if TYPE_CHECKING:
    from casadi_ik import errors, logs, motion, papers, solve
    from casadi_ik.api import METHODS, Solver
    from casadi_ik.collision.scene import Scene, load_scene
    from casadi_ik.errors import CasadiIKError
    from casadi_ik.files.shipped import shipped_names
    from casadi_ik.integrations.datasets import Candidates, load_candidates
    from casadi_ik.kinematics.arm_hand import ArmHand, load_robot
    from casadi_ik.model.grasp import Contact, Grasp, Tolerance
    from casadi_ik.model.load_grasp import load_grasp, shipped_grasps
    from casadi_ik.model.pose import Free
    from casadi_ik.planning.touch.surface import Surface, load_surface
    from casadi_ik.solve.best_effort import BestEffort
    from casadi_ik.solve.registry import register_method
    from casadi_ik.solve.solution import BatchSolution, Solution
    from casadi_ik.solve.status import Status

__version__ = "0.1.0"

_MODULES = {
    "METHODS": "api",
    "ArmHand": "kinematics.arm_hand",
    "BatchSolution": "solve.solution",
    "BestEffort": "solve.best_effort",
    "Candidates": "integrations.datasets",
    "CasadiIKError": "errors",
    "Contact": "model.grasp",
    "Free": "model.pose",
    "Grasp": "model.grasp",
    "Scene": "collision.scene",
    "Solution": "solve.solution",
    "Solver": "api",
    "Status": "solve.status",
    "Surface": "planning.touch.surface",
    "Tolerance": "model.grasp",
    "errors": "",
    "load_candidates": "integrations.datasets",
    "load_grasp": "model.load_grasp",
    "load_robot": "kinematics.arm_hand",
    "load_scene": "collision.scene",
    "load_surface": "planning.touch.surface",
    "logs": "",
    "motion": "",
    "papers": "",
    "register_method": "solve.registry",
    "shipped_grasps": "model.load_grasp",
    "shipped_names": "files.shipped",
    "solve": "",
}
"""Public names and the modules that define them; "" marks a public submodule."""

__all__ = [
    "METHODS",
    "ArmHand",
    "BatchSolution",
    "BestEffort",
    "Candidates",
    "CasadiIKError",
    "Contact",
    "Free",
    "Grasp",
    "Scene",
    "Solution",
    "Solver",
    "Status",
    "Surface",
    "Tolerance",
    "errors",
    "load_candidates",
    "load_grasp",
    "load_robot",
    "load_scene",
    "load_surface",
    "logs",
    "motion",
    "papers",
    "register_method",
    "shipped_grasps",
    "shipped_names",
    "solve",
]

renamed_modules.install()


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used (PEP 562).

    CasADi and NumPy take a second to import. `casadi-ik --help` needs neither, and Ctrl-C in that
    second reaches the command line's own handler.
    """
    if name in _MODULES:
        module = _MODULES[name]
        value = (
            getattr(import_module(f"{__name__}.{module}"), name)
            if module
            else import_module(f"{__name__}.{name}")
        )
    elif name in renamed_modules.NEW_PATHS:
        value = import_module(f"{__name__}.{name}")
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
