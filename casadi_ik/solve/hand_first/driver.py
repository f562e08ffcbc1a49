"""Driver of hand-first: C code generated for a robot, and its calls for one target and for batches.

The algorithm is in hand_first.c and seeds.c, and in the loop that calls them. This module provides
their memory, their constants and the kernels that they call.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from importlib import resources
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile import REPEATED, RUNNING, FunctionKernel, LoopKernel
from casadi_ik.compile.cancellation import SLICE, DriverCode, check
from casadi_ik.compile.codegen import WIDE, define, define_arrays, driver_text, number
from casadi_ik.compile.function_kernel import machine_lanes, memory
from casadi_ik.compile.graphs import recipe
from casadi_ik.compile.libraries import load_library
from casadi_ik.compile.loop import SLOTS, UNBEGUN, UNBOUNDED, SlotSource
from casadi_ik.errors import KernelError
from casadi_ik.files.arrays import Array, spread_steps
from casadi_ik.kinematics.contact_fit import initial_lm_state
from casadi_ik.kinematics.contacts import LENGTH
from casadi_ik.model.grasp import MAX_PLAIN_LENGTH, MIN_PLAIN_LENGTH, UNIT_ROUNDING
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.hand_first.parameters import HandFirstParameters
from casadi_ik.solve.hand_first.seeds import FEATURES, Seeds
from casadi_ik.solve.hand_first.state import HandFirstLayouts, terms
from casadi_ik.solve.method import Outcome, SingleOutcome
from casadi_ik.solve.status import Phase, Status
from casadi_ik.solve.turns import TURN
from casadi_ik.solve.verdict import LIMIT_SLACK, TOLERANCE_SLACK, construct_unchecked

MALFORMED = -9
"""Return code of a search for a malformed target."""

SMALLEST = 1e-9
"""Lower bound of the ranges that scale motor distances [rad or m]."""

KERNELS = {
    "look_up": "lookup_job",
    "begin": "map_job",
    "solve": "loop_job",
    "seen": "map_job",
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

HANDS = "EXPORT int casadi_ik_hands"
"""Declaration of the function that a multi-arm robot calls for seeds of its sides."""

OF_SIDES = """
typedef int (*find_hands)(void *, const double *, const double *, const double *, int64_t, int64_t,
                          double *);
#define HANDS(side, ...) ((find_hands) job->hands[side])((void *) job->sides[side], __VA_ARGS__)
"""
"""Macro by which a multi-arm robot calls the seed function of a side."""

STATE = (
    *("q", "phase", "candidate", "earlier", "held", "returns"),
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
        made: Factories of the kernels below, which are compiled at the first use.
        sides: Plans of the sides of a multi-arm robot, for the seeds of their hands.
    """

    layouts: HandFirstLayouts
    options: HandFirstParameters
    budget: int
    seeds: Seeds
    enforce_limits: bool
    made: Mapping[str, Callable[[], Any]]
    sides: tuple[SearchPlan, ...] = ()

    @property
    def begin(self) -> FunctionKernel:
        """Kernel of the first state and the parameters of a restart."""
        return self.made["begin"]()

    @property
    def solve(self) -> LoopKernel:
        """Compiled loop."""
        return self.made["solve"]()

    @property
    def contacts(self) -> FunctionKernel:
        """Kernel of contact points and normals of configurations, for exported solvers."""
        return self.made["contacts"]()

    @property
    def judge(self) -> FunctionKernel:
        """Kernel of the errors of a configuration and its excess over limits."""
        return self.made["judge"]()

    @property
    def rounds(self) -> int:
        """Maximum number of restarts of a search."""
        return self.options.all_rounds(self.layouts.robot)

    @property
    def mends(self) -> bool:
        """Whether the seeds of later restarts are repaired finger by finger."""
        return self.enforce_limits and self.seeds.mends

    @property
    def pool(self) -> int:
        """Maximum number of postures from which the seeds of a restart are selected."""
        options = self.options
        mended = max(options.pool, options.candidates)
        return mended if self.mends else options.candidates * max(options.rounds - 1, 1)

    @property
    def kernels(self) -> dict[str, Any]:
        """Called kernels by their names in `KERNELS`."""
        found = {"begin": self.begin, "solve": self.solve, "judge": self.judge}
        return found if self.sides else found | self.of_hands

    @property
    def of_hands(self) -> dict[str, Any]:
        """Kernels that find seeds."""
        found = {"look_up": self.seeds.table.lookup}
        return found | ({"seen": self.seeds.seen} if self.mends else {})

    @property
    def source(self) -> str:
        """C code of a search."""
        names = "spread", "sides" if self.sides else "seeds", "hand_first"
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
            "N_TERMS": terms(robot).size,
            "N_STATE": layouts.state.size,
            "N_PARAMETERS": layouts.parameters.size,
            "N_CANDIDATES": self.options.candidates,
            "N_POOL": self.pool,
            "N_MENDED": self.pool if self.mends else self.options.candidates,
            "N_MORE": len(layouts.contacts.data) - 2,
            "N_SIDES": len(self.sides),
            "N_TURNING": len(robot.multi_turn),
        }

    @property
    def fields(self) -> dict[str, tuple[str, int | None, str]]:
        """Type, length (None: scalar) and meaning of the members of a search, 8 bytes each."""
        f, n, h, _, state, parameters, candidates, pool, mended, more, *_ = self.sizes.values()
        double, whole = "double", "int64_t"
        h = max(h, 1)  # a tool has no motors, and C no empty arrays
        return {
            "points": (double, 3 * f, "the question: base frame, NaN = free"),
            "normals": (double, 3 * f, ""),
            "more": (double, 3 * f * more + 1, "contacts' other vectors, without a verdict here"),
            "here": (double, n, "where the robot is"),
            "turns": (
                double,
                max(self.sizes["N_TURNING"], 1),
                "full turns taken off `here`",
            ),
            "terms": (double, self.sizes["N_TERMS"], "tolerances, bounds, 1 = nearest wanted"),
            "most": (whole, None, "rounds of a search; 0: its first alone, no search without"),
            "q": (double, n, "the answer"),
            "position_error": (double, f, "[m]"),
            "angle_error": (double, f, "[rad]"),
            "beyond": (double, None, "by how much the worst motor or joint is beyond its limits"),
            "iterations": (whole, None, ""),
            "restarts": (whole, None, ""),
            "status": (whole, None, ""),
            "judged": (whole, None, "on its way: whether there is a verdict"),
            "round": (whole, None, ""),
            "preference_dropped": (whole, None, "1 = restarts are repeated without the preference"),
            "restart_quota": (whole, None, "restarts that this call may still begin"),
            "slot": (whole, None, "of the loop, -1 = not under way"),
            "begun": (whole, None, "iterations before the round"),
            "loop_status": (whole, None, ""),
            "paused": (whole, None, ""),
            "state": (double, state, ""),
            "parameters": (double, parameters, ""),
            "previous_state": (double, state, "last state of the previous restart"),
            "mark": (double, state, ""),
            "postures": (double, candidates * h, "of the round"),
            "incumbent_hands": (double, 2 * h, "the best hand and the previous best hand"),
            "incumbent_count": (whole, None, ""),
            "seed_pool": (double, mended * h, "work memory of seeds.c and of collision checks"),
            "seed_error": (double, mended, "sums of squared contact errors"),
            "seed_rows": (whole, pool, ""),
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
        named = set(re.findall(r"\w+", source))
        tables = self._arrays() | dict(arrays or {})
        tables = {name: array for name, array in tables.items() if name in named}
        return define(self._whole_numbers()) + "".join(lines) + define_arrays(tables)

    def _whole_numbers(self) -> dict[str, int]:
        layouts, robot = self.layouts, self.layouts.robot
        places = {f"STATE_{name.upper()}": layouts.state.slice(name).start for name in self._state}
        for label, layout in (("PARAMETERS", layouts.parameters), ("TERMS", terms(robot))):
            for name in ("lower", "upper", "nearest"):
                places[f"{label}_{name.upper()}"] = layout.slice(name).start
        return {
            "RUNNING": RUNNING,
            "REPEATED": REPEATED,
            "UNBEGUN": UNBEGUN,
            "BUDGET": self.budget,
            "ALL_ROUNDS": self.rounds,
            "FIRST_RUGGED": self.options.first_rugged,
            "MENDS": int(self.mends),
            "FINGER_FEATURES": FEATURES,
            "ENFORCE_LIMITS": int(self.enforce_limits),
            "HAS_ARM": int(bool(layouts.arm)),
            "N_CARRIED": len(self._carried),
            "N_FRESH": len(initial_lm_state()),
            "N_COUNTS": len(self.layouts.stages),
            **{f"{status.name}_STATUS": int(status) for status in Status},
            **{f"{phase.name}_PHASE": int(phase) for phase in Phase},
            **{k: v for k, v in self._options.items() if isinstance(v, int)},
            **places,
        }

    @property
    def _state(self) -> tuple[str, ...]:
        return (*STATE, "hopeless") if self.sides else STATE

    @property
    def _options(self) -> dict[str, Any]:
        """Numeric options; of pairs for few and many motors the robot's, and that for many."""
        many, found = self.options.is_many(self.layouts.robot), dict[str, Any]()
        for name, value in asdict(self.options).items():
            if isinstance(value, int | float):
                found[name.upper()] = value
            elif name in ("same_minimum", "far_cost"):
                found |= {name.upper(): value[many], f"{name.upper()}_MANY": value[1]}
        return found

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
    def _carried(self) -> list[int]:
        """Indices of the state entries that are kept across restarts."""
        slices = map(self.layouts.state.slice, self.layouts.carried)
        return [place for one in slices for place in range(one.start, one.stop)]

    def _arrays(self) -> dict[str, NDArray[Any]]:
        robot, seeds = self.layouts.robot, self.seeds
        hand, spreads = list(robot.hand_actuators), seeds.spreads
        lower, upper = seeds.anywhere_bounds(self.enforce_limits)
        fresh, state = initial_lm_state(), self.layouts.state
        return {
            "HAND": np.array(hand, dtype=np.int64),
            "CARRIED": np.array(self._carried),
            "FRESH_PLACES": np.array([state.slice(name).start for name in fresh]),
            "FRESH_VALUES": np.array([float(value) for value in fresh.values()]),
            "LOWER": robot.lower,
            "UPPER": robot.upper,
            "ORDER_RANGES": np.maximum((robot.upper - robot.lower)[hand], SMALLEST),
            "HAND_STEPS": spread_steps(len(hand)),
            "ALL_STEPS": spread_steps(len(robot.actuators)),
            "ANYWHERE_LOWER": lower,
            "ANYWHERE_RANGE": upper - lower,
            **(self._finger_tables() if self.mends else {}),
            "TABLE_LOWER": np.array([spread.lower[hand] for spread in spreads]),
            "TABLE_RANGE": np.array([(spread.upper - spread.lower)[hand] for spread in spreads]),
            "TABLE_SQUEEZE": np.array([1 - spread.at_limits for spread in spreads]),
            "TABLE_ROWS": np.array([spread.count for spread in spreads]),
            **(self._side_tables() if self.sides else {}),
            **(self._turning_tables() if robot.multi_turn else {}),
        }

    def _side_tables(self) -> dict[str, NDArray[Any]]:
        """Return the fingers, hands and motors of each side, padded with zeros."""
        robot = self.layouts.robot
        motors = [sorted((*arm, *hand)) for arm, hand in robot.side_actuators]
        places = np.zeros((len(motors), max(map(len, motors))), dtype=np.int64)
        for i, own in enumerate(motors):
            places[i, : len(own)] = own
        return {
            "SIDE_FINGERS": np.array([len(side.fingers) for side in robot.sides]),
            "SIDE_HANDS": np.array([len(hand) for _, hand in robot.side_actuators]),
            "SIDE_MOTORS": np.array([len(own) for own in motors]),
            "SIDE_PLACES": places,
        }

    def _turning_tables(self) -> dict[str, NDArray[Any]]:
        """Return the places in q of the motors that turn, and which of them have no limits."""
        robot = self.layouts.robot
        turning = np.array(robot.multi_turn, dtype=np.int64)
        return {"TURNING": turning, "CONTINUOUS": robot.continuous[turning].astype(np.int64)}

    def _finger_tables(self) -> dict[str, NDArray[Any]]:
        """Return the tables of single fingers for repairs, padded with zeros."""
        tables = self.seeds.fingers
        most = max(len(table.places) for table in tables)
        places = np.zeros((len(tables), most), dtype=np.int64)
        postures = np.zeros((len(tables), len(tables[0].postures), most))
        for i, table in enumerate(tables):
            places[i, : len(table.places)] = table.places
            postures[i, :, : len(table.places)] = table.postures
        return {
            "FINGER_MOTORS": np.array([len(table.places) for table in tables]),
            "FINGER_PLACES": places,
            "FINGER_POSTURES": postures,
            "FINGER_TIPS": np.array([table.features for table in tables]),
        }


class Searches:
    """Memory of concurrent searches and the calls that run them; not shared by threads.

    The attributes are views of the first search.

    Attributes:
        points: (f, 3) [m], NaN where free; write into it.
        normals: (f, 3); write into it.
        more: (f, 3) each, the contacts' other vectors; write into them.
        here: (n,) where the robot is; write into it.
        terms: What `beginning` calls so; write into it.
        q: (n,) the answer; a call overwrites it, as all below.
        position_error: (f,) [m], where there are points and normals only.
        angle_error: (f,) [rad], likewise.
        state: (ns,) of the loop.
        parameters: (np,) of the loop.
        postures: (candidates, hand) of a round.
    """

    def __init__(self, plan: SearchPlan, count: int) -> None:
        """Compile what is not compiled yet.

        Args:
            plan: Ingredients of the C code; its kernels are compiled.
            count: Number of concurrent searches.

        Raises:
            KernelError: The compiler refused.
        """
        robot = plan.layouts.robot
        self.plan = plan
        self._name, library = _library(plan)
        if library is None:
            raise KernelError(f"{self._name}: no compiler, and no kernel made ahead")
        self._search: Any = library["casadi_ik_search"]
        self._decide: Any = library["casadi_ik_decide"]
        self._find_postures: Any = library["casadi_ik_postures"]
        self._follow = ctypes.cast(library["casadi_ik_follow"], ctypes.c_void_p).value
        self._memory = searches = np.zeros(count, dtype=_form(plan))
        self._kept = _called(plan, searches, plan.kernels)
        for i, side in enumerate(plan.sides):
            self._kept += self._hands_of(side, i)
        f = len(robot.fingers)
        one = searches[0]
        self.points, self.normals = one["points"].reshape(f, 3), one["normals"].reshape(f, 3)
        self.more = list(one["more"][:-1].reshape(-1, f, 3))
        self.here, self.terms, self.q = one["here"], one["terms"], one["q"]
        self.position_error, self.angle_error = one["position_error"], one["angle_error"]
        self.state, self.parameters = one["state"], one["parameters"]
        shape = plan.options.candidates, plan.sizes["N_HAND"]
        self.postures = one["postures"][: np.prod(shape)].reshape(shape)
        self._one = one
        self._counts = self.state[plan.layouts.state.slice("counts")]
        self._base = memory(searches.view(np.uint8))
        self._address = ctypes.c_void_p(self._base)
        # An entry of a record costs as much as a tenth of a solve: these are read in every one.
        offsets = searches.dtype.fields or {}
        self._most, self._iterations, self._restarts, self._status, self._paused = (
            ctypes.c_int64.from_address(self._base + offsets[name][1])
            for name in ("most", "iterations", "restarts", "status", "paused")
        )
        self._beyond = ctypes.c_double.from_address(self._base + offsets["beyond"][1])

    def _hands_of(self, plan: SearchPlan, place: int) -> tuple[Any, ...]:
        """Allocate the seed searches of a side, one for each search of the multi-arm robot."""
        name, library = _library(plan)
        if library is None:
            raise KernelError(f"{name}: no compiler, and no kernel made ahead")
        own = np.zeros(len(self._memory), dtype=_form(plan))
        kept = _called(plan, own, plan.of_hands)
        step = own.dtype.itemsize
        first = memory(own.view(np.uint8))
        self._memory["sides"][:, place] = first + step * np.arange(len(own))
        found: Any = library["casadi_ik_hands"]
        self._memory["hands"][:, place] = ctypes.cast(found, ctypes.c_void_p).value
        return kept

    def ask(self, targets: TargetBatch, row: int, here: Array, given: Array) -> None:
        """Write a target to the arrays.

        Args:
            targets: k targets.
            row: Index of the target.
            here: (n,) start configuration.
            given: Terms of the target.
        """
        self.points[...], self.normals[...] = targets.points[row], targets.normals[row]
        self.here[...], self.terms[...] = here, given
        for vectors, name in zip(self.more, self.plan.layouts.contacts.data[2:], strict=True):
            vectors[...] = targets.vectors(f"{name}s")[row]

    def __call__(self, rounds: int) -> int | None:
        """Search for the target in the arrays.

        Args:
            rounds: Maximum number of restarts.

        Returns:
            Code of `Status`, after the verdict where there is one; None: the target is malformed.

        Raises:
            KernelError: No work memory.
        """
        self._most.value = rounds
        code = self._search(self._address)
        if code == DriverCode.DONE:
            return self._status.value
        if code == MALFORMED:
            return None
        try:
            while code != DriverCode.DONE:
                check(self._name, code)
                code = self._search(self._address)
        finally:
            self._paused.value = 0
        return self._status.value

    def answer(self, status: int) -> SingleOutcome:
        """Return a copy of the last answer.

        Args:
            status: Status that the call returned.
        """
        errors = None
        if not self.more:
            errors = self.position_error.tolist(), self.angle_error.tolist(), self._beyond.value
        return construct_unchecked(
            SingleOutcome,
            q=self.q.copy(),
            status=status,
            iterations=self._iterations.value,
            restarts=self._restarts.value,
            phases=dict(
                zip(self.plan.layouts.labels, map(int, self._counts.tolist()), strict=True)
            ),
            errors=errors,
        )

    def decide(self, status: int, rounds: int) -> bool:
        """Return whether a restart follows; it then begins with `state` and `parameters`.

        Args:
            status: Status with which the loop ended in `state`, or `UNBEGUN`.
            rounds: Maximum number of restarts.
        """
        self._one["loop_status"], self._one["most"] = status, rounds
        code = self._decide(self._address)
        if code != DriverCode.GOES_ON:
            check(self._name, code)
        return code == DriverCode.GOES_ON

    def hands(self, number: int) -> Array:
        """Return the seeds (candidates, hand) of a restart for the target in the arrays."""
        self._one["round"], self.terms[-1] = number, 0.0  # in no particular order
        check(self._name, self._find_postures(self._address))
        return self.postures.copy()

    def batch(
        self,
        targets: TargetBatch,
        q0: Array,
        given: Array,
        rounds: NDArray[np.int64],
        trace: bool,
    ) -> Outcome:
        """Search for k targets, `SLOTS` of them at a time.

        Args:
            targets: The targets.
            q0: (k, n) start configurations.
            given: Terms of the targets, (t,) or (k, t).
            rounds: (k,) maximum numbers of restarts.
            trace: Whether to keep every iteration.
        """
        plan, count = self.plan, len(targets)
        data = plan.layouts.contacts.data
        more = [targets.vectors(f"{name}s") for name in data[2:]]
        asked = [
            *map(np.ascontiguousarray, (targets.points, targets.normals)),
            np.stack(more, axis=1) if more else np.zeros(1),
            *map(np.ascontiguousarray, (q0, given)),
            rounds,
        ]
        answers = [
            np.empty_like(q0, order="C"),
            np.empty((count, len(plan.layouts.stages))),
            np.empty(count, dtype=np.int64),
        ]
        step = 0 if given.ndim == 1 else given.shape[1]
        job = (ctypes.c_int64 * 11)(self._base, *map(memory, asked), step, *map(memory, answers))
        fields: Any = self._memory.dtype.fields
        result = plan.solve.run_from_slots(
            SlotSource(
                states=self._base + fields["state"][1],
                parameters=self._base + fields["parameters"][1],
                step=self._memory.dtype.itemsize // 8,
                slots=len(self._memory),
                follow=self._follow or 0,
                method=ctypes.addressof(job),
            ),
            count,
            plan.budget,
            trace,
        )
        q, counts, restarts = answers
        return Outcome(
            q=q,
            status=result.status.astype(np.int64),
            iterations=result.iterations,
            restarts=restarts,
            time=result.time,
            phases=dict(zip(self.plan.layouts.labels, counts.astype(np.int64).T, strict=True)),
            rows=result.rows,
        )


def _called(plan: SearchPlan, searches: NDArray[Any], kernels: dict[str, Any]) -> tuple[Any, ...]:
    """Store the addresses of kernels in searches; return the objects that must stay alive."""
    tables = plan.seeds.tables(plan.enforce_limits)
    for i, table in enumerate(tables):
        searches["tiles"][:, i] = memory(table.lookup.tiles)
    for name, kernel in kernels.items():
        searches[name] = ctypes.cast(kernel.entry, ctypes.c_void_p).value
    return kernels, tables, searches


class SearchPool:
    """Pool of search memory, which grows with the number of concurrent threads."""

    def __init__(self, plan: Callable[[bool], SearchPlan]) -> None:
        """Store the factory of plans; nothing is compiled yet.

        Args:
            plan: Return the plan with or without enforced limits.
        """
        self._plan = plan
        self._free: dict[tuple[bool, int], list[Searches]] = {}

    @contextmanager
    def lent(self, enforce_limits: bool, count: int = 1) -> Iterator[Searches]:
        """Lend memory for one search, or for `SLOTS` searches if there are several targets."""
        size = SLOTS if count > 1 else 1
        free = self._free.setdefault((enforce_limits, size), [])
        try:
            searches = free.pop()
        except IndexError:
            searches = Searches(self._plan(enforce_limits), size)
        yield searches
        free.append(searches)


def can_search(plan: SearchPlan) -> bool:
    """Return whether a search and all functions that it calls are compiled."""
    called = (
        *plan.kernels.values(),
        *(one for side in plan.sides for one in side.of_hands.values()),
    )
    libraries = (_library(one)[1] for one in (plan, *plan.sides))
    return all(kernel.entry for kernel in called) and None not in libraries


def _library(plan: SearchPlan) -> tuple[str, ctypes.CDLL | None]:
    """Return name and compiled library of a search."""
    robot = plan.layouts.robot
    name = ca.Function.fix_name(f"hand_first_search_{robot.name}")
    given = robot, plan.options, plan.layouts.kinds, plan.budget, plan.enforce_limits
    wide = machine_lanes() > 0
    known = recipe(*given, wide)
    return name, load_library(name, lambda: _text(plan, wide), "casadi_ik_search", known)


def _form(plan: SearchPlan) -> list[Any]:
    """Return the memory of a search as a NumPy record type."""
    kinds = {"double": np.float64, "int64_t": np.int64}
    form: list[Any] = [
        (name, kinds[kind], () if length is None else (length,))
        for name, (kind, length, _) in plan.fields.items()
    ]
    sides = [(name, np.int64, (len(plan.sides),)) for name in ("sides", "hands") if plan.sides]
    return [*form, ("tiles", np.int64, (3,)), *sides, *((name, np.int64) for name in KERNELS)]


def _text(plan: SearchPlan, wide: bool) -> str:
    """Return the C text of the library."""
    jobs = (driver_text(name) for name in ("loop_job", "map_job", "lookup_job"))
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
            define(codes | {"FOREVER": UNBOUNDED}),
            *jobs,
            f"typedef struct {{\n{plan.members()}",
            f"  const int16_t *tiles[3];\n{sides}{pointers}}} search;\n",
            f"{calls}#define TILES(table) (job->tiles[table])\n",
            define(plan.sizes),
            plan.constants(source),
            EXPORT,
            OF_SIDES if plan.sides else f"#define FIND_HANDS {HANDS}\n",
            source,
            source_text("calls"),
        )
    )
