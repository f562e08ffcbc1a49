"""Sources with which an exported solver of one or several arms avoids collisions."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from casadi_ik.collision.clearance import DISTANCE_ROUNDING, SceneCheck
from casadi_ik.collision.model import CollisionModel, robot_solids
from casadi_ik.collision.scene import Scene
from casadi_ik.collision.solids import C_NAMES, EXPORTED_KINDS
from casadi_ik.compile.codegen import define, define_arrays, driver_text, number
from casadi_ik.compile.function_kernel import FunctionKernel
from casadi_ik.compile.graphs import FunctionGraph
from casadi_ik.errors import UnsupportedError
from casadi_ik.export.single import ARM_ROUNDING, SinglePrecision, render_template
from casadi_ik.files.arrays import Array, spread_steps
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.arms.family import ArmFamily
from casadi_ik.kinematics.arms.search import ARM_SEARCH, arms_graph
from casadi_ik.kinematics.robot_kernels import RobotKernels
from casadi_ik.solve.alternatives import side_links
from casadi_ik.solve.arm_search import RedundancySamples
from casadi_ik.solve.collision_free_steps import COLLISION_FREE_PARAMETERS
from casadi_ik.solve.free_hands import UNCONSTRAINED_FINGER_PARAMETERS
from casadi_ik.solve.hand_first.method import HandFirstMethod
from casadi_ik.solve.hand_first.multi_arm import MultiArmStep
from casadi_ik.solve.subproblems import PALM_SCALES, TRUNK_STRETCH

MAX_SOLIDS = 1000
"""Largest capacity of a scene. Each solid takes kilobytes of memory."""


@dataclass(frozen=True, eq=False)
class ClosedArm:
    """An arm with a closed-form inverse, as data of the arm search in C.

    Attributes:
        family: Family of the arm.
        columns: Indices of its motors in q.
        lower: (a,) lower limits of its motors.
        upper: (a,) upper limits.
        samples: Values of the redundancy parameter at which arms are computed.
    """

    family: ArmFamily
    columns: tuple[int, ...]
    lower: Array
    upper: Array
    samples: RedundancySamples

    @property
    def sizes(self) -> dict[str, int]:
        """Macros for the sizes of its arrays."""
        grid, midpoints = self.samples.levels
        return {
            "N_ARM": len(self.lower),
            "N_REDUNDANCY": self.family.size,
            "N_ROWS": self.family.rows,
            "N_SAMPLES": len(grid),
            "N_MORE_SAMPLES": len(midpoints),
            "N_SAMPLE_OFFSETS": len(self.samples.offsets),
        }

    @property
    def arrays(self) -> dict[str, Array]:
        """Arrays by their names in C; no array is empty."""
        (grid, midpoints), offsets = self.samples.levels, self.samples.offsets
        return {
            "SAMPLES": grid.ravel(),
            "MORE_SAMPLES": midpoints.ravel(),
            "SAMPLE_OFFSETS": offsets,
            "ARM_LOW": self.lower,
            "ARM_RANGE": self.upper - self.lower,
        }


@dataclass(frozen=True, eq=False)
class SceneSources:
    """Additions to the sources of a solver that checks collisions; robots with one arm or none.

    Attributes:
        robot: Robot with shapes.
        method: The method hand-first for the robot.
        prefix: Prefix of every public name.
        capacity: Largest number of solids in the scene.
        check: Collision check of the robot in an empty scene.
        single: Allowances for rounding; None: double precision.
    """

    robot: ArmHand
    method: HandFirstMethod
    prefix: str
    capacity: int
    check: SceneCheck
    single: SinglePrecision | None = None

    @classmethod
    def for_robot(
        cls,
        robot: ArmHand,
        method: HandFirstMethod,
        prefix: str,
        capacity: int,
        single: SinglePrecision | None = None,
    ) -> SceneSources:
        """Build the pairs of shapes of a robot, and its sources.

        Raises:
            UnsupportedError: The robot has no shapes, or the capacity is too large.
        """
        if capacity > MAX_SOLIDS:
            raise UnsupportedError(
                f"--scene: capacity is {capacity} solids; expected at most {MAX_SOLIDS}"
            )
        return cls(robot, method, prefix, capacity, SceneCheck(robot, Scene()), single)

    @property
    def model(self) -> CollisionModel:
        """Shapes of the robot, and the pairs of them that are checked."""
        return self.check.model

    @cached_property
    def closed_arms(self) -> list[ClosedArm]:
        """The arms by side; empty if one of them has no closed-form inverse."""
        arms = []
        for family, columns in self._families:
            if family is None:
                return []
            limits = self.robot.lower[list(columns)], self.robot.upper[list(columns)]
            arms.append(
                ClosedArm(family, columns, *limits, RedundancySamples.for_family(family, *limits))
            )
        return arms

    @property
    def _families(self) -> list[tuple[ArmFamily | None, tuple[int, ...]]]:
        """Family of each arm, and the indices of its motors in q."""
        return [(self.method.step.arm, self.robot.description.arm_actuators)]

    @property
    def clearance_kernel(self) -> tuple[FunctionKernel, str, int]:
        """Graph of the poses of shapes, constants of its driver, and size of its work memory."""
        n, capsules, solids = len(self.robot.actuators), len(self.model.capsules), self._n_solids
        constants = define({"N_Q": n, "N_CAPSULES": capsules, "N_OWN": solids, **C_NAMES})
        work = n + 6 * capsules + 12 * (solids + self.capacity)
        return self.check.kernel.shape_poses, constants, work

    @property
    def maps(self) -> dict[str, FunctionKernel | FunctionGraph]:
        """Graphs of arms in closed form by name: pose of the palm, and arms at a pose."""
        if not self.closed_arms:
            return {}
        palm, (arm,) = RobotKernels(self.robot.description).palm, self.closed_arms
        return {"palm": palm, "arms": arms_graph(arm.family, "all_arms", "")}

    @property
    def _n_solids(self) -> int:
        """Number of boxes and cylinders of the robot."""
        return len(self.robot.description.shapes.solids)

    @property
    def _max_pairs(self) -> int:
        """Largest number of pairs of shapes, with a full scene."""
        return len(self.model.pairs) + self.capacity * len(self.model.capsules)

    @property
    def scratch(self) -> int:
        """Memory of the arm search in units of 8 bytes; see `scratch_size` in arm_search.c."""
        n, sizes = len(self.robot.actuators), [1]
        for arm in self.closed_arms:
            samples, rows, n_redundancy = arm.samples, arm.family.rows, arm.family.size
            max_arms = max(*map(len, samples.levels), len(samples.offsets)) * rows + 1
            integers = 6 * max_arms + 2
            numbers = 2 * max_arms * (len(arm.lower) + 2) + max_arms * (12 + n_redundancy)
            numbers += (max_arms + 1) * n + 1
            size = 8 if self.single is None else 4
            sizes.append(integers + (size * numbers + 2 * max_arms + 7) // 8)
        return max(sizes)

    @property
    def rounding(self) -> float:
        """Rounding error by which the clearance of an answer may fall below the margin [m]."""
        return DISTANCE_ROUNDING if self.single is None else 0.0

    @property
    def min_limit_margin(self) -> float:
        """Smallest margin of an arm to its limits [rad]; negative: rounding error at a limit."""
        return ARM_SEARCH.tolerance if self.single is None else -ARM_ROUNDING

    @property
    def margin_marks(self) -> dict[str, str]:
        """Substitutes that add the rounding error to margins in single precision."""
        if self.single is None:
            return {}
        rounding = number(self.single.tolerance.position)
        return {
            "MORE_MARGIN": f" + {rounding}",
            "FIRST_MARGIN": f"  {self.prefix}_set_margin(solver, 0.0);\n",
        }

    @property
    def links(self) -> tuple[str, ...]:
        """Names of all links."""
        return tuple(self.model.bodies)

    def substitutes(self) -> dict[str, str]:
        """Return the substitutes of the template marks for a solver with a scene."""
        candidates = self.method.options.candidates
        marks = {
            "PREFIX": self.prefix,
            "GUARD": self.prefix.upper(),
            "REAL": "double" if self.single is None else "float",
            "CAPACITY": str(self.capacity),
            "SOLIDS": str(max(self._n_solids + self.capacity, 1)),
            "SHAPE_POSES": str(6 * len(self.model.capsules) + 12 * self._n_solids),
            "CAPSULES": str(len(self.model.capsules)),
            "OWN_SOLIDS": str(self._n_solids),
            "LINKS": str(len(self.links)),
            "ROUNDING": number(self.rounding),
            "N_HAND_COORDINATES": str(self._hand_coordinates),
            "N_CANDIDATES": str(candidates),
            "MAX_HAND_FITS": str(self._restarts * candidates),
            "MAX_HANDS": str(self._restarts * candidates + 1),
            "SCENE_SEARCH_CONSTANTS": self.search_constants(),
            "MAX_PAIRS": str(max(self._max_pairs, 1)),
            "KINDS_C": "\n".join(
                f"  {self.prefix.upper()}_{kind.name} = {int(kind)}, /* {row.size} */"
                for kind, row in EXPORTED_KINDS.items()
            ),
            "KINDS_JS": ", ".join(f"{kind.name}: {int(kind)}" for kind in EXPORTED_KINDS),
            "KINDS_DTS": "\n".join(
                f"  /** {row.size} */\n  readonly {kind.name}: {int(kind)};"
                for kind, row in EXPORTED_KINDS.items()
            ),
            "LINK_NAMES": ", ".join(json.dumps(link, ensure_ascii=False) for link in self.links),
            "SHAPES_JSON": json.dumps(self.shapes()),
        }
        marks |= self.arm_marks
        real = marks["REAL"]
        scratch_type = "double" if self.single is None else "int64_t"
        return marks | {
            "SCENE": "",
            "SCENE_FIELDS": (
                f"  {real} clearance; /* [m], negative in collision */\n"
                "  int64_t nearest[2]; /* indices of links, or -1 - number of a solid */\n"
                f"  {self.prefix}_scene scene;\n"
            ),
            "SCENE_SCRATCH": f"  {scratch_type} scratch[{self.scratch}];\n",
            "SCENE_SEARCH": render_template("scene_search.c", marks),
            "SCENE_INIT": f"  {self.prefix}_scene_init(solver);\n",
            "SCENE_BEGIN": self.begin,
            "SCENE_STATUS_TYPE": " | 6",
            "SCENE_STATUS_JS": "  COLLISION: 6,\n",
            "SCENE_STATUS_DTS": (
                "  /** Contacts and limits are met, but the robot is in collision. */\n"
                "  readonly COLLISION: 6;\n"
            ),
            "SCENE_ANSWER_JS": (
                "      clearance: this._wasm.last_clearance(),\n      closest: this.closest(),\n"
            ),
            "SCENE_ANSWER_DTS": (
                "  /** Clearance [m] and the nearest pair: links, or a link and `solid N`. */\n"
                "  clearance: number;\n  closest: readonly [string, string] | null;\n"
            ),
        }

    def source(self) -> str:
        """Return the text of the scene's C file."""
        marks = self.margin_marks | {
            "PREFIX": self.prefix,
            "GUARD": self.prefix.upper(),
            "SCENE_CONSTANTS": self._constants(),
            "ARM_SEARCH": driver_text("arm_search") if self.closed_arms else "",
            **self.arm_marks,
        }
        return render_template("scene.c", marks)

    def jobs(self) -> str:
        """Return the declarations of collision checks, for all files of the solver."""
        return (
            f"#define OWN_SOLID\ntypedef {self.prefix}_solid solid;\n"
            + driver_text("clearance_job")
            + f"int {self.prefix}_place_kernel(const scalar *q, scalar *poses, "
            f"{self.prefix}_memory *memory);\n"
            f"void {self.prefix}_scene_init({self.prefix}_solver *solver);\n"
            f"int {self.prefix}_hand_is_free({self.prefix}_solver *solver, const scalar *lower, "
            "const scalar *upper, scalar *q);\n" + self.arm_jobs
        )

    def shapes(self) -> dict[str, Any]:
        """Return the robot's shapes as JSON data."""
        shapes = self.robot.description.shapes
        return {
            "capsules": [
                {"link": capsule.link, "radius": capsule.radius, "shown": capsule.covers < 0}
                for capsule in self.model.capsules
            ],
            "solids": [
                {"link": solid.link, "kind": solid.kind, "size": solid.size.tolist()}
                for solid in shapes.solids
            ],
        }

    @property
    def _restarts(self) -> int:
        """Number of restarts that search for collision-free hands."""
        return min(COLLISION_FREE_PARAMETERS.restarts, self.method.options.rounds)

    begin = "  solver->scene.is_searching = solver->scene.preference_dropped = 0;\n"
    """Statements that reset the search of the scene for a new target."""

    @property
    def arm_marks(self) -> dict[str, str]:
        """Substitutes that depend on the number of arms."""
        return {
            "ONE_ARM": "",
            "CAPSULE_GROUP": "(MOVING[i] ? ARM_PAIRS : is_idle && is_idle[LINK[i]])",
            "PAIR_GROUP": (
                "(PAIR_MOVING[k] ? ARM_PAIRS : is_idle && (is_idle[first_link]\n"
                "        || is_idle[second_link]))"
            ),
        }

    @property
    def arm_jobs(self) -> str:
        """Declaration of the function that chooses a collision-free arm."""
        return (
            f"int {self.prefix}_arm_is_free({self.prefix}_solver *solver, const scalar *lower, "
            "const scalar *upper, int prefer_q0, scalar *q);\n"
        )

    def pair_group(self, *links: str) -> int:
        """Return 1 if the arm changes the distance of two links, or of a link from the base."""
        return int(not self.model.moving.isdisjoint(links))

    def arm_constants(self) -> tuple[dict[str, int], str, dict[str, Array]]:
        """Return integers, text and arrays that describe the arms in closed form."""
        (arm,) = self.closed_arms
        columns = ", ".join(map(str, arm.columns))
        return arm.sizes, f"#define ARM_COLUMNS {{{columns}}}\n", arm.arrays

    @property
    def _hand_coordinates(self) -> int:
        """Number of coordinates of a hand pose; see `AlternativeFinder.hand_coordinates`."""
        return len(self.robot.description.hand_actuators) + 12

    def search_constants(self) -> str:
        """Return the constants of the search for collision-free hands."""
        closed = int(bool(self.closed_arms))
        ranges = np.maximum(
            self.robot.upper - self.robot.lower, COLLISION_FREE_PARAMETERS.min_range
        )
        sizes = {"SCENE_RESTARTS": self._restarts, "HAS_CLOSED_ARM": closed}
        sizes |= {"N_HAND_COORDINATES": self._hand_coordinates}
        sizes |= {"STATE_PALM_NUMBER": self.method.step.layouts.state.slice("palm_number").start}
        reals = {
            "MIN_HAND_DIFFERENCE": COLLISION_FREE_PARAMETERS.min_hand_difference,
            "PALM_ROTATION_SCALE": PALM_SCALES[0],
            "PALM_TRANSLATION_SCALE": PALM_SCALES[3],
        }
        return (
            define(sizes)
            + "".join(f"#define {name} {number(float(value))}\n" for name, value in reals.items())
            + define_arrays({"MOTOR_RANGES": ranges})
        )

    def _idle_constants(self) -> str:
        """Return the constants of fingers without a contact."""
        robot, description = self.robot, self.robot.description
        parameters = UNCONSTRAINED_FINGER_PARAMETERS
        hand = list(description.hand_actuators)
        finger_motors = [description.finger_actuators(name) for name in robot.fingers]
        links_by_motor = [description.links_moved([motor]) for motor in hand]
        integers = {
            "N_HAND": len(hand),
            "N_IDLE_RADII": len(parameters.local_radii),
            "N_IDLE": parameters.postures,
            "N_IDLE_LOCAL": parameters.local_postures,
        }
        return (
            define(integers)
            + f"#define IDLE_MAX_GAIN {number(parameters.max_gain)}\n"
            + define_arrays(
                {
                    "HAND": np.array(hand, dtype=int),
                    "HAND_LOWER": robot.lower[hand],
                    "HAND_RANGE": (robot.upper - robot.lower)[hand],
                    "HAND_SPREAD": spread_steps(len(robot.lower))[hand],
                    "IDLE_RADII": np.array(parameters.local_radii),
                    "FINGER_MOVED": np.array(
                        [[motor in motors for motor in hand] for motors in finger_motors], dtype=int
                    ),
                    "LINK_MOVED": np.array(
                        [[link in links for links in links_by_motor] for link in self.links],
                        dtype=int,
                    ),
                }
            )
        )

    def _constants(self) -> str:
        """Return the constants of the scene's C file."""
        model, robot = self.model, self.robot
        link_index = {name: i for i, name in enumerate(self.links)}
        solids, attached = robot_solids(robot.description), robot.description.shapes.solids
        contact_links = self.check.finger_bodies
        pairs, capsules = model.pairs, model.capsules
        groups = [self.pair_group(*model.names(i, j)) for i, j in pairs.tolist()]
        arrays: dict[str, np.ndarray] = {
            "RADII": model.radii,
            "HALVES": model.half_lengths,
            "LINK": np.array([link_index[capsule.link] for capsule in capsules]),
            "FIXED": np.array([int(model.is_fixed(capsule.link)) for capsule in capsules]),
            "MOVING": np.array([self.pair_group(capsule.link) for capsule in capsules]),
            "TOUCHES": np.array(
                [
                    [int(capsule.link in contact_links[finger]) for capsule in capsules]
                    for finger in robot.fingers
                ]
            ),
            "PAIRS": pairs,
            "PAIR_MOVING": np.array(groups, dtype=int),
            "OFFSETS": model.offsets,
            "SIZE_FACTORS": np.array([row.factors for row in EXPORTED_KINDS.values()]),
            "OWN_KIND": np.array([int(solid.kind) for solid in solids], dtype=int),
            "OWN_SIZE": np.array([solid.size for solid in solids]).reshape(-1, 3),
            "OWN_REACH": np.array([solid.reach for solid in solids]),
            "OWN_LINK": np.array([link_index[solid.link] for solid in attached], dtype=int),
        }
        integers = {
            "N_CAPSULES": len(capsules),
            "N_OWN": len(solids),
            "N_KINDS": len(EXPORTED_KINDS),
            "N_PAIRS": len(pairs),
            "HAS_CLOSED_ARM": int(bool(self.closed_arms)),
        }
        text = f"#define ROUNDING {number(self.rounding)}\n"
        if self.closed_arms:
            text += f"#define MIN_LIMIT_MARGIN {number(self.min_limit_margin)}\n"
            sizes, columns, tables = self.arm_constants()
            integers, text, arrays = integers | sizes, text + columns, arrays | tables
        return define(integers) + text + define_arrays(arrays) + self._idle_constants()


WITHOUT_SCENE = {
    "SCENE_SEARCH": (
        "#define continue_search(solver, max_iterations) search_run(solver, max_iterations, 1)\n"
    )
}
"""Substitutes of the template marks for a solver without collision checks."""


@dataclass(frozen=True, eq=False)
class MultiArmSceneSources(SceneSources):
    """Additions to the sources of a solver that checks collisions of a multi-arm robot.

    Pairs of shapes are sorted into groups by the motors that determine their distance: a hand
    without its idle fingers, by side; idle fingers, by side; the trunk or several palms; an arm
    and the arms of earlier sides, by side.
    """

    @cached_property
    def step(self) -> MultiArmStep:
        """Step of the method, with the data of its sides."""
        assert isinstance(self.method.step, MultiArmStep)
        return self.method.step

    @property
    def _families(self) -> list[tuple[ArmFamily | None, tuple[int, ...]]]:
        return [(side.family, side.arm) for side in self.step.sides]

    @property
    def maps(self) -> dict[str, FunctionKernel | FunctionGraph]:
        """Graphs of the poses of palms, and of each side's arms in closed form, by name."""
        arms = {
            f"arms_{i}": arms_graph(arm.family, "all_arms", "")
            for i, arm in enumerate(self.closed_arms)
        }
        return {"palm": self.step.palms(), **arms}

    @property
    def arm_marks(self) -> dict[str, str]:
        """Substitutes that depend on the number of arms."""
        count = len(self.step.sides)
        return {
            "BODY": "",
            "CAPSULE_GROUP": "pair_group(MOVING[i], is_idle && is_idle[LINK[i]])",
            "PAIR_GROUP": (
                "pair_group(PAIR_MOVING[k],\n"
                "                   is_idle && (is_idle[first_link] || is_idle[second_link]))"
            ),
            "ARMS_OF_SIDES": self._arms_of_sides(),
            "SIDES": str(count),
            "PAIR_GROUPS": str(3 * count + 1),
            "MAX_TRUNK_TRIALS": str(
                sum(trunks for trunks, _ in COLLISION_FREE_PARAMETERS.trunk_stages)
            ),
        }

    @property
    def begin(self) -> str:
        """Statements that reset the search of the scene for a new target."""
        return f"{super().begin}  solver->scene.has_pair_list = 0;\n"

    @property
    def arm_jobs(self) -> str:
        """Declarations of the functions that check hands and choose collision-free arms."""
        solver, bounds = f"{self.prefix}_solver *solver", "const scalar *lower, const scalar *upper"
        return (
            f"void {self.prefix}_list_pairs({solver}, {bounds});\n"
            f"int {self.prefix}_side_is_free({solver}, int side, const scalar *q);\n"
            f"int {self.prefix}_arms_are_free({solver}, {bounds}, int prefer_q0,\n"
            "    const scalar *palms, scalar *q);\n"
        )

    def pair_group(self, *links: str) -> int:
        """Return the group of a link or of a pair of links, if no finger is idle."""
        count, sides = len(self.step.sides), side_links(self.robot.description)
        arm_sides = [i for i, (arm, _) in enumerate(sides) if not arm.isdisjoint(links)]
        if arm_sides:
            return 2 * count + 1 + arm_sides[-1]
        movable = {link for link in links if not self.model.is_fixed(link)}
        hand_sides = [i for i, (_, hand) in enumerate(sides) if movable <= hand]
        return hand_sides[0] if hand_sides else 2 * count

    def arm_constants(self) -> tuple[dict[str, int], str, dict[str, Array]]:
        """Return nothing: the table of `_arms_of_sides` describes the arms."""
        return {}, "", {}

    def search_constants(self) -> str:
        """Return the constants of the search for collision-free hands, trunks and arms."""
        state, parameters = self.step.layouts.state, self.step.layouts.parameters
        motors = [*self.robot.description.trunk_actuators, *self.step.layouts.arm]
        integers = {
            "STATE_FIRST_CANDIDATE": state.slice("first_candidate").start,
            "STATE_PALMS": state.slice("palm_rotation_0").start,
            "STATE_MEETS_CONTACTS": state.slice("meets_contacts").start,
            "STATE_ARM_MARGIN": state.slice("arm_margin").start,
            "PARAMETERS_PALMS_ONLY": parameters.slice("palms_only").start,
            "N_TRUNK_AND_ARMS": len(motors),
            "N_TRUNK_STAGES": len(COLLISION_FREE_PARAMETERS.trunk_stages),
        }
        arrays = {
            "TRUNK_STAGES": np.array(COLLISION_FREE_PARAMETERS.trunk_stages),
            "TRUNK_AND_ARMS": np.array(motors),
            "TRUNK_AND_ARM_STEPS": spread_steps(len(motors)),
        }
        return (
            super().search_constants()
            + define(integers)
            + f"#define TRUNK_STRETCH {number(TRUNK_STRETCH)}\n"
            + f"#define NO_MARGIN {number(ARM_SEARCH.no_margin)}\n"
            + define_arrays(arrays)
        )

    def _arms_of_sides(self) -> str:
        """Return the definition of the table of arms by side; empty without closed forms."""
        text = rows = ""
        for i, arm in enumerate(self.closed_arms):
            n = arm.sizes
            arrays = {
                f"{name}_{i}": array
                for name, array in arm.arrays.items()
                if name != "SAMPLE_OFFSETS"
            }
            columns = ", ".join(map(str, arm.columns))
            text += define_arrays(arrays) + f"static const int64_t COLUMNS_{i}[] = {{{columns}}};\n"
            rows += (
                f"  {{{self.prefix}_arms_{i}_kernel, {n['N_ARM']}, {n['N_REDUNDANCY']}, "
                f"{n['N_ROWS']}, {{{n['N_SAMPLES']}, {n['N_MORE_SAMPLES']}}},\n"
                f"   {{SAMPLES_{i}, MORE_SAMPLES_{i}}}, ARM_LOW_{i}, ARM_RANGE_{i}, "
                f"COLUMNS_{i}}},\n"
            )
        if not rows:
            return ""
        max_sizes = {
            f"MAX_{name}": max(arm.sizes[f"N_{name}"] for arm in self.closed_arms)
            for name in ("ARM", "ROWS")
        }
        return define(max_sizes) + text + f"static const side_arm ARMS[] = {{\n{rows}}};\n"
