"""C code of SX Functions: one statement for each scalar operation.

Numbers have the type `real`, results of comparisons the type `mask`. Operations that only one
output after the first depends on are in a block that is skipped if the caller passes NULL for it.
Common subexpressions are written once. A Function that is never inlined
(`kinematics.smooth.call_function`) is called, on arrays. The sine and the cosine of an angle are
computed together, and one call computes up to `CodeOptions.width` sines or arcs that do not depend
on each other.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import casadi as ca
import numpy as np

CName = str

FLOAT32 = np.finfo(np.float32)

UNARY = (
    "exp log sqrt sin cos tan asin acos atan floor ceil fabs sign "
    "sinh cosh tanh asinh acosh atanh log1p expm1 erf"
)
"""Functions of one argument."""

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
"""C expressions of operations on numbers, by CasADi's operation code."""

MASK: dict[int, str] = {
    ca.OP_LT: "LESS(%s,%s)",
    ca.OP_LE: "AT_MOST(%s,%s)",
    ca.OP_EQ: "EQUAL(%s,%s)",
    ca.OP_NE: "UNEQUAL(%s,%s)",
    ca.OP_NOT: "NOT(%s)",
    ca.OP_AND: "%s&%s",
    ca.OP_OR: "%s|%s",
}
"""C expressions of comparisons and logic, by CasADi's operation code."""

MASK_OPERATIONS = (ca.OP_NOT, ca.OP_AND, ca.OP_OR)

SIN_COS, ARCS, STATEMENT = "turns", "arcs", "statement"
ELEMENTARY_KINDS = {
    ca.OP_SIN: SIN_COS,
    ca.OP_COS: SIN_COS,
    **dict.fromkeys((ca.OP_ASIN, ca.OP_ACOS, ca.OP_ATAN, ca.OP_ATAN2), ARCS),
}
"""Elementary functions that one call computes for several values (elementary_calls.c)."""

VECTOR_SIZES = (1, 2, 4)
"""Numbers of values that one call of an elementary function can compute."""


@dataclass(frozen=True)
class CodeOptions:
    """Options of the generated code.

    Attributes:
        lanes: Number of lanes of `real`; 1: `real` is a scalar.
        single: True for single precision.
        replaced: Pairs of a constant and its replacement.
    """

    lanes: int = 1
    single: bool = False
    replaced: tuple[tuple[float, float], ...] = ()

    @property
    def width(self) -> int:
        """Maximum number of values that one call of an elementary function computes."""
        return 1 if self.lanes > 1 or self.single else VECTOR_SIZES[-1]

    def digits(self, value: float) -> str:
        """Return a constant as the text of an array element.

        In single precision a number that is too large or too small becomes the largest or the
        smallest float instead of infinity or zero, since such bounds mean "any" and "positive".
        """
        if not np.isfinite(value):
            return "NAN" if np.isnan(value) else "INFINITY" if value > 0 else "-INFINITY"
        value = dict(self.replaced).get(value, value)
        if self.single and value:
            size = min(max(abs(value), float(FLOAT32.tiny)), float(FLOAT32.max))
            return f"{float(np.copysign(size, value))!r}f"
        return repr(float(value))

    def number(self, value: float) -> str:
        """Return a constant of the type `real`."""
        return f"R({self.digits(value)})"


class NoCodeError(Exception):
    """The Function contains an operation without C code."""


@dataclass(slots=True)
class _Node:
    """An operation whose result has a name.

    Attributes:
        name: Name of the result.
        value: C expression, or whole statements if the kind is `STATEMENT`.
        mask: True if the result is a `mask`.
        needs: Indices of the operations that it uses.
        kind: `SIN_COS`, `ARCS`, `STATEMENT`, or "" for any other operation.
        arguments: Arguments of an elementary function: an angle, or height and width.
        outputs: Bit set of the outputs that need the operation.
        dependencies: Bit set of the elementary functions that it depends on, itself included.
        is_written: True once the operation is in the text.
    """

    name: CName
    value: str
    mask: bool
    needs: tuple[int, ...]
    kind: str = ""
    arguments: tuple[str, ...] = ()
    outputs: int = 0
    dependencies: int = 0
    is_written: bool = False


Caller = Callable[[ca.Function, Sequence[str]], str]
"""Returns the C statement that calls a Function with arguments."""


ARRAY_ELEMENT = re.compile(r"(\w+)\[(\d+)\]")
"""An array element in C, with the array's name and the index."""


def _store_lines(stores: Sequence[str]) -> list[str]:
    """Return the statements that store outputs; runs of consecutive elements become a memcpy."""
    lines: list[str] = []
    elements = [
        [ARRAY_ELEMENT.fullmatch(side) for side in line[:-1].split("=", 1)] for line in stores
    ]
    first = 0
    for end in range(1, len(stores) + 1):
        if end < len(stores) and all(
            current
            and following
            and current[1] == following[1]
            and int(current[2]) + 1 == int(following[2])
            for current, following in zip(elements[end - 1], elements[end], strict=True)
        ):
            continue
        run = elements[first]
        if end - first > 4:
            to, source = (f"{element[1]}+{element[2]}" for element in run if element)
            lines.append(f"memcpy({to}, {source}, {end - first}*sizeof(real));")
        else:
            lines += stores[first:end]
        first = end
    return lines


def _view(numbers: Sequence[str]) -> str | None:
    """Return a pointer to numbers that are consecutive elements of one array, otherwise None."""
    match = ARRAY_ELEMENT.fullmatch(numbers[0]) if numbers else None
    if match is None:
        return None
    name, first = match[1], int(match[2])
    is_contiguous = all(number == f"{name}[{first + i}]" for i, number in enumerate(numbers))
    return f"{name}+{first}" if is_contiguous else None


def straight_lines(function: ca.Function, options: CodeOptions, caller: Caller) -> str:
    """Return the C body of an SX Function with inputs `i0`, `i1`, ... and outputs `o0`, `o1`, ...

    Raises:
        NoCodeError: An operation has no C code.
    """
    reader = _Reader(function, options, caller)
    nodes = reader.nodes
    for node in reversed(nodes):
        for need in node.needs:
            nodes[need].outputs |= node.outputs
    stores = [_store_lines(lines) for lines in reader.stores]
    writer = _Writer(nodes, options.width)
    single_output_masks = {1 << output for output in range(1, len(stores))}
    common = [
        k
        for k, node in enumerate(nodes)
        if node.outputs and node.outputs not in single_output_masks
    ]
    lines = [*writer.lines(common), *stores[0]]
    for output in range(1, len(stores)):
        private = [k for k, node in enumerate(nodes) if node.outputs == 1 << output]
        lines += [f"if (o{output}) {{", *writer.lines(private), *stores[output], "}"]
    return "".join([f"  {line}\n" for line in lines])


_Value = tuple[str, int, bool]
"""Content of a slot of the work vector: C text, node index or -1, True if it is a `mask`."""


@dataclass(slots=True)
class _Call:
    """A call of a Function: its node, pointers to its arguments, indices of the used outputs."""

    function: ca.Function
    node: _Node
    arguments: list[str]
    used_outputs: set[int]

    def lines(self, caller: Caller) -> str:
        """Return declarations of the used results, and the call; unused results are NULL."""
        function, lines, call_arguments = self.function, [], list(self.arguments)
        for i in range(function.n_out()):
            if i and i not in self.used_outputs:
                call_arguments.append("NULL")
                continue
            call_arguments.append(f"{self.node.name}_{i}")
            lines.append(f"real {call_arguments[-1]}[{max(function.nnz_out(i), 1)}];")
        return "\n  ".join([*lines, caller(function, call_arguments)])


class _Reader:
    """Reader of the operations of an SX function.

    Attributes:
        nodes: Operations whose results have names.
        stores: Statements that store the numbers of each output.
    """

    def __init__(self, function: ca.Function, options: CodeOptions, caller: Caller) -> None:
        """Read all operations."""
        self.nodes: list[_Node] = []
        self.stores: list[list[str]] = [[] for _ in range(function.n_out())]
        self._function = function
        self._known_values: dict[str, _Value] = {}  # results by C expression
        self._calls: dict[str, _Call] = {}
        self._elementary = 0
        work: dict[int, _Value] = {}
        elements: Any = None
        for k in range(function.n_instructions()):
            code, slots = function.instruction_id(k), function.instruction_output(k)
            if code == ca.OP_CONST:
                work[slots[0]] = options.number(function.instruction_constant(k)), -1, False
                continue
            arguments = function.instruction_input(k)
            if code == ca.OP_INPUT:
                work[slots[0]] = f"i{arguments[0]}[{arguments[1]}]", -1, False
                continue
            values = [work[slot] for slot in arguments]
            if code == ca.OP_OUTPUT:
                (text, node, mask), (output, element) = values[0], slots
                value = f"TRUTH({text})" if mask else text
                self.stores[output].append(f"o{output}[{element}]={value};")
                if node >= 0:
                    self.nodes[node].outputs |= 1 << output
            elif code == ca.OP_ASSIGN:
                work[slots[0]] = values[0]
            elif code == ca.OP_CALL:
                elements = elements or function.instructions_sx().nz
                results = self._call_results(elements[k].which_function(), values, slots)
                work |= dict(zip(slots, results, strict=True))
            else:
                work[slots[0]] = self._operation(code, values)
        for call in self._calls.values():
            call.node.value = call.lines(caller)

    def _add(self, value: str, needs: Iterable[int], mask: bool = False, kind: str = "") -> _Node:
        node = _Node(f"t{len(self.nodes)}", value, mask, tuple(needs), kind)
        for need in node.needs:
            node.dependencies |= self.nodes[need].dependencies
        self.nodes.append(node)
        return node

    def _operation(self, code: int, values: list[_Value]) -> _Value:
        texts = tuple(
            as_mask(text, mask) if takes_mask else f"TRUTH({text})" if mask else text
            for (text, _, mask), takes_mask in zip(values, takes_masks(code), strict=False)
        )
        is_mask = code in MASK
        try:
            value = (MASK if is_mask else REAL)[code] % texts
        except KeyError:
            raise NoCodeError(f"operation {code} of {self._function.name()!r}") from None
        if value not in self._known_values:
            kind = ELEMENTARY_KINDS.get(code, "")
            index, needs = len(self.nodes), (node for _, node, _ in values if node >= 0)
            node = self._add(value, needs, is_mask, kind)
            if kind:
                node.arguments = _call_arguments(code, texts)
                node.dependencies |= 1 << self._elementary
                self._elementary += 1
            self._known_values[value] = node.name, index, is_mask
        return self._known_values[value]

    def _call_results(
        self, function: ca.Function, values: list[_Value], slots: Sequence[int]
    ) -> Iterator[_Value]:
        """Yield the results of a call; a result is used if its slot is not negative."""
        arguments: list[str] = []
        needs: set[int] = set()
        remaining = iter(values)
        for i in range(function.n_in()):
            argument, owners = self._argument(list(islice(remaining, function.nnz_in(i))))
            arguments.append(argument)
            needs |= owners
        key = f"{function.__hash__()}({','.join(arguments)})"
        if key not in self._calls:
            self._known_values[key] = key, len(self.nodes), False
            node = self._add("", sorted(needs), kind=STATEMENT)
            self._calls[key] = _Call(function, node, arguments, set())
        call, index = self._calls[key], self._known_values[key][1]
        slot_iterator = iter(slots)
        for i in range(function.n_out()):
            for element in range(function.nnz_out(i)):
                if next(slot_iterator) >= 0:
                    call.used_outputs.add(i)
                yield f"{call.node.name}_{i}[{element}]", index, False

    def _argument(self, values: list[_Value]) -> tuple[str, set[int]]:
        """Return a pointer to numbers, and the nodes it depends on; gathers them if necessary."""
        numbers = [f"TRUTH({text})" if mask else text for text, _, mask in values]
        owners = {node for _, node, _ in values if node >= 0}
        if (pointer := _view(numbers)) is not None:
            return pointer, owners
        array = ",".join(numbers or ["R(0.0)"])
        if array not in self._known_values:
            index = len(self.nodes)
            node = self._add(f"const real t{index}[]={{{array}}};", sorted(owners), kind=STATEMENT)
            self._known_values[array] = node.name, index, False
        name, index, _ = self._known_values[array]
        return name, {index}


def takes_masks(code: int) -> tuple[bool, bool]:
    """Return for both operands of an operation whether they have the type `mask`."""
    return (code in MASK_OPERATIONS or code == ca.OP_IF_ELSE_ZERO), code in MASK_OPERATIONS


def as_mask(text: str, mask: bool) -> str:
    """Convert an operand to a `mask` unless it is one."""
    return text if mask else f"UNEQUAL({text},R(0.0))"


def _call_arguments(code: int, values: tuple[str, ...]) -> tuple[str, ...]:
    """Return the arguments of an elementary function; arcs are angles of a point (height, width).

    See `runtime/elementary.c`.
    """
    x = values[0]
    root = f"real_sqrt((R(1.0)-{x})*(R(1.0)+{x}))"
    arcs = {ca.OP_ASIN: (x, root), ca.OP_ACOS: (root, x), ca.OP_ATAN: (x, "R(1.0)")}
    return arcs.get(code, values)


class _Writer:
    """Writer of operations in their order, or earlier if a grouped call needs them."""

    def __init__(self, nodes: list[_Node], width: int) -> None:
        self._nodes = nodes
        self._width = width
        self._pending_calls: list[int] = []
        self._computed = 0
        self._lines: list[str] = []

    def lines(self, numbers: Sequence[int]) -> list[str]:
        """Return the statements of operations, including operations that these depend on."""
        self._lines = []
        self._pending_calls = [
            number for number in numbers if self._nodes[number].kind in (SIN_COS, ARCS)
        ]
        for number in numbers:
            self._write(number)
        return self._lines

    def _write(self, number: int) -> None:
        nodes, stack = self._nodes, [number]
        while stack:
            node = nodes[stack[-1]]
            missing = [need for need in node.needs if not nodes[need].is_written]
            if missing and not node.is_written:
                stack += missing
                continue
            index = stack.pop()
            if node.is_written:
                continue
            if node.kind in (SIN_COS, ARCS):
                self._append_call(index)
            else:
                self._append(node, node.value)

    def _append(self, node: _Node, value: str) -> None:
        # Not const: clang would try to fold the whole expression of a constant.
        kind = "mask" if node.mask else "real"
        self._lines.append(value if node.kind == STATEMENT else f"{kind} {node.name}={value};")
        node.is_written = True

    def _append_call(self, number: int) -> None:
        """Append a call of an elementary function, with later ones whose inputs are ready."""
        group, lanes = self._group(number)
        for node in group:
            for need in node.needs:
                self._write(need)
            self._computed |= node.dependencies
        if len(group) == 1:
            self._append(group[0], group[0].value)
            return
        kind, width = group[0].kind, next(size for size in VECTOR_SIZES if size >= len(lanes))
        arguments = [*lanes, *[next(reversed(lanes))] * (width - len(lanes))]
        numbers = ", ".join(value for values in zip(*arguments, strict=True) for value in values)
        names = [f"s{number}", f"c{number}"] if kind == SIN_COS else [f"s{number}"]
        self._lines.append(f"real {', '.join(f'{name}[{width}]' for name in names)};")
        self._lines.append(f"own_{kind}_{width}({numbers}, {', '.join(names)});")
        for node in group:
            name = f"c{number}" if node.value.startswith("real_cos") else f"s{number}"
            self._append(node, f"{name}[{lanes[node.arguments]}]")

    def _group(self, number: int) -> tuple[list[_Node], dict[tuple[str, ...], int]]:
        """Return the operations of one call, and the index of each distinct argument."""
        first = self._nodes[number]
        lanes, group = {first.arguments: 0}, [first]
        self._pending_calls.remove(number)
        for candidate in self._pending_calls[:]:
            node = self._nodes[candidate]
            own_bit = 1 << node.dependencies.bit_length() - 1
            if node.kind != first.kind or node.dependencies & ~self._computed != own_bit:
                continue
            if node.arguments not in lanes:
                if len(lanes) == self._width:
                    continue
                lanes[node.arguments] = len(lanes)
            group.append(node)
            self._pending_calls.remove(candidate)
        return group, lanes
