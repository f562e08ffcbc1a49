"""Draw the figures of the concept pages, in colours for light and dark pages.

    python docs/building/figures.py

writes docs/concepts/*.svg and docs/static/social.png.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Arc, Circle, FancyArrowPatch, Polygon

DOCS = Path(__file__).parents[1]
INK, FAINT = "#7b858f", "#a9b1b8"
ARM, HAND, OBJECT = "#e08a2e", "#5f7f9f", "#6aaed6"
TARGET, REACHED, BAD = "#c99700", "#1f9d55", "#d6404b"

Point = Sequence[float]

plt.switch_backend("svg")
plt.rcParams.update({"svg.hashsalt": "casadi_ik", "font.size": 11, "mathtext.fontset": "stix"})


def stage(wide: float, high: float, widths: Sequence[float] = (1.0,)) -> tuple[Any, list[Any]]:
    """Return a figure and its panels in a row, with equal scales and without axes."""
    figure, axes = plt.subplots(
        1, len(widths), figsize=(wide, high), width_ratios=widths, layout="constrained"
    )
    panels = list(np.atleast_1d(axes))
    for panel in panels:
        panel.set_aspect("equal")
        panel.axis("off")
    return figure, panels


def chain(axes: Any, points: Sequence[Point], color: str, width: float = 6, **style: Any) -> None:
    """Draw links from point to point, with joints between them."""
    x, y = np.array(points, dtype=float).T
    axes.plot(x, y, "-", color=color, lw=width, solid_capstyle="round", zorder=3, **style)
    alpha = style.get("alpha", 1.0)
    axes.plot(x[:-1], y[:-1], "o", color=INK, ms=width * 0.95, zorder=4, alpha=alpha)


def arrow(axes: Any, tail: Point, head: Point, color: str, width: float = 2.0) -> None:
    """Draw an arrow between two points."""
    axes.add_patch(
        FancyArrowPatch(
            tail, head, arrowstyle="-|>", mutation_scale=12, color=color, lw=width,
            shrinkA=0, shrinkB=0, zorder=6,
        )
    )  # fmt: skip


def dot(axes: Any, at: Point, color: str, size: float = 7) -> None:
    """Draw the point of a contact."""
    axes.plot(*at, "o", color=color, ms=size, zorder=7)


def label(axes: Any, at: Point, text: str, color: str = INK, **style: Any) -> None:
    """Write a label at a point."""
    axes.text(*at, text, color=color, zorder=8, **{"ha": "center", "va": "center", **style})


def frame(axes: Any, at: Point, angle: float, name: str, below: float = 0.28) -> None:
    """Draw two axes of a frame, and its name."""
    for turn, color in ((0.0, BAD), (np.pi / 2, REACHED)):
        direction = 0.42 * np.array([np.cos(angle + turn), np.sin(angle + turn)])
        arrow(axes, at, np.array(at) + direction, color, 1.8)
    label(axes, (at[0], at[1] - below), name, fontsize=10)


def hand(axes: Any, alpha: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Draw a palm with two fingers around (0, 0); return fingertips and pad normals."""
    palm = np.array([[-1.5, -0.5], [-1.5, 0.5], [-1.15, 0.5], [-1.15, -0.5]])
    axes.add_patch(Polygon(palm, closed=True, fc=HAND, ec="none", alpha=alpha, zorder=3))
    for side in (1, -1):
        bent = [(-1.15, 0.45 * side), (-0.65, 1.05 * side), (0.0, 0.68 * side)]
        chain(axes, bent, HAND, 8, alpha=alpha)
    tips = np.array([(0.0, 0.6), (0.0, -0.6)])
    return tips, np.array([(0.0, -1.0), (0.0, 1.0)])


def frames() -> Any:
    """Draw frames, contacts and errors."""
    figure, (left, right) = stage(8.2, 3.3, (7.5, 5))
    base = (-5.0, -1.3)
    chain(left, [base, (-5.0, -0.2), (-3.4, 1.1), (-2.1, 0.3), (-1.5, 0.0)], ARM, 9)
    left.plot([-5.5, -4.5], [-1.42, -1.42], color=INK, lw=3)
    left.add_patch(Circle((0.0, 0.0), 0.58, fc=OBJECT, ec="none", alpha=0.75, zorder=2))
    tips, normals = hand(left)
    for tip, normal in zip(tips, normals, strict=True):
        dot(left, tip, REACHED)
        arrow(left, tip, tip + 0.48 * normal, REACHED)
    frame(left, base, 0.0, "base frame", 0.42)
    frame(left, (-1.33, 0.0), 0.0, "")
    label(left, (-2.2, -0.75), "palm frame", fontsize=10)
    label(left, (0.75, 0.95), r"contact $p_i,\ n_i$", REACHED, ha="left")
    left.plot([0.08, 0.7], [0.64, 0.9], color=FAINT, lw=0.8)
    label(left, (0.7, 0.0), "object", OBJECT, ha="left")
    label(left, (-3.6, 1.45), "arm", ARM)
    label(left, (-0.65, 1.4), "finger", HAND)
    left.set(xlim=(-5.7, 2.0), ylim=(-2.0, 1.8))

    target, actual = np.array([1.6, 0.2]), np.array([0.0, 0.0])
    tip = [(-1.3, 0.75), (-0.25, 0.12)]
    chain(right, tip, HAND, 26)
    right.plot([target[0], actual[0]], [target[1], actual[1]], ":", color=INK, lw=1.6)
    label(right, (0.85, -0.08), r"$d_i$", fontsize=14)
    for at, direction, color in (
        (target, np.array([0.62, -0.75]), TARGET), (actual, np.array([0.93, -0.36]), REACHED),
    ):  # fmt: skip
        dot(right, at, color, 9)
        arrow(right, at, at + 1.15 * direction / np.linalg.norm(direction), color)
    ghost = target + 1.15 * np.array([0.93, -0.36])
    right.plot([target[0], ghost[0]], [target[1], ghost[1]], "--", color=REACHED, lw=1.2)
    right.add_patch(Arc(target, 1.5, 1.5, theta1=-50, theta2=-21, color=INK, lw=1.4))
    label(right, np.add(target, (0.72, -0.56)), r"$\varphi_i$", fontsize=14)
    label(right, (1.7, 0.5), r"target: $p_i,\ n_i$", TARGET)
    label(right, (-0.1, -0.55), r"actual: $\hat p_i,\ \hat n_i$", REACHED)
    right.set(xlim=(-1.7, 3.0), ylim=(-1.2, 1.2))
    return figure


def palm_fit() -> Any:
    """Draw the three steps of hand first."""
    figure, panels = stage(8.6, 3.0, (2.4, 4.2, 6.0))
    titles = ("1  contacts", "2  palm and hand fitted", "3  arm in closed form")
    for number, (axes, title) in enumerate(zip(panels, titles, strict=True)):
        axes.add_patch(Circle((0.0, 0.0), 0.58, fc=OBJECT, ec="none", alpha=0.75, zorder=2))
        if number == 2:
            base = (-4.1, -1.5)
            axes.plot([-4.5, -3.7], [-1.62, -1.62], color=INK, lw=3)
            chain(axes, [base, (-4.1, -0.5), (-3.3, 1.0), (-2.1, 0.25), (-1.5, 0)], ARM, 8)
        if number == 0:
            tips, normals = np.array([(0.0, 0.6), (0.0, -0.6)]), np.array([(0, -1.0), (0, 1.0)])
        else:
            tips, normals = hand(axes)
        for tip, normal in zip(tips, normals, strict=True):
            dot(axes, tip, TARGET if number == 0 else REACHED)
            arrow(axes, tip - (0.55 * normal if number == 0 else 0 * normal),
                  tip + (0.0 if number == 0 else 0.48) * normal,
                  TARGET if number == 0 else REACHED)  # fmt: skip
        if number == 1:
            for turn in (150.0, 210.0):
                axes.add_patch(
                    Arc((-1.33, 0), 2.1, 2.1, theta1=turn, theta2=turn + 28, color=INK, lw=1.4)
                )
            label(axes, (-2.35, -1.0), "free to move", fontsize=10)
        left = (-1.2, -3.0, -4.8)[number]
        axes.set(xlim=(left, 1.2), ylim=(-1.9, 2.0))
        label(axes, ((left + 1.2) / 2, 1.85), title, fontsize=12)
    return figure


def swivel() -> Any:
    """Draw the redundancy of an arm with spherical shoulder and wrist."""
    figure, (axes,) = stage(6.2, 3.4)
    shoulder, wrist = np.array([0.0, 0.0]), np.array([4.0, 0.5])
    middle = shoulder + 0.52 * (wrist - shoulder)
    across = np.array([-(wrist - shoulder)[1], (wrist - shoulder)[0]])
    across = across / np.linalg.norm(across)
    axis = (wrist - shoulder) / np.linalg.norm(wrist - shoulder)

    def elbow(angle: float) -> np.ndarray:
        return middle + 1.45 * np.cos(angle) * across + 0.5 * np.sin(angle) * axis

    turns = np.linspace(0, 2 * np.pi, 200)
    circle = np.array([elbow(turn) for turn in turns])
    axes.plot(*circle.T, color=BAD, lw=2.2, zorder=1)
    for low, high in ((-0.7, 1.2), (2.3, 3.6)):
        free = np.array([elbow(turn) for turn in np.linspace(low, high, 80)])
        axes.plot(*free.T, color=REACHED, lw=4.5, zorder=2, solid_capstyle="round")
    chain(axes, [shoulder, elbow(2.75), wrist], ARM, 7, alpha=0.3)
    chain(axes, [shoulder, elbow(0.35), wrist], ARM, 9)
    axes.plot(*np.array([shoulder, wrist]).T, "--", color=INK, lw=1.3)
    axes.plot(*wrist, "o", color=INK, ms=10, zorder=5)
    axes.plot(*np.array([middle, elbow(0.0)]).T, color=FAINT, lw=1)
    axes.plot(*np.array([middle, elbow(0.35)]).T, color=FAINT, lw=1)
    label(axes, np.add(middle, (0.22, 0.72)), r"$\psi$", fontsize=14)
    label(axes, np.add(shoulder, (-0.28, -0.12)), r"$S$", fontsize=14)
    label(axes, np.add(wrist, (0.3, 0.05)), r"$W$", fontsize=14)
    label(axes, (0.85, 0.98), r"$a$", ARM, fontsize=14)
    label(axes, (3.35, 1.25), r"$b$", ARM, fontsize=14)
    label(axes, (4.6, 1.75), "swivels within limits", REACHED, ha="center")
    label(axes, (4.6, -0.75), "a joint beyond its limit", BAD, ha="center")
    axes.plot([2.05, 3.4], [1.7, 1.76], color=FAINT, lw=0.8)
    axes.plot([2.62, 3.2], [-0.2, -0.66], color=FAINT, lw=0.8)
    axes.set(xlim=(-0.6, 6.0), ylim=(-1.4, 2.1))
    return figure


def closed_chain() -> Any:
    """Draw arm and thumb as a closed chain."""
    figure, (axes,) = stage(6.4, 3.6)
    base, contact = (-4.6, -1.5), np.array([0.0, 0.42])
    axes.plot([-5.1, -4.1], [-1.62, -1.62], color=INK, lw=3)
    axes.plot([-0.9, 1.1], [-1.62, -1.62], color=INK, lw=3)
    axes.plot([-4.1, -0.9], [-1.62, -1.62], ":", color=INK, lw=1.5)
    axes.add_patch(Polygon([(-0.36, 0.36), (0.36, 0.36), (0.36, -1.6), (-0.36, -1.6)],
                           closed=True, fc=OBJECT, ec="none", alpha=0.75, zorder=2))  # fmt: skip
    chain(axes, [base, (-4.6, -0.2), (-3.3, 1.2), (-2.2, 0.9), (-1.5, 0.75)], ARM, 9)
    palm = np.array([[-1.55, 0.3], [-1.45, 1.25], [-1.1, 1.2], [-1.2, 0.25]])
    axes.add_patch(Polygon(palm, closed=True, fc=HAND, ec="none", zorder=3))
    chain(axes, [(-1.12, 1.15), (-0.5, 1.35), (0.0, 0.5)], HAND, 8)
    chain(axes, [(-1.2, 0.35), (-0.95, -0.35), (-0.6, -0.75)], HAND, 8, alpha=0.4)
    dot(axes, (-0.37, -0.55), TARGET)
    axes.plot([-0.56, -0.4], [-0.7, -0.58], ":", color=INK, lw=1.4)
    dot(axes, contact, REACHED, 9)
    arrow(axes, contact, contact - (0.0, 0.75), REACHED)
    axes.add_patch(Arc((0.0, 0.72), 0.9, 0.3, theta1=200, theta2=520, color=BAD, lw=2))
    arrow(axes, (0.40, 0.78), (0.36, 0.84), BAD)
    label(axes, (0.65, 0.8), "virtual joint about\nthe contact normal", BAD, ha="left")
    label(axes, (-0.35, 1.65), "thumb", HAND)
    label(axes, (-1.45, -0.55), "other\nfingers", HAND)
    label(axes, (-3.2, 1.65), "arm", ARM)
    label(axes, (-1.62, 1.55), "palm", HAND)
    loop = FancyArrowPatch((-3.9, -1.1), (-0.6, 0.35), connectionstyle="arc3,rad=-0.55",
                           arrowstyle="<|-|>", mutation_scale=12, color=FAINT, lw=1.3)  # fmt: skip
    axes.add_patch(loop)
    label(axes, (-2.75, -0.45), "closed through\nthe ground", INK)
    axes.set(xlim=(-5.3, 2.6), ylim=(-1.8, 1.95))
    return figure


def mechanisms() -> Any:
    """Draw the triangle of a lead screw, and a four-bar."""
    figure, (left, right) = stage(8.2, 3.0, (1, 1))
    joint, pivot = np.array([0.0, 0.0]), np.array([2.6, 0.0])
    crank_end = 1.25 * np.array([np.cos(1.15), np.sin(1.15)])
    left.plot(*np.array([joint, pivot]).T, color=INK, lw=5, solid_capstyle="round")
    left.plot(*np.array([joint, crank_end]).T, color=HAND, lw=7, solid_capstyle="round")
    left.plot(*np.array([joint, 1.9 * crank_end]).T, color=HAND, lw=7, alpha=0.35)
    left.plot(*np.array([pivot, crank_end]).T, color=ARM, lw=4, ls=(0, (4, 1)))
    for at in (joint, pivot, crank_end):
        left.plot(*at, "o", color="white", mec=INK, mew=2, ms=9, zorder=6)
    left.add_patch(Arc(joint, 0.9, 0.9, theta1=0, theta2=66, color=INK, lw=1.4))
    label(left, (0.62, 0.3), r"$\theta$", fontsize=14)
    label(left, (1.35, -0.25), r"$b$", fontsize=14)
    label(left, (0.08, 0.75), r"$c$", HAND, fontsize=14)
    label(left, (1.72, 0.78), r"slider $s$", ARM, fontsize=12)
    label(left, (1.2, 2.4), "lead screw", fontsize=12)
    left.set(xlim=(-0.6, 3.2), ylim=(-0.6, 2.6))

    p, q, g, h, phi = 1.5, 1.75, 0.9, 1.05, 1.0
    crank, ground = p * np.exp(1j * phi), complex(g, 0.0)
    gap = crank - ground
    cosine = (q * q + abs(gap) ** 2 - h * h) / (2 * q * abs(gap))
    rod = ground + q * np.exp(1j * (np.angle(gap) - np.arccos(cosine)))
    at = {name: np.array([z.real, z.imag]) for name, z in
          {"o": 0j, "g": ground, "p": crank, "q": rod}.items()}  # fmt: skip
    for ends, color, width in (("og", INK, 5), ("op", HAND, 7), ("gq", ARM, 4), ("pq", HAND, 7)):
        right.plot(*np.array([at[ends[0]], at[ends[1]]]).T, color=color, lw=width,
                   solid_capstyle="round")  # fmt: skip
    for joint in at.values():
        right.plot(*joint, "o", color="white", mec=INK, mew=2, ms=9, zorder=6)
    right.add_patch(Arc((0, 0), 0.8, 0.8, theta1=0, theta2=np.degrees(phi), color=INK, lw=1.4))
    turn = np.degrees(np.angle(rod - ground))
    right.add_patch(Arc((g, 0), 0.7, 0.7, theta1=0, theta2=turn, color=INK, lw=1.4))
    extension = crank + 0.75 * np.exp(1j * phi)
    right.plot(
        [crank.real, extension.real], [crank.imag, extension.imag], "--", color=FAINT, lw=1.4
    )
    last = np.degrees(np.angle(rod - crank))
    right.add_patch(
        Arc(at["p"], 0.9, 0.9, theta1=min(last, np.degrees(phi)),
            theta2=max(last, np.degrees(phi)), color=INK, lw=1.4)
    )  # fmt: skip
    right.plot([g, g + 0.6], [0, 0], "--", color=FAINT, lw=1.4)
    label(right, (0.5, 0.2), r"$\phi$", fontsize=13)
    label(right, (g + 0.48, 0.22), r"$\psi$", fontsize=13)
    label(right, np.add(at["p"], (0.6, 0.32)), r"$\theta_3$", fontsize=13)
    label(right, (0.45, -0.25), r"ground $g$", fontsize=12)
    label(right, (0.12, 0.8), r"crank $p$", HAND, fontsize=12, ha="right")
    middle = (at["g"] + at["q"]) / 2
    label(right, np.add(middle, (0.45, 0.0)), r"rod $q$", ARM, fontsize=12)
    middle = (at["p"] + at["q"]) / 2
    label(right, np.add(middle, (0.1, -0.3)), r"$h$", HAND, fontsize=13)
    label(right, (0.9, 2.4), "four-bar", fontsize=12)
    right.set(xlim=(-1.0, 3.2), ylim=(-0.6, 2.6))
    return figure


def social() -> None:
    """Draw the preview card for links to the site."""
    figure = plt.figure(figsize=(12, 6.3), dpi=100, facecolor="#161b22")
    picture = plt.imread(DOCS / "cup_dark.png")
    high, wide = picture.shape[:2]
    axes = figure.add_axes((0.37, 0.02, 0.62, 0.75))
    axes.imshow(picture[int(0.12 * high) : int(0.94 * high), int(0.405 * wide) :])
    axes.axis("off")
    figure.text(0.05, 0.86, "casadi_ik", color="#e6edf3", fontsize=40, fontweight="bold")
    words = "Inverse kinematics for robot arms with multi-fingered hands"
    figure.text(0.05, 0.79, words, color="#9aa5b1", fontsize=20)
    facts = "Fingertip contacts in,\njoint angles out:\nmicroseconds, or the\nreason why not."
    figure.text(0.05, 0.32, facts, color=ARM, fontsize=24, linespacing=1.5)
    figure.savefig(DOCS / "static" / "social.png", facecolor=figure.get_facecolor())
    plt.close(figure)


FIGURES: tuple[Callable[[], Any], ...] = (frames, palm_fit, swivel, closed_chain, mechanisms)

if __name__ == "__main__":
    for draw in FIGURES:
        figure = draw()
        path = DOCS / "concepts" / f"{draw.__name__}.svg"
        figure.savefig(path, transparent=True, bbox_inches="tight", metadata={"Date": None})
        plt.close(figure)
    social()
