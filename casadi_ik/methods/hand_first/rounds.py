"""What rounds.c is made of: all rounds of one target in compiled code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.grasps.grasp import LARGE, SMALL, UNIT
from casadi_ik.kernels import REPEATED, RUNNING, FunctionKernel, LoopKernel
from casadi_ik.kernels.codegen import define
from casadi_ik.kernels.constants import define_arrays, number
from casadi_ik.kernels.driver_code import SLICE
from casadi_ik.methods.common.contact_fit import fresh_fit
from casadi_ik.methods.hand_first import going_on, restarts
from casadi_ik.methods.hand_first.beginning import terms
from casadi_ik.methods.hand_first.each_finger import mends
from casadi_ik.methods.hand_first.parameters import HandFirstParameters
from casadi_ik.methods.hand_first.restarts import Restarts
from casadi_ik.methods.hand_first.state import STAGES, HandFirstLayouts
from casadi_ik.problem.contacts.conditions import LENGTH
from casadi_ik.problem.status import Phase, Status
from casadi_ik.problem.verdict import LIMIT_SLACK, TOLERANCE_SLACK
from casadi_ik.symbolic.even_spread import even_steps

DIMENSIONS = (
    *("N_FINGERS", "N_MOTORS", "N_HAND", "N_TERMS", "N_STATE", "N_PARAMETERS"),
    *("N_CANDIDATES", "N_POOL", "N_MENDED", "N_MORE"),
)
"""Of the arrays in `rounds`."""

STATE = (
    *("q", "phase", "candidate", "earlier", "held", "returns"),
    *("best_cost", "best_q", "counts"),
)
"""What rounds.c reads and writes of a state."""


@cache
def source_text(name: str) -> str:
    """The text of "rounds_job" (the memory) or "rounds" (what is done in it)."""
    source = resources.files("casadi_ik.methods.hand_first") / f"{name}.c"
    return source.read_text(encoding="utf-8")


@dataclass(frozen=True, eq=False)
class RoundsPlan:
    """What rounds.c is made of for a robot and a way of taking limits.

    Attributes:
        layouts: Of the step.
        options: Of the method.
        rounds: How many there are at most.
        budget: Iterations of a round.
        hands: The hand postures that rounds begin from.
        enforce_limits: Whether limits are part of being solved.
        begin: Makes first state and parameters of a round.
        solve: The loop.
        contacts: Contact points and normals of configurations.
        judge: Errors and excess over limits of a configuration.
    """

    layouts: HandFirstLayouts
    options: HandFirstParameters
    rounds: int
    budget: int
    hands: Restarts
    enforce_limits: bool
    begin: FunctionKernel
    solve: LoopKernel
    contacts: FunctionKernel
    judge: FunctionKernel

    @property
    def sizes(self) -> dict[str, int]:
        """The `DIMENSIONS` by name."""
        robot, layouts, candidates = self.layouts.robot, self.layouts, self.options.candidates
        pool = self.hands.pool
        values = (
            *(len(robot.fingers), len(robot.actuators), len(robot.hand_actuators)),
            *(terms(robot).size, layouts.state.size, layouts.parameters.size),
            *(candidates, pool, pool if self.mends else 1, len(layouts.contacts.data) - 2),
        )
        return dict(zip(DIMENSIONS, values, strict=True))

    @property
    def mends(self) -> bool:
        """Whether postures of the wide table are mended finger by finger."""
        return self.enforce_limits and mends(self.layouts.robot)

    def constants(
        self,
        reals: Mapping[str, float] | None = None,
        arrays: Mapping[str, NDArray[Any]] | None = None,
    ) -> str:
        """All of them but the `sizes`, as C text.

        Args:
            reals: Those of them that are others than in Python.
            arrays: Likewise.
        """
        numbers = self._real_numbers() | dict(reals or {})
        lines = (f"#define {name} {number(value)}\n" for name, value in numbers.items())
        tables = self._arrays() | dict(arrays or {})
        return define(self._whole_numbers()) + "".join(lines) + define_arrays(tables)

    def _whole_numbers(self) -> dict[str, int]:
        layouts = self.layouts
        places = {f"STATE_{name.upper()}": layouts.state.slice(name).start for name in STATE}
        for label, layout in (("PARAMETERS", layouts.parameters), ("TERMS", terms(layouts.robot))):
            for name in ("lower", "upper", "nearest"):
                places[f"{label}_{name.upper()}"] = layout.slice(name).start
        return {
            "RUNNING": RUNNING,
            "REPEATED": REPEATED,
            "BUDGET": self.budget,
            "TABLE_ROUNDS": self.options.rounds,
            "ROUNDS": self.rounds,
            "VALLEYS": restarts.VALLEYS,
            "FIRST_RUGGED": restarts.first_rugged(self.options),
            "VARIED": going_on.VARIED,
            "RETURNS": going_on.most_returns(len(layouts.robot.hand_actuators)),
            "RETURNS_OF_HELD": going_on.RETURNS_OF_MANY,
            "POOL": restarts.MENDED if self.mends else restarts.POOL,
            "MENDS": int(self.mends),
            "SPREAD": restarts.SPREAD,
            "NARROW": restarts.NARROW,
            "NARROWER": restarts.NARROWER,
            "ENFORCE_LIMITS": int(self.enforce_limits),
            "HAS_ARM": int(bool(layouts.robot.arm_actuators)),
            "SOLVED_STATUS": int(Status.SOLVED),
            "STALLED_STATUS": int(Status.STALLED),
            "LIMIT_STATUS": int(Status.ITERATION_LIMIT),
            "INVALID_STATUS": int(Status.INVALID),
            "CANDIDATE_PHASE": int(Phase.CANDIDATE),
            "REFINEMENT_PHASE": int(Phase.REFINEMENT),
            "N_CARRIED": len(self._carried),
            "N_FRESH": len(fresh_fit()),
            "N_COUNTS": len(STAGES),
            **places,
        }

    def _real_numbers(self) -> dict[str, float]:
        hand = len(self.layouts.robot.hand_actuators)
        return {
            "SURE": going_on.SURE,
            "NEAR_COST": going_on.near_cost(hand),
            "NEAR_OF_HELD": going_on.NEAR_OF_MANY,
            "NEAR_SHRINKS": going_on.NEAR_SHRINKS,
            "AT_END": restarts.AT_END,
            "HELD": restarts.HELD,
            "NUDGE": restarts.NUDGE,
            "LENGTH": LENGTH,
            "ALIKE": restarts.SIMILAR * restarts.SIMILAR * hand,
            "UNIT": UNIT,
            "SMALL_LENGTH": SMALL,
            "LARGE_LENGTH": LARGE,
            "TOLERANCE_SLACK": TOLERANCE_SLACK,
            "LIMIT_SLACK": LIMIT_SLACK,
            "SLICE": SLICE,
        }

    @property
    def _carried(self) -> list[int]:
        """Places in the state."""
        slices = map(self.layouts.state.slice, going_on.CARRIED)
        return [place for one in slices for place in range(one.start, one.stop)]

    def _arrays(self) -> dict[str, NDArray[Any]]:
        robot, hands = self.layouts.robot, self.hands
        hand, spreads = list(robot.hand_actuators), hands.spreads
        lower, upper = hands.anywhere_bounds(self.enforce_limits)
        fresh, state = fresh_fit(), self.layouts.state
        return {
            "HAND": np.array(hand, dtype=np.int64),
            "CARRIED": np.array(self._carried),
            "FRESH_PLACES": np.array([state.slice(name).start for name in fresh]),
            "FRESH_VALUES": np.array([float(value) for value in fresh.values()]),
            "LOWER": robot.lower,
            "UPPER": robot.upper,
            "SIZE": hands.size,
            "ORDER_RANGES": np.maximum((robot.upper - robot.lower)[hand], going_on.TINY),
            "STRIDES": np.concatenate([hands.strides(i) for i in range(self.rounds)]),
            "HAND_STEPS": even_steps(len(hand)),
            "ALL_STEPS": even_steps(len(robot.actuators)),
            "ANYWHERE_LOWER": lower,
            "ANYWHERE_RANGE": upper - lower,
            "TABLE_LOWER": np.array([spread.lower[hand] for spread in spreads]),
            "TABLE_RANGE": np.array([(spread.upper - spread.lower)[hand] for spread in spreads]),
            "TABLE_SQUEEZE": np.array([1 - spread.at_limits for spread in spreads]),
            "TABLE_ROWS": np.array([spread.count for spread in spreads]),
        }
