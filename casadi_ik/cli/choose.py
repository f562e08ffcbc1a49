"""`casadi-ik choose`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from casadi_ik.answers.solution import Ranking
from casadi_ik.api import Solver
from casadi_ik.cli.answer import Answer, Exit
from casadi_ik.cli.outputs import check_outputs, write_output
from casadi_ik.cli.question import (
    located,
    the_object_pose,
    the_options,
    the_robot,
    the_scene,
    the_start,
    the_tolerance,
)
from casadi_ik.cli.report import clearance, duration, files, headline, table
from casadi_ik.cli.solve import as_json
from casadi_ik.datasets import Candidates, load_candidates
from casadi_ik.grasps.load import grasp_data


def choose(arguments: argparse.Namespace) -> Answer:
    """Rank the answers to many grasps.

    Raises:
        CasadiIKError: Bad input, or an output that cannot be written.
    """
    path, out = Path(arguments.candidates), arguments.out
    robot = the_robot(arguments.robot)
    q0, pose = the_start(arguments, robot), the_object_pose(arguments)
    grasps = load_candidates(
        path,
        robot,
        arguments.layout,
        arguments.hand,
        take=arguments.take,
        grasped=arguments.object,
        of=arguments.of,
        scale=arguments.scale,
        invalid=arguments.invalid,
    )
    check_outputs([("--out", out)], inputs=[path])
    solver = Solver(
        robot,
        tolerance=the_tolerance(arguments),
        options=the_options(arguments),
        scene=the_scene(arguments),
    )
    with located(str(path)):
        ranking = solver.choose(
            grasps,
            pose,
            q0,
            arguments.limit,
            arguments.prefer,
            arguments.seed,
            per_candidate=arguments.per_candidate,
        )
    text = json.dumps(_ranked(ranking, grasps), indent=2, allow_nan=False) + "\n"
    write_output(out, "--out", lambda part: part.write_text(text, encoding="utf-8"))
    report = _report(path.name, solver, ranking, grasps, out)
    return Answer(report, Exit.DONE if ranking.entries else Exit.NOT_SOLVED)


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
    name: str, solver: Solver, ranking: Ranking, grasps: Candidates, out: Path
) -> RenderableType:
    found = f"{ranking.answered} of {ranking.candidates} candidates of {name} have an answer"
    seconds = sum(one.solution.time for one in ranking.entries[:1]) * ranking.candidates
    parts: list[RenderableType] = [
        headline(bool(ranking.entries), "FOUND" if ranking.entries else "NONE FOUND", found),
        *(Text(f"  {note}") for note in grasps.notes),
    ]
    if ranking.entries:
        best = table("candidate", "name", "score", "clearance", right=("score",))
        for one in ranking:
            clear = clearance(one.solution) if one.solution.clearance is not None else "not checked"
            label = grasps[one.candidate].name
            best.add_row(str(one.candidate), label, f"{one.score:.4g}", clear)
        parts += [Text(f"  by {ranking.prefer}, in {duration(seconds)}"), best]
    if solver.scene is None:
        parts.append(Text("  collision not checked"))
    parts += [Text(f"  {count} have none: {reason}") for reason, count in ranking.failures.items()]
    return Group(*parts, *files([("out", out)]))
