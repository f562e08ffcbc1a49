"""Sources of a solver and of a follower: rendered templates, and a file per kernel."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile import FunctionKernel, LoopKernel
from casadi_ik.compile.codegen import (
    define,
    define_arrays,
    driver_text,
    number,
    row_major,
    standalone_source,
)
from casadi_ik.compile.emitter import CodeOptions
from casadi_ik.compile.graphs import FunctionGraph
from casadi_ik.compile.layout import Layout
from casadi_ik.compile.lookup import TILE
from casadi_ik.export.scene import WITHOUT_SCENE, SceneSources
from casadi_ik.export.single import (
    FOLLOWING,
    IN_DOUBLE,
    SinglePrecision,
    filled,
    in_single,
    in_single_precision,
)
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import point_normal_kinds
from casadi_ik.model.targets import TargetBatch, Tolerance
from casadi_ik.motion import recovery
from casadi_ik.motion.cycle import Cycle
from casadi_ik.motion.follower import PALM_WEIGHT
from casadi_ik.motion.free_path import motor_units
from casadi_ik.motion.inputs import ERROR_TIME, contact_weights
from casadi_ik.motion.motion import RUN_UP, own_velocities
from casadi_ik.motion.moving import FOLLOWING_PULL, SETTLING
from casadi_ik.solve.hand_first.method import HandFirstMethod
from casadi_ik.solve.hand_first.parameters import HandFirstParameters
from casadi_ik.solve.hand_first.search_code import SearchPlan, source_text
from casadi_ik.solve.hand_first.state import terms
from casadi_ik.solve.request import POSTURE_LIMIT_SLACK, contacts_from_palms
from casadi_ik.solve.verdict import LIMIT_SLACK, TOLERANCE_SLACK


def palm_marks(robot: ArmHand, prefix: str, real: str) -> dict[str, str]:
    """Return the substitutes for solving given palms; none where contacts leave the palm free.

    Robots without an arm, or with several arms, have none either.
    """
    if not robot.description.arm_actuators or robot.description.sides:
        return {}
    motors = robot.description.finger_motors
    own = np.where(np.isin(robot.actuators, motors), robot.home, np.nan)
    home = robot.palm(robot.home)
    if contacts_from_palms(robot, home[None], own[None])[2]:  # contacts leave it free
        return {}
    pose = np.concatenate([home[:3, :3].ravel(), home[:3, 3]])
    constants = f"#define POSTURE_ROUNDING {number(POSTURE_LIMIT_SLACK)}\n" + define_arrays(
        {"HOME_PALM": pose, "OF_HAND": np.isin(robot.actuators, motors).astype(int)}
    )
    marks = {"PREFIX": prefix, "GUARD": prefix.upper()}
    return {
        "PALM_CALLS": filled("palm.h", marks | {"REAL": real}),
        "PALM": "\n" + constants + filled("palm.c", marks),
        "PALM_WASM": filled("palm_wasm.c", marks),
        "PALM_JS": filled("palm.js", marks),
        "PALM_DTS": filled("palm.d.ts", marks),
    }


@dataclass(frozen=True, eq=False)
class FollowSources:
    """Sources of an exported follower.

    Attributes:
        robot: The robot.
        prefix: Prefix of every public name.
        tolerance: Tolerance of contacts.
    """

    robot: ArmHand
    prefix: str
    tolerance: Tolerance

    def files(self) -> tuple[dict[str, str], dict[str, str]]:
        """Return the C file by path, and the substitutes of marks in the other templates."""
        cycle = Cycle(self.robot.description, point_normal_kinds(len(self.robot.fingers)))
        marks = {
            "PREFIX": self.prefix,
            "GUARD": self.prefix.upper(),
            "CYCLE": standalone_source(row_major(cycle.graph.function), CodeOptions()),
            "FOLLOW_CONSTANTS": self._constants(cycle),
            "FOLLOW_STATE": str(cycle.state.size),
            "FOLLOW_PARAMETERS": str(cycle.parameters.size),
            "FOLLOW_RECORD": str(cycle.record.size),
            "FOLLOW_TRAIL": str(recovery.CAPACITY),
        }
        about = {
            "FOLLOW": "",
            "FOLLOW_CALLS": filled("follow.h", marks),
            "FOLLOW_WASM": filled("follow_wasm.c", marks),
            "FOLLOW_JS": filled("follow.js", marks),
            "FOLLOW_DTS": filled("follow.d.ts", marks),
            "FOLLOW_STATUS_JS": (
                "export const FollowStatus = Object.freeze({\n"
                "  HOLDING: 0,\n  FOLLOWING: 1,\n  LATE: 2,\n  MISSED: 3,\n});\n"
            ),
            "FOLLOW_STATUS_DTS": (
                "export const FollowStatus: {\n"
                "  /** Invalid frame: the motors decelerate to rest and wait. */\n"
                "  readonly HOLDING: 0;\n"
                "  /** All contacts are within tolerance. */\n  readonly FOLLOWING: 1;\n"
                "  /** Velocity and acceleration limits delay the motors. */\n  readonly LATE: 2;\n"
                "  /** No configuration on this branch meets the contacts. */\n"
                "  readonly MISSED: 3;\n"
                "};\n"
            ),
        }
        return {f"src/{self.prefix}_follow.c": filled("follow.c", marks)}, about

    def _constants(self, cycle: Cycle) -> str:
        robot, f = self.robot, len(self.robot.fingers)
        places = {
            "N_FINGERS": f,
            "N_MOTORS": len(robot.actuators),
            "MOVES_PALM": int(bool(cycle.palms)),
            "TRAIL_CAPACITY": recovery.CAPACITY,
        }
        places |= _places("STATE", cycle.state) | _places("PARAMETER", cycle.parameters)
        numbers = {
            "TOLERANCE_SLACK": TOLERANCE_SLACK,
            "SETTLING": SETTLING,
            "ERROR_TIME": ERROR_TIME,
            "PULL": FOLLOWING_PULL,
            "RUN_UP": RUN_UP,
            "PALM_WEIGHT": PALM_WEIGHT,
            "TRAIL_SPACING": recovery.SPACING,
            "TRAIL_CHECK_PERIOD": recovery.CHECK_PERIOD,
            "TRAIL_PATIENCE": recovery.PATIENCE,
            "TRAIL_SEARCH_TIME": recovery.SEARCH_TIME,
            "TRAIL_GAIN": recovery.GAIN,
            "TRAIL_PROGRESS": recovery.PROGRESS,
        }
        arrays = {
            "LOWER": robot.description.motion_limits[0],
            "UPPER": robot.description.motion_limits[1],
            "HOME": robot.home,
            "VELOCITY": own_velocities(robot),
            "UNITS": motor_units(robot),
            "WEIGHTS": contact_weights((self.tolerance,) * f),
            "POSITION_TOLERANCES": np.full(f, self.tolerance.position),
            "ANGLE_TOLERANCES": np.full(f, self.tolerance.angle),
        }
        return (
            define(places | _places("RECORD", cycle.record))
            + "".join(f"#define {name} {number(value)}\n" for name, value in numbers.items())
            + define_arrays(arrays)
        )


def _places(label: str, layout: Layout) -> dict[str, int]:
    return {f"{label}_{one.name.upper()}": layout.slice(one.name).start for one in layout}


@dataclass(frozen=True)
class Part:
    """An exported kernel.

    Attributes:
        name: Name of its file and function.
        job: C type of its argument.
        text: Text of its file.
        work: Size of its work memory in numbers.
    """

    name: str
    job: str
    text: str
    work: int


@dataclass(frozen=True, eq=False)
class SideSources:
    """Sources that seed the hand of one side of a robot with several arms.

    Attributes:
        plan: Search of the side alone.
        solver: Prefix of the names of the robot's solver.
        place: Index of the side.
    """

    plan: SearchPlan
    solver: str
    place: int

    @property
    def prefix(self) -> str:
        """Prefix of its names."""
        return f"{self.solver}_side_{self.place}"

    @property
    def member(self) -> str:
        """Member of the solver's struct that holds its memory."""
        own = f"{self.plan.members()}  {self.solver}_memory *memory;\n"
        return f"  struct {self.prefix} {{\n{own}  }} side_{self.place};\n"

    @property
    def declared(self) -> str:
        """Declaration of its function."""
        return (
            f"int {self.prefix}_hands(struct {self.prefix} *job, const scalar *points, "
            "const scalar *normals,\n    const scalar *q0, int64_t nearest, int64_t round, "
            "scalar *postures);\n"
        )

    @property
    def called(self) -> str:
        """Case of the switch that calls its function."""
        return (
            f"    case {self.place}:\n"
            f"      job->side_{self.place}.memory = &job->memory;\n"
            f"      return {self.prefix}_hands(&job->side_{self.place}, points, normals, q0, "
            "nearest, round,\n                                postures);\n"
        )

    def source(self, names: Iterable[str]) -> str:
        """Return the text of its file, which calls the named kernels."""
        texts = driver_text("loops") + "".join(
            map(source_text, ("spread", "restarts", "seeds", "hands"))
        )
        calls = "".join(
            f"#define {name.upper()}(work) {self.prefix}_{name}_kernel(work, job->memory)\n"
            for name in names
        )
        return (
            f"/* Seeds of the hand of {plain(self.plan.layouts.robot.name)}. */\n"
            f'#include "{self.solver}_parts.h"\n\n'
            "enum { DONE = 0, SLICE_OVER = 1 };\n\n"
            f"typedef struct {self.prefix} search;\n\n"
            f"{tiles(self.prefix, self.plan)}{calls}#define FIND_HANDS int {self.prefix}_hands\n"
            f"{define(self.plan.sizes)}{self.plan.constants(texts)}{texts}"
        )


HANDS_OF = """\
static int hands_of(search *job, int side, const scalar *points, const scalar *normals,
                    const scalar *q0, int64_t nearest, int64_t round, scalar *postures) {
  switch (side) {
@CASES@    default: return SLICE_OVER;
  }
}
#define HANDS(side, ...) hands_of(job, side, __VA_ARGS__)
"""


def tiles(prefix: str, plan: SearchPlan) -> str:
    """Return the macro that selects a lookup table; hands with repaired seeds have only one."""
    first, later = (f"{prefix}_table_{i}" for i in (0, 0 if plan.repairs_seeds else 1))
    return f"#define TILES(table) ((table) ? {later} : {first})\n"


@dataclass(frozen=True, eq=False)
class SolverSources:
    """Sources of a solver.

    Attributes:
        robot: The robot.
        method: The method hand-first for the robot.
        prefix: Prefix of every public name.
        tolerance: Default tolerance of contacts.
        scene: Sources of the scene; None: collisions are not checked.
        single: Allowances for rounding; None: double precision.
    """

    robot: ArmHand
    method: HandFirstMethod
    prefix: str
    tolerance: Tolerance
    scene: SceneSources | None = None
    single: SinglePrecision | None = None

    @cached_property
    def plan(self) -> SearchPlan:
        """Search for one target."""
        return self.method.plan(enforce_limits=True)

    @cached_property
    def sides(self) -> tuple[SideSources, ...]:
        """Sources of the sides of a robot with several arms."""
        return tuple(SideSources(one, self.prefix, i) for i, one in enumerate(self.plan.sides))

    @property
    def _searches(self) -> dict[str, SearchPlan]:
        """Searches that look up hand seeds, by the infix of their names."""
        found = {f"side_{side.place}_": side.plan for side in self.sides}
        return found or {"": self.plan}

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """Exported kernels."""
        plan, n_state = self.plan, self.plan.layouts.state.size
        # Exports do not record iterations.
        loop = define(plan.solve.constants | {"N_RECORD": 0, "ROW_BYTES": 0})
        loop += "#define store_row(record, row) ((void) (record), (void) (row))\n"
        parts = (
            self._part("begin", "map", plan.begin),
            self._part("solve", "loop", plan.solve, loop, 2 * n_state),
            self._part("contacts", "map", plan.contacts),
            self._part("judge", "map", plan.judge),
        )
        for name, search in self._searches.items():
            parts += self._hand_parts(name, search)
        return parts + self._scene_parts()

    def _hand_parts(self, name: str, plan: SearchPlan) -> tuple[Part, ...]:
        """Return the kernels that look up hand seeds."""
        lookup = plan.seeds.table.lookup
        tables = zip(plan.seeds.tables(enforce_limits=True), plan.seeds.table_samples, strict=False)
        rows = max(samples.count for _, samples in tables) + TILE
        # Distances of all rows and of their tiles are 32 bits each.
        room = rows if self.single is None else rows + rows // TILE
        constants = define(lookup.constants | {"REGISTER_BYTES": 0})
        found = (self._part(f"{name}look_up", "lookup", lookup.key, constants, room),)
        return found + (
            (self._part(f"{name}finger_errors", "map", plan.seeds.finger_errors),)
            if plan.repairs_seeds
            else ()
        )

    def _scene_parts(self) -> tuple[Part, ...]:
        scene = self.scene
        if scene is None:
            return ()
        shape_poses, constants, work = scene.clearance_kernel
        clearance = self._part("near", "clearance", shape_poses, constants, work)
        place = filled("place.c", {"PREFIX": self.prefix})
        parts = (replace(clearance, text=clearance.text + place),)
        return parts + tuple(self._part(name, "map", each) for name, each in scene.maps.items())

    def _part(
        self,
        name: str,
        driver: str,
        kernel: FunctionKernel | LoopKernel | FunctionGraph,
        constants: str = "",
        extra: int = 0,
    ) -> Part:
        of_graph = isinstance(kernel, FunctionGraph)
        function: Any = row_major(kernel.function) if of_graph else kernel.function
        if driver in ("map", "lookup"):
            constants += define({"N_IN": function.n_in(), "N_OUT": function.n_out()})
        if driver == "lookup":
            extra += function.numel_out(0)
        before = {"clearance": "lanes_alone"}.get(driver)
        text = driver_text(before) if before else ""
        text += driver_text(driver)
        body = "".join(
            (
                f'#include "{self.prefix}_parts.h"\n\n',
                standalone_source(function, self.form),
                f"#define NAMED {self.prefix}_{name}_kernel\n",
                f"#define MEMORY {self.prefix}_memory\n",
                driver_text("freestanding"),
                constants,
                text,
            )
        )
        return Part(name, f"{driver}_job", body, extra)

    @property
    def form(self) -> CodeOptions:
        """Options of the code of graphs."""
        if self.single is None:
            return CodeOptions()
        return CodeOptions(single=True, replaced=FOLLOWING)

    @property
    def substitutes(self) -> dict[str, str]:
        """Substitutes of the template marks."""
        robot, sizes = self.robot, self.plan.sizes
        jobs = "".join(driver_text(f"{name}_job") for name in ("loop", "map", "lookup"))
        jobs += self.scene.jobs() if self.scene else ""
        parts = "".join(
            f"int {self.prefix}_{p.name}_kernel({p.job} *job, {self.prefix}_memory *memory);\n"
            for p in self.parts
        ) + "".join(side.declared for side in self.sides)
        calls = "".join(
            f"#define {p.name.upper()}(work) {self.prefix}_{p.name}_kernel(work, &job->memory)\n"
            for p in self.parts
        )
        about = dict(WITHOUT_SCENE) if self.scene is None else self.scene.substitutes()
        about |= IN_DOUBLE if self.single is None else in_single(self.single)
        about |= palm_marks(robot, self.prefix, about["REAL"])
        lower, upper = self._bounds
        single = self.single
        changed = (None, None) if single is None else (single.reals, single.arrays)
        return about | {
            "PREFIX": self.prefix,
            "GUARD": self.prefix.upper(),
            "ROBOT": plain(robot.name),
            "FINGERS": str(len(robot.fingers)),
            "MOTORS": str(len(robot.actuators)),
            "FINGER_LIST": ", ".join(map(plain, robot.fingers)),
            "MOTOR_LIST": ", ".join(map(plain, robot.actuators)),
            "FINGER_NAMES": _strings(robot.fingers),
            "MOTOR_NAMES": _strings(robot.actuators),
            "W": str(max(1, *(part.work for part in self.parts))),
            "STRUCT": (self.plan.members() + "".join(side.member for side in self.sides)).rstrip(),
            "SEEDS": self._seeds(),
            "TABLES": "".join(
                f"extern const int16_t {name}[];\n" for name in self._tables
            ).rstrip(),
            "JOBS": jobs,
            "PARTS": parts,
            "CALLS": calls,
            "SIZES": define(sizes),
            "CONSTANTS": self.plan.constants(self.plan.source + "".join(about.values()), *changed),
            "SEARCH": self.plan.source,
            "TERMS": define_arrays({"TERMS": self._terms(), "HOME": robot.home}),
            "LIMITS": define_arrays(
                {f"{self.prefix}_lower": lower, f"{self.prefix}_upper": upper}, "const"
            ),
            "POSITION_TOLERANCE": repr(self.tolerance.position),
            "ANGLE_TOLERANCE": repr(self.tolerance.angle),
        }

    def _seeds(self) -> str:
        """Return the macros through which the search obtains seeds."""
        if not self.sides:
            return tiles(self.prefix, self.plan)
        return HANDS_OF.replace("@CASES@", "".join(side.called for side in self.sides))

    @property
    def side_files(self) -> dict[str, str]:
        """Files of the sides by path."""
        return {f"src/{side.prefix}.c": side.source(side.plan.seed_kernels) for side in self.sides}

    @cached_property
    def _tables(self) -> dict[str, NDArray[np.int16]]:
        """Keys of the lookup tables by the names of their arrays."""
        return {
            f"{self.prefix}_{name}table_{i}": np.ascontiguousarray(table.lookup.tiles).reshape(-1)
            for name, plan in self._searches.items()
            for i, table in enumerate(plan.seeds.tables(enforce_limits=True))
        }

    def tables(self) -> str:
        """Return the file with the keys of the lookup tables."""
        head = "/* Keys of hand postures, which are compared with targets. */\n"
        include = f'#include "{self.prefix}_parts.h"\n\n'
        return head + include + define_arrays(self._tables, "const")

    @property
    def _bounds(self) -> tuple[Array, Array]:
        return (self.robot.lower, self.robot.upper) if self.single is None else self.single.bounds

    def _terms(self) -> Array:
        f = len(self.robot.fingers)
        none, allowed = np.zeros((1, f, 3)), self.tolerance
        layout = terms(self.robot.description)
        if self.single is not None:
            less = self.single.tolerance
            allowed = Tolerance(allowed.position - less.position, allowed.angle - less.angle)
        found = self.method.terms(TargetBatch(none, none, allowed, True)).copy()
        found[layout.slice("lower")], found[layout.slice("upper")] = self._bounds
        return found

    def judge(self) -> dict[str, str]:
        """Return the files of double-precision kinematics that verify answers."""
        marks = {
            "KINEMATICS": standalone_source(self.plan.judge.function, CodeOptions()),
            "POSITION_TOLERANCE": repr(self.tolerance.position),
            "ANGLE_TOLERANCE": repr(self.tolerance.angle),
            "LIMIT_SLACK": repr(LIMIT_SLACK),
        }
        return {f"test/{name}": filled(name, marks) for name in ("judge.c", "judge.h")}

    def final(self, files: dict[str, str]) -> dict[str, str]:
        """Return C files in the precision of the export."""
        if self.single is None:
            return files
        return {path: in_single_precision(text) for path, text in files.items()}


def hand_first(robot: ArmHand) -> HandFirstMethod:
    """Return the method hand-first of a robot, with its kernels compiled."""
    method = HandFirstMethod(robot.description, HandFirstParameters())
    method.prepare()
    return method


def plain(name: str) -> str:
    """Return a name without characters that could end a comment; files are untrusted."""
    return re.sub(r"[^\w .+-]", "_", name)


def _strings(names: tuple[str, ...]) -> str:
    """Return a list of string literals of C and JavaScript."""
    return ", ".join(json.dumps(name, ensure_ascii=False) for name in names)
