"""All rounds of one target in one call of compiled code (rounds.c): constants, memory, the call."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from importlib import resources
from typing import Any

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import UnsupportedError
from casadi_ik.kernels import REPEATED, RUNNING, FunctionKernel, LookupKernel, LoopKernel
from casadi_ik.kernels.buffered import memory
from casadi_ik.kernels.cache import load_library
from casadi_ik.kernels.codegen import define, driver_text
from casadi_ik.kernels.constants import define_arrays, number
from casadi_ik.kernels.driver_code import SLICE, DriverCode, check
from casadi_ik.kernels.robot_kernels import RobotKernels
from casadi_ik.methods.common.contact_fit import fresh_fit
from casadi_ik.methods.common.even_spread import even_steps
from casadi_ik.methods.common.posture_table import PostureTable
from casadi_ik.methods.hand_first import method as rules
from casadi_ik.methods.hand_first import restarts
from casadi_ik.methods.hand_first.beginning import terms
from casadi_ik.methods.hand_first.method import HandFirstMethod
from casadi_ik.problem.contacts.conditions import LENGTH
from casadi_ik.problem.status import Phase, Status
from casadi_ik.problem.verdict import LIMIT_SLACK, TOLERANCE_SLACK

SYMBOL = "casadi_ik_rounds"

DIMENSIONS = (
    *("N_FINGERS", "N_MOTORS", "N_HAND", "N_TERMS", "N_STATE", "N_PARAMETERS"),
    *("N_CANDIDATES", "N_POOL"),
)
"""Of the arrays in `rounds`."""

KERNELS = ("look_up", "begin", "solve", "contacts", "valley", "judge")
"""The compiled functions it calls."""


@dataclass(frozen=True, eq=False)
class RoundsPlan:
    """What rounds.c is made of for a robot and a way of taking limits.

    Attributes:
        method: The method, whose kernels it calls.
        enforce_limits: Whether limits are part of being solved.
    """

    method: HandFirstMethod
    enforce_limits: bool

    @property
    def tables(self) -> tuple[PostureTable, ...]:
        """The tables, in the order of their numbers in rounds.c."""
        hands = self.method.hands
        own = (hands.table, hands.wide_table)
        return own if self.enforce_limits else (*own, hands.free_table)

    @property
    def sizes(self) -> dict[str, int]:
        """The `DIMENSIONS` by name."""
        method, robot = self.method, self.method.robot
        candidates, layouts = method.options.candidates, method.step.layouts
        pool = restarts.POOL * candidates * max(method.options.rounds - 1, 1)
        values = (
            *(len(robot.fingers), len(robot.actuators), len(robot.hand_actuators)),
            *(terms(robot).size, layouts.state.size, layouts.parameters.size),
            *(candidates, pool),
        )
        return dict(zip(DIMENSIONS, values, strict=True))

    def text(self) -> str:
        """The constants and rounds.c itself; what calls of kernels mean has to stand before."""
        source = resources.files("casadi_ik.methods.hand_first") / "rounds.c"
        return self._constants() + source.read_text(encoding="utf-8")

    def _constants(self) -> str:
        method, robot = self.method, self.method.robot
        hands, options, layouts = method.hands, method.options, method.step.layouts
        state, parameters, common = layouts.state, layouts.parameters, terms(robot)
        hand = list(robot.hand_actuators)
        whole = {
            "RUNNING": RUNNING,
            "REPEATED": REPEATED,
            "BUDGET": method.max_iterations,
            "TABLE_ROUNDS": options.rounds,
            "ROUNDS": method.rounds,
            "VALLEYS": restarts.VALLEYS,
            "RUGGED": restarts.RUGGED,
            "VARIED": rules.VARIED,
            "RETURNS": rules.RETURNS,
            "POOL": restarts.POOL,
            "FREE": int(not self.enforce_limits),
            "ENFORCE_LIMITS": int(self.enforce_limits),
            "HAS_ARM": int(bool(robot.arm_actuators)),
            "SOLVED_STATUS": int(Status.SOLVED),
            "STALLED_STATUS": int(Status.STALLED),
            "LIMIT_STATUS": int(Status.ITERATION_LIMIT),
            "INVALID_STATUS": int(Status.INVALID),
            "CANDIDATE_PHASE": int(Phase.CANDIDATE),
            "REFINEMENT_PHASE": int(Phase.REFINEMENT),
            **{f"STATE_{name.upper()}": state.slice(name).start for name in STATE},
            **{
                f"{label}_{name.upper()}": layout.slice(name).start
                for label, layout in (("PARAMETERS", parameters), ("TERMS", common))
                for name in ("lower", "upper", "nearest")
            },
        }
        real = {
            "SURE": rules.SURE,
            "NEAR_COST": rules.NEAR,
            "AT_END": restarts.AT_END,
            "HELD": restarts.HELD,
            "NUDGE": restarts.NUDGE,
            "LENGTH": LENGTH,
            "ALIKE": restarts.SIMILAR * restarts.SIMILAR * len(hand),
            "TOLERANCE_SLACK": TOLERANCE_SLACK,
            "LIMIT_SLACK": LIMIT_SLACK,
            "SLICE": SLICE,
        }
        carried = [state.slice(name) for name in rules.CARRIED]
        fresh = {state.slice(name).start: float(value) for name, value in fresh_fit().items()}
        carried_places = [place for part in carried for place in range(part.start, part.stop)]
        whole |= {"N_CARRIED": len(carried_places), "N_FRESH": len(fresh)}
        lower, upper = hands.anywhere_bounds(self.enforce_limits)
        tables = self.tables
        ranges = np.maximum((robot.upper - robot.lower)[hand], rules.TINY)
        arrays = {
            "HAND": np.array(hand),
            "CARRIED": np.array(carried_places),
            "FRESH_PLACES": np.array(list(fresh)),
            "FRESH_VALUES": np.array(list(fresh.values())),
            "LOWER": robot.lower,
            "UPPER": robot.upper,
            "SIZE": hands.size,
            "ORDER_RANGES": ranges,
            "STRIDES": np.concatenate([hands.strides(i) for i in range(restarts.VALLEYS)]),
            "HAND_STEPS": even_steps(len(hand)),
            "ALL_STEPS": even_steps(len(robot.actuators)),
            "ANYWHERE_LOWER": lower,
            "ANYWHERE_RANGE": upper - lower,
            "TABLE_LOWER": np.array([table.lower for table in tables]),
            "TABLE_RANGE": np.array([table.ranges for table in tables]),
            "TABLE_SQUEEZE": np.array([1 - table.at_limits for table in tables]),
            "TABLE_ROWS": np.array([len(table.postures) for table in tables]),
        }
        reals = "".join(f"#define {name} {number(value)}\n" for name, value in real.items())
        return define(self.sizes | whole) + reals + define_arrays(arrays)


STATE = ("q", "phase", "candidate", "earlier", "returns", "best_cost", "best_q")
"""What rounds.c reads and writes of a state."""

_HOSTED = """\
enum { DONE = 0 };
#define OWN_FIELDS \\
  const int16_t *tiles[3]; \\
  int (*look_up)(lookup_job *); \\
  int (*begin)(map_job *); \\
  int (*solve)(loop_job *); \\
  int (*contacts)(map_job *); \\
  int (*valley)(map_job *); \\
  int (*judge)(map_job *);
#define TILES(table) (job->tiles[table])
#define LOOK_UP(work) (job->look_up)(work)
#define BEGIN(work) (job->begin)(work)
#define SOLVE(work) (job->solve)(work)
#define CONTACTS(work) (job->contacts)(work)
#define VALLEY(work) (job->valley)(work)
#define JUDGE(work) (job->judge)(work)
"""

_ENTRY = """
#if defined(_WIN32)
__declspec(dllexport)
#else
__attribute__((visibility("default")))
#endif
int casadi_ik_rounds(rounds *job) {
  int code;
  do code = rounds_run(job, BUDGET);
  while (code == DONE && job->status == RUNNING);
  return code;
}
"""


class OneTarget:
    """Solves one target after the other in memory of its own; not to be shared by threads.

    Attributes:
        points: (f, 3) [m], NaN where free; write into it.
        normals: (f, 3) unit; write into it.
        here: (n,) where the robot is; write into it.
        terms: What `beginning` calls so; write into it.
        q: (n,) the answer; a call overwrites it, as all below.
        position_error: (f,) [m].
        angle_error: (f,) [rad].
    """

    def __init__(self, plan: RoundsPlan) -> None:
        """Compile what is not compiled yet.

        Raises:
            UnsupportedError: There is no compiled code of the robot's kernels.
        """
        method, sizes = plan.method, plan.sizes
        self._name = f"hand_first_rounds_{method.robot.name}"
        self._plan = plan
        library = load_library(
            ca.Function.fix_name(self._name),
            _nothing,
            self._driver(),
            SYMBOL,
            write=lambda _, driver: driver,
        )
        kernels = self._kernels()
        if library is None or any(kernel is None for kernel in kernels):
            raise UnsupportedError(f"method {method.name!r} has no compiled code here")
        self._library = library
        self._run: Any = library[SYMBOL]
        self._job = _structure(sizes)()
        for i, table in enumerate(plan.tables):
            self._job.tiles[i] = memory(table.lookup.tiles)
        for name, kernel in zip(KERNELS, kernels, strict=True):
            setattr(self._job, name, ctypes.cast(kernel, ctypes.c_void_p).value)
        f = sizes["N_FINGERS"]
        self.points = self._view("points").reshape(f, 3)
        self.normals = self._view("normals").reshape(f, 3)
        self.here, self.terms, self.q = map(self._view, ("here", "terms", "q"))
        self.position_error, self.angle_error = map(self._view, ("position_error", "angle_error"))
        self._reference = ctypes.byref(self._job)

    def _driver(self) -> str:
        jobs = map(driver_text, ("loop_job", "map_job", "lookup_job"))
        head = "#include <stdint.h>\n#include <string.h>\n"
        return head + "".join(jobs) + _HOSTED + self._plan.text() + _ENTRY

    def _kernels(self) -> list[Any]:
        """Addresses in the order of `KERNELS`, None where there is no compiled code."""
        method, robot = self._plan.method, RobotKernels(self._plan.method.robot)
        owners: tuple[LookupKernel | FunctionKernel | LoopKernel, ...] = (
            *(method.hands.table.lookup, method.first, method.kernel),
            *(robot.contacts, method.hands.valley, robot.deviations),
        )
        return [owner.entry for owner in owners]

    def _view(self, name: str) -> Array:
        return np.ctypeslib.as_array(getattr(self._job, name))

    @property
    def status(self) -> int:
        """Code of `Status`, after the verdict."""
        return self._job.status

    @property
    def iterations(self) -> int:
        """Of all rounds."""
        return self._job.iterations

    @property
    def restarts(self) -> int:
        """How often it began anew."""
        return self._job.restarts

    @property
    def beyond(self) -> float:
        """By how much the worst actuator or joint is beyond its limits [rad or m]."""
        return self._job.beyond

    def __call__(self) -> int:
        """Solve what stands in the arrays; the status.

        Raises:
            KernelError: No work memory.
        """
        job = self._job
        job.round = job.under_way = job.iterations = job.status = 0
        while (code := self._run(self._reference)) != DriverCode.DONE:
            check(self._name, code)
        return job.status


def _structure(sizes: dict[str, int]) -> type[ctypes.Structure]:
    """`rounds` of rounds.c."""
    f, n, h = sizes["N_FINGERS"], sizes["N_MOTORS"], sizes["N_HAND"]
    pool, state = sizes["N_POOL"], sizes["N_STATE"]
    fields: list[tuple[str, Any]] = [
        *_arrays(points=3 * f, normals=3 * f, here=n, terms=sizes["N_TERMS"]),
        *_arrays(q=n, position_error=f, angle_error=f),
        ("beyond", ctypes.c_double),
        *_whole("iterations", "restarts", "status"),
        *_whole("round", "under_way", "in_round", "evaluations"),
        *_arrays(state=state, last=state, parameters=sizes["N_PARAMETERS"], mark=state),
        *_arrays(postures=sizes["N_CANDIDATES"] * h, places=pool * h, closest=pool),
        ("found", ctypes.c_int64 * pool),
        ("taken", ctypes.c_int64 * pool),
        *_arrays(moved=(h + 1) * n),
        *_arrays(moved_points=(h + 1) * 3 * f, moved_normals=(h + 1) * 3 * f),
        *_arrays(rigid=36 * f, slopes=6 * f * h, held=h, motion=h),
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
