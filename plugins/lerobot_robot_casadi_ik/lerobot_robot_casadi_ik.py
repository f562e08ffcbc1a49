"""Plugin of LeRobot: its tools import this package by name, which registers the steps."""

# pyright: reportMissingImports=false
from casadi_ik.integrations.lerobot import ArmKinematics, ContactsToJoints

__all__ = ["ArmKinematics", "ContactsToJoints"]
