"""Shapes and colours of what pictures and pages draw."""

MESHES_VARIABLE = "CASADI_IK_MESHES"
"""Environment variable; "off" disables visual meshes."""
