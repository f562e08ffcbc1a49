"""Template rendering, and the substitutes for double and single precision."""

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

_TURNS = ("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh")
_OTHERS = ("exp", "log", "log10", "pow", "sqrt", "hypot", "fabs", "floor", "ceil", "fmod", "fmax")
LIBM = frozenset((*_TURNS, *_OTHERS, "fmin", "rint", "round", "copysign", "frexp", "ldexp"))
"""Functions of the C library whose single-precision variants have the suffix f."""

FLOAT = np.finfo(np.float32)
EPSILON = float(FLOAT.eps)

ROUNDING = 8 * EPSILON
"""Bound of the rounding error of kinematics: an angle [rad], and a fraction of the robot's reach.

Source: three times the largest error in 20,000 random solves of kuka_lwr_barrett and
panda+allegro_right."""

ARM_ROUNDING = 16 * ROUNDING
"""Bound of the rounding error of arm joints that are computed from the pose of the palm [rad].

A joint at a limit may exceed it by this amount, and is then clamped."""

FOLLOWING = ((FIT.exact * FIT.exact, ARM_ROUNDING * ARM_ROUNDING),)
"""Thresholds in the graphs that are replaced in single precision: pairs of old and new values.

A fit or an arm whose cost is below the threshold is exact. Single precision does not reach the
value of double precision, and would search an arm from every start, in thirteen times as many
iterations.
"""

SMALL, LARGE = 1e-15, 1e15
"""Lengths between these have squares that neither underflow nor overflow."""

SAMPLES = 1024
"""Number of random configurations that estimate the reach of a robot."""


def in_single_precision(text: str) -> str:
    """Return C code with its double-precision types, constants and functions in single precision.

    No operation remains in double precision. Constants outside the range of single precision become
    the largest or smallest positive number, not infinity or zero: such constants are bounds, and a
    lower bound of a divisor must stay positive.
    """
    return TOKEN.sub(_exchanged, text)


def _exchanged(match: re.Match[str]) -> str:
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
    """Allowances for rounding, with which double precision confirms answers in single precision.

    Attributes:
        robot: The robot.
    """

    robot: ArmHand

    @cached_property
    def reach(self) -> float:
        """Largest distance of a contact from the origin of the base frame [m]."""
        points, _ = self.robot.contacts(self.robot.random(np.random.default_rng(0), SAMPLES))
        return float(np.linalg.norm(points, axis=-1).max())

    @property
    def tolerance(self) -> Tolerance:
        """Rounding error by which tolerances are reduced."""
        return Tolerance(ROUNDING * self.reach, ROUNDING)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """The robot's limits (n,), moved inwards by the rounding error; exact in single precision.

        Raises:
            UnsupportedError: A range is smaller than the rounding error.
        """
        lower, upper = self.robot.lower, self.robot.upper
        low = (lower + ROUNDING * np.maximum(1.0, np.abs(lower))).astype(np.float32)
        high = (upper - ROUNDING * np.maximum(1.0, np.abs(upper))).astype(np.float32)
        for name, one, other in zip(self.robot.actuators, low, high, strict=True):
            if one >= other:
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
            "SMALL_LENGTH": SMALL,
            "LARGE_LENGTH": LARGE,
        }

    @property
    def arrays(self) -> dict[str, Array]:
        """Arrays of the search that depend on the precision."""
        lower, upper = self.bounds
        return {"LOWER": lower, "UPPER": upper}


IN_DOUBLE = {
    "REAL": "double",
    "MATHS": "#include <math.h>",
    "AND_SUM": ", sum = 0;",
    "ANSWERS": (
        "Answers are bit for bit those of the Python package (method hand-first) on machines with "
        "IEEE 754\narithmetic, at any optimisation level, without fused multiply-adds "
        "(`-ffp-contract=off`).\n"
    ),
    "COMPARED": "and compares the answers bit for bit with those of Python",
}
"""Substitutes of the template marks in double precision."""

ANSWERS = """\
This project is in single precision, for controllers without double-precision arithmetic. Answers
that it reports as solved are solved in double precision as well; see [below](#single-precision).
"""

ABOUT = """
## Single precision

Every number is a `float`, and nothing is computed in double precision (`-Wdouble-promotion` checks
this). The method is that of the double-precision export, with thresholds adapted to single
precision. Iterates differ, so that the answer may be another one where a target has several.

Rounding moves the fingertips of this robot by less than {position:.1e} m and {angle:.1e} rad. The
solver reduces tolerances by these amounts and moves limits inwards by {angle:.1e} rad. Therefore an
answer that is reported as solved is solved in double precision as well. Use tolerances of
{least:.1g} m and {least_angle:.1g} rad or more; tolerances below the rounding error are never met.

`make test` solves the stored targets. It fails if an answer that is reported as solved violates
a tolerance or a limit in double precision (`test/judge.c`), or if more than one in a thousand of
the targets that double precision solves is missed.
"""


def in_single(single: SinglePrecision) -> dict[str, str]:
    """Return the substitutes of the template marks in single precision."""
    less = single.tolerance
    about = ABOUT.format(
        position=less.position,
        angle=less.angle,
        least=100 * less.position,
        least_angle=100 * less.angle,
    )
    return {
        "REAL": "float",
        "MATHS": "#define SINGLE\n#include <tgmath.h>",
        "AS_DOUBLE": "(double) ",
        "TO_REAL": "(float) ",
        "AND_SUM": ";\n  double sum = 0;",
        "LESS_POSITION": f" - {number(less.position)}",
        "LESS_ANGLE": f" - {number(less.angle)}",
        "STRICTER": " -Wdouble-promotion",
        "JUDGE": " test/judge.c",
        "PRECISION": ", single precision",
        "PRECISION_NOTE": (
            " *\n * Single precision: the solver reduces tolerances by the rounding error,\n"
            f" * {less.position:.1e} m and {less.angle:.1e} rad.\n"
        ),
        "ANSWERS": ANSWERS,
        "COMPARED": "and verifies the answers in double precision",
        "ABOUT_PRECISION": about,
    }


MARK = re.compile(r"@([A-Z_]+)(\??)@")
SECTION = re.compile(r"^@([A-Z_]+)\{@\n(.*?)^@\}@\n", re.MULTILINE | re.DOTALL)


def filled(name: str, substitutes: Mapping[str, str]) -> str:
    """Return the text of `templates/<name>` with all marks replaced.

    A mark `@NAME?@` is optional: it is removed if there is no substitute. Lines between `@NAME{@`
    and `@}@` are kept only if there is a substitute for NAME.

    Raises:
        KeyError: A mark that is not optional has no substitute.
    """
    text = (resources.files("casadi_ik.export") / "templates" / name).read_text(encoding="utf-8")
    text = SECTION.sub(lambda m: m[2] if m[1] in substitutes else "", text)
    return MARK.sub(lambda m: substitutes.get(m[1], "") if m[2] else substitutes[m[1]], text)
