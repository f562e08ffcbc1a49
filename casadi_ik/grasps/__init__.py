"""What is to be touched: contacts, grasps and objects, numpy only."""

from casadi_ik.grasps.grasp import Contact, Grasp
from casadi_ik.grasps.load import load_grasp

__all__ = ["Contact", "Grasp", "load_grasp"]
