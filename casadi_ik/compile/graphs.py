"""Functions that need not be built to be known: signature, recipe, and what builds them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from casadi_ik.compile.codegen import Stages
from casadi_ik.compile.layout import Layout
from casadi_ik.errors import InputError

BUILD_NO_GRAPHS = ("app", "export", "files", "integrations")
"""Rooms whose code cannot change a graph, so that it is no part of a kernel's name; import-linter
checks that none of them uses CasADi."""


DECIMALS = 12
"""Numbers [SI units] that agree to so many decimals are the same to a recipe: the last places of a
description follow the machine that read it."""


def recipe(*parts: Any) -> str:
    """A hash of data and of the code that makes graphs from it, 32 hexadecimal digits.

    It is the same on every machine and with every version of Python.

    Args:
        parts: Everything the graph depends on: text, numbers, arrays, records, collections and
            objects of such.
    """
    digest = hashlib.sha256(package_sources().encode())
    for part in _plain(parts):
        digest.update(part)
    return digest.hexdigest()[:32]


def _plain(value: Any) -> Iterator[bytes]:
    """Bytes that tell a value from every other."""
    if value is None or isinstance(value, str | bool | int | np.integer):
        yield f"{value!r};".encode()
    elif isinstance(value, float | np.floating | np.ndarray):
        array = np.asarray(value)
        if array.dtype.kind == "f":
            array = np.round(array.astype("<f8"), DECIMALS) + 0.0  # no negative zeros
        yield f"{array.shape}{array.dtype.str}".encode() + array.tobytes()
    elif isinstance(value, Path):
        yield value.name.encode()  # of a mesh to be drawn, wherever it is
    elif is_dataclass(value):
        yield type(value).__name__.encode()
        for item in fields(value):
            yield from _plain(getattr(value, item.name))
    elif isinstance(value, Mapping):
        yield from _plain(list(value.items()))
    elif isinstance(value, Iterable):
        items = sorted(value, key=repr) if isinstance(value, Set) else list(value)
        yield f"{len(items)} of ".encode()
        for item in items:
            yield from _plain(item)
    else:
        yield type(value).__name__.encode()
        yield from _plain(value.__getstate__())


@cache
def package_sources() -> str:
    """A hash of the code that graphs are made with."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[1]
    for path in sorted(root.rglob("*.[pc]*"), key=lambda path: path.parts):
        inside = path.relative_to(root)
        if path.suffix not in (".py", ".c") or inside.parts[0] in BUILD_NO_GRAPHS:
            continue
        digest.update(inside.as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:32]


Shape = tuple[int, int]


@dataclass(frozen=True)
class FunctionGraph:
    """A Function with its signature, built when it is needed.

    Attributes:
        name: Identifier (letters, digits, underscores), also the kernel's file name.
        source: Builds the function, with the arguments in the order of `inputs`.
        inputs: Rows and columns by argument name.
        outputs: Rows and columns of the results.
        recipe: See `recipe`; a library of the same recipe is taken without building the function.
    """

    name: str
    source: Callable[[], ca.Function]
    inputs: Mapping[str, Shape]
    outputs: tuple[Shape, ...]
    recipe: str = ""

    @classmethod
    def of(cls, function: ca.Function) -> FunctionGraph:
        """A function that is there already."""
        names = function.name_in()
        return cls(
            function.name(),
            lambda: function,
            {name: function.size_in(i) for i, name in enumerate(names)},
            tuple(function.size_out(i) for i in range(function.n_out())),
        )

    @cached_property
    def function(self) -> ca.Function:
        """The function, checked against the signature.

        Raises:
            InputError: It has another.
        """
        function = self.source()
        found = (
            [function.size_in(i) for i in range(function.n_in())],
            [function.size_out(i) for i in range(function.n_out())],
        )
        expected = list(self.inputs.values()), list(self.outputs)
        if found != expected:
            raise InputError(f"function {self.name!r}: sizes {found}, expected {expected}")
        return function


RUNNING = 0
"""The step's status output while the loop has to go on; any other integer ends it."""


@dataclass(frozen=True)
class StepGraph:
    """One whole iteration of a method as one graph.

    Attributes:
        name: Identifier (letters, digits, underscores), also the kernel's file name.
        source: The function ``(state, parameters) -> (state', record, status)``, or what builds
            it when it is needed; all dense column vectors, status a scalar: `RUNNING` or the code
            with which the loop ends.
        state: Layout of the state, what an iteration hands to the next.
        parameters: Layout of the parameters, constant during one solve (targets, tolerances,
            gains), so that one kernel serves every target.
        record: Layout of what is logged of each iteration.
        compilable: False if the graph holds a node that has no C code (an Ipopt call); such a
            graph runs in CasADi's virtual machine.
        stage: Name of the number in the state by which the step chooses what to do, "" if it does
            the same always. Solves in the same stage are made side by side.
        recipe: See `recipe`; a library of the same recipe is taken without building the function.
        apart: Name of the last parameter, if only C reads it: lanes do without it.
        virtual: Of stages: the iteration without a compiler, with arrays `inputs` and `outputs` as
            of the function; a call is one, False if it fails.
    """

    name: str
    source: ca.Function | Callable[[], ca.Function | Stages]
    state: Layout
    parameters: Layout
    record: Layout
    compilable: bool = True
    stage: str = ""
    recipe: str = ""
    apart: str = ""
    virtual: Callable[[], Any] | None = None

    def __post_init__(self) -> None:
        if isinstance(self.source, ca.Function):
            _ = self.function

    @property
    def stage_place(self) -> int:
        """Where in the state the stage is, -1 if there is none."""
        return self.state.slice(self.stage).start if self.stage else -1

    @property
    def seated(self) -> int:
        """How many of the parameters lanes need."""
        return self.parameters.slice(self.apart).start if self.apart else self.parameters.size

    @cached_property
    def function(self) -> ca.Function | Stages:
        """The function, checked against the layouts; or stages, which are not.

        Raises:
            InputError: Its sizes are others.
        """
        function = self.source if isinstance(self.source, ca.Function) else self.source()
        if isinstance(function, Stages):
            return function
        found = (
            [function.numel_in(i) for i in range(function.n_in())],
            [function.numel_out(i) for i in range(function.n_out())],
        )
        expected = (
            [self.state.size, self.parameters.size],
            [self.state.size, self.record.size, 1],
        )
        if found != expected:
            raise InputError(f"step graph {self.name!r}: sizes {found}, layouts say {expected}")
        return function
