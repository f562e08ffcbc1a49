"""Graph of the test that no hand posture in a box can meet a target.

Every contact that a hand in the box can make lies in a ball (`proofs.boxes`), and every admissible
contact lies within the tolerances of the target. The test evaluates necessary conditions: relations
between contacts that no palm motion changes (`contact_tests`), and relations between the contacts
and the workspace of the arm (`arm_tests`). A refuted box contains no solution; a box that is not
refuted may still contain no solution.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import casadi as ca

from casadi_ik.compile.graphs import FunctionGraph, recipe
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.smooth import Expr, with_cse
from casadi_ik.solve.proofs.arm_tests import cone_excess, palm_ball, wrist_excess
from casadi_ik.solve.proofs.boxes import BoxContact, HandSpace, box_contacts
from casadi_ik.solve.proofs.contact_tests import (
    Inequality,
    pair_angles,
    pair_rows,
    rigid_excess,
)
from casadi_ik.solve.proofs.premises import ArmCones, ArmSpan


@dataclass(frozen=True, eq=False)
class BoxTest:
    """Test of boxes of hand postures for one robot.

    Attributes:
        space: Coordinates of the hand.
        arm: Shoulder and wrist of the arm; None if the palm does not move.
        cones: Cones within the limits of shoulder and wrist; None for arms of another family.
    """

    space: HandSpace
    arm: ArmSpan | None
    cones: ArmCones | None

    def graph(self) -> FunctionGraph:
        """Return the graph of the test.

        Returns:
            ``(lower, upper, joint_lower, joint_upper, points, normals, tolerance, constrained,
            span, cosines) -> (refuted, scores)``. Inputs: bounds of the coordinates (h,), limits of
            the finger joints (m,), contacts (f, 3), tolerances of position and angle (f, 2),
            1 where a point or normal is constrained (f, 2), smallest and largest distance of the
            wrist from the shoulder (2,), cosines of the arm's cones (2,). Outputs: values > 0 if
            the hand alone or the arm refutes the box (2,), and the contribution of each coordinate
            to the remaining uncertainty (h,).
        """
        robot = self.space.robot
        h, m, f = len(robot.finger_motors), len(robot.finger_joints), len(robot.fingers)
        shapes = {"lower": (h, 1), "upper": (h, 1), "joint_lower": (m, 1), "joint_upper": (m, 1)}
        shapes |= {"points": (f, 3), "normals": (f, 3), "tolerance": (f, 2), "constrained": (f, 2)}
        shapes |= {"span": (2, 1), "cosines": (2, 1)}
        name = ca.Function.fix_name(f"{robot.name}_box_test")

        def build() -> ca.Function:
            symbols = {key: ca.SX.sym(key, *shape) for key, shape in shapes.items()}
            outputs = with_cse(*map(ca.densify, self._outputs(symbols)))
            return ca.Function(
                name, list(symbols.values()), outputs, list(shapes), ["refuted", "scores"]
            )

        arm_geometry: tuple[Array, ...] = (
            () if self.arm is None else (self.arm.shoulder, self.arm.wrist)
        )
        arm_geometry += () if self.cones is None else (self.cones.last,)
        graph_recipe = recipe(name, robot, arm_geometry)
        return FunctionGraph(name, build, shapes, ((2, 1), (h, 1)), graph_recipe)

    def _outputs(self, p: dict[str, ca.SX]) -> tuple[Expr, Expr]:
        ranges = self.space.intervals(p["lower"], p["upper"])
        half_widths = (p["upper"] - p["lower"]) / 2
        contacts = box_contacts(self.space, ranges, half_widths, p, self.arm is not None)
        hand_tests, arm_tests = [ca.SX(-1)], [ca.SX(-1)]
        for i, name in enumerate(self.space.robot.finger_joints):
            hand_tests.append(ranges[name].lower - p["joint_upper"][i])
            hand_tests.append(p["joint_lower"][i] - ranges[name].upper)
        rows: list[Inequality] = []
        if self.arm is None:
            hand_tests += [test for contact in contacts for test in contact.fixed_hand_tests()]
        else:
            for a, b in combinations(contacts, 2):
                rows += pair_rows(a, b)
                hand_tests += pair_angles(a, b)
            hand_tests += [ca.fabs(row.value) - row.width for row in rows]
            hand_tests.append(rigid_excess(contacts))
            new_tests, arm_rows = self._arm_tests(contacts, self.arm, p)
            arm_tests, rows = arm_tests + new_tests, rows + arm_rows
        refuted = ca.vertcat(ca.mmax(ca.vertcat(*hand_tests)), ca.mmax(ca.vertcat(*arm_tests)))
        return refuted, self._scores(contacts, rows, p["constrained"])

    def _arm_tests(
        self, contacts: list[BoxContact], arm: ArmSpan, p: dict[str, ca.SX]
    ) -> tuple[list[Expr], list[Inequality]]:
        """Return the tests of the arm, and the inequalities that most of them depend on."""
        wrist_ball = palm_ball(contacts, ca.SX(ca.DM(arm.wrist)), 1)
        tests, rows = wrist_excess(contacts, arm, p["span"], wrist_ball)
        if self.cones is not None:
            axis_ball = palm_ball(contacts, ca.SX(ca.DM(self.cones.last)), 0)
            tests.append(cone_excess(self.cones, wrist_ball, axis_ball, p["span"], p["cosines"]))
        return tests, rows

    def _scores(
        self, contacts: list[BoxContact], rows: list[Inequality], constrained: Expr
    ) -> Expr:
        """Return the contribution of each coordinate to the remaining uncertainty, (h, 1).

        A coordinate scores highest if it widens inequalities that are nearly violated; motion of a
        contact alone has a tenth of that weight. 0.1 m count as one radian.
        """
        scores = []
        for k in range(len(self.space.coordinates)):
            largest = ca.SX(0)
            for i, contact in enumerate(contacts):
                motion = (
                    constrained[i, 0] * contact.radius_shares[k] / 0.1
                    + constrained[i, 1] * contact.chord_shares[k]
                )
                largest = ca.fmax(largest, motion)
            scores.append(0.1 * largest if rows else largest)
        for row in rows:
            square = (row.value / row.width) ** 2
            for k, motion in enumerate(row.shares):
                scores[k] += square * square * motion / row.width
        return ca.vertcat(*scores)
