"""Options that several commands have."""

from __future__ import annotations

import argparse

from casadi_ik.cli.values import file_name, numbers, positive, whole


def add_tolerances(parser: argparse.ArgumentParser) -> None:
    """When a contact counts as reached."""
    parser.add_argument(
        "--tolerance-position",
        metavar="METRES",
        type=positive,
        help="when a contact point counts as reached (default: 0.005)",
    )
    parser.add_argument(
        "--tolerance-angle",
        metavar="RADIANS",
        type=positive,
        help="when a contact normal counts as reached (default: 0.0524, 3 deg)",
    )


def add_effort(parser: argparse.ArgumentParser) -> None:
    """How long a target is tried."""
    parser.add_argument(
        "--max-rounds",
        metavar="N",
        type=whole(1),
        help="rounds of hand postures at most before a target is given up; 1 solves nearly all "
        "that can be reached (default: as many as may help)",
    )


def add_scene(parser: argparse.ArgumentParser, more: str = "") -> None:
    """What must not be touched, and what else it is for."""
    parser.add_argument(
        "--scene",
        metavar="FILE",
        help=f"what must not be touched{more}: a shipped name or a YAML file (default: nothing is "
        "checked)",
    )


def add_object_pose(parser: argparse.ArgumentParser, moves: str = "") -> None:
    """Where the object is, and what that moves."""
    parser.add_argument(
        "--object-pose",
        metavar="X",
        type=numbers,
        nargs="+",
        help=f"where the object is: x y z [m] roll pitch yaw [rad] in the base frame{moves}",
    )


def add_motion(parser: argparse.ArgumentParser) -> None:
    """Where a motion goes."""
    parser.add_argument(
        "--out",
        metavar="MOTION.mcap",
        type=file_name(".mcap", ".npz", ".csv"),
        required=True,
        help="write the motion",
    )


def add_size_limits(parser: argparse.ArgumentParser) -> None:
    """How large a file of somebody else may be."""
    parser.add_argument(
        "--size-limits",
        metavar="FACTOR",
        type=positive,
        help="allow files that are so many times as large as usual, packed and unpacked",
    )
