"""The part of an exported solver that knows what stands about the robot, and the robot itself."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from casadi_ik.collision.clearance import ROUNDING, SceneCheck
from casadi_ik.collision.model import CollisionModel, own_solids
from casadi_ik.collision.scene import Scene
from casadi_ik.collision.solids import C_NAMES, EXPORTED_KINDS
from casadi_ik.compile.codegen import define, define_arrays, driver_text, number
from casadi_ik.compile.function_kernel import FunctionKernel
from casadi_ik.compile.graphs import FunctionGraph
from casadi_ik.errors import UnsupportedError
from casadi_ik.export.single import ARM_ROUNDING, SinglePrecision, filled
from casadi_ik.files.arrays import Array, spread_steps
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.arms.family import ArmFamily
from casadi_ik.kinematics.arms.search import ARM_SEARCH, arms_graph
from casadi_ik.kinematics.robot_kernels import RobotKernels
from casadi_ik.solve.alternatives import side_links
from casadi_ik.solve.arm_search import RedundancySamples
from casadi_ik.solve.collision_free import COLLISION_FREE_PARAMETERS
from casadi_ik.solve.free_hands import UNCONSTRAINED_FINGER_PARAMETERS
from casadi_ik.solve.hand_first.method import HandFirstMethod
from casadi_ik.solve.hand_first.multi_arm import MultiArmStep
from casadi_ik.solve.trials import CARRY_ONLY, PALM_SCALES, TRUNK_STRETCH

MOST = 1000
"""The largest capacity: each solid costs kilobytes."""


@dataclass(frozen=True, eq=False)
class ClosedArm:
    """An arm in closed form, as C looks at it.

    Attributes:
        family: Its family.
        columns: Positions in q of its motors.
        lower: (a,) its limits.
        upper: (a,).
        samples: Values of the redundancy at which arms are computed.
    """

    family: ArmFamily
    columns: tuple[int, ...]
    lower: Array
    upper: Array
    samples: RedundancySamples

    @property
    def sizes(self) -> dict[str, int]:
        """Macros that its arrays are made of."""
        grid, between = self.samples.levels
        return {
            "N_ARM": len(self.lower),
            "N_REDUNDANCY": self.family.size,
            "N_ROWS": self.family.rows,
            "N_SAMPLES": len(grid),
            "N_MORE_SAMPLES": len(between),
            "N_SAMPLE_OFFSETS": len(self.samples.offsets),
        }

    @property
    def arrays(self) -> dict[str, Array]:
        """Its arrays; none is empty."""
        (grid, between), offsets = self.samples.levels, self.samples.offsets
        return {
            "SAMPLES": grid.ravel(),
            "MORE_SAMPLES": between.ravel(),
            "SAMPLE_OFFSETS": offsets,
            "ARM_LOW": self.lower,
            "ARM_RANGE": self.upper - self.lower,
        }


@dataclass(frozen=True, eq=False)
class SceneSources:
    """What a scene adds to the sources of a solver.

    Attributes:
        robot: With shapes.
        method: Hand-first for it.
        prefix: What every name begins with.
        capacity: How many solids may stand about.
        check: The robot's shapes with itself alone.
        single: What it allows for in single precision; None: it is in double.
    """

    robot: ArmHand
    method: HandFirstMethod
    prefix: str
    capacity: int
    check: SceneCheck
    single: SinglePrecision | None = None

    @classmethod
    def of(
        cls,
        robot: ArmHand,
        method: HandFirstMethod,
        prefix: str,
        capacity: int,
        single: SinglePrecision | None = None,
    ) -> SceneSources:
        """Find the pairs.

        Raises:
            UnsupportedError: The robot has no shapes, or that is too large a scene.
        """
        if capacity > MOST:
            raise UnsupportedError(f"--scene: found {capacity}, expected at most {MOST} solids")
        return cls(robot, method, prefix, capacity, SceneCheck(robot, Scene()), single)

    @property
    def model(self) -> CollisionModel:
        """The robot's shapes and pairs."""
        return self.check.model

    @cached_property
    def closed_arms(self) -> list[ClosedArm]:
        """The arm, or those of a body's sides; none where one has no closed form."""
        found = []
        for family, columns in self._families:
            if family is None:
                return []
            limits = self.robot.lower[list(columns)], self.robot.upper[list(columns)]
            found.append(ClosedArm(family, columns, *limits, RedundancySamples.of(family, *limits)))
        return found

    @property
    def _families(self) -> list[tuple[ArmFamily | None, tuple[int, ...]]]:
        """Of every arm its family and the positions in q of its motors."""
        return [(self.method.step.arm, self.robot.description.arm_actuators)]

    @property
    def near(self) -> tuple[FunctionKernel, str, int]:
        """The placing of shapes, its constants, and the numbers that its driver works with."""
        n, capsules, own = len(self.robot.actuators), len(self.model.capsules), self._own
        constants = define({"N_Q": n, "N_CAPSULES": capsules, "N_OWN": own, **C_NAMES})
        room = n + 6 * capsules + 12 * (own + self.capacity)
        return self.check.kernel.shape_poses, constants, room

    @property
    def maps(self) -> dict[str, FunctionKernel | FunctionGraph]:
        """What is asked of arms in closed form, by name: where the palm is, and its arms."""
        if not self.closed_arms:
            return {}
        palm, (arm,) = RobotKernels(self.robot.description).palm, self.closed_arms
        return {"palm": palm, "arms": arms_graph(arm.family, "all_arms", "")}

    @property
    def _own(self) -> int:
        return len(self.robot.description.shapes.solids)

    @property
    def _most_pairs(self) -> int:
        return len(self.model.pairs) + self.capacity * len(self.model.capsules)

    @property
    def room(self) -> int:
        """Memory of the arm search in units of 8 bytes, see `scratch_size` of arm_search.c."""
        n, sizes = len(self.robot.actuators), [1]
        for arm in self.closed_arms:
            samples, rows, free = arm.samples, arm.family.rows, arm.family.size
            most = max(*map(len, samples.levels), len(samples.offsets)) * rows + 1
            whole = 6 * most + 2
            numbers = 2 * most * (len(arm.lower) + 2) + most * (12 + free) + (most + 1) * n + 1
            size = 8 if self.single is None else 4
            sizes.append(whole + (size * numbers + 2 * most + 7) // 8)
        return max(sizes)

    @property
    def rounding(self) -> float:
        """What an answer may be short of the distance to keep [m]."""
        return ROUNDING if self.single is None else 0.0

    @property
    def allowed(self) -> float:
        """How far within its bounds an arm has to be, [rad] negative: rounding at a limit."""
        return ARM_SEARCH.tolerance if self.single is None else -ARM_ROUNDING

    @property
    def margin(self) -> dict[str, str]:
        """What stands for the marks of the distance to keep: in single precision rounding more."""
        if self.single is None:
            return {}
        more = number(self.single.tolerance.position)
        return {
            "MORE_MARGIN": f" + {more}",
            "FIRST_MARGIN": f"  {self.prefix}_set_margin(solver, 0.0);\n",
        }

    @property
    def links(self) -> tuple[str, ...]:
        """Names of all links."""
        return tuple(self.model.bodies)

    def substitutes(self) -> dict[str, str]:
        """What stands for the marks that a scene brings."""
        candidates = self.method.options.candidates
        marks = {
            "PREFIX": self.prefix,
            "GUARD": self.prefix.upper(),
            "REAL": "double" if self.single is None else "float",
            "CAPACITY": str(self.capacity),
            "SOLIDS": str(max(self._own + self.capacity, 1)),
            "PLACED": str(6 * len(self.model.capsules) + 12 * self._own),
            "CAPSULES": str(len(self.model.capsules)),
            "OWN_SOLIDS": str(self._own),
            "LINKS": str(len(self.links)),
            "ROUNDING": number(self.rounding),
            "N_HAND_PARTS": str(self._hand_coordinates),
            "N_CANDIDATES": str(candidates),
            "TRIED": str(self._rounds * candidates),
            "N_LOOKED": str(self._rounds * candidates + 1),
            "LOOK_CONSTANTS": self.look_constants(),
            "MOST_PAIRS": str(max(self._most_pairs, 1)),
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
        marks |= self.kind
        real = marks["REAL"]
        room = "double" if self.single is None else "int64_t"
        wasm, js, types = (
            filled(name, marks) for name in ("scene_wasm.c", "scene.js", "scene.d.ts")
        )
        return {
            "SCENE_TYPES": filled("scene_types.h", marks),
            "SCENE_CALLS": filled("scene_calls.h", marks),
            "SCENE_FIELDS": (
                f"  {real} clearance; /* [m], negative: something touches */\n"
                "  int64_t nearest[2]; /* places in the list of links; -1 - number: a solid */\n"
                f"  {self.prefix}_scene scene;\n"
            ),
            "SCENE_ROOM": f"  {room} room[{self.room}];\n",
            "SCENE_LOOK": filled("scene_look.c", marks),
            "SCENE_INIT": f"  {self.prefix}_scene_init(solver);\n",
            "SCENE_BEGIN": self.begun,
            "SCENE_WASM": wasm,
            "SCENE_JS": js,
            "SCENE_DTS": types,
            "SCENE_SHAPES_JS": filled("scene_shapes.js", marks),
            "SCENE_SHAPES_DTS": filled("scene_shapes.d.ts", marks),
            "SCENE_STATUS_TYPE": " | 6",
            "SCENE_STATUS_JS": "  COLLISION: 6,\n",
            "SCENE_STATUS_DTS": (
                "  /** Contacts and limits are met, but something touches. */\n"
                "  readonly COLLISION: 6;\n"
            ),
            "SCENE_ANSWER_JS": (
                "      clearance: this._wasm.least(),\n      closest: this.closest(),\n"
            ),
            "SCENE_ANSWER_DTS": (
                "  /** Smallest distance [m] and its pair: links, or a link and `solid N`. */\n"
                "  clearance: number;\n  closest: readonly [string, string] | null;\n"
            ),
        }

    def source(self) -> str:
        """The file of the scene."""
        marks = self.margin | {
            "PREFIX": self.prefix,
            "GUARD": self.prefix.upper(),
            "SCENE_CONSTANTS": self._constants(),
            "ARM_SEARCH": driver_text("arm_search") if self.closed_arms else "",
            **self.kind,
        }
        return filled("scene.c", marks)

    def jobs(self) -> str:
        """What the parts of a solver know of distances."""
        return (
            f"#define OWN_SOLID\ntypedef {self.prefix}_solid solid;\n"
            + driver_text("clearance_job")
            + f"int {self.prefix}_place_kernel(const scalar *q, scalar *places, "
            f"{self.prefix}_memory *memory);\n"
            f"void {self.prefix}_scene_init({self.prefix}_solver *solver);\n"
            f"int {self.prefix}_hand_is_free({self.prefix}_solver *solver, const scalar *lower, "
            "const scalar *upper, scalar *q);\n" + self.own_jobs
        )

    def shapes(self) -> dict[str, Any]:
        """The robot's shapes as JSON has them."""
        shapes = self.robot.description.shapes
        return {
            "capsules": [
                {"link": one.link, "radius": one.radius, "shown": one.covers < 0}
                for one in self.model.capsules
            ],
            "solids": [
                {"link": one.link, "kind": one.kind, "size": one.size.tolist()}
                for one in shapes.solids
            ],
        }

    @property
    def _rounds(self) -> int:
        """Rounds of other hands that are looked at."""
        return min(COLLISION_FREE_PARAMETERS.restarts, self.method.options.rounds)

    begun = "  solver->scene.looking = solver->scene.again = 0;\n"
    """What happens to the scene where a target is taken up."""

    @property
    def kind(self) -> dict[str, str]:
        """What stands for the marks that say how many arms there are."""
        return {
            "ONE_ARM": "",
            "CAPSULE_PART": "(MOVING[i] ? OF_ARM : idle && idle[LINK[i]])",
            "PAIR_PART": "(PAIR_MOVING[k] ? OF_ARM : idle && (idle[first] || idle[other]))",
        }

    @property
    def own_jobs(self) -> str:
        """What finds arms that are free."""
        return (
            f"int {self.prefix}_arm_is_free({self.prefix}_solver *solver, const scalar *lower, "
            "const scalar *upper, int near, scalar *q);\n"
        )

    def decided_by(self, *links: str) -> int:
        """Whether the arm decides where links are to each other, or one to the base."""
        return int(not self.model.moving.isdisjoint(links))

    def arm_constants(self) -> tuple[dict[str, int], str, dict[str, Array]]:
        """What is known of arms in closed form: whole numbers, text, arrays."""
        (arm,) = self.closed_arms
        columns = ", ".join(map(str, arm.columns))
        return arm.sizes, f"#define ARM_COLUMNS {{{columns}}}\n", arm.arrays

    @property
    def _hand_coordinates(self) -> int:
        """Number of values that distinguish hand poses, as `AlternativeFinder.hand_coordinates`."""
        return len(self.robot.description.hand_actuators) + 12

    def look_constants(self) -> str:
        """What the search for hands that are free knows."""
        closed = int(bool(self.closed_arms))
        ranges = np.maximum(
            self.robot.upper - self.robot.lower, COLLISION_FREE_PARAMETERS.min_range
        )
        sizes = {"LOOK_ROUNDS": self._rounds, "HAS_CLOSED_ARM": closed}
        sizes |= {"N_HAND_PARTS": self._hand_coordinates}
        sizes |= {"STATE_PALM_NUMBER": self.method.step.layouts.state.slice("palm_number").start}
        reals = {
            "LOOK_ALIKE": COLLISION_FREE_PARAMETERS.min_hand_difference,
            "PALM_TURN": PALM_SCALES[0],
            "PALM_SHIFT": PALM_SCALES[3],
        }
        return (
            define(sizes)
            + "".join(f"#define {name} {number(float(value))}\n" for name, value in reals.items())
            + define_arrays({"LOOK_RANGES": ranges})
        )

    def _idle_constants(self) -> str:
        """What is known of fingers that touch nothing."""
        robot, about = self.robot, self.robot.description
        hand = list(about.hand_actuators)
        fingers = [about.finger_actuators(name) for name in robot.fingers]
        moved = [about.links_moved([motor]) for motor in hand]
        whole = {
            "N_HAND": len(hand),
            "N_IDLE_RADII": len(UNCONSTRAINED_FINGER_PARAMETERS.local_radii),
        }
        whole |= {
            "N_IDLE": UNCONSTRAINED_FINGER_PARAMETERS.postures,
            "N_IDLE_LOCAL": UNCONSTRAINED_FINGER_PARAMETERS.local_postures,
        }
        return (
            define(whole)
            + f"#define IDLE_MAX_GAIN {number(UNCONSTRAINED_FINGER_PARAMETERS.max_gain)}\n"
            + define_arrays(
                {
                    "HAND": np.array(hand, dtype=int),
                    "HAND_LOWER": robot.lower[hand],
                    "HAND_RANGE": (robot.upper - robot.lower)[hand],
                    "HAND_SPREAD": spread_steps(len(robot.lower))[hand],
                    "IDLE_RADII": np.array(UNCONSTRAINED_FINGER_PARAMETERS.local_radii),
                    "FINGER_MOVED": np.array(
                        [[m in some for m in hand] for some in fingers], dtype=int
                    ),
                    "LINK_MOVED": np.array(
                        [[link in some for some in moved] for link in self.links], dtype=int
                    ),
                }
            )
        )

    def _constants(self) -> str:
        model, robot = self.model, self.robot
        links = {name: i for i, name in enumerate(self.links)}
        own, shapes = own_solids(robot.description), robot.description.shapes.solids
        touching = self.check.finger_bodies
        pairs, capsules = model.pairs, model.capsules
        crossing = [self.decided_by(*model.names(i, j)) for i, j in pairs.tolist()]
        arrays: dict[str, np.ndarray] = {
            "RADII": model.radii,
            "HALVES": model.halves,
            "LINK": np.array([links[one.link] for one in capsules]),
            "FIXED": np.array([int(model.is_fixed(one.link)) for one in capsules]),
            "MOVING": np.array([self.decided_by(one.link) for one in capsules]),
            "TOUCHES": np.array(
                [[int(one.link in touching[f]) for one in capsules] for f in robot.fingers]
            ),
            "PAIRS": pairs,
            "PAIR_MOVING": np.array(crossing, dtype=int),
            "OFFSETS": model.offsets,
            "SIZE_FACTORS": np.array([row.factors for row in EXPORTED_KINDS.values()]),
            "OWN_KIND": np.array([int(one.kind) for one in own], dtype=int),
            "OWN_SIZE": np.array([one.size for one in own]).reshape(-1, 3),
            "OWN_REACH": np.array([one.reach for one in own]),
            "OWN_LINK": np.array([links[one.link] for one in shapes], dtype=int),
        }
        whole = {
            "N_CAPSULES": len(capsules),
            "N_OWN": len(own),
            "N_KINDS": len(EXPORTED_KINDS),
            "N_PAIRS": len(pairs),
            "HAS_CLOSED_ARM": int(bool(self.closed_arms)),
        }
        text = f"#define ROUNDING {number(self.rounding)}\n"
        if self.closed_arms:
            text += f"#define MIN_LIMIT_MARGIN {number(self.allowed)}\n"
            sizes, columns, tables = self.arm_constants()
            whole, text, arrays = whole | sizes, text + columns, arrays | tables
        return define(whole) + text + define_arrays(arrays) + self._idle_constants()


WITHOUT_SCENE = {"SCENE_LOOK": "#define run_on(solver, most) search_run(solver, most, 1)\n"}
"""What stands for the marks where an export knows no scene."""


@dataclass(frozen=True, eq=False)
class BodySceneSources(SceneSources):
    """What a scene adds to the sources of a body's solver: several arms, or arms on a trunk.

    Pairs of shapes stand in the order of what decides how far they are apart: a hand alone, side
    after side; the same with idle fingers; the trunk, or several palms; an arm, with those before.
    """

    @cached_property
    def step(self) -> MultiArmStep:
        """The step of its method."""
        assert isinstance(self.method.step, MultiArmStep)
        return self.method.step

    @property
    def _families(self) -> list[tuple[ArmFamily | None, tuple[int, ...]]]:
        return [(side.family, side.arm) for side in self.step.sides]

    @property
    def maps(self) -> dict[str, FunctionKernel | FunctionGraph]:
        """Where the palms are, and the arms in closed form of each side."""
        arms = {
            f"arms_{i}": arms_graph(arm.family, "all_arms", "")
            for i, arm in enumerate(self.closed_arms)
        }
        return {"palm": self.step.palms(), **arms}

    @property
    def kind(self) -> dict[str, str]:
        """What stands for the marks that say how many arms there are."""
        count = len(self.step.sides)
        return {
            "BODY": "",
            "CAPSULE_PART": "part_of(MOVING[i], idle && idle[LINK[i]])",
            "PAIR_PART": "part_of(PAIR_MOVING[k], idle && (idle[first] || idle[other]))",
            "ARMS_OF_SIDES": self._arms_of_sides(),
            "SIDES": str(count),
            "PARTS_OF_PAIRS": str(3 * count + 1),
            "MOST_TRUNKS": str(sum(trunks for trunks, _ in COLLISION_FREE_PARAMETERS.trunk_stages)),
        }

    @property
    def begun(self) -> str:
        """What happens to the scene where a target is taken up."""
        return f"{super().begun}  solver->scene.listed = 0;\n"

    @property
    def own_jobs(self) -> str:
        """What finds hands and arms that are free."""
        solver, bounds = f"{self.prefix}_solver *solver", "const scalar *lower, const scalar *upper"
        return (
            f"void {self.prefix}_list_pairs({solver}, {bounds});\n"
            f"int {self.prefix}_side_is_free({solver}, int side, const scalar *q);\n"
            f"int {self.prefix}_arms_are_free({solver}, {bounds}, int near, const scalar *palms, "
            "scalar *q);\n"
        )

    def decided_by(self, *links: str) -> int:
        """The part of the list of pairs in which one of these links is, idle fingers aside."""
        count, sides = len(self.step.sides), side_links(self.robot.description)
        arms = [i for i, (arm, _) in enumerate(sides) if not arm.isdisjoint(links)]
        if arms:
            return 2 * count + 1 + arms[-1]
        moved = {link for link in links if not self.model.is_fixed(link)}
        own = [i for i, (_, hand) in enumerate(sides) if moved <= hand]
        return own[0] if own else 2 * count

    def arm_constants(self) -> tuple[dict[str, int], str, dict[str, Array]]:
        """How many there are: what is known of each stands in a table of its own."""
        return {}, "", {}

    def look_constants(self) -> str:
        """What the search for free hands, trunks and arms knows."""
        state = self.step.layouts.state
        motors = [*self.robot.description.trunk_actuators, *self.step.layouts.arm]
        carry: dict[int, float] = {}
        for name, value in (CARRY_ONLY | {"side": float(len(self.step.sides))}).items():
            place = state.slice(name)
            carry |= dict.fromkeys(range(place.start, place.stop), value)
        places = {
            "STATE_FIRST_CANDIDATE": state.slice("first_candidate").start,
            "STATE_PALMS": state.slice("palm_rotation_0").start,
            "N_CARRY": len(carry),
            "N_CARRYING": len(motors),
            "N_LOTS": len(COLLISION_FREE_PARAMETERS.trunk_stages),
        }
        arrays = {
            "LOTS": np.array(COLLISION_FREE_PARAMETERS.trunk_stages),
            "CARRY_PLACES": np.array(list(carry)),
            "CARRY_VALUES": np.array(list(carry.values())),
            "CARRYING": np.array(motors),
            "CARRYING_STEPS": spread_steps(len(motors)),
        }
        return (
            super().look_constants()
            + define(places)
            + f"#define TRUNK_AT_ENDS {number(TRUNK_STRETCH)}\n"
            + define_arrays(arrays)
        )

    def _arms_of_sides(self) -> str:
        """A table of the arms."""
        text = rows = ""
        for i, arm in enumerate(self.closed_arms):
            n = arm.sizes
            arrays = {f"{k}_{i}": array for k, array in arm.arrays.items() if k != "SAMPLE_OFFSETS"}
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
        most = {
            f"MOST_{name}": max(arm.sizes[f"N_{name}"] for arm in self.closed_arms)
            for name in ("ARM", "ROWS")
        }
        return define(most) + text + f"static const arm_of_side ARMS[] = {{\n{rows}}};\n"
