"""Registry of the methods by name."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import Any

from casadi_ik.errors import InputError, UnknownNameError
from casadi_ik.files.input_checks import checked_mapping
from casadi_ik.files.renamed_modules import warn_renamed
from casadi_ik.model.description import RobotDescription
from casadi_ik.solve.hand_first.method import HandFirstMethod
from casadi_ik.solve.hand_first.parameters import HandFirstParameters
from casadi_ik.solve.method import Method
from casadi_ik.solve.thumb_first.method import ThumbFirstMethod
from casadi_ik.solve.thumb_first.state import ThumbFirstParameters

Build = Callable[[RobotDescription, Any, bool], Method]
"""Function that builds a method from a robot, a parameter record and a flag to compile."""


@dataclass(frozen=True)
class _Entry:
    """A registered method.

    Attributes:
        summary: One-line description.
        record: Parameter record, a dataclass.
        build: Function that builds the method.
        fixed: Values of fields of the record that define the method and cannot be set.
    """

    summary: str
    record: type[Any]
    build: Build
    fixed: Mapping[str, Any] = field(default_factory=dict)

    @property
    def options(self) -> tuple[str, ...]:
        """Fields of the record that users can set."""
        return tuple(entry.name for entry in fields(self.record) if entry.name not in self.fixed)


_ENTRIES: dict[str, _Entry] = {
    "hand-first": _Entry(
        "palm and hand are fitted to the contacts, the arm follows in closed form (ours)",
        HandFirstParameters,
        HandFirstMethod,
    ),
    "thumb-first": _Entry(
        "the arm starts at the estimated palm, then moves along the arm-thumb closed chain (ours)",
        ThumbFirstParameters,
        ThumbFirstMethod,
    ),
}
"""Methods by name; `casadi_ik.papers` and `register_method` add more."""

RENAMED_OPTIONS = {
    "as_it_is": "max_cost_of_q0",
    "eased": "damping_decrease",
    "tightened": "damping_increase",
}
"""Deprecated name -> name of options of shipped methods; both work until version 0.3."""

_SHIPPED = set(_ENTRIES)
"""Names of shipped methods, which cannot be replaced."""


def add_shipped_method(
    name: str,
    summary: str,
    parameters: type[Any],
    build: Build,
    fixed: Mapping[str, Any] | None = None,
) -> None:
    """Register a shipped method; for the arguments see `register_method`."""
    _ENTRIES[name] = _Entry(summary, parameters, build, dict(fixed or {}))
    _SHIPPED.add(name)


def register_method(
    name: str,
    summary: str,
    parameters: type[Any],
    build: Build,
    fixed: Mapping[str, Any] | None = None,
    replace: bool = False,
) -> None:
    """Register a method for `Solver` under a name, in this process.

    Args:
        name: Name of the method; also the `Method.name` that `build` returns.
        summary: One-line description.
        parameters: Parameter record, a dataclass whose fields have defaults;
            `Solver(options=)` sets them.
        build: Function that returns the method, for example a subclass of `LoopedMethod`, from
            a robot, a parameter record and a flag to compile.
        fixed: Values of fields of the record that users cannot set.
        replace: True to replace a registered method.

    Raises:
        InputError: The name is taken, or an argument has the wrong type.

    Example:
        >>> from dataclasses import dataclass
        >>> @dataclass(frozen=True)
        ... class Parameters:
        ...     damping: float = 0.1
        >>> def build(robot, parameters, compiled):
        ...     raise NotImplementedError("make a `LoopedMethod`: docs/add_a_method.md")
        >>> ik.register_method("mine", "summary of the method", Parameters, build)
    """
    if not (isinstance(name, str) and name):
        raise InputError(f"name: found {name!r}, expected the name of a method")
    if name in _SHIPPED or (name in _ENTRIES and not replace):
        raise InputError(f"name: method {name!r} exists already; expected another name")
    if not (isinstance(parameters, type) and is_dataclass(parameters)):
        raise InputError(f"parameters: found {parameters!r}, expected a dataclass")
    if not callable(build):
        raise InputError(f"build: found {build!r}, expected a function that builds a method")
    _ENTRIES[name] = _Entry(summary, parameters, build, dict(fixed or {}))


def method_names() -> tuple[str, ...]:
    """Return the names of all methods: those of the package, then those registered by users."""
    return tuple(_ENTRIES)


def method_summary(name: str) -> str:
    """Return the one-line description of a method.

    Raises:
        UnknownNameError: The method does not exist.
    """
    return _entry(name).summary


def option_names(name: str) -> tuple[str, ...]:
    """Return the names of the parameters that `Solver(options=)` can set.

    Raises:
        UnknownNameError: The method does not exist.
    """
    return _entry(name).options


def changed_options(name: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options whose values are not the defaults of the method.

    Args:
        name: Name of a method; all options of an unknown one are returned.
        options: Values by name, as a log stores them (tuples are lists).
    """
    if name not in _ENTRIES:
        return dict(options)
    entry = _ENTRIES[name]
    defaults = json.loads(json.dumps(asdict(entry.record(**entry.fixed)), default=str))
    return {key: value for key, value in options.items() if value != defaults.get(key, math.nan)}


def with_finger_step(
    method: str, options: Mapping[str, Any], finger_step: str | None
) -> dict[str, Any]:
    """Return the options with the finger step added, for methods that have one.

    Raises:
        UnknownNameError: The method does not exist.
        InputError: The options contain a finger step already.
    """
    checked_mapping(options, "options", "from names to values")
    if finger_step is None:
        return dict(options)
    if "finger_step" in options:
        raise InputError("finger_step: given twice; expected an argument or an option")
    has_finger_step = "finger_step" in option_names(method)
    return {**options, "finger_step": finger_step} if has_finger_step else dict(options)


def build_method(
    name: str, robot: RobotDescription, options: dict[str, Any], compiled: bool = True
) -> Method:
    """Build a method for a robot.

    Args:
        name: One of `method_names`.
        robot: Description of the robot.
        options: Fields of the method's parameter record that differ from their defaults.
        compiled: False: use CasADi's virtual machine.

    Raises:
        UnknownNameError: The method or an option does not exist.
        InputError: An option has an invalid value.
        UnsupportedError: The method does not support the robot.
    """
    entry, options = _entry(name), dict(options)
    for old, new in RENAMED_OPTIONS.items():
        if old in options and old not in entry.options and new in entry.options:
            warn_renamed(f"option {old}", new)
            options[new] = options.pop(old)
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
    method = entry.build(robot, record, compiled)
    if method.name != name:
        raise InputError(f"method: `name` is {method.name!r}; expected {name!r}")
    return method


def _entry(name: str) -> _Entry:
    try:
        return _ENTRIES[name]
    except (KeyError, TypeError):
        raise UnknownNameError(
            f"method {name!r} does not exist; methods: {', '.join(_ENTRIES)}"
        ) from None
