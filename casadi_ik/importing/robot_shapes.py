"""The shapes of a whole robot from the files of its parts."""

from __future__ import annotations

from casadi_ik.importing.fitted import fitted
from casadi_ik.importing.mounted import hand_links
from casadi_ik.importing.surfaces import Surface, link_surfaces
from casadi_ik.importing.touching import may_touch
from casadi_ik.robots.collision import Touching
from casadi_ik.robots.collision_entries import ShapeEntry
from casadi_ik.robots.description import RobotDescription
from casadi_ik.robots.part import PREFIX
from casadi_ik.robots.robot_files.tree import RobotTree


def robot_shapes(
    robot: RobotDescription, files: tuple[RobotTree | None, RobotTree]
) -> tuple[dict[str, list[ShapeEntry]], list[Touching], list[str]]:
    """Shapes by link of the robot, links that may touch, and what could not be read.

    Simple shapes stay what they are; a mesh, or what is seen of a link that says nothing of
    collisions, is held by few capsules.

    Args:
        robot: The robot, imported from the files.
        files: The arm's, if it has one of its own, and the hand's.
    """
    surfaces: dict[str, Surface] = {}
    simple: dict[str, list[ShapeEntry]] = {}
    notes: list[str] = []
    taken: set[str] = set()
    hand = hand_links(robot)
    for file in files:
        if file is None:
            continue
        ours = {link: _ours(link, robot.links, taken) for link in file.links}
        wanted = {
            link: name
            for link, name in ours.items()
            if name in robot.links and (None in files or (name in hand) == (file is files[1]))
        }
        found, said = link_surfaces(file, wanted)
        surfaces |= {wanted[link]: surface for link, surface in found.items()}
        entries = file.shapes.entries
        simple |= {wanted[link]: list(entries[link]) for link in wanted if link in entries}
        notes += said
        taken |= set(file.links)
    ordered = {link: surfaces[link] for link in robot.links if link in surfaces}
    shapes = fitted(ordered, {robot.palm_link}, simple)
    return shapes, may_touch(robot, shapes, surfaces), notes


def _ours(link: str, links: tuple[str, ...], taken: set[str]) -> str:
    """What a link of a file is called in the robot."""
    prefixed = PREFIX + link
    return prefixed if prefixed in links and link in taken else link
