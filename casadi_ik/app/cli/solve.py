"""Commands `casadi-ik solve` and `casadi-ik choose`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.text import Text

from casadi_ik.app.cli import options as opt
from casadi_ik.app.cli.inputs import (
    load_grasp_arg,
    load_robot_arg,
    located,
    make_solver,
    parse_fixed,
    parse_object_pose,
    parse_q0,
    report_units,
)
from casadi_ik.app.cli.options import Option
from casadi_ik.app.cli.outputs import check_outputs, write_json
from casadi_ik.app.cli.table import Arguments, CommandResult, command
from casadi_ik.app.report import duration, files, ranking_report, solution_report
from casadi_ik.collision.clearance import SceneCheck
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import CasadiIKError, MissingExtraError
from casadi_ik.integrations.datasets import LAYOUT_NAMES, load_candidates
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.objects import load_object
from casadi_ik.solve.solution import Solution
from casadi_ik.solve.solution_files import ranking_data, solution_data
from casadi_ik.solve.target_builder import TargetBuilder, tolerances_by_finger

TIMING_BUDGET = 0.2
"""Time for which a solve is repeated to measure its time [s]."""

SLOW_FIRST_SOLVE = 1.0
"""Time of a first solve above which the report explains it [s]."""


@command(
    opt.GRASP,
    opt.ROBOT,
    *opt.SOLVER,
    Option("--out FILE.json", "output file of the solution", parse=opt.json_name),
    opt.picture("--picture", "picture of the grasp"),
    opt.picture("--picture-dark", "picture on a dark background"),
    opt.MESHES,
    opt.diagnose(default=True),
    opt.BEST_EFFORT,
    opt.SIZE_LIMITS,
)
def solve(args: Arguments) -> CommandResult:
    """Solve the inverse kinematics of one grasp.

    Examples:
      casadi-ik solve cup
      casadi-ik solve cup --method enhanced-dls --out cup.json --log cup.mcap
      casadi-ik solve cup --scene table --picture cup.png
      casadi-ik solve cup --object-pose 1 0 2 0 0 0 --best-effort
      casadi-ik solve my.yaml --robot mine.yaml --tolerance-position 2 --mm

    Example of a grasp file:
      robot: kuka_lwr_barrett
      contacts:   # point [m], outward pad normal, in the robot's base frame
        thumb:    {point: [-0.83, 0.15, 0.41], normal: [0.48, -0.88, 0]}
        finger_2: {point: [-0.84, 0.11, 0.435], normal: [0.72, 0.70, 0]}
        finger_3: {point: [-0.84, 0.11, 0.385], normal: [0.72, 0.70, 0]}

    --object-pose moves the contacts with the object. If the file states no pose of
    its object, its contacts are in the object's frame.

    exit codes: 0 solved, 1 not solved (see report), 2 bad input
    """
    path, grasp = load_grasp_arg(args)
    robot = load_robot_arg(args.robot, path, grasp)
    q0, fixed = parse_q0(args, robot), parse_fixed(args, robot)
    with located(str(path)):
        grasp.arrays(robot.fingers)
    pictures = {"--picture": args.picture, "--picture-dark": args.picture_dark}
    outputs = {"--log": args.log, "--out": args.out, **pictures}
    check_outputs(outputs, inputs=[path])
    draw = _drawing(path, grasp) if any(pictures.values()) else None
    solver = make_solver(args, robot)

    def run_solver(log: Path | None = None, diagnose: bool = False) -> Solution:
        return solver.solve(
            grasp, q0, args.seed, log, diagnose, fixed, args.prefer, bool(args.best_effort)
        )

    with located(str(path)):
        solution = run_solver(args.log, args.diagnose)
    first, solution = solution.time, replace(solution, time=_warm_time(run_solver, solution))
    if args.out is not None:
        write_json(args.out, solution_data(solution))
    for option, file in pictures.items():
        if draw is not None and file is not None:
            dark = option == "--picture-dark"
            draw(robot, solution, grasp, file, scene=solver.scene, dark=dark)
    notes = [] if args.scene else _penetration(robot, grasp, solution)
    if first > max(10 * solution.time, SLOW_FIRST_SOLVE):
        notes.append(
            f"the first solve took {duration(first)} because kernels were compiled or loaded"
        )
    name, enforced = grasp.name or str(path), solver.limits == "enforce"
    report = solution_report(solution, robot, name, report_units(args), enforced, notes)
    return CommandResult.of_parts(solution.success, report, *files(outputs))


def _warm_time(run_solver: Callable[[], Solution], solution: Solution) -> float:
    """Return the time of a solve without compilation and loading of kernels [s].

    An unsolved grasp is not repeated because its solve takes long.
    """
    times = [solution.time]
    while solution.success and len(times) < 4 and sum(times[1:]) < TIMING_BUDGET:
        times.append(run_solver().time)
    return min(times)


def _penetration(robot: ArmHand, grasp: Grasp, solution: Solution) -> list[str]:
    """Return a note if the solution penetrates the grasped object and both have shapes."""
    shapes = robot.description.shapes.capsules
    if not (solution.success and grasp.object and grasp.object_pose is not None and shapes):
        return []
    builder = TargetBuilder(robot, tolerances_by_finger(None, robot.fingers))
    try:
        check = SceneCheck(robot, Scene(), compiled=False)
        query = check.collision_query(builder.from_grasps([grasp]))
    except CasadiIKError:  # a robot or an object without shapes
        return []
    of_object = np.array([grasp.object in names for names in query.table.names], dtype=bool)
    clear = query.with_table(query.table.select(of_object)).check(solution.q[None])
    pair = clear.pair(0)
    if clear.free[0] or pair is None:
        return []
    depth = -1e3 * float(clear.distance[0])
    return [f"the shapes of {pair[0]} and {pair[1]} overlap by {depth:.3g} mm; try --scene table"]


def _drawing(path: Path, grasp: Grasp) -> Callable[..., Any]:
    """Return the function that draws a solution after checking its requirements.

    Raises:
        MissingExtraError: matplotlib is not installed.
        CasadiIKError: The object of the grasp is unknown or malformed.
    """
    with located("--picture", (MissingExtraError,)):
        from casadi_ik.app.pictures import draw_solution
    if grasp.object:
        with located(f"{path}: object.name"):
            load_object(grasp.object)
    return draw_solution


@command(
    Option("CANDIDATES", "file or folder of candidate grasps, see below"),
    opt.REQUIRED_ROBOT,
    opt.OBJECT_POSE,
    Option(
        "--layout L",
        "format of the file, see below (default: detected)",
        parse=opt.choice(*LAYOUT_NAMES),
    ),
    Option("--hand FILE", "hand of the file: name or YAML file (default: by robot)"),
    Option(
        "--take palm|contacts",
        "goal of rows: palm pose or fingertips",
        "palm",
    ),
    Option(
        "--object NAME",
        "object of a data set or table: name, YAML file or mesh",
    ),
    Option("--of NAME", "use only grasps of this object (name as in the file)"),
    Option("--scale FACTOR", "use only grasps of this object scale (as in the file)"),
    Option(
        "--invalid error|drop|clip",
        "treatment of invalid rows, see below",
        "error",
    ),
    opt.SCENE_FILE,
    opt.PREFER,
    opt.Q0,
    Option("--limit N", "maximum number of solutions", 10),
    Option("--per-candidate N", "maximum number of solutions per candidate", 1),
    Option("--best-effort", "nearest configurations if there is no solution"),
    opt.RANDOM_SEED,
    *opt.TOLERANCES,
    opt.MAX_RESTARTS,
    opt.out_option("RANKED.json", "output file of the ranked solutions", opt.json_name),
    opt.SIZE_LIMITS,
)
def choose(args: Arguments) -> CommandResult:
    r"""Rank candidate grasps and return the best feasible ones.

    Examples:
      casadi-ik choose candidates.yaml --robot panda+allegro_right --scene table \
          --out ranked.json
      casadi-ik choose grasps/ --robot R --object-pose 0.5 0 0.1 0 0 1.57 \
          --prefer q0 --out ranked.json

    CANDIDATES is one of
      a YAML file with a list of grasps in the format of grasp files:
        candidates:
          - contacts: {thumb: {point: [0.02, 0.1, 0], normal: [0, -1, 0]}, ...}
          - contacts: ...
      a folder of grasp files
      an npz file with points and normals (k, f, 3), as for `casadi-ik batch`
      an npy file of getagrip, dexgraspnet, bodex, dexgraspbench or dexonomy with
        palm poses and hand postures
      a pt file of multidex; --of selects one of its objects
      a table (.csv, .npz, .parquet) with the palm pose in columns x y z and qw qx
        qy qz or roll pitch yaw, and the joint positions of the hand by name
    --layout names the format: getagrip, dexgraspnet, bodex, dexgraspbench,
    dexonomy, multidex, isaac_grasp, acronym, graspnet, poses or table. No code in
    a file is executed. docs/datasets.md describes the formats.

    Palm poses and hand postures of a file are kept, and only the arm is solved.
    With --take contacts only the fingertips are kept; if --object names an object,
    only the pads that touch it count. A mesh is decomposed into convex pieces and
    scaled as the data state.

    --invalid error rejects a file with invalid rows, drop skips these rows, and clip
    moves joints to their limits.

    --object-pose moves the contacts with the object. Contacts of a file without an
    object pose are in the object's frame.

    RANKED.json holds the solutions, best first, with the number of the candidate and
    the score, and the number of candidates without solution by reason.

    exit codes: 0 at least one found, 1 none (the report counts the reasons),
    2 bad input
    """
    path = Path(args.candidates)
    robot = load_robot_arg(args.robot)
    q0, pose = parse_q0(args, robot), parse_object_pose(args)
    grasps = load_candidates(
        path,
        robot,
        args.layout,
        args.hand,
        take=args.take,
        grasped=args.object,
        of=args.of,
        scale=args.scale,
        invalid=args.invalid,
    )
    check_outputs({"--out": args.out}, inputs=[path])
    solver = make_solver(args, robot)
    with located(str(path)):
        ranking = solver.choose(
            grasps,
            pose,
            q0,
            args.limit,
            args.prefer,
            args.seed,
            per_candidate=args.per_candidate,
            best_effort=bool(args.best_effort),
        )
    names = [grasp.name for grasp in grasps]
    write_json(args.out, ranking_data(ranking, names))
    notes = [*grasps.notes] + ([] if solver.scene else ["collision not checked"])
    report = ranking_report(ranking, names, path.name, report_units(args))
    output_lines = files({"--out": args.out})
    return CommandResult.of_parts(
        ranking.answered > 0, report, *(Text(f"  {note}") for note in notes), *output_lines
    )
