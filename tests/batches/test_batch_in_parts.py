"""Batches in parts give the same answers on every kind of worker, and lose or repeat nothing."""

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
    """Write reachable targets and a malformed one into a file."""
    points, normals = robot.contacts(robot.random(np.random.default_rng(4), COUNT))
    points[321, 0, 0] = np.inf
    path = tmp_path_factory.mktemp("targets") / "targets.npz"
    np.savez(path, points=points, normals=normals)
    return path


@pytest.fixture(scope="module")
def unbroken_answers(
    targets: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, np.ndarray]:
    """Return the answers of the batch in one part."""
    out = tmp_path_factory.mktemp("whole") / "out.npz"
    assert main(["batch", str(targets), *ROBOT, "--out", str(out)]) == 1
    return answers(out)


def answers(path: Path) -> dict[str, np.ndarray]:
    """Return the content of a file of answers without its times."""
    with np.load(path) as arrays:
        return {name: arrays[name] for name in arrays.files if name not in ("time", "row")}


def assert_same_arrays(actual: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    assert actual.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(actual[name], array, err_msg=name)


def begun(*words: object) -> subprocess.Popen[str]:
    """Start the command line in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "casadi_ik", "batch", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": str(Path(ik.__file__).parents[1])},
    )


def wait_for_parts(folder: Path, minimum: int, process: subprocess.Popen[str]) -> list[Path]:
    """Wait until that many parts exist or the process has ended."""
    end = time.monotonic() + 6000
    while time.monotonic() < end:
        parts = sorted(folder.glob("part-*.npz"))
        if len(parts) >= minimum or process.poll() is not None:
            return parts
        time.sleep(0.01)
    raise AssertionError(f"{folder}: fewer than {minimum} parts")


@pytest.mark.slow
@POSIX
def test_killed_batch_resumes(
    targets: Path, unbroken_answers: dict[str, np.ndarray], tmp_path: Path
):
    """After the client is killed, its finished parts are kept and only the others are solved."""
    out, folder = tmp_path / "out.npz", tmp_path / "out.npz.parts"
    words = (targets, *ROBOT, *PARTS, "--resume", "--out", out, "--log", tmp_path / "logs")
    process = begun(*words)
    wait_for_parts(folder, 5, process)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    stamps = {path: path.stat().st_mtime_ns for path in folder.glob("part-*.npz")}
    assert 5 <= len(stamps) < COUNT // SIZE
    assert not out.exists()
    first = next(iter(stamps))
    first.unlink()  # as if it had been lost
    kept_stamps = {path: stamp for path, stamp in stamps.items() if path != first}

    process = begun(*words)
    wait_for_parts(folder, len(stamps) + 2, process)
    with contextlib.suppress(FileNotFoundError):  # it is through already
        assert {path: path.stat().st_mtime_ns for path in kept_stamps} == kept_stamps
    report, error = process.communicate(timeout=300)
    assert process.returncode == 1, error
    assert f"{COUNT - 1} of {COUNT}" in report
    assert_same_arrays(answers(out), unbroken_answers)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["logs", "out.npz"]
    log = ik.logs.open(tmp_path / "logs")
    assert len(log.solves()) == COUNT - 1


@pytest.mark.slow
@POSIX
def test_terminated_batch_resumes(targets: Path, tmp_path: Path):
    """After SIGTERM to the client alone, finished parts are kept and its workers end."""
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
    """Return whether any process of a group is running."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.fixture
def cluster() -> Iterator[tuple[str, subprocess.Popen[str], list[subprocess.Popen[str]]]]:
    """Start a scheduler and two workers."""
    with ExitStack() as stack:
        scheduler, address = stack.enter_context(scheduler_process())
        workers = [stack.enter_context(worker_process(address)) for _ in range(2)]
        yield address, scheduler, workers


@pytest.mark.slow
@POSIX
def test_cluster_survives_lost_worker_and_scheduler(
    cluster, targets: Path, unbroken_answers: dict[str, np.ndarray], tmp_path: Path
):
    address, scheduler, workers = cluster
    out = tmp_path / "out"
    words = (targets, *ROBOT, *PARTS, "--resume", "--dask", address, "--out", out)
    process = begun(*words)
    wait_for_parts(out, 5, process)
    workers[0].kill()
    part_count = len(wait_for_parts(out, 12, process))
    assert part_count >= 12
    scheduler.kill()
    report, error = process.communicate(timeout=6000)
    if process.returncode == 2:
        assert report == ""
        assert f"casadi-ik: error: --dask {address}: " in error
        assert "--resume" in error
        assert "Traceback" not in error
    else:  # it was faster than the kill
        assert process.returncode == 1, error

    assert main(["batch", str(targets), *ROBOT, *PARTS, "--resume", "--out", str(out)]) == 1
    parts = [answers(path) for path in sorted(out.glob("part-*.npz"))]
    assert len(parts) == COUNT // SIZE
    joined_answers = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    assert_same_arrays(joined_answers, unbroken_answers)


def test_folder_of_files_and_table_give_the_same_answers(
    targets: Path, robot: ik.ArmHand, unbroken_answers: dict[str, np.ndarray], tmp_path: Path
):
    """Write the batch to a Parquet file, then to an npz file."""
    with np.load(targets) as arrays:
        points, normals = arrays["points"][:250].copy(), arrays["normals"][:250]
    columns = {
        f"{finger}_{axis}": array[:, i, j]
        for i, finger in enumerate(robot.fingers)
        for endings, array in ((("x", "y", "z"), points), (("nx", "ny", "nz"), normals))
        for j, axis in enumerate(endings)
    }
    folder = tmp_path / "targets"
    folder.mkdir()
    pl.DataFrame(columns)[:130].write_parquet(folder / "a.parquet")
    np.savez(folder / "b.npz", points=points[130:], normals=normals[130:])
    out = tmp_path / "out.npz"
    assert main(["batch", str(folder), *ROBOT, *PARTS, "--out", str(out)]) == 0
    assert_same_arrays(
        answers(out), {name: array[:250] for name, array in unbroken_answers.items()}
    )


Change = Callable[[Path], list[str]]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda _: [], "out: holds parts of this batch"),
        (lambda _: ["--resume", "--seed", "7"], "seed: parts have 0, this batch has 7"),
        (lambda out: _damage(out), "damaged"),
        (
            lambda out: _copy(out),
            "part-000001.npz: row: found 10 targets from 0 on, expected 10 targets from 10 on",
        ),
    ],
)
def test_existing_parts_must_match(
    change: Change, says: str, robot: ik.ArmHand, tmp_path: Path, capsys
):
    points, normals = robot.contacts(robot.random(np.random.default_rng(4), 20))
    path, out = tmp_path / "targets.npz", tmp_path / "out"
    np.savez(path, points=points, normals=normals)
    words = ["batch", str(path), *ROBOT, "--part-size", "10", "--out", str(out)]
    assert main(words) == 0
    capsys.readouterr()
    assert main([*words, *change(out)]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


def _damage(out: Path) -> list[str]:
    path = out / "part-000001.npz"
    path.write_bytes(path.read_bytes()[:100])
    return ["--resume"]


def _copy(out: Path) -> list[str]:
    (out / "part-000001.npz").write_bytes((out / "part-000000.npz").read_bytes())
    return ["--resume"]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("missing.parquet", "missing.parquet: not a Parquet file"),
        ("empty", "contains no .npz or .parquet file"),
        ("other.parquet", "thumb_x: missing, expected columns thumb_x"),
    ],
)
def test_bad_targets(name: str, says: str, tmp_path: Path, capsys):
    (tmp_path / "empty").mkdir()
    pl.DataFrame({"x": [1.0]}).write_parquet(tmp_path / "other.parquet")
    out = tmp_path / "out"
    assert main(["batch", str(tmp_path / name), *ROBOT, "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize("missing", ["joblib", "polars"])
def test_missing_extra_leaves_no_files(
    missing: str, robot: ik.ArmHand, tmp_path: Path, capsys, monkeypatch
):
    """The error appears before anything is written that would need --resume."""
    points, normals = robot.contacts(robot.random(np.random.default_rng(4), 2))
    path = tmp_path / "targets.npz"
    np.savez(path, points=points, normals=normals)
    if missing == "polars":
        path = path.rename(tmp_path / "targets.parquet")
    monkeypatch.setitem(sys.modules, missing, None)
    for out in (tmp_path / "out.npz", tmp_path / "out"):
        assert main(["batch", str(path), *ROBOT, "--resume", "--out", str(out)]) == 2
        error = capsys.readouterr().err
        assert f"pip install {missing}" in error
        assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == [path]


def test_answers_are_written_as_npz_table_or_folder(
    targets: Path, tmp_path: Path, capsys, unbroken_answers
):
    assert main(["batch", str(targets), *ROBOT, "--out", str(tmp_path / "out.csv")]) == 2
    error = capsys.readouterr().err
    assert "out.csv', expected OUT.npz" in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
    out = tmp_path / "out.parquet"
    assert main(["batch", str(targets), *ROBOT, "--out", str(out)]) == 1
    np.testing.assert_array_equal(pl.read_parquet(out)["success"], unbroken_answers["success"])


@pytest.mark.slow
@POSIX
@pytest.mark.parametrize("wait_for", ["out.npz.parts", "out.npz.parts/part-*.npz"])
def test_termination_leaves_no_partial_file(targets: Path, tmp_path: Path, wait_for: str) -> None:
    """After SIGTERM only complete parts with their logs remain; without a part, nothing."""
    out, logs = tmp_path / "out.npz", tmp_path / "logs"
    process = begun(targets, *ROBOT, *PARTS, "--jobs", 2, "--out", out, "--log", logs)
    while process.poll() is None and not list(tmp_path.glob(wait_for)):
        time.sleep(0.01)
    process.terminate()
    output = process.communicate(timeout=6000)
    assert process.returncode == 143, output
    parts = sorted((tmp_path / "out.npz.parts").glob("part-*.npz"))
    left = {path for path in tmp_path.rglob("*") if path.is_file()}
    written = set(logs.glob("part-*.mcap"))
    manifest = {tmp_path / "out.npz.parts" / "batch.json"} if parts else set()
    assert left == {*parts, *written, *manifest}
    assert {path.stem for path in written} >= {path.stem for path in parts}
    assert all(len(answers(part)["q"]) == SIZE for part in parts)
    assert all(len(ik.logs.open(log).solves()) == SIZE for log in written)
