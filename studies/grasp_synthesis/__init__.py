"""How the shipped grasps are computed; run ``studies/make_grasps.py``."""
