"""Graphs of the stages of hand-first for a multi-arm robot: arm-hands on a common trunk.

Each hand is fitted independently, as if it were floating, which determines a palm pose for each
side. The arms are then placed in closed form at the current trunk. Where some arm cannot follow,
trunk and arms move together in damped steps that keep the palm poses. multi_arm.c chooses the next
stage.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import casadi as ca

from casadi_ik.compile.graphs import FunctionGraph
from casadi_ik.compile.layout import Layout
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.family import ArmFamily
from casadi_ik.kinematics.arms.recognise import arm_family
from casadi_ik.kinematics.arms.search import ARM_SEARCH, ArmTrials, Farthest
from casadi_ik.kinematics.box_qp import BoxBounds, clip, damped_step
from casadi_ik.kinematics.contact_fit import (
    FIT,
    TrialStep,
    evaluate_contact_step,
    evaluate_excess_step,
    evaluate_step,
    initial_lm_state,
)
from casadi_ik.kinematics.contacts import LENGTH, Kinds
from casadi_ik.kinematics.forward import ActuatedKinematics, Pose, actuated
from casadi_ik.kinematics.palm import base_rotation, best_palm, hand_contacts, newton_polish
from casadi_ik.kinematics.smooth import Expr, call_function, hoisted_call_function, with_cse
from casadi_ik.model.description import RobotDescription
from casadi_ik.solve.hand_first.parameters import STAGE_PARAMETERS, TRUNK_PARAMETERS
from casadi_ik.solve.hand_first.state import SIDE_OFFSET, HandFirstLayouts, Stage, with_rows
from casadi_ik.solve.hand_first.step import HandFirstStep, PalmAndHand, fit_results, fit_step
from casadi_ik.solve.status import Phase


class SideStage(NamedTuple):
    """A stage of a side after the first side.

    Attributes:
        name: Name of its graph in multi_arm.c.
        code: Code of the stage in the state.
    """

    name: str
    code: int


@dataclass(frozen=True, eq=False)
class ArmHandSide:
    """Arm-hand that is a side of a multi-arm robot.

    Attributes:
        index: Index of the side.
        layouts: Layouts of the side as a robot.
        family: Closed form of its arm; None: the arm is moved by damped steps.
        motors: Indices in q of all its motors, in the order of the side's own q.
        arm: Indices in q of the motors of its arm.
        hand: Indices in q of the motors of its hand.
        fingers: Indices of its fingers.
        arms: Slice of its arm among the motors of all arms.
        hands: Slice of its hand among the motors of all hands.
        base: (3, 3) rotation of the robot's base, see `palm.base_rotation`.
    """

    index: int
    layouts: HandFirstLayouts
    family: ArmFamily | None
    motors: list[int]
    arm: tuple[int, ...]
    hand: tuple[int, ...]
    fingers: list[int]
    arms: slice
    hands: slice
    base: Array

    @property
    def robot(self) -> RobotDescription:
        """The side as a robot."""
        return self.layouts.robot

    @cached_property
    def _parameters(self) -> Layout:
        """Layout of the side's parameters without the postures."""
        fields = self.layouts.parameters.fields
        return Layout(tuple(field for field in fields if field.name != "postures"))

    # The following functions depend on quantities of the side only. They are equal for mirrored
    # sides, whose code is then emitted once (compile/emitter.py).

    def best_palm(self, hand: Expr, p: dict[str, Expr], number: Expr) -> tuple[Expr, Expr]:
        """Return rotation and origin of the best palm pose of a hand, see `palm.best_palm`."""
        parameters, number_symbol = self._parameters.symbols("own"), ca.SX.sym("turn")
        hand_symbol = ca.SX.sym("hand", hand.numel())
        contacts = hand_contacts(self.robot, hand_symbol, self.robot.hand_actuators)
        unpacked = self._parameters.unpack(parameters)
        pose = best_palm(contacts, self.layouts.contacts, unpacked, number_symbol, self.base)
        function = call_function("best_palm", [hand_symbol, parameters, number_symbol], pose)
        return function(hand, self._parameters.pack(p), number)

    def fit(
        self, x: PalmAndHand, damping: Expr, p: dict[str, Expr], q: Expr, tolerant: bool
    ) -> TrialStep:
        """Make one damped step of palm and hand, see `fit_step`."""
        parameters, damping_symbol = self._parameters.symbols("own"), ca.SX.sym("damping")
        symbol = PalmAndHand(
            ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3), ca.SX.sym("h", x.hand.numel())
        )
        q_symbol = ca.SX.sym("q", q.numel())
        unpacked = self._parameters.unpack(parameters)
        step = fit_step(
            *(self.layouts, None, symbol, damping_symbol, unpacked, q_symbol),
            [parameters],
            tolerant,
        )
        numbers = step.residual_before, step.residual, step.predicted_decrease, step.max_change
        inputs = [*symbol, damping_symbol, parameters, q_symbol]
        function = call_function("fitted", inputs, [*step.x, *numbers])
        *next_x, residual_before, residual, decrease, max_change = function(
            *x, damping, self._parameters.pack(p), q
        )
        return TrialStep(PalmAndHand(*next_x), residual_before, residual, decrease, max_change)

    def parameters(self, p: dict[str, Expr]) -> dict[str, Expr]:
        """Return the side's parameters from those of the robot."""
        contacts = {field.name for field in self.layouts.contacts.fields}
        by_finger = contacts | {"position_tolerance", "angle_tolerance"}
        selected = {
            name: p[name][self.fingers, :] if name in by_finger else p[name]
            for name in self._parameters.names
        }
        return selected | {name: p[name][self.motors] for name in ("lower", "upper", "start")}

    def has_contact(self, p: dict[str, Expr]) -> Expr:
        """Return 1 if one of its fingers has a contact."""
        return ca.mmax(p["weights"][self.fingers, 0]) > 0

    def palm(self, kinematics: ActuatedKinematics) -> Pose:
        """Return the pose of its palm, base frame."""
        robot = self.robot
        return kinematics.kinematics.links[robot.palm_link].compose(robot.palm_placement)


def arm_hand_sides(robot: RobotDescription, candidates: int, kinds: Kinds) -> list[ArmHandSide]:
    """Return the sides of a multi-arm robot.

    Args:
        robot: Description of the robot.
        candidates: Maximum number of hand postures of a restart.
        kinds: Kinds of the contacts, by finger.
    """
    sides: list[ArmHandSide] = []
    first_arm = first_hand = 0
    base = base_rotation(robot)
    for index, (side, (arm, hand)) in enumerate(
        zip(robot.sides, robot.side_actuators, strict=True)
    ):
        side_robot = robot.side(side.name)
        fingers = [robot.finger_names.index(finger) for finger in side.fingers]
        layouts = HandFirstLayouts(side_robot, candidates, tuple(kinds[i] for i in fingers))
        sides.append(
            ArmHandSide(
                *(index, layouts, arm_family(side_robot)),
                *(sorted((*arm, *hand)), arm, hand, fingers),
                slice(first_arm, first_arm + len(arm)),
                slice(first_hand, first_hand + len(hand)),
                base,
            )
        )
        first_arm, first_hand = first_arm + len(arm), first_hand + len(hand)
    return sides


class MultiArmStep(HandFirstStep):
    """Graphs of the stages for a multi-arm robot.

    Attributes:
        sides: Its arm-hands.
    """

    def __init__(self, robot: RobotDescription, candidates: int, kinds: Kinds) -> None:
        """Store the arguments; graphs are built when first needed. See `HandFirstStep`."""
        super().__init__(robot, None, candidates, kinds)
        self.sides = arm_hand_sides(robot, candidates, kinds)

    @cached_property
    def stages(self) -> dict[Stage | SideStage, Callable[[], ca.Function]]:
        """Factories of the graphs of all stages of the robot."""
        factories: dict[Stage | SideStage, Callable[[], ca.Function]] = {
            Stage.START: self._start,
            Stage.REFINEMENT: self._refinement,
            Stage.TOLERANT_REFINEMENT: self._tolerant_refinement,
            Stage.BALANCE: self._balance,
            Stage.ARM_PLACEMENT: self._all_arms,
            Stage.TRUNK: self._trunk,
        }
        for side in self.sides:
            for stage, build in (
                (Stage.CANDIDATE, self._side_candidate),
                (Stage.HAND_FIT, self._side_fit),
                (Stage.TOLERANT_HAND_FIT, partial(self._side_fit, tolerant=True)),
            ):
                key: Stage | SideStage = stage
                if side.index:
                    code = stage + SIDE_OFFSET * side.index
                    key = SideStage(f"{stage.name}_{side.index}", code)
                factories[key] = partial(build, key, side)
        return factories

    def _side_candidate(self, stage: Stage | SideStage, side: ArmHandSide) -> ca.Function:
        """Build the best palm pose of a hand posture of a side."""
        inputs, s, p = self._vectors()
        hands = ca.SX.sym("hand", len(self.layouts.robot.hand_actuators))
        hand = hands[side.hands]
        number = ca.fmax(s["candidate"] + s["candidates_before"], 0.0) + s["palm_number"]
        rotation, origin = side.best_palm(hand, side.parameters(p), number)
        previous_q = s["q"] if side.index else p["start"]
        q = with_rows(previous_q, side.hand, hand)
        changes = {
            "q": q,
            "palm_rotation": rotation,
            "palm_origin": origin,
            "cost": 0.0,
        } | initial_lm_state()
        record = self.layouts.row(s, p, q, Phase.CANDIDATE)
        results = {"is_idle": ca.logic_not(side.has_contact(p))}
        return self._function(stage, [*inputs, hands], s, changes, results, record)

    def _side_fit(
        self, stage: Stage | SideStage, side: ArmHandSide, tolerant: bool = False
    ) -> ca.Function:
        """Build one damped step of the palm and the hand of a side."""
        inputs, s, p = self._vectors()
        side_p, rows = side.parameters(p), side.layouts.contacts
        hand = list(side.robot.hand_actuators)
        q = s["q"][side.motors]
        x = PalmAndHand(s["palm_rotation"], s["palm_origin"], q[hand])
        trial = side.fit(x, s["damping"], side_p, q, tolerant)
        fraction = STAGE_PARAMETERS.fit_fraction
        if tolerant:
            outcome = evaluate_excess_step(s, side_p, trial, rows, fraction)
        else:
            tight = STAGE_PARAMETERS.tight_fit_fraction
            outcome = evaluate_contact_step(s, side_p, trial, rows, fraction, tight)
        accepted, next_x = outcome.accepted, trial.x
        changes = {
            "q": with_rows(s["q"], side.hand, ca.if_else(accepted, next_x.hand, x.hand)),
            "palm_rotation": ca.if_else(accepted, next_x.rotation, x.rotation),
            "palm_origin": ca.if_else(accepted, next_x.origin, x.origin),
            "meets_contacts": outcome.within,
        } | outcome.lm_state
        is_of_side = ca.DM.zeros(len(self.robot.fingers), 2)
        is_of_side[side.fingers, :] = 1
        record_p = p | {"weights": p["weights"] * is_of_side}
        padded = replace(trial, residual_before=self._padded(side, trial.residual_before))
        record = self.layouts.row(s, record_p, s["q"], Phase.HAND_FIT, padded, accepted)
        results = fit_results(trial, outcome, side_p)
        return self._function(stage, inputs, s, changes, results, record)

    def _padded(self, side: ArmHandSide, residual: Expr) -> Expr:
        """Return the residual of a side with zeros for all other fingers."""
        contacts = self.layouts.contacts
        count, padded = len(side.fingers), ca.SX.zeros(contacts.size)
        for i, rows in enumerate(side.layouts.contacts.slices):
            aspect, finger = divmod(i, count)
            contact = aspect * len(self.robot.fingers) + side.fingers[finger]
            padded[contacts.slices[contact]] = residual[rows]
        return padded

    def _all_arms(self) -> ca.Function:
        """Build a trial of arms of all sides for their palm poses, at the trunk of q."""
        inputs, s, p = self._vectors(ca.MX)
        palms = self._palms_from_trunk()(*inputs)
        visit = s["candidate"] + s["candidates_before"] + s["trunk_trials"]
        arms: list[Expr] = []
        for side, pose in zip(self.sides, zip(palms[::2], palms[1::2], strict=True), strict=True):
            columns = list(side.arm)
            bounds = p["lower"][columns], p["upper"][columns]
            if side.family is None:
                arms += [s["q"][columns], ca.MX(ARM_SEARCH.outside), ca.MX(0), ca.MX(0)]
                continue
            search = ArmTrials(side.family, Farthest())
            best = s["arm_best"][side.arms], s["arm_redundancy"][side.index]
            trial = s["stage_iterations"]
            arm, margin, redundancy = search.trial(Pose(*pose), bounds, trial, best, visit)
            is_exact: Expr = margin >= ARM_SEARCH.tolerance
            if not side.family.is_exact:
                polish = newton_polish(side.robot, side.family.model_error)
                limits = (p[name][side.motors] for name in ("lower", "upper"))
                arm, is_exact = polish(arm, *pose, *limits)
            arms += [arm, margin, redundancy, is_exact]
        outputs = self._best_arms()(*inputs, *arms)
        return ca.Function("arm_placement", inputs, list(outputs))

    def _palms_from_trunk(self) -> ca.Function:
        """Return (state, parameters) -> rotation and origin of each palm in the trunk frame."""
        inputs, s, _ = self._vectors()
        trunk = actuated(self.robot, s["q"]).kinematics.links[self.robot.trunk_link]
        poses = []
        for side in self.sides:
            rotation, origin = self._palm_pose(s, side)
            poses += [trunk.rotation.T @ rotation, trunk.inverse_apply(origin)]
        return ca.Function("seen", inputs, with_cse(*map(ca.densify, poses)))

    def palms(self) -> FunctionGraph:
        """Return the graph of the palm poses of a configuration.

        Returns:
            q (n, 1) -> rotation, row by row, and origin of each palm in the base frame, (12 s, 1);
            poses in the trunk frame as the rows of (4, 4) matrices, (16 s, 1).
        """
        q = ca.SX.sym("q", len(self.robot.actuators))
        kinematics = actuated(self.robot, q)
        trunk = kinematics.kinematics.links[self.robot.trunk_link]
        in_base: list[Expr] = []
        in_trunk: list[Expr] = []
        for side in self.sides:
            pose = side.palm(kinematics)
            in_base += [ca.vec(pose.rotation.T), pose.origin]
            matrix = ca.horzcat(trunk.rotation.T @ pose.rotation, trunk.inverse_apply(pose.origin))
            in_trunk += [ca.vec(matrix.T), ca.SX([0.0, 0.0, 0.0, 1.0])]
        outputs = with_cse(*(ca.densify(ca.vertcat(*poses)) for poses in (in_base, in_trunk)))
        return FunctionGraph.from_function(ca.Function("palms", [q], outputs))

    def _palm_pose(self, s: dict[str, Expr], side: ArmHandSide) -> tuple[Expr, Expr]:
        return s[f"palm_rotation_{side.index}"], s[f"palm_origin_{side.index}"]

    def _best_arms(self) -> ca.Function:
        """Build the update of the best arm of each side."""
        inputs, s, p = self._vectors()
        trial_inputs: list[Expr] = []
        arms: list[Expr] = []
        margins: list[Expr] = []
        redundancies: list[Expr] = []
        are_exact = ca.SX(1)
        q = s["q"]
        for side in self.sides:
            arm = ca.SX.sym("arm", len(side.arm))
            score, redundancy, is_exact = (ca.SX.sym(name) for name in ("score", "swivel", "hits"))
            trial_inputs += [arm, score, redundancy, is_exact]
            has_contact, previous_margin = side.has_contact(p), s["arm_margin"][side.index]
            # A margin >= 0 means that the arm meets the palm pose.
            score = ca.if_else(
                is_exact, ca.fmax(score, 0.0), ca.fmin(score, -TRUNK_PARAMETERS.miss_margin)
            )
            is_better = score > previous_margin
            margins.append(ca.fmax(score, previous_margin))
            redundancies.append(ca.if_else(is_better, redundancy, s["arm_redundancy"][side.index]))
            best = ca.if_else(is_better, arm, s["arm_best"][side.arms])
            best = ca.if_else(has_contact, best, q[list(side.arm)])
            arms.append(best)
            is_placed = ca.logic_or(margins[-1] >= 0, ca.logic_not(has_contact))
            are_exact = ca.logic_and(are_exact, is_placed)
            q = with_rows(q, side.arm, best)
        q = ca.fmin(ca.fmax(q, p["lower"]), p["upper"])
        changes = {
            "stage_iterations": s["stage_iterations"] + 1,
            "arm_margin": ca.vertcat(*margins),
            "arm_best": ca.vertcat(*arms),
            "arm_redundancy": ca.vertcat(*redundancies),
        }
        margin = ca.mmin(ca.vertcat(*margins))
        record = self.layouts.row(s, p, q, Phase.ARM_PLACEMENT, margin=margin)
        results = {"arm_is_exact": are_exact}
        all_inputs = [*inputs, *trial_inputs]
        return self._function(Stage.ARM_PLACEMENT, all_inputs, s, changes, results, record)

    @property
    def _carrying(self) -> list[int]:
        """Indices in q of the motors that carry the palms: trunk, then arms."""
        return [*self.robot.trunk_actuators, *self.layouts.arm]

    def _trunk(self) -> ca.Function:
        """Build one damped step of trunk and arms towards the palm poses."""
        inputs, s, p = self._vectors()
        rows, palm_errors = self._carrying, self._palm_errors(s, p, inputs)
        # If the preference is q0, the trunk moves less than the arms.
        unit = ca.if_else(p["nearest"], TRUNK_PARAMETERS.trunk_unit, 1.0)
        units = ca.vertcat(
            ca.repmat(unit, len(self.robot.trunk), 1), ca.SX.ones(len(self.layouts.arm), 1)
        )
        value, lower, upper = (x[rows] / units for x in (s["q"], p["lower"], p["upper"]))
        bounds = BoxBounds(value, lower, upper, first=0)
        residual_before, jacobian, reduced_residual = palm_errors(s["q"])
        jacobian = jacobian @ ca.diag(units)
        damped = damped_step(jacobian, reduced_residual, s["damping"], bounds, FIT.passes)
        q = with_rows(s["q"], rows, units * clip(value + damped.step, bounds))
        residual = palm_errors(q)[0]
        max_change = ca.mmax(ca.fabs(q - s["q"]))
        trial = TrialStep(q, residual_before, residual, damped.predicted_decrease, max_change)
        outcome = evaluate_step(
            *(s, trial, ca.SX(0), ca.SX(0)), TRUNK_PARAMETERS.patience, TRUNK_PARAMETERS.budget
        )
        changes = {"q": ca.if_else(outcome.accepted, q, s["q"])} | outcome.lm_state
        results = {"is_settled": outcome.settled, "cost": outcome.cost}
        record = self.layouts.row(s, p, s["q"], Phase.TRUNK, margin=-ca.sqrt(outcome.cost))
        return self._function(Stage.TRUNK, inputs, s, changes, results, record)

    def _palm_errors(
        self, s: dict[str, Expr], p: dict[str, Expr], symbols: list[Expr]
    ) -> Callable[[Expr], Any]:
        """Return a function of q with the errors of the palm poses.

        Args:
            s: State.
            p: Parameters.
            symbols: Symbols on which state and parameters depend.

        Returns:
            q -> residual with twelve rows a side (differences of origins / `LENGTH` and of
            rotations); Jacobian over trunk and arms and residual with six rows a side and the same
            normal equations, because the three columns of a rotation rotate like one vector.
        """
        q = ca.SX.sym("q", s["q"].numel())
        kinematics = actuated(self.robot, q)
        residual: list[Expr] = []
        jacobian: list[Expr] = []
        reduced_residual: list[Expr] = []
        for side in self.sides:
            has_contact, palm = side.has_contact(p), side.palm(kinematics)
            rotation, origin = self._palm_pose(s, side)
            shift = has_contact * (palm.origin - origin) / LENGTH
            residual += [shift, has_contact * ca.vec(palm.rotation - rotation)]
            rates = kinematics.twist(side.robot.palm_link, palm.origin, self._carrying)
            linear, angular = map(ca.sparsify, rates)
            crossed = sum(
                (ca.cross(palm.rotation[:, i], rotation[:, i]) for i in range(3)), ca.SX.zeros(3, 1)
            )
            scale = 2**0.5
            jacobian += [has_contact * linear / LENGTH, has_contact * scale * angular]
            reduced_residual += [shift, -has_contact * crossed / scale]
        outputs = (ca.vertcat(*rows) for rows in (residual, jacobian, reduced_residual))
        return hoisted_call_function("palms_off", [q], symbols, list(outputs))
