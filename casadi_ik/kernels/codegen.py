"""From a CasADi Function to the C text of a library: generated code, names, a driver.

The drivers (`drivers/*.c`) are fixed C code that calls "the step" by macros; what they need to
know of one function arrives as `#define` lines.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Any

import casadi as ca

from casadi_ik.errors import KernelError
from casadi_ik.kernels.arguments import looked_at_once
from casadi_ik.kernels.some_at_once import some_at_once
from casadi_ik.kernels.wanted_outputs import wanted_outputs


@cache
def driver_text(name: str) -> str:
    """The text of `drivers/<name>.c`."""
    return (resources.files("casadi_ik.kernels") / "drivers" / f"{name}.c").read_text(
        encoding="utf-8"
    )


def define(constants: Mapping[str, int]) -> str:
    """The constants as `#define` lines."""
    return "".join(f"#define {name} ({value})\n" for name, value in constants.items())


def row_major(function: ca.Function) -> ca.Function:
    """The same function with dense inputs and outputs whose memory is row by row.

    CasADi works on the nonzeros of matrices, column by column. Transposing inside the graph costs
    nothing in an SX graph and lets numpy memory go in and out as it is.

    Args:
        function: Any CasADi Function.

    Returns:
        The function itself where it is dense and has vectors only; otherwise a function of the
        same name and argument names, in which an r x c matrix is declared c x r.
    """
    count_in, count_out = function.n_in(), function.n_out()
    shapes_in = [function.size_in(i) for i in range(count_in)]
    shapes_out = [function.size_out(i) for i in range(count_out)]
    dense = all(function.sparsity_in(i).is_dense() for i in range(count_in)) and all(
        function.sparsity_out(i).is_dense() for i in range(count_out)
    )
    if dense and all(1 in shape for shape in (*shapes_in, *shapes_out)):
        return function
    # Of the two kinds of symbols only one fits, which the stubs cannot know.
    kind: Any = ca.SX if function.is_a("SXFunction") else ca.MX
    names_in, names_out = function.name_in(), function.name_out()
    symbols: list[Any] = [
        kind.sym(name, columns, rows)
        for name, (rows, columns) in zip(names_in, shapes_in, strict=True)
    ]
    results = function.call([symbol.T for symbol in symbols])
    outputs = [ca.densify(result.T) for result in results]
    return ca.Function(function.name(), symbols, outputs, names_in, names_out)


def function_source(function: ca.Function) -> str:
    """The C code of a function and of everything it calls.

    Raises:
        KernelError: The graph holds a node without C code (a Python callback, an Ipopt call).
    """
    name = function.name()
    options = {"with_header": False, "mex": False, "main": False}
    generator = ca.CodeGenerator(name, options)
    try:
        generator.add(function)
        text = generator.dump()
    except RuntimeError as error:
        raise KernelError(f"kernel {name!r}: no C code can be generated: {error}") from error
    for line in text.splitlines():
        if line.lstrip().startswith("#error"):
            raise KernelError(f"kernel {name!r}: {line.strip().removeprefix('#error').strip()}")
    return wanted_outputs(looked_at_once(text))


OWN = ("sin", "cos", "tan", "asin", "acos", "atan", "atan2")
"""Functions of the C library that generated code does not call (drivers/elementary.c)."""

EXTREMES = ("fmax", "fmin")
"""Likewise (drivers/extremes.c): a call takes as long as ten operations."""

LOOPS = """\
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize ("O3")
#endif
"""
"""Has gcc turn loops into vector operations, which it does not do at the level of long sources."""

WIDE = """\
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#pragma GCC target("avx2")
#endif
"""
"""Before all code: for machines with wide registers, whose instructions are fewer."""


@cache
def own_functions() -> str:
    """Their forms for one number, and for some at once."""
    forms = driver_text("elementary")
    few = driver_text("elementary_few") + forms
    return "".join(
        (
            driver_text("elementary_alone") + forms,
            f"#define FEW 2\n{few}#undef FEW\n",
            f"#ifdef __AVX2__\n#define FEW 4\n{few}#undef FEW\n#endif\n",
            driver_text("elementary_calls") + driver_text("extremes"),
        )
    )


def with_own_functions(text: str) -> str:
    """Generated code that calls the elementary functions of the drivers."""
    return "\n".join(
        (
            own_functions(),
            *(f"#define {name} own_{name}" for name in (*OWN, *EXTREMES)),
            text,
            *(f"#undef {name}" for name in (*OWN, *EXTREMES)),
        )
    )


def step_names(name: str) -> str:
    """The macros by which drivers name a function's symbols."""
    suffixes = ("", "_work", "_checkout", "_release", "_incref")
    return "".join(f"#define STEP{suffix} {name}{suffix}\n" for suffix in suffixes)


def library_source(
    function: ca.Function, driver: str, wide: bool = False, loops: bool = False
) -> str:
    """The text of a whole library: the function's code, its names, what drivers share, a driver.

    Args:
        function: Dense and row-major.
        driver: C text of the driver, with its constants.
        wide: Whether the machine has wide registers.
        loops: Whether loops over tables are most of the work.
    """
    # More than one thread at once may hold memory of a function that needs some.
    header = "#define CASADI_MAX_NUM_THREADS 64\n"
    return "\n".join(
        (
            WIDE if wide else "",
            LOOPS if loops else "",
            header,
            with_own_functions(some_at_once(function_source(function))),
            step_names(function.name()),
            driver_text("common"),
            driver,
        )
    )
