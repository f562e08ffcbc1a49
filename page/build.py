"""Build the page that solves in the browser: drag a contact, and arm and hand follow.

Every robot's solver is exported as WebAssembly and written into a script of its own, which the page
loads when the robot is chosen; three.js comes from the npm registry (`npm ci`, versions in
package-lock.json) and is bundled. What comes out are plain files: they work from any file host, and
from disk::

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
from casadi_ik.export.project import checked_prefix, wasm_project, write_folder
from casadi_ik.model.load_grasp import shipped_grasps
from casadi_ik.model.objects import load_object

HERE = Path(__file__).parent

ROBOTS = {
    "kuka_lwr_barrett": "LWR 4+ · Barrett",
    "panda+allegro_right": "Panda · Allegro",
    "baxter_ar10": "Baxter · AR10",
    "panda+shadow": "Panda · Shadow",
    "two_ur10e+barrett_bh8_280": "Two UR10e · Barretts",
    "g1+dex3": "G1 · two Dex3",
}
"""What can be chosen, and what it is called there."""

COLORS = {
    "object": palette.OBJECT,
    "scene": palette.SCENE,
    "touching": palette.NEAREST,
    "pad": palette.PAD,
}
"""Of what the page draws beside robots."""

CAPACITY = 8
"""Solids of a scene: an object of several parts, and the obstacle."""

LARGEST = 4e6
"""A robot's script is at most as large [bytes]."""

CLOSE = 0.015
"""Of two contacts of a shipped grasp that are nearer to each other [m] one is left out: the shapes
of two fingers would overlap."""

SPANS = 20_000
"""Random configurations, from which it is known how far fingertips reach, and apart."""


def of_grasps(robot: ik.ArmHand, name: str) -> list[dict[str, Any]]:
    """The robot's shipped grasps with objects as an export has them; else its contacts at home."""
    found: list[dict[str, Any]] = []
    for file in shipped_grasps(name):
        grasp = ik.load_grasp(file)
        if grasp.object is None or grasp.object_pose is None:
            continue
        # Where pads are and face then, which of balls is not where they touch.
        q = ik.Solver(robot, scene=scene_with_object(ik.Scene(), grasp)).solve(grasp).q
        points, normals = robot.contacts(q)
        for k, finger in enumerate(robot.fingers):
            near = np.linalg.norm(points[:k] - points[k], axis=1) < CLOSE
            if finger not in grasp.contacts or near.any():
                points[k] = normals[k] = np.nan
        parts = primitive_solids(load_object(grasp.object).shape)
        if len(parts) >= CAPACITY or any(solid.kind not in EXPORTED_KINDS for solid, _ in parts):
            continue
        # As the page answers, bit for bit: cameras look at that.
        solver = ik.Solver(robot, scene=scene_with_object(ik.Scene(), grasp))
        close = close_view(robot, solver.solve_batch(points[None], normals[None]).q[0])
        middle = np.nanmean(points, axis=0)
        found.append(
            {
                "name": file,
                "object": grasp.object.replace("_", " "),
                "views": {"close": close, "whole": overview(middle, close)},
                "points": [None if np.isnan(p).any() else p.tolist() for p in points],
                "normals": [None if np.isnan(n).any() else n.tolist() for n in normals],
                "solids": [
                    solid_to_dict(solid, grasp.object_pose @ place) | {"shape": solid.kind.name}
                    for solid, place in parts
                ],
            }
        )
    if not found:
        points, normals = (values.tolist() for values in robot.contacts(robot.home))
        close = close_view(robot, robot.home)
        views = {"close": close, "whole": overview(np.mean(points, axis=0), close)}
        asked = {"points": points, "normals": normals, "views": views}
        found.append({"name": "home", "object": "", "solids": [], **asked})
    return found


def reached(robot: ik.ArmHand) -> dict[str, Any]:
    """How far apart two fingertips, and each from the base, were in random configurations [m]."""
    points, _ = robot.contacts(robot.random(np.random.default_rng(0), SPANS))
    pairs = itertools.combinations(range(len(robot.fingers)), 2)
    away = {pair: np.linalg.norm(points[:, pair[0]] - points[:, pair[1]], axis=1) for pair in pairs}
    return {
        "spans": [
            {"fingers": pair, "least": float(d.min()), "most": float(d.max())}
            for pair, d in away.items()
        ],
        "reach": np.linalg.norm(points, axis=2).max(axis=0).tolist(),
    }


def about(robot: ik.ArmHand, name: str) -> dict[str, Any]:
    """What the page has to know of a robot beside its solver."""
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
        "grasps": of_grasps(robot, name),
        **reached(robot),
    }


def run(*command: str) -> None:
    """Run a command in this folder."""
    done = subprocess.run(command, cwd=HERE, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")


def bundle(entry: Path, out: Path, *more: str) -> None:
    """A script that needs nothing and is no module: from disk, browsers load no others."""
    run(
        *("npx", "--no-install", "esbuild", str(entry), "--bundle", "--minify", "--format=iife"),
        *("--target=es2022", "--charset=utf8", "--log-level=error", f"--outfile={out}", *more),
    )


def build_robot(name: str, out: Path, keep: Path | None) -> dict[str, Any]:
    """A robot's script; what the page says of it before it is loaded.

    Args:
        name: Of the robot.
        out: Folder of the page.
        keep: Where the exported module stays, if it shall.
    """
    robot = ik.load_robot(name)
    prefix = checked_prefix(None, name)
    data = about(robot, name)
    with tempfile.TemporaryDirectory() as folder:
        place = (keep or Path(folder)) / prefix
        write_folder(place, wasm_project(robot, prefix, CAPACITY))
        (place / "about.json").write_text(json.dumps(data), encoding="utf-8")
        entry = place / "entry.js"
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
    if size > LARGEST:
        raise SystemExit(f"{name}: {size / 1e6:.1f} MB, expected at most {LARGEST / 1e6:.0f} MB")
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
    """Build it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), metavar="ROBOT")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the exported modules here")
    arguments = parser.parse_args()
    if shutil.which("npm") is None:
        raise SystemExit("the page needs node and npm, to bundle three.js")
    out = arguments.out.resolve()
    (out / "robots").mkdir(parents=True, exist_ok=True)
    run("npm", "ci", "--no-audit", "--no-fund", "--silent")
    robots = [build_robot(name, out, arguments.keep) for name in arguments.robots]
    defined = {"ROBOTS": robots, "PALETTE": COLORS}
    words = [f"--define:{name}={json.dumps(value)}" for name, value in defined.items()]
    bundle(HERE / "src" / "main.js", out / "page.js", *words)
    for name in ("index.html", "page.css"):
        shutil.copy(HERE / "src" / name, out / name)
    print(f"open {out / 'index.html'}", file=sys.stderr)


if __name__ == "__main__":
    main()
