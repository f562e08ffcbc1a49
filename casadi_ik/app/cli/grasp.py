"""Command `casadi-ik grasp`."""

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
from casadi_ik.app.cli.inputs import (
    load_robot_arg,
    load_scene_arg,
    located,
    parse_object_pose,
    parse_q0,
)
from casadi_ik.app.cli.options import Option
from casadi_ik.app.cli.outputs import check_outputs, output
from casadi_ik.app.cli.table import Arguments, CommandResult, command
from casadi_ik.app.cli.view import serve
from casadi_ik.app.report import fields, files, headline, table
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import MissingExtraError
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.planning.touch.found_grasps import FoundGrasps
from casadi_ik.planning.touch.surface import load_surface
from casadi_ik.solve.solution import Choice, Ranking
from casadi_ik.solve.solution_files import RANKED_MEMBER, ranking_data


@command(
    Option("OBJECT", "mesh (stl, obj, ...), shipped object or YAML file"),
    opt.REQUIRED_ROBOT,
    Option("--scale S", "unit of the mesh [m]: 0.001 for mm", 1.0, opt.positive),
    opt.OBJECT_POSE,
    Option("--fingers N", "number of fingertips in contact", 3, opt.integer(2)),
    Option("--mu MU", "friction coefficient", 0.5, opt.positive),
    Option(
        "--hold KG_N...",
        "required payload [kg] and squeeze force [N]",
        parse=lambda words: opt.numbers(words, 2, "kg N"),
    ),
    opt.SCENE_FILE,
    Option(
        "--prefer load|clearance|limits|q0",
        "ranking criterion, see below",
        default="load",
    ),
    Option("--limit N", "maximum number of grasps", 200, opt.integer(1)),
    opt.Q0,
    opt.RANDOM_SEED,
    Option("--jobs N", "threads", 1, opt.integer(1)),
    opt.out_option("FOUND.npz", "output file of the grasps"),
    opt.picture("--picture", "picture of the best nine grasps"),
    Option("--view", "show the grasps in the browser (needs 'casadi-ik[view]')"),
)
def grasp(args: Arguments) -> CommandResult:
    r"""Find collision-free grasps of an object that the arm can reach.

    Examples:
      casadi-ik grasp mug.obj --robot panda+allegro_right --scene table \
          --object-pose 0.5 0.1 0.05 0 0 0 --out mug.npz --picture mug.png
      casadi-ik view mug.npz --scene table
      casadi-ik reach mug.npz --rank 1 --scene table --out way.mcap

    The search matches two opposing fingertips with two opposing patches of the
    object, places the other fingers on the surface, fits palm and hand posture,
    solves the arm in closed form, checks collisions, and ranks the remaining grasps:
    by load (weight that a unit of grip force holds), by clearance, by the margin to
    joint limits, or by the distance from --q0.

    FOUND.npz holds points, normals and balls (k, f, 3) in the format of `casadi-ik
    batch` and `choose`, q, load, closure and clearance, and the ranked solutions for
    `casadi-ik reach` and `view`. If no grasp is found, no file is written.

    exit codes: 0 at least one found, 1 none (see report), 2 bad input
    """
    robot, scene = load_robot_arg(args.robot), load_scene_arg(args)
    outputs = {"--out": args.out, "--picture": args.picture}
    check_outputs(outputs, inputs=[Path(args.object)])
    draw = None
    if args.picture is not None:
        with located("--picture", (MissingExtraError,)):
            from casadi_ik.app.pictures import draw_grasps as draw
    if args.view:
        with located("--view", (MissingExtraError,)):
            import_module("casadi_ik.app.viewer")
    surface = load_surface(args.object, args.scale, args.seed)
    with located(args.object):
        grasps = Solver(robot, scene=scene).grasps_of(
            surface,
            parse_object_pose(args),
            fingers=args.fingers,
            mu=args.mu,
            hold=args.hold,
            limit=args.limit,
            jobs=args.jobs,
            seed=args.seed,
            prefer=args.prefer,
            q0=parse_q0(args, robot),
        )
    counts = fields({name: f"{number:,}" for name, number in grasps.counts.items()})
    subject = f"{surface.object.name} with {robot.name}, {grasps.time:.2f} s of processor time"
    if not len(grasps):
        title = headline(False, "NONE FOUND", subject)
        return CommandResult.of_parts(False, title, counts, Text(f"  {grasps.reason}"))
    with output(args.out) as part:
        part.write_bytes(grasps_npz(grasps, robot.fingers))
    if draw is not None:
        draw(robot, grasps, args.picture, scene=scene)
    best = table("rank", "load [N/N]", "clearance [mm]", "fingers")
    for rank, entry in enumerate(grasps[:10], 1):
        clearance = "" if entry.clearance is None else f"{1e3 * entry.clearance:.1f}"
        best.add_row(str(rank), f"{entry.load:.3f}", clearance, " ".join(entry.grasp.contacts))
    title = headline(True, f"{len(grasps)} FOUND", subject)
    report = CommandResult.of_parts(True, title, counts, best, *files(outputs))
    return replace(report, epilogue=partial(_view, robot, grasps, scene)) if args.view else report


def _view(robot: ArmHand, grasps: FoundGrasps, scene: Scene | None) -> None:
    """Show the grasps in the browser until Ctrl-C."""
    from casadi_ik.app.viewer import view_found

    serve(view_found(robot, grasps, scene=scene))


def grasps_npz(grasps: FoundGrasps, fingers: tuple[str, ...]) -> bytes:
    """Return the contents of FOUND.npz."""
    k, f = len(grasps), len(fingers)
    arrays = {"points": np.full((k, f, 3), np.nan), "normals": np.full((k, f, 3), np.nan)}
    for row, entry in enumerate(grasps):
        for name, contact in entry.grasp.contacts.items():
            arrays["points"][row, fingers.index(name)] = contact.point
            arrays["normals"][row, fingers.index(name)] = contact.normal
        for name, vectors in entry.grasp.more(fingers).items():
            arrays.setdefault(name, np.full((k, f, 3), np.nan))[row] = vectors
    choices = [
        Choice(i, entry.solution, entry.score, entry.grasp) for i, entry in enumerate(grasps)
    ]
    ranking = Ranking(tuple(choices), k, k, {}, grasps.prefer)
    data = ranking_data(ranking, [entry.grasp.name for entry in grasps])
    for item, entry in zip(data["ranked"], grasps, strict=True):
        item["load"] = entry.load
    text = json.dumps(data, allow_nan=False)
    arrays |= {
        "q": np.array([entry.q for entry in grasps]),
        "load": np.array([entry.load for entry in grasps]),
        "closure": np.array([entry.closure for entry in grasps]),
        "clearance": np.array([entry.solution.clearance for entry in grasps], dtype=float),
        RANKED_MEMBER: np.frombuffer(text.encode(), dtype=np.uint8),
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()
