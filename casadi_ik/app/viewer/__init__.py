"""Interactive viewer in the browser: drag contacts, play logs; needs the extra `view`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import DescriptionError, InputError, optional_import

# The first missing package decides which extra the error names.
with optional_import("the viewer"):
    import viser as _  # noqa: F401

from casadi_ik.app.drawing.surfaces import join_surfaces
from casadi_ik.app.drawing.visual_meshes import file_mesh_parts
from casadi_ik.app.viewer.access import HOST, LOOPBACK, PORT, Server, Viewer, serve
from casadi_ik.app.viewer.candidates import Candidate, Candidates
from casadi_ik.app.viewer.grasp_page import GraspPage
from casadi_ik.app.viewer.pad_page import PadPage
from casadi_ik.app.viewer.page import Page
from casadi_ik.app.viewer.play_page import PlayPage, motion_playback, solve_playback
from casadi_ik.app.viewer.request import PageRequest, Settings, request_of
from casadi_ik.collision.scene import Scene
from casadi_ik.files.reading import read_yaml
from casadi_ik.kinematics.arm_hand import ArmHand, load_robot
from casadi_ik.logs.solve import SolveRecord
from casadi_ik.model.grasp import Grasp
from casadi_ik.planning.touch.found_grasps import FoundGrasp

__all__ = [
    "HOST",
    "PORT",
    "Candidate",
    "PageRequest",
    "Settings",
    "Viewer",
    "request_of",
    "view_found",
    "view_grasp",
    "view_log",
    "view_motion",
    "view_pads",
]


def view_grasp(
    robot: ArmHand,
    grasp: Grasp | None = None,
    *,
    q: ArrayLike | None = None,
    scene: Scene | None = None,
    settings: Settings | None = None,
    candidates: Candidates | None = None,
    host: str = HOST,
    port: int | None = None,
    dark: bool | None = None,
) -> Viewer:
    """Open a page on which contacts, the object and obstacles can be dragged.

    Args:
        robot: The robot.
        grasp: The grasp; None: the contacts of the robot at q.
        q: (n,) Initial configuration [rad or m]; None: home. A grasp is solved from q unless q
            meets its contacts.
        scene: Obstacles; None: collisions are not checked.
        settings: Solver settings.
        candidates: Candidate grasps by name, offered in a list.
        host: Address at which the page is served; "0.0.0.0": reachable from the network.
        port: Port; None: the first free one from 8080 on.
        dark: Use the dark theme initially; None: follow the first browser that opens the page.

    Raises:
        InputError: The grasp names an unknown finger, or the port is in use.
        CasadiIKError: The scene does not fit the robot.
    """
    start = robot.configuration(q)
    request = request_of(robot, grasp, start, scene, settings)
    return _start_page(
        serve(host, port),
        lambda server: GraspPage(server, robot, request, start, candidates, q is None, dark),
    )


def view_found(
    robot: ArmHand,
    found: Sequence[FoundGrasp],
    *,
    scene: Scene | None = None,
    host: str = HOST,
    port: int | None = None,
    dark: bool | None = None,
) -> Viewer:
    """Open a page with the grasps of `Solver.grasps_of`, with filters.

    Args:
        robot: Robot of the grasps.
        found: At least one grasp, the best first.
        scene: Obstacles; None: collisions are not checked.
        host: See `view_grasp`.
        port: See `view_grasp`.
        dark: See `view_grasp`.

    Raises:
        InputError: There are no grasps, or the port is in use.
    """
    if not len(found):
        raise InputError("found: no grasps; expected at least one")
    candidates = {
        f"{rank}. {grasp.grasp.name}, load {grasp.load:.2f}": grasp
        for rank, grasp in enumerate(found, 1)
    }
    best = found[0]
    return view_grasp(
        robot,
        best.grasp,
        q=best.q,
        scene=scene,
        candidates=candidates,
        host=host,
        port=port,
        dark=dark,
    )


def view_log(
    *solves: tuple[SolveRecord, ArmHand],
    scene: Scene | None = None,
    host: str = HOST,
    port: int | None = None,
    dark: bool | None = None,
) -> Viewer:
    """Open a page that plays one logged solve, or two next to each other.

    Args:
        solves: Logged solves, each with its robot.
        scene: Obstacles, which logs do not contain; None: none are drawn.
        host: See `view_grasp`.
        port: See `view_grasp`.
        dark: See `view_grasp`.

    Raises:
        LogError: The log has no iterations.
        InputError: The number of solves is not one or two, or the port is in use.
    """
    if not 1 <= len(solves) <= 2:
        raise InputError(f"solves: found {len(solves)}, expected one or two")
    playbacks = [solve_playback(*solve_and_robot) for solve_and_robot in solves]
    return _start_page(serve(host, port), lambda server: PlayPage(server, playbacks, scene, dark))


def view_motion(
    robot: ArmHand,
    times: ArrayLike,
    q: ArrayLike,
    *,
    grasp: Grasp | None = None,
    scene: Scene | None = None,
    label: str = "",
    host: str = HOST,
    port: int | None = None,
    dark: bool | None = None,
) -> Viewer:
    """Open a page that plays a motion, with charts of positions and velocities.

    Args:
        robot: The robot.
        times: (k,) Increasing times [s].
        q: (k, n) Configurations [rad or m].
        grasp: Contacts that are drawn; None: none.
        scene: Obstacles; None: none are drawn.
        label: Name of the motion.
        host: See `view_grasp`.
        port: See `view_grasp`.
        dark: See `view_grasp`.

    Raises:
        InputError: Times and configurations do not fit, or the port is in use.
    """
    playback = motion_playback(robot, np.asarray(times, float), np.asarray(q, float), label, grasp)
    return _start_page(serve(host, port), lambda server: PlayPage(server, [playback], scene, dark))


def view_pads(path: str | PathLike[str], *, host: str = HOST, port: int | None = None) -> Viewer:
    """Open a page on which the pads of an imported robot are corrected.

    Args:
        path: Description written by `casadi-ik import`.
        host: See `view_grasp`. Saving is possible only on a page of this machine, whose address
            then contains a token.
        port: See `view_grasp`.

    Raises:
        DescriptionError: The description is malformed, or does not list pads.
        InputError: The port is in use.
    """
    file = Path(path)
    robot = load_robot(file)
    if not isinstance(read_yaml(file).get("fingers"), dict):
        raise DescriptionError(f"{file}: fingers: expected pads by finger")
    surfaces = {
        link: join_surfaces([part.mesh for part in parts])
        for link, parts in file_mesh_parts(robot.description).items()
    }
    writable = host in LOOPBACK
    return _start_page(
        serve(host, port, secret=writable),
        lambda server: PadPage(server, robot, file, surfaces, writable),
    )


def _start_page(server: Server, page: Callable[[Server], Page]) -> Viewer:
    """Start a page, and stop its server if the page raises an error."""
    try:
        return Viewer(server, page(server))
    except BaseException:
        server.stop()
        raise
