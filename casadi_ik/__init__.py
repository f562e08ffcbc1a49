"""Arm-hand inverse kinematics from fingertip contacts: fast, exact and explained."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from casadi_ik.public import *  # noqa: F403

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Import the public names when the first of them is used (PEP 562).

    CasADi and NumPy take a second to import. `casadi-ik --help` needs neither, and Ctrl-C in that
    second reaches the command line's own handler.
    """
    if name.startswith("__") and name != "__all__":
        raise AttributeError(name)
    public = import_module("casadi_ik.public")
    if hasattr(public, name):
        globals().update((one, getattr(public, one)) for one in public.__all__)
        return getattr(public, name)
    if name in globals():  # a submodule, imported by now
        return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__getattr__("__all__")})
