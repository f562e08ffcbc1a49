"""Damage: the reader says so or gives the truth, whatever is cut, flipped or killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up_solves import make_block

import casadi_ik as ik
from casadi_ik.errors import LogError, UnknownNameError
from casadi_ik.logs import Log
from casadi_ik.logs.container import read_contents
from casadi_ik.logs.writer import CHUNK_SIZE

Write = Callable[..., Path]

WRITER = """
import sys
sys.path.insert(0, sys.argv[2])
from made_up_solves import make_block
from casadi_ik.logs import McapRecorder
with McapRecorder(sys.argv[1], robot_name="made_up") as recorder:
    for first in range(0, 1_000_000, 20):
        recorder.record(make_block(*[400] * 20, first=first))
        print(first, flush=True)
"""


def answers(log: Log) -> dict[str, Any]:
    """Everything a log says, as bytes."""
    tables = {"solves": log.solves(), "iterations": log.iterations(), "events": log.events()}
    found: dict[str, Any] = {
        name: [(part.method, part.labels, part.rows.tobytes()) for part in table.parts]
        for name, table in tables.items()
    }
    found["times"] = [
        (part.solve_id.tobytes(), part.iteration.tobytes())
        for table in tables.values()
        for part in table.parts
    ]
    return found | {"metadata": dict(log.metadata), "urdf": log.attachment("robot.urdf")}


def said_of(path: Path) -> Any:
    """Everything a log says, or the one error."""
    try:
        return answers(ik.logs.open(path))
    except (LogError, UnknownNameError) as error:
        assert error.args[0].count("\n") == 0  # noqa: PT017
        return error.args[0]


@pytest.fixture
def whole(write: Write, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A log of several chunks and two methods."""
    monkeypatch.setattr("casadi_ik.logs.writer.CHUNK_SIZE", 2**15)
    blocks = [make_block(*[60] * 3, first=3 * i) for i in range(3)]
    return write(*blocks, make_block(20, 30, method="hand-first"), urdf="<robot/>" * 100)


@pytest.mark.parametrize("seed", range(100))
def test_a_flipped_bit(whole: Path, seed: int) -> None:
    """Half of them in the chunks, half in all that is small beside the chunks."""
    rng = np.random.default_rng(seed)
    truth = answers(ik.logs.open(whole))
    data = bytearray(whole.read_bytes())
    if seed % 2:
        position = int(rng.integers(len(data)))
    else:
        chunks = read_contents(whole).chunks
        inside = {
            byte
            for chunk in chunks
            for byte in range(
                chunk.chunk_start_offset + 60, chunk.chunk_start_offset + chunk.chunk_length
            )
        }
        position = int(rng.choice([byte for byte in range(len(data)) if byte not in inside]))
    data[position] ^= 1 << int(rng.integers(8))
    whole.write_bytes(data)
    found = said_of(whole)
    assert found == truth or found.startswith(f"{whole}: ")


@pytest.mark.parametrize("seed", range(100))
def test_a_cut_log(whole: Path, seed: int) -> None:
    """Every complete chunk is read, and the log says that it is not whole."""
    rng = np.random.default_rng(seed)
    contents = read_contents(whole)
    before = ik.logs.open(whole)
    truth = before.iterations(method="enhanced-dls").rows
    urdf = before.attachment("robot.urdf")
    length = int(rng.integers(whole.stat().st_size))
    with whole.open("r+b") as stream:
        stream.truncate(length)
    complete = [
        chunk
        for chunk in contents.chunks
        if chunk.chunk_start_offset + chunk.chunk_length <= length
    ]
    if length < contents.chunks[0].chunk_start_offset:
        with pytest.raises(LogError, match=rf"^{whole}: "):
            ik.logs.open(whole)
        return
    log = ik.logs.open(whole)
    assert log.info().unfinished == (whole,)
    assert log.info().chunks == len(complete)
    if not complete:
        assert log.methods == ()
        return
    first = log.solves(method="enhanced-dls").solve_id
    assert first.tolist() == list(range(len(first)))
    found = log.iterations(method="enhanced-dls").rows
    assert found.tobytes() == truth[: 60 * len(first)].tobytes()
    assert log.attachment("robot.urdf") == urdf


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
@pytest.mark.parametrize("after", [0.0, 0.05, 0.2])
def test_a_killed_writer(tmp_path: Path, after: float) -> None:
    """All but the chunk being filled and the one being written is there."""
    path = tmp_path / "killed.mcap"
    command = [sys.executable, "-c", WRITER, str(path), str(Path(__file__).parent)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        for line in writer.stdout:
            if int(line) >= 200:
                break
        time.sleep(after)
        os.kill(writer.pid, signal.SIGKILL)
        recorded = int((line, *writer.stdout.read().split())[-1]) + 20
    log = ik.logs.open(path)
    assert log.info().unfinished == (path,)
    solves = log.solves().solve_id
    np.testing.assert_array_equal(solves, np.arange(len(solves)))
    of_a_solve = sum(chunk.uncompressed_size for chunk in read_contents(path).chunks) / len(solves)
    assert (recorded - len(solves)) * of_a_solve < 2 * (CHUNK_SIZE + of_a_solve)
    assert len(solves) <= recorded + 20
    assert len(log.iterations()) == 400 * len(solves)
    assert log.iterations(solve=41).rows.tobytes() == make_block(400, first=41).rows.tobytes()
    # The lock died with the writer.
    with ik.logs.McapRecorder(path, robot_name="made_up"):
        pass


def test_a_warning_names_the_unfinished_file(whole: Path, caplog: pytest.LogCaptureFixture) -> None:
    with whole.open("r+b") as stream:
        stream.truncate(whole.stat().st_size - 4)
    ik.logs.open(whole)
    (message,) = caplog.messages
    assert message.startswith(f"{whole}: not finished; ")
