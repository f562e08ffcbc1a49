"""Pages used by mouse in a browser."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from bench_view import NO_PAINTING
from browser import CHROMIUM, Browser, Page
from scipy.spatial.transform import Rotation

import casadi_ik as ik

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium (Debian: apt chromium)"),
]

WINDOW = (700, 420)

KNOWN_COMPLAINTS = (
    "THREE.Clock",
    "KHR_parallel_shader_compile",
    "GPU stall",
    "RenderTargets",
    "preventDefault",
)
"""Messages of viser's client, and of a browser without a graphics card."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser() as chromium:
        yield chromium


def opened(browser: Browser, viewer: Any, painted: bool = False) -> tuple[Page, Any]:
    """The page, and the camera of its browser as the server knows it, once it has drawn.

    Without a graphics card painting takes most of the time: it is left out unless it is asked for.
    """
    page = browser.open("about:blank", *WINDOW)
    if not painted:
        page.call("Page.addScriptToEvaluateOnNewDocument", source=NO_PAINTING)
    viewer._server.scene.add_light_directional("/light/lamp", position=(0.9, -0.7, 3.2))
    page.go(viewer.url)
    page.wait("document.querySelector('canvas') !== null")
    server, end = viewer._server, time.monotonic() + 180
    while not server.get_clients() and time.monotonic() < end:
        time.sleep(0.1)
    client = list(server.get_clients().values())[-1]
    page.wait("document.querySelector('.ik-status, .ik-iteration, .ik-pad') !== null")
    # A note about the missing graphics card covers the picture.
    page.evaluate("document.querySelector('.mantine-Notification-closeButton')?.click()")
    return page, client


def pixel(page: Page, client: Any, point: np.ndarray) -> np.ndarray:
    """Return the position of a point of the base frame on the page [CSS pixels]."""
    box = page.evaluate(
        "(({x, y, width, height}) => [x, y, width, height])"
        "(document.querySelector('canvas').getBoundingClientRect())"
    )
    camera = client.camera
    to_camera = Rotation.from_quat(camera.wxyz, scalar_first=True).inv()
    point_in_camera = to_camera.apply(point - camera.position)
    focal = box[3] / 2 / np.tan(camera.fov / 2)
    return (
        np.array(box[:2]) + np.array(box[2:]) / 2 + focal * point_in_camera[:2] / point_in_camera[2]
    )


def drag_along(page: Page, client: Any, view: Any, name: str, distance: float) -> None:
    """Drag the arrow of a handle that appears longest by a distance [m]."""
    pose, size = view.request.poses[name], view._handles._controls[name].handle.scale
    start_pixel = pixel(page, client, pose[:3, 3])
    tips = [pixel(page, client, pose[:3, 3] + size * pose[:3, i]) for i in range(3)]
    axis = int(np.argmax([np.linalg.norm(tip - start_pixel) for tip in tips]))
    start = start_pixel + 0.92 * (tips[axis] - start_pixel)
    end = start + distance / size * (tips[axis] - start_pixel)
    page.drag((float(start[0]), float(start[1])), (float(end[0]), float(end[1])), steps=4)


def complaints(page: Page) -> list[str]:
    return [
        complaint
        for complaint in page.complaints
        if not any(known_text in complaint for known_text in KNOWN_COMPLAINTS)
    ]


def text_of(page: Page, of: str) -> str:
    return page.evaluate(f"document.querySelector('{of}')?.innerText ?? ''")


def press(page: Page, label: str, of: str = "button") -> None:
    """Press the element with a label by mouse, once it does not move."""
    rectangle = (
        f"(() => {{ const b = [...document.querySelectorAll({of!r})]"
        f".find(b => b.innerText.trim() === {label!r}); b?.scrollIntoView({{block: 'center'}});"
        " const r = b?.getBoundingClientRect();"
        " return r && r.width && [r.x + r.width / 2, r.y + r.height / 2]; })()"
    )
    place, place_before = page.wait(rectangle), None
    while place != place_before:
        time.sleep(0.3)
        place, place_before = page.wait(rectangle), place
    page.click(*place)


def arrived(file: Path) -> None:
    """Wait until the browser has saved a file."""
    end = time.monotonic() + 180
    while not file.is_file() and time.monotonic() < end:
        time.sleep(0.05)
    assert file.is_file(), sorted(path.name for path in file.parent.iterdir())


def test_dragged_object_and_contact_are_reached(cup: Any, browser: Browser) -> None:
    page, client = opened(browser, cup)
    time.sleep(1.5)  # the camera comes to rest
    assert text_of(page, ".ik-status") == "SOLVED"
    view, robot = cup.page, cup.page.robot
    # The object is the first handle, and moves its contacts.
    place = view.request.object_pose[:3, 3]
    point_before = view.request.grasp.contacts["thumb"].point
    drag_along(page, client, view, "object", 0.02)
    page.wait("document.querySelector('.ik-status') !== null")
    assert view.work.settle(300)
    shift = view.request.object_pose[:3, 3] - place
    assert 0.004 < np.linalg.norm(shift) < 0.06
    assert np.allclose(view.request.grasp.contacts["thumb"].point - point_before, shift, atol=1e-9)
    assert view.result.success
    view.select("thumb")
    assert view.work.settle(300)
    time.sleep(0.5)
    point_before = view.request.grasp.contacts["thumb"].point
    drag_along(page, client, view, "thumb", 0.012)
    page.wait("document.querySelector('.ik-status') !== null")
    assert view.work.settle(300)
    point_target = view.request.grasp.contacts["thumb"].point
    assert 0.002 < np.linalg.norm(point_target - point_before) < 0.04
    assert view.result.success
    tip = robot.contacts(view.result.q)[0][robot.fingers.index("thumb")]
    assert np.linalg.norm(tip - point_target) <= 5e-3
    # After a long drag, the page states the reason of the failure.
    drag_along(page, client, view, "thumb", 0.3)
    page.wait("(document.querySelector('.ik-why')?.innerText ?? '').includes('the contacts')")
    assert view.work.settle(300)
    assert not view.result.success
    assert text_of(page, ".ik-status") == view.result.headline
    assert complaints(page) == []
    page.close()


def test_two_browsers_share_one_drag(cup: Any, browser: Browser, tmp_path: Path) -> None:
    second_page, _ = opened(browser, cup)
    page, _ = opened(browser, cup, painted=True)
    view = cup.page
    text_before = text_of(second_page, ".ik-finger")
    pose = view.request.contacts["thumb"].control.copy()
    pose[:3, 3] += [0.006, 0.0, 0.01]
    view.drag("thumb", pose)
    finger_text = "document.querySelector('.ik-finger').innerText"
    for browser_page in (second_page, page):
        browser_page.wait(f"{finger_text} !== {text_before!r}")
    assert text_of(page, ".ik-finger") == text_of(second_page, ".ik-finger")
    second_page.close()
    # The saved grasp is the current one, and is solved alone.
    page.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    press(page, "Files", "[role=tab]")
    press(page, "Save grasp (YAML)")
    press(page, "Export picture (PNG)")
    grasp, picture = tmp_path / "cup.yaml", tmp_path / "cup.png"
    arrived(grasp)
    arrived(picture)
    saved = ik.load_grasp(grasp)
    assert np.allclose(saved.contacts["thumb"].point, view.request.grasp.contacts["thumb"].point)
    assert ik.Solver(ik.load_robot(saved.robot)).solve(saved).success
    image = plt.imread(picture)
    assert image.shape[:2] == (1000, 1600)
    assert len(np.unique(image.reshape(-1, image.shape[2]), axis=0)) > 100
    assert complaints(page) == []
    page.close()
