"""Arm-hand inverse kinematics from fingertip contacts."""
