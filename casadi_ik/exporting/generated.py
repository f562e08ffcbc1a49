"""Generated C made fit to stand alone: no symbol and no parameter that a strict compiler minds."""

from __future__ import annotations

import re
from typing import Any

from casadi_ik.errors import UnsupportedError
from casadi_ik.kernels.codegen import EXTREMES, OWN, driver_text, function_source, own_functions
from casadi_ik.kernels.some_at_once import some_at_once

DEFINITION = re.compile(
    r"^(?:CASADI_SYMBOL_EXPORT |static )*"
    r"[A-Za-z_][\w ]*[ *]+(\w+)\([^;{]*\) ?\{(?:[^\n]*\}\n|.*?^\}\n)",
    re.MULTILINE | re.DOTALL,
)
CONSTANT = re.compile(
    r"^static const \w+ (\w+)\[\d+\](?:\s*=\s*\{.*?\})?;\n", re.MULTILINE | re.DOTALL
)
ONE_LINE = re.compile(r"^CASADI_SYMBOL_EXPORT .*\{.*\}\n", re.MULTILINE)
STEP = re.compile(r"const casadi_real\*\* arg, casadi_real\*\* res, casadi_int\* iw, ")
MEMORY = re.compile(r"casadi_f\d+_(?:mem|checkout)")

TYPES = """\
#define casadi_real double
#define casadi_int long long int
#define casadi_to_int(x) ((casadi_int) (x))
#define casadi_inf INFINITY
#define casadi_nan NAN
#define CASADI_CAST(type, value) ((type) (value))
"""

WHOLE = "casadi_whole"
"""Name of the outermost function."""

UNUSED = "  (void) arg, (void) res, (void) iw, (void) w, (void) mem;\n"


def standing_alone(function: Any, single: bool = False) -> str:
    """The C code of a CasADi function, all of it static.

    Args:
        function: Dense and row-major.
        single: Whether it will be rewritten for single precision: then its sines are of that.

    Raises:
        UnsupportedError: It needs memory of its own.
        KernelError: It has no C code.
    """
    name = function.name()
    text = function_source(function)
    if not single:
        text = some_at_once(text)
    if MEMORY.search(text):
        raise UnsupportedError(f"function {name!r} needs memory of its own: it cannot be exported")
    # Its own name could be one of the solver's.
    body = re.sub(rf"\b{name}\b", WHOLE, ONE_LINE.sub("", text))
    pieces = [(match[1], match[0]) for match in DEFINITION.finditer(body)]
    constants = [(match[1], match[0]) for match in CONSTANT.finditer(body)]
    kept = _reached(WHOLE, [*constants, *pieces])
    lines = [_static(source) for _, source in kept]
    alone = driver_text("elementary_single"), driver_text("extremes")
    return "".join(
        (
            TYPES,
            *(alone if single else (own_functions(),)),
            *(f"#define {own} own_{own}\n" for own in (*OWN, *EXTREMES)),
            *lines,
            *(f"#undef {own}\n" for own in (*OWN, *EXTREMES)),
            f"#define STEP {WHOLE}\n",
        )
    )


def _reached(name: str, pieces: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """What a function needs, in order."""
    sources = dict(pieces)
    wanted, reached = [name], {name}
    while wanted:
        for word in set(re.findall(r"\b\w+\b", sources[wanted.pop()])):
            if word in sources and word not in reached:
                reached.add(word)
                wanted.append(word)
    return [(key, source) for key, source in pieces if key in reached]


def _static(source: str) -> str:
    if source.startswith("static const"):
        return source
    source = source.removeprefix("CASADI_SYMBOL_EXPORT ").removeprefix("static ")
    if STEP.search(source.partition("\n")[0]):
        head, _, rest = source.partition("{\n")
        source = f"{head}{{\n{UNUSED}{rest}"
    return f"static {source}"
