"""Pages used by mouse in a real browser."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import CHROMIUM, Browser, Page

import casadi_ik as ik
from casadi_ik.viewing import Viewer, view_log
from casadi_ik.viewing.drawn_contacts import SIZE
from casadi_ik.viewing.frames import pose_of

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium (Debian: apt chromium)")

WINDOW = (700, 420)

KNOWN = ("THREE.Clock", "KHR_parallel_shader_compile", "GPU stall")
"""What viser's client says of itself and of a browser without a graphics card."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser() as one:
        yield one


def opened(browser: Browser, viewer: Viewer) -> tuple[Page, Any]:
    """The page, and the camera of its browser as the server knows it, once it has drawn."""
    # Without a graphics card shadows take most of the time.
    viewer._server.scene.add_light_directional("/light/lamp", position=(0.9, -0.7, 3.2))
    page = browser.open(viewer.url, *WINDOW)
    page.wait("document.querySelector('canvas') !== null")
    server, end = viewer._server, time.monotonic() + 30
    while not server.get_clients() and time.monotonic() < end:
        time.sleep(0.1)
    (client,) = server.get_clients().values()
    page.wait("document.body.innerText.length > 40")
    time.sleep(2.0)  # the camera comes to rest
    return page, client


def pixel(page: Page, client: Any, point: np.ndarray) -> np.ndarray:
    """Where a point of the base frame is on the page [CSS pixels]."""
    box = page.evaluate(
        "(({x, y, width, height}) => [x, y, width, height])"
        "(document.querySelector('canvas').getBoundingClientRect())"
    )
    camera = client.camera
    seen = np.linalg.inv(pose_of(camera.position, camera.wxyz)) @ np.append(point, 1.0)
    focal = box[3] / 2 / np.tan(camera.fov / 2)
    return np.array(box[:2]) + np.array(box[2:]) / 2 + focal * seen[:2] / seen[2]


def drag_along(page: Page, client: Any, pose: np.ndarray, far: float) -> None:
    """Drag that arrow of a control at a pose that is seen longest, so far [m]."""
    here = pixel(page, client, pose[:3, 3])
    tips = [pixel(page, client, pose[:3, 3] + SIZE * pose[:3, i]) for i in range(3)]
    axis = int(np.argmax([np.linalg.norm(tip - here) for tip in tips]))
    start = here + 0.92 * (tips[axis] - here)
    end = start + far / SIZE * (tips[axis] - here)
    page.drag((float(start[0]), float(start[1])), (float(end[0]), float(end[1])), steps=4)


def complaints(page: Page) -> list[str]:
    return [one for one in page.complaints if not any(known in one for known in KNOWN)]


def said(page: Page, of: str) -> str:
    return page.evaluate(f"document.querySelector('{of}')?.innerText ?? ''")


def test_a_contact_is_dragged_by_mouse_and_reached(cup: Viewer, browser: Browser) -> None:
    page, client = opened(browser, cup)
    assert said(page, ".ik-status") == "SOLVED"
    shown, robot = cup.page, cup.page.robot
    before = shown.asked.grasp.contacts["thumb"].point
    drag_along(page, client, shown.asked.held["thumb"].control, 0.012)
    page.wait("document.querySelector('.ik-status') !== null")
    assert shown.work.settle()
    wanted = shown.asked.grasp.contacts["thumb"].point
    assert 0.002 < np.linalg.norm(wanted - before) < 0.04
    assert shown.answer.success
    tip = robot.contacts(shown.answer.q)[0][robot.fingers.index("thumb")]
    assert np.linalg.norm(tip - wanted) <= 5e-3
    # And far away: why not is on the page.
    drag_along(page, client, shown.asked.held["thumb"].control, 0.3)
    page.wait("(document.querySelector('.ik-why')?.innerText ?? '').includes('the contacts')")
    assert shown.work.settle()
    assert not shown.answer.success
    assert said(page, ".ik-status") == shown.answer.headline
    assert complaints(page) == []
    page.close()


def test_a_log_is_played_by_mouse(robot: ik.ArmHand, tmp_path: Path, browser: Browser) -> None:
    path = tmp_path / "cup.mcap"
    ik.Solver(robot).solve(ik.load_grasp("cup"), log=path)
    viewer = view_log((ik.logs.one_solve(ik.logs.open(path)), robot))
    page, _ = opened(browser, viewer)
    assert "iteration 0 of" in said(page, ".ik-iteration")
    x, y = page.evaluate(
        "(() => { const b = [...document.querySelectorAll('button')]"
        ".find(b => b.innerText === 'Play').getBoundingClientRect();"
        " return [b.x + b.width / 2, b.y + b.height / 2]; })()"
    )
    page.click(x, y)
    last = viewer.page.count - 1
    page.wait(f"document.querySelector('.ik-iteration').innerText.includes('iteration {last} of')")
    page.wait("document.body.innerText.includes('SOLVED')")
    assert np.array_equal(viewer.page._shown[0][0].q, viewer.page.tracks[0].q[-1])
    assert complaints(page) == []
    viewer.stop()
    page.close()
