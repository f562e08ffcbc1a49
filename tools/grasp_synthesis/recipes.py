"""Manual choices for each object: the pinched sides and the orientation."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Recipe:
    """Pinch and presentation of an object.

    Attributes:
        name: The object.
        part: What is pinched, in words, for the file.
        axes: Rows: the palm's x, y and z axes in the object frame before the solver turns the
            object about the palm's x axis.
        along: Where along the palm's x axis the grasp sits, from the object's middle [m].
        box_axis: For a box the axis whose faces are pinched.
        edge_margin: Distance of every contact from the object's edges [m].
        spread: Fixed spread [rad]; None leaves it to the solver where the surface leaves it free.
        up: Object axis that points up in the scene; None leaves it to the palm (balls).
        approach: "down" or "forward": where the palm faces in the scene.
        bottom: Height of the object's lowest point above the table [m].
        scene: The same in words.
    """

    name: str
    part: str
    axes: tuple[tuple[float, float, float], ...]
    up: tuple[float, float, float] | None
    approach: str
    bottom: float
    scene: str
    along: float = 0.0
    box_axis: int = 2
    edge_margin: float = 0.010
    spread: float | None = None


# Rows: palm x, y, z in the object frame.
STANDING = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
ROUND_STANDING = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0))
LYING_LONG = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
FLAT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

UP = (0.0, 0.0, 1.0)
BALL = "the ball by an even tripod (spread 60 deg), all normals through its centre"
TRIPOD = math.pi / 3

RECIPES = (
    Recipe(
        "cup",
        "across the 55 mm; the fingers, 50 mm apart, leave 5 mm to either rim",
        ROUND_STANDING,
        UP,
        "forward",
        0.38,
        "held upright, 38 cm above the table",
        edge_margin=0.0049,
    ),
    Recipe(
        "apple",
        BALL,
        FLAT,
        None,
        "down",
        0.15,
        "held 15 cm above the table, palm down",
        spread=TRIPOD,
    ),
    Recipe(
        "banana",
        "across the 36 mm, thumb inside the bend, fingers outside",
        FLAT,
        (0.0, 0.0, -1.0),
        "down",
        0.15,
        "held flat, 15 cm above the table, palm down",
    ),
    Recipe(
        "cracker_box",
        "by its two ends, 210 mm, since exactly parallel pads stay 131 mm apart (not its 60 mm)",
        LYING_LONG,
        (-1.0, 0.0, 0.0),
        "down",
        0.0,
        "lying on the table, palm down",
    ),
    Recipe(
        "tomato_soup_can",
        "across the 66 mm",
        ROUND_STANDING,
        UP,
        "forward",
        0.38,
        "held upright, 38 cm above the table",
    ),
    Recipe(
        "bleach_cleanser",
        "across the 98 mm of the body, at its middle",
        STANDING,
        UP,
        "forward",
        0.25,
        "held upright, 25 cm above the table",
    ),
    Recipe(
        "sugar_box",
        "by its two ends, 175 mm, since exactly parallel pads stay 131 mm apart (not its 39 mm)",
        LYING_LONG,
        (-1.0, 0.0, 0.0),
        "down",
        0.0,
        "lying on the table, palm down",
    ),
    Recipe(
        "mustard_bottle",
        "across the 85 mm of the body, at its middle",
        STANDING,
        UP,
        "forward",
        0.30,
        "held upright, 30 cm above the table",
    ),
    Recipe(
        "potted_meat_can",
        "across the 97 mm",
        STANDING,
        UP,
        "forward",
        0.38,
        "held upright, 38 cm above the table",
    ),
    Recipe(
        "orange",
        BALL,
        FLAT,
        None,
        "down",
        0.15,
        "held 15 cm above the table, palm down",
        spread=TRIPOD,
    ),
    Recipe(
        "mug",
        "across the 80 mm of the body, the handle away from the palm",
        ROUND_STANDING,
        UP,
        "forward",
        0.38,
        "held upright, 38 cm above the table",
    ),
    Recipe(
        "tennis_ball",
        BALL,
        FLAT,
        None,
        "down",
        0.15,
        "held 15 cm above the table, palm down",
        spread=TRIPOD,
    ),
)
