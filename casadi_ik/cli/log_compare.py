"""`casadi-ik log compare`: two methods on the same targets."""

from __future__ import annotations

import argparse

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from casadi_ik import logs
from casadi_ik.cli.answer import Answer
from casadi_ik.cli.report import table
from casadi_ik.errors import InputError
from casadi_ik.logs.explain.compare import Matched, matched, side_by_side
from casadi_ik.logs.read.one_solve import one_solve

SHOWN = 12
"""How many solves that only one method solved are named."""


def compare(arguments: argparse.Namespace) -> Answer:
    """Compare two methods: one target side by side, many in numbers.

    Raises:
        LogError: A file is missing, damaged or no log of casadi_ik.
        UnknownNameError: A method is not in the logs.
        InputError: There are not two methods, or no target in common.
    """
    opened = [logs.open(name) for name in arguments.files]
    first, second = _methods(opened, arguments.methods)
    pairs = matched(opened, first, second)
    if arguments.solve is not None:
        pairs = pairs.of_first(arguments.solve)
    if len(pairs) == 0:
        asked = "" if arguments.solve is None else f" of solve {arguments.solve}"
        where = ", ".join(arguments.files)
        raise InputError(f"{where}: {first} and {second}: no target{asked} in common")
    return Answer(_one(pairs) if len(pairs) == 1 else _many(pairs))


def _methods(opened: list[logs.Log], asked: list[str] | None) -> tuple[str, str]:
    held = list(dict.fromkeys(method for log in opened for method in log.methods))
    if asked is not None:
        for method in asked:
            if method not in held:
                raise InputError(f"--methods: found {method!r}, the logs hold {', '.join(held)}")
        return asked[0], asked[1]
    if len(held) != 2:
        raise InputError(
            f"the logs hold {', '.join(held) or 'no method'}, expected two methods (say --methods)"
        )
    return held[0], held[1]


def _one(pairs: Matched) -> RenderableType:
    (pair,) = pairs.pairs
    solves = [one_solve(each.log, each.solve_id, each.method) for each in pair]
    names = [f"{each.method}, solve {each.solve_id}" for each in solves]
    rows = table("", *names)
    for line in side_by_side(*solves):
        rows.add_row(line.what, line.first, line.second)
    return rows


def _many(pairs: Matched) -> RenderableType:
    success = np.array([[each.success for each in pair] for pair in pairs.pairs])
    iterations = np.array([[each.iterations for each in pair] for pair in pairs.pairs])
    times = np.array([[each.time for each in pair] for pair in pairs.pairs])
    names = (pairs.first, pairs.second)
    rows = table("method", "solved", "iterations where both", "time where both", right=("solved",))
    both = success.all(axis=1)
    for i, name in enumerate(names):
        means = ("-", "-")
        if both.any():
            means = (f"{iterations[both, i].mean():.1f}", f"{1e3 * times[both, i].mean():.3g} ms")
        rows.add_row(name, f"{success[:, i].sum()} of {len(success)}", *means)
    parts: list[RenderableType] = [rows]
    lines = [f"solved by both {both.sum()}, by neither {(~success.any(axis=1)).sum()}"]
    for i, name in enumerate(names):
        only = np.flatnonzero(success[:, i] & ~success[:, 1 - i]).tolist()
        numbers = ", ".join(str(pairs.pairs[j][0].solve_id) for j in only[:SHOWN])
        more = f" and {len(only) - SHOWN} more" if len(only) > SHOWN else ""
        lines.append(f"only by {name}: {len(only)}" + (f" (solve {numbers}{more})" if only else ""))
    return Group(*parts, *(Text(f"  {line}") for line in lines))
