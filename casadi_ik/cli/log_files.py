"""`casadi-ik log export`, `finish` and `merge`: logs as other files, whole again, as one."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Group, RenderableType
from rich.text import Text

from casadi_ik import logs
from casadi_ik.arm_hand import load_robot
from casadi_ik.cli.answer import Answer
from casadi_ik.cli.log import filters, named, size
from casadi_ik.cli.log_solve import the_solve
from casadi_ik.cli.outputs import check_outputs, write_output
from casadi_ik.cli.question import located
from casadi_ik.cli.report import fields, files
from casadi_ik.errors import InputError, MissingExtraError, UnknownNameError
from casadi_ik.logs.mcap.data_section import NothingWrittenError
from casadi_ik.logs.read.files import log_files
from casadi_ik.logs.read.same_robot import check_robot
from casadi_ik.logs.repair.finish import finish_log
from casadi_ik.logs.repair.merge import merge_logs

SUFFIXES = {".mcap": "viewer", ".parquet": "parquet", ".csv": "csv"}


def export(arguments: argparse.Namespace) -> Answer:
    """Write a file for a viewer, or a table.

    Raises:
        CasadiIKError: Bad input, a missing extra, or an output that cannot be written.
    """
    out: Path = arguments.out
    kind = arguments.to or SUFFIXES.get(out.suffix.lower())
    if kind is None:
        raise InputError(f"--out: found {str(out)!r}, expected {', '.join(SUFFIXES)}, or say --to")
    return _view(arguments, out) if kind == "viewer" else _table(arguments, out, kind)


def _view(arguments: argparse.Namespace, out: Path) -> Answer:
    with located("log export", (MissingExtraError,)):
        from casadi_ik.logs.viewer.export import write_view
    from casadi_ik.logs.viewer.layout import layout_of, write_layout

    layout = out.with_suffix(".layout.json")
    check_outputs([("--out", out), ("the layout", layout)], inputs=[Path(arguments.file)])
    log = logs.open(arguments.file)
    solve = the_solve(arguments, log)
    with located(f"{arguments.file}: robot (say --robot)", (UnknownNameError,)):
        robot = load_robot(arguments.robot or solve.robot)
    check_robot(robot, log.attachment("robot.urdf").decode(), arguments.file)
    write_view(out, solve, robot)
    write_layout(layout, layout_of(solve, robot))
    return Answer(Group(*files([("viewer", out), ("layout", layout)])))


def _table(arguments: argparse.Namespace, out: Path, kind: str) -> Answer:
    check_outputs([("--out", out)], inputs=[Path(arguments.file)])
    log = logs.open(arguments.file)
    with located("log export", (MissingExtraError,)):
        frame = getattr(log, arguments.what)(**filters(arguments)).frame()
    write = frame.write_parquet if kind == "parquet" else frame.write_csv
    write_output(out, "--out", write)
    about = {"rows": f"{frame.height} {arguments.what}", "columns": str(frame.width)}
    return Answer(Group(fields(about), *files([(kind, out)])))


def finish(arguments: argparse.Namespace) -> Answer:
    """Repair logs in place; in a folder those in which nothing is whole are named and left.

    Raises:
        LogError: A file is missing, no MCAP file, or damaged elsewhere than at its end.
    """
    parts: list[RenderableType] = []
    for path, _ in (found := log_files(arguments.files)):
        name = str(path)
        try:
            done = finish_log(path)
        except NothingWrittenError:
            if len(found) == 1:
                raise
            parts += [_heading(name), fields({"done": "left as it is: nothing in it is whole"})]
            continue
        text = f"finished, {size(done.cut)} of a torn tail cut" if done.changed else "whole already"
        about = {"done": text, "holds": f"{done.chunks} chunks, {done.messages} messages"}
        parts += [_heading(name), fields(about)]
    return Answer(Group(*parts))


def merge(arguments: argparse.Namespace) -> Answer:
    """Join shards.

    Raises:
        LogError: A shard is missing, damaged, contradicts the others or doubles a solve; or the
            new log cannot be written.
    """
    out: Path = arguments.out
    check_outputs([("--out", out)], inputs=[path for path, _ in log_files(arguments.files)])
    done = merge_logs(arguments.files, out)
    solves = ", ".join(f"{count} of {method}" for method, count in done.solves.items()) or "none"
    about = {
        "shards": str(done.shards),
        "solves": solves,
        "messages": str(done.messages),
        "size": size(done.size),
    }
    if done.left_out:
        about["left out"] = named(done.left_out, "nothing in it is whole")
    return Answer(Group(fields(about), *files([("log", out)])))


def _heading(name: str) -> Text:
    return Text(name, "bold", no_wrap=True, overflow="ignore")
