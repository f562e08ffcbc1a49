"""Generated code that looks once whether an argument is there, and not at each of its numbers.

CasADi writes `a1=arg[0]? arg[0][7] : 0;` for a number of an input and `if (res[0]!=0)
res[0][7]=a1;` for one of an output. Each is a branch, and a function of many numbers takes a
compiler long for its branches alone. Here the arguments are looked at where the function begins:
what is not given is taken from zeros, what is not wanted is put aside.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

SIGNATURE = re.compile(r"/\* \w+:\((.*)\)->\((.*)\) \*/")
HEAD = re.compile(r"(?:static|CASADI_SYMBOL_EXPORT) int (\w+)\(const casadi_real\*\* arg, .*\) ?\{")
ARGUMENT = re.compile(r"\w+(\[(?:(\d+)(?:x(\d+))?(?:,(\d+)nz)?)?\])?")
BETWEEN = re.compile(r",(?![^\[]*\])")
GIVEN = re.compile(r"arg\[(\d+)\]\s*\?\s*arg\[\1\]\[(\d+)\]\s*:\s*0;")
WANTED = re.compile(r"if \(res\[(\d+)\]!=0\) res\[\1\]\[(\d+)\]=")


def argument_sizes(arguments: str) -> tuple[int, ...] | None:
    """Numbers of each argument of a signature: `x` has one, `x[3x2]` six, `x[3x2,4nz]` four.

    None if one is of an unknown form.
    """
    sizes: list[int] = []
    for argument in BETWEEN.split(arguments) if arguments else ():
        found = ARGUMENT.fullmatch(argument)
        if found is None:
            return None
        shape, rows, columns, nonzeros = found.groups()
        size = int(nonzeros or int(rows or 0) * int(columns or 1))
        sizes.append(size if shape else 1)
    return tuple(sizes)


def looked_at_once(text: str) -> str:
    """Generated code, its arguments looked at once."""
    lines = text.splitlines()
    functions = list(_functions(lines))
    most = 1
    for place, (sizes_in, sizes_out), end in reversed(functions):
        body = "\n".join(lines[place + 1 : end])
        used_in = sorted({int(found[1]) for found in GIVEN.finditer(body)})
        used_out = sorted({int(found[1]) for found in WANTED.finditer(body)})
        if not used_in and not used_out:
            continue
        most = max(most, *(sizes_in[k] for k in used_in), 1)
        body = WANTED.sub(r"out\1[\2]=", GIVEN.sub(r"in\1[\2];", body))
        first = [f"  casadi_real aside{k}[{max(sizes_out[k], 1)}];" for k in used_out]
        first += [
            f"  const casadi_real *in{k} = arg[{k}] ? arg[{k}] : casadi_nought;" for k in used_in
        ]
        first += [f"  casadi_real *out{k} = res[{k}] ? res[{k}] : aside{k};" for k in used_out]
        lines[place + 1 : end] = [*first, *body.splitlines()]
    if functions:
        lines.insert(
            functions[0][0] - 1, f"static const casadi_real casadi_nought[{most}] = {{0}};"
        )
    return "\n".join(lines) + "\n"


def _functions(
    lines: list[str],
) -> Iterator[tuple[int, tuple[tuple[int, ...], tuple[int, ...]], int]]:
    """Of every function the line of its head, the sizes of its arguments, the line of its end."""
    sizes = None
    for number, line in enumerate(lines):
        if signature := SIGNATURE.fullmatch(line):
            given, wanted = argument_sizes(signature[1]), argument_sizes(signature[2])
            sizes = None if given is None or wanted is None else (given, wanted)
        elif HEAD.fullmatch(line) and sizes is not None:
            yield number, sizes, lines.index("}", number)
            sizes = None
