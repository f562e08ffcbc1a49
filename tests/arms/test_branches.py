"""Branches of arms and the stretches of their redundancy, against scans of all of it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.arms.recognise import arm_family
from casadi_ik.solving.alternatives.branches import ArmBranches

KINDS = [(s, e, w) for s in (1, -1) for e in (1, -1) for w in (1, -1)]


class Arm:
    """A robot, the branches of its arm, and its bounds."""

    def __init__(self, name: str) -> None:
        self.robot = ik.load_robot(f"{name}+barrett_bh8_280")
        family = arm_family(self.robot.description)
        assert family is not None
        self.branches, count = ArmBranches(family, compiled=False), len(family.screws)
        self.around = bool(family.redundancy) and family.redundancy[0].joint is None
        self.columns = slice(0, count)
        self.bounds = self.robot.lower[self.columns], self.robot.upper[self.columns]
        if family.redundancy:
            self.range = tuple(float(end) for end in family.redundancy[0].bounds(*self.bounds))

    def palms(self, seed, count):
        q = self.robot.random(np.random.default_rng(seed), count)
        return [(self.robot.palm(one), one[self.columns]) for one in q]

    def margin(self, arms):
        return np.minimum(arms - self.bounds[0], self.bounds[1] - arms).min(axis=-1)

    def contains(self, stretch, values):
        start, end = stretch
        if self.around:
            return np.mod(values - start, 2 * np.pi) <= end - start
        return (values >= start) & (values <= end)


@cache
def arm_of(name: str) -> Arm:
    return Arm(name)


@pytest.mark.parametrize("name", ["kuka_lwr4", "panda", "kinova_gen3", "xarm7"])
def test_the_stretches_are_all_that_is_allowed_and_no_more(name):
    """Against a scan of the whole redundancy, a branch at a time."""
    arm, inside_anywhere = arm_of(name), 0
    scan = np.linspace(*arm.range, 700)[1:-1] + 1e-4
    for palm, own in arm.palms(1, 3):
        found = arm.branches.find(palm, *arm.bounds)
        assert found
        margins = arm.branches._margins(palm, scan, *arm.bounds)
        for kind in KINDS:
            of_kind = [b.swivel for b in found if (b.shoulder, b.elbow, b.wrist) == kind]
            arms = arm.branches.arms(palm, ik.answers.ArmBranch(*kind, arm.range), scan)
            row = np.abs(arm.branches._at(palm[:3, :3], palm[:3, 3], scan)[0] - arms[:, None])
            (row,) = np.flatnonzero(row.max(axis=(0, 2)) == 0)
            inside = np.any([arm.contains(b, scan) for b in of_kind] or [scan > 1e9], axis=0)
            np.testing.assert_array_equal(inside, margins[:, row] >= 0)
            inside_anywhere += int(inside.sum())
        # The ends are where something is at a limit, or where the arm is stretched out.
        for branch in found:
            ends = arm.branches.arms(palm, branch, np.array(branch.swivel))
            assert (arm.margin(ends) > -1e-6).all()
            if arm.around and branch.swivel[1] - branch.swivel[0] < 2 * np.pi - 1e-9:
                np.testing.assert_allclose(arm.margin(ends), 0, atol=1e-7)
        # The configuration itself, turned by whole turns, is one of them.
        near = [arm.branches.arms(palm, b, np.linspace(*b.swivel, 2000)) for b in found]
        off = min(np.abs(np.angle(np.exp(1j * (arms - own)))).max(axis=1).min() for arms in near)
        assert off < 0.02 or not arm.branches.family.exact
    assert inside_anywhere > 0


@pytest.mark.parametrize("name", ["ur5e", "puma560", "irb140", "xarm6"])
def test_an_arm_of_six_joints_has_single_branches(name):
    """The arm that a palm pose was made with, turned by whole turns, is among them."""
    arm = arm_of(name)
    for palm, own in arm.palms(2, 8):
        found = arm.branches.find(palm, *arm.bounds)
        assert len(set(found)) == len(found)
        assert all(branch.swivel is None for branch in found)
        arms = [arm.branches.arms(palm, branch, np.zeros(1))[0] for branch in found]
        assert min(np.abs(np.angle(np.exp(1j * (a - own)))).max() for a in arms) < 1e-6
