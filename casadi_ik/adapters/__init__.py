"""Arm-hand kinematics inside other people's systems: a module each, which imports that system."""
