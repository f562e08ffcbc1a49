"""C code from CasADi Functions.

`emit` walks the instructions of a Function and of all it calls and writes one C function for each,
callees first. The text is the same for one number at a time, for vectors and for single precision:
what `real`, `mask` and `real_sin` stand for is said by the C text before it (`runtime/scalar.c`,
`runtime/lanes.c`, `runtime/single.c`). What is written:

- An SX Function is straight-line code (`straight_lines.py`).
- An MX Function is a list of calls, with arrays on the stack between them.
- A Map calls a Function for each of its columns.
- A Switch calls one of several Functions. Of vectors it calls each that any lane takes, and every
  lane keeps the results of its own.

Other Functions are expanded into SX. Functions that differ by constants alone, as those of a left
and a right arm do, are one in C, with a table of constants each.
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
    Form,
    Name,
    NoCodeError,
    as_mask,
    straight_lines,
    takes_masks,
)
from casadi_ik.errors import KernelError


def emit(functions: Sequence[ca.Function], form: Form) -> tuple[str, list[Name]]:
    """C text of functions and of all they call.

    Args:
        functions: Any; what is called more than once is written once.
        form: What the code is for.

    Returns:
        The text, and the names of the functions in C: `static void name(const real *i0, ...,
        real *o0, ...)`, some of them macros, of lanes with `int wanted` behind, a bit for each lane
        that counts. The nonzeros of an output are written where it is not NULL; the first never is.

    Raises:
        KernelError: One holds what has no C code (a Python callback, an Ipopt call).
    """
    emitter = _Emitter(form)
    names = []
    for function in functions:
        try:
            names.append(emitter.name(function))
        except NoCodeError as error:
            raise KernelError(f"kernel {function.name()!r}: no C code for {error}") from error
    return emitter.text(names), names


VARIES = re.compile(r"\bR\((-?[0-9][^()]*)\)|\b(f[0-9]+_\w+)\(")
"""What functions that are alike differ in: constants, and which of some alike they call."""


class _Written(NamedTuple):
    """A function in C: its name, its parameters, its body, the kind of functions that it is of."""

    name: Name
    given: str
    body: str
    kind: int


class _Emitter:
    """Writes functions, each once."""

    def __init__(self, form: Form) -> None:
        self.form = form
        self._names: dict[int, tuple[Name, ca.Function]] = {}
        self._written: dict[Name, _Written] = {}
        self._kinds: dict[str, int] = {}

    def name(self, function: ca.Function) -> Name:
        """The name of a function in C, which is written if it is not yet."""
        key = function.__hash__()
        if key not in self._names:
            body = self._body(function)
            name = f"f{len(self._names)}_{function.name()}"
            self._names[key] = name, function
            inputs = [f"i{i}" for i in range(function.n_in())]
            outputs = [f"o{i}" for i in range(function.n_out())]
            given = [f"const real *{each}" for each in inputs] + [f"real *{o}" for o in outputs]
            head = ", ".join(given + (["int wanted"] if self.form.lanes > 1 else []))
            unused = ", ".join(f"(void) {each}" for each in inputs + outputs)
            self._write(name, head, f"  {unused};\n{body}")
        return self._names[key][0]

    def _write(self, name: Name, given: str, body: str) -> None:
        """Keep a function that calls none but those that are kept."""

        def kind(found: re.Match[str]) -> str:
            return f"<{self._written[found[2]].kind if found[2] else ''}>"

        form = given + VARIES.sub(kind, body)
        number = self._kinds.setdefault(form, len(self._kinds))
        self._written[name] = _Written(name, given, body, number)

    def text(self, asked: Sequence[Name]) -> str:
        """All of them, those that are alike as one with constants by name if they are called so."""
        kinds: list[list[_Written]] = [[] for _ in self._kinds]
        for function in self._written.values():
            kinds[function.kind].append(function)
        tables: dict[Name, list[str]] = {}
        codes = [self._of_kind(number, kind, tables) for number, kind in enumerate(kinds)]
        called = {*asked, *(name for code in codes for _, name in VARIES.findall(code))}
        texts = []
        for number, (code, kind) in enumerate(zip(codes, kinds, strict=True)):
            texts.append(code)
            for name in (each.name for each in kind if tables[each.name] and each.name in called):
                texts += [
                    f"static const scalar of_{name}[]={{{','.join(tables[name])}}};\n",
                    f"#define {name}(...) alike{number}(of_{name}, __VA_ARGS__)\n",
                ]
        return "".join(texts)

    def _of_kind(self, number: int, kind: list[_Written], tables: dict[Name, list[str]]) -> str:
        """Code of functions that are alike; `tables` gets the constants in which each differs."""
        first, *others = kind
        own = [list[str]() for _ in kind]
        places: list[int | None] = []
        for varying in zip(*(VARIES.findall(each.body) for each in kind), strict=True):
            parts = [tables[name] if name else [constant] for constant, name in varying]
            differs = any(part != parts[0] for part in parts)
            places.append(len(own[0]) if differs else None)
            for table, part in zip(own, parts, strict=True):
                table += part if differs else []
        tables |= {each.name: table for each, table in zip(kind, own, strict=True)}
        if not own[0]:
            same = "".join(f"#define {other.name} {first.name}\n" for other in others)
            return f"CODE void {first.name}({first.given}) {{\n{first.body}}}\n{same}"
        at = iter(places)

        def placed(found: re.Match[str]) -> str:
            place = next(at)
            if place is None:
                return found[0]
            if not found[2]:
                return f"R(constants[{place}])"
            return f"alike{self._written[found[2]].kind}(constants+{place}, "

        body = VARIES.sub(placed, first.body)
        return f"CODE void alike{number}(const scalar *constants, {first.given}) {{\n{body}}}\n"

    def call(self, function: ca.Function, arguments: Sequence[str], wanted: str = "wanted") -> str:
        """A call of a function."""
        behind = [wanted] if self.form.lanes > 1 else []
        return f"{self.name(function)}({', '.join([*arguments, *behind])});"

    def _body(self, function: ca.Function) -> str:
        kind = function.class_name()
        if kind == "SXFunction":
            return straight_lines(function, self.form, self.call)
        if kind == "Switch":
            return _switch_body(function, self)
        if kind == "Map":
            return _map_body(function, self)
        if kind == "MXFunction":
            try:
                return _MXBody(function, self).text()
            except _UnknownError:
                pass
        try:
            return straight_lines(function.expand(), self.form, self.call)
        except RuntimeError as error:
            raise NoCodeError(f"{function.name()!r}: {error}") from error


# MX: calls, and what hands numbers from one to the other.


class _UnknownError(Exception):
    """An operation that is not written as it is."""


class _Array(NamedTuple):
    """Numbers in C.

    Attributes:
        name: An expression of the first one's place.
        size: How many.
        fixed: Whether they are constants, of the type `scalar`.
    """

    name: str
    size: int
    fixed: bool = False

    def at(self, index: int | str) -> str:
        """One of them."""
        return f"R({self.name}[{index}])" if self.fixed else f"{self.name}[{index}]"


class _MXBody:
    """Writes an MX function."""

    def __init__(self, function: ca.Function, emitter: _Emitter) -> None:
        self._function = function
        self._emitter = emitter
        self._lines: list[str] = []
        self._held: dict[int, _Array] = {}  # by place of the work vector
        self._constants: dict[str, str] = {}  # names of arrays by their numbers
        self._direct = self._outputs_of_calls()

    def _outputs_of_calls(self) -> dict[tuple[int, int], int]:
        """For results of calls that are an output and nothing else: which."""
        function = self._function
        made: dict[int, tuple[int, int]] = {}
        uses: dict[tuple[int, int], list[int | None]] = {}
        parts = [0] * function.n_out()
        for k in range(function.n_instructions()):
            code, places = function.instruction_id(k), function.instruction_output(k)
            if code != ca.OP_INPUT:
                output = places[0] if code == ca.OP_OUTPUT else None
                for place in function.instruction_input(k):
                    if place in made:
                        uses.setdefault(made[place], []).append(output)
            if code == ca.OP_OUTPUT:
                parts[places[0]] += 1
                continue
            for i, place in enumerate(places):
                made.pop(place, None)
                if code == ca.OP_CALL:
                    made[place] = k, i
        return {
            key: found[0]
            for key, found in uses.items()
            if len(found) == 1 and found[0] is not None and parts[found[0]] == 1
        }

    def text(self) -> str:
        """The body.

        Raises:
            _UnknownError: An operation is not known.
        """
        function = self._function
        inputs, outputs = [0] * function.n_in(), [0] * function.n_out()  # numbers gone through
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            given, places = function.instruction_input(k), function.instruction_output(k)
            if code == ca.OP_OUTPUT:
                found, to = self._held[given[0]], f"o{places[0]}"
                if found.name != to:
                    copied = self._copy(found, f"{to}+{outputs[places[0]]}")
                    self._lines.append(f"if ({to}) {copied}")
                outputs[places[0]] += found.size
                continue
            value = function.instruction_MX(k)
            if code == ca.OP_INPUT:
                self._held[places[0]] = _Array(f"(i{given[0]}+{inputs[given[0]]})", value.nnz())
                inputs[given[0]] += value.nnz()
            elif code == ca.OP_CALL:
                self._call(k, value.which_function())
            elif len(places) == 1:
                found = [self._held[place] for place in given]
                self._held[places[0]] = self._operation(f"w{k}", code, value, found)
            else:
                raise _UnknownError
        tables = [
            f"static const scalar {name}[]={{{text}}};" for text, name in self._constants.items()
        ]
        return "".join([f"  {line}\n" for line in (*tables, *self._lines)])

    def _array(self, name: str, size: int) -> _Array:
        self._lines.append(f"real {name}[{max(size, 1)}];")
        return _Array(name, size)

    def _constant(self, name: str, numbers: Sequence[float]) -> _Array:
        texts = ",".join(self._emitter.form.digits(number) for number in numbers or [0.0])
        return _Array(self._constants.setdefault(texts, name), len(numbers), fixed=True)

    @staticmethod
    def _copy(source: _Array, to: str) -> str:
        return f"for (int k = 0; k < {source.size}; ++k) ({to})[k]={source.at('k')};"

    def _call(self, k: int, called: ca.Function) -> None:
        function, arguments = self._function, []
        for i, place in enumerate(function.instruction_input(k)):
            name = f"z{k}_{i}"
            given = self._held.get(place) or self._constant(name, [0.0] * called.nnz_in(i))
            if given.fixed and self._emitter.form.lanes > 1:
                own = self._array(f"y{k}_{i}", given.size)
                self._lines.append(self._copy(given, own.name))
                given = own
            arguments.append(given.name)
        for i, place in enumerate(function.instruction_output(k)):
            if (k, i) in self._direct:
                arguments.append(f"o{self._direct[k, i]}")
            elif place < 0 and i:
                arguments.append("NULL")
                continue
            else:
                arguments.append(self._array(f"w{k}_{i}", called.nnz_out(i)).name)
            self._held[place] = _Array(arguments[-1], called.nnz_out(i))
        self._lines.append(self._emitter.call(called, arguments))

    def _operation(self, name: str, code: int, value: ca.MX, given: Sequence[_Array]) -> _Array:
        size = value.nnz()
        if code == ca.OP_ASSERTION:
            raise NoCodeError(f"an assertion of {self._function.name()!r}")
        if code == ca.OP_CONST:
            return self._constant(name, value.to_DM().nonzeros())
        if code == ca.OP_RESHAPE or (code == ca.OP_SPARSITY_CAST and given[0].size == size):
            return given[0]
        if code == ca.OP_GETNONZEROS:
            return self._chosen(name, given[0], _whole(value.mapping()))
        if code == ca.OP_TRANSPOSE and value.is_dense():
            order = np.arange(size).reshape(value.shape[0], -1).ravel(order="F")
            return self._chosen(name, given[0], order.tolist())
        if code == ca.OP_PROJECT:
            before, after = value.dep().sparsity(), value.sparsity()
            known = {place: i for i, place in enumerate(zip(*before.get_triplet(), strict=True))}
            order = [known.get(place) for place in zip(*after.get_triplet(), strict=True)]
            return self._chosen(name, given[0], order)
        if code == ca.OP_HORZREPMAT:
            made, source = self._array(name, size), given[0].at(f"k%{given[0].size}")
            self._lines.append(f"for (int k = 0; k < {size}; ++k) {name}[k]={source};")
            return made
        if code == ca.OP_SETNONZEROS:
            made = self._array(name, size)
            self._lines.append(self._copy(given[0], name))
            order = enumerate(_whole(value.mapping()))
            self._lines += [f"{name}[{i}]={given[1].at(k)};" for k, i in order]
            return made
        if code in (ca.OP_VERTCAT, ca.OP_HORZCAT):
            made, at = self._array(name, size), 0
            for each in given:
                self._lines.append(self._copy(each, f"{name}+{at}"))
                at += each.size
            return made
        if code in REAL or code in MASK:
            return self._elementwise(name, code, given, size)
        return self._of_matrices(name, code, value, given)

    def _chosen(self, name: str, source: _Array, order: Sequence[int | None]) -> _Array:
        """Numbers of an array, None for zero; a view of those that follow each other."""
        first = order[0] if order else 0
        if first is not None and list(order) == list(range(first, first + len(order))):
            return _Array(f"({source.name}+{first})", len(order), source.fixed)
        self._lines += [f"real {name}[{max(len(order), 1)}];"] + [
            f"{name}[{k}]={'R(0.0)' if i is None else source.at(i)};" for k, i in enumerate(order)
        ]
        return _Array(name, len(order))

    def _elementwise(self, name: str, code: int, given: Sequence[_Array], size: int) -> _Array:
        if any(each.size not in (1, size) for each in given):
            raise _UnknownError
        texts = (
            as_mask(each.at("k" if each.size > 1 else 0), False)
            if wanted
            else each.at("k" if each.size > 1 else 0)
            for each, wanted in zip(given, takes_masks(code), strict=False)
        )
        value = (MASK[code] if code in MASK else REAL[code]) % tuple(texts)
        made = self._array(name, size)
        value = f"TRUTH({value})" if code in MASK else value
        self._lines.append(f"for (int k = 0; k < {size}; ++k) {name}[k]={value};")
        return made

    def _of_matrices(self, name: str, code: int, value: ca.MX, given: Sequence[_Array]) -> _Array:
        """What is made of whole matrices, in loops."""
        matrices = [value.dep(i) for i in range(value.n_dep())]
        if not all(matrix.is_dense() for matrix in (value, *matrices)):
            raise _UnknownError
        first, x = given[0], given[0].at("k")
        made, sum_ = self._array(name, value.nnz()), f"{name}[0]"
        if code == ca.OP_MTIMES:
            rows, inner, columns = value.size1(), matrices[1].size2(), value.size2()
            left, right = given[1].at(f"i+{rows}*k"), given[2].at(f"k+{inner}*j")
            self._lines += [
                self._copy(first, name),
                f"for (int j = 0; j < {columns}; ++j) for (int k = 0; k < {inner}; ++k) "
                f"for (int i = 0; i < {rows}; ++i) {name}[i+{rows}*j]+={left}*{right};",
            ]
            return made
        if code == ca.OP_FIND and self._emitter.form.lanes == 1:
            zeros = f"while (k < {first.size} && EQUAL({x},R(0.0))) ++k;"
            self._lines.append(f"{{ int k = 0; {zeros} {sum_}=R(k); }}")
            return made
        each = {
            ca.OP_DOT: f"{sum_}+{x}*{given[-1].at('k')}",
            ca.OP_NORM2: f"{sum_}+real_sq({x})",
            ca.OP_NORMF: f"{sum_}+real_sq({x})",
            ca.OP_NORMINF: f"real_fmax({sum_},real_fabs({x}))",
            ca.OP_MMIN: f"real_fmin({sum_},{x})",
            ca.OP_MMAX: f"real_fmax({sum_},{x})",
            # How many zeros there are before the first number that is none.
            ca.OP_FIND: f"{sum_}+IF(EQUAL({sum_},R(k))&EQUAL({x},R(0.0)),R(1.0))",
        }.get(code)
        if each is None:
            raise _UnknownError
        begin = first.at(0) if code in (ca.OP_MMIN, ca.OP_MMAX) else "R(0.0)"
        self._lines.append(f"{sum_}={begin};")
        self._lines.append(f"for (int k = 0; k < {first.size}; ++k) {sum_}={each};")
        if code in (ca.OP_NORM2, ca.OP_NORMF):
            self._lines.append(f"{sum_}=real_sqrt({sum_});")
        return made


def _whole(numbers: Any) -> list[int]:
    return [int(number) for number in ca.DM(numbers).nonzeros()]


# Map: the same for each column; Switch: one of several.


def _map_body(function: ca.Function, emitter: _Emitter) -> str:
    about = function.info()
    one, count = about["f"], about["n"]
    inputs = [f"i{i}+k*{one.nnz_in(i)}" for i in range(one.n_in())]
    outputs = [f"o{i} ? o{i}+k*{one.nnz_out(i)} : NULL" for i in range(one.n_out())]
    call = emitter.call(one, [*inputs, *outputs])
    return f"  for (int k = 0; k < {count}; ++k) {call}\n"


def _switch_body(function: ca.Function, emitter: _Emitter) -> str:
    about = function.info()
    if about["project_in"] or about["project_out"]:
        raise NoCodeError(f"branches of different sparsities: {function.name()!r}")
    branches = [*about["f"], about["f_def"]]
    inputs = [f"i{i}" for i in range(1, function.n_in())]
    outputs = [f"o{i}" for i in range(function.n_out())]
    last = len(branches) - 1

    def cases(places: Sequence[str], wanted: str) -> Iterator[str]:
        for number, branch in enumerate(branches):
            label = f"case {number}" if number < last else "default"
            yield f"    {label}: {emitter.call(branch, [*inputs, *places], wanted)} break;\n"

    if emitter.form.lanes == 1:
        lines = [f"  switch (branch_of(i0[0], {last})) {{\n", *cases(outputs, ""), "  }\n"]
        return "".join(lines)
    sizes = [max(function.nnz_out(i), 1) for i in range(len(outputs))]
    places = [f"p{i}" for i in range(len(outputs))]
    return "".join(
        (
            *(f"  real own{i}[{size}];\n" for i, size in enumerate(sizes)),
            "  int branch[LANES], b;\n",
            f"  lanes_branches(i0[0], {last}, branch);\n",
            f"  for (b = 0; b <= {last}; ++b) {{\n",
            "    const int mine = wanted & lanes_in(branch, b);\n",
            *(
                f"    real *p{i} = mine == wanted || !o{i} ? o{i} : own{i};\n"
                for i in range(len(outputs))
            ),
            "    if (!mine) continue;\n",
            "    switch (b) {\n",
            *cases(places, "mine"),
            "    }\n",
            "    if (mine == wanted) return;\n",
            *(f"    lanes_keep(mine, own{i}, {size}, o{i});\n" for i, size in enumerate(sizes)),
            "  }\n",
        )
    )
