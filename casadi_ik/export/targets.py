"""Test targets with the solutions of this package, and the example of an exported solver."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from casadi_ik.api import Solver
from casadi_ik.collision.clearance import SceneCheck
from casadi_ik.collision.scene import Scene
from casadi_ik.collision.solids import solid_to_dict
from casadi_ik.compile.codegen import digits, numbers
from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.load_grasp import load_grasp, shipped_grasps
from casadi_ik.solve.collision_free import resolve_single
from casadi_ik.solve.engine import Engine
from casadi_ik.solve.hand_first.method import HandFirstMethod
from casadi_ik.solve.hand_first.parameters import HandFirstParameters
from casadi_ik.solve.registry import build_method
from casadi_ik.solve.status import Status
from casadi_ik.solve.target_builder import TargetBuilder

TARGET_COUNT = 1000
"""Number of targets that the test of an export solves."""

UNREACHABLE_PERIOD = 100
"""Period of the targets that are moved out of reach, so that all restarts are tested."""

TARGET_SEED = 17
"""Seed of the random targets."""

INTEGER_RESULTS = ("status", "iterations", "restarts")
"""Names of the integer results of a solve."""


@dataclass(frozen=True, eq=False)
class ExampleTarget:
    """Target of the example program.

    Attributes:
        description: Description in one sentence.
        points: (f, 3) [m].
        normals: (f, 3), NaN where free.
    """

    description: str
    points: Array
    normals: Array


def example_target(robot: ArmHand) -> ExampleTarget:
    """Return the first shipped grasp of the robot, or its contacts at home."""
    names = shipped_grasps(robot.name)
    if names:
        grasp = load_grasp(names[0])
        points, normals = grasp.arrays(robot.fingers)
        if not np.isnan(points).any() and not grasp.extra_vectors(robot.fingers):
            return ExampleTarget(f"Solves the shipped grasp {names[0]}.", points, normals)
    return ExampleTarget(
        "Solves the contacts of the home configuration.", *robot.contacts(robot.home)
    )


def stored_targets(
    solver: Solver, scene: SceneTargets | None = None, count: int = TARGET_COUNT
) -> list[dict[str, Any]]:
    """Return random targets with the solutions of the Python package.

    Args:
        solver: Solver of the robot, without a scene.
        scene: Scene in which the targets are solved; None: no collision check.
        count: Number of targets.

    Returns:
        Records with the keys q0 (None: start at home and prefer solutions far from limits),
        points, normals, q, status, iterations, restarts; with a scene also clearance.
    """
    robot = solver.robot
    rng = np.random.default_rng(TARGET_SEED)
    q = robot.random(rng, count)
    nearest_limits = np.where(rng.random(q.shape) < 0.5, robot.lower, robot.upper)
    points, normals = robot.contacts(np.where(rng.random(q.shape) < 0.2, nearest_limits, q))
    n_unreachable = -(-count // UNREACHABLE_PERIOD)
    points[:n_unreachable] += rng.normal(0, 0.1, points[:n_unreachable].shape)
    prefers_q0 = np.arange(count) % 4 == 1
    q0 = np.clip(q + 0.1, robot.lower, robot.upper)
    targets: list[dict[str, Any]] = [{} for _ in range(count)]
    for rows, starts in ((~prefers_q0, None), (prefers_q0, q0[prefers_q0])):
        answers = _answers(solver, points[rows], normals[rows], starts)
        for i, row in enumerate(np.flatnonzero(rows).tolist()):
            q, *numbers = next(answers)
            targets[row] = {
                "q0": None if starts is None else starts[i].tolist(),
                "points": points[row].ravel().tolist(),
                "normals": normals[row].ravel().tolist(),
                "q": q.tolist(),
                **dict(zip(INTEGER_RESULTS, map(int, numbers), strict=True)),
            }
    return targets if scene is None else [scene.with_scene_result(target) for target in targets]


def _answers(
    solver: Solver, points: Array, normals: Array, starts: Array | None
) -> Iterator[tuple[Array, int, int, int]]:
    """Yield q and the `INTEGER_RESULTS` of k targets.

    A batch solves the sides of a multi-arm robot without a trunk independently. An export solves
    them together, like `Solver.fast`.
    """
    robot = solver.robot.description
    if not robot.sides or robot.trunk:
        batch = solver.solve_batch(points, normals, q0=starts)
        yield from zip(batch.q, batch.status, batch.iterations, batch.restarts, strict=True)
        return
    method, builder = (
        HandFirstMethod(robot, HandFirstParameters()),
        TargetBuilder(solver.robot, solver.tolerances),
    )
    search = method.new_search(enforce_limits=True)
    assert search is not None
    for row in range(len(points)):
        q0 = None if starts is None else starts[row]
        target = builder.from_arrays(points[row : row + 1], normals[row : row + 1], q0=q0)
        search.set_target(target, 0, method.settings(target))
        answer = search.result(search(method.rounds) or 0)
        yield answer.q, answer.status, answer.iterations, answer.restarts


def targets_header(
    solver: Solver,
    scene: SceneTargets | None = None,
    single: bool = False,
    count: int = TARGET_COUNT,
) -> str:
    """Return a C header with the targets of `stored_targets` and the scene.

    Args:
        solver: Solver of the robot, without a scene.
        scene: Scene in which the targets are solved; None: no collision check.
        single: True for a solver in single precision: the header has the status of each solution
            in double precision, and no configurations.
        count: Number of targets.
    """
    f, n = len(solver.robot.fingers), len(solver.robot.actuators)
    integers, answer = (INTEGER_RESULTS[:1], "") if single else (INTEGER_RESULTS, f", q[{n}]")
    clearance = scene is not None and not single
    rows = []
    for target in stored_targets(solver, scene, count):
        q0 = target["q0"] or solver.robot.home.tolist()
        row = [str(int(target["q0"] is not None)), *(str(target[name]) for name in integers)]
        row += map(numbers, (target["points"], target["normals"], q0))
        row += [numbers(target["q"])] if answer else []
        if clearance:
            row.append("NAN" if target["clearance"] is None else digits(target["clearance"]))
        rows.append("{" + ", ".join(row) + "},\n")
    content = (
        "their status in double precision" if single else "the solutions of the Python package"
    )
    return (
        f"/* Targets, and {content}. */\n"
        f"enum {{ TARGETS = {count} }};\n\n"
        f"typedef struct {{\n  int prefers_q0, {', '.join(integers)};\n"
        f"  double points[{3 * f}], normals[{3 * f}], q0[{n}]{answer};\n"
        f"{'  double clearance;' + chr(10) if clearance else ''}}} target;\n\n"
        "static const target targets[TARGETS] = {\n" + "".join(rows) + "};\n"
    ) + ("" if scene is None else "\n" + scene.header("float" if single else "double"))


FRAMES = 120
"""Number of frames in the test of an exported follower."""

PERIOD = 0.004
"""Time between two frames [s]."""

FOLLOW_STATUS = ("HOLDING", "FOLLOWING", "LATE", "MISSED")
"""Names of the codes that the exported header defines, in their order."""


def frames_header(solver: Solver) -> str:
    """Return C definitions of frames of moving contacts, with the results of the Python follower.

    The contacts move from home towards those of a random configuration, are missing for a few
    frames, and finally move out of reach.
    """
    robot = solver.robot
    f, n = len(robot.fingers), len(robot.actuators)
    goal = robot.home + 0.2 * (robot.random(np.random.default_rng(TARGET_SEED), 1)[0] - robot.home)
    fractions = np.linspace(0, 1, FRAMES)[:, None]
    points, normals = robot.contacts(robot.home + fractions * (goal - robot.home))
    points[FRAMES // 2 : FRAMES // 2 + 5] = np.nan
    normals[FRAMES // 2 : FRAMES // 2 + 5] = np.nan
    points[-FRAMES // 6 :] += 3.0
    follower = solver.follow(q0=robot.home, period=PERIOD)
    rows = []
    for target in zip(points, normals, strict=True):
        q = follower(*target)
        vectors = [c_array(vector) for vector in (*target, q)]
        status = FOLLOW_STATUS.index(follower.state.status.name)
        rows.append("{" + ", ".join([str(status), *vectors]) + "},\n")
    return (
        f"\nenum {{ FRAMES = {FRAMES} }};\n#define PERIOD {PERIOD}\n\n"
        f"typedef struct {{\n  int status;\n  double points[{3 * f}], normals[{3 * f}], q[{n}];\n"
        "} frame;\n\nstatic const frame frames[FRAMES] = {\n" + "".join(rows) + "};\n"
    )


def c_array(array: Array) -> str:
    """Return an array initialiser of C; numbers may be NaN."""
    values = (digits(v) if np.isfinite(v) else "NAN" for v in array.ravel().tolist())
    return "{" + ", ".join(values) + "}"


PLACEMENT_SAMPLES = 64
"""Number of random configurations; solids are placed at fingertips of some of them."""

RELATIVE_SIZE = 0.15
"""Size of a solid as a fraction of the robot's reach."""

SCENE_MARGIN = 1e-3
"""Required clearance [m]."""

GRASPED_INDEX = 1
"""Index of the grasped solid."""


class SceneTargets:
    """Scene of up to four solids, and the solutions of targets in this scene.

    Attributes:
        solver: Solver without a scene.
        scene: Scene with as many solids as the capacity permits.
    """

    def __init__(self, solver: Solver, capacity: int) -> None:
        """Place as many of four solids as the capacity permits."""
        self.solver, robot = solver, solver.robot
        q = robot.random(np.random.default_rng(5), PLACEMENT_SAMPLES)
        tips = robot.contacts(q)[0][:, 0]
        distances = np.linalg.norm(tips, axis=1)
        positions = tips[np.argsort(-distances)][[0, 12, 24]]
        size = RELATIVE_SIZE * float(distances.max())
        wall = [0.9 * float(tips[:, 0].max()), 0.0, 0.0]
        shapes: list[dict[str, Any]] = [
            {"kind": "box", "size": [size, 0.7 * size, 0.5 * size], "rpy": [0.3, 0.2, 0.1]},
            {"kind": "capsule", "radius": 0.4 * size, "length": 0.5 * size, "rpy": [1.0, 0.0, 0.5]},
            {"kind": "cylinder", "radius": 0.4 * size, "length": size, "rpy": [0.0, 0.5, 0.0]},
            {"kind": "half-space", "rpy": [0.0, -np.pi / 2, 0.0], "xyz": wall},
        ]
        solids: dict[str, dict[str, Any]] = {}
        self._check = SceneCheck(robot, Scene({}, SCENE_MARGIN))
        for shape, position in zip(shapes, positions.tolist(), strict=False):
            shape["xyz"] = position
        self.scene = Scene({}, SCENE_MARGIN)
        for shape in shapes[:capacity]:
            solids = solids | {f"solid {len(solids)}": shape}
            grasped = f"solid {GRASPED_INDEX}" if GRASPED_INDEX in range(len(solids)) else None
            scene = Scene(solids, SCENE_MARGIN, grasped)
            try:
                self._check = SceneCheck(robot, scene)
            except DescriptionError:
                # Omit a solid that penetrates the base of a hand without an arm.
                solids.popitem()
            else:
                self.scene = scene

    @cached_property
    def _engine(self) -> Engine:
        robot = self.solver.robot
        method = build_method("hand-first", robot.description, {})
        return Engine(robot, method, check=self._check)

    def with_scene_result(self, target: dict[str, Any]) -> dict[str, Any]:
        """Return a stored target with its solution in the scene, searched as in an export."""
        if target["status"] != Status.SOLVED:
            return target | {"clearance": None}
        if self.solver.robot.description.sides:
            return target | self._collision_result(target)
        points, normals = (np.reshape(target[key], (1, -1, 3)) for key in ("points", "normals"))
        result = self._collision_free(points, normals, np.array(target["q"]), target["q0"])
        if result is None and target["q0"] is not None:
            without_preference = self.solver.solve_batch(points, normals)
            result = (
                self._collision_free(points, normals, without_preference.q[0], None)
                if without_preference.success[0]
                else None
            )
        if result is None:
            return target | {"status": int(Status.COLLISION), "clearance": None}
        return target | {"q": result[0].tolist(), "clearance": result[1]}

    def _collision_result(self, target: dict[str, Any]) -> dict[str, Any]:
        """Return status and clearance of the solution of a multi-arm robot, without a search."""
        points, normals = (np.reshape(target[key], (1, -1, 3)) for key in ("points", "normals"))
        builder = TargetBuilder(self.solver.robot, self.solver.tolerances)
        query = self._check.collision_query(builder.from_arrays(points, normals))
        clear = query.check(np.array(target["q"])[None])
        if not clear.free[0]:
            return {"status": int(Status.COLLISION), "clearance": None}
        return {"clearance": float(clear.distance[0])}

    def _collision_free(
        self, points: Array, normals: Array, q: Array, q0: list[float] | None
    ) -> tuple[Array, float] | None:
        """Return a collision-free solution and its clearance [m]; None if the search fails."""
        engine, builder = self._engine, TargetBuilder(self.solver.robot, self.solver.tolerances)
        targets = builder.from_arrays(points, normals, q0=q0)
        query = engine.collision_query(targets)
        assert query is not None
        clear = query.check(q[None])
        if not clear.free[0]:
            resolved = resolve_single(engine.finder, targets, query, q, try_other_hands=True)
            if resolved is None:
                return None
            q, _, clear = resolved
        return q, float(clear.distance[0])

    def solids(self) -> list[dict[str, Any]]:
        """Return the solids of the scene as arguments of the exported function."""
        entries = []
        for name, item in self.scene.items.items():
            (solid, pose_in_item) = item.parts[0]
            entries.append(
                solid_to_dict(solid, item.pose @ pose_in_item)
                | {"grasped": name == self.scene.grasped}
            )
        return entries

    def header(self, real: str = "double") -> str:
        """Return the scene as C definitions with numbers of the type `real`."""
        rows = ",\n".join(
            f"{{{entry['kind']}, {int(entry['grasped'])}, {numbers(entry['size'])}, "
            f"{numbers(entry['pose'])}}}"
            for entry in self.solids()
        )
        return (
            "typedef struct {\n  int kind, grasped;\n"
            f"  {real} size[3], pose[12];\n}} standing_solid;\n\n"
            f"enum {{ N_SOLIDS = {len(self.scene.items)} }};\n"
            f"#define MARGIN ({real}) {digits(self.scene.margin)}\n"
            f"static const standing_solid scene[N_SOLIDS] = {{\n{rows}}};\n\n"
        )

    def json(self) -> str:
        """Return the scene as JSON."""
        return json.dumps({"margin": self.scene.margin, "solids": self.solids()}) + "\n"


SCENE_TEST_C = {
    "SCENE_TEST_SAME": (
        "      && (!(stored->clearance == stored->clearance)\n"
        "          || solver->clearance == stored->clearance)\n"
    ),
    # The result with a collision is not compared: it has the largest clearance found.
    "SCENE_TEST_OR": f"stored->status == {int(Status.COLLISION)} || ",
    "SCENE_TEST_SET": (
        "  @P_set_margin(&whole_solver, MARGIN);\n  @P_set_margin(&sliced_solver, MARGIN);\n"
        "  for (i = 0; i < N_SOLIDS; ++i) {\n"
        "    const standing_solid s = scene[i];\n"
        "    @P_set_solid(&whole_solver, i, s.kind, s.size, s.pose, s.grasped);\n"
        "    @P_set_solid(&sliced_solver, i, s.kind, s.size, s.pose, s.grasped);\n"
        "  }\n"
    ),
}
SCENE_TEST_SINGLE = SCENE_TEST_C | {
    "SCENE_TEST_SAME": "  is_within &= solver->clearance >= MARGIN;\n",
}
SCENE_TEST_MJS = {
    "SCENE_TEST_SAME": (
        "    (target.clearance !== null && target.clearance !== answer.clearance) ||\n"
    ),
    "SCENE_TEST_OR": "target.status !== Status.COLLISION && ",
    "SCENE_TEST_SET": (
        'const url = new URL("./scene.json", import.meta.url);\n'
        'const scene = JSON.parse(await readFile(url, "utf8"));\n'
        "for (const each of [solver, slicedSolver]) {\n"
        "  each.setMargin(scene.margin);\n"
        "  scene.solids.forEach((s, i) => each.setSolid(i, s.kind, s.size, s.pose, s.grasped));\n"
        "}\n"
    ),
}
"""Substitutes of the marks of tests in a scene."""

MULTI_ARM_TEST_C = {
    "SCENE_TEST_FREED": (
        "  if (stored->status == @G_COLLISION && solver->status == @G_SOLVED) {\n"
        "    return solver->clearance >= MARGIN - 1e-9\n"
        "        && solver->iterations == stored->iterations;\n"
        "  }\n"
    ),
}
MULTI_ARM_TEST_MJS = {
    "SCENE_TEST_FREED": (
        "  if (target.status === Status.COLLISION && answer.status === Status.SOLVED) {\n"
        "    const isTooClose = answer.clearance < scene.margin - 1e-9;\n"
        "    return isTooClose || answer.iterations !== target.iterations;\n"
        "  }\n"
    ),
}
"""Substitutes for multi-arm robots: any solution is accepted if the stored result collides."""
