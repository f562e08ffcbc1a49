"""C projects and WebAssembly modules of a robot's solver, and kernels compiled ahead of use.

A folder is written under a temporary name next to its final path, and renamed when complete.
"""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from casadi_ik.api import Solver
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import InputError, KernelError, MissingExtraError, UnsupportedError, os_errors
from casadi_ik.export.scene import MultiArmSceneSources, SceneSources
from casadi_ik.export.single import SinglePrecision, render_template
from casadi_ik.export.solver import FollowSources, SolverSources, prepared_method
from casadi_ik.export.targets import (
    MULTI_ARM_TEST_C,
    MULTI_ARM_TEST_MJS,
    SCENE_TEST_C,
    SCENE_TEST_MJS,
    SCENE_TEST_SINGLE,
    TARGET_COUNT,
    ExampleTarget,
    SceneTargets,
    c_array,
    example_target,
    frames_header,
    stored_targets,
    targets_header,
)
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Contact, Grasp
from casadi_ik.planning.touch.hands import touch_library

EXPORT_MARKER = ".casadi_ik_export"
"""Name of the file that identifies a folder as an export."""

EXPORTABLE_METHODS = ("hand-first",)
"""Names of the methods that can be exported."""

IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


def export_prefix(prefix: str | None, robot: str) -> str:
    """Return the prefix of all exported names; by default it is derived from the robot's name.

    Raises:
        InputError: The prefix is not an identifier of C.
    """
    if prefix is None:
        identifier = re.sub(r"\W+", "_", robot, flags=re.ASCII).strip("_").lower()
        return identifier if IDENTIFIER.fullmatch(identifier) else f"robot_{identifier}"
    if not IDENTIFIER.fullmatch(prefix):
        raise InputError(f"--prefix: found {prefix!r}, expected letters, digits and underscores")
    return prefix


def check_method(method: str) -> None:
    """Check that a method can be exported.

    Raises:
        UnsupportedError: The method cannot be exported.
    """
    if method not in EXPORTABLE_METHODS:
        raise UnsupportedError(
            f"--method: {method!r} cannot be exported, expected one of "
            f"{', '.join(EXPORTABLE_METHODS)}"
        )


def check_folder(folder: Path) -> None:
    """Check that a folder may be written: it is missing, empty, or an earlier export.

    Raises:
        InputError: The path is another file or folder.
    """
    with os_errors(f"--out: {folder}", InputError):
        if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
            raise InputError(
                f"--out: {folder} is not a folder; expected a new one or an earlier export"
            )
        if folder.is_dir() and any(folder.iterdir()) and not (folder / EXPORT_MARKER).is_file():
            raise InputError(
                f"--out: {folder} is not empty and not an earlier export; nothing was written"
            )


@dataclass(frozen=True, eq=False)
class ExportedSolver:
    """Sources of an exported solver, and the data of its tests.

    Attributes:
        solver: Solver in Python, whose solutions the export reproduces.
        example: Target of the example program.
        marks: Substitutes of the template marks.
        sources: Headers and C files by path.
        scene: Scene of the test targets; None: no collision check.
        judge: Files of double-precision kinematics that verify single-precision solutions.
    """

    solver: Solver
    example: ExampleTarget
    marks: dict[str, str]
    sources: dict[str, str]
    scene: SceneTargets | None
    judge: dict[str, str]


def export_solver(
    robot: ArmHand,
    prefix: str,
    capacity: int | None = None,
    single: bool = False,
    follow: bool = False,
    count: int = TARGET_COUNT,
) -> ExportedSolver:
    """Return the solver of a robot as source code.

    Args:
        robot: The robot.
        prefix: Prefix of every public name.
        capacity: Maximum number of solids in the scene; None: no collision check.
        single: True to compute in single precision.
        follow: True to add a follower of moving contacts; double precision only.
        count: Number of targets that the test of the export solves.

    Raises:
        UnsupportedError: The robot cannot be exported in this way.
    """
    if not robot.actuators:
        raise UnsupportedError(f"export: {robot.name} has no actuators; expected at least one")
    if single and follow:
        raise UnsupportedError("--follow: computes in double precision; expected no --single")
    method, solver = prepared_method(robot), Solver(robot)
    if not method.kernel.compiled:
        raise UnsupportedError(
            "export: a C compiler is required to compute the solutions of the test; "
            "pip install 'casadi-ik[compiler]' installs one"
        )
    precision = SinglePrecision(robot) if single else None
    scene = None
    if capacity is not None:
        sources_class = MultiArmSceneSources if robot.description.sides else SceneSources
        scene = sources_class.for_robot(robot, method, prefix, capacity, precision)
    tolerance = next(iter(solver.tolerances.values()))
    sources = SolverSources(robot, method, prefix, tolerance, scene, precision)
    target = example_target(robot)
    marks = sources.substitutes | {
        "EXAMPLE_WHAT": target.description,
        "EXAMPLE_POINTS": c_array(target.points),
        "EXAMPLE_NORMALS": c_array(target.normals),
        "TARGETS": str(count),
        "ROUNDS_COUNT": str(sources.plan.rounds),
    }
    follower_files: dict[str, str] = {}
    if follow:
        follower_files, follower_marks = FollowSources(_as_hand(robot), prefix, tolerance).files()
        marks |= follower_marks
    files = (
        follower_files
        | sources.side_files
        | {
            f"include/{prefix}.h": render_template("solver.h", marks),
            f"src/{prefix}_parts.h": render_template("parts.h", marks),
            f"src/{prefix}_solver.c": render_template("solver.c", marks),
            f"src/{prefix}_tables.c": sources.tables(),
            **{f"src/{prefix}_{kernel.name}.c": kernel.text for kernel in sources.kernels},
        }
    )
    if scene is not None:
        files[f"src/{prefix}_scene.c"] = scene.source()
    test_scene = None if capacity is None else SceneTargets(solver, capacity)
    judge = sources.judge() if single else {}
    return ExportedSolver(solver, target, marks, sources.in_precision(files), test_scene, judge)


def _as_hand(robot: ArmHand) -> ArmHand:
    """Return the robot; for a multi-arm robot, a hand with all of its motors."""
    return ArmHand(robot.description.as_hand) if robot.description.sides else robot


def _test_marks(project: ExportedSolver, pieces: Mapping[str, str]) -> dict[str, str]:
    """Return the substitutes of the template marks, with those of the test in a scene."""
    if project.scene is None:
        return project.marks
    prefix = project.marks["PREFIX"]
    named = {
        name: piece.replace("@P", prefix).replace("@G", prefix.upper())
        for name, piece in pieces.items()
    }
    return project.marks | named


def c_project(
    robot: ArmHand,
    prefix: str,
    capacity: int | None = None,
    single: bool = False,
    follow: bool = False,
    count: int = TARGET_COUNT,
) -> dict[str, str | bytes]:
    """Return the files of a C project by path.

    Args:
        robot: The robot.
        prefix: Prefix of every public name.
        capacity: Maximum number of solids in the scene; None: no collision check.
        single: True to compute in single precision.
        follow: True to add a follower of moving contacts; double precision only.
        count: Number of targets that the test of the project solves.

    Raises:
        UnsupportedError: The robot's solver cannot be exported.
    """
    project = export_solver(robot, prefix, capacity, single, follow, count)
    files = {
        "example/main.c": "main.c",
        "test/test.c": "test_single.c" if single else "test.c",
        "bench/bench.c": "bench.c",
        "CMakeLists.txt": "CMakeLists.txt",
        "Makefile": "Makefile",
        "README.md": "README.md",
    }
    multi_arm_marks = MULTI_ARM_TEST_C if robot.description.sides else {}
    marks = _test_marks(project, SCENE_TEST_SINGLE if single else SCENE_TEST_C | multi_arm_marks)
    return {
        **project.sources,
        f"include/{prefix}.hpp": render_template("solver.hpp", marks),
        **{path: render_template(name, marks) for path, name in files.items()},
        **project.judge,
        "test/targets.h": targets_header(project.solver, project.scene, single, count)
        + (frames_header(Solver(_as_hand(robot))) if follow else ""),
    }


def write_folder(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Write a folder atomically, replacing an earlier export.

    Raises:
        InputError: The folder cannot be written; no part of it remains.
    """
    check_folder(folder)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        try:
            for name, content in files.items():
                path = temporary / name
                path.parent.mkdir(parents=True, exist_ok=True)
                data = content.encode() if isinstance(content, str) else content
                path.write_bytes(data)
            (temporary / EXPORT_MARKER).write_text(
                "casadi-ik export wrote this folder and may replace it.\n"
            )
            temporary.chmod(0o755)
            replaced = temporary.with_name(temporary.name + ".old")
            if folder.exists():
                folder.rename(replaced)
            try:
                temporary.rename(folder)
            except OSError:
                if replaced.exists():
                    replaced.rename(folder)
                raise
            shutil.rmtree(replaced, ignore_errors=True)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
    except OSError as error:
        raise InputError(f"--out: {folder}: cannot be written: {error.strerror}") from error


# Fused multiply-adds would change the last bits of the solutions.
COMMAND = (
    *("-m", "ziglang", "cc", "-target", "wasm32-wasi", "-mexec-model=reactor", "-std=c11"),
    *("-O2", "-msimd128", "-ffp-contract=off", "-fno-math-errno", "-fno-sanitize=all", "-s"),
)


def wasm_project(
    robot: ArmHand, prefix: str, capacity: int | None = None, follow: bool = False
) -> dict[str, str | bytes]:
    """Return the files of a WebAssembly module and its JavaScript wrapper by path.

    Raises:
        MissingExtraError: ziglang is not installed.
        UnsupportedError: The robot's solver cannot be exported.
        KernelError: The compilation failed.
    """
    if importlib.util.find_spec("ziglang") is None:
        raise MissingExtraError("--target wasm needs ziglang: pip install 'casadi-ik[compiler]'")
    project = export_solver(robot, prefix, capacity, follow=follow)
    multi_arm_marks = MULTI_ARM_TEST_MJS if robot.description.sides else {}
    marks = _test_marks(project, SCENE_TEST_MJS | multi_arm_marks) | {
        "LOWER_JSON": json.dumps(robot.lower.tolist()),
        "UPPER_JSON": json.dumps(robot.upper.tolist()),
        "HOME_JSON": json.dumps(robot.home.tolist()),
        "EXAMPLE_POINTS_JSON": _numbers(project.example.points.ravel().tolist()),
        "EXAMPLE_NORMALS_JSON": _numbers(project.example.normals.ravel().tolist()),
    }
    files = {
        f"{prefix}.js": "solver.js",
        f"{prefix}.d.ts": "solver.d.ts",
        "example.html": "example.html",
        "test.mjs": "test.mjs",
        "README.md": "README_wasm.md",
    }
    package = {"name": prefix, "type": "module", "main": f"{prefix}.js"}
    scene_file = {} if project.scene is None else {"scene.json": project.scene.json()}
    return {
        **scene_file,
        **{path: render_template(name, marks) for path, name in files.items()},
        "package.json": json.dumps(package) + "\n",
        "targets.json": json.dumps(stored_targets(project.solver, project.scene)) + "\n",
        f"{prefix}.wasm": _module(project),
    }


def _numbers(values: list[float]) -> str:
    """Return a JavaScript array of numbers that may be NaN."""
    return "[" + ", ".join("NaN" if value != value else repr(value) for value in values) + "]"


def _module(project: ExportedSolver) -> bytes:
    """Compile the sources to WebAssembly.

    Raises:
        KernelError: The compilation failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for name, text in project.sources.items():
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        (root / "src" / "wasm.c").write_text(
            render_template("wasm.c", project.marks), encoding="utf-8"
        )
        module = root / "solver.wasm"
        texts = sorted(str(path) for path in (root / "src").glob("*.c"))
        include = [f"-I{root / 'include'}", f"-I{root / 'src'}"]
        command = [sys.executable, *COMMAND, *include, *texts, "-lm", "-o", str(module)]
        result = subprocess.run(command, capture_output=True, text=True, errors="replace")
        if result.returncode or not module.is_file():
            complaint = "; ".join(result.stderr.splitlines()[:3]) or "no message"
            raise KernelError(f"zig could not compile the WebAssembly module: {complaint[:500]}")
        return module.read_bytes()


def kernel_uses(
    robot: ArmHand, everything: bool = False
) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield the uses of a robot that compile kernels, each with its description and a function.

    Args:
        robot: The robot.
        everything: True to include scenes, choices, motions and diagnoses.
    """
    solver = Solver(robot)
    q = robot.random(np.random.default_rng(0), 64)  # enough targets for vectorised solves

    def targets() -> tuple[np.ndarray, np.ndarray]:
        return robot.contacts(q)

    @cache
    def grasp() -> Grasp:
        points, normals = robot.contacts(q[0])
        pairs = zip(robot.fingers, points, normals, strict=True)
        return Grasp({name: Contact(*pair) for name, *pair in pairs})

    def solve_with_log() -> object:
        with tempfile.TemporaryDirectory() as folder:
            return solver.solve_batch(*targets(), log=Path(folder) / "log.mcap")

    yield "forward kinematics", targets
    yield "one target", lambda: solver.solve(grasp())
    yield "limits ignored", lambda: Solver(robot, limits="ignore").solve(grasp())
    yield "batches", lambda: solver.solve_batch(*targets())
    yield "grasps of surfaces", touch_library
    if not everything:
        return

    def solve_unreachable(diagnose: bool) -> object:
        points, normals = targets()
        return solver.solve_batch(
            points[:1] + 100.0, normals[:1], diagnose=diagnose, best_effort=not diagnose
        )

    yield "real-time loops", solver.fast
    yield "logs", solve_with_log
    yield "diagnoses", lambda: solve_unreachable(True)
    yield "nearest configurations", lambda: solve_unreachable(False)
    yield "followers", lambda: solver.follow(q[0], period=0.001)(grasp())
    try:
        scene_solver = Solver(robot, scene=Scene())
    except UnsupportedError:
        return
    yield "scenes", lambda: scene_solver.solve_batch(*targets())
    yield "choices", lambda: scene_solver.choose([grasp()] * 2, limit=1)
    yield "ways to a grasp", lambda: scene_solver.reach(grasp(), q0=q[1])
