"""What a solve touched on its way, and how far its answer is from touching something, in words."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from casadi_ik.logs.read.one_solve import OneSolve
from casadi_ik.problem.trace import CLEARANCE


def collision_lines(solve: OneSolve) -> Iterator[str]:
    """When iterations touched something; nothing is said of a solve without a scene."""
    if CLEARANCE not in solve.layout.names or len(solve.rows) == 0:
        return
    clearance = solve.rows[CLEARANCE].astype(float)
    entered = [one for one in solve.events if one.kind == "COLLISION_ENTERED"]
    left = [one for one in solve.events if one.kind == "COLLISION_LEFT"]
    if not entered:
        yield f"nothing touched on the way: clearance at least {_mm(float(np.nanmin(clearance)))}"
        return
    deepest = int(np.nanargmin(clearance))
    line = f"something touched from iteration {entered[0].iteration} on"
    if len(entered) > 1:
        line += f", {len(entered)} times"
    line += f"; clearance down to {_mm(float(clearance[deepest]))} in iteration {deepest}"
    if len(left) == len(entered):
        line += f"; free from iteration {left[-1].iteration} on"
    yield line


def answer_lines(solve: OneSolve) -> Iterator[str]:
    """How far the answer is from touching something."""
    if solve.clearance is None:
        yield "collision not checked"
    elif solve.closest is None:
        yield "nothing there to touch"
    else:
        pair = " and ".join(solve.closest)
        what = "overlap by" if solve.clearance < 0 else "are nearest to touching:"
        yield f"{pair} {what} {_mm(abs(solve.clearance))}"
    if CLEARANCE in solve.layout.names and len(solve.rows) and solve.clearance is not None:
        last = float(solve.rows[CLEARANCE][-1])
        if solve.success and last < 0 <= solve.clearance:
            yield f"chosen among other answers; the last iteration touched by {_mm(-last)}"


def _mm(value: float) -> str:
    return f"{1e3 * value:.2f} mm"
