"""`casadi-ik choose`, and the file of ranked answers that it writes and that others read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from casadi_ik.answers.solution import Ranking
from casadi_ik.api import Solver
from casadi_ik.arrays import Array
from casadi_ik.cli import options as opt
from casadi_ik.cli.inputs import located, the_object_pose, the_robot, the_solver, the_start
from casadi_ik.cli.outputs import check_outputs
from casadi_ik.cli.report import (
    as_json,
    clearance,
    duration,
    files,
    headline,
    table,
    write_json,
)
from casadi_ik.cli.table import Answer, Said, command
from casadi_ik.datasets import LAYOUTS, Candidates, load_candidates
from casadi_ik.errors import DescriptionError, InputError
from casadi_ik.files.limits import LIMITS, RAISED, limit
from casadi_ik.grasps import Grasp
from casadi_ik.grasps.load import GraspFile, grasp_data, grasp_of


@command(
    opt.Option("CANDIDATES", "the grasps, see below"),
    opt.needed(opt.ROBOT),
    opt.OBJECT_POSE,
    opt.Option(
        "--layout L",
        f"of the file: {', '.join(LAYOUTS)}, table",
        opt.one_of(*LAYOUTS, "table"),
        otherwise="told from it",
    ),
    opt.Option(
        "--hand FILE",
        "what the file calls the hand's joints and where it has the hand's frame: a shipped "
        "name or a YAML file",
        otherwise="the shipped one that fits the robot",
    ),
    opt.Option(
        "--take palm|contacts",
        "what a palm and a posture of a data set or table are taken for",
        default="palm",
    ),
    opt.Option(
        "--object NAME",
        "what a data set or table grasps: a shipped name, a YAML file or a mesh (in convex "
        "pieces; as large as the data say); of --take contacts only the pads that touch it "
        "count",
    ),
    opt.Option(
        "--of NAME",
        "of which object's grasps, by the file's own name, where it has those of several",
    ),
    opt.Option(
        "--scale S",
        "of which size of the object, by the file's own scale, where it has several",
        opt.positive,
    ),
    opt.Option(
        "--invalid error|drop|clip",
        "what becomes of rows of a data set or table with joints beyond their limits or with "
        "no grasp in them: the file is refused, they are left out, or joints are put at their "
        "limits",
        default="error",
    ),
    opt.SCENE,
    opt.PREFER,
    opt.Q0,
    opt.Option("--limit N", "answers at most", opt.whole(1), default=10),
    opt.Option("--per-candidate N", "answers of one candidate at most", opt.whole(1), default=1),
    opt.SEED,
    *opt.TOLERANCES,
    opt.MAX_ROUNDS,
    opt.out("RANKED.json", "write the answers", Path),
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
    write_json(said.out, _ranked(ranking, grasps))
    report = _report(path.name, solver, ranking, grasps)
    return Answer.solved(bool(ranking.entries), Group(*report, *files({"--out": said.out})))


def _ranked(ranking: Ranking, grasps: Candidates) -> dict[str, Any]:
    return {
        "candidates": ranking.candidates,
        "answered": ranking.answered,
        "prefer": ranking.prefer,
        "failures": dict(ranking.failures),
        "ranked": [
            {
                "candidate": one.candidate,
                "name": grasps[one.candidate].name,
                "score": one.score,
                "grasp": grasp_data(one.grasp),
                **({} if before is None else {"pregrasp": grasp_data(before)}),
                "solution": as_json(one.solution),
            }
            for one in ranking
            for before in (one.grasp.pregrasp,)
        ],
    }


def _report(
    name: str, solver: Solver, ranking: Ranking, grasps: Candidates
) -> list[RenderableType]:
    found = f"{ranking.answered} of {ranking.candidates} candidates of {name} have an answer"
    parts: list[RenderableType] = [
        headline(bool(ranking.entries), "FOUND" if ranking.entries else "NONE FOUND", found),
        *(Text(f"  {note}") for note in grasps.notes),
    ]
    if ranking.entries:
        seconds = ranking.entries[0].solution.time * ranking.candidates
        best = table("candidate", "name", "score", "clearance", right=("score",))
        for one in ranking:
            clear = clearance(one.solution).removeprefix("collision ")
            best.add_row(str(one.candidate), grasps[one.candidate].name, f"{one.score:.4g}", clear)
        parts += [Text(f"  by {ranking.prefer}, in {duration(seconds)}"), best]
    if solver.scene is None:
        parts.append(Text("  collision not checked"))
    return parts + [Text(f"  {n} have none: {why}") for why, n in ranking.failures.items()]


class RankedSolution(msgspec.Struct, frozen=True):
    """What is needed of an answer.

    Attributes:
        robot: Whose it is.
        q: A number per actuator [rad or m].
    """

    robot: str
    q: list[float]


class RankedEntry(msgspec.Struct, frozen=True):
    """One of the answers.

    Attributes:
        candidate: Number of its grasp among the candidates.
        score: What it was ranked by.
        solution: How to take it.
        name: Of its grasp.
        grasp: The grasp, where the object is; None in older files.
        pregrasp: The same hand before it, if the candidate said it.
    """

    candidate: int
    score: float
    solution: RankedSolution
    name: str = ""
    grasp: GraspFile | None = None
    pregrasp: GraspFile | None = None

    @property
    def label(self) -> str:
        """It in a few words."""
        return f"{self.name or 'candidate'} ({self.candidate}), score {self.score:.4g}"


class _RankedFile(msgspec.Struct, frozen=True):
    ranked: list[RankedEntry]


@dataclass(frozen=True, eq=False)
class ChosenPosture:
    """One of the answers, to be reached.

    Attributes:
        grasp: The grasp, base frame.
        q: (n,) the posture [rad or m].
        robot: Name of the robot.
    """

    grasp: Grasp
    q: Array
    robot: str


def chosen_posture(path: Path, rank: int) -> ChosenPosture:
    """One of the answers of a file.

    Args:
        path: What ``casadi-ik choose --out`` wrote.
        rank: Which, from 1.

    Raises:
        InputError: As for `read_ranked`, or there are fewer.
        DescriptionError: Its grasp is missing or malformed.
    """
    found = read_ranked(path)
    if rank > len(found):
        raise InputError(f"--rank: found {rank}, but {path} has {len(found)} answers")
    one, where = found[rank - 1], f"ranked[{rank - 1}]."
    if one.grasp is None:
        raise DescriptionError(
            f"{path}: {where}grasp: missing, expected what `casadi-ik choose` writes now"
        )
    name = one.name or f"{path.stem}[{rank - 1}]"
    grasp = grasp_of(one.grasp, path, name, f"{where}grasp.")
    if one.pregrasp is not None:
        before = grasp_of(one.pregrasp, path, name, f"{where}pregrasp.")
        grasp = replace(grasp, pregrasp=before)
    return ChosenPosture(grasp, np.array(one.solution.q), one.solution.robot)


def read_ranked(path: Path) -> list[RankedEntry]:
    """The answers of a file, best first, at least one.

    Args:
        path: What ``casadi-ik choose --out`` wrote.

    Raises:
        InputError: It cannot be read, is too large, is none of that kind, or has no answers; the
            message names file and key.
    """
    try:
        size, most = path.stat().st_size, limit(LIMITS.ranked_bytes)
        if size > most:
            raise InputError(f"{path}: found {size} bytes, expected at most {most} {RAISED}")
        found = msgspec.json.decode(path.read_bytes(), type=_RankedFile).ranked
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        text = str(error).replace("`$.", "`")
        raise InputError(f"{path}: expected what `casadi-ik choose` writes: {text}") from error
    if not found:
        raise InputError(f"{path}: ranked: found none, expected at least one answer")
    return found
