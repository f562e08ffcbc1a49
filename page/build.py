"""Build the page that solves in the browser: drag a contact, and arm and hand follow.

Each robot's solver is exported as WebAssembly and bundled into a script that the page loads when
the robot is selected. three.js comes from the npm registry (`npm ci`, versions in
package-lock.json). The result are plain files for any file host, which also work from disk::

    python page/build.py --out out/page
"""

from __future__ import annotations

import argparse
import itertools
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import casadi_ik as ik
from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import close_view, link_styles, overview, scene_with_object
from casadi_ik.collision.solids import EXPORTED_KINDS, primitive_solids, solid_to_dict
from casadi_ik.export.project import export_prefix, wasm_project, write_folder
from casadi_ik.model.load_grasp import shipped_grasps
from casadi_ik.model.objects import load_object

PAGE_FOLDER = Path(__file__).parent

ROBOTS = {
    "kuka_lwr_barrett": "LWR 4+ · Barrett",
    "panda+allegro_right": "Panda · Allegro",
    "baxter_ar10": "Baxter · AR10",
    "panda+shadow": "Panda · Shadow",
    "two_ur10e+barrett_bh8_280": "Two UR10e · Barretts",
    "g1+dex3": "G1 · two Dex3",
}
"""Robots of the page, and their titles."""

COLORS = {
    "object": palette.OBJECT,
    "scene": palette.SCENE,
    "touching": palette.NEAREST,
    "pad": palette.PAD,
}
"""Colours of items other than robots."""

SOLID_CAPACITY = 8
"""Maximum number of solids: the parts of an object, and the obstacle."""

MAX_SCRIPT_SIZE = 4e6
"""Maximum size of a robot's script [bytes]."""

MIN_CONTACT_DISTANCE = 0.015
"""Minimum distance of contacts of a shipped grasp [m]; of closer ones, one is left out, since the
shapes of the fingers would overlap.
"""

SAMPLE_COUNT = 20_000
"""Number of random configurations from which the ranges of fingertip distances are estimated."""


def grasp_entries(robot: ik.ArmHand, name: str) -> list[dict[str, Any]]:
    """Return the robot's shipped grasps whose objects can be exported, or its contacts at home."""
    grasps: list[dict[str, Any]] = []
    for grasp_name in shipped_grasps(name):
        grasp = ik.load_grasp(grasp_name)
        if grasp.object is None or grasp.object_pose is None:
            continue
        # Points and normals of the pads; for a ball condition they differ from the target.
        q = ik.Solver(robot, scene=scene_with_object(ik.Scene(), grasp)).solve(grasp).q
        points, normals = robot.contacts(q)
        for k, finger in enumerate(robot.fingers):
            is_close = np.linalg.norm(points[:k] - points[k], axis=1) < MIN_CONTACT_DISTANCE
            if finger not in grasp.contacts or is_close.any():
                points[k] = normals[k] = np.nan
        parts = primitive_solids(load_object(grasp.object).shape)
        if len(parts) >= SOLID_CAPACITY or any(
            solid.kind not in EXPORTED_KINDS for solid, _ in parts
        ):
            continue
        # Cameras show the solution of the page, which equals this one bit for bit.
        solver = ik.Solver(robot, scene=scene_with_object(ik.Scene(), grasp))
        close_up = close_view(robot, solver.solve_batch(points[None], normals[None]).q[0])
        center = np.nanmean(points, axis=0)
        grasps.append(
            {
                "name": grasp_name,
                "object": grasp.object.replace("_", " "),
                "views": {"close": close_up, "whole": overview(center, close_up)},
                "points": [None if np.isnan(p).any() else p.tolist() for p in points],
                "normals": [None if np.isnan(n).any() else n.tolist() for n in normals],
                "solids": [
                    solid_to_dict(solid, grasp.object_pose @ pose) | {"shape": solid.kind.name}
                    for solid, pose in parts
                ],
            }
        )
    if not grasps:
        points, normals = (values.tolist() for values in robot.contacts(robot.home))
        close_up = close_view(robot, robot.home)
        views = {"close": close_up, "whole": overview(np.mean(points, axis=0), close_up)}
        contacts_and_views = {"points": points, "normals": normals, "views": views}
        grasps.append({"name": "home", "object": "", "solids": [], **contacts_and_views})
    return grasps


def reach_statistics(robot: ik.ArmHand) -> dict[str, Any]:
    """Return the ranges of distances between fingertips and from the base."""
    points, _ = robot.contacts(robot.random(np.random.default_rng(0), SAMPLE_COUNT))
    pairs = itertools.combinations(range(len(robot.fingers)), 2)
    distances = {
        pair: np.linalg.norm(points[:, pair[0]] - points[:, pair[1]], axis=1) for pair in pairs
    }
    return {
        "spans": [
            {"fingers": pair, "least": float(d.min()), "most": float(d.max())}
            for pair, d in distances.items()
        ],
        "reach": np.linalg.norm(points, axis=2).max(axis=0).tolist(),
    }


def robot_data(robot: ik.ArmHand, name: str) -> dict[str, Any]:
    """Return the data of a robot that the page needs besides its solver."""
    description = robot.description
    arms = description.arm_actuators
    if description.sides:
        arms = (
            *description.trunk_actuators,
            *(i for arm, _ in description.side_actuators for i in arm),
        )
    return {
        "name": robot.name,
        "title": ROBOTS.get(name, name),
        "armMotors": list(arms),
        "looks": link_styles(robot.description),
        "prismatic": [motor.unit == "m" for motor in robot.description.actuators],
        "grasps": grasp_entries(robot, name),
        **reach_statistics(robot),
    }


def run(*command: str) -> None:
    """Run a command in the folder of the page."""
    done = subprocess.run(command, cwd=PAGE_FOLDER, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")


def bundle(entry: Path, out: Path, *options: str) -> None:
    """Bundle a script as an IIFE, because browsers do not load modules from disk."""
    run(
        *("npx", "--no-install", "esbuild", str(entry), "--bundle", "--minify", "--format=iife"),
        *("--target=es2022", "--charset=utf8", "--log-level=error", f"--outfile={out}", *options),
    )


def build_robot(name: str, out: Path, keep_folder: Path | None) -> dict[str, Any]:
    """Build the script of a robot, and return its entry in the page.

    Args:
        name: Name of the robot.
        out: Folder of the page.
        keep_folder: Folder in which the exported module is kept; None: it is not kept.
    """
    robot = ik.load_robot(name)
    prefix = export_prefix(None, name)
    data = robot_data(robot, name)
    with tempfile.TemporaryDirectory() as folder:
        folder_of_robot = (keep_folder or Path(folder)) / prefix
        write_folder(folder_of_robot, wasm_project(robot, prefix, SOLID_CAPACITY))
        (folder_of_robot / "about.json").write_text(json.dumps(data), encoding="utf-8")
        entry = folder_of_robot / "entry.js"
        entry.write_text(
            f'import * as solver from "./{prefix}.js";\n'
            f'import wasm from "./{prefix}.wasm";\n'
            'import about from "./about.json";\n'
            f"globalThis.casadiIkRobots ??= {{}};\n"
            f"globalThis.casadiIkRobots[{json.dumps(name)}] = {{ solver, wasm, about }};\n",
            encoding="utf-8",
        )
        script = out / "robots" / f"{prefix}.js"
        loaders = ("--loader:.wasm=binary", "--external:node:fs/promises")
        bundle(entry, script, *loaders, "--define:import.meta.url=''")
    size = script.stat().st_size
    if size > MAX_SCRIPT_SIZE:
        raise SystemExit(
            f"{name}: {size / 1e6:.1f} MB, expected at most {MAX_SCRIPT_SIZE / 1e6:.0f} MB"
        )
    print(f"{name}: {size / 1e6:.2f} MB", flush=True)
    motors, fingers = len(robot.actuators), len(robot.fingers)
    return {
        "name": name,
        "title": data["title"],
        "what": f"{motors} motors, {fingers} fingers",
        "script": f"robots/{prefix}.js",
        "size": size,
    }


def main() -> None:
    """Build the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), metavar="ROBOT")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the exported modules here")
    arguments = parser.parse_args()
    if shutil.which("npm") is None:
        raise SystemExit("npm is not installed; the page needs node and npm to bundle three.js")
    out = arguments.out.resolve()
    (out / "robots").mkdir(parents=True, exist_ok=True)
    run("npm", "ci", "--no-audit", "--no-fund", "--silent")
    robots = [build_robot(name, out, arguments.keep) for name in arguments.robots]
    definitions = {"ROBOTS": robots, "PALETTE": COLORS}
    options = [f"--define:{name}={json.dumps(value)}" for name, value in definitions.items()]
    bundle(PAGE_FOLDER / "src" / "main.js", out / "page.js", *options)
    for name in ("index.html", "page.css"):
        shutil.copy(PAGE_FOLDER / "src" / name, out / name)
    print(f"open {out / 'index.html'}", file=sys.stderr)


if __name__ == "__main__":
    main()
