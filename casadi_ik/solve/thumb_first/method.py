"""The thumb-first method: palm estimates from a table of postures, then one compiled loop."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np

from casadi_ik.compile import StepGraph
from casadi_ik.files.arrays import Array, Counts
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.arms.recognise import arm_family
from casadi_ik.kinematics.contacts import Kinds, point_normal_kinds, target_values
from casadi_ik.kinematics.posture_table import PostureTable
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.looped_method import LoopedMethod, Start
from casadi_ik.solve.status import Phase
from casadi_ik.solve.thumb_first.step import STAGES, ThumbFirstParameters, ThumbFirstStep

NEAREST = "q0"
"""The preference for what is near the start."""


class ThumbFirstMethod(LoopedMethod):
    """`thumb-first`: the arm starts at the estimated palm, then the closed chain does the rest.

    Attributes:
        step: Its step for this robot; in the virtual machine if it is ProxQP's.
        preferences: What it can prefer.
    """

    name = "thumb-first"
    preferences: tuple[str, ...] = ("limits", NEAREST)
    follows_closed_chain = True
    takes_free_contacts = True
    takes_fixed_actuators = True

    def __init__(
        self,
        robot: RobotDescription,
        options: ThumbFirstParameters,
        compiled: bool = True,
        kinds: Kinds | None = None,
    ) -> None:
        """Recognise the arm and lay out the step; point and normal if no kinds are given."""
        super().__init__(robot, options, compiled)
        robot.one_hand(self.name)
        self.options: ThumbFirstParameters = options
        self._kinds = kinds or point_normal_kinds(len(robot.fingers))
        self.step = ThumbFirstStep(robot, options, self._kinds, arm_family(robot))

    def step_graph(self) -> StepGraph:
        """The whole iteration."""
        return self.step.graph()

    @cached_property
    def table(self) -> PostureTable:
        """The hand postures that targets are compared with."""
        robot, options = ArmHand(self.robot), self.options
        return PostureTable(
            robot,
            self.robot.hand_actuators,
            options.table,
            pull=options.pull,
            compiled=self._compiled,
        )

    def for_kinds(self, kinds: Kinds) -> ThumbFirstMethod:
        """The same for contacts of other kinds."""
        if kinds == self._kinds:
            return self
        return ThumbFirstMethod(self.robot, self.options, self._compiled, kinds)

    def prepare(self) -> None:
        """Build and compile the loop, and fill the table."""
        _ = self.kernel, self.table

    def begin(self, targets: TargetBatch, q0: Array) -> Start:
        """Start where the robot is, if its nearest is wanted, and from estimates of the palm."""
        count, step, most = len(targets), self.step, self.options.starts
        lower, upper = targets.bounds(self.robot)
        hand = list(self.robot.hand_actuators)
        here = np.clip(q0, lower, upper)
        nearest = targets.prefer == NEAREST
        found = self._hands(targets, here[:, hand], nearest, most)[:, :most]
        postures = np.zeros((count, most, len(hand)))
        postures[:, : found.shape[1]] = found
        known = [~np.isnan(array[..., 0]) for array in (targets.points, targets.normals)]
        values = {
            **target_values(targets),
            **{
                f"{name}s": np.nan_to_num(targets.vectors(f"{name}s"))
                for name in self.step.contacts.data
            },
            "weights": np.stack(known, axis=2),
            "lower": lower,
            "upper": upper,
            "postures": np.clip(postures, lower[hand], upper[hand]),
            "given": found.shape[1],
            "here": here,
            "nearest": float(nearest),
            "first_damping": self.options.damping,
            "step_cap": self.options.step_cap,
        }
        parameters = step.parameters.pack_rows(values, count)
        first = {item.name: np.zeros(item.shape) for item in step.state} | {
            "q": here if nearest else q0,
            "passed": -1.0,
            "phase": Phase.HAND_ALIGNMENT if nearest else Phase.CANDIDATE,
            "start": -float(nearest),
            "damping": self.options.damping,
            "best_q": q0,
            "best_cost": np.finfo(float).max,
        }
        return step.state.pack_rows(first, count), parameters

    def _hands(self, targets: TargetBatch, own: Array, nearest: bool, count: int) -> Array:
        """Hands (k, c, hand) to begin with: of those that look alike, the nearest is first.

        Args:
            targets: k targets.
            own: (k, hand) the robot's own.
            nearest: Whether what is near to that is wanted, not what is near to its home.
            count: How many of the table.
        """
        wanted = targets.points, targets.normals
        home = np.tile(self._home, (len(own), 1))
        if not nearest:
            return self.table.nearest(*wanted, count, home)
        found = self.table.nearest(*wanted, 1, own)
        if count > 1:
            # What is near was a dead end: from here on as if nothing was preferred.
            found = np.concatenate([found, self.table.nearest(*wanted, count, home)], axis=1)
        # A hand without an arm has begun there already.
        if not self.robot.arm_actuators:
            return found
        return np.concatenate([own[:, None], found], axis=1)

    @cached_property
    def _home(self) -> Array:
        return ArmHand(self.robot).home[list(self.robot.hand_actuators)]

    def phase_counts(self, states: Array, iterations: Counts) -> Mapping[Phase, Counts]:
        """The step counts them."""
        del iterations
        counts = states[:, self.step.state.slice("counts")].astype(np.int64)
        return {stage: counts[:, i] for i, stage in enumerate(STAGES)}

    def restarts(self, states: Array) -> Counts:
        """Palm estimates begun from but the first."""
        start = states[:, self.step.state.slice("start").start].astype(np.int64)
        return np.clip(start, 0, self.options.starts - 1)
