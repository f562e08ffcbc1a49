"""Refusals of a recorder, and logs after failed writes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up_solves import LABELS, T0, Field, Layout, TraceFormat, changed, make_block
from processes import NOT_ROOT, POSIX, file_size_limit

from casadi_ik import errors, logs

Write = Callable[..., Path]


def record_many(path: Path, blocks: int) -> None:
    """Record blocks of six solves with 1000 iterations each, which is more than a chunk."""
    with logs.McapRecorder(path, robot_name="made_up", compression="none") as recorder:
        for i in range(blocks):
            recorder.record(make_block(*[1000] * 6, first=6 * i))


@POSIX
@pytest.mark.parametrize(
    ("capacity", "solves"),
    [(0, 0), (100, 0), (20_000, 0), (3_000_000, 6), (7_300_000, 18), (-100, 24)],
)
def test_disk_full(tmp_path: Path, capacity: int, solves: int) -> None:
    """A first chunk that does not fit leaves nothing; every other complete chunk is read.

    A negative capacity is short of the whole log by so many bytes, which the summary lacks.
    """
    path = tmp_path / "cup.mcap"
    if capacity < 0:
        record_many(tmp_path / "whole.mcap", 4)
        capacity += (tmp_path / "whole.mcap").stat().st_size
    with file_size_limit(capacity), pytest.raises(errors.LogError) as caught:
        record_many(path, 4)
    assert str(path) in str(caught.value)
    assert isinstance(caught.value.__cause__, OSError)
    if not solves:
        assert list(tmp_path.iterdir()) == []
        return
    log = logs.open(path)
    assert log.info().unfinished == (path,)
    assert len(log.solves()) >= solves
    rows = log.iterations(solve=0)
    assert rows.rows.tobytes() == make_block(1000).rows.tobytes()


@POSIX
def test_paths_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    cases = {
        tmp_path / "folder": "is a directory",
        tmp_path / "none" / "cup.mcap": "No such file or directory",
        tmp_path / "file" / "cup.mcap": "Not a directory",
        tmp_path / ("x" * 300): "name too long",
        Path("/dev/null"): "not a regular file",
    }
    for path, reason in cases.items():
        with pytest.raises(errors.LogError, match=reason) as caught:
            logs.McapRecorder(path, robot_name="made_up")
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]


@NOT_ROOT
def test_a_read_only_folder(tmp_path: Path) -> None:
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o500)
    with pytest.raises(errors.LogError, match="Permission denied"):
        logs.McapRecorder(folder / "cup.mcap", robot_name="made_up")
    assert list(folder.iterdir()) == []


def test_two_writers_on_one_path(tmp_path: Path) -> None:
    """A second writer is refused in the same process and in another; the first log is unchanged."""
    path = tmp_path / "cup.mcap"
    program = (
        "import sys\nfrom casadi_ik import errors, logs\n"
        "try: logs.McapRecorder(sys.argv[1], robot_name='r')\n"
        "except errors.LogError as error: print(error)\n"
    )
    with logs.McapRecorder(path, robot_name="made_up") as recorder:
        with pytest.raises(errors.LogError, match=r"cup\.mcap:.*log:"):
            logs.McapRecorder(path, robot_name="made_up")
        second_writer = subprocess.run(
            [sys.executable, "-c", program, path], capture_output=True, text=True, check=True
        )
        assert "another writer" in second_writer.stdout
        recorder.record(make_block(10))
    assert len(logs.open(path).solves()) == 1
    with logs.McapRecorder(path, robot_name="made_up"):
        pass
    assert len(logs.open(path).solves()) == 0


def test_existing_log_is_kept_until_the_first_chunk(tmp_path: Path) -> None:
    path = tmp_path / "cup.mcap"
    path.write_bytes(b"an older log")

    def fail() -> None:
        with logs.McapRecorder(path, robot_name="made_up") as recorder:
            recorder.record(make_block(10))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert path.read_bytes() == b"an older log"
    path.unlink()
    with pytest.raises(KeyboardInterrupt):
        fail()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("written", [0, 1, 2])
def test_an_interrupt_while_a_chunk_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: int
) -> None:
    """The log continues before the interrupted chunk, whose bytes are overwritten."""
    write, calls = os.write, []

    def interrupted(descriptor: int, data: Any) -> int:
        done = write(descriptor, data)
        calls.append(done)
        if len(calls) == written + 1:
            raise KeyboardInterrupt
        return done

    monkeypatch.setattr("casadi_ik.logs.chunk_writer.os.write", interrupted)
    path = tmp_path / "cup.mcap"
    with pytest.raises(KeyboardInterrupt):
        record_many(path, 4)
    if not written:
        assert list(tmp_path.iterdir()) == []
        return
    log = logs.open(path)
    assert log.info().unfinished == ()
    assert log.info().chunks == written
    solves = len(log.solves())
    assert log.iterations().rows.tobytes() == make_block(*[1000] * solves).rows.tobytes()


def test_a_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    link = tmp_path / "link.mcap"
    link.symlink_to(tmp_path / "real" / "cup.mcap")
    with logs.McapRecorder(link, robot_name="made_up") as recorder:
        recorder.record(make_block(5))
    assert link.is_symlink()
    assert len(logs.open(link).solves()) == 1


def test_contradictory_blocks_leave_the_log_usable(tmp_path: Path) -> None:
    path = tmp_path / "cup.mcap"
    good = make_block(5, 5)
    other_format = TraceFormat(Layout.record(Field("q", (3,))), LABELS)
    bad = {
        "solve 1 is already in the log": make_block(5, 5, first=1),
        "rows do not have the layout": changed(make_block(3, first=8), format=other_format),
        r"found rows of shape \(3,\), expected \(4,\)": changed(
            make_block(3, first=8), iterations=np.array([4])
        ),
        "layout or labels differ": make_block(1, first=2, form=other_format),
        "lower_snake_case": make_block(
            1, method="new", form=TraceFormat(Layout.record(Field("J")))
        ),
        f"{2**32} .* range of log times": make_block(1, first=2**32),
        "-1 .* range of log times": changed(make_block(1), first=-1),
    }
    with logs.McapRecorder(path, robot_name="made_up", clock=logs.LogClock(T0)) as recorder:
        recorder.record(good)
        for reason, block in bad.items():
            with pytest.raises(errors.LogError, match=reason):
                recorder.record(block)
        recorder.record(make_block(5, first=6))
    log = logs.open(path)
    assert log.solves().solve_id.tolist() == [0, 1, 6]
    assert log.methods == ("enhanced-dls",)
    with pytest.raises(errors.LogError, match="closed"):
        recorder.record(make_block(5, first=7))


@pytest.mark.parametrize(
    "options", [{"sample": 1.5}, {"sample": float("nan")}, {"seed": -1}, {"seed": 0.5}]
)
def test_bad_policies_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(errors.InputError, match=rf"keep\.{next(iter(options))}: found"):
        logs.Keep(**options)


def test_unknown_compression(tmp_path: Path) -> None:
    with pytest.raises(errors.LogError, match=r"'gzip'.*none, lz4, zstd"):
        logs.McapRecorder(tmp_path / "a", robot_name="r", compression="gzip")  # type: ignore[arg-type]


def test_metadata_is_complete(write: Write) -> None:
    parameters = {
        "damping": 0.1,
        "limits": np.array([1.0, np.inf]),
        "nested": {"a": (1, None, True)},
        "path": Path("x"),
    }
    path = write(
        make_block(50, first=1),
        make_block(10, first=3),
        urdf="<robot name='é'/>",
        parameters=parameters,
        seed=7,
        keep=logs.Keep(sample=0.5, seed=3),
        rules=logs.EventRules(singular={"arm": 0.02}),
    )
    log = logs.open(path)
    info = log.info()
    metadata = info.metadata
    assert metadata["robot"] == info.robot == "made_up"
    assert (metadata["seed"], metadata["format"]) == ("7", "2")
    assert metadata["keep"] == {"failed": True, "singular": True, "sample": 0.5, "seed": 3}
    assert (metadata["t0_ns"], metadata["slot_ns"]) == (str(T0), "60000000000")
    assert metadata["iteration_ns"] == "1000000"
    assert {"casadi", "numpy", "mcap"} <= set(metadata["packages"])
    assert metadata["packages"]["numpy"] == np.__version__
    assert metadata["machine"]["cores"] == os.cpu_count()
    assert metadata["code_version"] != "not installed"
    assert {"created", "python", "compression"} <= set(metadata)
    logged_parameters = metadata["parameters"]
    assert logged_parameters["limits"] == [1.0, "inf"]
    assert (
        logged_parameters["damping"],
        logged_parameters["nested"],
        logged_parameters["path"],
    ) == (0.1, {"a": [1, None, True]}, "x")
    assert logged_parameters["event_rules"]["singular"] == {"arm": 0.02}
    assert info.attachments == {"robot.urdf": len("<robot name='é'/>".encode())}
    assert log.attachment("robot.urdf").decode() == "<robot name='é'/>"
    with pytest.raises(errors.UnknownNameError, match=r"'x'; attached:"):
        log.attachment("x")
    assert info.size == path.stat().st_size
    assert (info.compression, info.chunks) == ("zstd", 1)
    assert 0 < info.compressed < info.uncompressed


def test_solve_without_room_for_iterations_has_its_totals(tmp_path: Path) -> None:
    path = tmp_path / "long.mcap"
    clock = logs.LogClock(T0, slot=5_000_000)
    with logs.McapRecorder(path, robot_name="made_up", clock=clock) as recorder:
        recorder.record(make_block(5, 6, 4))
    log = logs.open(path)
    solves = log.solves().array()
    assert (solves["kept"].tolist(), solves["iterations"].tolist()) == ([1, 0, 1], [5, 6, 4])
    assert log.iterations().solve_id.tolist() == [0] * 5 + [2] * 4
    assert log.solves(solve=[1]).solve_id.tolist() == [1]


LIMIT = 3 * 2**21


@pytest.fixture
def small_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Set a small size limit of records."""
    monkeypatch.setattr("casadi_ik.logs.chunks.RECORD_LIMIT", LIMIT)


@pytest.mark.usefixtures("small_limit")
def test_every_written_solve_is_readable(tmp_path: Path) -> None:
    """Solves that do not fit a record are refused, and all others are read."""
    path = tmp_path / "x.mcap"
    lengths, refused = range(1000, 9001, 500), []
    with logs.McapRecorder(path, robot_name="made_up", compression="lz4") as recorder:
        for number, length in enumerate(lengths):
            try:
                recorder.record(make_block(200, length, first=2 * number))
            except errors.LogError:
                refused.append(length)
    written = [length for length in lengths if length not in refused]
    assert refused == list(lengths)[len(written) :]
    assert max(written) >= 4000 < min(refused)
    assert logs.open(path).iterations().rows.size == sum(200 + length for length in written)
    assert logs.open(path).solves().solve_id.tolist() == list(range(2 * len(written)))


@pytest.mark.usefixtures("small_limit")
@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"urdf": " " * LIMIT}, "attachment 'robot.urdf'"),
        ({"parameters": {"note": "x" * LIMIT}}, "the metadata"),
    ],
)
def test_oversized_attachments_are_refused(tmp_path: Path, fields: dict, says: str) -> None:
    with pytest.raises(errors.LogError, match=rf"x\.mcap: {says}.*\d+.*6291456"):
        logs.McapRecorder(tmp_path / "x.mcap", robot_name="made_up", **fields)
    assert list(tmp_path.iterdir()) == []
