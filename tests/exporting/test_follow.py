"""Exported followers and palms equal Python, and keep limits for any input."""

from __future__ import annotations

import importlib.util
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from c_flags import SANITIZERS, STRICT
from commands import main
from excursions import excursion
from moved_base import on_pedestal
from processes import output_of

import casadi_ik as ik

pytestmark = pytest.mark.slow

PERIOD = 0.004

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")

FOLLOW_PROGRAM = """
#include <stdio.h>
#include "arm.h"
static arm_follower follower;
int main(void) { /* q0; then by cycle: points, normals, whether there is a palm, palm */
  double q0[ARM_MOTORS], row[6 * ARM_FINGERS + 13];
  int i;
  if (fread(q0, sizeof q0, 1, stdin) != 1) return 2;
  if (!arm_follow_from(&follower, q0, 0.0, 0, 0)) return 3;
  if (arm_follow_from(&follower, q0, PERIOD, 0, 0)) return 3;
  while (fread(row, sizeof row, 1, stdin) == 1) {
    const double *palm = row + 6 * ARM_FINGERS;
    printf("%d", arm_follow(&follower, row, row + 3 * ARM_FINGERS, *palm ? palm + 1 : 0));
    for (i = 0; i < ARM_MOTORS; ++i) printf(" %a", follower.q[i]);
    puts("");
  }
  return 0;
}
"""
PALMS = """
#include <stdio.h>
#include "arm.h"
static arm_solver solver;
int main(void) { /* palm, posture */
  double row[12 + ARM_MOTORS];
  arm_init(&solver);
  while (fread(row, sizeof row, 1, stdin) == 1) {
    int i;
    printf("%d", arm_solve_palm(&solver, row, row + 12, 0));
    for (i = 0; i < ARM_MOTORS; ++i) printf(" %a", solver.q[i]);
    puts("");
  }
  /* What was held for a palm is free again. */
  {
    double points[3 * ARM_FINGERS], normals[3 * ARM_FINGERS];
    arm_contacts(&solver, row + 12, points, normals);
    return arm_solve(&solver, points, normals, 0) != ARM_SOLVED;
  }
}
"""


def built(out: Path, name: str, text: str, sources: str, *flags: str) -> Path:
    (out / f"{name}.c").write_text(text.replace("PERIOD", repr(PERIOD)))
    files = [str(path.relative_to(out)) for path in out.glob(f"src/{sources}.c")]
    command = ["gcc", *STRICT, *flags, "-Iinclude", f"{name}.c", *files, "-o", name, "-lm"]
    output_of(*command, cwd=out)
    return out / name


def run_program(program: Path, *arrays: np.ndarray) -> tuple[list[int], np.ndarray]:
    """Run the program and return the status and configuration of each line."""
    data = b"".join(np.ascontiguousarray(array, dtype=float).tobytes() for array in arrays)
    lines = [line.split() for line in output_of(program, input=data).splitlines()]
    return [int(line[0]) for line in lines], np.array(
        [[float.fromhex(word) for word in line[1:]] for line in lines]
    )


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("follow") / "solver"
    words = ["export", "kuka_lwr_barrett", "--prefix", "arm", "--follow", "--out", str(out)]
    assert main(words) == 0
    return out


def stream(robot: ik.ArmHand, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return targets that move, jump, leave the reach, are partly free or invalid."""
    rng = np.random.default_rng(3)
    ends = np.clip(robot.home + rng.uniform(-0.2, 0.2, (6, 14)), robot.lower, robot.upper)
    part = np.linspace(0, 1, count // 5)[:, None]
    q = np.concatenate([a + part * (b - a) for a, b in zip(ends[::2], ends[1::2], strict=True)])
    q = np.concatenate([q, np.repeat(ends[:2], count // 5, axis=0)])
    points, normals = robot.contacts(q)
    points[count // 2 : count // 2 + 20] += 3.0
    points[30:60, 1] = normals[30:60, 1] = normals[70:90] = np.nan
    points[100:103, 0, 0], points[110, 2], normals[111, 0] = np.nan, np.inf, 0.0
    points[120:125] = normals[120:125] = np.nan
    points[130] = 1e200
    palms = np.zeros((len(q), 13))
    poses = robot.palm(q)
    palms[:, 1:] = np.hstack([poses[:, :3, :3].reshape(-1, 9), poses[:, :3, 3]])
    palms[40:50, 0] = palms[150:300, 0] = 1
    return points, normals, palms


@needs_gcc
def test_follower_matches_python_and_keeps_limits(robot, project):
    program = built(project, "followed", FOLLOW_PROGRAM, "arm_follow", "-O1", *SANITIZERS)
    points, normals, palms = stream(robot, 1000)
    rows = np.hstack([points.reshape(len(points), -1), normals.reshape(len(points), -1), palms])
    status, q = run_program(program, robot.home, rows)

    follower = ik.Solver(robot).follow(q0=robot.home, period=PERIOD)
    names = ("HOLDING", "FOLLOWING", "LATE", "MISSED")
    for row, (ended, q_row) in enumerate(zip(status, q, strict=True)):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = palms[row, 1:10].reshape(3, 3), palms[row, 10:]
        expected = follower(points[row], normals[row], pose if palms[row, 0] else None)
        assert names[ended] == follower.state.status.name, row
        np.testing.assert_array_equal(q_row, expected, f"row {row}")
    assert set(status) == {0, 1, 2, 3}

    steps = np.diff(np.vstack([robot.home, robot.home, q]), axis=0)
    assert (np.abs(steps) <= follower.velocity * PERIOD * (1 + 1e-9)).all()
    change = np.abs(np.diff(steps, axis=0))
    assert (change <= follower.acceleration * PERIOD**2 * (1 + 1e-6) + 1e-12).all()
    assert (q >= robot.lower).all()
    assert (q <= robot.upper).all()


@needs_gcc
def test_reachable_motion_is_followed_closely(robot, project):
    """The motors stand still in the last of four seconds, in which the target does."""
    program = built(project, "closely", FOLLOW_PROGRAM, "arm_follow", "-O1")
    second = round(1 / PERIOD)
    turn = np.append(np.linspace(0, 4, 500), np.full(4 * second, 4.0))[:, None, None]
    points, normals = robot.contacts(robot.home)
    points = points + 0.04 * np.concatenate([np.sin(turn), 1 - np.cos(turn), 0 * turn], axis=2)
    none = np.zeros((len(points), 13))
    facing = np.broadcast_to(normals.ravel(), (len(points), normals.size))
    rows = np.hstack([points.reshape(len(points), -1), facing, none])
    status, q = run_program(program, robot.home, rows)
    assert set(status) == {1}
    np.testing.assert_array_equal(q[-second:], q[-1:].repeat(second, axis=0))
    assert np.linalg.norm(robot.contacts(q)[0] - points, axis=2).max() < 2e-3


@needs_gcc
def test_return_path_matches_python(robot, project):
    program = built(project, "back", FOLLOW_PROGRAM, "arm_follow", "-O1", *SANITIZERS)
    rng = np.random.default_rng(7)
    postures = np.concatenate([robot.random(rng, 1) for _ in range(4)])
    start = robot.home + 0.5 * (postures[-1] - robot.home)
    targets = list(excursion(robot, start, "out", PERIOD))
    rows = np.array([[*points.ravel(), *normals.ravel()] for points, normals in targets])
    status, q = run_program(program, start, np.hstack([rows, np.zeros((len(rows), 13))]))
    follower = ik.Solver(robot).follow(start, PERIOD)
    expected = np.array([follower(*target) for target in targets])
    np.testing.assert_array_equal(q, expected)
    assert {1, 3} <= set(status)
    assert status[-1] == 1


CLUTCH_PROGRAM = """
#include <stdio.h>
#include "arm.h"
static arm_follower follower;
int main(void) { /* q0; measured q; then by cycle: points, normals, palm */
  double q0[ARM_MOTORS], measured[ARM_MOTORS], row[6 * ARM_FINGERS + 12];
  int i, cycle;
  if (fread(q0, sizeof q0, 1, stdin) != 1) return 2;
  if (fread(measured, sizeof measured, 1, stdin) != 1) return 2;
  if (arm_follow_from(&follower, q0, PERIOD, 0, 0)) return 3;
  for (cycle = 0; fread(row, sizeof row, 1, stdin) == 1; ++cycle) {
    if (cycle == 50) arm_pause(&follower);
    if (cycle == 150 && arm_resume(&follower, 0)) return 4;
    if (cycle == 250 && arm_resume(&follower, measured)) return 4;
    if (cycle == 300 && arm_follow_posture(&follower, q0)) return 4;
    printf("%d", arm_follow(&follower, row, row + 3 * ARM_FINGERS, row + 6 * ARM_FINGERS));
    for (i = 0; i < ARM_MOTORS; ++i) printf(" %a", follower.q[i]);
    puts("");
  }
  return 0;
}
"""


@needs_gcc
def test_clutch_matches_python(robot, project):
    """The measured posture is beyond a limit; the targets leap at the pauses."""
    program = built(project, "clutch", CLUTCH_PROGRAM, "arm_follow", "-O1", *SANITIZERS)
    share = np.linspace(0, 1, 600)[:, None]
    path = robot.home + 0.1 * share * np.sin(np.arange(14))
    points, normals = robot.contacts(path)
    points[100:200] += 0.3
    points[200:] -= 0.5
    normals[200:] = -normals[200:, :, [1, 2, 0]]
    poses = robot.palm(path)
    measured = path[250].copy()
    measured[3] = robot.lower[3] - 0.05
    measured[8] += 0.1
    start = path[0].copy()
    start[1] = robot.upper[1] + 0.02
    rows = [points.reshape(600, -1), normals.reshape(600, -1), poses[:, :3, :3].reshape(600, -1)]
    rows = np.hstack([*rows, poses[:, :3, 3]])
    status, q = run_program(program, start, measured, rows)
    follower = ik.Solver(robot).follow(start, PERIOD)
    names = ("HOLDING", "FOLLOWING", "LATE", "MISSED")
    for cycle in range(600):
        if cycle == 50:
            follower.pause()
        if cycle == 150:
            follower.resume()
        if cycle == 250:
            follower.resume(measured)
        if cycle == 300:
            follower.posture = start
        expected = follower(points[cycle], normals[cycle], poses[cycle])
        np.testing.assert_allclose(q[cycle], expected, atol=1e-9, err_msg=f"cycle {cycle}")
        assert names[status[cycle]] == follower.state.status.name, cycle
    assert status[50:150] == [0] * 100
    assert ((q[-1] >= robot.lower) & (q[-1] <= robot.upper)).all()


@needs_gcc
def test_palms_match_python(robot, project):
    program = built(project, "palms", PALMS, "*", "-O0", "-Isrc")
    q = robot.random(np.random.default_rng(4), 60)
    poses = robot.palm(q)
    poses[50:55, :3, 3] += 5.0
    palms = np.hstack([poses[:, :3, :3].reshape(-1, 9), poses[:, :3, 3]])
    wrong = palms[:1] * 2, np.where(np.arange(12) == 11, np.nan, palms[:1])
    status, statuses = run_program(
        program, *np.hstack([palms, q]), *(np.append(w, q[0]) for w in wrong)
    )
    assert status[60:] == [-2, -2]
    hand = robot.description.hand_actuators
    hands = {robot.actuators[i]: q[:, i] for i in hand}
    batch = ik.Solver(robot).solve_palms(poses, hands)
    assert status[:60] == batch.status.tolist()
    np.testing.assert_allclose(statuses[:60], batch.q, atol=1e-9)
    assert np.abs(robot.palm(statuses[:50])[:, :3, 3] - poses[:50, :3, 3]).max() < 5e-3
    np.testing.assert_array_equal(statuses[:50][:, list(hand)], q[:50][:, list(hand)])


def test_single_precision_has_no_follower(tmp_path, capsys):
    words = ["export", "kuka_lwr_barrett", "--follow", "--single", "--out", str(tmp_path / "s")]
    assert main(words) == 2
    assert "--follow: " in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


USE_PROGRAM = """
import { FollowStatus, Solver, home, motors, upper } from "./arm.js";
const solver = await Solver.load(), rows = [];
solver.followFrom(home, { period: 0.004 });
let last;
for (let i = 0; i < 200; ++i) {
  const { points, normals } = solver.contacts(home.map((x, k) => x + 5e-4 * i * (upper[k] - x)));
  last = solver.follow(points, normals);
  rows.push([...last.q]);
}
const ended = last.status === FollowStatus.FOLLOWING && Math.max(...last.positionError) < 1e-3;
const length = last.velocity.length === motors.length;
let refused = false;
try { solver.followFrom(home, { period: 0 }); }
catch (error) { refused = error instanceof RangeError; }
console.log(JSON.stringify({ rows, ended, refused, length }));
"""


@pytest.mark.skipif(
    shutil.which("node") is None or importlib.util.find_spec("ziglang") is None,
    reason="needs node and the package ziglang",
)
def test_javascript_follower_matches(tmp_path):
    out = tmp_path / "module"
    words = ["export", "ar10", "--prefix", "arm", "--target", "wasm", "--follow"]
    assert main([*words, "--out", str(out)]) == 0
    (out / "use.mjs").write_text(USE_PROGRAM)
    answers = json.loads(output_of("node", "use.mjs", cwd=out))
    assert (answers["ended"], answers["refused"], answers["length"]) == (True, True, True)
    robot = ik.load_robot("ar10")
    follower = ik.Solver(robot).follow(q0=robot.home, period=0.004)
    for i, row in enumerate(answers["rows"]):
        targets = robot.contacts(robot.home + 5e-4 * i * (robot.upper - robot.home))
        np.testing.assert_allclose(row, follower(*targets), atol=1e-9)


SOLVED = """
#include <stdio.h>
#include "arm.h"
static arm_solver solver;
int main(void) { /* q0, points, normals */
  double row[ARM_MOTORS + 6 * ARM_FINGERS];
  int i;
  arm_init(&solver);
  while (fread(row, sizeof row, 1, stdin) == 1) {
    const double *points = row + ARM_MOTORS;
    printf("%d", arm_solve(&solver, points, points + 3 * ARM_FINGERS, row));
    for (i = 0; i < ARM_MOTORS; ++i) printf(" %a", solver.q[i]);
    puts("");
  }
  return 0;
}
"""


@needs_gcc
def test_joint_without_limits_is_continuous(tmp_path):
    """A solver answers in the turn nearest to q0, and a follower turns continuously."""
    source = on_pedestal(ik.load_robot("ur5e+panda_hand"), tmp_path, continuous=("ur5e_joint_1",))
    out = tmp_path / "solver"
    words = ["export", str(source.description.path), "--prefix", "arm", "--follow"]
    assert main([*words, "--out", str(out)]) == 0
    count = 1500
    q = np.tile([5.0, -1.2, 1.1, -0.6, -1.3, 0.5, 0.02], (count, 1))
    q[:, 0] += np.pi * (1 - np.cos(np.linspace(0, np.pi, count)))
    points, normals = source.contacts(q)
    targets = np.concatenate([points.reshape(count, -1), normals.reshape(count, -1)], axis=1)
    program = built(out, "solved", SOLVED, "arm_*")
    statuses, answers = run_program(program, np.concatenate([q - 0.1, targets], axis=1)[::100])
    assert set(statuses) == {1}
    assert np.abs(answers[:, 0] - q[::100, 0]).max() < 1.0
    program = built(out, "followed", FOLLOW_PROGRAM, "arm_follow", "-O1")
    palms = np.zeros((count, 13))
    statuses, answers = run_program(program, q[0], np.concatenate([targets, palms], axis=1))
    assert set(statuses) == {1}
    assert np.abs(answers[:, 0] - q[:, 0]).max() < 0.5
    follower = ik.Solver(source).follow(q0=q[0], period=PERIOD)
    states = [follower(*target) for target in zip(points, normals, strict=True)]
    np.testing.assert_allclose(states, answers, atol=1e-6)
