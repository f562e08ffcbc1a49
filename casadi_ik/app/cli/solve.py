"""`casadi-ik solve` and `casadi-ik choose`: one grasp, and the best of many."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.text import Text

from casadi_ik.app.cli import options as opt
from casadi_ik.app.cli.inputs import (
    located,
    the_fixed,
    the_grasp,
    the_object_pose,
    the_robot,
    the_solver,
    the_start,
    the_units,
)
from casadi_ik.app.cli.options import Option
from casadi_ik.app.cli.outputs import check_outputs, write_json
from casadi_ik.app.cli.table import Answer, Said, command
from casadi_ik.app.report import duration, files, ranking_report, solution_report
from casadi_ik.collision.clearance import SceneCheck
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import CasadiIKError, MissingExtraError
from casadi_ik.integrations.datasets import LAYOUT_NAMES, load_candidates
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.objects import load_object
from casadi_ik.solve.request import Request, tolerances_by_finger
from casadi_ik.solve.solution import Solution
from casadi_ik.solve.solution_files import ranking_data, solution_data

REPEATED_FOR = 0.2
"""How long a solve is repeated to time it [s], unless one alone takes longer."""

SLOW = 1.0
"""A first solve that takes longer [s], where others do not, is told of."""


@command(
    opt.GRASP,
    opt.ROBOT,
    *opt.SOLVER,
    Option("--out FILE.json", "write the solution as JSON", read=opt.json_name),
    opt.picture("--picture", "draw the grasp"),
    opt.picture("--picture-dark", "the same for a dark page"),
    opt.diagnose(default=True),
    opt.SIZE_LIMITS,
)
def solve(said: Said) -> Answer:
    """Find the position of every motor for one grasp.

    Examples:
      casadi-ik solve cup
      casadi-ik solve cup --method enhanced-dls --out cup.json --log cup.mcap
      casadi-ik solve cup --scene table --picture cup.png
      casadi-ik solve my.yaml --robot mine.yaml --tolerance-position 2 --mm

    a grasp file:
      robot: kuka_lwr_barrett
      contacts:   # point [m], outward pad normal, in the robot's base frame
        thumb:    {point: [-0.83, 0.15, 0.41], normal: [0.48, -0.88, 0]}
        finger_2: {point: [-0.84, 0.11, 0.435], normal: [0.72, 0.70, 0]}
        finger_3: {point: [-0.84, 0.11, 0.385], normal: [0.72, 0.70, 0]}

    exit codes: 0 solved, 1 not solved (the report says why), 2 bad input
    """
    path, grasp = the_grasp(said)
    robot = the_robot(said.robot, path, grasp)
    q0, fixed = the_start(said, robot), the_fixed(said, robot)
    with located(str(path)):
        grasp.arrays(robot.fingers)
    pictures = {"--picture": said.picture, "--picture-dark": said.picture_dark}
    outputs = {"--log": said.log, "--out": said.out, **pictures}
    check_outputs(outputs, inputs=[path])
    draw = _drawing(path, grasp) if any(pictures.values()) else None
    solver = the_solver(said, robot)

    def solved(log: Path | None = None, diagnose: bool = False) -> Solution:
        return solver.solve(grasp, q0, said.seed, log, diagnose, fixed, said.prefer)

    with located(str(path)):
        solution = solved(said.log, said.diagnose)
    first, solution = solution.time, replace(solution, time=_warm_time(solved, solution))
    if said.out is not None:
        write_json(said.out, solution_data(solution))
    for option, file in pictures.items():
        if draw is not None and file is not None:
            dark = option == "--picture-dark"
            draw(robot, solution, grasp, file, scene=solver.scene, dark=dark)
    notes = [] if said.scene else _penetration(robot, grasp, solution)
    if first > max(10 * solution.time, SLOW):
        notes.append(f"the first solve took {duration(first)}: kernels were compiled or loaded")
    name, enforced = grasp.name or str(path), solver.limits == "enforce"
    report = solution_report(solution, robot, name, the_units(said), enforced, notes)
    return Answer.solved(solution.success, report, *files(outputs))


def _warm_time(solved: Callable[[], Solution], solution: Solution) -> float:
    """How long a solve takes where nothing has to be compiled or loaded [s].

    What was not solved is not solved again: it takes its time.
    """
    times = [solution.time]
    while solution.success and len(times) < 4 and sum(times[1:]) < REPEATED_FOR:
        times.append(solved().time)
    return min(times)


def _penetration(robot: ArmHand, grasp: Grasp, solution: Solution) -> list[str]:
    """That an answer penetrates the object it grasps, if it does and that is known."""
    shapes = robot.description.shapes.capsules
    if not (solution.success and grasp.object and grasp.object_pose is not None and shapes):
        return []
    request = Request(robot, tolerances_by_finger(None, robot.fingers), True)
    try:
        check = SceneCheck(robot, Scene(), compiled=False)
        query = check.collision_query(request.of_grasps([grasp], None))
    except CasadiIKError:  # a robot or an object without shapes
        return []
    mine = np.array([grasp.object in names for names in query.table.names], dtype=bool)
    clear = query.with_table(query.table.select(mine)).check(solution.q[None])
    pair = clear.pair(0)
    if clear.free[0] or pair is None:
        return []
    depth = -1e3 * float(clear.distance[0])
    return [f"the shapes of {pair[0]} and {pair[1]} overlap by {depth:.3g} mm; try --scene table"]


def _drawing(path: Path, grasp: Grasp) -> Callable[..., Any]:
    """The function that draws a solution, after making sure that it can.

    Raises:
        MissingExtraError: matplotlib is not installed.
        CasadiIKError: The grasp names an object that there is not, or a malformed one.
    """
    with located("--picture", (MissingExtraError,)):
        from casadi_ik.app.pictures import draw_solution
    if grasp.object:
        with located(f"{path}: object.name"):
            load_object(grasp.object)
    return draw_solution


@command(
    Option("CANDIDATES", "the grasps, see below"),
    opt.THE_ROBOT,
    opt.OBJECT_POSE,
    Option(
        "--layout L",
        f"of the file: {', '.join(LAYOUT_NAMES)} (default: detected from it)",
        read=opt.one_of(*LAYOUT_NAMES),
    ),
    Option(
        "--hand FILE",
        "what the file calls the hand's joints and where it has the hand's frame: a shipped "
        "name or a YAML file (default: the shipped one that fits the robot)",
    ),
    Option(
        "--take palm|contacts",
        "what a palm and a posture of a data set or table are taken for",
        "palm",
    ),
    Option(
        "--object NAME",
        "what a data set or table grasps: a shipped name, a YAML file or a mesh (in convex "
        "pieces; as large as the data say); of --take contacts only the pads that touch it "
        "count",
    ),
    Option(
        "--of NAME",
        "of which object's grasps, by the file's own name, where it has those of several",
    ),
    Option(
        "--scale FACTOR",
        "of which size of the object, by the file's own scale, where it has several",
    ),
    Option(
        "--invalid error|drop|clip",
        "what becomes of rows of a data set or table with joints beyond their limits or with "
        "no grasp in them: the file is refused, they are left out, or joints are put at their "
        "limits",
        "error",
    ),
    opt.SCENE,
    opt.PREFER,
    opt.Q0,
    Option("--limit N", "answers at most", 10),
    Option("--per-candidate N", "answers of one candidate at most", 1),
    opt.SEED,
    *opt.TOLERANCES,
    opt.MAX_ROUNDS,
    opt.out("RANKED.json", "write the answers", opt.json_name),
    opt.SIZE_LIMITS,
)
def choose(said: Said) -> Answer:
    r"""Of many grasps find those that are best to take, and how.

    Examples:
      casadi-ik choose candidates.yaml --robot panda+allegro_right --scene table \
          --out ranked.json
      casadi-ik choose grasps/ --robot R --object-pose 0.5 0 0.1 0 0 1.57 \
          --prefer q0 --out ranked.json

    CANDIDATES is one of
      a YAML file with a list of grasps, each as a grasp file has it:
        candidates:
          - contacts: {thumb: {point: [0.02, 0.1, 0], normal: [0, -1, 0]}, ...}
          - contacts: ...
      a folder of grasp files
      an npz file with points and normals (k, f, 3), as for `casadi-ik batch`
      an npy file of getagrip, dexgraspnet, bodex, dexgraspbench or dexonomy: palms
        and hands are as they are there, only the arm is looked for (--take
        contacts: only the fingertips are)
      a pt file of multidex, the same; --of says of which of its objects
      a table (.csv, .npz, .parquet) with columns x y z, qw qx qy qz or roll pitch
        yaw (where the robot's palm frame is to be) and the hand's joints by name
    Nothing in a file is run. docs/choosing.md says what is in them.

    RANKED.json holds the answers, best first, each with the number of its candidate
    and its score, and how many candidates have none, by reason.

    exit codes: 0 at least one found, 1 none (the report counts the reasons),
    2 bad input
    """
    path = Path(said.candidates)
    robot = the_robot(said.robot)
    q0, pose = the_start(said, robot), the_object_pose(said)
    grasps = load_candidates(
        path,
        robot,
        said.layout,
        said.hand,
        take=said.take,
        grasped=said.object,
        of=said.of,
        scale=said.scale,
        invalid=said.invalid,
    )
    check_outputs({"--out": said.out}, inputs=[path])
    solver = the_solver(said, robot)
    with located(str(path)):
        ranking = solver.choose(
            grasps,
            pose,
            q0,
            said.limit,
            said.prefer,
            said.seed,
            per_candidate=said.per_candidate,
        )
    names = [grasp.name for grasp in grasps]
    write_json(said.out, ranking_data(ranking, names))
    notes = [*grasps.notes] + ([] if solver.scene else ["collision not checked"])
    report = ranking_report(ranking, names, path.name, the_units(said))
    written = files({"--out": said.out})
    return Answer.solved(
        bool(ranking.entries), report, *(Text(f"  {note}") for note in notes), *written
    )
