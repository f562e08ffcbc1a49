"""One target at a time in one call of compiled code, in memory made once."""

from __future__ import annotations

import ctypes
from typing import Any

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import KernelError
from casadi_ik.kernels import FunctionKernel, LookupKernel, LoopKernel
from casadi_ik.kernels.buffered import memory
from casadi_ik.kernels.cache import load_library
from casadi_ik.kernels.codegen import define, driver_text
from casadi_ik.kernels.driver_code import DriverCode, check
from casadi_ik.made import made
from casadi_ik.methods.hand_first.rounds import RoundsPlan, source_text
from casadi_ik.methods.hand_first.state import STAGE_LABELS
from casadi_ik.problem.method import Quick

SYMBOL = "casadi_ik_rounds"

MALFORMED, UNHELPED = -9, -10
"""What it returns for a question that is none, and where no round is left that may help."""

KERNELS = {
    "look_up": "lookup_job",
    "begin": "map_job",
    "solve": "loop_job",
    "contacts": "map_job",
    "valley": "map_job",
    "each_finger": "map_job",
    "judge": "map_job",
}
"""The compiled functions it calls, and what they work on."""


class OneTarget:
    """Solves one target after the other; not to be shared by threads.

    Attributes:
        points: (f, 3) [m], NaN where free; write into it.
        normals: (f, 3); write into it.
        more: (f, 3) each, the contacts' other vectors; write into them.
        here: (n,) where the robot is; write into it.
        terms: What `beginning` calls so; write into it.
        state: (ns,) in which the loop ended; to be set before `go_on`.
        q: (n,) the answer; a call overwrites it, as all below.
        position_error: (f,) [m], where there are points and normals only.
        angle_error: (f,) [rad], likewise.
    """

    def __init__(self, plan: RoundsPlan, whole: bool) -> None:
        """Compile what is not compiled yet.

        Args:
            plan: What it is made of; its kernels are compiled.
            whole: Whether all rounds are made; else the first.

        Raises:
            KernelError: The compiler refused.
        """
        sizes, hands, robot = plan.sizes, plan.hands, plan.layouts.robot
        self._name = ca.Function.fix_name(f"hand_first_rounds_{robot.name}")
        library = load_library(
            self._name, _nothing, _driver(plan), SYMBOL, write=lambda _, driver: driver
        )
        if library is None:
            raise KernelError(f"{self._name}: the compiler that made the other kernels is gone")
        self._run: Any = library[SYMBOL]
        self._run_on: Any = library[f"{SYMBOL}_on"]
        self._job = job = _structure(sizes)()
        job.rounds = plan.rounds if whole else 0
        self._kept = hands.tables(plan.enforce_limits) if whole else (hands.table,)
        for i, table in enumerate(self._kept):
            job.tiles[i] = memory(table.lookup.tiles)
        self._link("look_up", hands.table.lookup)
        self._link("begin", plan.begin)
        self._link("solve", plan.solve)
        self._link("judge", plan.judge)
        if whole:
            self._link("contacts", plan.contacts)
            self._link("valley", hands.valley)
            if plan.mends and hands.each_finger is not None:
                self._link("each_finger", hands.each_finger)
        f = len(robot.fingers)
        self.points = self._view("points").reshape(f, 3)
        self.normals = self._view("normals").reshape(f, 3)
        self.more = list(self._view("more")[:-1].reshape(-1, f, 3))
        self.here, self.terms, self.q = map(self._view, ("here", "terms", "q"))
        self.position_error, self.angle_error = map(self._view, ("position_error", "angle_error"))
        self.state = self._view("state")
        self._counts = self.state[plan.layouts.state.slice("counts")]
        self._reference = ctypes.byref(job)

    def _link(self, name: str, kernel: FunctionKernel | LookupKernel | LoopKernel) -> None:
        setattr(self._job, name, ctypes.cast(kernel.entry, ctypes.c_void_p).value)

    def _view(self, name: str) -> Array:
        return np.ctypeslib.as_array(getattr(self._job, name))

    def __call__(self) -> int | None:
        """Solve what stands in the arrays.

        Returns:
            Code of `Status`, after the verdict where there is one; None: the target is malformed.

        Raises:
            KernelError: No work memory.
        """
        return self._ended(self._run(self._reference))

    def go_on(self, number: int, rounds: int) -> int | None:
        """Make later rounds for what stands in the arrays, after others that ended in `state`.

        The search without preference follows where what is near was wanted.

        Args:
            number: The first of them.
            rounds: How many there are with those before.

        Returns:
            As above; None: no round is left that may help.

        Raises:
            KernelError: No work memory.
        """
        job = self._job
        job.round, job.rounds = number, rounds
        return self._ended(self._run_on(self._reference))

    def _ended(self, code: int) -> int | None:
        job = self._job
        if code == DriverCode.DONE:
            return job.status
        if code in (MALFORMED, UNHELPED):
            return None
        try:
            while code != DriverCode.DONE:
                check(self._name, code)
                code = self._run(self._reference)
        finally:
            job.paused = 0
        return job.status

    @property
    def iterations(self) -> int:
        """Of the last call."""
        return self._job.iterations

    def quick(self, judged: bool) -> Quick:
        """The last answer, copied.

        Args:
            judged: Whether there was a verdict.
        """
        job = self._job
        errors = None
        if judged:
            errors = self.position_error.tolist(), self.angle_error.tolist(), job.beyond
        phases = dict(zip(STAGE_LABELS, map(int, self._counts.tolist()), strict=True))
        return made(
            Quick,
            q=self.q.copy(),
            iterations=job.iterations,
            restarts=job.restarts,
            phases=phases,
            errors=errors,
        )


def _driver(plan: RoundsPlan) -> str:
    """The C text: what rounds.c expects, itself, and the function that Python calls."""
    jobs = (driver_text(name) for name in ("loop_job", "map_job", "lookup_job"))
    pointers = "".join(f"  int (*{name})({job} *); \\\n" for name, job in KERNELS.items())
    calls = "".join(f"#define {name.upper()}(work) (job->{name})(work)\n" for name in KERNELS)
    fields = f"  int64_t paused; \\\n  const int16_t *tiles[3]; \\\n{pointers}\n"
    return "".join(
        (
            "#include <math.h>\n#include <stdint.h>\n#include <string.h>\n",
            "enum { DONE = 0, SLICE_OVER = 1, "
            f"MALFORMED = {MALFORMED}, UNHELPED = {UNHELPED} }};\n",
            *jobs,
            f"#define OWN_FIELDS \\\n{fields}{calls}",
            "#define TILES(table) (job->tiles[table])\n",
            define(plan.sizes),
            source_text("rounds_job"),
            plan.constants(),
            source_text("rounds"),
            driver_text("rounds_call"),
        )
    )


def _structure(sizes: dict[str, int]) -> type[ctypes.Structure]:
    """`rounds` of rounds.c."""
    f, n, h = sizes["N_FINGERS"], sizes["N_MOTORS"], sizes["N_HAND"]
    pool, state = sizes["N_POOL"], sizes["N_STATE"]
    fields: list[tuple[str, Any]] = [
        *_arrays(points=3 * f, normals=3 * f, more=3 * f * sizes["N_MORE"] + 1),
        *_arrays(here=n, terms=sizes["N_TERMS"], q=n, position_error=f, angle_error=f),
        ("beyond", ctypes.c_double),
        *_whole("iterations", "restarts", "status", "round", "under_way", "in_round", "rounds"),
        *_whole("again"),
        *_arrays(state=state, last=state, parameters=sizes["N_PARAMETERS"], mark=state),
        *_arrays(postures=sizes["N_CANDIDATES"] * h, near=pool * h),
        *_arrays(mended=sizes["N_MENDED"] * h, left=sizes["N_MENDED"]),
        *_arrays(places=pool * h, closest=pool),
        ("found", ctypes.c_int64 * pool),
        ("taken", ctypes.c_int64 * pool),
        *_arrays(moved=(h + 1) * n),
        *_arrays(moved_points=(h + 1) * 3 * f, moved_normals=(h + 1) * 3 * f),
        *_arrays(rigid=36 * f, slopes=6 * f * h, held=h, motion=h),
        *_whole("paused"),
        ("tiles", ctypes.c_void_p * 3),
        *((name, ctypes.c_void_p) for name in KERNELS),
    ]
    return type("Rounds", (ctypes.Structure,), {"_fields_": fields})


def _arrays(**sizes: int) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_double * size) for name, size in sizes.items()]


def _whole(*names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_int64) for name in names]


def _nothing() -> ca.Function:
    """The rounds are no function of CasADi."""
    x = ca.SX.sym("x")
    return ca.Function("nothing", [x], [x])
