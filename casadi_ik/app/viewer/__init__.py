"""Pages in the browser in which contacts are dragged and logs play; needs the extra `view`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.app.drawing.drawables import file_meshes
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import DescriptionError, InputError, MissingExtraError
from casadi_ik.files.reading import read_yaml
from casadi_ik.kinematics.arm_hand import ArmHand, load_robot
from casadi_ik.logs.solve import OneSolve
from casadi_ik.model.grasp import Grasp
from casadi_ik.planning.touch.grasps import FoundGrasp

try:
    import viser as _  # noqa: F401
except ImportError as error:
    raise MissingExtraError(
        f"views in the browser need {error.name}, which is not installed: "
        "pip install 'casadi-ik[view]'"
    ) from error

from casadi_ik.app.viewer.access import HOST, LOOPBACK, PORT, Server, Viewer, serve
from casadi_ik.app.viewer.candidates import Candidate, Candidates
from casadi_ik.app.viewer.grasp_page import GraspPage
from casadi_ik.app.viewer.pad_page import PadPage
from casadi_ik.app.viewer.page import Page
from casadi_ik.app.viewer.play_page import PlayPage, motion_track, track_of
from casadi_ik.app.viewer.request import PageRequest, Settings, request_of

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
    dark: bool = False,
) -> Viewer:
    """A page on which contacts, the object and what stands about are dragged.

    Args:
        robot: The robot.
        grasp: What is asked; None: the contacts that the robot has at q.
        q: (n,) where the robot begins [rad or m]; None: at home. With a grasp it is solved from
            there, unless q meets the contacts already.
        scene: What stands about; None: nothing is checked.
        settings: How it is solved.
        candidates: Other requests to choose from, by name.
        host: Who may see it; "0.0.0.0": everybody in the network.
        port: Where; None: the first free one from 8080 on.
        dark: Whether the page is dark at first.

    Raises:
        InputError: A finger that the robot has not, or a port that cannot be had.
        CasadiIKError: The scene does not fit the robot.
    """
    start = robot.configuration(q)
    asked = request_of(robot, grasp, start, scene, settings)
    return _shown(
        serve(host, port),
        lambda server: GraspPage(server, robot, asked, start, candidates, q is None, dark),
    )


def view_found(
    robot: ArmHand,
    found: Sequence[FoundGrasp],
    *,
    scene: Scene | None = None,
    host: str = HOST,
    port: int | None = None,
    dark: bool = False,
) -> Viewer:
    """A page on which grasps that `Solver.grasps_of` has found are filtered and looked at.

    Args:
        robot: The robot that they were found for.
        found: The grasps, best first, at least one.
        scene: What stands about; None: nothing is checked.
        host: As for `view_grasp`.
        port: As for `view_grasp`.
        dark: As for `view_grasp`.

    Raises:
        InputError: There is none, or a port that cannot be had.
    """
    if not len(found):
        raise InputError("found: there is no grasp to show, expected at least one")
    candidates = {
        f"{place}. {one.grasp.name}, load {one.load:.2f}": one for place, one in enumerate(found, 1)
    }
    first = found[0]
    return view_grasp(
        robot,
        first.grasp,
        q=first.q,
        scene=scene,
        candidates=candidates,
        host=host,
        port=port,
        dark=dark,
    )


def view_log(
    *solves: tuple[OneSolve, ArmHand],
    scene: Scene | None = None,
    host: str = HOST,
    port: int | None = None,
    dark: bool = False,
) -> Viewer:
    """A page on which one solve plays, or two side by side.

    Args:
        solves: Each with the robot that it was solved for.
        scene: What stood about the robot, which a log does not tell; None: nothing is drawn.
        host: As for `view_grasp`.
        port: As for `view_grasp`.
        dark: As for `view_grasp`.

    Raises:
        LogError: The log has kept no iterations.
        InputError: None or more than two, or a port that cannot be had.
    """
    if not 1 <= len(solves) <= 2:
        raise InputError(f"found {len(solves)} solves, expected one or two")
    tracks = [track_of(*one) for one in solves]
    return _shown(serve(host, port), lambda server: PlayPage(server, tracks, scene, dark))


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
    dark: bool = False,
) -> Viewer:
    """A page on which a motion plays, with every motor and its velocity over time.

    Args:
        robot: The robot.
        times: (k,) increasing [s].
        q: (k, n) [rad or m].
        grasp: Contacts that are drawn; None: none.
        scene: What stood about the robot; None: nothing is drawn.
        label: What the motion is called.
        host: As for `view_grasp`.
        port: As for `view_grasp`.
        dark: As for `view_grasp`.

    Raises:
        InputError: Times and positions do not fit, or a port that cannot be had.
    """
    track = motion_track(robot, np.asarray(times, float), np.asarray(q, float), label, grasp)
    return _shown(serve(host, port), lambda server: PlayPage(server, [track], scene, dark))


def view_pads(path: str | PathLike[str], *, host: str = HOST, port: int | None = None) -> Viewer:
    """A page on which the pads of an imported robot are corrected.

    Args:
        path: Its description, as `casadi-ik import` has written it.
        host: As for `view_grasp`; what others may see they may not have written, and of what is
            written from here the address has a token.
        port: As for `view_grasp`.

    Raises:
        DescriptionError: The description is malformed, or does not state its pads.
        InputError: A port that cannot be had.
    """
    file = Path(path)
    robot = load_robot(file)
    if not isinstance(read_yaml(file).get("fingers"), dict):
        raise DescriptionError(f"{file}: fingers: expected the pads of the fingers, by name")
    surfaces = file_meshes(robot.description)
    writable = host in LOOPBACK
    return _shown(
        serve(host, port, secret=writable),
        lambda server: PadPage(server, robot, file, surfaces, writable),
    )


def _shown(server: Server, page: Callable[[Server], Page]) -> Viewer:
    """A page that runs; nothing is served if it cannot be made."""
    try:
        return Viewer(server, page(server))
    except BaseException:
        server.stop()
        raise
