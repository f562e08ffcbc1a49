"""`casadi-ik log why` and `plot`: one solve."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.text import Text

from casadi_ik import logs
from casadi_ik.cli.answer import Answer
from casadi_ik.cli.outputs import check_outputs
from casadi_ik.cli.question import located
from casadi_ik.cli.report import files, headline
from casadi_ik.errors import MissingExtraError, UnknownNameError
from casadi_ik.logs.explain.why import explain
from casadi_ik.logs.read.one_solve import OneSolve, one_solve


def why(arguments: argparse.Namespace) -> Answer:
    """Explain one solve.

    Raises:
        LogError: The file is missing, damaged or no log of casadi_ik.
        UnknownNameError: There is no such solve, or several.
    """
    solve = the_solve(arguments, logs.open(arguments.file))
    found = explain(solve)
    parts: list[RenderableType] = [headline(solve.success, solve.status, found.headline)]
    if solve.shard:
        parts.append(Text(f"  solve {solve.number} of {solve.shard}"))
    for title, lines in (
        ("phases", found.phases),
        ("fingers", found.fingers),
        ("met on its way", found.met),
        ("verdict", found.verdict),
    ):
        if lines:
            parts.append(Text(f"  {title}", "bold"))
            parts += [Padding(Text(line), (0, 0, 0, 4)) for line in lines]
    return Answer(Group(*parts))


def plot(arguments: argparse.Namespace) -> Answer:
    """Draw one solve.

    Raises:
        LogError: The file is missing, damaged or no log of casadi_ik; or it kept no iterations.
        UnknownNameError: There is no such solve, or several.
        MissingExtraError: matplotlib is not installed.
        PictureError: The picture cannot be written.
    """
    with located("log plot", (MissingExtraError,)):
        from casadi_ik.views import draw_convergence
    log = logs.open(arguments.file)
    solve = the_solve(arguments, log)
    default = f"{Path(arguments.file).stem}-{solve.method}-{solve.solve_id}.png"
    out: Path = arguments.out or Path(default)
    check_outputs([("--out", out)], inputs=[Path(arguments.file)])
    chosen = {"method": solve.method, "solve": solve.solve_id}
    with located(f"{arguments.file}: solve {solve.solve_id}"):
        draw_convergence(
            log.iterations(**chosen),
            out,
            events=log.events(**chosen),
            tolerance=min(solve.tolerances, key=lambda each: each.position),
            span=tuple(arguments.range) if arguments.range else None,
            title=f"{solve.method} · solve {solve.solve_id} · {solve.iterations} iterations"
            f" · {solve.status}",
        )
    return Answer(Group(*files([("plot", out)])))


def the_solve(arguments: argparse.Namespace, log: logs.Log) -> OneSolve:
    """The solve that was asked for.

    Raises:
        LogError: The log is damaged.
        UnknownNameError: There is no such solve, or several; the message names the file.
    """
    try:
        return one_solve(log, arguments.solve, arguments.method)
    except UnknownNameError as error:
        text = str(error)
        where = "" if arguments.file in text else f"{arguments.file}: "
        raise UnknownNameError(f"{where}{text}") from error
