"""Whether no hand within a box of its coordinates can meet a target: one test, as a graph.

Every contact of such a hand lies in a ball (`contact_ranges`), every contact asked for within its
tolerances. Hence inequalities between what is kept by all motions of the palm, and between that
and what the arm can do. All are necessary: what is refuted is impossible, what is not may be, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import casadi as ca

from casadi_ik.arrays import Array
from casadi_ik.kernels.function_graph import FunctionGraph
from casadi_ik.kernels.recipe import recipe
from casadi_ik.problem.arm_cones import ArmCones
from casadi_ik.solving.diagnosis.box_contacts import BoxContact, box_contacts
from casadi_ik.solving.diagnosis.cone_bound import cone_excess
from casadi_ik.solving.diagnosis.hand_space import HandSpace
from casadi_ik.solving.diagnosis.pair_rows import Row, pair_angles, pair_rows
from casadi_ik.solving.diagnosis.rigid_bound import rigid_excess
from casadi_ik.solving.diagnosis.wrist_bound import Carrier, Wrist, wrist_excess
from casadi_ik.symbolic.smooth import Expr
from casadi_ik.symbolic.subexpressions import shared

LENGTH = 0.1
"""A length that counts as much as one radian [m]."""

ANYWAY = 0.1
"""What a coordinate counts that moves a finger, against one that widens a row nearly broken."""


@dataclass(frozen=True, eq=False)
class BoxTest:
    """The step for one robot.

    Attributes:
        space: The hand's coordinates.
        wrist: The arm; None if the palm does not move.
        cones: What the limits of its shoulder and wrist leave; None for other arms.
    """

    space: HandSpace
    wrist: Wrist | None
    cones: ArmCones | None

    def graph(self) -> FunctionGraph:
        """The graph.

        Returns:
            ``(lower, upper, joint_lower, joint_upper, points, normals, tolerance, asked, span,
            cosines) -> (refuted, scores)``: coordinates (h,), joints of the fingers (m,), contacts
            (f, 3), tolerances and what is asked (f, 2), the wrist's smallest and largest distance
            (2,), cosines of the arm's cones (2,).
            Refuted by the hand and by the reach (2,) where > 0; scores (h,): what each coordinate
            leaves open.
        """
        robot = self.space.robot
        h, m, f = len(self.space.motors), len(self.space.joints), len(robot.fingers)
        shapes = {"lower": (h, 1), "upper": (h, 1), "joint_lower": (m, 1), "joint_upper": (m, 1)}
        shapes |= {"points": (f, 3), "normals": (f, 3), "tolerance": (f, 2), "asked": (f, 2)}
        shapes |= {"span": (2, 1), "cosines": (2, 1)}
        name = ca.Function.fix_name(f"{robot.name}_box_test")

        def build() -> ca.Function:
            symbols = {key: ca.SX.sym(key, *shape) for key, shape in shapes.items()}
            outputs = shared(*map(ca.densify, self._outputs(symbols)))
            return ca.Function(
                name, list(symbols.values()), outputs, list(shapes), ["refuted", "scores"]
            )

        place: tuple[Array, ...] = () if self.wrist is None else self.wrist.points
        place += () if self.cones is None else (self.cones.last,)
        known = recipe(name, robot, place)
        return FunctionGraph(name, build, shapes, ((2, 1), (h, 1)), known)

    def _outputs(self, p: dict[str, ca.SX]) -> tuple[Expr, Expr]:
        ranges = self.space.ranges(p["lower"], p["upper"])
        half = (p["upper"] - p["lower"]) / 2
        contacts = box_contacts(self.space, ranges, half, p, self.wrist is not None)
        hand, reach = [ca.SX(-1)], [ca.SX(-1)]
        for i, name in enumerate(self.space.joints):
            hand.append(ranges[name].lower - p["joint_upper"][i])
            hand.append(p["joint_lower"][i] - ranges[name].upper)
        rows: list[Row] = []
        if self.wrist is None:
            hand += [test for contact in contacts for test in contact.alone()]
        else:
            for a, b in combinations(contacts, 2):
                rows += pair_rows(a, b)
                hand += pair_angles(a, b)
            hand += [ca.fabs(row.value) - row.width for row in rows]
            hand.append(rigid_excess(contacts))
            tests, reached = self._reach(contacts, self.wrist, p)
            reach, rows = reach + tests, rows + reached
        refuted = ca.vertcat(ca.mmax(ca.vertcat(*hand)), ca.mmax(ca.vertcat(*reach)))
        return refuted, self._scores(contacts, rows, p["asked"])

    def _reach(
        self, contacts: list[BoxContact], wrist: Wrist, p: dict[str, ca.SX]
    ) -> tuple[list[Expr], list[Row]]:
        """Tests of the arm, and rows of what decides most of them."""
        carrier = Carrier(contacts)
        ball = carrier.point(ca.SX(ca.DM(wrist.wrist)))
        found, rows = wrist_excess(contacts, wrist, p["span"], ball)
        if self.cones is not None:
            last = carrier.direction(ca.SX(ca.DM(self.cones.last)))
            found.append(cone_excess(self.cones, ball, last, p["span"], p["cosines"]))
        return found, rows

    def _scores(self, contacts: list[BoxContact], rows: list[Row], asked: Expr) -> Expr:
        """By coordinate what it leaves open: most of all in rows that are nearly broken."""
        found = []
        for k in range(len(self.space.motors)):
            most = ca.SX(0)
            for i, contact in enumerate(contacts):
                share = asked[i, 0] * contact.moved[k] / LENGTH + asked[i, 1] * contact.turned[k]
                most = ca.fmax(most, share)
            found.append(ANYWAY * most if rows else most)
        for row in rows:
            square = (row.value / row.width) ** 2
            for k, share in enumerate(row.shares):
                found[k] += square * square * share / row.width
        return ca.vertcat(*found)
