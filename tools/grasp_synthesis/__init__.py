"""How the shipped grasps are computed; run ``tools/make_grasps.py``."""
