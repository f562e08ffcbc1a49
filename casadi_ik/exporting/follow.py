"""What follows moving contacts, as source code: the graph of one cycle, and what drives it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.exporting.single import filled
from casadi_ik.kernels.codegen import define, define_arrays, number, row_major, standing_alone
from casadi_ik.kernels.emitter import Form
from casadi_ik.kernels.layout import Layout
from casadi_ik.motion.asked import contact_weights
from casadi_ik.motion.cycle import Cycle
from casadi_ik.motion.follower import PALM_WEIGHT
from casadi_ik.motion.moving import FOLLOWING_PULL, SETTLING
from casadi_ik.motion.plan import FADING
from casadi_ik.motion.rates import RUN_UP, own_velocities
from casadi_ik.problem.contacts import usual
from casadi_ik.problem.problems import Tolerance
from casadi_ik.problem.verdict import TOLERANCE_SLACK


@dataclass(frozen=True, eq=False)
class FollowSources:
    """What a follower adds to the sources of a solver.

    Attributes:
        robot: The robot.
        prefix: What every name begins with.
        tolerance: When a contact counts as reached.
    """

    robot: ArmHand
    prefix: str
    tolerance: Tolerance

    def files(self) -> tuple[dict[str, str], dict[str, str]]:
        """The C file by path, and what stands for the marks of the other templates."""
        cycle = Cycle(self.robot.description, usual(len(self.robot.fingers)))
        marks = {
            "PREFIX": self.prefix,
            "GUARD": self.prefix.upper(),
            "CYCLE": standing_alone(row_major(cycle.graph.function), Form()),
            "FOLLOW_CONSTANTS": self._constants(cycle),
            "FOLLOW_STATE": str(cycle.state.size),
            "FOLLOW_ASKED": str(cycle.parameters.size),
            "FOLLOW_RECORD": str(cycle.record.size),
        }
        about = {
            "FOLLOW_CALLS": filled("follow.h", marks),
            "FOLLOW_WASM": filled("follow_wasm.c", marks),
            "FOLLOW_JS": filled("follow.js", marks),
            "FOLLOW_DTS": filled("follow.d.ts", marks),
            "FOLLOW_STATUS_JS": (
                "export const FollowStatus = Object.freeze({\n"
                "  HOLDING: 0,\n  FOLLOWING: 1,\n  LATE: 2,\n  MISSED: 3,\n});\n"
            ),
            "FOLLOW_STATUS_DTS": (
                "export const FollowStatus: {\n"
                "  /** The frame was none: the motors come to rest and wait. */\n"
                "  readonly HOLDING: 0;\n"
                "  /** Every contact is within tolerance. */\n  readonly FOLLOWING: 1;\n"
                "  /** Velocities and accelerations permit no more. */\n  readonly LATE: 2;\n"
                "  /** No posture on this branch meets the contacts. */\n  readonly MISSED: 3;\n"
                "};\n"
            ),
        }
        return {f"src/{self.prefix}_follow.c": filled("follow.c", marks)}, about

    def _constants(self, cycle: Cycle) -> str:
        robot, f = self.robot, len(self.robot.fingers)
        places = {"N_FINGERS": f, "N_MOTORS": len(robot.actuators), "MOVES_PALM": int(cycle.palm)}
        places |= _places("STATE", cycle.state) | _places("ASKED", cycle.parameters)
        numbers = {
            "TOLERANCE_SLACK": TOLERANCE_SLACK,
            "SETTLING": SETTLING,
            "FADING": FADING,
            "PULL": FOLLOWING_PULL,
            "RUN_UP": RUN_UP,
            "PALM_WEIGHT": PALM_WEIGHT,
        }
        arrays = {
            "LOWER": robot.lower,
            "UPPER": robot.upper,
            "HOME": robot.home,
            "VELOCITY": own_velocities(robot),
            "WEIGHTS": contact_weights((self.tolerance,) * f),
            "POSITION_TOLERANCES": np.full(f, self.tolerance.position),
            "ANGLE_TOLERANCES": np.full(f, self.tolerance.angle),
        }
        return (
            define(places | _places("RECORD", cycle.record))
            + "".join(f"#define {name} {number(value)}\n" for name, value in numbers.items())
            + define_arrays(arrays)
        )


def _places(label: str, layout: Layout) -> dict[str, int]:
    return {f"{label}_{one.name.upper()}": layout.slice(one.name).start for one in layout}


NO_FOLLOWER = dict.fromkeys(
    (
        *("FOLLOW_CALLS", "FOLLOW_WASM", "FOLLOW_JS"),
        *("FOLLOW_DTS", "FOLLOW_STATUS_JS", "FOLLOW_STATUS_DTS"),
    ),
    "",
)
"""What stands for the marks where an export does not follow."""
