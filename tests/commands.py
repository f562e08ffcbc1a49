"""The entry point of the command line, `casadi-ik`, called in this process."""

from casadi_ik.cli.main import main

__all__ = ["main"]
