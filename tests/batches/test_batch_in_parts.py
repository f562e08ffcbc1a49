"""Batches in parts: the same answers whoever solves them, and nothing lost or done twice."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from commands import main
from dask_processes import scheduler_process, worker_process
from processes import POSIX

import casadi_ik as ik

ROBOT = ("--robot", "kuka_lwr_barrett")
COUNT, SIZE = 4000, 100
PARTS = ("--part-size", str(SIZE))


@pytest.fixture(scope="module")
def targets(robot: ik.ArmHand, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Targets that can be reached, one that cannot be asked, in one file."""
    points, normals = robot.contacts(robot.random(np.random.default_rng(4), COUNT))
    points[321, 0, 0] = np.inf
    path = tmp_path_factory.mktemp("targets") / "targets.npz"
    np.savez(path, points=points, normals=normals)
    return path


@pytest.fixture(scope="module")
def whole(targets: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """The answers of a batch in one go."""
    out = tmp_path_factory.mktemp("whole") / "out.npz"
    assert main(["batch", str(targets), *ROBOT, "--out", str(out)]) == 1
    return answers(out)


def answers(path: Path) -> dict[str, np.ndarray]:
    """What a file of answers holds but the times."""
    with np.load(path) as arrays:
        return {name: arrays[name] for name in arrays.files if name not in ("time", "row")}


def same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)


def begun(*words: object) -> subprocess.Popen[str]:
    """The command line as a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "casadi_ik", "batch", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": str(Path(ik.__file__).parents[1])},
    )


def wait_for_parts(folder: Path, least: int, process: subprocess.Popen[str]) -> list[Path]:
    """Wait until so many parts are there, or the process has ended."""
    end = time.monotonic() + 6000
    while time.monotonic() < end:
        parts = sorted(folder.glob("part-*.npz"))
        if len(parts) >= least or process.poll() is not None:
            return parts
        time.sleep(0.01)
    raise AssertionError(f"{folder}: fewer than {least} parts")


@POSIX
def test_killed_and_taken_up_again(targets: Path, whole: dict[str, np.ndarray], tmp_path: Path):
    """The client is killed; what it had finished is kept as it is, and the rest is done."""
    out, folder = tmp_path / "out.npz", tmp_path / "out.npz.parts"
    words = (targets, *ROBOT, *PARTS, "--resume", "--out", out, "--log", tmp_path / "logs")
    process = begun(*words)
    wait_for_parts(folder, 5, process)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    kept = {path: path.stat().st_mtime_ns for path in folder.glob("part-*.npz")}
    assert 5 <= len(kept) < COUNT // SIZE
    assert not out.exists()
    first = next(iter(kept))
    first.unlink()  # as if it had been lost
    before = {path: stamp for path, stamp in kept.items() if path != first}

    process = begun(*words)
    wait_for_parts(folder, len(kept) + 2, process)
    with contextlib.suppress(FileNotFoundError):  # it is through already
        assert {path: path.stat().st_mtime_ns for path in before} == before
    report, error = process.communicate(timeout=300)
    assert process.returncode == 1, error
    assert f"{COUNT - 1} of {COUNT}" in report
    same(answers(out), whole)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["logs", "out.npz"]
    log = ik.logs.open(tmp_path / "logs")
    assert len(log.solves()) == COUNT - 1


@POSIX
def test_terminated(targets: Path, tmp_path: Path):
    """SIGTERM to the client alone: the finished parts stay, its workers do not."""
    out = tmp_path / "out"
    process = begun(targets, *ROBOT, *PARTS, "--resume", "--jobs", "2", "--out", out)
    wait_for_parts(out, 3, process)
    process.terminate()
    _, error = process.communicate(timeout=600)
    assert process.returncode == 143
    assert error.splitlines()[-1] == "casadi-ik: error: terminated"
    assert len(list(out.glob("part-*.npz"))) >= 3
    end = time.monotonic() + 600
    while alive(process.pid) and time.monotonic() < end:
        time.sleep(0.05)
    assert not alive(process.pid)


def alive(group: int) -> bool:
    """Whether any process of a group is left."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.fixture
def cluster() -> Iterator[tuple[str, subprocess.Popen[str], list[subprocess.Popen[str]]]]:
    """A scheduler and two workers."""
    with ExitStack() as stack:
        scheduler, address = stack.enter_context(scheduler_process())
        workers = [stack.enter_context(worker_process(address)) for _ in range(2)]
        yield address, scheduler, workers


@pytest.mark.slow
