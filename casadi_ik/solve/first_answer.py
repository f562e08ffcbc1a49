"""Interim solutions from CasADi's virtual machine while the C code is compiled in the background.

A separate process compiles into the cache, so that later programs find the library too. It ends
after the compilation, and leaves no incomplete library if it is killed. The virtual machine
computes the solution of the first restart of the compiled code, up to the last digits of sines and
arctangents. A target that this restart does not solve waits for the compiler, so a solution does
not depend on the time of the call.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

from casadi_ik.collision.clearance import SceneCheck
from casadi_ik.compile.cancellation import cached_only, virtual_machine
from casadi_ik.compile.compiler import find_compiler, print_note, waits_for_compiler
from casadi_ik.compile.libraries import NotCachedError
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.batches import judge_outcome
from casadi_ik.solve.method import HandSearch
from casadi_ik.solve.solution import Solution
from casadi_ik.solve.turns import in_nearest_turns, with_search_starts


@dataclass(frozen=True)
class BackgroundCompilation:
    """Settings of the compilation in the background.

    Attributes:
        poll_interval: Interval between two searches for the library [s].
        lifetime: Maximum lifetime of the process [s].
        seconds_per_motor: Approximate compile time per motor [s]. Source: gcc 12, one core of a
            server of 2023.
    """

    poll_interval: float = 0.25
    lifetime: float = 900.0
    seconds_per_motor: float = 0.4


BACKGROUND_COMPILATION = BackgroundCompilation()

CHILD = """\
import sys
sys.path[:0] = [sys.argv[1]]
from casadi_ik.solve.first_answer import compile_in_background
compile_in_background()
"""


class InterimSolver:
    """Solves single targets until the compiled code of a method is available.

    Threads may share an instance.
    """

    def __init__(self, method: HandSearch | None) -> None:
        """Store the method; nothing is built before the first call.

        Args:
            method: The method; None: there are no interim solutions.
        """
        self._method = method
        self._virtual: tuple[HandSearch, ArmHand] | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._last_poll = 0.0
        self._lock = threading.Lock()

    def solve(self, targets: TargetBatch, check: SceneCheck | None) -> Solution | None:
        """Solve a target in the virtual machine.

        Args:
            targets: One target.
            check: Collision check of the scene; None: collisions are not checked.

        Returns:
            The solution; None if compiled code is available, or is needed for this target.
        """
        method = self._method
        if method is None or self._is_ready(method):
            return None
        with virtual_machine():
            if self._virtual is None:
                virtual = method.in_virtual_machine()
                # The compiled method and the virtual one must not share functions of the robot.
                self._virtual = virtual, ArmHand(virtual.robot)
            virtual, robot = self._virtual
            outcome = virtual.run(with_search_starts(virtual.robot, targets), rounds=1)
            q = in_nearest_turns(virtual.robot, targets, outcome.q)
            outcome = replace(outcome, q=q)
            query = None
            if check is not None:
                query = SceneCheck(robot, check.scene, compiled=False).collision_query(targets)
            batch = judge_outcome(robot, virtual.name, targets, outcome, query)
        return batch.solution(0) if batch.success[0] else None

    def _is_ready(self, method: HandSearch) -> bool:
        """Return whether to use the compiled method, waiting for the compiler if necessary."""
        with self._lock:
            process, poll_time = self._process, time.monotonic()
            interval = BACKGROUND_COMPILATION.poll_interval
            if process is not None and poll_time - self._last_poll < interval:
                return False
            self._last_poll = poll_time
            try:
                with cached_only():
                    method.prepare()
            except NotCachedError:
                has_ended = process is not None and process.poll() is not None
                is_ready = waits_for_compiler() or has_ended
                if not is_ready and process is None:
                    self._process = start_compilation(method)
                    is_ready = self._process is None
            else:
                is_ready = True
            if is_ready:
                self._method = None
            return is_ready


def start_compilation(method: HandSearch) -> subprocess.Popen[bytes] | None:
    """Start a process that compiles a method; None if no process can be started."""
    if not Path(sys.executable or "").name.startswith("python") or find_compiler() is None:
        return None
    package = Path(__file__).parents[2]
    # A separate process group, so that Ctrl-C does not end the compilation.
    flags = subprocess.CREATE_NO_WINDOW if sys.platform == "win32" else 0
    try:
        process = subprocess.Popen(
            [sys.executable, "-c", CHILD, str(package)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            creationflags=flags,
        )
        assert process.stdin is not None
        with process.stdin as stream:
            pickle.dump(method, stream)
    except OSError:
        return None
    seconds = BACKGROUND_COMPILATION.seconds_per_motor * len(method.robot.actuators)
    print_note(
        f"{method.robot.name}: compiling in the background (about {seconds:.0f} s, once per "
        "machine); CasADi's virtual machine solves until then"
    )
    return process


def compile_in_background() -> None:
    """Compile the method that standard input holds, first for one target, then for batches."""
    threading.Thread(target=_exit_after_lifetime, daemon=True).start()
    method = pickle.load(sys.stdin.buffer)
    with contextlib.suppress(OSError, AttributeError):
        os.nice(5)
    method.prepare()
    method.prepare(batches=True)


def _exit_after_lifetime() -> None:
    time.sleep(BACKGROUND_COMPILATION.lifetime)
    os._exit(1)
