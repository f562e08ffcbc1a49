"""C text of whole libraries: the code of a CasADi Function, and the runtime that calls it.

The runtime (`runtime/*.c`) is fixed C code that calls the function through the macro `STEP`; the
sizes of a function are `#define` lines.
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
    """Return the text of `runtime/<name>.c`."""
    return (resources.files("casadi_ik.compile") / "runtime" / f"{name}.c").read_text(
        encoding="utf-8"
    )


def c_struct(name: str, sizes: Mapping[str, int] | None = None, driver: str = "") -> Any:
    """Return the C struct `<name>` of `runtime/<name>.c` for ctypes; pointers become addresses.

    Args:
        name: Name of the struct.
        sizes: Lengths of arrays by the name in brackets.
        driver: Name of the file if it differs from that of the struct.
    """
    text = re.sub(r"/\*.*?\*/", "", driver_text(driver or name), flags=re.DOTALL)
    body = text.partition(f"}} {name};")[0].rpartition("typedef struct {")[2]
    fields: list[tuple[str, Any]] = []
    for declaration in filter(str.strip, body.split(";")):
        if declaration.strip().isupper():
            continue  # a macro for fields of a standalone solver
        if callback := re.search(r"(?:\(\*|KERNEL\()(\w+)", declaration):
            fields.append((callback[1], ctypes.c_void_p))
            continue
        kind: Any = ctypes.c_double if "scalar" in declaration else ctypes.c_int64
        for name in declaration.split(","):
            match = re.search(r"(\**)(\w+)(?:\[(\w+)\])?\s*$", name)
            assert match is not None, name
            pointer, field, size = match.groups()
            field_type = ctypes.c_void_p if pointer else kind
            fields.append((field, field_type * (sizes or {})[size] if size else field_type))
    return type(name, (ctypes.Structure,), {"_fields_": fields})


def define(constants: Mapping[str, int]) -> str:
    """Return constants as `#define` lines."""
    return "".join(f"#define {name} ({value})\n" for name, value in constants.items())


def row_major(function: Any) -> Any:
    """Return a function with dense, row-major inputs and outputs.

    CasADi stores the nonzeros of matrices column by column. A transposition inside an SX graph
    costs nothing and lets NumPy memory pass without a copy.

    Args:
        function: Any CasADi Function, or stages.

    Returns:
        Stages, or a dense function of vectors, unchanged; otherwise a function with the same names
        in which an r x c matrix is declared c x r.
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
    # CasADi's stubs cannot tell which of the two symbol types a function takes.
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
"""First lines of a library for machines with wide registers."""


@cache
def type_definitions(options: CodeOptions) -> str:
    """Return the C definitions that emitted code needs: types, operations, elementary functions."""
    forms, loops = driver_text("elementary"), driver_text("loops")
    if options.single:
        single = driver_text("elementary_single") + driver_text("real")
        return f"{loops}#define SINGLE\n{single}"
    scalar_text = loops + forms
    if options.lanes > 1:
        return scalar_text + define({"LANES": options.lanes}) + driver_text("lanes") + forms
    return "".join(
        (
            scalar_text,
            f"#define FEW 2\n{forms}#undef FEW\n",
            f"#ifdef __AVX2__\n#define FEW 4\n{forms}#undef FEW\n#endif\n",
            driver_text("elementary_calls") + driver_text("real"),
        )
    )


@dataclass(frozen=True, eq=False)
class Stages:
    """Iteration with control flow in C: the functions that it calls, and its text.

    Attributes:
        functions: Functions of dense vectors by enum member; the text calls them by member name.
        text: C code that defines ``iterate(real *state, const real *parameters, const scalar *const
            *own, real *state_after, real *record, real *status, int active_lanes)``. `own` holds
            the parameters of each lane; `record` may be NULL.
    """

    functions: Mapping[Any, ca.Function]
    text: str

    def source(self, options: CodeOptions) -> str:
        """Return the C code of the stages and the macro `STEP`."""
        text, names = emit(list(self.functions.values()), options)
        lane_argument = ", active_lanes" if options.lanes > 1 else ""
        calls = "".join(
            f"#define {stage.name}(...) {name}(__VA_ARGS__{lane_argument})\n"
            for stage, name in zip(self.functions, names, strict=True)
        )
        arguments = "(real *) (arg)[0], (arg)[1], (const scalar *const *) (arg)[2]"
        step = f"iterate({arguments}, (res)[0], (res)[1], (res)[2], active_lanes)"
        return (
            text
            + calls
            + self.text
            + f"#define STEP(arg, res, active_lanes) {step}\n"
            + define({"STEP_IN": 2, "STEP_OUT": 3, "STEP_STAGES": len(self.functions)})
        )


MAX_GRAPH_STAGES = 12
"""Number of queues in the loop for a step that is one graph with an unknown number of stages."""


def step_source(function: ca.Function | Stages, options: CodeOptions) -> str:
    """Return the C code of a function, and the macro `STEP(arg, res, active_lanes)` for calls."""
    if isinstance(function, Stages):
        return function.source(options)
    text, (name,) = emit([function], options)
    n_in, n_out = function.n_in(), function.n_out()
    arguments = [*(f"(arg)[{i}]" for i in range(n_in)), *(f"(res)[{i}]" for i in range(n_out))]
    lane_mask = ["active_lanes"] if options.lanes > 1 else []
    return "".join(
        (
            text,
            f"#define STEP(arg, res, active_lanes) {name}({', '.join(arguments + lane_mask)})\n",
            define({"STEP_IN": n_in, "STEP_OUT": n_out, "STEP_STAGES": MAX_GRAPH_STAGES}),
        )
    )


def standalone_source(function: ca.Function | Stages, options: CodeOptions) -> str:
    """Return the C code of a function with all definitions that it needs."""
    return type_definitions(options) + step_source(function, options)


def library_source(
    function: ca.Function | Stages,
    driver: str,
    lanes: int = 1,
    wide: bool = False,
) -> str:
    """Return the text of a library: code of the function, shared runtime, specific runtime.

    Args:
        function: Dense, row-major function or stages.
        driver: C text of the specific runtime with its constants.
        lanes: Number of lanes.
        wide: True if the machine has wide registers.
    """
    options = CodeOptions(lanes)
    return "\n".join(
        (
            WIDE if wide else "",
            standalone_source(function, options),
            driver_text("common"),
            driver,
        )
    )


def digits(value: float) -> str:
    """Return a finite number as a C literal of type double."""
    if not math.isfinite(value):
        raise ValueError(f"{value} has no C literal")
    return repr(float(value))


def number(value: float) -> str:
    """Return a C constant of the type `scalar`."""
    return f"((scalar) {digits(value)})"


def numbers(values: Iterable[Any]) -> str:
    """Return a C initializer of numbers, with nested braces for nested sequences."""
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
    """Return definitions of C arrays of type `scalar`, `int16_t` or `int`, by name.

    C has no empty arrays: a dimension of zero becomes one, and the array contains zeros.
    """
    text = ""
    for name, array in arrays.items():
        if not array.size:
            array = np.zeros([max(size, 1) for size in array.shape], array.dtype)
        integer_type = "int16_t" if array.dtype == np.int16 else "int"
        kind = integer_type if array.dtype.kind in "iu" else "scalar"
        sizes = "".join(f"[{size}]" for size in array.shape)
        text += f"{scope} {kind} {name}{sizes} = {numbers(array)};\n"
    return text
