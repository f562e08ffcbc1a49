"""What goes wrong with files: one `LogError` with path and reason, nothing half-written."""

from __future__ import annotations

import dataclasses
import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
from made_up_solves import LAYOUT, T0, make_solve
from mcap.writer import Writer

from casadi_ik.errors import LogError, UnknownNameError
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.logs import EventRules, LogClock, McapRecorder, open_log
from casadi_ik.logs.cdr import Codec
from casadi_ik.solvers.recorder import Event, EventKind, Recorder, SolveRecord

Write = Callable[..., Path]


class FullDisk:
    """A file on a disk that has room for so many bytes."""

    def __init__(self, stream: IO[bytes], room: int) -> None:
        self._stream = stream
        self._room = room

    def write(self, data: Any) -> int:
        self._room -= len(data)
        if self._room < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._stream.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@pytest.mark.parametrize("room", [0, 100, 1500, 20_000, 200_000])
def test_disk_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int) -> None:
    """The disk fills while opening, in a chunk or while finishing; the old log stays."""
    path = tmp_path / "cup.mcap"
    path.write_bytes(b"an older log")
    opened = McapRecorder._open_part
    monkeypatch.setattr(McapRecorder, "_open_part", lambda self: FullDisk(opened(self), room))

    def run() -> None:
        with McapRecorder(path, robot_name="made_up", compression="none") as recorder:
            for i in range(5):
                recorder.record(make_solve(i, rows=1000))

    with pytest.raises(LogError, match=r"cup\.mcap: cannot write the log: No space left") as caught:
        run()
    assert isinstance(caught.value.__cause__, OSError)
    assert [p.name for p in tmp_path.iterdir()] == ["cup.mcap"]
    assert path.read_bytes() == b"an older log"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_disk_full_as_the_system_says_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A buffered file whose write fails late, when it is flushed or closed."""

    def open_full(self: McapRecorder) -> IO[bytes]:
        self._part.symlink_to("/dev/full")
        return self._part.open("wb")

    monkeypatch.setattr(McapRecorder, "_open_part", open_full)
    recorder = McapRecorder(tmp_path / "cup.mcap", robot_name="made_up")
    recorder.record(make_solve(0, rows=10))
    with pytest.raises(LogError, match="No space left"):
        recorder.close()
    assert list(tmp_path.iterdir()) == []
    recorder.close()


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
        with pytest.raises(LogError, match=reason) as caught:
            McapRecorder(path, robot_name="made_up")
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]


def test_a_read_only_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As root nothing is read-only: then only the refusal is made up."""
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o500)
    if os.access(folder, os.W_OK):

        def refuse(self: McapRecorder) -> IO[bytes]:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

        monkeypatch.setattr(McapRecorder, "_open_part", refuse)
    with pytest.raises(LogError, match="Permission denied"):
        McapRecorder(folder / "cup.mcap", robot_name="made_up")
    assert list(folder.iterdir()) == []


def test_nothing_is_there_before_close_nor_after_a_failure(tmp_path: Path) -> None:
    path = tmp_path / "cup.mcap"
    recorder: Recorder
    with McapRecorder(path, robot_name="made_up") as recorder:
        recorder.record(make_solve(0))
        assert not path.exists()
        assert len(list(tmp_path.glob(".cup.mcap.*.part"))) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["cup.mcap"]
    before = path.read_bytes()

    def fail() -> None:
        with McapRecorder(path, robot_name="made_up") as recorder:
            recorder.record(make_solve(1))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert [p.name for p in tmp_path.iterdir()] == ["cup.mcap"]
    assert path.read_bytes() == before


def test_a_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    link = tmp_path / "link.mcap"
    link.symlink_to(tmp_path / "real" / "cup.mcap")
    with McapRecorder(link, robot_name="made_up") as recorder:
        recorder.record(make_solve(0))
    assert link.is_symlink()
    assert len(open_log(link).solves()) == 1


def test_records_that_contradict_leave_the_log_usable(tmp_path: Path) -> None:
    path = tmp_path / "cup.mcap"
    good = make_solve(0)
    other = Layout.record(Field("q", (3,)))
    wild = make_solve(5).summary

    def of_number(solve_id: int) -> SolveRecord:
        return dataclasses.replace(good, summary=dataclasses.replace(wild, solve_id=solve_id))

    bad = {
        "already in the log": good,
        "not of its layout": dataclasses.replace(make_solve(8), layout=other),
        "layout differs": make_solve(1, layout=other),
        "outside the trace": dataclasses.replace(
            make_solve(2), events=(Event(50, EventKind.RESTART, "", 0.0, 0.0),)
        ),
        "lower_snake_case": make_solve(3, "new", layout=Layout.record(Field("J"))),
        "room for 60000": make_solve(4, rows=60_001, layout=LAYOUT),
        "no time for a solve": of_number(2**32),
        "solve -1": of_number(-1),
        "'seed'": dataclasses.replace(good, summary=dataclasses.replace(wild, seed=2**63)),
    }
    with McapRecorder(path, robot_name="made_up", clock=LogClock(T0)) as recorder:
        recorder.record(good)
        for reason, record in bad.items():
            with pytest.raises(LogError, match=reason):
                recorder.record(record)
        recorder.record(make_solve(6))
    log = open_log(path)
    assert [solve.solve_id for solve in log.solves()] == [0, 6]
    assert log.methods == ("enhanced-dls",)
    with pytest.raises(LogError, match="closed"):
        recorder.record(make_solve(7))


def test_unknown_compression(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="'gzip': expected one of none, lz4, zstd"):
        McapRecorder(tmp_path / "a", robot_name="r", compression="gzip")  # type: ignore[arg-type]


def test_files_that_are_no_log(tmp_path: Path, write: Write) -> None:
    foreign = tmp_path / "foreign.mcap"
    with foreign.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata("somebody", {"a": "b"})
        writer.finish()
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "text").write_text("robot: ar10\n")
    cases = {
        tmp_path / "missing": "No such file",
        tmp_path: "Is a directory",
        tmp_path / "empty": "not an MCAP file: it is empty",
        tmp_path / "text": "not an MCAP file: it begins with b'robot: a'",
        foreign: r"not a log of casadi_ik: no metadata 'casadi_ik' \(found: somebody\)",
    }
    for path, reason in cases.items():
        with pytest.raises(LogError, match=reason) as caught:
            open_log(path)
        assert str(caught.value).startswith(f"{path}: ")


def test_truncated_files(tmp_path: Path, write: Write) -> None:
    whole = write(make_solve(0)).read_bytes()
    path = tmp_path / "torn.mcap"
    rng = np.random.default_rng(0)
    for length in [8, 9, len(whole) - 1, *rng.integers(10, len(whole) - 1, 30)]:
        path.write_bytes(whole[:length])
        with pytest.raises(LogError, match=rf"torn\.mcap: the log is truncated.* {length} bytes"):
            open_log(path)


def test_flipped_bits_never_escape_as_another_error(tmp_path: Path, write: Write) -> None:
    """Whatever a flipped bit does, it gives a `LogError` or leaves the iterations as they were."""
    solve = make_solve(0)
    whole = bytearray(write(solve, compression="none").read_bytes())
    path = tmp_path / "flipped.mcap"
    rng = np.random.default_rng(1)
    for position in rng.integers(0, len(whole), 100):
        bit = 1 << int(rng.integers(8))
        whole[position] ^= bit
        path.write_bytes(whole)
        try:
            log = open_log(path)
            rows = log.iterations().rows
            log.solves()
            log.events()
        except (LogError, UnknownNameError):
            pass
        else:
            assert rows.tobytes() == solve.trace.tobytes() or rows.dtype != solve.trace.dtype
        whole[position] ^= bit


def test_metadata_is_complete(write: Write) -> None:
    parameters = {
        "damping": 0.1,
        "limits": np.array([1.0, np.inf]),
        "nested": {"a": (1, None, True)},
        "path": Path("x"),
    }
    path = write(
        make_solve(1),
        make_solve(3, rows=10),
        urdf="<robot name='é'/>",
        parameters=parameters,
        seed=7,
        rules=EventRules(singular={"arm": 0.02}),
    )
    log = open_log(path)
    info = log.info
    metadata = info.metadata
    assert metadata["robot"] == info.robot == "made_up"
    assert (metadata["seed"], metadata["keep"], metadata["format"]) == ("7", "all", "1")
    assert (metadata["t0_ns"], metadata["slot_ns"]) == (str(T0), "60000000000")
    assert metadata["iteration_ns"] == "1000000"
    assert {"casadi", "numpy", "mcap"} <= set(metadata["packages"])
    assert metadata["packages"]["numpy"] == np.__version__
    assert metadata["machine"]["cores"] == os.cpu_count()
    assert metadata["code_version"] != "not installed"
    assert {"created", "python", "compression"} <= set(metadata)
    found = metadata["parameters"]
    assert found["limits"] == [1.0, "inf"]
    assert (found["damping"], found["nested"], found["path"]) == (0.1, {"a": [1, None, True]}, "x")
    assert found["event_rules"]["singular"] == {"arm": 0.02}
    assert info.attachments == {"robot.urdf": len("<robot name='é'/>".encode())}
    assert log.attachment("robot.urdf").decode() == "<robot name='é'/>"
    with pytest.raises(UnknownNameError, match=r"no attachment 'x'; attached: robot\.urdf"):
        log.attachment("x")
    assert info.start == T0 + 60_000_000_000
    assert info.end == T0 + 3 * 60_000_000_000 + 9_000_000
    assert info.size == path.stat().st_size
    assert (info.compression, info.chunks) == ("zstd", 1)
    assert 0 < info.compressed < info.uncompressed


def test_log_times_are_arithmetic() -> None:
    clock = LogClock(1000, slot=5_000_000)
    np.testing.assert_array_equal(clock.times(3, 2), [15_001_000, 16_001_000])
    solve, iteration = clock.locate(np.concatenate([clock.times(3, 5), clock.times(4, 1)]))
    assert solve.tolist() == [3, 3, 3, 3, 3, 4]
    assert iteration.tolist() == [0, 1, 2, 3, 4, 0]
    with pytest.raises(LogError, match="solve 3: 6 iterations, the log has room for 5"):
        clock.times(3, 6)
    assert LogClock.now().t0 % 1_000_000_000 == 0


def test_a_message_of_another_encoding_is_refused() -> None:
    with pytest.raises(LogError, match="starts with 00 00 00 00"):
        Codec("uint8 a\n").decode(bytes(5))
