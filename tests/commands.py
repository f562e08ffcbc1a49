"""The command line, `casadi-ik`, called in this process."""

from __future__ import annotations

from casadi_ik.app import viewer as viewing
from casadi_ik.app.cli.lists import schema_of
from casadi_ik.app.cli.main import main
from casadi_ik.app.cli.table import COMMANDS, GROUPS, load, parse

__all__ = ["COMMANDS", "GROUPS", "load", "main", "schema_of", "view_of"]


def view_of(*words: str) -> viewing.Viewer:
    """Return the viewer that `casadi-ik view` opens, without waiting for its end."""
    from casadi_ik.app.cli.view import open_viewer

    return open_viewer(parse(["view", *words])[1])
