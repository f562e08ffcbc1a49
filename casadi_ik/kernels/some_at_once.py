"""Generated code that calls elementary functions for several numbers at once.

A sine or an arc takes a hundred operations one after the other, and a solve alone needs dozens that
do not wait for each other: those go through vectors (`drivers/elementary_few.c`), two or four at a
time, and a sine and a cosine of the same angle together. The values are the same bit for bit, only
the order of the code is another: what a call needs is moved before the first of its group.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from casadi_ik.kernels.arguments import HEAD

WIDTHS = (1, 2, 4)
"""Of how many numbers there are calls."""

LINE = re.compile(r"  (a\d+|out\d+\[\d+\])=(.*);")
BLOCK, END = re.compile(r"  if \(res\[\d+\]\) \{"), "  }"
DECLARED = re.compile(r"  casadi_real a\d+(?:, a\d+)*;")
LOCAL = re.compile(r"\ba\d+\b")
CALL = re.compile(r"(sin|cos|asin|acos|atan|atan2)\( ?(-?\w+) ?(?:, ?(-?\w+) ?)?\)")
TURNS, ARCS = "turns", "arcs"
KINDS = {"sin": TURNS, "cos": TURNS, **dict.fromkeys(("asin", "acos", "atan", "atan2"), ARCS)}


@dataclass
class _Line:
    """An assignment.

    Attributes:
        target: What is assigned to: a number of the outputs, or the line's own name.
        value: Text, with the names of the lines it needs.
        needs: Those lines.
        after: A bit for each call of an elementary function that it needs, by whatever way.
        kind: TURNS or ARCS for such a call, "" for anything else.
        given: What the call is of: an angle, or height and width.
        block: The line that begins the block it stands in, "" for none.
        written: Whether it is among what is returned already.
    """

    target: str
    value: str
    needs: list[int]
    after: int = 0
    kind: str = ""
    given: tuple[str, ...] = ()
    block: str = ""
    written: bool = False


def some_at_once(text: str) -> str:
    """Generated code with the calls of its functions put together."""
    lines, made = iter(text.splitlines()), []
    for line in lines:
        made.append(line)
        if HEAD.fullmatch(line):
            body = list(iter(lines.__next__, "}"))
            made += [*_together(body), "}"]
    return "\n".join(made) + "\n"


def _together(body: list[str]) -> list[str]:
    """The body of a function; as it is if it has no two calls, or lines that are no assignments."""
    first = next((i for i, line in enumerate(body) if LINE.fullmatch(line)), len(body))
    last = max((i + 1 for i, line in enumerate(body) if LINE.fullmatch(line)), default=first)
    last += body[last : last + 1] == [END]
    lines = _parsed(body[first:last])
    if lines is None or sum(bool(line.kind) for line in lines) < 2:
        return body
    head = [line for line in body[:first] if not DECLARED.fullmatch(line)]
    if len(head) == first:  # its variables are declared in a way not known here
        return body
    return [*head, *_Writer(lines).text(), *body[last:]]


def _parsed(texts: list[str]) -> list[_Line] | None:
    """The assignments, every one to a variable of its own; None if there is something else."""
    now: dict[str, int] = {}
    lines: list[_Line] = []
    calls, block = 0, ""
    for text in texts:
        if BLOCK.fullmatch(text) or text == END:
            block = "" if text == END else text
            continue
        match, number = LINE.fullmatch(text), len(lines)
        if match is None:
            return None
        target, value = match.groups()
        names = LOCAL.findall(value)
        if not now.keys() >= set(names):
            return None
        needs = [now[name] for name in names]
        after = 0
        for need in needs:
            after |= lines[need].after
        value = LOCAL.sub(lambda name: f"t{now[name[0]]}", value)
        line = _Line(target, value, needs, after, block=block)
        lines.append(line)
        if target.startswith("a"):
            line.target, now[target] = f"t{number}", number
            if call := CALL.fullmatch(line.value):
                line.kind, line.given = KINDS[call[1]], _given(*call.groups())
                line.after |= 1 << calls
                calls += 1
    return lines


def _given(name: str, x: str, y: str) -> tuple[str, ...]:
    """What a call is of; arcs as angles of a point, see `drivers/elementary.c`."""
    root = f"sqrt((1.-{x})*(1.+{x}))"
    arcs = {"asin": (x, root), "acos": (root, x), "atan": (x, "1."), "atan2": (x, y)}
    return arcs.get(name, (x,))


class _Writer:
    """Writes the lines, each when it is its turn or when a call needs it before."""

    def __init__(self, lines: list[_Line]) -> None:
        """Nothing is written yet."""
        self._lines = lines
        self._calls = [number for number, line in enumerate(lines) if line.kind]
        self._done = 0
        self._made: list[str] = []

    def text(self) -> list[str]:
        """All of them."""
        block = ""
        for number, line in enumerate(self._lines):
            if line.block != block:
                self._made += [*([END] if block else []), *([line.block] if line.block else [])]
                block = line.block
            self._write(number)
        return [*self._made, *([END] if block else [])]

    def _write(self, number: int) -> None:
        """A line, after those it needs."""
        waiting = [number]
        while waiting:
            line = self._lines[waiting[-1]]
            missing = [need for need in line.needs if not self._lines[need].written]
            if missing and not line.written:
                waiting += missing
                continue
            at = waiting.pop()
            if line.written:
                continue
            if line.kind:
                self._call(at)
            else:
                self._put(line, line.value)

    def _put(self, line: _Line, value: str) -> None:
        declared = "const casadi_real " if line.target.startswith("t") else ""
        self._made.append(f"  {declared}{line.target}={value};")
        line.written = True

    def _call(self, number: int) -> None:
        """A call together with the next ones that wait for no call."""
        group, places = self._group(number)
        for line in group:
            for need in line.needs:
                self._write(need)
            self._done |= line.after
        if len(group) == 1:
            self._put(group[0], group[0].value)
            return
        kind, width = group[0].kind, next(size for size in WIDTHS if size >= len(places))
        given = [*places, *[next(reversed(places))] * (width - len(places))]
        numbers = ", ".join(value for values in zip(*given, strict=True) for value in values)
        names = [f"s{number}", f"c{number}"] if kind == TURNS else [f"s{number}"]
        self._made.append(f"  casadi_real {', '.join(f'{name}[{width}]' for name in names)};")
        self._made.append(f"  own_{kind}_{width}({numbers}, {', '.join(names)});")
        for line in group:
            name = f"c{number}" if line.value.startswith("cos") else f"s{number}"
            self._put(line, f"{name}[{places[line.given]}]")

    def _group(self, number: int) -> tuple[list[_Line], dict[tuple[str, ...], int]]:
        """The lines of calls made together, and the place of what each is of."""
        kind, places = self._lines[number].kind, {self._lines[number].given: 0}
        group = [self._lines[number]]
        self._calls.remove(number)
        for other in self._calls[:]:
            line = self._lines[other]
            own = 1 << line.after.bit_length() - 1
            alike = line.kind == kind and line.block == group[0].block
            if not alike or line.after & ~self._done != own:
                continue
            if line.given not in places:
                if len(places) == WIDTHS[-1]:
                    continue
                places[line.given] = len(places)
            group.append(line)
            self._calls.remove(other)
        return group, places
