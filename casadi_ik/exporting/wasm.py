"""A solver as a WebAssembly module, and the JavaScript around it."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from casadi_ik.arm_hand import ArmHand
from casadi_ik.errors import KernelError, MissingExtraError
from casadi_ik.exporting.project import Exported, exported, tested
from casadi_ik.exporting.targets import IN_TEST_MJS
from casadi_ik.exporting.targets import stored
from casadi_ik.exporting.single import filled

# No contraction: with fused multiply-adds the answers would be others in the last places.
COMMAND = (
    *("-m", "ziglang", "cc", "-target", "wasm32-wasi", "-mexec-model=reactor", "-std=c11"),
    *("-O2", "-msimd128", "-ffp-contract=off", "-fno-math-errno", "-fno-sanitize=all", "-s"),
)


def wasm_project(
    robot: ArmHand, prefix: str, capacity: int | None = None, follow: bool = False
) -> dict[str, str | bytes]:
    """The files of a module with its wrapper, by path.

    Raises:
        MissingExtraError: ziglang is not installed.
        UnsupportedError: The robot's solver cannot be exported.
        KernelError: The compiler refused.
    """
    if importlib.util.find_spec("ziglang") is None:
        raise MissingExtraError("--target wasm needs ziglang: pip install 'casadi-ik[compiler]'")
    project = exported(robot, prefix, capacity, follow=follow)
    marks = (
        project.marks
        | tested(project, IN_TEST_MJS)
        | {
            "LOWER_JSON": json.dumps(robot.lower.tolist()),
            "UPPER_JSON": json.dumps(robot.upper.tolist()),
            "HOME_JSON": json.dumps(robot.home.tolist()),
            "EXAMPLE_POINTS_JSON": _numbers(project.example.points.ravel().tolist()),
            "EXAMPLE_NORMALS_JSON": _numbers(project.example.normals.ravel().tolist()),
        }
    )
    files = {
        f"{prefix}.js": "solver.js",
        f"{prefix}.d.ts": "solver.d.ts",
        "example.html": "example.html",
        "test.mjs": "test.mjs",
        "README.md": "README_wasm.md",
    }
    package = {"name": prefix, "type": "module", "main": f"{prefix}.js"}
    about = {} if project.scene is None else {"scene.json": project.scene.json()}
    return {
        **about,
        **{path: filled(name, marks) for path, name in files.items()},
        "package.json": json.dumps(package) + "\n",
        "targets.json": json.dumps(stored(project.solver, project.scene)) + "\n",
        f"{prefix}.wasm": _module(project),
    }


def _numbers(values: list[float]) -> str:
    """A JavaScript array, NaN included."""
    return "[" + ", ".join("NaN" if value != value else repr(value) for value in values) + "]"


def _module(project: Exported) -> bytes:
    """The sources, compiled.

    Raises:
        KernelError: The compiler refused.
    """
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for name, text in project.sources.items():
            path = place / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        (place / "src" / "wasm.c").write_text(filled("wasm.c", project.marks), encoding="utf-8")
        made = place / "solver.wasm"
        texts = sorted(str(path) for path in (place / "src").glob("*.c"))
        include = [f"-I{place / 'include'}", f"-I{place / 'src'}"]
        command = [sys.executable, *COMMAND, *include, *texts, "-lm", "-o", str(made)]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace")
        if done.returncode or not made.is_file():
            complaint = "; ".join(done.stderr.splitlines()[:3]) or "no complaint"
            raise KernelError(f"zig made no WebAssembly module: {complaint[:500]}")
        return made.read_bytes()
