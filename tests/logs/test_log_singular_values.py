"""Every method's log holds the singular values of arm and hand, and says what was not measured."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from made_up_solves import FORMAT, LABELS, make_block

import casadi_ik as ik
from casadi_ik.cli.main import main
from casadi_ik.kernels.layout import Layout
from casadi_ik.logs.explanation import explain
from casadi_ik.logs.solve import one_solve
from casadi_ik.problem.jacobian_measures import THRESHOLDS, JacobianMeasures
from casadi_ik.problem.status import Phase

LENGTH = 0.1
OPTIONS = {"enhanced-dls": {"max_iterations": 200}, "enhanced-sdls": {"max_iterations": 200}}
OPTIONS |= {"original-dls": {"max_iterations": 200}, "original-sdls": {"max_iterations": 200}}
OPTIONS |= {"ipopt": {"restarts": 1}}
STEP = 1e-6


def spread(robot: ik.ArmHand, q: np.ndarray, of: str, columns: tuple[int, ...]) -> np.ndarray:
    """Singular values of a Jacobian by central differences, descending."""
    found = []
    for column in columns:
        ahead, behind = q.copy(), q.copy()
        ahead[column] += STEP
        behind[column] -= STEP
        if of == "palm":
            first, second = (robot.palm(x) for x in (behind, ahead))
            turn = (second[:3, :3] - first[:3, :3]) @ robot.palm(q)[:3, :3].T / (2 * STEP)
            angular = np.array([turn[2, 1], turn[0, 2], turn[1, 0]])
            moved = (second[:3, 3] - first[:3, 3]) / (2 * STEP * LENGTH)
            found.append(np.concatenate([moved, angular]))
        else:
            finger = robot.fingers.index(of)
            first, second = (robot.contacts(x)[0][finger] for x in (behind, ahead))
            found.append((second - first) / (2 * STEP * LENGTH))
    return np.linalg.svd(np.array(found).T, compute_uv=False)


@pytest.fixture(scope="module")
def arms(robot: ik.ArmHand) -> np.ndarray:
    """Configurations whose elbow is straight to 1e-3 rad, within limits: the arm is singular."""
    rng = np.random.default_rng(40)
    q = robot.random(rng, 6)
    q[:, robot.actuators.index("lwr_joint_4")] = rng.normal(0, 1e-3, 6)
    return q


@pytest.fixture(scope="module", params=ik.METHODS)
def log(request, robot, arms, tmp_path_factory) -> ik.logs.Log:
    """A log of solves that begin at the answer, next to the singularity."""
    path = tmp_path_factory.mktemp("singular") / f"{request.param}.mcap"
    solver = ik.Solver(
        robot, request.param, options=OPTIONS.get(request.param, {}), finger_step="closed-form"
    )
    solver.solve_batch(*robot.contacts(arms), q0=arms, log=path)
    return ik.logs.open(path)


def test_each_row_with_a_configuration_has_the_values_it_should(robot, log):
    """Against singular values of central differences, which know nothing of the measure."""
    rows = log.iterations().rows
    some = rows[:: max(len(rows) // 12, 1)]
    arm = robot.description.arm_actuators
    fingers = {name: robot.description.finger_actuators(name) for name in robot.fingers}
    unplaced = log.iterations().method == "hand-first"
    for row in some:
        q = row["q"].astype(float)
        hands = [spread(robot, q, name, columns) for name, columns in fingers.items()]
        assert row["sigma_hand"] == pytest.approx(min(s[-1] for s in hands), rel=1e-3, abs=1e-5)
        assert row["condition_hand"] == pytest.approx(max(s[0] / s[-1] for s in hands), rel=1e-2)
        if unplaced and row["phase"] in (Phase.CANDIDATE, Phase.HAND_FIT):
            assert np.isnan(row["sigma_arm"])
            assert np.isnan(row["condition_arm"])
            continue
        values = spread(robot, q, "palm", arm)
        assert row["sigma_arm"] == pytest.approx(values[-1], rel=1e-3, abs=1e-5)
        if values[-1] > 1e-3:
            assert row["condition_arm"] == pytest.approx(values[0] / values[-1], rel=1e-2)


def test_singular_arms_are_events_in_every_method(robot, log):
    """Every solve that comes to a singular arm has the event, its joints and its threshold."""
    solves = log.solves()
    lowest = solves.rows["lowest_sigma"][:, solves.labels["lowest_sigma"].index("arm")]
    events = [r for r in log.events(event="NEAR_SINGULAR").records() if r["jacobian"] == "arm"]
    near = set(np.flatnonzero(lowest < THRESHOLDS["arm"][0]).tolist())
    assert {event["solve_id"] for event in events} == near
    assert near, "the answers are singular: someone has to come there"
    for event in events:
        assert event["value"] < event["threshold"] == THRESHOLDS["arm"][0]
        assert set(event["joint_mask"]) == set(robot.actuators[:7])


def test_why_tells_of_every_jacobian(log):
    for solve in range(2):
        met = " | ".join(explain(one_solve(log, solve)).met)
        for name in ("arm", "hand"):
            assert (
                f"{name} near singular" in met
                or f"{name} never near singular" in met
                or (f"smallest singular value of the {name} down to" in met)
            ), met
        assert "not measured" not in met


def test_thumb_first_measures_its_closed_chain(robot):
    """Five rows of the thumb's contact over arm and thumb; by central differences again."""
    measures = JacobianMeasures(robot.description, closed_chain=True)
    q = robot.random(np.random.default_rng(3), 5)
    rows = np.zeros(5, [("q", "f8", q.shape[1]), ("phase", "u1")])
    rows["q"] = q
    names = [field.name for field in measures.fields]
    values = dict(zip(names, measures(rows).T, strict=True))
    description = robot.description
    columns = (*description.arm_actuators, *description.finger_actuators("thumb"))
    for row, x in enumerate(q):
        found, (_, normals) = [], robot.contacts(x)
        normal = normals[0]
        across = np.linalg.svd(normal[None])[2][1:]
        for column in columns:
            ahead, behind = x.copy(), x.copy()
            ahead[column] += STEP
            behind[column] -= STEP
            (p1, n1), (p2, n2) = robot.contacts(behind), robot.contacts(ahead)
            turned = across @ np.cross(normal, (n2[0] - n1[0]) / (2 * STEP))
            found.append([*(p2[0] - p1[0]) / (2 * STEP * LENGTH), *turned])
        s = np.linalg.svd(np.array(found).T, compute_uv=False)
        assert values["sigma_closed_chain"][row] == pytest.approx(s[-1], rel=1e-3)
        assert values["condition_closed_chain"][row] == pytest.approx(s[0] / s[-1], rel=1e-3)


def test_the_virtual_machine_measures_the_same(robot):
    q = robot.random(np.random.default_rng(5), 9)
    rows = np.zeros(9, [("q", "f8", q.shape[1]), ("phase", "u1")])
    rows["q"] = q
    fast, slow = (JacobianMeasures(robot.description, compiled=c)(rows) for c in (True, False))
    np.testing.assert_allclose(fast[:, ::2], slow[:, ::2], rtol=1e-4, atol=1e-6)


def test_info_tells_what_was_not_measured(write, tmp_path: Path, capsys, robot):
    """A log of rows without singular values says so, and does not say that nothing happened."""
    plain = Layout(tuple(f for f in FORMAT.layout if not f.name.startswith("sigma_")))
    form = dataclasses.replace(FORMAT, layout=plain, labels=LABELS, jacobians={})
    path = write(make_block(5, 5, form=form), name="bare.mcap")
    assert main(["log", "info", str(path)]) == 0
    assert "not measured" in capsys.readouterr().out
    solved = ik.Solver(robot).solve(ik.load_grasp("cup"), log=tmp_path / "cup.mcap")
    assert solved.success
    assert main(["log", "info", str(tmp_path / "cup.mcap")]) == 0
    shown = capsys.readouterr().out
    assert "not measured" not in shown
    assert "arm 0." in shown
