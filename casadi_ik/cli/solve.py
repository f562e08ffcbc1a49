"""`casadi-ik solve`."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from casadi_ik.answers.diagnosis import Diagnosis
from casadi_ik.answers.solution import Solution
from casadi_ik.arm_hand import ArmHand
from casadi_ik.cli.answer import Answer, Exit
from casadi_ik.cli.outputs import check_outputs, write_output
from casadi_ik.cli.question import located, the_fixed, the_grasp, the_robot, the_solver, the_start
from casadi_ik.cli.report import solution_report
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import CasadiIKError, MissingExtraError
from casadi_ik.grasps import Grasp, load_object
from casadi_ik.problem.clearance import SceneCheck
from casadi_ik.problem.questions import Questions, tolerances_by_finger
from casadi_ik.proofs.proof import Proof

Draw = Callable[..., object]


def solve(arguments: argparse.Namespace) -> Answer:
    """Solve one grasp.

    Raises:
        CasadiIKError: Bad input, or an output that cannot be written.
    """
    path, grasp = the_grasp(arguments)
    robot = the_robot(arguments.robot, path, grasp)
    q0 = the_start(arguments, robot)
    fixed = the_fixed(arguments, robot)
    with located(str(path)):
        grasp.arrays(robot.fingers)
    out: Path | None = arguments.out
    picture: Path | None = arguments.picture
    dark: Path | None = arguments.picture_dark
    pictures = [(file, kind) for file, kind in ((picture, False), (dark, True)) if file is not None]
    outputs = {"--log": arguments.log, "--out": out, "--picture": picture, "--picture-dark": dark}
    check_outputs(outputs.items(), inputs=[path])
    draw = _drawing(path, grasp) if pictures else None
    solver = the_solver(arguments, robot)
    with located(str(path)):
        solution = solver.solve(
            grasp,
            q0,
            arguments.seed,
            arguments.log,
            arguments.diagnose,
            fixed,
            arguments.prefer,
        )
    if out is not None:
        text = json.dumps(as_json(solution), indent=2, allow_nan=False) + "\n"
        write_output(out, "--out", lambda part: part.write_text(text, encoding="utf-8"))
    if draw is not None:
        for file, is_dark in pictures:
            draw(robot, solution, grasp, file, scene=solver.scene, dark=is_dark)
    written = [(option.lstrip("-"), file) for option, file in outputs.items() if file is not None]
    warning = "" if arguments.scene else penetration(robot, grasp, solution)
    report = solution_report(grasp.name or str(path), solver, solution, written, warning)
    return Answer(report, Exit.DONE if solution.success else Exit.NOT_SOLVED)


def penetration(robot: ArmHand, grasp: Grasp, solution: Solution) -> str:
    """That an answer penetrates the object it grasps, if it does; "" where that is not known."""
    shapes = robot.description.shapes.capsules
    if not (solution.success and grasp.object and grasp.object_pose is not None and shapes):
        return ""
    try:
        check = SceneCheck(robot, Scene(), compiled=False)
        around = check.around(
            Questions(robot, tolerances_by_finger(None, robot.fingers), True).of_grasps(
                [grasp], None
            )
        )
    except CasadiIKError:  # a robot or an object without shapes
        return ""
    mine = np.array([grasp.object in names for names in around.table.names], dtype=bool)
    clear = around.only(mine).check(solution.q[None])
    pair = clear.pair(0)
    if clear.free[0] or pair is None:
        return ""
    depth = -1e3 * float(clear.distance[0])
    return f"the shapes of {pair[0]} and {pair[1]} overlap by {depth:.3g} mm; try --scene table"


def as_json(solution: Solution) -> dict[str, Any]:
    """A solution as JSON holds it; null stands for what is not a finite number (a free finger)."""
    return {
        "success": solution.success,
        "status": solution.status.name,
        "method": solution.method,
        "robot": solution.robot,
        "actuators": list(solution.actuators),
        "q": [_finite(value) for value in solution.q],
        "iterations": solution.iterations,
        "restarts": solution.restarts,
        "time": _finite(solution.time),
        "contacts": {
            finger: {
                "position_error": _finite(contact.position_error),
                "angle_error": _finite(contact.angle_error),
                "ok": contact.ok,
            }
            for finger, contact in solution.contacts.items()
        },
        "diagnosis": None if solution.diagnosis is None else _diagnosis(solution.diagnosis),
        **({} if solution.palm is None else {"palm": _plain(solution.palm)}),
        **({} if solution.clearance is None else _checked(solution, solution.clearance)),
    }


def _checked(solution: Solution, clearance: float) -> dict[str, Any]:
    """What there is to say where collisions were checked."""
    return {
        "clearance": _finite(clearance),
        "closest": _plain(solution.closest),
        "collision": _plain(solution.collision),
    }


def _diagnosis(diagnosis: Diagnosis) -> dict[str, Any]:
    names = [item.name for item in fields(diagnosis) if item.name not in ("lazy", "proof")]
    names += ["established", "reliefs", "freed", "lines"]
    found = {name: getattr(diagnosis, name) for name in names}
    proof = None if diagnosis.proof is None else _proof(diagnosis.proof)
    return _plain(found | {"reason": diagnosis.reason.name, "proof": proof})


def _proof(proof: Proof) -> dict[str, Any]:
    return {
        "kind": proof.kind.name,
        "fingers": proof.fingers,
        "boxes": proof.boxes,
        "quantities": proof.quantities,
        "tolerance": proof.tolerance,
    }


def _plain(value: Any) -> Any:
    """What JSON can hold: arrays and tuples as lists, null for what is not finite."""
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    return _finite(value) if isinstance(value, float) else value


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _drawing(path: Path, grasp: Grasp) -> Draw:
    """The function that draws a solution, after making sure that it can.

    Raises:
        MissingExtraError: matplotlib is not installed.
        CasadiIKError: The grasp names an object that there is not, or a malformed one.
    """
    with located("--picture", (MissingExtraError,)):
        from casadi_ik.views import draw_solution
    if grasp.object:
        with located(f"{path}: object.name"):
            load_object(grasp.object)
    return draw_solution
