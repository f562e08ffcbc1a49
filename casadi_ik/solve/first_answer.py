"""A robot's first answers, from CasADi's virtual machine while its C is compiled in the background.

A process of its own compiles into the cache, so that the next program finds what this one asked
for. It ends by itself; where it is killed, nothing is left that looks like a library. The virtual
machine answers what the first round of compiled code would answer, the same up to the last places
of sines and arcs. What that round does not solve waits for the compiler, so an answer does not
depend on when it was asked for.
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
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.batches import judged
from casadi_ik.solve.hand_first.method import HandFirstMethod
from casadi_ik.solve.solution import Solution
from casadi_ik.solve.turns import in_nearest_turns, search_start


@dataclass(frozen=True)
class Waiting:
    """How long is waited for compiled code.

    Attributes:
        look_again: From one look for it to the next [s].
        lifetime: After which the process in the background ends in any case [s].
        motor: What a motor adds to the compiler's work, about [s] (gcc 12, one core of a server of
            2023).
    """

    look_again: float = 0.25
    lifetime: float = 900.0
    motor: float = 0.4


WAITING = Waiting()

CHILD = """\
import sys
sys.path[:0] = [sys.argv[1]]
from casadi_ik.solve.first_answer import compile_in_background
compile_in_background()
"""


class FirstAnswers:
    """Answers of a method until its compiled code is there; threads may share it."""

    def __init__(self, method: HandFirstMethod | None) -> None:
        """Nothing is done before the first answer; without a method there is none."""
        self._method = method
        self._early: tuple[HandFirstMethod, ArmHand] | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._looked = 0.0
        self._lock = threading.Lock()

    def answer(
        self, targets: TargetBatch, start: Array, check: SceneCheck | None
    ) -> Solution | None:
        """The answer of the virtual machine.

        Args:
            targets: One target.
            start: (n,) where the robot is.
            check: What answers must not touch; None: nothing is checked.

        Returns:
            The answer, or None where compiled code is there, or has to be waited for.
        """
        method = self._method
        if method is None or self._is_ready(method):
            return None
        with virtual_machine():
            if self._early is None:
                virtual = method.in_virtual_machine()
                # A robot of its own: its functions are not those of the compiled method.
                self._early = virtual, ArmHand(virtual.robot)
            virtual, robot = self._early
            near = search_start(virtual.robot, start)[None]
            outcome = virtual.run(targets, near, 0, False, rounds=1)
            q = in_nearest_turns(virtual.robot, targets, outcome.q, start)
            outcome = replace(outcome, q=q)
            query = None
            if check is not None:
                query = SceneCheck(robot, check.scene, compiled=False).collision_query(targets)
            batch = judged(robot, virtual.name, targets, outcome, query)
        return batch.solution(0) if batch.success[0] else None

    def _is_ready(self, method: HandFirstMethod) -> bool:
        """Whether the method is compiled, or is to be waited for."""
        with self._lock:
            process, now = self._process, time.monotonic()
            if process is not None and now - self._looked < WAITING.look_again:
                return False
            self._looked = now
            try:
                with cached_only():
                    method.prepare()
            except NotCachedError:
                ready = waits_for_compiler() or (process is not None and process.poll() is not None)
                if not ready and process is None:
                    self._process = started(method)
                    ready = self._process is None
            else:
                ready = True
            if ready:
                self._method = None
            return ready


def started(method: HandFirstMethod) -> subprocess.Popen[bytes] | None:
    """A process that compiles a method, or None where none can be started."""
    if not Path(sys.executable or "").name.startswith("python") or find_compiler() is None:
        return None
    package = Path(__file__).parents[2]
    # A process group of its own: Ctrl-C is not meant for it.
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
    seconds = WAITING.motor * len(method.robot.actuators)
    print_note(
        f"{method.robot.name}: compiled in the background (about {seconds:.0f} s, once per "
        "machine); until then CasADi's virtual machine answers"
    )
    return process


def compile_in_background() -> None:
    """What that process does: for one target first, then for batches."""
    threading.Thread(target=_end_later, daemon=True).start()
    method = pickle.load(sys.stdin.buffer)
    with contextlib.suppress(OSError, AttributeError):
        os.nice(5)
    method.prepare()
    method.prepare(batches=True)


def _end_later() -> None:
    time.sleep(WAITING.lifetime)
    os._exit(1)
