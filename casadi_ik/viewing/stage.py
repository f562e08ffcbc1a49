"""What every page has: light, ground, where it is seen from, how its panel looks."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import viser

from casadi_ik import palette
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array

AWAY = 1.3
"""How far the camera is, in sizes of what it looks at."""

LAMP = np.array([0.55, -0.45, 1.9])
"""From what is looked at to the lamp, in sizes of it."""

TILT = 0.36
"""How far up it is, as a part of how far it is away along the ground."""


def set_stage(server: viser.ViserServer, title: str, floor: float = 0.0) -> None:
    """Daylight, a ground with a grid of 0.1 m and 0.5 m, and the look of the panel.

    Args:
        server: The page.
        title: On the panel.
        floor: Height of the ground [m].
    """
    scene, gui = server.scene, server.gui
    scene.set_up_direction("+z")
    scene.world_axes.visible = False
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(hdri=None)
    scene.add_light_hemisphere(
        "/light/sky", sky_color=(255, 255, 255), ground_color=(214, 210, 204), intensity=2.1
    )
    scene.add_light_directional("/light/fill", intensity=0.6, position=(-2.0, 2.0, 1.0))
    scene.add_grid(
        "/ground",
        width=4.0,
        height=4.0,
        cell_size=0.1,
        section_size=0.5,
        cell_color=(226, 228, 231),
        section_color=(200, 204, 209),
        shadow_opacity=0.22,
        plane_opacity=0.0,
        position=(0.0, 0.0, floor),
    )
    gui.configure_theme(
        control_layout="collapsible",
        control_width="medium",
        show_logo=False,
        show_share_button=False,
        brand_color=palette.rgb("#2f6db3"),
    )
    gui.set_panel_label(title)


def look_at(server: viser.ViserServer, target: Array, size: float, view: Array) -> None:
    """Where a browser that opens the page looks from, and what lights what it sees.

    Args:
        server: The page.
        target: (3,) middle of what is to be seen [m].
        size: How large it is [m].
        view: (3,) from there towards the camera.
    """
    way = view / np.linalg.norm(view)
    server.initial_camera.fov = float(np.deg2rad(40.0))
    server.initial_camera.look_at = target
    server.initial_camera.position = target + AWAY * size * way
    # For its shadows the scene is drawn once more, for those of a sun three times.
    server.scene.add_light_spot(
        "/light/lamp",
        color=(255, 250, 242),
        intensity=2.2,
        decay=0.0,
        angle=0.95,
        penumbra=0.3,
        position=tuple((target + size * LAMP).tolist()),
        direction=(-LAMP[0], -LAMP[1], -LAMP[2]),
        cast_shadow=True,
    )


def look_at_robot(server: viser.ViserServer, robot: ArmHand, q: Array, wide: int = 1) -> None:
    """The robot at q, its hand in the middle and seen from where its fingertips are apart.

    Args:
        server: The page.
        robot: The robot.
        q: (n,) [rad or m].
        wide: How many robots stand side by side.
    """
    links = np.array([pose[:3, 3] for pose in robot.links(q).values()])
    tips, normals = robot.contacts(q)
    every = np.concatenate([links, tips])
    low, high = every.min(axis=0), every.max(axis=0)
    hand = tips.mean(axis=0)
    size = wide * max(float(np.linalg.norm(high - low)), 0.3)
    side = float(np.arctan2(hand[1], hand[0])) if np.hypot(*hand[:2]) > 0.05 else 0.0

    def apart(view: Array) -> float:
        flat = tips - np.outer(tips @ view, view)
        gaps = np.linalg.norm(flat[:, None] - flat[None], axis=2)
        gap = gaps[np.triu_indices(len(tips), 1)].min() if len(tips) > 1 else 0.0
        return float(gap + 0.03 * (1 - np.abs(normals @ view).max()))

    views = []
    # Two stand beside each other as seen from where they reach to.
    turns = [-75, -60, -45, -30, 30, 45, 60, 75] if wide == 1 else [-30, 30]
    for turn in np.deg2rad(turns):
        way = np.array([np.cos(side + turn), np.sin(side + turn), TILT])
        views.append(way / np.linalg.norm(way))
    share = 0.62 if wide == 1 else 0.0
    target = (1 - share) * (low + high) / 2 + share * hand
    look_at(server, target, (0.72 if wide == 1 else 0.78) * size, max(views, key=apart))


def look_at_hand(server: viser.ViserServer, robot: ArmHand, q: Array) -> None:
    """The hand alone at q, from the side that its thumb's pad is seen from."""
    links, palm = robot.links(q), robot.palm(q)
    hand = {joint.child for joint in robot.description.joints if joint.part == "hand"}
    tips, _ = robot.contacts(q)
    points = [links[link][:3, 3] for link in links if link in hand]
    every = np.concatenate([np.array([*points, palm[:3, 3]]), tips])
    low, high = every.min(axis=0), every.max(axis=0)
    size = max(float(np.linalg.norm(high - low)), 0.1)
    # Across the way from palm to thumb, along which the pads are seen from the side.
    aside = 0.35 * palm[:3, 2] + 0.25 * palm[:3, 1]
    # Of its two sides the one that is seen from above the ground.
    view = max(palm[:3, 0] + aside, aside - palm[:3, 0], key=lambda one: one[2])
    look_at(server, (low + high) / 2, 1.25 * size, view + np.array([0.0, 0.0, 0.3]))


def legend(entries: Iterable[tuple[str, str]]) -> str:
    """What the colours mean, as HTML.

    Args:
        entries: Colour and meaning.
    """
    rows = "".join(
        f'<span style="white-space:nowrap;margin-right:0.9em"><span style="display:inline-block;'
        f"width:0.75em;height:0.75em;border-radius:50%;background:{color};margin-right:0.35em;"
        f'vertical-align:-0.05em"></span>{text}</span> '
        for color, text in entries
    )
    style = f"font-size:0.75em;line-height:1.65;color:{palette.INK};padding:0.2em 1em 0.4em"
    return f'<div style="{style}">{rows}</div>'
