"""Ctrl-C during batches: threads stop, and finished blocks of a stream are delivered."""

from __future__ import annotations

import os
import signal
import threading
import time

import numpy as np
import pytest
from processes import POSIX, python

import casadi_ik as ik
from casadi_ik.compile.cancellation import CancelledError, stop_if_cancelled
from casadi_ik.solve.batches import map_ordered

pytestmark = pytest.mark.usefixtures("usual_flags")

SCRIPT = """
    import os, signal, sys, threading, time
    import numpy as np
    import casadi_ik as ik
    robot = ik.load_robot("kuka_lwr_barrett")
    points, normals = robot.contacts(robot.random(np.random.default_rng(0), {count}))
    normals += {noise} * np.random.default_rng(1).normal(size=normals.shape)
    solver = ik.Solver(robot, "{method}", compiled={compiled})
    solver.solve_batch(points[:8], normals[:8], jobs=2, diagnose={diagnose})
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's "&" ignores it
    threading.Timer(1.5, os.kill, (os.getpid(), signal.SIGINT)).start()
    begin = time.monotonic()
    try:
        solver.solve_batch(points, normals, jobs=2, diagnose={diagnose})
    except KeyboardInterrupt:
        print("interrupted", time.monotonic() - begin, threading.active_count())
"""


@POSIX
@pytest.mark.parametrize(
    ("method", "count", "diagnose", "compiled"),
    [
        ("hand-first", 1_000_000, False, True),
        pytest.param("ipopt", 600, False, True, marks=pytest.mark.slow),
        pytest.param("hand-first", 60_000, True, True, marks=pytest.mark.slow),
        pytest.param("hand-first", 200_000, False, False, marks=pytest.mark.slow),
        pytest.param("original-dls", 40_000, False, True, marks=pytest.mark.slow),
    ],
)
def test_threads_stop_at_an_interrupt(
    method: str, count: int, diagnose: bool, compiled: bool
) -> None:
    """Each whole batch takes minutes; the limit of the interrupt allows for a busy machine."""
    script = SCRIPT.format(
        method=method, count=count, diagnose=diagnose, compiled=compiled, noise=int(diagnose)
    )
    done = python("-c", script)
    assert done.stdout, f"ended before it was interrupted: {done.stderr}"
    word, seconds, threads = done.stdout.split()
    assert word == "interrupted", done.stderr
    assert float(seconds) < 60
    assert threads == "1"


@POSIX
def test_stream_delivers_finished_blocks(robot) -> None:
    points, normals = robot.contacts(robot.random(np.random.default_rng(0), 30))
    solver = ik.Solver(robot)
    handler_before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def blocks():
        for start in range(0, 30, 10):
            if start == 20:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(5)
            yield points[start : start + 10], normals[start : start + 10]

    finished_blocks = []
    try:
        with pytest.raises(KeyboardInterrupt):
            finished_blocks.extend(solver.solve_blocks(blocks(), jobs=2))
    finally:
        signal.signal(signal.SIGINT, handler_before)
    assert [block.first_row for block in finished_blocks] == [0, 10]
    assert all(block.solution.success.all() for block in finished_blocks)


def test_error_stops_other_threads() -> None:
    started, stopped = threading.Event(), threading.Event()

    def until_told() -> None:
        started.set()
        try:
            while True:
                stop_if_cancelled()
                time.sleep(0.01)
        except CancelledError:
            stopped.set()
            raise

    def fail() -> None:
        started.wait(120)
        raise ValueError("of one")

    with pytest.raises(ValueError, match="of one"):
        list(map_ordered(lambda task: task(), [fail, until_told], 2))
    assert stopped.is_set()
    stop_if_cancelled()  # this thread was never told
