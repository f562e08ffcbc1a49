"""The method `thumb-first`: palm estimates from a table of postures, then one compiled loop."""

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
from casadi_ik.model.targets import Q0, TargetBatch
from casadi_ik.solve.looped_method import LoopedMethod, Start
from casadi_ik.solve.status import Phase
from casadi_ik.solve.thumb_first.state import THUMB_FIRST_STAGES, ThumbFirstParameters
from casadi_ik.solve.thumb_first.step import ThumbFirstStep


class ThumbFirstMethod(LoopedMethod):
    """`thumb-first`: the arm starts at the estimated palm pose and moves along the closed chain.

    Attributes:
        step: Step of this robot; runs in the virtual machine if it uses ProxQP.
        preferences: Names of the supported preferences.
    """

    name = "thumb-first"
    preferences: tuple[str, ...] = ("limits", Q0)
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
        """Recognise the family of the arm and lay out the step.

        Args:
            robot: Description of the robot.
            options: Parameters of the method.
            compiled: False to run the step in CasADi's virtual machine.
            kinds: Kind of contact of each finger (default: point and normal).
        """
        super().__init__(robot, options, compiled)
        robot.require_single_hand(self.name)
        self.options: ThumbFirstParameters = options
        self._kinds = kinds or point_normal_kinds(len(robot.fingers))
        self.step = ThumbFirstStep(robot, options, self._kinds, arm_family(robot))

    def step_graph(self) -> StepGraph:
        """Return the graph of an iteration."""
        return self.step.graph()

    @cached_property
    def table(self) -> PostureTable:
        """Table of hand postures for palm estimates."""
        robot, options = ArmHand(self.robot), self.options
        return PostureTable(
            robot,
            self.robot.hand_actuators,
            options.table,
            pull=options.pull,
            compiled=self._compiled,
        )

    def for_kinds(self, kinds: Kinds) -> ThumbFirstMethod:
        """Return this method for contacts of other kinds."""
        if kinds == self._kinds:
            return self
        return ThumbFirstMethod(self.robot, self.options, self._compiled, kinds)

    def prepare(self) -> None:
        """Build and compile the loop, and compute the table."""
        _ = self.kernel, self.table

    def begin(self, targets: TargetBatch) -> Start:
        """Return initial states: q0 if it is preferred, then palm estimates."""
        q0, prefers_q0 = targets.starts(self.robot), targets.prefers_q0
        count, step, max_starts = len(targets), self.step, self.options.starts
        lower, upper = targets.bounds(self.robot)
        hand = list(self.robot.hand_actuators)
        current = np.clip(q0, lower, upper)
        hands = self._hands(targets, current[:, hand], prefers_q0, max_starts)[:, :max_starts]
        postures = np.zeros((count, max_starts, len(hand)))
        postures[:, : hands.shape[1]] = hands
        is_constrained = [~np.isnan(array[..., 0]) for array in (targets.points, targets.normals)]
        values = {
            **target_values(targets),
            **{
                f"{name}s": np.nan_to_num(targets.vectors(f"{name}s"))
                for name in self.step.contacts.data
            },
            "weights": np.stack(is_constrained, axis=2),
            "lower": lower,
            "upper": upper,
            "postures": np.clip(postures, lower[hand], upper[hand]),
            "n_postures": hands.shape[1],
            "start_q": current,
            "prefers_q0": float(prefers_q0),
            "first_damping": self.options.damping,
            "step_cap": self.options.step_cap,
        }
        parameters = step.parameters.pack_rows(values, count)
        initial_state = {item.name: np.zeros(item.shape) for item in step.state} | {
            "q": current if prefers_q0 else q0,
            "last_start_distance": -1.0,
            "phase": Phase.HAND_ALIGNMENT if prefers_q0 else Phase.CANDIDATE,
            "start": -float(prefers_q0),
            "damping": self.options.damping,
            "best_q": q0,
            "best_cost": np.finfo(float).max,
        }
        return step.state.pack_rows(initial_state, count), parameters

    def _hands(self, targets: TargetBatch, current: Array, prefers_q0: bool, count: int) -> Array:
        """Return hand postures (k, c, hand) to start from, nearest first among similar shapes.

        Args:
            targets: k targets.
            current: (k, hand) hand posture of q0.
            prefers_q0: True to prefer postures near q0, False for postures near home.
            count: Number of postures from the table.
        """
        contacts = targets.points, targets.normals
        home = np.tile(self._home, (len(current), 1))
        if not prefers_q0:
            return self.table.nearest(*contacts, count, home)
        hands = self.table.nearest(*contacts, 1, current)
        if count > 1:
            # If the posture near q0 fails, continue without the preference.
            hands = np.concatenate([hands, self.table.nearest(*contacts, count, home)], axis=1)
        # A hand without an arm has already started at the current posture.
        if not self.robot.arm_actuators:
            return hands
        return np.concatenate([current[:, None], hands], axis=1)

    @cached_property
    def _home(self) -> Array:
        return ArmHand(self.robot).home[list(self.robot.hand_actuators)]

    def phase_counts(self, states: Array, iterations: Counts) -> Mapping[Phase, Counts]:
        """Return the iterations by phase, which the step counts."""
        del iterations
        counts = states[:, self.step.state.slice("counts")].astype(np.int64)
        return {stage: counts[:, i] for i, stage in enumerate(THUMB_FIRST_STAGES)}

    def restarts(self, states: Array) -> Counts:
        """Return the number of palm estimates after the first."""
        start = states[:, self.step.state.slice("start").start].astype(np.int64)
        return np.clip(start, 0, self.options.starts - 1)
