"""Computation of the built-in grasps; run ``tools/make_grasps.py``."""
