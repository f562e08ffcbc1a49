"""C code from CasADi Functions.

`emit` reads the instructions of a Function and of all Functions that it calls, and writes one C
function for each, callees first. The text is the same for scalars, vectors and single precision:
the C text before it defines `real`, `mask` and `real_sin` (`runtime/real.c`, `runtime/lanes.c`,
`runtime/elementary_single.c`).

- An SX Function becomes straight-line code (`straight_lines.py`).
- An MX Function becomes a list of calls, with arrays on the stack between them.
- A Map calls a Function for each of its columns.
- A Switch calls one of several Functions. With several lanes it calls each branch that any lane
  takes, and every lane stores the results of its branch.

Other Functions are expanded into SX. Functions that differ in constants only, such as those of
a left and a right arm, share a C function, with a table of constants for each.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from casadi_ik.compile.straight_lines import (
    MASK,
    REAL,
    CName,
    CodeOptions,
    NoCodeError,
    as_mask,
    straight_lines,
    takes_masks,
)
from casadi_ik.errors import KernelError


def emit(functions: Sequence[ca.Function], options: CodeOptions) -> tuple[str, list[CName]]:
    """Return the C text of functions and of all functions that they call.

    Args:
        functions: Functions of any kind; a function that is called several times is written once.
        options: Lanes and precision of the code.

    Returns:
        The text, and the names of the functions in C: `static void name(const real *i0, ...,
        real *o0, ...)`; some are macros. With several lanes, `int active_lanes` follows: a bit for
        each lane whose results are needed. The nonzeros of an output are written unless its pointer
        is NULL; the pointer of the first output never is.

    Raises:
        KernelError: A function contains an operation without C code, such as a Python callback.
    """
    emitter = _Emitter(options)
    names = []
    for function in functions:
        try:
            names.append(emitter.name(function))
        except NoCodeError as error:
            raise KernelError(f"kernel {function.name()!r}: no C code for {error}") from error
    return emitter.text(names), names


VARYING_PART = re.compile(r"\bR\((-?[0-9][^()]*)\)|\b(f[0-9]+_\w+)\(")
"""Pattern of a constant or a callee, the parts in which functions of a group may differ."""


class _CFunction(NamedTuple):
    """A C function: name, parameters, body, and the index of its group of similar functions."""

    name: CName
    parameters: str
    body: str
    group: int


class _Emitter:
    """Writer of C functions; writes each function once."""

    def __init__(self, options: CodeOptions) -> None:
        self.options = options
        self._names: dict[int, tuple[CName, ca.Function]] = {}
        self._functions: dict[CName, _CFunction] = {}
        self._groups: dict[str, int] = {}

    def name(self, function: ca.Function) -> CName:
        """Return the C name of a function; write the function on first use."""
        key = function.__hash__()
        if key not in self._names:
            body = self._body(function)
            name = f"f{len(self._names)}_{function.name()}"
            self._names[key] = name, function
            inputs = [f"i{i}" for i in range(function.n_in())]
            outputs = [f"o{i}" for i in range(function.n_out())]
            parameters = [f"const real *{i}" for i in inputs] + [f"real *{o}" for o in outputs]
            head = ", ".join(parameters + (["int active_lanes"] if self.options.lanes > 1 else []))
            unused = ", ".join(f"(void) {x}" for x in inputs + outputs)
            self._write(name, head, f"  {unused};\n{body}")
        return self._names[key][0]

    def _write(self, name: CName, parameters: str, body: str) -> None:
        """Store a function; all functions that it calls are stored already."""

        def group(match: re.Match[str]) -> str:
            return f"<{self._functions[match[2]].group if match[2] else ''}>"

        signature = parameters + VARYING_PART.sub(group, body)
        number = self._groups.setdefault(signature, len(self._groups))
        self._functions[name] = _CFunction(name, parameters, body, number)

    def text(self, entry_points: Sequence[CName]) -> str:
        """Return the text of all functions; similar ones share code and have constant tables."""
        groups: list[list[_CFunction]] = [[] for _ in self._groups]
        for function in self._functions.values():
            groups[function.group].append(function)
        tables: dict[CName, list[str]] = {}
        codes = [self._group_code(index, group, tables) for index, group in enumerate(groups)]
        used_names = {
            *entry_points,
            *(name for code in codes for _, name in VARYING_PART.findall(code)),
        }
        texts = []
        for index, (code, group) in enumerate(zip(codes, groups, strict=True)):
            texts.append(code)
            for name in (f.name for f in group if tables[f.name] and f.name in used_names):
                texts += [
                    f"static const scalar of_{name}[]={{{','.join(tables[name])}}};\n",
                    f"#define {name}(...) shared{index}(of_{name}, __VA_ARGS__)\n",
                ]
        return "".join(texts)

    def _group_code(
        self, index: int, group: list[_CFunction], tables: dict[CName, list[str]]
    ) -> str:
        """Return the code of similar functions; `tables` receives the constants that differ."""
        first, *duplicates = group
        constants = [list[str]() for _ in group]
        table_offsets: list[int | None] = []
        for varying in zip(*(VARYING_PART.findall(f.body) for f in group), strict=True):
            parts = [tables[name] if name else [constant] for constant, name in varying]
            differs = any(part != parts[0] for part in parts)
            table_offsets.append(len(constants[0]) if differs else None)
            for table, part in zip(constants, parts, strict=True):
                table += part if differs else []
        tables |= {f.name: table for f, table in zip(group, constants, strict=True)}
        if not constants[0]:
            aliases = "".join(
                f"#define {duplicate.name} {first.name}\n" for duplicate in duplicates
            )
            return f"CODE void {first.name}({first.parameters}) {{\n{first.body}}}\n{aliases}"
        offset_iterator = iter(table_offsets)

        def substitute(match: re.Match[str]) -> str:
            offset = next(offset_iterator)
            if offset is None:
                return match[0]
            if not match[2]:
                return f"R(constants[{offset}])"
            return f"shared{self._functions[match[2]].group}(constants+{offset}, "

        body = VARYING_PART.sub(substitute, first.body)
        return (
            f"CODE void shared{index}(const scalar *constants, {first.parameters}) {{\n{body}}}\n"
        )

    def call(
        self, function: ca.Function, arguments: Sequence[str], active_lanes: str = "active_lanes"
    ) -> str:
        """Return the C statement that calls a function."""
        lane_mask = [active_lanes] if self.options.lanes > 1 else []
        return f"{self.name(function)}({', '.join([*arguments, *lane_mask])});"

    def _body(self, function: ca.Function) -> str:
        kind = function.class_name()
        if kind == "SXFunction":
            return straight_lines(function, self.options, self.call)
        if kind == "Switch":
            return _switch_body(function, self)
        if kind == "Map":
            return _map_body(function, self)
        if kind == "MXFunction":
            try:
                return _MXBody(function, self).text()
            except _UnsupportedOperationError:
                pass
        try:
            return straight_lines(function.expand(), self.options, self.call)
        except RuntimeError as error:
            raise NoCodeError(f"{function.name()!r}: {error}") from error


# MX Functions: calls, and operations that move numbers between them.


class _UnsupportedOperationError(Exception):
    """The operation has no direct C code; the Function is expanded instead."""


class _Array(NamedTuple):
    """An array in C.

    Attributes:
        name: C expression of the pointer to the first element.
        size: Number of elements.
        is_constant: True if the elements are constants of the type `scalar`.
    """

    name: str
    size: int
    is_constant: bool = False

    def item(self, index: int | str) -> str:
        """Return the C expression of an element."""
        return f"R({self.name}[{index}])" if self.is_constant else f"{self.name}[{index}]"


class _MXBody:
    """Writer of an MX Function."""

    def __init__(self, function: ca.Function, emitter: _Emitter) -> None:
        self._function = function
        self._emitter = emitter
        self._lines: list[str] = []
        self._work: dict[int, _Array] = {}  # by slot of the work vector
        self._constants: dict[str, str] = {}  # array names by content
        self._direct_outputs = self._calls_that_write_outputs()

    def _calls_that_write_outputs(self) -> dict[tuple[int, int], int]:
        """Return (instruction, result) -> output for results that are used as one output only."""
        function = self._function
        sources: dict[int, tuple[int, int]] = {}
        uses: dict[tuple[int, int], list[int | None]] = {}
        stores = [0] * function.n_out()
        for k in range(function.n_instructions()):
            code, slots = function.instruction_id(k), function.instruction_output(k)
            if code != ca.OP_INPUT:
                output = slots[0] if code == ca.OP_OUTPUT else None
                for slot in function.instruction_input(k):
                    if slot in sources:
                        uses.setdefault(sources[slot], []).append(output)
            if code == ca.OP_OUTPUT:
                stores[slots[0]] += 1
                continue
            for i, slot in enumerate(slots):
                sources.pop(slot, None)
                if code == ca.OP_CALL:
                    sources[slot] = k, i
        return {
            key: outputs[0]
            for key, outputs in uses.items()
            if len(outputs) == 1 and outputs[0] is not None and stores[outputs[0]] == 1
        }

    def text(self) -> str:
        """Return the body.

        Raises:
            _UnsupportedOperationError: An operation is not known.
        """
        function = self._function
        inputs, outputs = [0] * function.n_in(), [0] * function.n_out()  # elements consumed so far
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            arguments, slots = function.instruction_input(k), function.instruction_output(k)
            if code == ca.OP_OUTPUT:
                source, destination = self._work[arguments[0]], f"o{slots[0]}"
                if source.name != destination:
                    copied = self._copy(source, f"{destination}+{outputs[slots[0]]}")
                    self._lines.append(f"if ({destination}) {copied}")
                outputs[slots[0]] += source.size
                continue
            value = function.instruction_MX(k)
            if code == ca.OP_INPUT:
                self._work[slots[0]] = _Array(
                    f"(i{arguments[0]}+{inputs[arguments[0]]})", value.nnz()
                )
                inputs[arguments[0]] += value.nnz()
            elif code == ca.OP_CALL:
                self._call(k, value.which_function())
            elif len(slots) == 1:
                operands = [self._work[slot] for slot in arguments]
                self._work[slots[0]] = self._operation(f"w{k}", code, value, operands)
            else:
                raise _UnsupportedOperationError
        tables = [
            f"static const scalar {name}[]={{{text}}};" for text, name in self._constants.items()
        ]
        return "".join([f"  {line}\n" for line in (*tables, *self._lines)])

    def _array(self, name: str, size: int) -> _Array:
        self._lines.append(f"real {name}[{max(size, 1)}];")
        return _Array(name, size)

    def _constant(self, name: str, numbers: Sequence[float]) -> _Array:
        texts = ",".join(self._emitter.options.digits(number) for number in numbers or [0.0])
        return _Array(self._constants.setdefault(texts, name), len(numbers), is_constant=True)

    @staticmethod
    def _copy(source: _Array, destination: str) -> str:
        return f"for (int k = 0; k < {source.size}; ++k) ({destination})[k]={source.item('k')};"

    def _call(self, k: int, callee: ca.Function) -> None:
        function, arguments = self._function, []
        for i, slot in enumerate(function.instruction_input(k)):
            name = f"z{k}_{i}"
            argument = self._work.get(slot) or self._constant(name, [0.0] * callee.nnz_in(i))
            if argument.is_constant and self._emitter.options.lanes > 1:
                copy = self._array(f"y{k}_{i}", argument.size)
                self._lines.append(self._copy(argument, copy.name))
                argument = copy
            arguments.append(argument.name)
        for i, slot in enumerate(function.instruction_output(k)):
            if (k, i) in self._direct_outputs:
                arguments.append(f"o{self._direct_outputs[k, i]}")
            elif slot < 0 and i:
                arguments.append("NULL")
                continue
            else:
                arguments.append(self._array(f"w{k}_{i}", callee.nnz_out(i)).name)
            self._work[slot] = _Array(arguments[-1], callee.nnz_out(i))
        self._lines.append(self._emitter.call(callee, arguments))

    def _operation(self, name: str, code: int, value: ca.MX, operands: Sequence[_Array]) -> _Array:
        size = value.nnz()
        if code == ca.OP_ASSERTION:
            raise NoCodeError(f"an assertion of {self._function.name()!r}")
        if code == ca.OP_CONST:
            return self._constant(name, value.to_DM().nonzeros())
        if code == ca.OP_RESHAPE or (code == ca.OP_SPARSITY_CAST and operands[0].size == size):
            return operands[0]
        if code == ca.OP_GETNONZEROS:
            return self._gather(name, operands[0], _integers(value.mapping()))
        if code == ca.OP_TRANSPOSE and value.is_dense():
            order = np.arange(size).reshape(value.shape[0], -1).ravel(order="F")
            return self._gather(name, operands[0], order.tolist())
        if code == ca.OP_PROJECT:
            source_sparsity, sparsity = value.dep().sparsity(), value.sparsity()
            index_of = {
                position: i
                for i, position in enumerate(zip(*source_sparsity.get_triplet(), strict=True))
            }
            order = [
                index_of.get(position) for position in zip(*sparsity.get_triplet(), strict=True)
            ]
            return self._gather(name, operands[0], order)
        if code == ca.OP_HORZREPMAT:
            array, source = self._array(name, size), operands[0].item(f"k%{operands[0].size}")
            self._lines.append(f"for (int k = 0; k < {size}; ++k) {name}[k]={source};")
            return array
        if code == ca.OP_SETNONZEROS:
            array = self._array(name, size)
            self._lines.append(self._copy(operands[0], name))
            order = enumerate(_integers(value.mapping()))
            self._lines += [f"{name}[{i}]={operands[1].item(k)};" for k, i in order]
            return array
        if code in (ca.OP_VERTCAT, ca.OP_HORZCAT):
            array, offset = self._array(name, size), 0
            for element in operands:
                self._lines.append(self._copy(element, f"{name}+{offset}"))
                offset += element.size
            return array
        if code in REAL or code in MASK:
            return self._elementwise(name, code, operands, size)
        return self._matrix_operation(name, code, value, operands)

    def _gather(self, name: str, source: _Array, order: Sequence[int | None]) -> _Array:
        """Gather elements of an array, None for zero; consecutive elements become a view."""
        first = order[0] if order else 0
        if first is not None and list(order) == list(range(first, first + len(order))):
            return _Array(f"({source.name}+{first})", len(order), source.is_constant)
        self._lines += [f"real {name}[{max(len(order), 1)}];"] + [
            f"{name}[{k}]={'R(0.0)' if i is None else source.item(i)};" for k, i in enumerate(order)
        ]
        return _Array(name, len(order))

    def _elementwise(self, name: str, code: int, operands: Sequence[_Array], size: int) -> _Array:
        if any(element.size not in (1, size) for element in operands):
            raise _UnsupportedOperationError
        texts = (
            as_mask(element.item("k" if element.size > 1 else 0), False)
            if takes_mask
            else element.item("k" if element.size > 1 else 0)
            for element, takes_mask in zip(operands, takes_masks(code), strict=False)
        )
        value = (MASK[code] if code in MASK else REAL[code]) % tuple(texts)
        array = self._array(name, size)
        value = f"TRUTH({value})" if code in MASK else value
        self._lines.append(f"for (int k = 0; k < {size}; ++k) {name}[k]={value};")
        return array

    def _matrix_operation(
        self, name: str, code: int, value: ca.MX, operands: Sequence[_Array]
    ) -> _Array:
        """Write an operation on whole matrices as loops."""
        matrices = [value.dep(i) for i in range(value.n_dep())]
        if not all(matrix.is_dense() for matrix in (value, *matrices)):
            raise _UnsupportedOperationError
        first, x = operands[0], operands[0].item("k")
        array, accumulator = self._array(name, value.nnz()), f"{name}[0]"
        if code == ca.OP_MTIMES:
            rows, inner, columns = value.size1(), matrices[1].size2(), value.size2()
            a, b = (
                operands[1].item(f"i+{rows}*k"),
                operands[2].item(f"k+{inner}*j"),
            )
            self._lines += [
                self._copy(first, name),
                f"for (int j = 0; j < {columns}; ++j) for (int k = 0; k < {inner}; ++k) "
                f"for (int i = 0; i < {rows}; ++i) {name}[i+{rows}*j]+={a}*{b};",
            ]
            return array
        if code == ca.OP_FIND and self._emitter.options.lanes == 1:
            zeros = f"while (k < {first.size} && EQUAL({x},R(0.0))) ++k;"
            self._lines.append(f"{{ int k = 0; {zeros} {accumulator}=R(k); }}")
            return array
        update = {
            ca.OP_DOT: f"{accumulator}+{x}*{operands[-1].item('k')}",
            ca.OP_NORM2: f"{accumulator}+real_sq({x})",
            ca.OP_NORMF: f"{accumulator}+real_sq({x})",
            ca.OP_NORMINF: f"real_fmax({accumulator},real_fabs({x}))",
            ca.OP_MMIN: f"real_fmin({accumulator},{x})",
            ca.OP_MMAX: f"real_fmax({accumulator},{x})",
            # Number of zeros before the first nonzero.
            ca.OP_FIND: f"{accumulator}+IF(EQUAL({accumulator},R(k))&EQUAL({x},R(0.0)),R(1.0))",
        }.get(code)
        if update is None:
            raise _UnsupportedOperationError
        initial = first.item(0) if code in (ca.OP_MMIN, ca.OP_MMAX) else "R(0.0)"
        self._lines.append(f"{accumulator}={initial};")
        self._lines.append(f"for (int k = 0; k < {first.size}; ++k) {accumulator}={update};")
        if code in (ca.OP_NORM2, ca.OP_NORMF):
            self._lines.append(f"{accumulator}=real_sqrt({accumulator});")
        return array


def _integers(numbers: Any) -> list[int]:
    return [int(number) for number in ca.DM(numbers).nonzeros()]


# Map applies a function to each column; Switch selects one of several functions.


def _map_body(function: ca.Function, emitter: _Emitter) -> str:
    info = function.info()
    mapped, count = info["f"], info["n"]
    inputs = [f"i{i}+k*{mapped.nnz_in(i)}" for i in range(mapped.n_in())]
    outputs = [f"o{i} ? o{i}+k*{mapped.nnz_out(i)} : NULL" for i in range(mapped.n_out())]
    call = emitter.call(mapped, [*inputs, *outputs])
    return f"  for (int k = 0; k < {count}; ++k) {call}\n"


def _switch_body(function: ca.Function, emitter: _Emitter) -> str:
    info = function.info()
    if info["project_in"] or info["project_out"]:
        raise NoCodeError(f"branches of different sparsities: {function.name()!r}")
    branches = [*info["f"], info["f_def"]]
    inputs = [f"i{i}" for i in range(1, function.n_in())]
    outputs = [f"o{i}" for i in range(function.n_out())]
    last = len(branches) - 1

    def cases(destinations: Sequence[str], lane_mask: str) -> Iterator[str]:
        for number, branch in enumerate(branches):
            label = f"case {number}" if number < last else "default"
            call = emitter.call(branch, [*inputs, *destinations], lane_mask)
            yield f"    {label}: {call} break;\n"

    if emitter.options.lanes == 1:
        lines = [f"  switch (branch_of(i0[0], {last})) {{\n", *cases(outputs, ""), "  }\n"]
        return "".join(lines)
    sizes = [max(function.nnz_out(i), 1) for i in range(len(outputs))]
    destinations = [f"p{i}" for i in range(len(outputs))]
    return "".join(
        (
            *(f"  real own{i}[{size}];\n" for i, size in enumerate(sizes)),
            "  int branch[LANES], b;\n",
            f"  lanes_branches(i0[0], {last}, branch);\n",
            f"  for (b = 0; b <= {last}; ++b) {{\n",
            "    const int branch_lanes = active_lanes & lanes_in(branch, b);\n",
            *(
                f"    real *p{i} = branch_lanes == active_lanes || !o{i} ? o{i} : own{i};\n"
                for i in range(len(outputs))
            ),
            "    if (!branch_lanes) continue;\n",
            "    switch (b) {\n",
            *cases(destinations, "branch_lanes"),
            "    }\n",
            "    if (branch_lanes == active_lanes) return;\n",
            *(
                f"    lanes_keep(branch_lanes, own{i}, {size}, o{i});\n"
                for i, size in enumerate(sizes)
            ),
            "  }\n",
        )
    )
