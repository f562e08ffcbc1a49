"""Options that several commands have."""

from __future__ import annotations

import argparse

from casadi_ik.cli.values import positive


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
