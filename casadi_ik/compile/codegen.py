"""C text: of a whole library for a CasADi Function and a driver, and of numbers.

The drivers (`runtime/*.c`) are fixed C code that calls "the step" by a macro; what they need to
know of one function arrives as `#define` lines.
"""

from __future__ import annotations

import ctypes
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.emitter import CodeOptions, emit


@cache
def driver_text(name: str) -> str:
    """The text of `runtime/<name>.c`."""
    return (resources.files("casadi_ik.compile") / "runtime" / f"{name}.c").read_text(
        encoding="utf-8"
    )


def c_struct(name: str, sizes: Mapping[str, int] | None = None, driver: str = "") -> Any:
    """The struct `<name>` of `runtime/<name>.c` for ctypes; pointers of any kind are addresses.

    Args:
        name: As C has it.
        sizes: What names in brackets stand for.
        driver: Whose it is, if that has another name.
    """
    text = re.sub(r"/\*.*?\*/", "", driver_text(driver or name), flags=re.DOTALL)
    body = text.partition(f"}} {name};")[0].rpartition("typedef struct {")[2]
    fields: list[tuple[str, Any]] = []
    for declaration in filter(str.strip, body.split(";")):
        if declaration.strip().isupper():
            continue  # what a solver that stands alone adds
        if called := re.search(r"(?:\(\*|KERNEL\()(\w+)", declaration):
            fields.append((called[1], ctypes.c_void_p))
            continue
        kind: Any = ctypes.c_double if "scalar" in declaration else ctypes.c_int64
        for one in declaration.split(","):
            found = re.search(r"(\**)(\w+)(?:\[(\w+)\])?\s*$", one)
            assert found is not None, one
            pointer, field, size = found.groups()
            own = ctypes.c_void_p if pointer else kind
            fields.append((field, own * (sizes or {})[size] if size else own))
    return type(name, (ctypes.Structure,), {"_fields_": fields})


def define(constants: Mapping[str, int]) -> str:
    """The constants as `#define` lines."""
    return "".join(f"#define {name} ({value})\n" for name, value in constants.items())


def row_major(function: Any) -> Any:
    """The same function with dense inputs and outputs whose memory is row by row.

    CasADi works on the nonzeros of matrices, column by column. Transposing inside the graph costs
    nothing in an SX graph and lets numpy memory go in and out as it is.

    Args:
        function: Any CasADi Function, or stages.

    Returns:
        Stages, and the function itself where it is dense and has vectors only; otherwise a function
        of the same name and argument names, in which an r x c matrix is declared c x r.
    """
    if isinstance(function, Stages):
        return function
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


WIDE = """\
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#pragma GCC target("avx2")
#endif
"""
"""Before all code: for machines with wide registers, whose instructions are fewer."""


@cache
def meaning(options: CodeOptions) -> str:
    """C text that says what the emitter's code means: types, operations, elementary functions."""
    forms, loops = driver_text("elementary"), driver_text("loops")
    if options.single:
        single = driver_text("elementary_single") + driver_text("real")
        return f"{loops}#define SINGLE\n{single}"
    alone = loops + driver_text("elementary_alone") + forms
    if options.lanes > 1:
        own = driver_text("lanes") + driver_text("elementary_lanes") + forms
        return alone + define({"LANES": options.lanes}) + own
    few = driver_text("elementary_few") + forms
    return "".join(
        (
            alone,
            f"#define FEW 2\n{few}#undef FEW\n",
            f"#ifdef __AVX2__\n#define FEW 4\n{few}#undef FEW\n#endif\n",
            driver_text("elementary_calls") + driver_text("real"),
        )
    )


@dataclass(frozen=True, eq=False)
class Stages:
    """An iteration that C decides on: the functions it calls, and its text.

    Attributes:
        functions: By members of an enum, whose names the text calls them by; dense vectors.
        text: Defines ``iterate(real *state, const real *parameters, const scalar *const *own, real
            *state_after, real *record, real *status, int wanted)``: `own` are the parameters of
            each lane by themselves, `record` may be NULL.
    """

    functions: Mapping[Any, ca.Function]
    text: str

    def source(self, options: CodeOptions) -> str:
        """C code, as of `step_source`."""
        text, names = emit(list(self.functions.values()), options)
        behind = ", wanted" if options.lanes > 1 else ""
        calls = "".join(
            f"#define {stage.name}(...) {name}(__VA_ARGS__{behind})\n"
            for stage, name in zip(self.functions, names, strict=True)
        )
        arguments = "(real *) (arg)[0], (arg)[1], (const scalar *const *) (arg)[2]"
        step = f"iterate({arguments}, (res)[0], (res)[1], (res)[2], wanted)"
        return (
            text
            + calls
            + self.text
            + f"#define STEP(arg, res, wanted) {step}\n"
            + define({"STEP_IN": 2, "STEP_OUT": 3})
        )


def step_source(function: ca.Function | Stages, options: CodeOptions) -> str:
    """C code of a function, which drivers call by the macro `STEP(arg, res, wanted)`."""
    if isinstance(function, Stages):
        return function.source(options)
    text, (name,) = emit([function], options)
    n_in, n_out = function.n_in(), function.n_out()
    arguments = [*(f"(arg)[{i}]" for i in range(n_in)), *(f"(res)[{i}]" for i in range(n_out))]
    lane_mask = ["wanted"] if options.lanes > 1 else []
    return "".join(
        (
            text,
            f"#define STEP(arg, res, wanted) {name}({', '.join(arguments + lane_mask)})\n",
            define({"STEP_IN": n_in, "STEP_OUT": n_out}),
        )
    )


def standing_alone(function: ca.Function | Stages, options: CodeOptions) -> str:
    """C code of a function and of all it needs."""
    return meaning(options) + step_source(function, options)


def library_source(
    function: ca.Function | Stages,
    driver: str,
    lanes: int = 1,
    wide: bool = False,
) -> str:
    """The text of a whole library: the function's code, what drivers share, a driver.

    Args:
        function: Dense and row-major.
        driver: C text of the driver, with its constants.
        lanes: How many solves are made side by side.
        wide: Whether the machine has wide registers.
    """
    options = CodeOptions(lanes)
    return "\n".join(
        (
            WIDE if wide else "",
            standing_alone(function, options),
            driver_text("common"),
            driver,
        )
    )


def digits(value: float) -> str:
    """A finite number as C writes it, as a double."""
    if not math.isfinite(value):
        raise ValueError(f"{value} is no constant of C")
    return repr(float(value))


def number(value: float) -> str:
    """A constant of the type `scalar`, whatever its precision."""
    return f"((scalar) {digits(value)})"


def numbers(values: Iterable[Any]) -> str:
    """Numbers between braces, in lines; rows of rows have braces of their own."""
    parts = [
        numbers(value)
        if isinstance(value, Sequence | np.ndarray)
        else str(int(value))
        if isinstance(value, int | np.integer)
        else digits(value)
        for value in values
    ]
    lines, line = [], ""
    for part in parts:
        if line and len(line) + len(part) + 2 > 96:
            lines.append(line)
            line = ""
        line += ("" if not line else " ") + part + ","
    return "{\n" + "\n".join([*lines, line.rstrip(",")]) + "}"


def define_arrays(arrays: Mapping[str, NDArray[Any]], scope: str = "static const") -> str:
    """Arrays of the type `scalar`, of 16-bit or of common whole numbers, by name; none is empty."""
    text = ""
    for name, array in arrays.items():
        whole = "int16_t" if array.dtype == np.int16 else "int"
        kind = whole if array.dtype.kind in "iu" else "scalar"
        sizes = "".join(f"[{size}]" for size in array.shape)
        text += f"{scope} {kind} {name}{sizes} = {numbers(array)};\n"
    return text
