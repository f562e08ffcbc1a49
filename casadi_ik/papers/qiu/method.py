"""The methods of Qiu & Kermani 2021, each one compiled loop."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Generic, TypeVar

from casadi_ik.arrays import Array, Counts
from casadi_ik.kernels import StepGraph
from casadi_ik.methods.common.limits import starts_within
from casadi_ik.methods.common.looped_method import LoopedMethod, Start
from casadi_ik.papers.qiu.enhanced import EnhancedStep
from casadi_ik.papers.qiu.original import OriginalStep
from casadi_ik.papers.qiu.parameters import OriginalParameters, QiuParameters
from casadi_ik.problem.status import Phase
from casadi_ik.problem.targets import TargetBatch
from casadi_ik.problem.trace import RecordedJacobian
from casadi_ik.robots.description import RobotDescription

Step = TypeVar("Step", EnhancedStep, OriginalStep)


class _QiuMethod(LoopedMethod, Generic[Step]):
    """What the methods of the paper share: one step graph, begun at q0, within the paper's budget.

    Attributes:
        step: Its step for this robot.
    """

    step: Step

    def step_graph(self) -> StepGraph:
        """The whole iteration."""
        return self.step.graph()

    def begin(self, targets: TargetBatch, q0: Array) -> Start:
        """Start at q0, moved into limits that are enforced."""
        step, count = self.step, len(targets)
        first = step.first_state(starts_within(self.robot, targets, q0))
        states = step.state.pack_rows(first, count)
        return states, step.parameters.pack_rows(step.parameter_values(targets), count)


class EnhancedMethod(_QiuMethod[EnhancedStep]):
    """`enhanced-*`: thumb reaching, then hand alignment along the arm-thumb closed chain.

    Its step runs in the virtual machine if the finger step is Ipopt's.
    """

    def __init__(
        self, robot: RobotDescription, options: QiuParameters, compiled: bool = True
    ) -> None:
        """Lay out the step; the budget is the paper's."""
        super().__init__(robot, options, compiled)
        self.name = f"enhanced-{options.steps}"
        self.step = EnhancedStep(robot, options)
        self.max_iterations = options.max_iterations

    def phase_counts(self, states: Array, iterations: Counts) -> Mapping[Phase, Counts]:
        """What is not thumb reaching is hand alignment."""
        reached = states[:, self.step.state.slice("reached").start].astype(iterations.dtype)
        return {Phase.THUMB_REACHING: reached, Phase.HAND_ALIGNMENT: iterations - reached}

    @property
    def jacobians(self) -> Mapping[str, RecordedJacobian]:
        """Those of thumb, palm and closed chain."""
        return self.step.jacobians


class OriginalMethod(_QiuMethod[OriginalStep]):
    """`original-*`: all contacts in one hierarchy, what the paper compares with."""

    def __init__(
        self, robot: RobotDescription, options: OriginalParameters, compiled: bool = True
    ) -> None:
        """Lay out the step; the budget is the paper's."""
        super().__init__(robot, options, compiled)
        self.name = f"original-{options.steps}"
        self.step = OriginalStep(robot, options)
        self.max_iterations = options.max_iterations

    def phase_counts(self, states: Array, iterations: Counts) -> Mapping[Phase, Counts]:
        """There is but one phase."""
        del states
        return {Phase.HIERARCHY: iterations.copy()}
