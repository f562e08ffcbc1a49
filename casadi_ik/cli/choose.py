"""`casadi-ik choose`."""

from __future__ import annotations

from pathlib import Path

from rich.text import Text

from casadi_ik.answers.report import files, ranking_report
from casadi_ik.answers.stored import ranking_data
from casadi_ik.cli import options as opt
from casadi_ik.cli.inputs import (
    located,
    the_object_pose,
    the_robot,
    the_solver,
    the_start,
    the_units,
)
from casadi_ik.cli.options import Option
from casadi_ik.cli.outputs import check_outputs, write_json
from casadi_ik.cli.table import Answer, Said, command
from casadi_ik.datasets import LAYOUTS, load_candidates


@command(
    Option("CANDIDATES", "the grasps, see below"),
    opt.THE_ROBOT,
    opt.OBJECT_POSE,
    Option(
        "--layout L",
        f"of the file: {', '.join(LAYOUTS)}, table (default: detected from it)",
        read=opt.one_of(*LAYOUTS, "table"),
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
