"""Cylinder on a table, and solvers for the tests of grasps of surfaces."""

import numpy as np

import casadi_ik as ik

PLACE = np.eye(4)
PLACE[:3, 3] = [0.5, 0.1, 0.055]


def solver_of(robot):
    return ik.Solver(ik.load_robot(robot), scene=ik.load_scene("table"))


def surface_of(folder, mesh):
    mesh.export(folder / "mesh.stl")
    return ik.load_surface(folder / "mesh.stl")
