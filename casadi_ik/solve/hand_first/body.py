"""The stages of hand-first for a body: arm-hands on a common trunk.

Every hand is fitted by itself, as if it could fly: that fixes a palm pose each. Then the arms are
placed in closed form at a trunk, and where they cannot all follow, trunk and arms move together in
damped steps that keep the palms. Which of them comes when stands in iteration.c.
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
    tolerance_ratio,
)
from casadi_ik.kinematics.contacts import LENGTH, Kinds
from casadi_ik.kinematics.forward import ActuatedKinematics, Pose, actuated
from casadi_ik.kinematics.palm import base_rotation, best_palm, hand_contacts, newton_polish
from casadi_ik.kinematics.smooth import Expr, call_function, hoisted_call_function, with_cse
from casadi_ik.model.description import RobotDescription
from casadi_ik.solve.hand_first.parameters import BODY, STAGES
from casadi_ik.solve.hand_first.state import BY_SIDE, HandFirstLayouts, Stage, with_rows
from casadi_ik.solve.hand_first.step import HandFirstStep, PalmAndHand, fit_step
from casadi_ik.solve.status import Phase


class SideStage(NamedTuple):
    """A stage of a side after the first one.

    Attributes:
        name: What iteration.c calls its function.
        code: The stage's number in a state.
    """

    name: str
    code: int


@dataclass(frozen=True, eq=False)
class BodySide:
    """An arm-hand of a body.

    Attributes:
        place: Its number.
        layouts: Of it as a robot by itself.
        family: Of its arm, or None: then it is searched.
        motors: Positions in q of all its motors, in the order of its own q.
        arm: Positions in q of its arm's motors.
        hand: Positions in q of its hand's motors.
        fingers: Numbers of its fingers.
        arms: Where its arm is among the motors of all arms.
        hands: Where its hand is among the motors of all hands.
        base: (3, 3) rotation of the body's base, see `palm.base_rotation`.
    """

    place: int
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
        """The side as a robot by itself."""
        return self.layouts.robot

    @cached_property
    def _own(self) -> Layout:
        """Of its parameters."""
        fields = self.layouts.parameters.fields
        return Layout(tuple(field for field in fields if field.name != "postures"))

    # What follows are functions of what is the side's alone: of a left and a right side they are
    # alike, so that their code stands once (compile/emitter.py).

    def best_palm(self, hand: Expr, own: dict[str, Expr], number: Expr) -> tuple[Expr, Expr]:
        """Return rotation and origin of the palm that suits a hand best, see `palm.best_palm`."""
        given, turn = self._own.symbols("own"), ca.SX.sym("turn")
        at = ca.SX.sym("hand", hand.numel())
        contacts = hand_contacts(self.robot, at, self.robot.hand_actuators)
        found = best_palm(contacts, self.layouts.contacts, self._own.unpack(given), turn, self.base)
        return call_function("best_palm", [at, given, turn], found)(
            hand, self._own.pack(own), number
        )

    def fitted(
        self, x: PalmAndHand, damping: Expr, own: dict[str, Expr], q: Expr, tolerant: bool
    ) -> TrialStep:
        """Make one damped step of palm and hand, see `fit_step`."""
        given, around = self._own.symbols("own"), ca.SX.sym("damping")
        there = PalmAndHand(ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3), ca.SX.sym("h", x.hand.numel()))
        at = ca.SX.sym("q", q.numel())
        parameters = self._own.unpack(given)
        step = fit_step(self.layouts, None, there, around, parameters, at, [given], tolerant)
        rest = step.residual_before, step.residual, step.predicted_decrease, step.max_change
        whole = call_function("fitted", [*there, around, given, at], [*step.x, *rest])
        *reached, before, left, promised, size = whole(*x, damping, self._own.pack(own), q)
        return TrialStep(PalmAndHand(*reached), before, left, promised, size)

    def parameters(self, p: dict[str, Expr]) -> dict[str, Expr]:
        """The part of a body's parameters that is the side's."""
        contacts = {field.name for field in self.layouts.contacts.fields}
        by_finger = contacts | {"position_tolerance", "angle_tolerance"}
        found = {
            name: p[name][self.fingers, :] if name in by_finger else p[name]
            for name in self._own.names
        }
        return found | {name: p[name][self.motors] for name in ("lower", "upper", "start")}

    def asked(self, p: dict[str, Expr]) -> Expr:
        """1 if one of its fingers has a contact."""
        return ca.mmax(p["weights"][self.fingers, 0]) > 0

    def palm(self, body: ActuatedKinematics) -> Pose:
        """The pose of its palm, base frame."""
        robot = self.robot
        return body.kinematics.links[robot.palm_link].at(robot.palm_placement)


def body_sides(robot: RobotDescription, candidates: int, kinds: Kinds) -> list[BodySide]:
    """The sides of a body.

    Args:
        robot: The description.
        candidates: Hand postures a solve may start from.
        kinds: Of the contacts, by finger.
    """
    found: list[BodySide] = []
    arms = hands = 0
    base = base_rotation(robot)
    for place, (side, (arm, hand)) in enumerate(
        zip(robot.sides, robot.side_actuators, strict=True)
    ):
        alone = robot.side(side.name)
        fingers = [robot.finger_names.index(finger) for finger in side.fingers]
        layouts = HandFirstLayouts(alone, candidates, tuple(kinds[i] for i in fingers))
        found.append(
            BodySide(
                *(place, layouts, arm_family(alone)),
                *(sorted((*arm, *hand)), arm, hand, fingers),
                slice(arms, arms + len(arm)),
                slice(hands, hands + len(hand)),
                base,
            )
        )
        arms, hands = arms + len(arm), hands + len(hand)
    return found


class BodyStep(HandFirstStep):
    """The stages' functions for a body."""

    def __init__(self, robot: RobotDescription, candidates: int, kinds: Kinds) -> None:
        """Remember what the functions are made of; see `HandFirstStep`."""
        super().__init__(robot, None, candidates, kinds)
        self.sides = body_sides(robot, candidates, kinds)

    @cached_property
    def stages(self) -> dict[Stage | SideStage, Callable[[], ca.Function]]:
        """What builds the functions of the stages that solves of the body may be in."""
        found: dict[Stage | SideStage, Callable[[], ca.Function]] = {
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
                if side.place:
                    code = stage + BY_SIDE * side.place
                    key = SideStage(f"{stage.name}_{side.place}", code)
                found[key] = partial(build, key, side)
        return found

    def _side_candidate(self, stage: Stage | SideStage, side: BodySide) -> ca.Function:
        inputs, s, p = self._vectors()
        hands = ca.SX.sym("hand", len(self.layouts.robot.hand_actuators))
        hand = hands[side.hands]
        number = ca.fmax(s["candidate"] + s["earlier"], 0.0) + s["turn"]
        rotation, origin = side.best_palm(hand, side.parameters(p), number)
        before = s["q"] if side.place else p["start"]
        q = with_rows(before, side.hand, hand)
        changed = {
            "q": q,
            "palm_rotation": rotation,
            "palm_origin": origin,
            "cost": 0.0,
        } | initial_lm_state()
        record = self.layouts.row(s, p, q, Phase.CANDIDATE)
        said = {"within": ca.logic_not(side.asked(p))}
        return self._function(stage, [*inputs, hands], s, changed, said, record)

    def _side_fit(
        self, stage: Stage | SideStage, side: BodySide, tolerant: bool = False
    ) -> ca.Function:
        """Build one damped step of the palm and the hand of a side."""
        inputs, s, p = self._vectors()
        own, rows = side.parameters(p), side.layouts.contacts
        hand = list(side.robot.hand_actuators)
        q = s["q"][side.motors]
        x = PalmAndHand(s["palm_rotation"], s["palm_origin"], q[hand])
        tried = side.fitted(x, s["damping"], own, q, tolerant)
        part_of_tolerance = STAGES.before_the_arm
        if tolerant:
            judged = evaluate_excess_step(s, own, tried, rows, part_of_tolerance)
        else:
            judged = evaluate_contact_step(s, own, tried, rows, part_of_tolerance, STAGES.fit_part)
        keep, reached = judged.accepted, tried.x
        changed = {
            "q": with_rows(s["q"], side.hand, ca.if_else(keep, reached.hand, x.hand)),
            "palm_rotation": ca.if_else(keep, reached.rotation, x.rotation),
            "palm_origin": ca.if_else(keep, reached.origin, x.origin),
            "fits": judged.within,
        } | judged.lm_state
        said = {
            "settled": judged.settled,
            "within": judged.within,
            "miss": tolerance_ratio(judged.cost, own),
            "cost": ca.sumsqr(tried.residual_before),
        }
        of_side = ca.DM.zeros(len(self.robot.fingers), 2)
        of_side[side.fingers, :] = 1
        seen = p | {"weights": p["weights"] * of_side}
        whole = replace(tried, residual_before=self._whole(side, tried.residual_before))
        record = self.layouts.row(s, seen, s["q"], Phase.HAND_FIT, whole, keep)
        return self._function(stage, inputs, s, changed, said, record)

    def _whole(self, side: BodySide, residual: Expr) -> Expr:
        """A side's residual among zeros for all other fingers."""
        contacts = self.layouts.contacts
        count, whole = len(side.fingers), ca.SX.zeros(contacts.size)
        for i, own in enumerate(side.layouts.contacts.slices):
            aspect, finger = divmod(i, count)
            place = aspect * len(self.robot.fingers) + side.fingers[finger]
            whole[contacts.slices[place]] = residual[own]
        return whole

    def _all_arms(self) -> ca.Function:
        """Some arms of every side for its palm, at the trunk of q."""
        inputs, s, p = self._vectors(ca.MX)
        seen = self._seen()(*inputs)
        visit = s["candidate"] + s["earlier"] + s["tried"]
        found: list[Expr] = []
        for side, pose in zip(self.sides, zip(seen[::2], seen[1::2], strict=True), strict=True):
            columns = list(side.arm)
            bounds = p["lower"][columns], p["upper"][columns]
            if side.family is None:
                found += [s["q"][columns], ca.MX(ARM_SEARCH.outside), ca.MX(0), ca.MX(0)]
                continue
            search = ArmTrials(side.family, Farthest())
            best = s["arm"][side.arms], s["swivel"][side.place]
            arm, margin, swivel = search.trial(Pose(*pose), bounds, s["spent"], best, visit)
            hits: Expr = margin >= ARM_SEARCH.tolerance
            if not side.family.is_exact:
                polish = newton_polish(side.robot, side.family.model_error)
                limits = (p[name][side.motors] for name in ("lower", "upper"))
                arm, hits = polish(arm, *pose, *limits)
            found += [arm, margin, swivel, hits]
        outputs = self._kept_arms()(*inputs, *found)
        return ca.Function("arm_placement", inputs, list(outputs))

    def _seen(self) -> ca.Function:
        """(state, parameters) -> rotation and origin of every palm, seen from the trunk's end."""
        inputs, s, _ = self._vectors()
        base = actuated(self.robot, s["q"]).kinematics.links[self.robot.trunk_link]
        found = []
        for side in self.sides:
            rotation, origin = self._palm(s, side)
            found += [base.rotation.T @ rotation, base.inverse_apply(origin)]
        return ca.Function("seen", inputs, with_cse(*map(ca.densify, found)))

    def palms(self) -> FunctionGraph:
        """Where the palms are.

        Returns:
            q (n, 1) -> rotation, row by row, and origin of every palm, (12 s, 1); the same as the
            trunk's end sees them, as the rows of (4, 4) poses, (16 s, 1).
        """
        q = ca.SX.sym("q", len(self.robot.actuators))
        body = actuated(self.robot, q)
        base = body.kinematics.links[self.robot.trunk_link]
        found: list[Expr] = []
        seen: list[Expr] = []
        for side in self.sides:
            pose = side.palm(body)
            found += [ca.vec(pose.rotation.T), pose.origin]
            placed = ca.horzcat(base.rotation.T @ pose.rotation, base.inverse_apply(pose.origin))
            seen += [ca.vec(placed.T), ca.SX([0.0, 0.0, 0.0, 1.0])]
        outputs = with_cse(*(ca.densify(ca.vertcat(*some)) for some in (found, seen)))
        return FunctionGraph.of(ca.Function("palms", [q], outputs))

    def _palm(self, s: dict[str, Expr], side: BodySide) -> tuple[Expr, Expr]:
        return s[f"palm_rotation_{side.place}"], s[f"palm_origin_{side.place}"]

    def _kept_arms(self) -> ca.Function:
        """Keep the best arm of every side so far."""
        inputs, s, p = self._vectors()
        given: list[Expr] = []
        arms: list[Expr] = []
        margins: list[Expr] = []
        swivels: list[Expr] = []
        near = ca.SX(1)
        q = s["q"]
        for side in self.sides:
            arm = ca.SX.sym("arm", len(side.arm))
            score, swivel, hits = (ca.SX.sym(name) for name in ("score", "swivel", "hits"))
            given += [arm, score, swivel, hits]
            asked, before = side.asked(p), s["margin"][side.place]
            # A margin of zero and more says that the real arm was found.
            score = ca.if_else(hits, ca.fmax(score, 0.0), ca.fmin(score, -BODY.missed))
            better = score > before
            margins.append(ca.fmax(score, before))
            swivels.append(ca.if_else(better, swivel, s["swivel"][side.place]))
            own = ca.if_else(better, arm, s["arm"][side.arms])
            own = ca.if_else(asked, own, q[list(side.arm)])
            arms.append(own)
            hit = ca.logic_or(margins[-1] >= 0, ca.logic_not(asked))
            near = ca.logic_and(near, hit)
            q = with_rows(q, side.arm, own)
        q = ca.fmin(ca.fmax(q, p["lower"]), p["upper"])
        changed = {
            "spent": s["spent"] + 1,
            "margin": ca.vertcat(*margins),
            "arm": ca.vertcat(*arms),
            "swivel": ca.vertcat(*swivels),
        }
        margin = ca.mmin(ca.vertcat(*margins))
        record = self.layouts.row(s, p, q, Phase.ARM_PLACEMENT, margin=margin)
        said = {"within": near, "near": near}
        return self._function(Stage.ARM_PLACEMENT, [*inputs, *given], s, changed, said, record)

    @property
    def _carrying(self) -> list[int]:
        """Positions in q of what carries the palms: trunk, then arms."""
        return [*self.robot.trunk_actuators, *self.layouts.arm]

    def _trunk(self) -> ca.Function:
        """One damped step of trunk and arms that keeps the palms."""
        inputs, s, p = self._vectors()
        rows, off = self._carrying, self._off(s, p, inputs)
        # Where what is near is wanted the trunk moves last.
        unit = ca.if_else(p["nearest"], BODY.trunk_unit, 1.0)
        units = ca.vertcat(
            ca.repmat(unit, len(self.robot.trunk), 1), ca.SX.ones(len(self.layouts.arm), 1)
        )
        value, lower, upper = (x[rows] / units for x in (s["q"], p["lower"], p["upper"]))
        bounds = BoxBounds(value, lower, upper, first=0)
        before, slopes, turned = off(s["q"])
        slopes = slopes @ ca.diag(units)
        damped = damped_step(slopes, turned, s["damping"], bounds, FIT.passes)
        q = with_rows(s["q"], rows, units * clip(value + damped.step, bounds))
        there = off(q)[0]
        size = ca.mmax(ca.fabs(q - s["q"]))
        tried = TrialStep(q, before, there, damped.predicted_decrease, size)
        judged = evaluate_step(s, tried, ca.SX(0), ca.SX(0), BODY.patience, BODY.budget)
        now = ca.if_else(judged.accepted, q, s["q"])
        changed = {"q": now} | judged.lm_state
        said = {"settled": judged.settled, "cost": judged.cost}
        record = self.layouts.row(s, p, s["q"], Phase.TRUNK, margin=-ca.sqrt(judged.cost))
        return self._function(Stage.TRUNK, inputs, s, changed, said, record)

    def _off(
        self, s: dict[str, Expr], p: dict[str, Expr], given: list[Expr]
    ) -> Callable[[Expr], Any]:
        """How far the palms are off, a function of q.

        Args:
            s: State.
            p: Parameters.
            given: The symbols that both are made of.

        Returns:
            What gives differences of origins by `LENGTH` and of rotations, twelve a side; six rows
            a side with the same normal equations, as Jacobian over trunk and arms and as residual:
            three columns of a rotation turn like one vector.
        """
        q = ca.SX.sym("q", s["q"].numel())
        body = actuated(self.robot, q)
        apart: list[Expr] = []
        slopes: list[Expr] = []
        turned: list[Expr] = []
        for side in self.sides:
            asked, palm = side.asked(p), side.palm(body)
            rotation, origin = self._palm(s, side)
            shift = asked * (palm.origin - origin) / LENGTH
            apart += [shift, asked * ca.vec(palm.rotation - rotation)]
            rates = body.twist(side.robot.palm_link, palm.origin, self._carrying)
            linear, angular = map(ca.sparsify, rates)
            crossed = sum(
                (ca.cross(palm.rotation[:, i], rotation[:, i]) for i in range(3)), ca.SX.zeros(3, 1)
            )
            half = 2**0.5
            slopes += [asked * linear / LENGTH, asked * half * angular]
            turned += [shift, -asked * crossed / half]
        found = (ca.vertcat(*each) for each in (apart, slopes, turned))
        return hoisted_call_function("palms_off", [q], given, list(found))
