"""A function that need not be built to be known."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from casadi_ik.errors import InputError

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
        loops: Whether loops over tables are most of its work.
    """

    name: str
    source: Callable[[], ca.Function]
    inputs: Mapping[str, Shape]
    outputs: tuple[Shape, ...]
    recipe: str = ""
    loops: bool = False

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
