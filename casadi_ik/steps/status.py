"""How an iteration, and with it a solve, can end; and the phases it goes through."""

from __future__ import annotations

from enum import IntEnum


class Status(IntEnum):
    """How a solve ended. Not converging is a status, never an exception."""

    INVALID = -1
    """A number was no longer finite; the last finite configuration is returned."""
    RUNNING = 0
    """Not ended yet (a step's status only)."""
    SOLVED = 1
    """Every contact within tolerance, every actuator and joint within limits if enforced."""
    STALLED = 2
    """The iteration stands still away from the contacts."""
    ITERATION_LIMIT = 3
    """The budget of iterations is used up."""
    UNREACHABLE = 4
    """The contacts cannot be reached; the verdict says why."""


class Phase(IntEnum):
    """What an iteration is working on."""

    THUMB_REACHING = 1
    HAND_ALIGNMENT = 2
    REFINEMENT = 3
