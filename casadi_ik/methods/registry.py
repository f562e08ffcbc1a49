"""The methods by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from casadi_ik.errors import InputError, UnknownNameError
from casadi_ik.methods.hand_first.method import HandFirstMethod
from casadi_ik.methods.hand_first.parameters import HandFirstParameters
from casadi_ik.methods.ipopt.method import IpoptMethod
from casadi_ik.methods.ipopt.parameters import IpoptParameters
from casadi_ik.methods.qiu.enhanced import EnhancedStep
from casadi_ik.methods.qiu.method import QiuMethod
from casadi_ik.methods.qiu.original import OriginalStep
from casadi_ik.methods.qiu.parameters import FINGER_STEPS, OriginalParameters, QiuParameters
from casadi_ik.methods.thumb_first.method import ThumbFirstMethod
from casadi_ik.methods.thumb_first.parameters import ThumbFirstParameters
from casadi_ik.problem.method import Method
from casadi_ik.robots.description import RobotDescription


@dataclass(frozen=True)
class _Entry:
    """How a method is built.

    Attributes:
        summary: What it does, in one line.
        record: Its parameter record.
        fixed: Fields of the record that make the method what its name says.
        build: Makes it from robot, record and whether to compile.
    """

    summary: str
    record: type[Any]
    fixed: Mapping[str, Any]
    build: Callable[[str, RobotDescription, Any, bool], Method]

    @property
    def options(self) -> tuple[str, ...]:
        """Fields of the record that can be chosen."""
        return tuple(entry.name for entry in fields(self.record) if entry.name not in self.fixed)


def _hand_first(
    name: str, robot: RobotDescription, record: HandFirstParameters, compiled: bool
) -> Method:
    del name
    return HandFirstMethod(robot, record, compiled)


def _thumb_first(
    name: str, robot: RobotDescription, record: ThumbFirstParameters, compiled: bool
) -> Method:
    del name
    return ThumbFirstMethod(robot, record, compiled)


def _enhanced(name: str, robot: RobotDescription, record: QiuParameters, compiled: bool) -> Method:
    return QiuMethod(name, EnhancedStep(robot, record), compiled)


def _original(
    name: str, robot: RobotDescription, record: OriginalParameters, compiled: bool
) -> Method:
    return QiuMethod(name, OriginalStep(robot, record), compiled)


def _ipopt(name: str, robot: RobotDescription, record: IpoptParameters, compiled: bool) -> Method:
    del name, compiled  # Ipopt calls its graphs in the virtual machine
    return IpoptMethod(robot, record)


_PAPER = "(Qiu & Kermani 2021)"
_ENTRIES: dict[str, _Entry] = {
    "hand-first": _Entry(
        "palm and hand are fitted to the contacts, the arm follows in closed form (ours)",
        HandFirstParameters,
        {},
        _hand_first,
    ),
    "thumb-first": _Entry(
        "the arm starts at the estimated palm, then moves along the arm-thumb closed chain (ours)",
        ThumbFirstParameters,
        {},
        _thumb_first,
    ),
    "enhanced-dls": _Entry(
        f"thumb first, then the arm-thumb closed chain; damped least squares {_PAPER}",
        QiuParameters,
        {"steps": "dls"},
        _enhanced,
    ),
    "enhanced-sdls": _Entry(
        f"the same with selectively damped least squares {_PAPER}",
        QiuParameters,
        {"steps": "sdls"},
        _enhanced,
    ),
    "original-dls": _Entry(
        f"all contacts in one hierarchy, what the paper compares with; DLS {_PAPER}",
        OriginalParameters,
        {"steps": "dls"},
        _original,
    ),
    "original-sdls": _Entry(
        f"the same with selectively damped least squares {_PAPER}",
        OriginalParameters,
        {"steps": "sdls"},
        _original,
    ),
    "ipopt": _Entry(
        "the whole arm-hand as one nonlinear program, with restarts: slow, to compare with",
        IpoptParameters,
        {},
        _ipopt,
    ),
}

METHODS: tuple[str, ...] = tuple(_ENTRIES)
"""Names of the methods, the default first."""


def method_summary(name: str) -> str:
    """What a method does, in one line.

    Raises:
        UnknownNameError: No such method.
    """
    return _entry(name).summary


def option_names(name: str) -> tuple[str, ...]:
    """Names of the parameters that `Solver`'s options can set.

    Raises:
        UnknownNameError: No such method.
    """
    return _entry(name).options


def method_options(
    name: str, options: Mapping[str, Any], finger_step: str | None
) -> dict[str, Any]:
    """Options of a method, with the finger step if the method has one.

    Args:
        name: One of `METHODS`.
        options: What was set besides.
        finger_step: One of `FINGER_STEPS`; None leaves the method's own.

    Raises:
        UnknownNameError: No such method.
        InputError: No such finger step.
    """
    if finger_step is None:
        return dict(options)
    if finger_step not in FINGER_STEPS:
        raise InputError(
            f"finger_step: found {finger_step!r}, expected one of {', '.join(FINGER_STEPS)}"
        )
    has_one = "finger_step" in _entry(name).options
    return {**options, "finger_step": finger_step} if has_one else dict(options)


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
    entry = _entry(name)
    for option in options:
        if option not in entry.options:
            raise UnknownNameError(
                f"option {option!r} does not exist for method {name!r}; options: "
                + ", ".join(entry.options)
            )
    try:
        record = entry.record(**options, **entry.fixed)
    except TypeError as error:
        raise InputError(f"options: {error}") from error
    return entry.build(name, robot, record, compiled)


def _entry(name: str) -> _Entry:
    try:
        return _ENTRIES[name]
    except (KeyError, TypeError):
        raise UnknownNameError(
            f"method {name!r} does not exist; methods: {', '.join(METHODS)}"
        ) from None
