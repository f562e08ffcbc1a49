"""The methods by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from casadi_ik.errors import InputError, UnknownNameError
from casadi_ik.robots.description import RobotDescription
from casadi_ik.solvers.method import Method
from casadi_ik.solvers.qiu import EnhancedMethod
from casadi_ik.steps.qiu_parameters import QiuParameters

Builder = Callable[[RobotDescription, dict[str, Any], bool], Method]


def _enhanced_dls(robot: RobotDescription, options: dict[str, Any], compiled: bool) -> Method:
    return EnhancedMethod(robot, _parameters(QiuParameters, options), compiled=compiled)


_BUILDERS: dict[str, tuple[Builder, str]] = {
    "enhanced-dls": (
        _enhanced_dls,
        "thumb first, then the arm-thumb closed chain; DLS steps (Qiu & Kermani 2021)",
    ),
}

METHODS: tuple[str, ...] = tuple(_BUILDERS)
"""Names of the methods, the default first."""


def method_summary(name: str) -> str:
    """What a method does, in one line."""
    return _BUILDERS[name][1]


def build_method(
    name: str, robot: RobotDescription, options: dict[str, Any], compiled: bool = True
) -> Method:
    """Build a method for a robot.

    Args:
        name: One of `METHODS`.
        robot: The description.
        options: Fields of the method's parameter record that differ from their defaults.
        compiled: False keeps to CasADi's virtual machine.

    Raises:
        UnknownNameError: No such method, or no such option.
        InputError: An option has a value it cannot have.
        UnsupportedError: The robot is not of the kind the method needs.
    """
    if name not in _BUILDERS:
        raise UnknownNameError(f"method {name!r} does not exist; methods: {', '.join(METHODS)}")
    return _BUILDERS[name][0](robot, options, compiled)


def _parameters(record: type[QiuParameters], options: dict[str, Any]) -> QiuParameters:
    known = record.__dataclass_fields__
    for option in options:
        if option not in known:
            raise UnknownNameError(f"option {option!r} does not exist; options: {', '.join(known)}")
    try:
        return record(**options)
    except TypeError as error:
        raise InputError(f"options: {error}") from error
