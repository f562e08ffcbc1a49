"""Second derivatives of the contact residual.

The vectors of a fingertip are fixed to a link. For joints i and j of its chain, i nearer to the
root, the second derivative of such a vector is ``w_i x (dv / dtheta_j)`` with the angular axis w_i,
which is zero for a slider. All second derivatives therefore follow from first ones by one cross
product per joint and one scalar product per pair of joints; automatic differentiation needs about
ten times as many operations.
"""

from __future__ import annotations

import casadi as ca

from casadi_ik.kinematics.contacts import ContactRows, Vectors, tip_vectors
from casadi_ik.kinematics.couplings import joint_positions
from casadi_ik.kinematics.forward import actuated
from casadi_ik.kinematics.smooth import Expr
from casadi_ik.model.description import RobotDescription


def residual_curvature(
    robot: RobotDescription, rows: ContactRows, q: Expr, p: dict[str, Expr], residual: Expr
) -> Expr:
    """Return the upper triangle (n, n) of the sum of residuals times their second derivatives.

    With ``J' J`` it is the Hessian of half the squared residual.

    Args:
        robot: Description of the robot.
        rows: Rows of the contacts.
        q: (n, 1) motor positions [rad or m].
        p: Parameters with the fields of `rows`.
        residual: Residual of `contact_residual` at q.
    """
    body = actuated(robot, q)
    kinematics = body.kinematics
    tips = [tip_vectors(kinematics, name) for name in robot.finger_names]
    slopes, curvatures = _vector_derivatives(rows, tips, p, residual)
    index = {name: i for i, name in enumerate(robot.joint_names)}
    moments: dict[str, Expr] = {}
    curvature, torque = ca.SX(len(index), len(index)), ca.SX(len(index), 1)
    for finger, tip, slope, second in zip(robot.fingers, tips, slopes, curvatures, strict=True):
        joints = [joint.name for joint in robot.chain(finger.link) if joint.type != "fixed"]
        linear, angular = kinematics.twist_columns(joints, finger.link, tip["point"])
        rates = []
        for j, name in enumerate(joints):
            velocity = [
                linear[:, j] if key == "point" else ca.cross(angular[:, j], vector)
                for key, vector in tip.items()
            ]
            moment = sum(
                (ca.cross(v, slope[3 * i : 3 * i + 3]) for i, v in enumerate(velocity)),
                ca.SX(3, 1),
            )
            moments[name] = moments.get(name, ca.SX(3, 1)) + moment
            rates.append(ca.sparsify(ca.vertcat(*velocity)))
            torque[index[name]] += ca.dot(rates[-1], slope)
        if second.nnz():
            for j, name in enumerate(joints):
                change = second @ rates[j]
                for i, proximal in enumerate(joints[: j + 1]):
                    curvature[index[proximal], index[name]] += ca.dot(rates[i], change)
    children = {joint.name: joint.child for joint in robot.joints}
    for name, moment in moments.items():
        for joint in robot.chain(children[name]):
            if joint.type == "revolute":
                axis = kinematics.axes[joint.name]
                curvature[index[joint.name], index[name]] += ca.dot(axis, moment)
    # The index of a joint need not grow along the chain.
    lower = ca.triu(curvature, False) + ca.tril(curvature, False).T
    symmetric = lower + lower.T + ca.diag(ca.diag(curvature))
    by_motors = body.coupling.T @ symmetric @ body.coupling
    return ca.triu(by_motors + _coupling_curvature(robot, q, torque))


def _vector_derivatives(
    rows: ContactRows, tips: list[Vectors], p: dict[str, Expr], residual: Expr
) -> tuple[list[Expr], list[Expr]]:
    """Return gradients (v, 1) and Hessians (v, v) of a weighted residual by vectors of each tip.

    The weights of the residual are its values, which count as constants.
    """
    symbols = [{name: ca.SX.sym(name, 3) for name in tip} for tip in tips]
    stacked = [ca.vertcat(*tip.values()) for tip in symbols]
    values = [ca.densify(ca.vertcat(*tip.values())) for tip in tips]
    factors = ca.SX.sym("factors", residual.numel())
    weighted = ca.dot(factors, rows.residual(symbols, rows.goals(p), p["weights"]))
    slopes = [ca.gradient(weighted, tip) for tip in stacked]
    curvatures = [
        ca.sparsify(ca.jacobian(slope, tip)) for slope, tip in zip(slopes, stacked, strict=True)
    ]
    results = ca.substitute(
        [*slopes, *curvatures], [*stacked, factors], [*values, ca.densify(residual)]
    )
    return results[: len(tips)], results[len(tips) :]


def _coupling_curvature(robot: RobotDescription, q: Expr, torque: Expr) -> Expr:
    """Return the curvature (n, n) that coupled joints add at generalised forces of the joints."""
    symbols, forces = ca.SX.sym("q", q.numel()), ca.SX.sym("torque", torque.numel())
    work = ca.dot(forces, joint_positions(robot, symbols))
    hessian = ca.Function("coupling_curvature", [symbols, forces], [ca.hessian(work, symbols)[0]])
    return hessian(q, torque)
