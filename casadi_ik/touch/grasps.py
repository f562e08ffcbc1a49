"""Grasps of a surface that an arm-hand can make, ranked: see `Solver.grasps_of`."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from casadi_ik.answers.solution import Solution
from casadi_ik.api import Solver
from casadi_ik.arrays import Array
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import InputError
from casadi_ik.grasps import Contact, Grasp
from casadi_ik.grasps.grasp import Tolerance
from casadi_ik.problem.clearance import SceneCheck
from casadi_ik.touch.hand_table import HandTable
from casadi_ik.touch.strength import generators, loads
from casadi_ik.touch.surface import Surface
from casadi_ik.touch.synthesis import (
    Candidates,
    Generator,
    HandCheck,
    TouchParameters,
    snapped,
    touching,
)

GRAVITY = 9.80665
"""Standard acceleration of free fall [m/s^2]."""


def find(solver, surface, pose=None, fingers=3, mu=0.5, hold=None, limit=200, seed=0, rounds=60, parameters=None):
    chosen = parameters or TouchParameters()
    place = np.eye(4) if pose is None else np.asarray(pose, float)
    robot = solver.robot
    table = HandTable(robot, seed)
    scene = (solver.scene or Scene()).holding(surface.name, place)
    check = SceneCheck(robot, scene)
    rng = np.random.default_rng(seed)
    generator = Generator(table, surface, fingers, chosen, rng, HandCheck(table, check, place))
    counts = generator.counts
    T = {}
    def tick(name, t0):
        T[name] = T.get(name, 0) + time.process_time() - t0
    arm = Solver(robot, options={"max_rounds": 1}, tolerance=Tolerance(1e-3, 0.02))
    judge = Solver(robot, options={"max_rounds": 1}, tolerance=Tolerance(1e-3, 0.02), scene=scene)
    q_all, tip_all, palms = [], [], []
    results = []
    center = surface.points.mean(0)
    length = surface.size / 2
    for _ in range(rounds):
        t0 = time.process_time(); c = generator.draw(); tick("draw", t0)
        if not len(c): continue
        t0 = time.process_time(); c = snapped(table, surface, c, chosen); tick("snap", t0)
        t0 = time.process_time()
        here, _, _ = touching(table, surface, c)
        ok = (~c.used | ((abs(here.height) < chosen.touch) & (here.lean < chosen.last_lean) & surface.inside[here.sample])).all(1)
        rows = np.flatnonzero(ok); c = c.rows(rows); generator.counted("on the surface", len(c))
        rows = np.flatnonzero(generator.clear(c)); c = c.rows(rows); generator.counted("clear again", len(c)); tick("verdict", t0)
        if not len(c): continue
        t0 = time.process_time()
        got = arm.solve_palms(place @ c.palm, table.configuration(c.hand)); tick("arm", t0)
        rows = np.flatnonzero(got.success); generator.counted("arm reaches", len(rows))
        if not len(rows): continue
        c = c.rows(rows); q = got.q[rows]
        t0 = time.process_time()
        points, normals = robot.contacts(q)
        points = np.where(c.used[..., None], points, np.nan); normals = np.where(c.used[..., None], normals, np.nan)
        final = judge.solve_batch(points, normals, q0=q, object_pose=place); tick("judge", t0)
        rows = np.flatnonzero(final.success); generator.counted("free", len(rows))
        if not len(rows): continue
        t0 = time.process_time()
        c = c.rows(rows); here, _, _ = touching(table, surface, c)
        order = np.argsort(~c.used, axis=1, kind="stable")[:, :fingers]
        pick = np.take_along_axis(here.sample, order, 1)
        W = generators(surface.points[pick], -surface.faces[pick], mu, center, length)
        L = loads(W); tick("load", t0)
        closed = L.min(1) > 1e-4
        generator.counted("closed", closed.sum())
        results.append((final.q[rows][closed], L[closed][:, [0,1,2,6,7,8]].min(1)))
        if counts["closed"] >= limit: break
    print(T); print(counts)
    return results
