"""What can be said behind `casadi-ik log`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from casadi_ik.cli.values import file_name, one_of, whole

if TYPE_CHECKING:
    from casadi_ik.cli.answer import Answer

_EXAMPLES = """\
examples:
  casadi-ik log info cup.mcap                        what it holds
  casadi-ik log solves study/ --status STALLED       every solve that stalled, of all shards
  casadi-ik log events cup.mcap --event NEAR_SINGULAR
  casadi-ik log why cup.mcap 3                       solve 3 in words
  casadi-ik log plot cup.mcap --solve 3 --out 3.png
  casadi-ik log compare ours.mcap paper.mcap         two methods on the same targets
  casadi-ik log report study/ --out report.html      a page: success, times, the hardest solves
  casadi-ik log export cup.mcap --solve 3 --out view.mcap    for Foxglove and Lichtblick
  casadi-ik log export study/ --what solves --out solves.parquet
  casadi-ik log finish torn.mcap                     repair what a killed writer has left
  casadi-ik log merge a.mcap b.mcap --out all.mcap

A folder stands for all logs in it.
"""

_EXPORT = """\
VIEW.mcap, for Foxglove (app.foxglove.dev) and Lichtblick: one solve with the robot, its frames,
joints, contacts, phases and events, 10 ms an iteration; needs casadi-ik[viewer]. Beside it
VIEW.layout.json is written, a layout to import there.
TABLE.parquet or TABLE.csv: rows of numbers, needs casadi-ik[dataframes].
"""

MOST = 40
"""How many rows of a table are shown unless said."""

HARDEST = 200
"""How many of a study's solves can be opened in its report unless said."""


def add_log(commands: Any) -> None:
    """Add `log` and its actions to the commands."""
    log = commands.add_parser(
        "log",
        help="look into logs",
        description="Look into logs that `--log` has written.",
        epilog=_EXAMPLES,
    )
    actions = log.add_subparsers(metavar="ACTION", required=True, title="actions")
    info = _action(actions, "info", "what logs hold", _info)
    info.description = "Methods, solves, iterations, events, size and origin of logs."
    _files(info)
    for name, text, run in (
        ("solves", "list solves and how they ended", _solves),
        ("events", "list events: singularities, limits, stalls, ...", _events),
    ):
        parser = _action(actions, name, text, run)
        _files(parser)
        _filters(parser)
        parser.add_argument(
            "--most", metavar="N", type=whole(1), default=MOST, help=f"rows shown (default: {MOST})"
        )
    _add_about_one(actions)
    _add_writers(actions)


def _add_about_one(actions: Any) -> None:
    why = _action(actions, "why", "explain one solve in words", _why)
    _file(why)
    why.add_argument("solve", metavar="SOLVE", nargs="?", type=whole(0), help=_SOLVE)
    why.add_argument("--method", metavar="M", help=_METHOD)
    plot = _action(actions, "plot", "draw how one solve went (needs casadi-ik[plots])", _plot)
    _file(plot)
    _one(plot)
    plot.add_argument(
        "--out",
        metavar="FILE.png",
        type=file_name(".png"),
        help="where to (default: named after log, method and solve, in this folder)",
    )
    plot.add_argument(
        "--range",
        metavar=("FIRST", "LAST"),
        nargs=2,
        type=whole(0),
        help="iterations drawn (default: all); long runs hide what happens at their beginning",
    )
    compare = _action(actions, "compare", "two methods on the same targets", _compare)
    _files(compare)
    compare.add_argument("--solve", metavar="N", type=whole(0), help="of the first method")
    compare.add_argument(
        "--methods",
        metavar="M",
        nargs=2,
        help="which two; last on the line (default: the only two)",
    )


def _add_writers(actions: Any) -> None:
    report = _action(actions, "report", "a study as one page (needs casadi-ik[plots])", _report)
    report.description = (
        "Write a page that needs nothing but a browser: success, time and iterations by method and "
        "targets, where solves fail or meet singularities, and the hardest with their stories."
    )
    _file(report)
    report.add_argument(
        "--out", metavar="REPORT.html", type=file_name(".html"), required=True, help="where to"
    )
    report.add_argument("--title", metavar="TEXT", help="default: what the log is called")
    report.add_argument(
        "--most",
        metavar="N",
        type=whole(1),
        default=HARDEST,
        help=f"solves that can be opened (default: {HARDEST})",
    )
    export = _action(actions, "export", "write tables, or a file for a viewer", _export)
    export.epilog = _EXPORT
    _file(export)
    _filters(export)
    export.add_argument(
        "--what",
        metavar="iterations|solves|events",
        type=one_of("iterations", "solves", "events"),
        default="iterations",
        help="rows of a table (default: iterations)",
    )
    export.add_argument(
        "--to",
        metavar="viewer|parquet|csv",
        type=one_of("viewer", "parquet", "csv"),
        help="kind of file (default: what --out ends in: .mcap, .parquet or .csv)",
    )
    export.add_argument(
        "--robot", metavar="R", help="viewer: a shipped name or a YAML file (default: the log's)"
    )
    export.add_argument("--out", metavar="FILE", type=file_name(), required=True, help="where to")
    finish = _action(actions, "finish", "repair logs in place whose writer was killed", _finish)
    _files(finish)
    merge = _action(actions, "merge", "join the shards of a study, without recompressing", _merge)
    _files(merge)
    merge.add_argument("--out", metavar="FILE.mcap", type=file_name(".mcap"), required=True)


_SOLVE = "number of the solve (default: the only one)"
_METHOD = "method (default: the only one)"


def _action(actions: Any, name: str, text: str, run: Any) -> argparse.ArgumentParser:
    parser = actions.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
    parser.set_defaults(run=run)
    return parser


def _files(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("files", metavar="FILE", nargs="+", help="logs, or folders of logs")


def _file(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="a log, or a folder of shards")


def _one(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--solve", metavar="N", type=whole(0), help=_SOLVE)
    parser.add_argument("--method", metavar="M", help=_METHOD)


def _filters(parser: argparse.ArgumentParser) -> None:
    _one(parser)
    for name, text in (
        ("status", "of the solve, e.g. STALLED"),
        ("event", "solves in which one happened, and those events, e.g. NEAR_SINGULAR"),
        ("phase", "solves, iterations and events in it, e.g. hand-alignment"),
    ):
        parser.add_argument(f"--{name}", metavar=name[0].upper(), help=text)


def _info(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.log import info

    return info(arguments)


def _solves(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.log import solves

    return solves(arguments)


def _events(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.log import events

    return events(arguments)


def _why(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.log_solve import why

    return why(arguments)


def _plot(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.log_solve import plot

    return plot(arguments)


def _compare(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.log_compare import compare

    return compare(arguments)


def _report(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.log_report import report

    return report(arguments)


def _export(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.log_files import export

    return export(arguments)


def _finish(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.log_files import finish

    return finish(arguments)


def _merge(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.log_files import merge

    return merge(arguments)
