"""C code of SX Functions: straight lines of operations on numbers.

Every operation is a line, on variables of the type `real`; comparisons are of the type `mask`. What
only outputs behind the first need stands in a block that is left out where the caller gives no
place for that output. An operation on the same operands as an earlier one is not written again.
A Function that is never inlined (`kinematics.smooth.part`) is called, on arrays.
Sines with cosines of the same angle are computed together, and up to `Form.width` sines or arcs
that do not wait for each other in one call.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import casadi as ca
import numpy as np

Name = str

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

TURNS, ARCS, LINES = "turns", "arcs", "lines"
KINDS = {
    ca.OP_SIN: TURNS,
    ca.OP_COS: TURNS,
    **dict.fromkeys((ca.OP_ASIN, ca.OP_ACOS, ca.OP_ATAN, ca.OP_ATAN2), ARCS),
}
"""Elementary functions that are computed several at a time (runtime/elementary_calls.c)."""

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


class NoCodeError(Exception):
    """What there is no C code for."""


@dataclass(slots=True)
class _Node:
    """An operation whose result has a name of its own.

    Attributes:
        name: Of the result.
        value: C text.
        mask: Whether it is of the type `mask`.
        needs: Operations it needs.
        kind: `TURNS` or `ARCS`, `LINES`: the value is whole lines, "" for anything else.
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


Caller = Callable[[ca.Function, Sequence[str]], str]
"""The line that calls a Function with arguments."""


PLACE = re.compile(r"(\w+)\[(\d+)\]")
"""A number of an array."""


def _copied(stores: Sequence[str]) -> list[str]:
    """Lines that store numbers; those that follow each other here and there are copied at once."""
    lines: list[str] = []
    places = [[PLACE.fullmatch(side) for side in line[:-1].split("=", 1)] for line in stores]
    first = 0
    for end in range(1, len(stores) + 1):
        if end < len(stores) and all(
            one and other and one[1] == other[1] and int(one[2]) + 1 == int(other[2])
            for one, other in zip(places[end - 1], places[end], strict=True)
        ):
            continue
        run = places[first]
        if end - first > 4:
            to, source = (f"{place[1]}+{place[2]}" for place in run if place)
            lines.append(f"memcpy({to}, {source}, {end - first}*sizeof(real));")
        else:
            lines += stores[first:end]
        first = end
    return lines


def _view(numbers: Sequence[str]) -> str | None:
    """The place of numbers that follow each other in an array, None if they do not."""
    found = PLACE.fullmatch(numbers[0]) if numbers else None
    if found is None:
        return None
    name, first = found[1], int(found[2])
    together = all(each == f"{name}[{first + i}]" for i, each in enumerate(numbers))
    return f"{name}+{first}" if together else None


def straight_lines(function: ca.Function, form: Form, caller: Caller) -> str:
    """The body of an SX Function: inputs are `i0`, `i1`, ..., outputs `o0`, `o1`, ...

    Raises:
        NoCodeError: An operation has no C code.
    """
    reader = _Reader(function, form, caller)
    nodes = reader.nodes
    for node in reversed(nodes):
        for need in node.needs:
            nodes[need].outputs |= node.outputs
    stores = [_copied(lines) for lines in reader.stores]
    writer = _Writer(nodes, form.width)
    apart = {1 << output for output in range(1, len(stores))}
    shared = [k for k, node in enumerate(nodes) if node.outputs and node.outputs not in apart]
    lines = [*writer.lines(shared), *stores[0]]
    for output in range(1, len(stores)):
        own = [k for k, node in enumerate(nodes) if node.outputs == 1 << output]
        lines += [f"if (o{output}) {{", *writer.lines(own), *stores[output], "}"]
    return "".join([f"  {line}\n" for line in lines])


_Held = tuple[str, int, bool]
"""What a place of the work vector holds: its text, its node or -1, whether it is a `mask`."""


@dataclass(slots=True)
class _Call:
    """A call of a Function: its node, the places of its arguments, the outputs that are used."""

    function: ca.Function
    node: _Node
    arguments: list[str]
    used: set[int]

    def lines(self, caller: Caller) -> str:
        """Room for the results, and the call; what is not used is not asked for."""
        function, lines, arguments = self.function, [], list(self.arguments)
        for i in range(function.n_out()):
            if i and i not in self.used:
                arguments.append("NULL")
                continue
            arguments.append(f"{self.node.name}_{i}")
            lines.append(f"real {arguments[-1]}[{max(function.nnz_out(i), 1)}];")
        return "\n  ".join([*lines, caller(function, arguments)])


class _Reader:
    """Reads the operations of an SX function.

    Attributes:
        nodes: Operations whose results have names.
        stores: For each output the lines that store its numbers.
    """

    def __init__(self, function: ca.Function, form: Form, caller: Caller) -> None:
        """Read all."""
        self.nodes: list[_Node] = []
        self.stores: list[list[str]] = [[] for _ in range(function.n_out())]
        self._function = function
        self._known: dict[str, _Held] = {}  # what operations gave, by their text
        self._calls: dict[str, _Call] = {}
        self._elementary = 0
        held: dict[int, _Held] = {}
        elements: Any = None
        for k in range(function.n_instructions()):
            code, to = function.instruction_id(k), function.instruction_output(k)
            if code == ca.OP_CONST:
                held[to[0]] = form.number(function.instruction_constant(k)), -1, False
                continue
            given = function.instruction_input(k)
            if code == ca.OP_INPUT:
                held[to[0]] = f"i{given[0]}[{given[1]}]", -1, False
                continue
            values = [held[place] for place in given]
            if code == ca.OP_OUTPUT:
                (text, node, mask), (output, element) = values[0], to
                value = f"TRUTH({text})" if mask else text
                self.stores[output].append(f"o{output}[{element}]={value};")
                if node >= 0:
                    self.nodes[node].outputs |= 1 << output
            elif code == ca.OP_ASSIGN:
                held[to[0]] = values[0]
            elif code == ca.OP_CALL:
                elements = elements or function.instructions_sx().nz
                results = self._called(elements[k].which_function(), values, to)
                held |= dict(zip(to, results, strict=True))
            else:
                held[to[0]] = self._operation(code, values)
        for call in self._calls.values():
            call.node.value = call.lines(caller)

    def _add(self, value: str, needs: Iterable[int], mask: bool = False, kind: str = "") -> _Node:
        node = _Node(f"t{len(self.nodes)}", value, mask, tuple(needs), kind)
        for need in node.needs:
            node.after |= self.nodes[need].after
        self.nodes.append(node)
        return node

    def _operation(self, code: int, values: list[_Held]) -> _Held:
        texts = tuple(
            as_mask(text, mask) if wanted else f"TRUTH({text})" if mask else text
            for (text, _, mask), wanted in zip(values, takes_masks(code), strict=False)
        )
        is_mask = code in MASK
        try:
            value = (MASK if is_mask else REAL)[code] % texts
        except KeyError:
            raise NoCodeError(f"operation {code} of {self._function.name()!r}") from None
        if value not in self._known:
            kind = KINDS.get(code, "")
            at, needs = len(self.nodes), (node for _, node, _ in values if node >= 0)
            node = self._add(value, needs, is_mask, kind)
            if kind:
                node.given = _given(code, texts)
                node.after |= 1 << self._elementary
                self._elementary += 1
            self._known[value] = node.name, at, is_mask
        return self._known[value]

    def _called(
        self, function: ca.Function, values: list[_Held], to: Sequence[int]
    ) -> Iterator[_Held]:
        """The results of a call, of which those with a place in `to` are used."""
        arguments: list[str] = []
        needs: set[int] = set()
        rest = iter(values)
        for i in range(function.n_in()):
            argument, owners = self._argument(list(islice(rest, function.nnz_in(i))))
            arguments.append(argument)
            needs |= owners
        known = f"{function.__hash__()}({','.join(arguments)})"
        if known not in self._calls:
            self._known[known] = known, len(self.nodes), False
            node = self._add("", sorted(needs), kind=LINES)
            self._calls[known] = _Call(function, node, arguments, set())
        call, at = self._calls[known], self._known[known][1]
        places = iter(to)
        for i in range(function.n_out()):
            for element in range(function.nnz_out(i)):
                if next(places) >= 0:
                    call.used.add(i)
                yield f"{call.node.name}_{i}[{element}]", at, False

    def _argument(self, values: list[_Held]) -> tuple[str, set[int]]:
        """The place of numbers, an array of their own where they do not stand in one."""
        numbers = [f"TRUTH({text})" if mask else text for text, _, mask in values]
        owners = {node for _, node, _ in values if node >= 0}
        if (place := _view(numbers)) is not None:
            return place, owners
        array = ",".join(numbers or ["R(0.0)"])
        if array not in self._known:
            at = len(self.nodes)
            node = self._add(f"const real t{at}[]={{{array}}};", sorted(owners), kind=LINES)
            self._known[array] = node.name, at, False
        name, at, _ = self._known[array]
        return name, {at}


def takes_masks(code: int) -> tuple[bool, bool]:
    """Whether the two operands of an operation are of the type `mask`."""
    return (code in OF_MASKS or code == ca.OP_IF_ELSE_ZERO), code in OF_MASKS


def as_mask(text: str, mask: bool) -> str:
    """An operand, which may be one already, as a `mask`."""
    return text if mask else f"UNEQUAL({text},R(0.0))"


def _given(code: int, values: tuple[str, ...]) -> tuple[str, ...]:
    """What a call is of; arcs as angles of a point, see `runtime/elementary.c`."""
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
        self._calls = [number for number in numbers if self._nodes[number].kind in (TURNS, ARCS)]
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
            if node.kind in (TURNS, ARCS):
                self._call(at)
            else:
                self._put(node, node.value)

    def _put(self, node: _Node, value: str) -> None:
        # Not const: clang would look for a constant's value through all that it is made of.
        kind = "mask" if node.mask else "real"
        self._lines.append(value if node.kind == LINES else f"{kind} {node.name}={value};")
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
