"""C code from CasADi Functions.

`emit` walks the instructions of a Function and of all it calls and writes one C function for each,
callees first. The text is the same for one number at a time, for vectors and for single precision:
what `real`, `mask` and `real_sin` stand for is said by the C text before it (`drivers/scalar.c`,
`drivers/lanes.c`, `drivers/single.c`). What is written:

- An SX Function is straight-line code on constants of the type `real`; comparisons are of the type
  `mask`. What only outputs behind the first need stands in a block that is left out where the
  caller gives no place for that output. Sines with cosines of the same angle are computed together,
  and up to `Form.width` sines or arcs that do not wait for each other in one call.
- An MX Function is a list of calls, with arrays on the stack between them.
- A Map calls a Function for each of its columns.
- A Switch calls one of several Functions. Of vectors it calls each that any lane takes, and every
  lane keeps the results of its own.

Other Functions are expanded into SX.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from casadi_ik.errors import KernelError

Name = str
Code = tuple[int, ...]

FLOAT = np.finfo(np.float32)

UNARY = (
    "exp log sqrt sin cos tan asin acos atan floor ceil fabs sign "
    "sinh cosh tanh asinh acosh atanh log1p expm1 erf"
)
"""Functions of one number."""

REAL: dict[int, str] = {
    ca.OP_ASSIGN: "%s",
    ca.OP_ADD: "%s+%s",
    ca.OP_SUB: "%s-%s",
    ca.OP_MUL: "%s*%s",
    ca.OP_DIV: "%s/%s",
    ca.OP_NEG: "-%s",
    ca.OP_SQ: "real_sq(%s)",
    ca.OP_TWICE: "R(2.0)*%s",
    ca.OP_INV: "R(1.0)/%s",
    ca.OP_IF_ELSE_ZERO: "IF(%s,%s)",
    ca.OP_POW: "real_pow(%s,%s)",
    ca.OP_CONSTPOW: "real_pow(%s,%s)",
    ca.OP_LIFT: "%s",
    **{
        code: f"real_{name}({arguments})"
        for arguments, names in (
            ("%s", UNARY),
            ("%s,%s", "fmod copysign fmin fmax atan2 hypot"),
        )
        for name in names.split()
        for code in [getattr(ca, f"OP_{name.upper()}")]
    },
}
"""Operations on numbers, as C writes them."""

MASK: dict[int, str] = {
    ca.OP_LT: "LESS(%s,%s)",
    ca.OP_LE: "AT_MOST(%s,%s)",
    ca.OP_EQ: "EQUAL(%s,%s)",
    ca.OP_NE: "UNEQUAL(%s,%s)",
    ca.OP_NOT: "NOT(%s)",
    ca.OP_AND: "%s&%s",
    ca.OP_OR: "%s|%s",
}
"""Operations that tell whether something holds."""

OF_MASKS = (ca.OP_NOT, ca.OP_AND, ca.OP_OR)

TURNS, ARCS = "turns", "arcs"
KINDS = {
    ca.OP_SIN: TURNS,
    ca.OP_COS: TURNS,
    **dict.fromkeys((ca.OP_ASIN, ca.OP_ACOS, ca.OP_ATAN, ca.OP_ATAN2), ARCS),
}
"""Elementary functions that are computed several at a time (drivers/elementary_calls.c)."""

WIDTHS = (1, 2, 4)
"""Of how many numbers there are calls."""


@dataclass(frozen=True)
class Form:
    """What the code is for.

    Attributes:
        lanes: Solves side by side; 1: `real` is a number.
        single: Whether numbers have single precision.
        replaced: Pairs of constants: a value and what stands for it.
    """

    lanes: int = 1
    single: bool = False
    replaced: tuple[tuple[float, float], ...] = ()

    @property
    def width(self) -> int:
        """How many elementary functions one call computes at most."""
        return 1 if self.lanes > 1 or self.single else WIDTHS[-1]

    def digits(self, value: float) -> str:
        """A constant as an element of an array.

        In single precision, numbers too large or too small become the largest and the smallest
        there are, not infinite and zero: such bounds say "any" and "more than nothing".
        """
        if not np.isfinite(value):
            return "NAN" if np.isnan(value) else "INFINITY" if value > 0 else "-INFINITY"
        value = dict(self.replaced).get(value, value)
        if self.single and value:
            size = min(max(abs(value), float(FLOAT.tiny)), float(FLOAT.max))
            return f"{float(np.copysign(size, value))!r}f"
        return repr(float(value))

    def number(self, value: float) -> str:
        """A constant of the type `real`."""
        return f"R({self.digits(value)})"


def emit(functions: Sequence[ca.Function], form: Form) -> tuple[str, list[Name]]:
    """C text of functions and of all they call.

    Args:
        functions: Any; what is called more than once is written once.
        form: What the code is for.

    Returns:
        The text, and the names of the functions in C: `static void name(const real *i0, ...,
        real *o0, ...)`, of lanes with `int wanted` behind, a bit for each lane that counts. The
        nonzeros of an output are written where it is not NULL; the first never is.

    Raises:
        KernelError: One holds what has no C code (a Python callback, an Ipopt call).
    """
    emitter = _Emitter(form)
    names = []
    for function in functions:
        try:
            names.append(emitter.name(function))
        except _NoCodeError as error:
            raise KernelError(f"kernel {function.name()!r}: no C code for {error}") from error
    return "".join(emitter.texts), names


class _NoCodeError(Exception):
    """What there is no C code for."""


class _Emitter:
    """Writes functions, each once."""

    def __init__(self, form: Form) -> None:
        self.form = form
        self.texts: list[str] = []
        self._names: dict[int, tuple[Name, ca.Function]] = {}

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
            self.texts.append(f"CODE void {name}({head}) {{\n  {unused};\n{body}}}\n")
        return self._names[key][0]

    def call(self, function: ca.Function, arguments: Sequence[str], wanted: str = "wanted") -> str:
        """A call of a function."""
        behind = [wanted] if self.form.lanes > 1 else []
        return f"{self.name(function)}({', '.join([*arguments, *behind])});"

    def _body(self, function: ca.Function) -> str:
        kind = function.class_name()
        if kind == "SXFunction":
            return _sx_body(function, self.form)
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
            return _sx_body(function.expand(), self.form)
        except RuntimeError as error:
            raise _NoCodeError(f"{function.name()!r}: {error}") from error


# SX: straight-line code.


@dataclass(slots=True)
class _Node:
    """An operation whose result has a name of its own.

    Attributes:
        name: Of the result.
        value: C text.
        mask: Whether it is of the type `mask`.
        needs: Operations it needs.
        kind: `TURNS` or `ARCS`, "" for anything else.
        given: What an elementary function is of: an angle, or height and width.
        outputs: A bit for each output that needs it.
        after: A bit for each elementary function it waits for, itself included.
        written: Whether it is in the text.
    """

    name: Name
    value: str
    mask: bool
    needs: tuple[int, ...]
    kind: str = ""
    given: tuple[str, ...] = ()
    outputs: int = 0
    after: int = 0
    written: bool = False


def _sx_body(function: ca.Function, form: Form) -> str:
    nodes, stores = _nodes(function, form)
    for node in reversed(nodes):
        for need in node.needs:
            nodes[need].outputs |= node.outputs
    writer = _Writer(nodes, form.width)
    apart = {1 << output for output in range(1, len(stores))}
    shared = [k for k, node in enumerate(nodes) if node.outputs and node.outputs not in apart]
    lines = [*writer.lines(shared), *stores[0]]
    for output in range(1, len(stores)):
        own = [k for k, node in enumerate(nodes) if node.outputs == 1 << output]
        lines += [f"if (o{output}) {{", *writer.lines(own), *stores[output], "}"]
    return "".join([f"  {line}\n" for line in lines])


def _nodes(function: ca.Function, form: Form) -> tuple[list[_Node], list[list[str]]]:
    """The operations of an SX function, and for each output the lines that store its numbers."""
    nodes: list[_Node] = []
    stores: list[list[str]] = [[] for _ in range(function.n_out())]
    # Of every place of the work vector: the text of what it holds, its node or -1, its type.
    held: dict[int, tuple[str, int, bool]] = {}
    identity, sources, targets = (
        function.instruction_id,
        function.instruction_input,
        function.instruction_output,
    )
    calls = 0
    for k in range(function.n_instructions()):
        code, to = identity(k), targets(k)
        if code == ca.OP_CONST:
            held[to[0]] = form.number(function.instruction_constant(k)), -1, False
            continue
        given = sources(k)
        if code == ca.OP_INPUT:
            held[to[0]] = f"i{given[0]}[{given[1]}]", -1, False
            continue
        values = [held[place] for place in given]
        if code == ca.OP_OUTPUT:
            text, node, mask = values[0]
            stores[to[0]].append(f"o{to[0]}[{to[1]}]={f'TRUTH({text})' if mask else text};")
            if node >= 0:
                nodes[node].outputs |= 1 << to[0]
            continue
        if code == ca.OP_ASSIGN:
            held[to[0]] = values[0]
            continue
        texts = tuple(
            _as_mask(text, mask) if wanted else f"TRUTH({text})" if mask else text
            for (text, _, mask), wanted in zip(values, _takes_masks(code), strict=False)
        )
        is_mask = code in MASK
        try:
            value = (MASK if is_mask else REAL)[code] % texts
        except KeyError:
            raise _NoCodeError(f"operation {code} of {function.name()!r}") from None
        needs = tuple(node for _, node, _ in values if node >= 0)
        node = _Node(f"t{len(nodes)}", value, is_mask, needs)
        for need in needs:
            node.after |= nodes[need].after
        if kind := KINDS.get(code):
            node.kind, node.given = kind, _given(code, texts)
            node.after |= 1 << calls
            calls += 1
        held[to[0]] = node.name, len(nodes), is_mask
        nodes.append(node)
    return nodes, stores


def _takes_masks(code: int) -> tuple[bool, bool]:
    return (code in OF_MASKS or code == ca.OP_IF_ELSE_ZERO), code in OF_MASKS


def _as_mask(text: str, mask: bool) -> str:
    return text if mask else f"UNEQUAL({text},R(0.0))"


def _given(code: int, values: tuple[str, ...]) -> tuple[str, ...]:
    """What a call is of; arcs as angles of a point, see `drivers/elementary.c`."""
    x = values[0]
    root = f"real_sqrt((R(1.0)-{x})*(R(1.0)+{x}))"
    arcs = {ca.OP_ASIN: (x, root), ca.OP_ACOS: (root, x), ca.OP_ATAN: (x, "R(1.0)")}
    return arcs.get(code, values)


class _Writer:
    """Writes operations, each when it is its turn or when a call needs it before."""

    def __init__(self, nodes: list[_Node], width: int) -> None:
        self._nodes = nodes
        self._width = width
        self._calls: list[int] = []
        self._done = 0
        self._lines: list[str] = []

    def lines(self, numbers: Sequence[int]) -> list[str]:
        """The lines of these operations, of which those before may be needed."""
        self._lines = []
        self._calls = [number for number in numbers if self._nodes[number].kind]
        for number in numbers:
            self._write(number)
        return self._lines

    def _write(self, number: int) -> None:
        nodes, waiting = self._nodes, [number]
        while waiting:
            node = nodes[waiting[-1]]
            missing = [need for need in node.needs if not nodes[need].written]
            if missing and not node.written:
                waiting += missing
                continue
            at = waiting.pop()
            if node.written:
                continue
            if node.kind:
                self._call(at)
            else:
                self._put(node, node.value)

    def _put(self, node: _Node, value: str) -> None:
        # Not const: clang would look for a constant's value through all that it is made of.
        self._lines.append(f"{'mask' if node.mask else 'real'} {node.name}={value};")
        node.written = True

    def _call(self, number: int) -> None:
        """An elementary function together with the next ones that wait for none."""
        group, places = self._group(number)
        for node in group:
            for need in node.needs:
                self._write(need)
            self._done |= node.after
        if len(group) == 1:
            self._put(group[0], group[0].value)
            return
        kind, width = group[0].kind, next(size for size in WIDTHS if size >= len(places))
        given = [*places, *[next(reversed(places))] * (width - len(places))]
        numbers = ", ".join(value for values in zip(*given, strict=True) for value in values)
        names = [f"s{number}", f"c{number}"] if kind == TURNS else [f"s{number}"]
        self._lines.append(f"real {', '.join(f'{name}[{width}]' for name in names)};")
        self._lines.append(f"own_{kind}_{width}({numbers}, {', '.join(names)});")
        for node in group:
            name = f"c{number}" if node.value.startswith("real_cos") else f"s{number}"
            self._put(node, f"{name}[{places[node.given]}]")

    def _group(self, number: int) -> tuple[list[_Node], dict[tuple[str, ...], int]]:
        """The operations of one call, and the place of what each is of."""
        first = self._nodes[number]
        places, group = {first.given: 0}, [first]
        self._calls.remove(number)
        for other in self._calls[:]:
            node = self._nodes[other]
            own = 1 << node.after.bit_length() - 1
            if node.kind != first.kind or node.after & ~self._done != own:
                continue
            if node.given not in places:
                if len(places) == self._width:
                    continue
                places[node.given] = len(places)
            group.append(node)
            self._calls.remove(other)
        return group, places


# MX: calls, and what hands numbers from one to the other.


class _UnknownError(Exception):
    """An operation that is not written as it is."""


class _Array(NamedTuple):
    """Numbers in C.

    Attributes:
        name: An expression of the first one's place.
        size: How many.
        fixed: Whether they are constants, of the type `number`.
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
            f"static const number {name}[]={{{text}}};" for text, name in self._constants.items()
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
            raise _NoCodeError(f"an assertion of {self._function.name()!r}")
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
            _as_mask(each.at("k" if each.size > 1 else 0), False)
            if wanted
            else each.at("k" if each.size > 1 else 0)
            for each, wanted in zip(given, _takes_masks(code), strict=False)
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
        raise _NoCodeError(f"branches of different sparsities: {function.name()!r}")
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
