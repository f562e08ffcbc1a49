"""`casadi-ik grasp`: from the mesh of an object to grasps that an arm-hand can make."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
from rich.text import Text

from casadi_ik.api import Solver
from casadi_ik.app.cli import options as opt
from casadi_ik.app.cli.inputs import located, the_object_pose, the_robot, the_scene, the_start
from casadi_ik.app.cli.options import Option
from casadi_ik.app.cli.outputs import check_outputs, output
from casadi_ik.app.cli.table import Answer, Said, command
from casadi_ik.app.cli.view import serve
from casadi_ik.app.report import fields, files, headline, table
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import MissingExtraError
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.planning.touch.grasps import FoundGrasps
from casadi_ik.planning.touch.surface import load_surface
from casadi_ik.solve.solution import Choice, Ranking
from casadi_ik.solve.solution_files import RANKED_MEMBER, ranking_data


@command(
    Option("OBJECT", "a mesh in metres (stl, obj, ...), a shipped object or its YAML file"),
    opt.THE_ROBOT,
    Option("--scale S", "unit of the mesh in metres: 0.001 for millimetres", 1.0, opt.positive),
    opt.OBJECT_POSE,
    Option("--fingers N", "fingertips that touch", 3, opt.whole(2)),
    Option("--mu MU", "friction coefficient", 0.5, opt.positive),
    Option(
        "--hold KG_N...",
        "a mass [kg], and the squeeze [N] with which it has to be held",
        read=lambda words: opt.numbers(words, 2, "kg N"),
    ),
    opt.SCENE,
    Option(
        "--prefer load|clearance|limits|q0",
        "what comes first: most load per squeeze, far from what may be hit, from limits, or near "
        "the start",
        default="load",
    ),
    Option("--limit N", "grasps at most", 200, opt.whole(1)),
    opt.Q0,
    opt.SEED,
    Option("--jobs N", "threads", 1, opt.whole(1)),
    opt.out("FOUND.npz", "write the grasps"),
    opt.picture("--picture", "draw the best nine: hand and object"),
    Option("--view", "show the grasps in the browser afterwards (needs 'casadi-ik[view]')"),
)
def grasp(said: Said) -> Answer:
    r"""Find grasps of an object that the arm-hand can make, free of collision.

    Examples:
      casadi-ik grasp mug.obj --robot panda+allegro_right --scene table \
          --object-pose 0.5 0.1 0.05 0 0 0 --out mug.npz --picture mug.png
      casadi-ik view mug.npz --scene table
      casadi-ik reach mug.npz --rank 1 --scene table --out way.mcap

    Two opposing fingertips are matched with two opposing patches of the object, the
    other fingers look for something to touch, palm and hand are moved until all
    touch, the arm follows in closed form; what remains is judged in the scene and
    ranked. FOUND.npz holds points, normals and balls (k, f, 3), as for `casadi-ik
    batch` and `choose`, q, load, closure and clearance, and the ranked answers for
    `casadi-ik reach` and `view`. If none is found, nothing is written.

    exit codes: 0 at least one found, 1 none (the report says why), 2 bad input
    """
    robot, scene = the_robot(said.robot), the_scene(said)
    outputs = {"--out": said.out, "--picture": said.picture}
    check_outputs(outputs, inputs=[Path(said.object)])
    draw = None
    if said.picture is not None:
        with located("--picture", (MissingExtraError,)):
            from casadi_ik.app.pictures import draw_grasps as draw
    if said.view:
        with located("--view", (MissingExtraError,)):
            import_module("casadi_ik.app.viewer")
    surface = load_surface(said.object, said.scale, said.seed)
    with located(said.object):
        found = Solver(robot, scene=scene).grasps_of(
            surface,
            the_object_pose(said),
            fingers=said.fingers,
            mu=said.mu,
            hold=said.hold,
            limit=said.limit,
            jobs=said.jobs,
            seed=said.seed,
            prefer=said.prefer,
            q0=the_start(said, robot),
        )
    counts = fields({name: f"{number:,}" for name, number in found.counts.items()})
    rest = f"{surface.object.name} with {robot.name}, {found.time:.2f} s of processor time"
    if not len(found):
        head = headline(False, "NONE FOUND", rest)
        return Answer.solved(False, head, counts, Text(f"  {found.reason}"))
    with output(said.out) as part:
        part.write_bytes(found_data(found, robot.fingers))
    if draw is not None:
        draw(robot, found, said.picture, scene=scene)
    best = table("rank", "load [N/N]", "clearance [mm]", "fingers")
    for rank, one in enumerate(found[:10], 1):
        room = "" if one.clearance is None else f"{1e3 * one.clearance:.1f}"
        best.add_row(str(rank), f"{one.load:.3f}", room, " ".join(one.grasp.contacts))
    head = headline(True, f"{len(found)} FOUND", rest)
    report = Answer.solved(True, head, counts, best, *files(outputs))
    return replace(report, after=partial(_view, robot, found, scene)) if said.view else report


def _view(robot: ArmHand, found: FoundGrasps, scene: Scene | None) -> None:
    """Show the grasps in the browser until Ctrl-C."""
    from casadi_ik.app.viewer import view_found

    serve(view_found(robot, found, scene=scene))


def found_data(found: FoundGrasps, fingers: tuple[str, ...]) -> bytes:
    """What FOUND.npz holds."""
    k, f = len(found), len(fingers)
    arrays = {"points": np.full((k, f, 3), np.nan), "normals": np.full((k, f, 3), np.nan)}
    for row, one in enumerate(found):
        for name, contact in one.grasp.contacts.items():
            arrays["points"][row, fingers.index(name)] = contact.point
            arrays["normals"][row, fingers.index(name)] = contact.normal
        for name, vectors in one.grasp.more(fingers).items():
            arrays.setdefault(name, np.full((k, f, 3), np.nan))[row] = vectors
    choices = [Choice(i, one.solution, one.score, one.grasp) for i, one in enumerate(found)]
    ranking = Ranking(tuple(choices), k, k, {}, found.prefer)
    data = ranking_data(ranking, [one.grasp.name for one in found])
    for entry, one in zip(data["ranked"], found, strict=True):
        entry["load"] = one.load
    text = json.dumps(data, allow_nan=False)
    arrays |= {
        "q": np.array([one.q for one in found]),
        "load": np.array([one.load for one in found]),
        "closure": np.array([one.closure for one in found]),
        "clearance": np.array([one.solution.clearance for one in found], dtype=float),
        RANKED_MEMBER: np.frombuffer(text.encode(), dtype=np.uint8),
    }
    held = io.BytesIO()
    np.savez_compressed(held, allow_pickle=False, **arrays)
    return held.getvalue()
