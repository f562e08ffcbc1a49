"""What the steps of Qiu & Kermani 2021 share: layouts, and the numbers that go in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, TypeVar

import casadi as ca

from casadi_ik.arrays import Array
from casadi_ik.kernels.graphs import StepGraph, recipe
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.papers.qiu.parameters import OriginalParameters, QiuParameters
from casadi_ik.problem.contacts import target_fields, target_values
from casadi_ik.problem.targets import TargetBatch
from casadi_ik.problem.trace import ANGLE_ERROR, LIMIT_MASK, PHASE, POSITION_ERROR, STATUS, Q
from casadi_ik.robots.description import RobotDescription

Options = TypeVar("Options", QiuParameters, OriginalParameters)


class QiuStep(Generic[Options]):
    """What the steps of the paper's methods share: layouts, and the numbers that go in.

    Attributes:
        robot: The description.
        options: The structural choices; their numbers are parameters of the graph.
        state: What an iteration hands to the next.
        parameters: The problem and the numbers of the method.
        record: What is logged of an iteration.
    """

    family: str
    compilable = True
    stage = ""

    def __init__(
        self,
        robot: RobotDescription,
        options: Options,
        state: Sequence[Field],
        numbers: Sequence[Field],
        measured: Sequence[Field],
    ) -> None:
        """Lay out state, parameters and record.

        Args:
            robot: The description.
            options: The structural choices.
            state: Fields of the state beside q.
            numbers: Fields of the parameters beside the targets and limits.
            measured: Fields of the record between the errors and the limits.
        """
        limits = Field("enforce_limits", doc="1: q is kept within its limits, 0: it is not")
        self.robot, self.options = robot, options
        self.state = Layout((Field("q", (len(robot.actuators),)), *state))
        self.parameters = Layout((*target_fields(robot), limits, *numbers))
        first, last = (Q, POSITION_ERROR, ANGLE_ERROR), (LIMIT_MASK, PHASE, STATUS)
        ends = [[field.of(robot) for field in fields] for fields in (first, last)]
        self.record = Layout.record(*ends[0], *measured, *ends[1])

    def graph(self) -> StepGraph:
        """The whole iteration."""
        return StepGraph(
            self._name,
            self._iteration,
            self.state,
            self.parameters,
            self.record,
            self.compilable,
            stage=self.stage,
            recipe=recipe(self._name, self.robot, self.options),
        )

    @property
    def _name(self) -> str:
        return ca.Function.fix_name(f"{self.family}_{self.options.steps}_{self.robot.name}")

    def _iteration(self) -> ca.Function:
        """``(state, parameters) -> (state', record, status)``."""
        raise NotImplementedError

    def first_state(self, starts: Array) -> dict[str, float | Array]:
        """Values of all state fields for starts (k, n)."""
        return {"q": starts}

    def parameter_values(self, targets: TargetBatch) -> dict[str, float | list[float] | Array]:
        """Values of all parameter fields for a batch."""
        named = (name for name in self.parameters.names if hasattr(self.options, name))
        return {
            **target_values(targets),
            "enforce_limits": float(targets.enforce_limits),
            **{name: float(getattr(self.options, name)) for name in named},
        }

    def _inputs(self) -> tuple[ca.SX, ca.SX, dict[str, ca.SX], dict[str, ca.SX]]:
        state, parameters = self.state.symbols("state"), self.parameters.symbols("parameters")
        return state, parameters, self.state.unpack(state), self.parameters.unpack(parameters)
