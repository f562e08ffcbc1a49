"""What the files of an exported project say in double and in single precision."""

from __future__ import annotations

from casadi_ik.exporting.single import SinglePrecision
from casadi_ik.kernels.codegen import number

IN_DOUBLE = {
    "REAL": "double",
    "AS_DOUBLE": "",
    "TO_REAL": "",
    "AND_SUM": ", sum = 0;",
    "LESS_POSITION": "",
    "LESS_ANGLE": "",
    "STRICTER": "",
    "JUDGE": "",
    "PRECISION": "",
    "PRECISION_NOTE": "",
    "ANSWERS": (
        "The answers are bit for bit those of the Python package (method hand-first) on a machine "
        "of the same\narithmetic, whatever the optimisation, as long as multiply-adds are not "
        "fused (`-ffp-contract=off`).\n"
    ),
    "COMPARED": "answers compared bit for bit",
    "ABOUT_PRECISION": "",
}
"""What stands for the marks in double precision."""

ANSWERS = """\
In single precision, for controllers without a unit for doubles: nothing is computed in double
precision. What is called solved is so in double precision, too; see [below](#single-precision).
"""

ABOUT = """
## Single precision

All numbers are `float`; `-Wdouble-promotion` tells that nothing else is computed with. The method
is the one of the double-precision export, its bounds against division by nothing those of this
precision; the iterates are others, and so may an answer be where a target has several.

Rounding moves this robot's fingertips by less than {position:.1e} m and {angle:.1e} rad. Answers
keep to tolerances less that, and to limits moved inwards by {angle:.1e} rad: what is called solved
is solved for double precision as well. So tolerances from {least:.1g} m and {least_angle:.1g} rad
on make sense; smaller ones than rounding are never met.

How often it solves: of 10,000 random targets within reach at 5 mm and 3 deg all that double
precision solves, of each of the robots kuka_lwr_barrett and panda+allegro_right. For this robot
`make test` tells: of a thousand that double precision solves one may be missed, and every answer is
judged by kinematics in double precision (`test/judge.c`).
"""


def in_single(single: SinglePrecision) -> dict[str, str]:
    """What stands for the marks in single precision."""
    less = single.tolerance
    about = ABOUT.format(
        position=less.position,
        angle=less.angle,
        least=100 * less.position,
        least_angle=100 * less.angle,
    )
    return {
        "REAL": "float",
        "AS_DOUBLE": "(double) ",
        "TO_REAL": "(float) ",
        "AND_SUM": ";\n  double sum = 0;",
        "LESS_POSITION": f" - {number(less.position)}",
        "LESS_ANGLE": f" - {number(less.angle)}",
        "STRICTER": " -Wdouble-promotion",
        "JUDGE": " test/judge.c",
        "PRECISION": ", single precision",
        "PRECISION_NOTE": (
            " *\n * In single precision. Answers keep to tolerances less what rounding makes of\n"
            f" * them: {less.position:.1e} m and {less.angle:.1e} rad.\n"
        ),
        "ANSWERS": ANSWERS,
        "COMPARED": "answers judged in double precision",
        "ABOUT_PRECISION": about,
    }
