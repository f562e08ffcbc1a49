"""How an arm is solved, for a reader."""

from __future__ import annotations

from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.closed_arms.form import ClosedForm
from casadi_ik.symbolic.closed_arms.held import held_arm
from casadi_ik.symbolic.closed_arms.passing import PassingArm
from casadi_ik.symbolic.closed_arms.recognise import arm_form
from casadi_ik.symbolic.srs_arm import SrsArm


def is_searched(robot: RobotDescription) -> bool:
    """Whether a robot has an arm that no closed form is known for."""
    return bool(robot.arm_actuators) and arm_form(robot) is None and held_arm(robot) is None


def form_in_words(robot: RobotDescription) -> str:
    """The form of a robot's arm."""
    if not robot.arm_actuators:
        return "no arm"
    form = arm_form(robot)
    if isinstance(form, SrsArm):
        return "spherical shoulder and wrist"
    if form is not None:
        return _words(form)
    held = held_arm(robot)
    if held is None:
        return "none, searched"
    return f"{_words(held.form)}, joints {', '.join(str(i + 1) for i in held.held)} held"


def _words(form: ClosedForm) -> str:
    return form.kind if form.exact or isinstance(form, PassingArm) else f"nearly {form.kind}"
