"""C code of the search of hand-first for a robot: constants, memory layout and library.

The algorithm is in restarts.c, seeds.c and hand_first.c, and in the loop that calls them.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from importlib import resources
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile import REPEATED, RUNNING, FunctionKernel, LoopKernel
from casadi_ik.compile.cancellation import SLICE, DriverCode
from casadi_ik.compile.codegen import WIDE, define, define_arrays, driver_text, number
from casadi_ik.compile.function_kernel import machine_lanes
from casadi_ik.compile.graphs import recipe
from casadi_ik.compile.libraries import load_library
from casadi_ik.compile.loop import NO_LIMIT, UNBEGUN
from casadi_ik.files.arrays import spread_steps
from casadi_ik.kinematics.contact_fit import initial_lm_state
from casadi_ik.kinematics.contacts import LENGTH
from casadi_ik.model.grasp import MAX_PLAIN_LENGTH, MIN_PLAIN_LENGTH, UNIT_ROUNDING
from casadi_ik.solve.hand_first.parameters import HandFirstParameters
from casadi_ik.solve.hand_first.seeds import FEATURES, Seeds
from casadi_ik.solve.hand_first.state import HandFirstLayouts, Stage, settings_layout
from casadi_ik.solve.status import Status
from casadi_ik.solve.turns import TURN
from casadi_ik.solve.verdict import LIMIT_SLACK, TOLERANCE_SLACK

MALFORMED = -9
"""Return code of a search for a malformed target."""

MIN_RANGE = 1e-9
"""Lower bound of the ranges that scale motor distances [rad or m]."""

KERNELS = {
    "look_up": "lookup_job",
    "begin": "map_job",
    "solve": "loop_job",
    "finger_errors": "map_job",
    "judge": "map_job",
}
"""Job type of each compiled function that a search calls."""

EXPORT = """
#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
"""

SIDE_SEEDS = "EXPORT int casadi_ik_hands"
"""Declaration of the function that a multi-arm robot calls for seeds of its sides."""

SIDE_CALLS = """
typedef int (*find_hands)(void *, const double *, const double *, const double *, int64_t, int64_t,
                          double *);
#define HANDS(side, ...) ((find_hands) job->hands[side])((void *) job->sides[side], __VA_ARGS__)
"""
"""Macro by which a multi-arm robot calls the seed function of a side."""

STATE_FIELDS = (
    *("q", "phase", "candidate", "candidates_before", "is_underactuated", "repeated_minima"),
    *("best_cost", "best_q", "counts"),
)
"""State fields that the C code reads and writes."""


@cache
def source_text(name: str) -> str:
    """Return the text of a C file of this package by its stem, such as "hand_first"."""
    source = resources.files("casadi_ik.solve.hand_first") / f"{name}.c"
    return source.read_text(encoding="utf-8")


@dataclass(frozen=True, eq=False)
class SearchPlan:
    """Ingredients of the C code for a robot, with or without enforced limits.

    Attributes:
        layouts: Layouts of the step.
        options: Parameters of the method.
        budget: Maximum number of iterations of a restart.
        seeds: Hand postures from which restarts begin.
        enforce_limits: Whether a solution must respect limits.
        kernel_factories: Factories of the kernels below, which are compiled at the first use.
        sides: Plans of the sides of a multi-arm robot, for the seeds of their hands.
    """

    layouts: HandFirstLayouts
    options: HandFirstParameters
    budget: int
    seeds: Seeds
    enforce_limits: bool
    kernel_factories: Mapping[str, Callable[[], Any]]
    sides: tuple[SearchPlan, ...] = ()

    @property
    def begin(self) -> FunctionKernel:
        """Kernel of the first state and the parameters of a restart."""
        return self.kernel_factories["begin"]()

    @property
    def solve(self) -> LoopKernel:
        """Compiled loop."""
        return self.kernel_factories["solve"]()

    @property
    def contacts(self) -> FunctionKernel:
        """Kernel of contact points and normals of configurations, for exported solvers."""
        return self.kernel_factories["contacts"]()

    @property
    def judge(self) -> FunctionKernel:
        """Kernel of the errors of a configuration and its excess over limits."""
        return self.kernel_factories["judge"]()

    @property
    def rounds(self) -> int:
        """Maximum number of restarts of a search."""
        return self.options.all_rounds(self.layouts.robot)

    @property
    def repairs_seeds(self) -> bool:
        """True if the seeds of later restarts are repaired finger by finger."""
        return self.enforce_limits and self.seeds.can_repair

    @property
    def pool(self) -> int:
        """Maximum number of postures from which the seeds of a restart are selected."""
        options = self.options
        repaired = max(options.pool, options.candidates)
        return repaired if self.repairs_seeds else options.candidates * max(options.rounds - 1, 1)

    @property
    def kernels(self) -> dict[str, Any]:
        """Called kernels by their names in `KERNELS`."""
        kernels = {"begin": self.begin, "solve": self.solve, "judge": self.judge}
        return kernels if self.sides else kernels | self.seed_kernels

    @property
    def seed_kernels(self) -> dict[str, Any]:
        """Called kernels that find seeds."""
        kernels = {"look_up": self.seeds.table.lookup}
        repair = {"finger_errors": self.seeds.finger_errors} if self.repairs_seeds else {}
        return kernels | repair

    @property
    def source(self) -> str:
        """C code of a search."""
        names = "spread", "restarts", "sides" if self.sides else "seeds", "hand_first"
        texts = map(source_text, names)
        return driver_text("loops") + "".join(texts)

    @property
    def sizes(self) -> dict[str, int]:
        """Macros of array dimensions."""
        robot, layouts = self.layouts.robot, self.layouts
        return {
            "N_FINGERS": len(robot.fingers),
            "N_MOTORS": len(robot.actuators),
            "N_HAND": len(robot.hand_actuators),
            "N_SETTINGS": settings_layout(robot).size,
            "N_STATE": layouts.state.size,
            "N_PARAMETERS": layouts.parameters.size,
            "N_CANDIDATES": self.options.candidates,
            "N_POOL": self.pool,
            "N_REPAIRED": self.pool if self.repairs_seeds else self.options.candidates,
            "N_EXTRA_VECTORS": len(layouts.contacts.data) - 2,
            "N_SIDES": len(self.sides),
            "N_TURNING": len(robot.multi_turn),
        }

    @property
    def fields(self) -> dict[str, tuple[str, int | None, str]]:
        """Type, length (None: scalar) and meaning of the members of a search, 8 bytes each."""
        f, n, h, _, state, parameters, candidates, pool, repaired, extra, *_ = self.sizes.values()
        double, integer = "double", "int64_t"
        h = max(h, 1)  # a tool has no motors, and C has no empty arrays
        return {
            "points": (double, 3 * f, "target: contact points [m], base frame, NaN = free"),
            "normals": (double, 3 * f, "target: pad normals, base frame, NaN = free"),
            "extra_vectors": (double, 3 * f * extra + 1, "target: further vectors of contacts"),
            "q0": (double, n, "start configuration"),
            "turns": (double, max(self.sizes["N_TURNING"], 1), "full turns subtracted from q0"),
            "settings": (
                double,
                self.sizes["N_SETTINGS"],
                "tolerances, bounds, 1 = q0 is preferred",
            ),
            "max_restarts": (integer, None, "0: the first restart only, without a search"),
            "q": (double, n, "result"),
            "position_error": (double, f, "of the result [m], by finger"),
            "angle_error": (double, f, "of the result [rad], by finger"),
            "limit_violation": (double, None, "largest violation of a limit by the result"),
            "iterations": (integer, None, "number of iterations of the search"),
            "restarts": (integer, None, "number of hand postures tried after the first"),
            "status": (integer, None, "of the search, RUNNING until it ends"),
            "has_verdict": (integer, None, "1 = the verdict decides the status"),
            "round": (integer, None, "number of the restart"),
            "preference_dropped": (integer, None, "1 = restarts are repeated without preference"),
            "restart_quota": (integer, None, "restarts that this call may still begin"),
            "slot": (integer, None, "of the loop, -1 = none"),
            "iterations_before": (integer, None, "iterations before this restart"),
            "loop_status": (integer, None, "status with which the iterations ended"),
            "paused": (integer, None, "1 = the next call continues the search"),
            "state": (double, state, "of the loop"),
            "parameters": (double, parameters, "of the loop"),
            "previous_state": (double, state, "last state of the previous restart"),
            "mark": (double, state, "state with which the loop detects cycles"),
            "postures": (double, candidates * h, "seeds of the restart"),
            "incumbent_hands": (double, 2 * h, "hand of the incumbent and of the previous one"),
            "incumbent_count": (integer, None, "number of incumbents so far"),
            "seed_pool": (double, repaired * h, "work memory of seeds.c and of collision checks"),
            "seed_error": (double, repaired, "sums of squared contact errors of the pool"),
            "seed_rows": (integer, pool, "rows of tables, or of the pool, best first"),
        }

    def members(self) -> str:
        """Return the `fields` as members of a C struct."""
        lines = []
        for name, (kind, length, doc) in self.fields.items():
            size = "" if length is None else f"[{length}]"
            lines.append(f"  {kind} {name}{size};{f'  /* {doc} */' if doc else ''}\n")
        return "".join(lines)

    def constants(
        self,
        source: str,
        reals: Mapping[str, float] | None = None,
        arrays: Mapping[str, NDArray[Any]] | None = None,
    ) -> str:
        """Return all constants except the `sizes` as C text.

        Args:
            source: C text; only arrays that it names are defined.
            reals: Numbers that replace those of Python.
            arrays: Arrays that replace those of Python.
        """
        numbers = self._real_numbers() | dict(reals or {})
        lines = (f"#define {name} {number(value)}\n" for name, value in numbers.items())
        words = set(re.findall(r"\w+", source))
        tables = self._arrays() | dict(arrays or {})
        tables = {name: array for name, array in tables.items() if name in words}
        return define(self._integers()) + "".join(lines) + define_arrays(tables)

    def _integers(self) -> dict[str, int]:
        layouts, robot = self.layouts, self.layouts.robot
        state, names = layouts.state, self._state_fields
        offsets = {f"STATE_{name.upper()}": state.slice(name).start for name in names}
        for label, layout in (
            ("PARAMETERS", layouts.parameters),
            ("SETTINGS", settings_layout(robot)),
        ):
            for name in ("lower", "upper", "nearest"):
                offsets[f"{label}_{name.upper()}"] = layout.slice(name).start
        return {
            "RUNNING": RUNNING,
            "REPEATED": REPEATED,
            "UNBEGUN": UNBEGUN,
            "BUDGET": self.budget,
            "ALL_ROUNDS": self.rounds,
            "FIRST_RUGGED": self.options.first_rugged,
            "REPAIRS": int(self.repairs_seeds),
            "FINGER_FEATURES": FEATURES,
            "ENFORCE_LIMITS": int(self.enforce_limits),
            "HAS_ARM": int(bool(layouts.arm)),
            "N_KEPT_FIELDS": len(self._kept_fields),
            "N_FIT_FIELDS": len(initial_lm_state()),
            "N_COUNTS": len(self.layouts.phases),
            **{f"{status.name}_STATUS": int(status) for status in Status},
            **{f"{stage.name}_STAGE": int(stage) for stage in Stage},
            **{k: v for k, v in self._options.items() if isinstance(v, int)},
            **offsets,
        }

    @property
    def _state_fields(self) -> tuple[str, ...]:
        return (*STATE_FIELDS, "is_out_of_reach") if self.sides else STATE_FIELDS

    @property
    def _options(self) -> dict[str, Any]:
        """Numeric options by macro; of a pair the robot's value, and the value for many motors."""
        many, options = self.options.is_many(self.layouts.robot), dict[str, Any]()
        for name, value in asdict(self.options).items():
            if isinstance(value, int | float):
                options[name.upper()] = value
            elif name in ("same_minimum", "far_cost"):
                options |= {name.upper(): value[many], f"{name.upper()}_MANY": value[1]}
        return options

    def _real_numbers(self) -> dict[str, float]:
        return {
            "LENGTH": LENGTH,
            "TURN": TURN,
            "UNIT": UNIT_ROUNDING,
            "SMALL_LENGTH": MIN_PLAIN_LENGTH,
            "LARGE_LENGTH": MAX_PLAIN_LENGTH,
            "TOLERANCE_SLACK": TOLERANCE_SLACK,
            "LIMIT_SLACK": LIMIT_SLACK,
            "SLICE": SLICE,
            **{k: v for k, v in self._options.items() if isinstance(v, float)},
        }

    @property
    def _kept_fields(self) -> list[int]:
        """Indices of the state entries that are kept across restarts."""
        slices = map(self.layouts.state.slice, self.layouts.kept_across_restarts)
        return [index for rows in slices for index in range(rows.start, rows.stop)]

    def _arrays(self) -> dict[str, NDArray[Any]]:
        robot, seeds = self.layouts.robot, self.seeds
        hand, samples = list(robot.hand_actuators), seeds.table_samples
        lower, upper = seeds.global_bounds(self.enforce_limits)
        fit, state = initial_lm_state(), self.layouts.state
        return {
            "HAND": np.array(hand, dtype=np.int64),
            "KEPT_FIELDS": np.array(self._kept_fields),
            "FIT_FIELDS": np.array([state.slice(name).start for name in fit]),
            "FIT_VALUES": np.array([float(value) for value in fit.values()]),
            "LOWER": robot.lower,
            "UPPER": robot.upper,
            "ORDER_RANGES": np.maximum((robot.upper - robot.lower)[hand], MIN_RANGE),
            "HAND_STEPS": spread_steps(len(hand)),
            "ALL_STEPS": spread_steps(len(robot.actuators)),
            "ANYWHERE_LOWER": lower,
            "ANYWHERE_RANGE": upper - lower,
            **(self._finger_tables() if self.repairs_seeds else {}),
            "TABLE_LOWER": np.array([table.lower[hand] for table in samples]),
            "TABLE_RANGE": np.array([(table.upper - table.lower)[hand] for table in samples]),
            "TABLE_SQUEEZE": np.array([1 - table.at_limits for table in samples]),
            "TABLE_ROWS": np.array([table.count for table in samples]),
            **(self._side_tables() if self.sides else {}),
            **(self._turning_tables() if robot.multi_turn else {}),
        }

    def _side_tables(self) -> dict[str, NDArray[Any]]:
        """Return the fingers, hands and motors of each side, padded with zeros."""
        robot = self.layouts.robot
        motors = [sorted((*arm, *hand)) for arm, hand in robot.side_actuators]
        columns = np.zeros((len(motors), max(map(len, motors))), dtype=np.int64)
        for i, motors_of_side in enumerate(motors):
            columns[i, : len(motors_of_side)] = motors_of_side
        return {
            "SIDE_FINGERS": np.array([len(side.fingers) for side in robot.sides]),
            "SIDE_HANDS": np.array([len(hand) for _, hand in robot.side_actuators]),
            "SIDE_MOTORS": np.array(list(map(len, motors))),
            "SIDE_COLUMNS": columns,
        }

    def _turning_tables(self) -> dict[str, NDArray[Any]]:
        """Return the motors that can move by full turns, and which of them have no limits."""
        robot = self.layouts.robot
        turning = np.array(robot.multi_turn, dtype=np.int64)
        return {"TURNING": turning, "CONTINUOUS": robot.continuous[turning].astype(np.int64)}

    def _finger_tables(self) -> dict[str, NDArray[Any]]:
        """Return the tables of single fingers for repairs, padded with zeros."""
        tables = self.seeds.fingers
        max_motors = max(len(table.columns) for table in tables)
        columns = np.zeros((len(tables), max_motors), dtype=np.int64)
        postures = np.zeros((len(tables), len(tables[0].postures), max_motors))
        for i, table in enumerate(tables):
            columns[i, : len(table.columns)] = table.columns
            postures[i, :, : len(table.columns)] = table.postures
        return {
            "FINGER_MOTORS": np.array([len(table.columns) for table in tables]),
            "FINGER_COLUMNS": columns,
            "FINGER_POSTURES": postures,
            "FINGER_TIPS": np.array([table.features for table in tables]),
        }


def can_search(plan: SearchPlan) -> bool:
    """Return whether a search and all functions that it calls are compiled."""
    kernels = (
        *plan.kernels.values(),
        *(kernel for side in plan.sides for kernel in side.seed_kernels.values()),
    )
    libraries = (search_library(part)[1] for part in (plan, *plan.sides))
    return all(kernel.entry for kernel in kernels) and None not in libraries


def search_library(plan: SearchPlan) -> tuple[str, ctypes.CDLL | None]:
    """Return name and compiled library of a search."""
    robot = plan.layouts.robot
    name = ca.Function.fix_name(f"hand_first_search_{robot.name}")
    wide = machine_lanes() > 0
    key = recipe(*(robot, plan.options, plan.layouts.kinds, plan.budget, plan.enforce_limits), wide)
    return name, load_library(name, lambda: _library_text(plan, wide), "casadi_ik_search", key)


def search_dtype(plan: SearchPlan) -> list[Any]:
    """Return the memory of a search as a NumPy record type."""
    kinds = {"double": np.float64, "int64_t": np.int64}
    members: list[Any] = [
        (name, kinds[kind], () if length is None else (length,))
        for name, (kind, length, _) in plan.fields.items()
    ]
    sides = [(name, np.int64, (len(plan.sides),)) for name in ("sides", "hands") if plan.sides]
    return [*members, ("tiles", np.int64, (3,)), *sides, *((name, np.int64) for name in KERNELS)]


def _library_text(plan: SearchPlan, wide: bool) -> str:
    """Return the C text of the library."""
    pointers = "".join(f"  int (*{name})({job} *);\n" for name, job in KERNELS.items())
    calls = "".join(f"#define {name.upper()}(work) (job->{name})(work)\n" for name in KERNELS)
    count = len(plan.sides)
    sides = f"  int64_t sides[{count}], hands[{count}];\n" if count else ""
    source = plan.source + ("" if plan.sides else source_text("hands"))
    codes = {code.name: int(code) for code in DriverCode} | {"MALFORMED": MALFORMED}
    return "".join(
        (
            WIDE if wide else "",
            "#include <math.h>\n#include <stdint.h>\n#include <string.h>\n",
            define(codes | {"FOREVER": NO_LIMIT}),
            driver_text("jobs"),
            f"typedef struct {{\n{plan.members()}",
            f"  const int16_t *tiles[3];\n{sides}{pointers}}} search;\n",
            f"{calls}#define TILES(table) (job->tiles[table])\n",
            define(plan.sizes),
            plan.constants(source),
            EXPORT,
            SIDE_CALLS if plan.sides else f"#define FIND_HANDS {SIDE_SEEDS}\n",
            source,
            source_text("calls"),
        )
    )
