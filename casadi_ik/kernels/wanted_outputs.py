"""Generated code that computes what only one output needs when that output is wanted.

A step gives the next state and a record of the iteration, and a solve without a log has no use for
the record: a quarter of the operations of a hand's fit. CasADi writes them among the others; here
they are moved behind them, into a block of their own, and a function that only hands an output on
asks for it if it is asked itself. The values are the same bit for bit.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass

from casadi_ik.kernels.arguments import HEAD

LINE = re.compile(r"  (a\d+|out(\d+)\[\d+\])=(.*);")
DECLARED = re.compile(r"  casadi_real a\d+(?:, a\d+)*;")
COPIED = re.compile(r"  casadi_copy\((w\d+), \d+, res\[(\d+)\]\);")
FILLED = re.compile(r"  (res1\[\d+\])=(w\d+);")
WORK = re.compile(r"\bw\d+\b")
LOCAL = re.compile(r"\ba\d+\b")

WORTH = 16
"""Operations of an output alone from which it has a block."""

NAMES = 12
"""Variables that are declared on a line."""


@dataclass
class _Line:
    """An assignment: its target, its text, the lines it needs, a bit for each output it is for."""

    target: str
    text: str
    needs: list[int]
    wanted: int


def wanted_outputs(text: str) -> str:
    """Generated code with blocks for outputs that need not be wanted; the first always is."""
    lines, made = iter(text.splitlines()), []
    for line in lines:
        made.append(line)
        if HEAD.fullmatch(line):
            made += [*_in_blocks(_handed_on(list(iter(lines.__next__, "}")))), "}"]
    return "\n".join(made) + "\n"


def _handed_on(body: list[str]) -> list[str]:
    """The body of a function whose calls fill only what is wanted of what is copied to outputs."""
    copied = {match[1]: match[2] for line in body if (match := COPIED.fullmatch(line))}
    if not copied:
        return body
    # Its declaration, the call, the copy: nothing else may look at it.
    counts = Counter(word for line in body for word in WORK.findall(line))
    made: list[str] = []
    for line in body:
        match = FILLED.fullmatch(line)
        if match and match[2] in copied and counts[match[2]] == 3:
            made.append(f"  {match[1]}=res[{copied[match[2]]}] ? {match[2]} : 0;")
        else:
            made.append(line)
    return made


def _in_blocks(body: list[str]) -> list[str]:
    places = [i for i, line in enumerate(body) if LINE.fullmatch(line)]
    if not places:
        return body
    first, last = places[0], places[-1] + 1
    head = [line for line in body[:first] if not DECLARED.fullmatch(line)]
    lines = _parsed(body[first:last])
    if lines is None or len(head) == first:
        return body
    counts = [0] * max(line.wanted.bit_length() for line in lines)
    for line in lines:
        if line.wanted and not line.wanted & (line.wanted - 1):
            counts[line.wanted.bit_length() - 1] += 1
    blocks = [k for k, count in enumerate(counts) if k and count >= WORTH]
    if not blocks:
        return body
    apart = {1 << k for k in blocks}
    names = [line.target for line in lines if not line.target.startswith("out")]
    made = [
        f"  casadi_real {', '.join(names[i : i + NAMES])};" for i in range(0, len(names), NAMES)
    ]
    made += [line.text for line in lines if line.wanted not in apart]
    for k in blocks:
        own = [line.text for line in lines if line.wanted == 1 << k]
        made += [f"  if (res[{k}]) {{", *own, "  }"]
    return [*head, *made, *body[last:]]


def _parsed(texts: list[str]) -> list[_Line] | None:
    """The assignments; None if there is something else."""
    now: dict[str, int] = {}
    lines: list[_Line] = []
    for number, text in enumerate(texts):
        match = LINE.fullmatch(text)
        if match is None:
            return None
        target, output, value = match.groups()
        names = LOCAL.findall(value)
        if not now.keys() >= set(names):
            return None
        needs = [now[name] for name in names]
        value = LOCAL.sub(lambda name: f"a{now[name[0]]}", value)
        if output is None:
            now[target] = number
            target = f"a{number}"
        wanted = 0 if output is None else 1 << int(output)
        lines.append(_Line(target, f"  {target}={value};", needs, wanted))
    for line in reversed(lines):
        for need in line.needs:
            lines[need].wanted |= line.wanted
    return lines
