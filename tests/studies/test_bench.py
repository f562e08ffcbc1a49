"""The benchmark alternates with another checkout, and every part of it runs."""

from __future__ import annotations

import re
from pathlib import Path

import bench
import bench_parts
import numpy as np
import peer_solvers
import peers
import pytest

import casadi_ik as ik

ROOT = Path(ik.__file__).parents[1]
CASES = (
    ("batch", "kuka_lwr_barrett", "limits", "5mm", 16),
    ("fast", "kuka_lwr_barrett", 16),
    ("single", "kuka_lwr_barrett", 4),
    ("clutter", "kuka_lwr_barrett", 2),
    ("follow", "kuka_lwr_barrett"),
    ("diagnosis", "kuka_lwr_barrett", "far", 4),
    ("methods", "kuka_lwr_barrett", "thumb-first", ""),
    ("threads", "kuka_lwr_barrett", 16),
    ("memory", "kuka_lwr_barrett", 100),
    ("many", "kuka_lwr_barrett", 60),
    ("logs", "kuka_lwr_barrett", "hand-first", "lz4", 24),
)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case[0])
def test_every_part_is_measured(case):
    assert case[0] in bench_parts.CASES
    measured = bench_parts.MEASUREMENTS[case[0]](*case[1:])()
    assert all(value >= 0 for value in measured.values())
    assert measured.get("missed", 0) == 0


def test_two_checkouts_alternate(tmp_path):
    arguments = ["--part", "batch", "--robots", "ar10", "--count", "16", "--turns", "2"]
    bench.main([*arguments, "--against", str(ROOT), "--report", str(tmp_path)])
    text = (tmp_path / "report.md").read_text()
    rows = re.findall(r"^\| batch \| ar10 \| \w+ \S+ 16 \| us \| (.*) \|$", text, re.MULTILINE)
    assert len(rows) == 4
    assert all(float(cell) > 0 for row in rows for cell in row.split(" | "))
    assert "--against CHECKOUT" in text
    assert str(ROOT) not in text


def test_another_checkout_needs_the_public_names_alone(tmp_path):
    modules = "bench_parts", "bench_processes", "bench_solves", "samplers", "peers", "peer_solvers"
    for name in modules:
        text = (ROOT / "studies" / f"{name}.py").read_text()
        assert not re.findall(r"^(?:from|import) casadi_ik\.(?!errors)", text, re.MULTILINE), name
    package = tmp_path / "casadi_ik"
    package.mkdir()
    (package / "__init__.py").touch()
    with pytest.raises(ik.errors.InputError, match=bench.OLDEST):
        bench.main(["--part", "fast", "--robots", "ar10", "--against", str(tmp_path)])


def test_rows_above_a_ratio_are_reported():
    row = ["batch", "ar10", "5 mm", "us", "9", "6", "1.500", "1.400"]
    count = ["batch", "ar10", "5 mm", "solved", "9", "6", "1.500", "1.500"]
    missing = ["batch", "ar10", "5 mm", "us", "9", "", "", ""]
    assert bench.slower_rows([row, count, missing], 1.3) == [row]
    assert bench.slower_rows([row, count, missing], 1.45) == []


@pytest.mark.parametrize("name", ["xarm7+ability", "kinova_gen3+inspire_rh56", "ur5e+shadow"])
def test_peer_robots_match_ours(name):
    """Couplings with offsets and several followers of a motor are in their URDF."""
    robot = ik.load_robot(name)
    contacts = peer_solvers.PinContacts(robot)
    q = robot.random(np.random.default_rng(0), 5)
    for q_row, points, normals in zip(q, *robot.contacts(q), strict=True):
        points_of_peer, rotations = contacts.at(contacts.model.createData(), q_row)
        np.testing.assert_allclose(points_of_peer, points, atol=1e-12)
        peer_normals = np.einsum("fij,fj->fi", rotations, contacts.axes)
        np.testing.assert_allclose(peer_normals, normals, atol=1e-12)
        theta = contacts.theta(q_row)
        assert (theta >= contacts.model.lowerPositionLimit).all()
        assert (theta <= contacts.model.upperPositionLimit).all()


@pytest.mark.parametrize("name", ["scipy", "ipopt"])
def test_a_peer_is_restarted_and_judged(robot, name):
    targets = robot.contacts(robot.random(np.random.default_rng(0), 4))
    run = peers.run_peer(name, robot, targets, ik.Tolerance(), restarts=40)
    assert run.times.shape == (4,)
    assert run.solved == 1 if name == "scipy" else run.solved > 0
    assert not peers.is_solved(
        robot, robot.random(np.random.default_rng(1), 4), targets, ik.Tolerance()
    ).any()
