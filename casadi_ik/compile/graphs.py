"""Functions that are built on demand: their signature, recipe and builder."""

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
"""Rooms whose code cannot change a graph, and is therefore not part of the name of a kernel.

Import-linter checks that none of them uses CasADi."""


DECIMALS = 12
"""Number of decimals [SI units] that enter a recipe; further digits of a description depend on the
machine that read it."""


def recipe(*parts: Any) -> str:
    """Return a hash of data and of the code that builds graphs from it, 32 hexadecimal digits.

    The hash is the same on every machine and with every version of Python.

    Args:
        parts: All data that the graph depends on: text, numbers, arrays, records, collections.
    """
    digest = hashlib.sha256(package_sources().encode())
    for part in _canonical_bytes(parts):
        digest.update(part)
    return digest.hexdigest()[:32]


def _canonical_bytes(value: Any) -> Iterator[bytes]:
    """Yield bytes that identify a value."""
    if value is None or isinstance(value, str | bool | int | np.integer):
        yield f"{value!r};".encode()
    elif isinstance(value, float | np.floating | np.ndarray):
        array = np.asarray(value)
        if array.dtype.kind == "f":
            array = np.round(array.astype("<f8"), DECIMALS) + 0.0  # no negative zeros
        yield f"{array.shape}{array.dtype.str}".encode() + array.tobytes()
    elif isinstance(value, Path):
        yield value.name.encode()  # a visual mesh; its folder is irrelevant
    elif is_dataclass(value):
        yield type(value).__name__.encode()
        for item in fields(value):
            yield from _canonical_bytes(getattr(value, item.name))
    elif isinstance(value, Mapping):
        yield from _canonical_bytes(list(value.items()))
    elif isinstance(value, Iterable):
        items = sorted(value, key=repr) if isinstance(value, Set) else list(value)
        yield f"{len(items)} of ".encode()
        for item in items:
            yield from _canonical_bytes(item)
    else:
        yield type(value).__name__.encode()
        yield from _canonical_bytes(value.__getstate__())


@cache
def package_sources() -> str:
    """Return a hash of the code that builds graphs."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[1]
    for path in sorted(root.rglob("*.[pc]*"), key=lambda path: path.parts):
        relative_path = path.relative_to(root)
        if path.suffix not in (".py", ".c") or relative_path.parts[0] in BUILD_NO_GRAPHS:
            continue
        digest.update(relative_path.as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:32]


Shape = tuple[int, int]


@dataclass(frozen=True)
class FunctionGraph:
    """A Function with its signature, built on demand.

    Attributes:
        name: Identifier (letters, digits, underscores), also the kernel's file name.
        source: Builds the function, with the arguments in the order of `inputs`.
        inputs: Rows and columns by argument name.
        outputs: Rows and columns of the outputs.
        recipe: Hash from `recipe`; a library with the same recipe is used without building the
            function.
    """

    name: str
    source: Callable[[], ca.Function]
    inputs: Mapping[str, Shape]
    outputs: tuple[Shape, ...]
    recipe: str = ""

    @classmethod
    def from_function(cls, function: ca.Function) -> FunctionGraph:
        """Wrap an existing function."""
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
            InputError: Its signature differs.
        """
        function = self.source()
        sizes = (
            [function.size_in(i) for i in range(function.n_in())],
            [function.size_out(i) for i in range(function.n_out())],
        )
        expected = list(self.inputs.values()), list(self.outputs)
        if sizes != expected:
            raise InputError(f"function {self.name!r}: sizes {sizes}, expected {expected}")
        return function


RUNNING = 0
"""Status output of a step while the loop continues; any other integer ends it."""


@dataclass(frozen=True)
class StepGraph:
    """Graph of one iteration of a method.

    Attributes:
        name: Identifier (letters, digits, underscores), also the kernel's file name.
        source: The function ``(state, parameters) -> (state', record, status)``, or its builder;
            all are dense column vectors, and the status is a scalar: `RUNNING` or the code with
            which the loop ends.
        state: Layout of the state, which an iteration passes to the next.
        parameters: Layout of the parameters, constant during a solve (targets, tolerances, gains),
            so that one kernel serves every target.
        record: Layout of the log record of an iteration.
        compilable: False if the graph contains a node without C code (an Ipopt call); such a
            graph runs in CasADi's virtual machine.
        stage: Name of the state field that selects the stage, "" without stages. Solves in the
            same stage share the lanes.
        recipe: Hash from `recipe`; a library with the same recipe is used without building the
            function.
        c_only: Name of the last parameter if only C code reads it, so that lanes do not load it.
        virtual: Builder of an iteration of stages without a compiler: a callable with arrays
            `inputs` and `outputs` that returns False if the step fails.
    """

    name: str
    source: ca.Function | Callable[[], ca.Function | Stages]
    state: Layout
    parameters: Layout
    record: Layout
    compilable: bool = True
    stage: str = ""
    recipe: str = ""
    c_only: str = ""
    virtual: Callable[[], Any] | None = None

    def __post_init__(self) -> None:
        if isinstance(self.source, ca.Function):
            _ = self.function

    @property
    def stage_index(self) -> int:
        """Index of the stage in the state; -1 without stages."""
        return self.state.slice(self.stage).start if self.stage else -1

    @property
    def loaded_parameters(self) -> int:
        """Number of parameters that lanes load."""
        return self.parameters.slice(self.c_only).start if self.c_only else self.parameters.size

    @cached_property
    def function(self) -> ca.Function | Stages:
        """The function, checked against the layouts; stages are not checked.

        Raises:
            InputError: Its sizes differ from the layouts.
        """
        function = self.source if isinstance(self.source, ca.Function) else self.source()
        if isinstance(function, Stages):
            return function
        sizes = (
            [function.numel_in(i) for i in range(function.n_in())],
            [function.numel_out(i) for i in range(function.n_out())],
        )
        expected = (
            [self.state.size, self.parameters.size],
            [self.state.size, self.record.size, 1],
        )
        if sizes != expected:
            raise InputError(
                f"step graph {self.name!r}: sizes {sizes}, expected {expected} from the layouts"
            )
        return function
