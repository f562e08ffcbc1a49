"""One line of generated C code, rewritten for vectors of doubles.

CasADi writes one operation a line: `a3=(a1*a2);`. Where `casadi_real` is a vector, arithmetic means
the same four times over; what does not (comparisons, choices, calls of the C library, plain
numbers) is given the names of `drivers/lanes.c`. Only lines of the forms CasADi is known to write
are let through.
"""

from __future__ import annotations

import re

from casadi_ik.errors import KernelError


class UnsuitedError(KernelError):
    """Code that has no form for vectors."""


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

INNER = re.compile(r"(\s*if \()casadi_f(\d+)\(arg1, res1, iw, w, 0\)\) return 1;")
OUTER = re.compile(r"\s*return casadi_f(\d+)\(arg, res, iw, w, mem\);")
ASSIGNMENT = re.compile(r"(\s*)((?:[aw]|out)\d+(?:\[\d+\])?)\s*([-+*/]?=)(.*);")
ELEMENTWISE = re.compile(r"(\s*for \(i=0, [^;()]*; i<\d+; \+\+i\) )\(\*rr\+\+\)\s*([-+*/]?=)(.*);")
POINTER = r"(?:arg\[\d+\] \? arg\[\d+\] : casadi_zeros|\(?&?w\w*(?:[-+]\d+)?\)?|0)"
AS_THEY_ARE = tuple(
    re.compile(rf"\s*{pattern}")
    for pattern in (
        r"(?:/\*.*\*/)?",
        r"(?:const )?casadi_(?:real|int)\b(?!.*=\d)[\w\s,*=+]*;",
        rf"(?:arg1|res1)\[\d+\]={POINTER};",
        r"res1\[\d+\]=res\[\d+\] \? w\d+ : 0;",
        rf"wr\d+ = {POINTER};",
        r"casadi_real aside\d+\[\d+\];",
        r"const casadi_real \*in(\d+) = arg\[\1\] \? arg\[\1\] : casadi_nought;",
        r"casadi_real \*out(\d+) = res\[\1\] \? res\[\1\] : aside\1;",
        r"if \(res\[(\d+)\](?:!=0)?\) res\[\1\]\[\d+\]\s*=\s*[aw]\d+;",
        rf"casadi_copy\((?:{POINTER}|arg\[\d+\]), \d+, (?:res\[\d+\]|w\d+)\);",
        rf"casadi_clear\({POINTER}, \d+\);",
        r"for \(i=0, rr=w\d+, cs=wr?\d+; i<\d+; \+\+i\) "
        r"for \(j=0; j<\d+; \+\+j\) rr\[i\+j\*\d+\] = \*cs\+\+;",
        r"for \(rr=[^;]*, cs=[^;]*; cs!=[^;]*; cs\+=\d+\) \*rr\+\+ = \*cs;",
        r"return 0;",
        r"if \(res\[\d+\]\) \{",
        r"\}",
    )
)


def rewritten(line: str) -> str:
    """The line for vectors; inner functions are called by the names `lanes.py` gives them.

    Args:
        line: Of the body of a function of the generated code.

    Raises:
        UnsuitedError: A line of a kind not foreseen.
    """
    if any(pattern.fullmatch(line) for pattern in AS_THEY_ARE):
        return line
    if match := INNER.fullmatch(line):
        return f"{match[1]}lanes_f{match[2]}(arg1, res1, iw, w, wanted)) return 1;"
    if match := OUTER.fullmatch(line):
        return f"  return lanes_f{match[1]}(arg, res, iw, w, wanted);"
    if match := ASSIGNMENT.fullmatch(line):
        return f"{match[1]}{match[2]} {match[3]} {_value(match[4].strip())};"
    if match := ELEMENTWISE.fullmatch(line):
        return f"{match[1]}(*rr++) {match[2]} {_value(match[3].strip())};"
    raise UnsuitedError(f"no side-by-side form of {line.strip()!r}")


def _value(text: str) -> str:
    """The right-hand side of an assignment: one operation."""
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
