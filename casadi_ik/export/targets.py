"""Test targets with the answers of this package, and the example of an exported solver."""

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
from casadi_ik.solve.request import Request
from casadi_ik.solve.status import Status

COUNT = 1000
"""Number of targets that the test of an export solves."""

UNREACHABLE = 100
"""One in this many targets is moved out of reach, so that its solve goes through all restarts."""

SEED = 17

WHOLE = ("status", "iterations", "restarts")


@dataclass(frozen=True, eq=False)
class Example:
    """The target of the example program.

    Attributes:
        what: Description in a sentence.
        points: (f, 3) [m].
        normals: (f, 3), NaN where free.
    """

    what: str
    points: Array
    normals: Array


def example(robot: ArmHand) -> Example:
    """Return the robot's first shipped grasp, or its contacts at home."""
    names = shipped_grasps(robot.name)
    if names:
        grasp = load_grasp(names[0])
        points, normals = grasp.arrays(robot.fingers)
        if not np.isnan(points).any() and not grasp.more(robot.fingers):
            return Example(f"Solves the shipped grasp {names[0]}.", points, normals)
    return Example("Solves the contacts of the home configuration.", *robot.contacts(robot.home))


def stored(
    solver: Solver, scene: SceneTargets | None = None, count: int = COUNT
) -> list[dict[str, Any]]:
    """Return random targets with the answers of Python.

    Args:
        solver: Solver of the robot, without a scene.
        scene: Scene in which the targets are solved; None: collisions are not checked.
        count: Number of targets.

    Returns:
        Records with the keys q0 (None: the robot is at home and prefers the middle of its limits),
        points, normals, q, status, iterations, restarts; with a scene also clearance.
    """
    robot = solver.robot
    rng = np.random.default_rng(SEED)
    q = robot.random(rng, count)
    ends = np.where(rng.random(q.shape) < 0.5, robot.lower, robot.upper)
    points, normals = robot.contacts(np.where(rng.random(q.shape) < 0.2, ends, q))
    beyond = -(-count // UNREACHABLE)
    points[:beyond] += rng.normal(0, 0.1, points[:beyond].shape)
    near = np.arange(count) % 4 == 1
    q0 = np.clip(q + 0.1, robot.lower, robot.upper)
    found: list[dict[str, Any]] = [{} for _ in range(count)]
    for rows, starts in ((~near, None), (near, q0[near])):
        answers = _answers(solver, points[rows], normals[rows], starts)
        for i, row in enumerate(np.flatnonzero(rows).tolist()):
            q, *numbers = next(answers)
            found[row] = {
                "q0": None if starts is None else starts[i].tolist(),
                "points": points[row].ravel().tolist(),
                "normals": normals[row].ravel().tolist(),
                "q": q.tolist(),
                **dict(zip(WHOLE, map(int, numbers), strict=True)),
            }
    return found if scene is None else [scene.answered(target) for target in found]


def _answers(
    solver: Solver, points: Array, normals: Array, starts: Array | None
) -> Iterator[tuple[Array, int, int, int]]:
    """Yield the answers to k targets, each with the integers that `WHOLE` names.

    A batch solves the sides of a robot with several arms and no trunk independently. An export
    solves them together, as `Solver.fast` does.
    """
    robot = solver.robot.description
    if not robot.sides or robot.trunk:
        batch = solver.solve_batch(points, normals, q0=starts)
        yield from zip(batch.q, batch.status, batch.iterations, batch.restarts, strict=True)
        return
    method, request = (
        HandFirstMethod(robot, HandFirstParameters()),
        Request(solver.robot, solver.tolerances, True),
    )
    search = method.new_search(enforce_limits=True)
    assert search is not None
    for row in range(len(points)):
        q0 = None if starts is None else starts[row]
        prefer = "limits" if q0 is None else "q0"
        target = request.of_arrays(
            points[row : row + 1], normals[row : row + 1], None, prefer=prefer
        )
        search.set_target(target, 0, request.start(q0), method.terms(target))
        answer = search.result(search(method.rounds) or 0)
        yield answer.q, answer.status, answer.iterations, answer.restarts


def targets_header(
    solver: Solver, scene: SceneTargets | None = None, single: bool = False, count: int = COUNT
) -> str:
    """Return a C header with the `stored` targets and the scene.

    Args:
        solver: Solver of the robot, without a scene.
        scene: Scene in which the targets are solved; None: collisions are not checked.
        single: Whether the header is for a solver in single precision: it then has the status of
            each answer in double precision, and no configurations.
        count: Number of targets.
    """
    f, n = len(solver.robot.fingers), len(solver.robot.actuators)
    whole, answer = (WHOLE[:1], "") if single else (WHOLE, f", q[{n}]")
    clearance = scene is not None and not single
    rows = []
    for target in stored(solver, scene, count):
        q0 = target["q0"] or solver.robot.home.tolist()
        row = [str(int(target["q0"] is not None)), *(str(target[name]) for name in whole)]
        row += map(numbers, (target["points"], target["normals"], q0))
        row += [numbers(target["q"])] if answer else []
        if clearance:
            row.append("NAN" if target["clearance"] is None else digits(target["clearance"]))
        rows.append("{" + ", ".join(row) + "},\n")
    what = "how they end in double precision" if single else "what the Python package answers"
    return (
        f"/* Targets, and {what}. */\n"
        f"enum {{ TARGETS = {count} }};\n\n"
        f"typedef struct {{\n  int near, {', '.join(whole)};\n"
        f"  double points[{3 * f}], normals[{3 * f}], q0[{n}]{answer};\n"
        f"{'  double clearance;' + chr(10) if clearance else ''}}} target;\n\n"
        "static const target targets[TARGETS] = {\n" + "".join(rows) + "};\n"
    ) + ("" if scene is None else "\n" + scene.header("float" if single else "double"))


FRAMES = 120
"""Number of frames that the test of an exported follower asks for."""

PERIOD = 0.004
"""Time between two frames [s]."""

FOLLOW_STATUS = ("HOLDING", "FOLLOWING", "LATE", "MISSED")
"""Names of the codes that `follow.h` defines, in their order."""


def frames_header(solver: Solver) -> str:
    """Return C definitions of frames of moving contacts, with the answers of Python's follower.

    The contacts move from those at home towards those of a random configuration, are missing for
    a few frames, and end out of reach.
    """
    robot = solver.robot
    f, n = len(robot.fingers), len(robot.actuators)
    goal = robot.home + 0.2 * (robot.random(np.random.default_rng(SEED), 1)[0] - robot.home)
    part = np.linspace(0, 1, FRAMES)[:, None]
    points, normals = robot.contacts(robot.home + part * (goal - robot.home))
    points[FRAMES // 2 : FRAMES // 2 + 5] = np.nan
    normals[FRAMES // 2 : FRAMES // 2 + 5] = np.nan
    points[-FRAMES // 6 :] += 3.0
    follower = solver.follow(q0=robot.home, period=PERIOD)
    rows = []
    for target in zip(points, normals, strict=True):
        q = follower(*target)
        vectors = [written(vector) for vector in (*target, q)]
        status = FOLLOW_STATUS.index(follower.state.status.name)
        rows.append("{" + ", ".join([str(status), *vectors]) + "},\n")
    return (
        f"\nenum {{ FRAMES = {FRAMES} }};\n#define PERIOD {PERIOD}\n\n"
        f"typedef struct {{\n  int status;\n  double points[{3 * f}], normals[{3 * f}], q[{n}];\n"
        "} frame;\n\nstatic const frame frames[FRAMES] = {\n" + "".join(rows) + "};\n"
    )


def written(array: Array) -> str:
    """Return an array initialiser of C; numbers may be NaN."""
    values = (digits(v) if np.isfinite(v) else "NAN" for v in array.ravel().tolist())
    return "{" + ", ".join(values) + "}"


DRAWN = 64
"""Number of random configurations, at whose fingertips solids are placed."""

SIZE = 0.15
"""Size of a solid as a fraction of the robot's reach."""

MARGIN = 1e-3
"""Required clearance [m]."""

GRASPED = 1
"""Index of the grasped solid."""


class SceneTargets:
    """A scene of up to four solids, and the answers to targets in it.

    Attributes:
        solver: Solver without a scene.
        scene: Scene with as many solids as the capacity allows.
    """

    def __init__(self, solver: Solver, capacity: int) -> None:
        self.solver, robot = solver, solver.robot
        q = robot.random(np.random.default_rng(5), DRAWN)
        tips = robot.contacts(q)[0][:, 0]
        far = np.linalg.norm(tips, axis=1)
        places = tips[np.argsort(-far)][[0, 12, 24]]
        size = SIZE * float(far.max())
        wall = [0.9 * float(tips[:, 0].max()), 0.0, 0.0]
        shapes: list[dict[str, Any]] = [
            {"kind": "box", "size": [size, 0.7 * size, 0.5 * size], "rpy": [0.3, 0.2, 0.1]},
            {"kind": "capsule", "radius": 0.4 * size, "length": 0.5 * size, "rpy": [1.0, 0.0, 0.5]},
            {"kind": "cylinder", "radius": 0.4 * size, "length": size, "rpy": [0.0, 0.5, 0.0]},
            {"kind": "half-space", "rpy": [0.0, -np.pi / 2, 0.0], "xyz": wall},
        ]
        solids: dict[str, dict[str, Any]] = {}
        self._check = SceneCheck(robot, Scene({}, MARGIN))
        for shape, place in zip(shapes, places.tolist(), strict=False):
            shape["xyz"] = place
        self.scene = Scene({}, MARGIN)
        for shape in shapes[:capacity]:
            solids = solids | {f"solid {len(solids)}": shape}
            grasped = f"solid {GRASPED}" if GRASPED in range(len(solids)) else None
            scene = Scene(solids, MARGIN, grasped)
            try:
                self._check = SceneCheck(robot, scene)
            except DescriptionError:
                # Solids that penetrate the base of a hand alone are left out.
                solids.popitem()
            else:
                self.scene = scene

    @cached_property
    def _engine(self) -> Engine:
        robot = self.solver.robot
        method = build_method("hand-first", robot.description, {})
        return Engine(robot, method, check=self._check)

    def answered(self, target: dict[str, Any]) -> dict[str, Any]:
        """Return a stored target with its answer in the scene, as an export searches it."""
        if target["status"] != Status.SOLVED:
            return target | {"clearance": None}
        if self.solver.robot.description.sides:
            return target | self._touching(target)
        points, normals = (np.reshape(target[key], (1, -1, 3)) for key in ("points", "normals"))
        found = self._free(points, normals, np.array(target["q"]), target["q0"])
        if found is None and target["q0"] is not None:
            usual = self.solver.solve_batch(points, normals)
            found = self._free(points, normals, usual.q[0], None) if usual.success[0] else None
        if found is None:
            return target | {"status": int(Status.COLLISION), "clearance": None}
        return target | {"q": found[0].tolist(), "clearance": found[1]}

    def _touching(self, target: dict[str, Any]) -> dict[str, Any]:
        """Return whether the answer of a robot with several arms collides; no other is searched."""
        points, normals = (np.reshape(target[key], (1, -1, 3)) for key in ("points", "normals"))
        request = Request(self.solver.robot, self.solver.tolerances, True)
        query = self._check.collision_query(request.of_arrays(points, normals, None))
        clear = query.check(np.array(target["q"])[None])
        if not clear.free[0]:
            return {"status": int(Status.COLLISION), "clearance": None}
        return {"clearance": float(clear.distance[0])}

    def _free(
        self, points: Array, normals: Array, q: Array, q0: list[float] | None
    ) -> tuple[Array, float] | None:
        """Return a collision-free answer and its clearance [m]; None if the search fails."""
        engine, request = self._engine, Request(self.solver.robot, self.solver.tolerances, True)
        prefer = "limits" if q0 is None else "q0"
        targets = request.of_arrays(points, normals, None, prefer=prefer)
        query = engine.collision_query(targets)
        assert query is not None
        clear = query.check(q[None])
        if not clear.free[0]:
            found = resolve_single(
                engine.finder, targets, query, q, request.start(q0), try_other_hands=True
            )
            if found is None:
                return None
            q, _, clear = found
        return q, float(clear.distance[0])

    def solids(self) -> list[dict[str, Any]]:
        """Return the solids of the scene as arguments of an export."""
        found = []
        for name, item in self.scene.items.items():
            (solid, place) = item.parts[0]
            found.append(
                solid_to_dict(solid, item.pose @ place) | {"grasped": name == self.scene.grasped}
            )
        return found

    def header(self, real: str = "double") -> str:
        """Return the scene as C definitions with numbers of the type `real`."""
        rows = ",\n".join(
            f"{{{one['kind']}, {int(one['grasped'])}, {numbers(one['size'])}, "
            f"{numbers(one['pose'])}}}"
            for one in self.solids()
        )
        return (
            "typedef struct {\n  int kind, grasped;\n"
            f"  {real} size[3], pose[12];\n}} standing;\n\n"
            f"enum {{ STANDING = {len(self.scene.items)} }};\n"
            f"#define MARGIN ({real}) {digits(self.scene.margin)}\n"
            f"static const standing scene[STANDING] = {{\n{rows}}};\n\n"
        )

    def json(self) -> str:
        """Return the scene as JSON."""
        return json.dumps({"margin": self.scene.margin, "solids": self.solids()}) + "\n"


IN_TEST_C = {
    "SCENE_TEST_SAME": (
        "      && (!(stored->clearance == stored->clearance)\n"
        "          || solver->clearance == stored->clearance)\n"
    ),
    # In a collision the answer of largest clearance is not compared.
    "SCENE_TEST_OR": f"stored->status == {int(Status.COLLISION)} || ",
    "SCENE_TEST_SET": (
        "  @P_set_margin(&one, MARGIN);\n  @P_set_margin(&other, MARGIN);\n"
        "  for (i = 0; i < STANDING; ++i) {\n"
        "    const standing *put = scene + i;\n"
        "    @P_set_solid(&one, i, put->kind, put->size, put->pose, put->grasped);\n"
        "    @P_set_solid(&other, i, put->kind, put->size, put->pose, put->grasped);\n"
        "  }\n"
    ),
}
IN_TEST_SINGLE = IN_TEST_C | {
    "SCENE_TEST_SAME": "  met &= solver->clearance >= MARGIN;\n",
}
IN_TEST_MJS = {
    "SCENE_TEST_SAME": (
        "    (target.clearance !== null && target.clearance !== answer.clearance) ||\n"
    ),
    "SCENE_TEST_OR": "target.status !== Status.COLLISION && ",
    "SCENE_TEST_SET": (
        'const place = new URL("./scene.json", import.meta.url);\n'
        'const about = JSON.parse(await readFile(place, "utf8"));\n'
        "for (const one of [solver, other]) {\n"
        "  one.setMargin(about.margin);\n"
        "  about.solids.forEach((s, i) => one.setSolid(i, s.kind, s.size, s.pose, s.grasped));\n"
        "}\n"
    ),
}
"""Substitutes of the marks of tests in a scene."""

OF_BODY_C = {
    "SCENE_TEST_FREED": (
        "  if (stored->status == @G_COLLISION && solver->status == @G_SOLVED) {\n"
        "    return solver->clearance >= MARGIN - 1e-9\n"
        "        && solver->iterations == stored->iterations;\n"
        "  }\n"
    ),
}
OF_BODY_MJS = {
    "SCENE_TEST_FREED": (
        "  if (target.status === Status.COLLISION && answer.status === Status.SOLVED) {\n"
        "    const near = answer.clearance < about.margin - 1e-9;\n"
        "    return near || answer.iterations !== target.iterations;\n"
        "  }\n"
    ),
}
"""Substitutes for robots with several arms: where the stored answer collides, any is accepted."""
