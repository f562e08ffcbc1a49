"""Sources of an exported solver and follower: rendered templates, and one file per kernel."""

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
    DOUBLE_PRECISION,
    REPLACED_THRESHOLDS,
    SinglePrecision,
    in_single_precision,
    render_template,
    single_precision_substitutes,
)
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import LENGTH, point_normal_kinds
from casadi_ik.model.targets import TargetBatch, Tolerance
from casadi_ik.motion import recovery
from casadi_ik.motion.cycle import CYCLE_TUNING, Cycle
from casadi_ik.motion.cycle_runner import ERROR_TIME, contact_weights
from casadi_ik.motion.follower import PALM_WEIGHT, RETURN_SHARE
from casadi_ik.motion.free_path import motor_units
from casadi_ik.motion.motion import RUN_UP, own_velocities
from casadi_ik.motion.moving import FOLLOWING_PULL, SETTLING
from casadi_ik.solve.hand_first.method import HandFirstMethod
from casadi_ik.solve.hand_first.parameters import HandFirstParameters
from casadi_ik.solve.hand_first.search_code import SearchPlan, source_text
from casadi_ik.solve.hand_first.state import settings_layout
from casadi_ik.solve.hand_postures import POSTURE_LIMIT_SLACK
from casadi_ik.solve.target_builder import contacts_from_palms
from casadi_ik.solve.verdict import LIMIT_SLACK, TOLERANCE_SLACK


def palm_substitutes(robot: ArmHand, prefix: str) -> dict[str, str]:
    """Return the substitutes for palm targets; empty if contacts leave the palm free.

    They are empty for robots without an arm or with several arms too.
    """
    if not robot.description.arm_actuators or robot.description.sides:
        return {}
    motors = robot.description.finger_motors
    hand_posture = np.where(np.isin(robot.actuators, motors), robot.home, np.nan)
    home = robot.palm(robot.home)
    if contacts_from_palms(robot, home[None], hand_posture[None])[2]:
        return {}
    pose = np.concatenate([home[:3, :3].ravel(), home[:3, 3]])
    constants = f"#define POSTURE_ROUNDING {number(POSTURE_LIMIT_SLACK)}\n" + define_arrays(
        {"HOME_PALM": pose, "OF_HAND": np.isin(robot.actuators, motors).astype(int)}
    )
    marks = {"PREFIX": prefix, "GUARD": prefix.upper()}
    return {"PALM": "\n" + constants + render_template("palm.c", marks)}


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
        """Return the C file by path, and the substitutes of marks in other templates."""
        cycle = Cycle(self.robot.description, point_normal_kinds(len(self.robot.fingers)))
        prefix = {"PREFIX": self.prefix}
        marks = prefix | {
            "GUARD": self.prefix.upper(),
            "CLUTCH": render_template("clutch.c", prefix),
            "RECOVERY": render_template("recovery.c", prefix),
            "CYCLE": standalone_source(row_major(cycle.graph.function), CodeOptions()),
            "FOLLOW_CONSTANTS": self._constants(cycle),
        }
        substitutes = {
            "FOLLOW": "",
            "FOLLOW_STATE": str(cycle.state.size),
            "FOLLOW_PARAMETERS": str(cycle.parameters.size),
            "FOLLOW_RECORD": str(cycle.record.size),
            "FOLLOW_TRAIL": str(recovery.CAPACITY),
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
        return {f"src/{self.prefix}_follow.c": render_template("follow.c", marks)}, substitutes

    def _constants(self, cycle: Cycle) -> str:
        """Return the C definitions of sizes, offsets, parameters and arrays of the follower."""
        robot, f = self.robot, len(self.robot.fingers)
        integers = {
            "N_FINGERS": f,
            "N_MOTORS": len(robot.actuators),
            "MOVES_PALM": int(bool(cycle.palms)),
            "TRAIL_CAPACITY": recovery.CAPACITY,
            "N_RESIDUALS": cycle.state.slice("residual").stop - cycle.state.slice("residual").start,
        }
        integers |= _field_offsets("STATE", cycle.state) | _field_offsets(
            "PARAMETER", cycle.parameters
        )
        numbers = {
            "TOLERANCE_SLACK": TOLERANCE_SLACK,
            "SETTLING": SETTLING,
            "ERROR_TIME": ERROR_TIME,
            "PULL": FOLLOWING_PULL,
            "RUN_UP": RUN_UP,
            "PALM_WEIGHT": PALM_WEIGHT,
            "LENGTH": LENGTH,
            "BRAKING_SHARE": CYCLE_TUNING.braking_share,
            "RETURN_SHARE": RETURN_SHARE,
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
            define(integers | _field_offsets("RECORD", cycle.record))
            + "".join(f"#define {name} {number(value)}\n" for name, value in numbers.items())
            + define_arrays(arrays)
        )


def _field_offsets(label: str, layout: Layout) -> dict[str, int]:
    return {f"{label}_{item.name.upper()}": layout.slice(item.name).start for item in layout}


@dataclass(frozen=True)
class KernelSource:
    """Source of an exported kernel.

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
    """Sources that seed the hand of one side of a multi-arm robot.

    Attributes:
        plan: Search of the side alone.
        solver: Prefix of the names of the robot's solver.
        index: Index of the side.
    """

    plan: SearchPlan
    solver: str
    index: int

    @property
    def prefix(self) -> str:
        """Prefix of the names of the side."""
        return f"{self.solver}_side_{self.index}"

    @property
    def member(self) -> str:
        """Member of the struct of the solver with the memory of the side."""
        members = f"{self.plan.members()}  {self.solver}_memory *memory;\n"
        return f"  struct {self.prefix} {{\n{members}  }} side_{self.index};\n"

    @property
    def declaration(self) -> str:
        """Declaration of the function that seeds the hand."""
        return (
            f"int {self.prefix}_hands(struct {self.prefix} *job, const scalar *points, "
            "const scalar *normals,\n    const scalar *q0, int64_t nearest, int64_t round, "
            "scalar *postures);\n"
        )

    @property
    def switch_case(self) -> str:
        """Case of the switch statement that calls the function."""
        return (
            f"    case {self.index}:\n"
            f"      job->side_{self.index}.memory = &job->memory;\n"
            f"      return {self.prefix}_hands(&job->side_{self.index}, points, normals, q0, "
            "nearest, round,\n                                postures);\n"
        )

    def source(self, names: Iterable[str]) -> str:
        """Return the C file of the side, which calls the kernels with these names."""
        texts = driver_text("loops") + "".join(
            map(source_text, ("spread", "restarts", "seeds", "hands"))
        )
        calls = "".join(
            f"#define {name.upper()}(work) {self.prefix}_{name}_kernel(work, job->memory)\n"
            for name in names
        )
        return (
            f"/* Seeds of the hand of {sanitized_name(self.plan.layouts.robot.name)}. */\n"
            f'#include "{self.solver}_parts.h"\n\n'
            "enum { DONE = 0, SLICE_OVER = 1 };\n\n"
            f"typedef struct {self.prefix} search;\n\n"
            f"{table_macro(self.prefix, self.plan)}{calls}"
            f"#define FIND_HANDS int {self.prefix}_hands\n"
            f"{define(self.plan.sizes)}{self.plan.constants(texts)}{texts}"
        )


HANDS_DISPATCH = """\
static int hands_of(search *job, int side, const scalar *points, const scalar *normals,
                    const scalar *q0, int64_t nearest, int64_t round, scalar *postures) {
  switch (side) {
@CASES@    default: return SLICE_OVER;
  }
}
#define HANDS(side, ...) hands_of(job, side, __VA_ARGS__)
"""


def table_macro(prefix: str, plan: SearchPlan) -> str:
    """Return the macro that selects a lookup table; hands with repaired seeds have one table."""
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
        scene: Sources of the scene; None: no collision check.
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
        """Sources of the sides of a multi-arm robot."""
        return tuple(SideSources(plan, self.prefix, i) for i, plan in enumerate(self.plan.sides))

    @property
    def _searches(self) -> dict[str, SearchPlan]:
        """Searches that look up hand seeds, by the infix of their names."""
        searches = {f"side_{side.index}_": side.plan for side in self.sides}
        return searches or {"": self.plan}

    @cached_property
    def kernels(self) -> tuple[KernelSource, ...]:
        """Exported kernels."""
        plan, n_state = self.plan, self.plan.layouts.state.size
        # Exports do not record iterations.
        loop = define(plan.solve.constants | {"N_RECORD": 0, "ROW_BYTES": 0})
        loop += "#define store_row(record, row) ((void) (record), (void) (row))\n"
        kernels = (
            self._kernel_source("begin", "map", plan.begin),
            self._kernel_source("solve", "loop", plan.solve, loop, 2 * n_state),
            self._kernel_source("contacts", "map", plan.contacts),
            self._kernel_source("judge", "map", plan.judge),
        )
        for name, search in self._searches.items():
            kernels += self._seed_kernels(name, search)
        return kernels + self._scene_kernels()

    def _seed_kernels(self, name: str, plan: SearchPlan) -> tuple[KernelSource, ...]:
        """Return the kernels that look up hand seeds."""
        lookup = plan.seeds.table.lookup
        tables = zip(plan.seeds.tables(enforce_limits=True), plan.seeds.table_samples, strict=False)
        rows = max(samples.count for _, samples in tables) + TILE
        # Distances of all rows and of their tiles are 32 bits each.
        work_size = rows if self.single is None else rows + rows // TILE
        constants = define(lookup.constants)
        kernels = (
            self._kernel_source(f"{name}look_up", "lookup", lookup.key, constants, work_size),
        )
        return kernels + (
            (self._kernel_source(f"{name}finger_errors", "map", plan.seeds.finger_errors),)
            if plan.repairs_seeds
            else ()
        )

    def _scene_kernels(self) -> tuple[KernelSource, ...]:
        """Return the kernels of the collision check; none without a scene."""
        scene = self.scene
        if scene is None:
            return ()
        shape_poses, constants, work = scene.clearance_kernel
        clearance = self._kernel_source("near", "clearance", shape_poses, constants, work)
        link_poses = render_template("place.c", {"PREFIX": self.prefix})
        kernels = (replace(clearance, text=clearance.text + link_poses),)
        return kernels + tuple(
            self._kernel_source(name, "map", graph) for name, graph in scene.maps.items()
        )

    def _kernel_source(
        self,
        name: str,
        driver: str,
        kernel: FunctionKernel | LoopKernel | FunctionGraph,
        constants: str = "",
        extra: int = 0,
    ) -> KernelSource:
        """Return the C file of a graph and of the loop that calls it.

        Args:
            name: Name of the kernel.
            driver: Name of the C file with the loop.
            kernel: The graph, or a kernel with a graph.
            constants: C definitions that the loop needs.
            extra: Numbers of work memory beyond those of the graph.
        """
        is_graph = isinstance(kernel, FunctionGraph)
        function: Any = row_major(kernel.function) if is_graph else kernel.function
        if driver in ("map", "lookup"):
            constants += define({"N_IN": function.n_in(), "N_OUT": function.n_out()})
        if driver == "lookup":
            extra += function.numel_out(0)
        body = "".join(
            (
                f'#include "{self.prefix}_parts.h"\n\n',
                standalone_source(function, self.code_options),
                f"#define NAMED {self.prefix}_{name}_kernel\n",
                f"#define MEMORY {self.prefix}_memory\n",
                driver_text("freestanding"),
                constants,
                driver_text(driver),
            )
        )
        return KernelSource(name, f"{driver}_job", body, extra)

    @property
    def code_options(self) -> CodeOptions:
        """Options of the code of graphs."""
        if self.single is None:
            return CodeOptions()
        return CodeOptions(single=True, replaced=REPLACED_THRESHOLDS)

    @property
    def substitutes(self) -> dict[str, str]:
        """Substitutes of the template marks."""
        robot, sizes = self.robot, self.plan.sizes
        jobs = driver_text("jobs")
        jobs += self.scene.jobs() if self.scene else ""
        declarations = "".join(
            f"int {self.prefix}_{p.name}_kernel({p.job} *job, {self.prefix}_memory *memory);\n"
            for p in self.kernels
        ) + "".join(side.declaration for side in self.sides)
        calls = "".join(
            f"#define {p.name.upper()}(work) {self.prefix}_{p.name}_kernel(work, &job->memory)\n"
            for p in self.kernels
        )
        substitutes = dict(WITHOUT_SCENE) if self.scene is None else self.scene.substitutes()
        substitutes |= (
            DOUBLE_PRECISION if self.single is None else single_precision_substitutes(self.single)
        )
        substitutes |= palm_substitutes(robot, self.prefix)
        lower, upper = self._bounds
        single = self.single
        single_constants = (None, None) if single is None else (single.reals, single.arrays)
        return substitutes | {
            "PREFIX": self.prefix,
            "GUARD": self.prefix.upper(),
            "ROBOT": sanitized_name(robot.name),
            "FINGERS": str(len(robot.fingers)),
            "MOTORS": str(len(robot.actuators)),
            "FINGER_LIST": ", ".join(map(sanitized_name, robot.fingers)),
            "MOTOR_LIST": ", ".join(map(sanitized_name, robot.actuators)),
            "FINGER_NAMES": _strings(robot.fingers),
            "MOTOR_NAMES": _strings(robot.actuators),
            "W": str(max(1, *(kernel.work for kernel in self.kernels))),
            "STRUCT": (self.plan.members() + "".join(side.member for side in self.sides)).rstrip(),
            "SEEDS": self._seeds(),
            "TABLES": "".join(
                f"extern const int16_t {name}[];\n" for name in self._tables
            ).rstrip(),
            "JOBS": jobs,
            "PARTS": declarations,
            "CALLS": calls,
            "SIZES": define(sizes),
            "CONSTANTS": self.plan.constants(
                self.plan.source + "".join(substitutes.values()), *single_constants
            ),
            "SEARCH": self.plan.source,
            "SETTINGS": define_arrays({"SETTINGS": self._settings(), "HOME": robot.home}),
            "LIMITS": define_arrays(
                {f"{self.prefix}_lower": lower, f"{self.prefix}_upper": upper}, "const"
            ),
            "POSITION_TOLERANCE": repr(self.tolerance.position),
            "ANGLE_TOLERANCE": repr(self.tolerance.angle),
        }

    def _seeds(self) -> str:
        """Return the macros through which the search obtains seeds."""
        if not self.sides:
            return table_macro(self.prefix, self.plan)
        return HANDS_DISPATCH.replace("@CASES@", "".join(side.switch_case for side in self.sides))

    @property
    def side_files(self) -> dict[str, str]:
        """Files of the sides by path."""
        return {f"src/{side.prefix}.c": side.source(side.plan.seed_kernels) for side in self.sides}

    @cached_property
    def _tables(self) -> dict[str, NDArray[np.int16]]:
        """Keys of the lookup tables by name of their C arrays."""
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

    def _settings(self) -> Array:
        """Return the settings of the method, with tolerances and limits of the precision."""
        f = len(self.robot.fingers)
        no_contacts, tolerance = np.zeros((1, f, 3)), self.tolerance
        layout = settings_layout(self.robot.description)
        if self.single is not None:
            reduction = self.single.tolerance
            tolerance = Tolerance(
                tolerance.position - reduction.position, tolerance.angle - reduction.angle
            )
        settings = self.method.settings(
            TargetBatch(no_contacts, no_contacts, tolerance, True)
        ).copy()
        settings[layout.slice("lower")], settings[layout.slice("upper")] = self._bounds
        return settings

    def judge(self) -> dict[str, str]:
        """Return the files of double-precision kinematics that verify solutions."""
        marks = {
            "KINEMATICS": standalone_source(self.plan.judge.function, CodeOptions()),
            "POSITION_TOLERANCE": repr(self.tolerance.position),
            "ANGLE_TOLERANCE": repr(self.tolerance.angle),
            "LIMIT_SLACK": repr(LIMIT_SLACK),
        }
        return {f"test/{name}": render_template(name, marks) for name in ("judge.c", "judge.h")}

    def in_precision(self, files: dict[str, str]) -> dict[str, str]:
        """Return C files in the precision of the export."""
        if self.single is None:
            return files
        return {path: in_single_precision(text) for path, text in files.items()}


def prepared_method(robot: ArmHand) -> HandFirstMethod:
    """Return the method hand-first of a robot with compiled kernels."""
    method = HandFirstMethod(robot.description, HandFirstParameters())
    method.prepare()
    return method


def sanitized_name(name: str) -> str:
    """Return a name without characters that could end a comment, because files are untrusted."""
    return re.sub(r"[^\w .+-]", "_", name)


def _strings(names: tuple[str, ...]) -> str:
    """Return a list of string literals of C and JavaScript."""
    return ", ".join(json.dumps(name, ensure_ascii=False) for name in names)
