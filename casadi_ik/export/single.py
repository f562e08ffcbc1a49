"""Rendering of templates, and their substitutes for double and single precision."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import resources

import numpy as np

from casadi_ik.compile.codegen import number
from casadi_ik.errors import UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contact_fit import FIT
from casadi_ik.model.targets import Tolerance

TOKEN = re.compile(
    r"""
    (?P<kept> /\*.*?\*/ | //[^\n]* | "(?:\\.|[^"\\])*" | '(?:\\.|[^'\\])*'
            | ^[ ]*\#[ ]*include[^\n]* | 0[xX][0-9a-fA-F]+\w* )
    | (?P<number> (?: \d+\.\d* | \.\d+ ) (?:[eE][-+]?\d+)? (?!\w) | \d+[eE][-+]?\d+ (?!\w) )
    | \d[\w.]*
    | (?P<word> [A-Za-z_]\w* )
    """,
    re.VERBOSE | re.MULTILINE | re.DOTALL,
)

_TRIGONOMETRIC = ("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh")
_ELEMENTARY = ("exp", "log", "log10", "pow", "sqrt", "hypot", "fabs", "fmod", "frexp", "ldexp")
_ROUNDING_FUNCTIONS = ("floor", "ceil", "rint", "round", "fmax", "fmin", "copysign")
LIBM = frozenset((*_TRIGONOMETRIC, *_ELEMENTARY, *_ROUNDING_FUNCTIONS))
"""Functions of the C library whose single-precision variants have the suffix f."""

FLOAT = np.finfo(np.float32)
EPSILON = float(FLOAT.eps)

SINGLE_ROUNDING = 8 * EPSILON
"""Bound of the rounding error of kinematics: an angle [rad], and a fraction of the robot's reach.

Source: three times the largest error in 20,000 random solves of kuka_lwr_barrett and
panda+allegro_right."""

ARM_ROUNDING = 16 * SINGLE_ROUNDING
"""Bound of the rounding error of arm joints that are computed from the pose of the palm [rad].

A joint at a limit may exceed the limit by this amount, and is then clipped."""

REPLACED_THRESHOLDS = ((FIT.exact * FIT.exact, ARM_ROUNDING * ARM_ROUNDING),)
"""Thresholds in the graphs that are replaced in single precision: pairs of old and new values.

A fit or an arm counts as exact if its cost is below the threshold. Single precision does not reach
the threshold of double precision; with it, the arm would be searched from every start, in 13 times
as many iterations.
"""

SMALL_LENGTH, LARGE_LENGTH = 1e-15, 1e15
"""Lengths between these have squares that neither underflow nor overflow."""

REACH_SAMPLES = 1024
"""Number of random configurations that estimate the reach of a robot."""


def in_single_precision(text: str) -> str:
    """Return C code with its double-precision types, constants and functions in single precision.

    No operation remains in double precision. Constants outside the range of single precision become
    the largest or smallest positive number, not infinity or zero: such constants are bounds, and a
    lower bound of a divisor must stay positive.
    """
    return TOKEN.sub(_exchanged, text)


def _exchanged(match: re.Match[str]) -> str:
    """Return a number, type or function of C in single precision."""
    number, word = match["number"], match["word"]
    if number is not None:
        return _number(number)
    if word == "double":
        return "float"
    return f"{word}f" if word in LIBM else match[0]


def _number(text: str) -> str:
    """Return a single-precision constant of C."""
    value = float(text)
    if value > float(FLOAT.max):
        text = repr(float(FLOAT.max))
    elif 0 < value < float(FLOAT.tiny):
        text = repr(float(FLOAT.tiny))
    return f"{text}f"


@dataclass(frozen=True, eq=False)
class SinglePrecision:
    """Allowances for rounding, so that solutions in single precision pass the check in double.

    Attributes:
        robot: The robot.
    """

    robot: ArmHand

    @cached_property
    def reach(self) -> float:
        """Largest distance of a contact from the origin of the base frame [m]."""
        points, _ = self.robot.contacts(self.robot.random(np.random.default_rng(0), REACH_SAMPLES))
        return float(np.linalg.norm(points, axis=-1).max())

    @property
    def tolerance(self) -> Tolerance:
        """Rounding errors, by which tolerances are reduced."""
        return Tolerance(SINGLE_ROUNDING * self.reach, SINGLE_ROUNDING)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Limits (n,), tightened by the rounding error and exact in single precision.

        Raises:
            UnsupportedError: A range is smaller than the rounding error.
        """
        lower, upper = self.robot.lower, self.robot.upper
        low = (lower + SINGLE_ROUNDING * np.maximum(1.0, np.abs(lower))).astype(np.float32)
        high = (upper - SINGLE_ROUNDING * np.maximum(1.0, np.abs(upper))).astype(np.float32)
        for name, lowest, highest in zip(self.robot.actuators, low, high, strict=True):
            if lowest >= highest:
                raise UnsupportedError(
                    f"--single: the range of motor {name!r} is too small for single precision"
                )
        return low.astype(float), high.astype(float)

    @property
    def reals(self) -> dict[str, float]:
        """Constants of the search that depend on the precision."""
        return {
            "LIMIT_SLACK": 0.0,
            "TOLERANCE_SLACK": 0.0,
            "SMALL_LENGTH": SMALL_LENGTH,
            "LARGE_LENGTH": LARGE_LENGTH,
        }

    @property
    def arrays(self) -> dict[str, Array]:
        """Arrays of the search that depend on the precision."""
        lower, upper = self.bounds
        return {"LOWER": lower, "UPPER": upper}


DOUBLE_PRECISION = {
    "REAL": "double",
    "MATHS": "#include <math.h>",
    "AND_SUM": ", sum = 0;",
    "ANSWERS": (
        "Solutions agree bit for bit with those of the Python package (method hand-first) on "
        "machines with\nIEEE 754 arithmetic, at any optimisation level, without fused "
        "multiply-adds\n(`-ffp-contract=off`).\n"
    ),
    "COMPARED": "and compares the solutions bit for bit with those of Python",
}
"""Substitutes of the template marks in double precision."""

SINGLE_PRECISION_SUMMARY = """\
This project computes in single precision, for controllers without double-precision arithmetic.
Targets reported as solved are also solved in double precision; see [below](#single-precision).
"""

SINGLE_PRECISION_PAGE = """
## Single precision

Every number is a `float`, and no operation is in double precision (`-Wdouble-promotion` checks
this). The method is that of the double-precision export, with thresholds adapted to single
precision. Iterates differ, so that a target with several solutions may get a different one.

Rounding moves the fingertips of this robot by less than {position:.1e} m and {angle:.1e} rad. The
solver reduces tolerances by these amounts and moves limits inwards by {angle:.1e} rad. A target
that is reported as solved is therefore also solved in double precision. Use tolerances of
{least:.1g} m and {least_angle:.1g} rad or more; tolerances below the rounding error are never met.

`make test` solves the stored targets. It fails if a solution that is reported as solved violates
a tolerance or a limit in double precision (`test/judge.c`), or if more than one in a thousand of
the targets that double precision solves is missed.
"""


def single_precision_substitutes(single: SinglePrecision) -> dict[str, str]:
    """Return the substitutes of the template marks in single precision."""
    reduction = single.tolerance
    page = SINGLE_PRECISION_PAGE.format(
        position=reduction.position,
        angle=reduction.angle,
        least=100 * reduction.position,
        least_angle=100 * reduction.angle,
    )
    return {
        "REAL": "float",
        "MATHS": "#define SINGLE\n#include <tgmath.h>",
        "AS_DOUBLE": "(double) ",
        "TO_REAL": "(float) ",
        "AND_SUM": ";\n  double sum = 0;",
        "LESS_POSITION": f" - {number(reduction.position)}",
        "LESS_ANGLE": f" - {number(reduction.angle)}",
        "STRICTER": " -Wdouble-promotion",
        "JUDGE": " test/judge.c",
        "PRECISION": ", single precision",
        "PRECISION_NOTE": (
            " *\n * Single precision: the solver reduces tolerances by the rounding error,\n"
            f" * {reduction.position:.1e} m and {reduction.angle:.1e} rad.\n"
        ),
        "ANSWERS": SINGLE_PRECISION_SUMMARY,
        "COMPARED": "and verifies the solutions in double precision",
        "ABOUT_PRECISION": page,
    }


TEMPLATE_MARK = re.compile(r"@([A-Z_]+)(\??)@")
TEMPLATE_SECTION = re.compile(r"^@([A-Z_]+)\{@\n((?:(?!@[A-Z_]+\{@\n).*\n)*?)@\}@\n", re.MULTILINE)
"""A section without inner sections."""


def render_template(name: str, substitutes: Mapping[str, str]) -> str:
    """Return the text of `templates/<name>` with all marks replaced.

    A mark `@NAME?@` is optional: it is removed if there is no substitute. Lines between `@NAME{@`
    and `@}@` are omitted unless there is a substitute for NAME; sections may contain others.

    Raises:
        KeyError: A mark that is not optional has no substitute.
    """
    text = (resources.files("casadi_ik.export") / "templates" / name).read_text(encoding="utf-8")
    count = 1
    while count:
        text, count = TEMPLATE_SECTION.subn(lambda m: m[2] if m[1] in substitutes else "", text)
    return TEMPLATE_MARK.sub(
        lambda m: substitutes.get(m[1], "") if m[2] else substitutes[m[1]], text
    )
