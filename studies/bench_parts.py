"""What `bench.py` measures; as a program the process that measures one version of the package.

A case is a part's name, a robot and more words or numbers; of it a measurement is made ready once
and then called turn by turn. Public names of the package only: other versions run this, too.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from bench_processes import FIRST, export, first_use, large_batch, logs, memory, peer, view
from bench_solves import (
    TOLERANCES,
    Case,
    Quantities,
    batch,
    choose,
    clutter,
    diagnosis,
    fast,
    follow,
    methods,
    scene,
    single,
    threads,
)
from samplers import suits

import casadi_ik as ik

FAST, SINGLE = 1000, 200
"""Calls of a turn."""

MEASUREMENTS: dict[str, Callable[..., Callable[[], Quantities]]] = {
    "batch": batch,
    "fast": fast,
    "single": single,
    "scene": scene,
    "clutter": clutter,
    "choose": choose,
    "follow": follow,
    "diagnosis": diagnosis,
    "methods": methods,
    "threads": threads,
    "memory": memory,
    "many": large_batch,
    "first-use": first_use,
    "export": export,
    "logs": logs,
    "peers": peer,
    "view": view,
}

ABROAD = ("first-use", "memory", "many", "peers", "view")
"""Measured once."""


def _samplers(robot: str) -> list[str]:
    other_robot = ik.load_robot(robot)
    return [name for name in ("random", "grasps", "limits") if suits(other_robot, name)]


def _batches(robots: list[str], count: int, _: str) -> list[Case]:
    return [
        (robot, sampler, tolerance, count)
        for robot in robots
        for sampler in _samplers(robot)
        for tolerance in TOLERANCES
    ]


def _methods(*_: Any) -> list[Case]:
    steps = {name: ("closed-form", "ipopt") for name in ik.METHODS if name.startswith("enhanced")}
    other_methods = [name for name in ik.METHODS if name not in ("hand-first", "ipopt")]
    return [
        ("kuka_lwr_barrett", name, step)
        for name in other_methods
        for step in steps.get(name, ("",))
    ]


def _peers(robots: list[str], count: int, _: str) -> list[Case]:
    names = importlib.import_module("peers").installed()
    return [
        (robot, sampler, tolerance, name, min(count, 60))
        for robot in robots
        for sampler in _samplers(robot)[:2]
        for tolerance in TOLERANCES
        for name in names
    ]


CASES: dict[str, Callable[[list[str], int, str], list[Case]]] = {
    "batch": _batches,
    "fast": lambda robots, *_: [(robot, FAST) for robot in robots],
    "single": lambda robots, *_: [(robot, SINGLE) for robot in robots],
    "scene": lambda robots, count, _: [(robot, min(count, 200)) for robot in robots],
    "clutter": lambda robots, *_: [(robot, place) for robot in robots for place in range(4)],
    "choose": lambda robots, *_: [
        (robot, grasp_kind, around)
        for robot in robots
        for grasp_kind in ("palms", "contacts")
        for around in ("free", "scene")
    ],
    "follow": lambda robots, *_: [(robot,) for robot in robots],
    "diagnosis": lambda robots, *_: [
        (robot, kind, 60) for robot in robots for kind in ("far", "moved", "turned")
    ],
    "methods": _methods,
    "threads": lambda robots, count, _: [(robot, 4 * count) for robot in robots],
    "memory": lambda robots, count, _: [(robot, 50 * count) for robot in robots[:1]],
    "many": lambda robots, count, _: [(robot, count) for robot in robots],
    "first-use": lambda robots, *_: [
        (robot, ask, "hand-first") for robot in robots for ask in FIRST
    ],
    "export": lambda robots, *_: [
        (robot, *words)
        for robot in robots
        for words in (("c",), ("c", "--single"), ("c", "--scene", "8"), ("wasm",))
    ],
    "logs": lambda _, count, __: [
        ("kuka_lwr_barrett", method, compression, count)
        for method in ("hand-first", "enhanced-dls")
        for compression in ("zstd", "lz4", "none")
    ],
    "peers": _peers,
    "view": lambda _, __, page: [
        (place, painted, flow)
        for place in ("server", *([page] if Path(page).is_file() else []))
        for painted, flow in ((True, False), (False, False), (False, True))
    ],
}
"""The cases of every part, behind its name, from robots, targets of a batch, and the page without
a server."""


@cache
def _ready(case: Case) -> Callable[[], Quantities]:
    return MEASUREMENTS[case[0]](*case[1:])


def serve() -> None:
    """Measure cases as they come, a line of JSON each."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no answer
    for line in sys.stdin:
        try:
            output: dict[str, Any] = {"found": _ready(tuple(json.loads(line)))()}
        except Exception as error:
            output = {"error": f"{type(error).__name__}: {error}"[:300]}
        answers.write(json.dumps(output) + "\n")
        answers.flush()


if __name__ == "__main__":
    serve()
