"""Commands `casadi-ik grasp`, `map` and `place-base`."""

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
from casadi_ik.app.cli.outputs import check_outputs, output, write_json, writing
from casadi_ik.app.cli.table import Arguments, CommandResult, command
from casadi_ik.app.cli.view import serve
from casadi_ik.app.report import fields, files, headline, table
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import InputError, MissingExtraError
from casadi_ik.files.arrays import Array
from casadi_ik.integrations.datasets import load_candidates
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.load_grasp import load_grasp
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
    opt.MESHES,
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

    FOUND.npz holds points and normals (k, f, 3), and tangents, lines, planes or balls
    if contacts have them, in the format of `casadi-ik batch` and `choose`. It also holds
    q, load, closure and clearance of each grasp, and the ranked solutions for
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
        for name, vectors in entry.grasp.extra_vectors(fingers).items():
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


@command(
    Option("ROBOT", "robot name or YAML file"),
    Option(
        "--region VALUES...",
        "box corners: x y z x y z [m] (default: around the arm)",
        parse=lambda words: opt.numbers(words, 6, "x y z x y z"),
    ),
    Option("--orientations N", "number of palm orientations", 32, opt.integer(1)),
    Option("--resolution M", "distance of neighbouring positions [m]", 0.05, opt.positive),
    Option("--meaning exact|tolerance", "palm pose itself, or within the solver's tolerance"),
    Option("--contacts GRASP", "grasp of an object whose poses are mapped"),
    opt.SCENE_FILE,
    opt.LIMIT_MODE,
    Option("--jobs N", "threads", 1, opt.integer(1)),
    opt.out_option("MAP.npz", "output file of the map", opt.file_name(".npz", ".ply", ".parquet")),
    opt.picture("--picture", "picture of three layers"),
)
def reach_map(args: Arguments) -> CommandResult:
    r"""Map the palm poses that an arm can reach, or the poses of an object.

    Examples:
      casadi-ik map ur5e --out ur5e.npz --picture ur5e.png
      casadi-ik map panda --scene table --resolution 0.1 --out panda.ply
      casadi-ik map my_robot.yaml --orientations 96 --jobs 4 --out my.parquet
      casadi-ik map kuka_lwr_barrett --contacts cup --resolution 0.2 \
          --orientations 8 --out cup.npz

    Every palm pose is REACHABLE (with joint positions as a witness, which forward
    kinematics confirms), UNREACHABLE (refuted by interval arithmetic) or OPEN. For an
    arm without an exact closed form, the solver searches for witnesses within its
    tolerance, and nothing is refuted. With --scene, a palm pose that is reached only in
    collision is COLLIDING. With --contacts, the cells are poses of the object of a grasp,
    which arm and hand take together, within tolerance.

    MAP.npz holds positions, rotations, code (0 OPEN, 1 REACHABLE, 2 UNREACHABLE,
    3 COLLIDING) and q.
    MAP.ply is a point cloud of the positions, coloured by the share of reachable
    orientations. MAP.parquet has a row per palm pose.

    exit codes: 0 done, 2 bad input
    """
    robot = load_robot_arg(args.robot)
    outputs = {"--out": args.out, "--picture": args.picture}
    check_outputs(outputs)
    draw = None
    if args.picture is not None:
        with located("--picture", (MissingExtraError,)):
            from casadi_ik.app.pictures import draw_reach_map as draw
    region = None if args.region is None else np.reshape(args.region, (2, 3))
    meaning = {"exact": "exact", "tolerance": "within tolerance"}.get(args.meaning)
    contacts = None
    if args.contacts is not None:
        with located("--contacts"):
            contacts = load_grasp(args.contacts)
    reach = Solver(robot, limits=args.limits, scene=load_scene_arg(args)).reach_map(
        region, args.orientations, args.resolution, meaning, jobs=args.jobs, contacts=contacts
    )
    save = {".npz": reach.save, ".ply": reach.to_ply, ".parquet": reach.to_parquet}
    with writing(args.out, "--out"):
        save[args.out.suffix](args.out)
    if draw is not None:
        draw(reach, args.picture)
    title = headline(True, "MAP", f"of {robot.name}, {reach.meaning}")
    counts = fields({name: f"{count:,}" for name, count in reach.counts.items()})
    return CommandResult.of_parts(True, title, counts, *files(outputs))


@command(
    Option("GRASPS", "file of palm poses or grasps, see below"),
    opt.REQUIRED_ROBOT,
    Option(
        "--region VALUES...",
        "corners of the base positions: x y z x y z [m]",
        parse=lambda words: opt.numbers(words, 6, "x y z x y z"),
    ),
    Option("--resolution M", "size of the smallest boxes [m]", 0.02, opt.positive),
    Option("--max-time S", "time after which the search ends [s]", 10.0, opt.positive),
    Option("--prefer limits|center", "preference among bases that reach equally many"),
    opt.SCENE_FILE,
    opt.LIMIT_MODE,
    opt.out_option("PLACE.json", "output file of the placement"),
    opt.picture("--picture", "heat map of the bases"),
)
def place_base(args: Arguments) -> CommandResult:
    r"""Place an upright base so that the arm reaches as many palm poses as possible.

    Examples:
      casadi-ik place-base palms.npz --robot ur5e --region -1 -1 0 1 1 0 \
          --out place.json
      casadi-ik place-base grasps.yaml --robot kuka_lwr_barrett --scene table \
          --out place.json

    The search is a branch and bound: the report has the number of palm poses that the
    best base reaches, and a proved upper bound for all bases of the region. With
    --scene, base and arm are free of collision; the bound ignores collisions.

    GRASPS is a file .npz with `palms` (k, 4, 4) or with `q` (k, n), as `grasp` and
    `batch` write it, a file .npy of palm poses, or any file that `choose` reads; all in
    the world frame. The default region is at height 0, around all bases that may reach
    a palm pose.

    PLACE.json holds robot (its name), pose (4, 4), base (x, y, z [m], yaw [rad]), count,
    upper_bound, reached (k) and q (null where not reached).

    exit codes: 0 a palm pose is reached, 1 none, 2 bad input
    """
    robot = load_robot_arg(args.robot)
    outputs = {"--out": args.out, "--picture": args.picture}
    check_outputs(outputs, inputs=[Path(args.grasps)])
    draw = None
    if args.picture is not None:
        with located("--picture", (MissingExtraError,)):
            from casadi_ik.app.pictures import draw_base_placement as draw
    region = None if args.region is None else np.reshape(args.region, (2, 3))
    solver, scene = Solver(robot, limits=args.limits), load_scene_arg(args)
    with located(args.grasps):
        grasps = _read_grasps(Path(args.grasps), robot)
        placement = solver.place_base(
            grasps, region, args.resolution, args.max_time, args.prefer, scene
        )
    rows = zip(placement.q.tolist(), placement.reached.tolist(), strict=True)
    data = {
        "robot": robot.name,
        "pose": placement.pose.tolist(),
        "base": placement.base.tolist(),
        "count": placement.count,
        "upper_bound": placement.upper_bound,
        "reached": placement.reached.tolist(),
        "q": [q if is_reached else None for q, is_reached in rows],
    }
    write_json(args.out, data)
    if draw is not None:
        draw(placement, args.picture)
    x, y, z, yaw = placement.base.tolist()
    report = fields(
        {
            "reached": f"{placement.count} of {len(placement.reached)} palm poses",
            "bound": f"{placement.upper_bound} (proved for all bases of the region)",
            "base": f"{x:.3f} {y:.3f} {z:.3f} m, yaw {yaw:.3f} rad",
        }
    )
    title = headline(placement.count > 0, "PLACED", f"{robot.name}, {placement.time:.1f} s")
    return CommandResult.of_parts(placement.count > 0, title, report, *files(outputs))


def _read_grasps(path: Path, robot: ArmHand) -> Array | tuple[Grasp, ...]:
    """Return the palm poses (k, 4, 4) of a file, or its grasps.

    Raises:
        InputError: The file cannot be read or has neither.
    """
    if path.suffix in (".npz", ".npy"):
        try:
            content = np.load(path, allow_pickle=False)
            if isinstance(content, np.ndarray):
                return content
            if "palms" in content:
                return content["palms"]
            if "q" in content:
                q = content["q"]
                return robot.palm(q[np.isfinite(q).all(axis=1)])
        except (OSError, ValueError) as error:
            raise InputError(f"palms: cannot be read: {error}; expected (k, 4, 4)") from error
    return load_candidates(path, robot).grasps
