"""C code of one solve rewritten for four side by side.

CasADi writes one operation a line: `a3=(a1*a2);`. Where `casadi_real` is a vector of four doubles,
arithmetic means the same four times over; what does not (comparisons, choices, calls of the C
library, plain numbers) is given the names of `drivers/lanes.c`. Only lines known to mean the same
are let through, so code of a kind not foreseen is refused rather than run wrong.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import casadi as ca

from casadi_ik.errors import KernelError
from casadi_ik.kernels.codegen import driver_text, function_source, step_names

LANES = 4
"""Solves side by side; as in drivers/lanes.c."""


class UnsuitedError(KernelError):
    """The code has a line that cannot be rewritten."""


SPACE = r"[ \t]*"
NUMBER = r"-?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
CONSTANT = rf"{NUMBER}|-?casadi_(?:inf|nan)"
VARIABLE = r"[A-Za-z_]\w*(?:\[\d+\])?|\(\*\w+\+\+\)"
OPERAND = rf"{SPACE}(?:{CONSTANT}|{VARIABLE}){SPACE}"

FUNCTIONS = (
    r"sqrt|floor|ceil|sin|cos|tan|asin|acos|atan|exp|log|tanh|atan2|fmod|pow"
    r"|casadi_sq|casadi_hypot|casadi_fabs|casadi_fmin|casadi_fmax"
)

OPERATION = re.compile(rf"\(({OPERAND})(<=|>=|==|!=|&&|\|\||[-+*/<>])({OPERAND})\)")
SIGN = re.compile(rf"\({SPACE}([-!])({OPERAND})\)")
CHOICE = re.compile(rf"\(({OPERAND})\?({OPERAND}):{SPACE}0{SPACE}\)")
CALL = re.compile(rf"({FUNCTIONS})\(({OPERAND})(?:,({OPERAND}))?\)")
GIVEN = re.compile(r"arg\[(\d+)\]\s*\?\s*(arg\[\1\]\[\d+\])\s*:\s*0")

ASSIGNMENT = re.compile(r"(\s*)([aw]\d+(?:\[\d+\])?)\s*([-+*/]?=)(.*);")
ELEMENTWISE = re.compile(r"(\s*for \(i=0, [^;()]*; i<\d+; \+\+i\) )\(\*rr\+\+\)\s*([-+*/]?=)(.*);")
POINTER = r"(?:arg\[\d+\] \? arg\[\d+\] : casadi_zeros|\(?&?w\w*(?:[-+]\d+)?\)?|0)"
AS_THEY_ARE = tuple(
    re.compile(rf"\s*{pattern}")
    for pattern in (
        r"(?:/\*.*\*/)?",
        r"(?:const )?casadi_(?:real|int)\b[\w\s,*=+]*;",
        rf"(?:arg1|res1)\[\d+\]={POINTER};",
        rf"wr?\d+ = {POINTER};",
        r"if \(res\[(\d+)\](?:!=0)?\) res\[\1\]\[\d+\]\s*=\s*[aw]\d+;",
        r"if \(casadi_f\d+\(arg1, res1, iw, w, 0\)\) return 1;",
        rf"casadi_copy\((?:{POINTER}|arg\[\d+\]), \d+, (?:res\[\d+\]|w\d+)\);",
        rf"casadi_clear\({POINTER}, \d+\);",
        r"for \(i=0, rr=w\d+, cs=wr?\d+; i<\d+; \+\+i\) "
        r"for \(j=0; j<\d+; \+\+j\) rr\[i\+j\*\d+\] = \*cs\+\+;",
        r"for \(rr=[^;]*, cs=[^;]*; cs!=[^;]*; cs\+=\d+\) \*rr\+\+ = \*cs;",
        r"return (?:0|casadi_f\d+\(arg, res, iw, w, mem\));",
    )
)

HEAD = re.compile(r"(?:static|CASADI_SYMBOL_EXPORT) (int \w+\(const casadi_real\*\* arg, .*\) ?\{)")
ZEROS = re.compile(r"static const casadi_real casadi_zeros\[(\d+)\]")
OUTPUTS = re.compile(r"/\* .*->\((.*)\) \*/")
SIZE = re.compile(r"\[(\d+)(?:x(\d+))?\]")
BRANCH = re.compile(r"\s*if \(casadi_f(\d+)\(arg\+1, res, iw, w, 0\)\) return 1;")
RENAMED = {"nan": "NAN", "inf": "INFINITY"} | {
    name: f"lanes_{name}" for name in ("sq", "fabs", "fmin", "fmax", "hypot", "copy", "clear")
}
KEPT = ("_work", "_checkout", "_release", "_incref")


def lanes_source(function: ca.Function, driver: str) -> str:
    """The text of a library of the function for four solves side by side.

    Args:
        function: Dense and row-major.
        driver: C text of the driver, with its constants.

    Raises:
        UnsuitedError: The code has a line of a kind not foreseen.
        KernelError: The graph has no C code.
    """
    text = function_source(function)
    zeros = ZEROS.search(text)
    return "\n".join(
        (
            driver_text("lanes"),
            *(f"#define casadi_{name} {own}" for name, own in RENAMED.items()),
            f"static const lanes casadi_zeros[{zeros[1] if zeros else 1}];",
            *_functions(text, function.name()),
            step_names(function.name()),
            driver_text("common"),
            driver,
        )
    )


def _functions(text: str, name: str) -> list[str]:
    """The functions of the generated code that a driver needs, rewritten."""
    found: list[str] = []
    lines = iter(text.splitlines())
    signature = ""
    kept = re.compile(rf"CASADI_SYMBOL_EXPORT ((?:int|void) {name}(?:{'|'.join(KEPT)})\(.*)")
    for line in lines:
        if head := HEAD.fullmatch(line):
            body = list(_until_end(lines))
            found.append(f"LANES_TARGET static {head[1]}")
            found.extend(_branches(body, signature) or map(_rewritten, body))
            found.append("}")
        elif head := kept.fullmatch(line):
            found.extend((f"static {head[1]}", *_until_end(lines), "}"))
        signature = line
    return found


def _until_end(lines: Iterator[str]) -> Iterator[str]:
    """The lines of a function's body."""
    for line in lines:
        if line == "}":
            return
        yield line


def _branches(body: list[str], signature: str) -> list[str] | None:
    """The body of a function that calls one of others by its first argument; None for the rest.

    Where the four agree, the branch they take is called; otherwise each branch that any of them
    takes, and everyone keeps the results of its own.
    """
    switch = body[0].strip() == "switch (arg[0] ? casadi_to_int(*arg[0]) : 0) {"
    choice = body[0].strip() == "if (arg[0] ? casadi_to_int(*arg[0]) : 0) {"
    if not (switch or choice):
        return None
    called = [match[1] for line in body if (match := BRANCH.fullmatch(line))]
    outputs = OUTPUTS.fullmatch(signature)
    if outputs is None or not called:
        raise UnsuitedError(f"branches of an unknown kind: {signature!r}")
    sizes = [_size(output) for output in outputs[1].split(",")]
    # Of `if`, the first branch is that of everything but 0.
    order = called if switch else called[::-1]
    last = len(order) - 1
    results = range(len(sizes))
    return [
        *(f"  lanes own{k}[{size}];" for k, size in enumerate(sizes)),
        f"  casadi_real *given[{len(sizes)}];",
        f"  lane_mask branch = lanes_branch(arg[0], {last}), mine;",
        "  int b;",
        f"  for (b = 0; b <= {last}; ++b) {{",
        "    mine = (lane_mask) (branch == (lane_mask) {b, b, b, b});",
        "    if (!lanes_any(mine)) continue;",
        "    if (lanes_all(mine)) {",
        *_calls(order, "return", "      "),
        "    }",
        *(f"    given[{k}] = res[{k}];" for k in results),
        *(f"    if (res[{k}]) res[{k}] = own{k};" for k in results),
        *_calls(order, "", "    "),
        *(f"    res[{k}] = given[{k}];" for k in results),
        *(f"    lanes_keep(mine, own{k}, {size}, res[{k}]);" for k, size in enumerate(sizes)),
        "  }",
        "  return 0;",
    ]


def _calls(order: list[str], word: str, indent: str) -> Iterator[str]:
    """A switch over b that calls the functions."""
    yield f"{indent}switch (b) {{"
    for case, number in enumerate(order):
        call = f"casadi_f{number}(arg + 1, res, iw, w, 0)"
        done = f"return {call};" if word else f"if ({call}) return 1; break;"
        yield f"{indent}  case {case}: {done}"
    yield f"{indent}}}"


def _size(output: str) -> int:
    """Numbers of an output in a signature: `o0` has one, `o0[3]` three, `o0[3x2]` six."""
    found = SIZE.search(output)
    return 1 if found is None else int(found[1]) * int(found[2] or 1)


def _rewritten(line: str) -> str:
    """One line of a function's body.

    Raises:
        UnsuitedError: A line of a kind not foreseen.
    """
    if any(pattern.fullmatch(line) for pattern in AS_THEY_ARE):
        return line
    if match := ASSIGNMENT.fullmatch(line):
        return f"{match[1]}{match[2]} {match[3]} {_value(match[4].strip())};"
    if match := ELEMENTWISE.fullmatch(line):
        return f"{match[1]}(*rr++) {match[2]} {_value(match[3].strip())};"
    raise UnsuitedError(f"no side-by-side form of {line.strip()!r}")


def _value(text: str) -> str:
    """The right-hand side of an assignment: one operation."""
    if match := GIVEN.fullmatch(text):
        return f"arg[{match[1]}] ? {match[2]} : SPREAD(0.0)"
    if match := OPERATION.fullmatch(text):
        left, operator, right = _operand(match[1]), match[2], _operand(match[3])
        if operator in ("&&", "||"):
            return f"TRUTH(IS({left}) {operator[0]} IS({right}))"
        both = f"({left} {operator} {right})"
        return both if operator in "+-*/" else f"TRUTH{both}"
    if match := SIGN.fullmatch(text):
        value = _operand(match[2])
        return f"(-{value})" if match[1] == "-" else f"TRUTH({value} == SPREAD(0.0))"
    if match := CHOICE.fullmatch(text):
        return f"lanes_if_else_zero({_operand(match[1])}, {_operand(match[2])})"
    if match := CALL.fullmatch(text):
        values = ", ".join(_operand(value) for value in match.groups()[1:] if value)
        return f"lanes_{match[1].removeprefix('casadi_')}({values})"
    if re.fullmatch(OPERAND, text):
        return _operand(text)
    raise UnsuitedError(f"no side-by-side form of the value {text!r}")


def _operand(text: str) -> str:
    text = text.strip()
    return f"SPREAD({text})" if re.fullmatch(CONSTANT, text) else text
