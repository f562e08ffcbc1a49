"""First answers of a robot, while its C code is compiled in the background."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from compilation import forbid_builds, forget
from processes import python
from toy_robots import grasp_of

import casadi_ik as ik
from casadi_ik.compile.compiler import find_compiler
from casadi_ik.export.project import kernel_uses

pytestmark = pytest.mark.skipif(
    find_compiler() is None or os.name != "posix", reason="needs a C compiler, and POSIX's signals"
)

SOLVE = """
    import sys
    import casadi_ik as ik
    solver = ik.Solver(ik.load_robot("kuka_lwr_barrett"), scene={scene})
    answers = [solver.solve(ik.load_grasp("cup")) for _ in range(3)]
    assert all(answer.success for answer in answers)
    print(*answers[-1].q.tolist())
"""


def run(cache: Path, policy: str, scene: str = "None") -> tuple[np.ndarray, str]:
    """Return the answer of another process, and its output."""
    changed = {"CASADI_IK_CACHE": str(cache), "CASADI_IK_COMPILE": policy}
    done = python("-c", SOLVE.format(scene=scene), env=changed, check=True)
    return np.array(done.stdout.split(), dtype=float), done.stderr


def loops(cache: Path) -> list[Path]:
    return list(cache.glob("hand_first_kuka_lwr_barrett*.so"))


def workers(cache: Path) -> list[int]:
    """Function that starts processes with a cache of their own."""
    workers_found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            process_files = (place / "environ").read_bytes(), (place / "cmdline").read_bytes()
        except OSError:
            continue
        if (
            f"CASADI_IK_CACHE={cache}\0".encode() in process_files[0]
            and b"first_answer" in process_files[1]
        ):
            workers_found.append(int(place.name))
    return workers_found


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["None", "ik.load_scene('table')"])
def test_virtual_machine_answers_during_compilation(tmp_path: Path, scene: str) -> None:
    early, lines = run(tmp_path, "background", scene)
    assert lines.startswith("kuka_lwr_barrett: ")
    assert "background (about 6 s" in lines
    assert lines.count("\n") == 1
    if not Path("/proc/self/environ").exists():
        pytest.skip("how processes are found is Linux's")
    until = time.monotonic() + 500
    while workers(tmp_path) and time.monotonic() < until:
        time.sleep(0.2)
    assert len(loops(tmp_path)) == 2  # one after the other, and side by side
    assert not list(tmp_path.glob("build-*"))
    late, lines = run(tmp_path, "background", scene)
    assert lines == ""
    np.testing.assert_allclose(late, early, rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="how processes are found")
def test_background_compilation_may_be_killed(tmp_path: Path) -> None:
    early, _ = run(tmp_path, "background")
    for number in workers(tmp_path):
        os.killpg(number, signal.SIGKILL)
    late, lines = run(tmp_path, "wait")
    assert lines == ""
    np.testing.assert_allclose(late, early, rtol=0, atol=1e-9)
    assert loops(tmp_path)


@pytest.mark.slow
def test_harder_targets_wait_for_the_compiler(
    robot: ik.ArmHand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Answers do not depend on the state of the compilation."""
    points, normals = robot.contacts(robot.home)
    grasp = grasp_of(robot, points + 5.0, normals)
    expected = ik.Solver(robot).solve(grasp)
    monkeypatch.setenv("CASADI_IK_CACHE", str(tmp_path))
    monkeypatch.setenv("CASADI_IK_COMPILE", "background")
    solution = ik.Solver(robot).solve(grasp)
    assert (solution.status, solution.q.tobytes()) == (expected.status, expected.q.tobytes())
    for number in workers(tmp_path):
        os.killpg(number, signal.SIGKILL)


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="needs a C compiler")
def test_nothing_is_compiled_after_preparation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CASADI_IK_CACHE", str(tmp_path))

    def through_all_uses() -> list[str]:
        forget(monkeypatch)
        done = []
        for use_name, use in kernel_uses(ik.load_robot("ar10"), everything=True):
            use()
            done.append(use_name)
        return done

    done = through_all_uses()
    assert {"one target", "batches", "scenes", "choices", "ways to a grasp", "followers"} <= {*done}

    forbid_builds(monkeypatch)
    monkeypatch.setattr(subprocess, "Popen", None)
    assert through_all_uses() == done
