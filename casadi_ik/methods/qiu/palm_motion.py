"""The palm motion that would remove the other fingers' errors (Qiu & Kermani 2021, eqs. 9-14)."""

from __future__ import annotations

import casadi as ca

from casadi_ik.methods.qiu.tasks import MILLIMETRE
from casadi_ik.problem.target import Target
from casadi_ik.symbolic.actuated import ActuatedKinematics
from casadi_ik.symbolic.directions import rotation_between
from casadi_ik.symbolic.se3 import log_se3
from casadi_ik.symbolic.so3 import log_so3, mean_rotation, project_to_rotation


def palm_motion(body: ActuatedKinematics, goals: dict[str, Target]) -> tuple[ca.SX, ca.SX]:
    """Mean translation and rotation demanded by the fingers, in the palm frame.

    Args:
        body: Kinematics over q.
        goals: Targets of the fingers that take part, base frame.

    Returns:
        translation (3, 1) [mm], eq. (13), and rotation vector (3, 1) [rad], eq. (12).
    """
    palm = body.kinematics.palm
    rotations, translations = [], []
    for name, goal in goals.items():
        point, normal = body.kinematics.contact(name)
        # Everything is seen from the palm. With the shortest rotation between the normals given
        # in palm coordinates, the sandwich of eq. (12) by the fingertip frame is already done.
        turn = rotation_between(palm.rotation.T @ normal, palm.rotation.T @ goal.normal)
        shift = palm.rotation.T @ (goal.point - point) / MILLIMETRE
        twist = log_se3((turn, shift))
        lever = palm.inverse_apply(point) / MILLIMETRE
        rotations.append(turn)
        translations.append(twist[:3] - ca.cross(twist[3:], lever))
    translation = sum(translations[1:], translations[0]) / len(translations)
    if len(rotations) == 2:
        mean = mean_rotation(*rotations)
    else:
        mean = project_to_rotation(sum(rotations[1:], rotations[0]) / len(rotations))
    return translation, log_so3(mean)
