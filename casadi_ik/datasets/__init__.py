"""Other people's grasps: data sets and tables, read as candidates."""

from casadi_ik.datasets.candidates import Candidates
from casadi_ik.datasets.layouts import LAYOUTS
from casadi_ik.datasets.load import load_candidates

__all__ = ["LAYOUTS", "Candidates", "load_candidates"]
