"""The library of a function for four or eight solves side by side.

The generated code is there twice: as CasADi wrote it, and once more for vectors of doubles
(`lanes_lines.py`), `casadi_f3` as `lanes_f3`. An inner function with a line that has no form for
vectors is called as it is, once for each lane that counts; the outermost must have one. What nobody
calls the compiler leaves out.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import casadi as ca

from casadi_ik.kernels.arguments import HEAD, SIGNATURE, argument_sizes
from casadi_ik.kernels.codegen import (
    define,
    driver_text,
    function_source,
    step_names,
    with_own_functions,
)
from casadi_ik.kernels.lanes_lines import UnsuitedError, rewritten

FAILURE = re.compile(
    r"\s*return (?!0;|casadi_f\d+\(arg, res, iw, w, mem\);).*|.*\) return (?!1;).*"
)
BRANCH = re.compile(r"\s*if \(casadi_f(\d+)\(arg\+1, res, iw, w, 0\)\) return 1;")
BY_FIRST_ARGUMENT = re.compile(r"\s*(switch|if) \(arg\[0\] \? casadi_to_int\(\*arg\[0\]\) : 0\) \{")
ZEROS = re.compile(r"static const casadi_real casadi_(zeros|nought)\[(\d+)\]")
MEMORY = re.compile(r"casadi_f\d+_(?:mem|checkout)")
WORK = re.compile(r"\*sz_(arg|res) = (\d+);")
RENAMED = ("sq", "fabs", "fmin", "fmax", "hypot", "copy", "clear", "zeros", "nought")


@dataclass(frozen=True)
class _Function:
    """A function of the generated code.

    Attributes:
        name: As CasADi named it.
        inputs: How many numbers each input has.
        outputs: How many numbers each output has.
        body: Its lines.
    """

    name: str
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    body: tuple[str, ...]

    @property
    def head(self) -> str:
        """The first line of its form for vectors; `wanted` has a bit for each lane that counts."""
        name = "lanes_" + self.name.removeprefix("casadi_")
        given = "const lanes** arg, lanes** res, casadi_int* iw, lanes* w, int wanted"
        return f"LANES_TARGET static int {name}({given}) {{"


def lanes_source(function: ca.Function, driver: str, lanes: int) -> str:
    """The text of a library of the function for some solves side by side.

    Args:
        function: Dense and row-major.
        driver: C text of the driver, with its constants.
        lanes: How many, 4 or 8.

    Raises:
        UnsuitedError: The outermost function has no form for vectors, or one needs memory or can
            fail.
        KernelError: The graph has no C code.
    """
    name = function.name()
    text = function_source(function)
    if MEMORY.search(text):
        raise UnsuitedError(f"{name}: a function with memory of its own")
    zeros = {"zeros": "1", "nought": "1"} | dict(ZEROS.findall(text))
    *inner, step, entry = _functions(text)
    room = {key: int(size) for key, size in WORK.findall(text)}
    return "\n".join(
        (
            "#define CASADI_SYMBOL_EXPORT static",
            with_own_functions(text),
            define({"LANES": lanes}),
            driver_text("lanes"),
            driver_text("elementary_lanes"),
            driver_text("elementary"),
            *(f"#undef casadi_{own}\n#define casadi_{own} lanes_{own}" for own in RENAMED),
            *(f"static const lanes lanes_{name}[{size}];" for name, size in zeros.items()),
            *(line for each in inner for line in _side_by_side(each, room)),
            *(line for each in (step, entry) for line in _for_vectors(each)),
            step_names(name).replace(f"STEP {name}", f"STEP lanes_{name}"),
            driver_text("common"),
            driver,
        )
    )


def _functions(text: str) -> Iterator[_Function]:
    """The functions with the signature of a step, callees before callers."""
    lines = iter(text.splitlines())
    inputs: tuple[int, ...] = ()
    outputs: tuple[int, ...] = ()
    for line in lines:
        if signature := SIGNATURE.fullmatch(line):
            inputs, outputs = _sizes(signature[1]), _sizes(signature[2])
        elif head := HEAD.fullmatch(line):
            body = tuple(iter(lines.__next__, "}"))
            # A failure would be that of all four.
            if failures := [line for line in body if FAILURE.fullmatch(line)]:
                raise UnsuitedError(f"{head[1]} can fail: {failures[0].strip()!r}")
            yield _Function(head[1], inputs, outputs, body)


def _sizes(arguments: str) -> tuple[int, ...]:
    sizes = argument_sizes(arguments)
    if sizes is None:
        raise UnsuitedError(f"arguments of an unknown form: {arguments!r}")
    return sizes


def _side_by_side(function: _Function, room: dict[str, int]) -> list[str]:
    """The function for vectors; one lane after the other where there is no other way."""
    try:
        return _for_vectors(function)
    except UnsuitedError:
        return _one_by_one(function, room)


def _for_vectors(function: _Function) -> list[str]:
    if choice := BY_FIRST_ARGUMENT.fullmatch(function.body[0]):
        body = _branches(function, choice[1])
    else:
        body = [rewritten(line) for line in function.body]
    return [function.head, *body, "}"]


def _one_by_one(function: _Function, room: dict[str, int]) -> list[str]:
    """Each lane that counts calls the function as it is."""
    sizes = [*function.inputs, *function.outputs]
    return [
        function.head,
        f"  static const int sizes[] = {{{', '.join(map(str, sizes))}}};",
        f"  double numbers[{sum(sizes)}];",
        f"  const double *one_arg[{room['arg']}];",
        f"  double *one_res[{room['res']}];",
        f"  const lanes_alone alone = {{{function.name}, {len(function.inputs)}, "
        f"{len(function.outputs)}, sizes, numbers, one_arg, one_res}};",
        "  return lanes_one_by_one(&alone, arg, res, iw, (double *) w, wanted);",
        "}",
    ]


def _branches(function: _Function, word: str) -> list[str]:
    """The body of a function that calls one of others by its first argument.

    Where all that count agree, the branch they take is called; otherwise each branch that any of
    them takes, and everyone keeps the results of its own.
    """
    called = [match[1] for line in function.body if (match := BRANCH.fullmatch(line))]
    # Of `if`, the first branch is that of everything but 0.
    order = called if word == "switch" else called[::-1]
    sizes = list(enumerate(function.outputs))
    return [
        *(f"  lanes own{k}[{size}];" for k, size in sizes),
        f"  lanes *given[{len(sizes)}];",
        "  int branch[LANES], b, mine;",
        f"  lanes_branch(arg[0], {len(order) - 1}, branch);",
        f"  for (b = 0; b < {len(order)}; ++b) {{",
        "    mine = wanted & lanes_in(branch, b);",
        "    if (!mine) continue;",
        "    if (mine == wanted) {",
        *_calls(order, "return {call};"),
        "    }",
        *(f"    given[{k}] = res[{k}];" for k, _ in sizes),
        *(f"    if (res[{k}]) res[{k}] = own{k};" for k, _ in sizes),
        *_calls(order, "if ({call}) return 1; break;"),
        *(f"    res[{k}] = given[{k}];" for k, _ in sizes),
        *(f"    lanes_keep(mine, own{k}, {size}, res[{k}]);" for k, size in sizes),
        "  }",
        "  return 0;",
    ]


def _calls(order: list[str], form: str) -> Iterator[str]:
    """A switch over b that calls the functions."""
    yield "    switch (b) {"
    for case, number in enumerate(order):
        call = f"lanes_f{number}(arg + 1, res, iw, w, mine)"
        yield f"      case {case}: {form.format(call=call)}"
    yield "    }"
