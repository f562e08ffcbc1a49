"""From the mouse to the drawn answer: how long a dragged contact takes in the browser.

A contact's control on the page of the shipped cup is dragged by mouse in Chromium, one step after
the other. Of every step the time is taken in the page from the pointer's event until the frame
after the verdict has changed is drawn; and on the server from the control's message until the
answer is handed to the socket. Without a graphics card the browser draws in software, which takes
most of the time: that of a frame is told beside; --plain leaves the shadows out.

    python studies/view_latency.py [--steps 40] [--scene table] [--plain]
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import casadi_ik as ik
from casadi_ik.viewing import view_grasp
from casadi_ik.viewing.drawn_contacts import SIZE
from casadi_ik.viewing.frames import pose_of

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

WATCH = """(() => {
  window.took = []; window.told = []; window.moved = 0;
  addEventListener('pointermove', () => { window.moved = performance.now(); }, true);
  const told = n => n.querySelector && n.querySelector('.ik-status') !== null;
  new MutationObserver(records => {
    const from = window.moved;
    if (!from || !records.some(r => told(r.target) || [...r.addedNodes].some(told))) return;
    window.moved = 0;
    window.told.push(performance.now() - from);
    requestAnimationFrame(() => setTimeout(() => window.took.push(performance.now() - from)));
  }).observe(document.body, {subtree: true, childList: true, characterData: true});
  return true; })()"""

FRAMES = """new Promise(done => { const at = []; const tick = t => { at.push(t);
  at.length < 6 ? requestAnimationFrame(tick) : done((at[5] - at[0]) / 5); };
  requestAnimationFrame(tick); })"""


def main() -> None:
    """Measure and print."""
    from browser import Browser

    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--scene")
    parser.add_argument("--plain", action="store_true")
    asked = parser.parse_args()
    scene = asked.scene and ik.load_scene(asked.scene)
    viewer = view_grasp(ik.load_robot("kuka_lwr_barrett"), ik.load_grasp("cup"), scene=scene)
    page_of_server, served = viewer.page, []
    put, draw = page_of_server.work.put, page_of_server.draw
    begun = [0.0]

    def told(key: str, change: Callable[[], None]) -> None:
        begun[0] = time.perf_counter()
        put(key, change)

    def drawn(answer: object) -> None:
        draw(answer)
        if begun[0]:
            served.append(time.perf_counter() - begun[0])
            begun[0] = 0.0

    page_of_server.draw, page_of_server.work.put = drawn, told
    if asked.plain:
        viewer._server.scene.add_light_directional("/light/lamp", position=(0.9, -0.7, 3.2))
    with Browser() as browser:
        page = browser.open(viewer.url, 700, 420)
        page.wait("document.querySelector('.ik-status') !== null")
        time.sleep(4.0)
        (client,) = viewer._server.get_clients().values()
        box = page.evaluate(
            "(({x, y, width, height}) => [x, y, width, height])"
            "(document.querySelector('canvas').getBoundingClientRect())"
        )
        pose = page_of_server.asked.held["thumb"].control

        def pixel(point: np.ndarray) -> np.ndarray:
            camera = client.camera
            seen = np.linalg.inv(pose_of(camera.position, camera.wxyz)) @ np.append(point, 1.0)
            focal = box[3] / 2 / np.tan(camera.fov / 2)
            return np.array(box[:2]) + np.array(box[2:]) / 2 + focal * seen[:2] / seen[2]

        here = pixel(pose[:3, 3])
        tips = [pixel(pose[:3, 3] + SIZE * pose[:3, i]) for i in range(3)]
        way = max((tip - here for tip in tips), key=lambda one: float(np.linalg.norm(one)))
        start, held = here + 0.92 * way, {"button": "left", "buttons": 1}
        frame = page.evaluate(FRAMES)
        page.mouse("Moved", *map(float, start))
        page.mouse("Pressed", *map(float, start), clickCount=1, **held)
        page.evaluate(WATCH)
        for i in range(asked.steps):
            x, y = start + 0.06 * way * np.sin(0.7 * (i + 1))
            page.mouse("Moved", float(x), float(y), **held)
            time.sleep(0.25)
        page.mouse("Released", *map(float, start), button="left", buttons=0, clickCount=1)
        took, told_after = page.evaluate("[window.took, window.told]")
    viewer.stop()
    print(f"steps answered in the page    {len(took)} of {asked.steps}")
    for what, values in (
        ("pointer to drawn", took),
        ("pointer to told", told_after),
        ("of it on the server", 1e3 * np.array(served)),
    ):
        half, most = np.quantile(values, [0.5, 0.9])
        print(f"{what:29s} {half:.1f} ms, {most:.1f} ms at nine of ten")
    print(f"a frame takes the browser     {frame:.1f} ms (drawn in software here)")


if __name__ == "__main__":
    main()
