"""Readers of published data sets and tables of grasps as candidates for `Solver.choose`."""

from casadi_ik.integrations.datasets.layouts import LAYOUTS
from casadi_ik.integrations.datasets.load import LAYOUT_NAMES, Candidates, load_candidates

__all__ = ["LAYOUTS", "LAYOUT_NAMES", "Candidates", "load_candidates"]
