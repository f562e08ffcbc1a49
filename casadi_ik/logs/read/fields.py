"""What the rows of a log must be like to be read: fields, kinds of numbers, shapes and names.

A log may come from anybody. Whatever its schemas and labels say is checked once, when it is
opened; behind that, whoever works with its rows can rely on them.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import msgspec
from mcap.records import Channel, Schema

from casadi_ik.errors import LogError
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.logs.mcap.metadata import parsed_json
from casadi_ik.logs.mcap.schema import parse_layout

Labels = Mapping[str, tuple[str, ...]]

NAME_LIMIT = 200
"""Characters of a method, a finger, a joint, a phase, ...; so many of them a field may have."""
COUNT_LIMIT = 4096

_SIZES = {"n": "q", "f": "position_error", "e": "events", "p": "phase_iterations"}
"""Fields whose length others share: of actuators, fingers, kinds of events, phases."""

_SOLVE = {
    **dict.fromkeys(("started", "time"), "f"),
    "q": "f n",
    **dict.fromkeys(("position_error", "angle_error"), "f f"),
    **dict.fromkeys(("target_points", "target_normals"), "f f 3"),
    **dict.fromkeys(("solve_id", "iterations", "restarts"), "u"),
    **dict.fromkeys(("status", "success", "limits_ok", "kept"), "u"),
    "phase_iterations": "u p",
    "events": "u e",
    "ok": "u f",
}
"""Kind of number, then the axes: a letter of `_SIZES`, a length, or "*" for a mask's words."""

_SOLVE_LATER = {
    "start": "f n",
    **dict.fromkeys(("position_tolerance", "angle_tolerance"), "f f"),
    "seed": "f",
    "fixed_mask": "u *",
    "limits_enforced": "u",
}
"""All of them or none: logs of earlier versions have none."""

_EVENT = {
    **dict.fromkeys(("value", "threshold"), "f"),
    **dict.fromkeys(("solve_id", "iteration", "kind", "jacobian", "phase"), "u"),
    "joint_mask": "u *",
}

_ITERATION = {
    "q": "f n",
    **dict.fromkeys(("position_error", "angle_error"), "f f"),
    **dict.fromkeys(("cost", "step_size", "damping"), "f"),
    **dict.fromkeys(("limit_mask", "active_mask"), "u *"),
    **dict.fromkeys(("phase", "status"), "u"),
}
"""What these are, wherever a method records them."""

_NAMED = {"solve": ("position_error", "events", "phase_iterations")}
"""Fields whose every element must have a name."""


def described(kind: str, channel: Channel, schema: Schema) -> tuple[Layout, Labels]:
    """Layout and labels of the messages of a channel.

    Args:
        kind: "iteration", "solve" or "event".
        channel: The channel.
        schema: Its schema.

    Raises:
        LogError: They are not such as a log of ours has.
    """
    try:
        text = schema.data.decode()
        layout = _layout(kind, text)
        labels = _labels(channel.metadata.get("labels", "{}"))
        for item in layout:
            names = labels.get(item.name, ())
            if item.name in _NAMED.get(kind, ()) and len(names) != item.shape[0]:
                raise LogError(
                    f"labels of {item.name}: {len(names)} names for {item.shape[0]} elements"
                )
    except UnicodeDecodeError as error:
        raise LogError(f"{channel.topic[:NAME_LIMIT]!r}: its schema is not UTF-8 text") from error
    except LogError as error:
        raise LogError(f"{channel.topic[:NAME_LIMIT]!r}: {error}") from error
    return layout, labels


@lru_cache(maxsize=64)
def _layout(kind: str, text: str) -> Layout:
    layout = parse_layout(text)
    fields = {item.name: item for item in layout}
    required = {"iteration": {}, "solve": _SOLVE, "event": _EVENT}[kind]
    if kind == "solve" and fields.keys() & _SOLVE_LATER.keys():
        required = required | _SOLVE_LATER
    for name in required:
        if name not in fields:
            raise LogError(f"schema: no field {name!r}")
    sizes = {
        letter: fields[name].shape[0]
        for letter, name in _SIZES.items()
        if name in fields and fields[name].shape
    }
    for name, expected in (required or _ITERATION).items():
        if name in fields:
            _check(fields[name], expected, sizes)
    for item in layout:
        if item.name.startswith(("sigma_", "condition_", "lowest_sigma")) and item.dtype[0] != "f":
            raise LogError(f"schema: field {item.name!r}: found {item.dtype}, expected floats")
    return layout


def _check(item: Field, expected: str, sizes: Mapping[str, int]) -> None:
    kind, *axes = expected.split()
    shape = tuple(int(axis) if axis.isdigit() else sizes.get(axis, -1) for axis in axes)
    right = item.shape == shape or (axes == ["*"] and len(item.shape) <= 1)
    if item.dtype[0] != kind or not right:
        what = {"f": "floats", "u": "unsigned integers"}[kind]
        raise LogError(
            f"schema: field {item.name!r}: found {item.dtype} {item.shape}, expected {what}"
            f" {tuple(axes)}"
        )


@lru_cache(maxsize=256)
def _labels(text: str) -> Labels:
    value = parsed_json("labels", text)
    try:
        labels = msgspec.convert(value, dict[str, tuple[str, ...]])
    except msgspec.ValidationError as error:
        raise LogError(f"labels: {error}") from error
    for field, names in labels.items():
        longest = max(map(len, names), default=0)
        if len(names) > COUNT_LIMIT or longest > NAME_LIMIT or len(field) > NAME_LIMIT:
            raise LogError(
                f"labels of {field[:NAME_LIMIT]!r}: more than {COUNT_LIMIT} names, or one of more"
                f" than {NAME_LIMIT} characters"
            )
    return labels
