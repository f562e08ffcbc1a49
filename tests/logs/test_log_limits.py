"""What no reader would take is not written: an error before any of it is on the disk."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_up_solves import make_block

import casadi_ik as ik
from casadi_ik.errors import LogError
from casadi_ik.logs import McapRecorder, chunks
from casadi_ik.logs.writer import CHUNK_SIZE

LIMIT = 3 * CHUNK_SIZE


@pytest.fixture(autouse=True)
def small_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Readers and writers that take little."""
    monkeypatch.setattr(chunks, "RECORD_LIMIT", LIMIT)


def test_a_solve_that_is_too_large_leaves_the_log_usable(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    says = r"x\.mcap: method 'enhanced-dls', solve 3 holds \d{7} bytes, more than the 6291456"
    with McapRecorder(path, robot_name="made_up", compression="none") as recorder:
        recorder.record(make_block(500, 4000))
        with pytest.raises(LogError, match=says):
            recorder.record(make_block(10, 9000, first=2))
        recorder.record(make_block(10, 4000, first=2))
    log = ik.logs.open(path)
    assert log.solves().rows["solve_id"].tolist() == [0, 1, 2, 3]
    assert len(log.iterations()) == 500 + 4000 + 10 + 4000


def test_the_largest_solve_that_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    most = 0
    for iterations in range(4000, 9000, 250):
        try:
            with McapRecorder(path, robot_name="made_up", compression="lz4") as recorder:
                recorder.record(make_block(200, iterations))
        except LogError:
            assert most
            return
        most = len(ik.logs.open(path).iterations())
        assert most == 200 + iterations
    pytest.fail("nothing was too large")


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"urdf": " " * LIMIT}, "attachment 'robot.urdf'"),
        ({"parameters": {"note": "x" * LIMIT}}, "the metadata"),
    ],
)
def test_what_goes_with_a_log_is_too_large(tmp_path: Path, given: dict, says: str) -> None:
    with pytest.raises(LogError, match=rf"x\.mcap: {says} holds \d+ bytes, more than the 6291456"):
        McapRecorder(tmp_path / "x.mcap", robot_name="made_up", **given)
    assert list(tmp_path.iterdir()) == []
