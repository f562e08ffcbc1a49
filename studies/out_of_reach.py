r"""Errors along a path that leaves the workspace of an arm and enters it again elsewhere.

Every frame of the path starts at the configuration of the frame before. Methods minimise the same
sum of squared errors; peers that are not installed are left out::

    python studies/out_of_reach.py --picture docs/out_of_reach.svg
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from peer_solvers import Mink, Peer, Pink, Placo

import casadi_ik as ik
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.contacts import LENGTH

TOLERANCE = ik.Tolerance(1e-3, float(2 * np.arcsin(1e-3 / LENGTH / 2)))
"""Tolerances whose ratio is that of the peers' residual: a chord of 1 counts as much as 0.1 m."""

FRAMES, OUTSIDE, SWING = 300, 0.35, np.radians(200.0)
"""Number of frames, distance beyond the first contact [m], and angle about the base [rad]."""

PEER_STEPS, MAX_CHANGE = 20, 0.7
"""Number of steps of a peer in each frame, and largest change of a motor in a step [rad]."""

DAMPINGS = (1e-6, 1e-4, 1e-2, 1e-1)
"""Damping values of the peers; the one with the smallest mean error is reported."""

PEERS: dict[str, tuple[str, Callable[[ik.ArmHand, float], Peer]]] = {
    "mink": ("mink", Mink),
    "Pink": ("pink", Pink),
    "placo": ("placo", Placo),
}
"""Package and constructor by name."""


@dataclass(frozen=True, eq=False)
class Track:
    """Configurations along a path.

    Attributes:
        q: (k, n) configurations [rad].
        seconds: Processor time of a frame [s].
    """

    q: Array
    seconds: float

    def distances(self, robot: ik.ArmHand, path: tuple[Array, Array]) -> Array:
        """Return (k,) roots of the minimised sums of squared errors [m]."""
        points, normals = robot.contacts(self.q)
        squares = (points - path[0]) ** 2 + LENGTH**2 * (normals - path[1]) ** 2
        return np.sqrt(squares.sum(axis=(1, 2)))


def path_of(robot: ik.ArmHand) -> tuple[Array, Array]:
    """Return points (k, f, 3) and normals (k, f, 3) of the path."""
    (point,), (normal,) = robot.contacts(robot.home)
    share = np.linspace(0.0, 1.0, FRAMES)
    angle = SWING * (share - np.sin(2 * np.pi * share) / (2 * np.pi))
    cosine, sine = np.cos(angle), np.sin(angle)
    rotation = np.zeros((FRAMES, 3, 3))
    rotation[:, 0, 0], rotation[:, 0, 1] = cosine, -sine
    rotation[:, 1, 0], rotation[:, 1, 1], rotation[:, 2, 2] = sine, cosine, 1.0
    stretch = 1 + OUTSIDE / np.linalg.norm(point) * np.sin(np.pi * share) ** 2
    points = stretch[:, None] * (rotation @ point)
    return points[:, None], (rotation @ normal)[:, None]


def follow(robot: ik.ArmHand, path: tuple[Array, Array], best_effort: bool | str) -> Track:
    """Follow a path with a solver; without `best_effort` unsolved frames keep the last answer."""
    solver, q, answers = ik.Solver(robot, tolerance=TOLERANCE), robot.home, []
    grasps = [
        ik.Grasp({robot.fingers[0]: ik.Contact(point[0], normal[0])})
        for point, normal in zip(*path, strict=True)
    ]
    solver.solve(grasps[FRAMES // 2], q0=q, diagnose=False, best_effort=best_effort)
    begin = time.process_time()
    for grasp in grasps:
        solution = solver.solve(grasp, q0=q, diagnose=False, prefer="q0", best_effort=best_effort)
        if best_effort or solution.success:
            q = solution.q
        answers.append(q)
    return Track(np.stack(answers), (time.process_time() - begin) / FRAMES)


def follow_by_peer(robot: ik.ArmHand, path: tuple[Array, Array], name: str) -> Track:
    """Follow a path with a peer at its best damping."""
    tracks = []
    for damping in DAMPINGS:
        peer = PEERS[name][1](robot, damping)
        q, answers = robot.home.copy(), []
        begin = time.process_time()
        for points, normals in zip(*path, strict=True):
            peer.aim(points, normals)
            for _ in range(PEER_STEPS):
                peer.contacts(q)
                change = peer.step(q)
                largest = np.abs(change).max()
                q = q + change * min(1.0, MAX_CHANGE / max(largest, MAX_CHANGE))
                q = np.clip(q, robot.lower, robot.upper)
            answers.append(q)
        tracks.append(Track(np.stack(answers), (time.process_time() - begin) / FRAMES))
    return min(tracks, key=lambda track: float(track.distances(robot, path).mean()))


def draw(errors: dict[str, Array], file: Path) -> None:
    """Draw the errors of all methods along the path."""
    figure = Figure(figsize=(8.0, 3.4), layout="constrained")
    axes = figure.subplots()
    for (name, error), style in zip(
        errors.items(), ("-", "--", ":", "-.", "-", "--"), strict=False
    ):
        axes.plot(1e3 * error, style, label=name)
    axes.set(xlabel="frame", ylabel="error [mm]", xlim=(0, FRAMES - 1))
    axes.set(yscale="log", ylim=(1.0, None))
    axes.legend(frameon=False, loc="upper left")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(file, metadata={"Date": None})


def main() -> None:
    """Follow the path with all methods, print their errors and draw them."""
    parser = argparse.ArgumentParser(description="Errors along a path out of reach.")
    parser.add_argument("--robot", default="panda", help="name of the arm")
    parser.add_argument("--picture", type=Path, help="file of the picture")
    options = parser.parse_args()
    robot = ik.load_robot(options.robot)
    path = path_of(robot)
    tracks = {
        "best_effort=True": follow(robot, path, True),
        'best_effort="local"': follow(robot, path, "local"),
        "solve, last solution kept": follow(robot, path, False),
    }
    for name, (package, _) in PEERS.items():
        if importlib.util.find_spec(package):
            tracks[name] = follow_by_peer(robot, path, name)
    errors = {name: track.distances(robot, path) for name, track in tracks.items()}
    for name, track in tracks.items():
        change = np.abs(np.diff(track.q, axis=0)).max()
        print(
            f"{name:26s} mean {1e3 * errors[name].mean():7.2f} mm, last "
            f"{1e3 * errors[name][-1]:7.2f} mm, largest change {np.degrees(change):6.1f} deg, "
            f"{1e6 * track.seconds:6.0f} us a frame"
        )
    if options.picture:
        draw(errors, options.picture)


if __name__ == "__main__":
    main()
