"""Other people's grasps: data sets and tables, read as candidates."""

from casadi_ik.integrations.datasets.layouts import LAYOUTS
from casadi_ik.integrations.datasets.load import LAYOUT_NAMES, Candidates, load_candidates

__all__ = ["LAYOUTS", "LAYOUT_NAMES", "Candidates", "load_candidates"]
