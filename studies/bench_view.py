"""From the mouse to the drawn answer: a contact of the shipped cup dragged by mouse in Chromium.

On the page of `casadi-ik view` or on the page without a server, one step after the other, each
begun when the one before is drawn: after a second's rest, when motors and most solutions are told
as well, or as a hand drags. Without a graphics card Chromium paints in software, on the same
processors as everything else, which takes most of the time: therefore also with the calls that
paint left out.

Scripts put into a page before its own write a row of times for every answer to a pointer's event
into `window.rows` [ms, the page's clock]. A page that a server solves for: `event` (the browser has
it), `sent` (handed to the socket), `came` (the answer is there), `told` (the verdict is on the
page), `drawn` (the frame that shows it is painted by the graphics library: a pixel is read back,
which waits for all of it). One that solves by itself: `event`, `asked` (the solve begins),
`solved`, `placed` (what is drawn stands where it belongs), `submitted` (drawing calls are made),
`drawn`.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

import casadi_ik as ik

PATIENCE = 20.0
"""A step that is not drawn after so long is counted as lost [s]."""

WARM = 2
"""Steps before the first that counts: they take hold, and compile what the others use."""

STEPS, PAINTED = 40, 5
"""Steps of a drag, and where all is painted, which may take seconds a step."""

STEP_PAUSE, FLOW = 1.0, 0.03
"""Between what is drawn and the next step [s]."""

BUTTON_HELD = {"button": "left", "buttons": 1}

BOX = (
    "(({x, y, width, height}) => [x, y, width, height])"
    "(document.querySelector('canvas').getBoundingClientRect())"
)

HANDLE = 0.06
"""Length of the axes by which a contact is held [m]."""

PROBES = Path(__file__).parent / "probes"
COMMON, SERVED, STATIC_PAGE_SCRIPT, NO_PAINTING, STILL = (
    (PROBES / f"{name}.js").read_text(encoding="utf-8")
    for name in ("common", "served", "alone", "no_painting", "still")
)
"""Scripts: for every page, for that of `casadi-ik view`, for the one without a server once it is
there. The fourth leaves out what a graphics card is for, clearing too: a picture that is only
cleared is put on the screen as well, in software too, 25 ms of a processor. The last gives times
[ms] of painting one and the same picture again and again."""

STAGES = {
    "server": ("event", "sent", "came", "told", "drawn"),
    "page": ("event", "asked", "solved", "placed", "submitted", "drawn"),
}

Quantities = dict[str, float]


def measure(target: str, painted: bool, flow: bool) -> Quantities:
    """Measure a drag: medians of times [ms], and processor times of a step.

    Args:
        target: "server": the page of `casadi-ik view`; else the file of the page without one.
        painted: Whether it is painted.
        flow: Whether steps follow each other as a hand drags.
    """
    steps, pause = PAINTED if painted else STEPS, FLOW if flow else STEP_PAUSE
    with browser_tools().Browser() as browser:
        drag = _on_view if target == "server" else _on_page
        rows, extra = drag(target, browser, steps, painted, pause)
    quantities: Quantities = {"steps lost": float(steps - len(rows))}
    if rows:
        stages = STAGES["server" if target == "server" else "page"]
        latencies = [row["drawn"] - row["event"] for row in rows]
        quantities["pointer to drawn answer ms"] = float(np.median(latencies))
        quantities["nine of ten ms"] = float(np.quantile(latencies, 0.9))
        for start, end in pairwise(stages):
            name = f"{start} to {end} ms"
            quantities[name] = float(np.median([row[end] - row[start] for row in rows]))
    return quantities | extra


def browser_tools() -> ModuleType:
    """Return the module of the browser that the tests use."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    try:
        tools = importlib.import_module("browser")
    finally:
        del sys.path[0]
    vars(tools)["PATIENCE"] = 300.0  # a picture painted in software on a busy machine
    return tools


def _opened(browser: Any, url: str, *scripts: str) -> Any:
    """Open a page with scripts that run first."""
    page = browser.open("about:blank", 1280, 800)
    for script in scripts:
        page.call("Page.addScriptToEvaluateOnNewDocument", source=script)
    page.go(url)
    return page


def _cpu_times(browser: Any) -> Quantities:
    """Processor time of a browser's processes by kind [s]."""
    connect = importlib.import_module("websockets.sync.client").connect
    with urllib.request.urlopen(f"{browser._address}/json/version") as answer:
        address = json.loads(answer.read())["webSocketDebuggerUrl"]
    with connect(address) as socket:
        socket.send(json.dumps({"id": 1, "method": "SystemInfo.getProcessInfo"}))
        quantities: Quantities = {"server": time.process_time()}
        for process_info in json.loads(socket.recv(PATIENCE))["result"]["processInfo"]:
            quantities[process_info["type"]] = quantities.get(process_info["type"], 0.0) + float(
                process_info["cpuTime"]
            )
    return quantities


@contextmanager
def _cpu_of(browser: Any, steps: int, quantities: Quantities, *kinds: str) -> Iterator[None]:
    """Record the processor time of a step by kind of process [ms]."""
    times_before = _cpu_times(browser)
    yield
    after = _cpu_times(browser)
    for kind in kinds:
        seconds = after.get(kind, 0.0) - times_before.get(kind, 0.0)
        quantities[f"{kind} ms of CPU a step"] = 1e3 * seconds / (steps + WARM)


def _drag(
    page: Any, start: np.ndarray, direction: np.ndarray, steps: int, pause: float
) -> list[dict[str, float]]:
    """Drag something to and fro about a start [pixels], each step once the one before is drawn."""

    def place(i: int) -> dict[str, float]:
        x, y = start + direction * (np.sin(0.9 * i) + 0.1 * np.sin(0.37 * i)) * (i > 0)
        return {"x": float(x), "y": float(y)}

    page.mouse("Moved", **place(0))
    page.mouse("Pressed", **place(0), clickCount=1, **BUTTON_HELD)
    for i in range(1, steps + WARM + 1):
        if i == WARM + 1:
            page.evaluate("window.rows = []")
        times_before, end = page.evaluate("window.rows.length"), time.monotonic() + PATIENCE
        page.mouse("Moved", **place(i), **BUTTON_HELD)
        while page.evaluate("window.rows.length") == times_before and time.monotonic() < end:
            time.sleep(0.02)
        time.sleep(pause)
    page.mouse("Released", **place(steps), button="left", buttons=0, clickCount=1)
    return page.evaluate("window.rows")


def _on_view(
    _: str, browser: Any, steps: int, painted: bool, pause: float
) -> tuple[list[dict[str, float]], Quantities]:
    """Drag on the page of `casadi-ik view`; return the shares of server and solver."""
    viewing = importlib.import_module("casadi_ik.app.viewer")
    robot, grasp = ik.load_robot("kuka_lwr_barrett"), ik.load_grasp("cup")
    viewer = viewing.view_grasp(robot, grasp, scene=ik.load_scene("table"))
    page_state, served, solves, begun = viewer.page, [], [], [0.0]
    submit, draw = page_state.work.submit, page_state.draw

    def note_submission(key: str, change: Callable[[], None]) -> None:
        begun[0] = time.perf_counter()
        submit(key, change)

    def answered(answer: Any) -> None:
        draw(answer)
        if begun[0]:
            served.append(1e3 * (time.perf_counter() - begun[0]))
            solves.append(1e3 * answer.solve_time)
            begun[0] = 0.0

    page = _opened(browser, viewer.url, COMMON + SERVED, *([] if painted else [NO_PAINTING]))
    page.wait("document.querySelector('.ik-status') !== null")
    time.sleep(4.0)  # the camera comes to rest
    client = list(viewer._server.get_clients().values())[-1]
    box, pose = page.evaluate(BOX), page_state.request.contacts["thumb"].control

    def pixel(point: np.ndarray) -> np.ndarray:
        camera = client.camera
        w, x, y, z = camera.wxyz
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        turn = np.eye(3) + 2 * w * cross + 2 * cross @ cross
        camera_point = turn.T @ (point - camera.position)
        focal = box[3] / 2 / np.tan(camera.fov / 2)
        return (
            np.array(box[:2]) + np.array(box[2:]) / 2 + focal * camera_point[:2] / camera_point[2]
        )

    start = pixel(pose[:3, 3])
    tips = [pixel(pose[:3, 3] + HANDLE * pose[:3, i]) for i in range(3)]
    direction = max((tip - start for tip in tips), key=lambda tip: float(np.linalg.norm(tip)))
    quantities: Quantities = {}
    quantities["picture painted again ms"] = _still(page, STILL.replace("DRAW", ""))
    page_state.work.submit, page_state.draw = note_submission, answered
    with _cpu_of(browser, steps, quantities, "server", "renderer", "GPU"):
        rows = _drag(page, start + 0.92 * direction, 0.25 * direction, steps, pause)
    viewer.stop()
    quantities["server's share ms"], quantities["solver's share ms"] = map(
        float, map(np.median, (served, solves))
    )
    return rows, quantities


def _on_page(
    path: str, browser: Any, steps: int, painted: bool, pause: float
) -> tuple[list[dict[str, float]], Quantities]:
    """Drag on the page without a server."""
    url, scripts = Path(path).resolve().as_uri(), [] if painted else [NO_PAINTING]
    page = _opened(browser, url, *scripts)
    page.wait("globalThis.casadiIk?.now.answer && !casadiIk.viewport.framePending", 60.0)
    time.sleep(1.0)
    page.evaluate(COMMON + STATIC_PAGE_SCRIPT)
    still = STILL.replace("DRAW; next()", "next()")
    still = still.replace("took.push(", "casadiIk.viewport.draw(); took.push(")
    quantities: Quantities = {}
    quantities["picture painted again ms"] = _still(page, still)
    start = np.array(page.evaluate("casadiIk.pixel('point 0')"))
    with _cpu_of(browser, steps, quantities, "renderer", "GPU"):
        rows = _drag(page, start, np.array([9.0, -9.0]), steps, pause)
    page.wait("!casadiIk.viewport.framePending")
    return rows, quantities


def _still(page: Any, script: str) -> float:
    return float(np.median(page.evaluate(script)))
