"""From the mouse to the drawn answer: how long a dragged contact takes in the browser.

A contact of the shipped cup is dragged by mouse in Chromium, one step after the other: on the page
of `casadi-ik view`, and on the page without a server (`--page out/page/index.html`, built by `make
page`). Every page is measured twice: as it is, and with the calls that paint left out. Without a
graphics card the browser paints in software, on the same processors as everything else, which takes
most of the time; with one this time is next to nothing. CPU times depend little on what else the
machine does::

    python studies/view_latency.py --page out/page/index.html --report out/view_latency
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from drag_latency.hand import Drags, browser_tools, cpu_of, drag
from drag_latency.probes import ALONE, NO_PAINTING, SERVED, STILL
from runner import markdown_table, provenance, write_page

import casadi_ik as ik
from casadi_ik.viewing import Viewer, view_grasp
from casadi_ik.viewing.drawn_contacts import SIZE
from casadi_ik.viewing.frames import pose_of

ROBOT, FINGER = "kuka_lwr_barrett", "thumb"
WINDOW = (1280, 800)

REST, FLOW = 1.0, 0.03
"""Between what is drawn and the next step: all that can wait is done; as a hand drags [s]."""

KINDS = {
    "as it is": (True, REST),
    "not painted": (False, REST),
    "not painted, in one go": (False, FLOW),
}
"""Whether it is painted, and the time between steps [s]."""

BOX = (
    "(({x, y, width, height}) => [x, y, width, height])"
    "(document.querySelector('canvas').getBoundingClientRect())"
)

INTRODUCTION = """
A contact of the cup ({robot}) dragged in steps of a few millimetres, window {width} x {height},
{steps} steps unpainted, {painted} painted, each begun {rest} s after the one before was drawn, when
motors and most solutions are told as well; "in one go": {flow} s, as a hand drags. Load of its
{processors} processors while it ran: {load}. Medians, in brackets nine of ten.

"As it is": Chromium paints in software here. "Not painted": the calls that draw and clear are left
out, everything else remains; a graphics card is in between, and near to this. The server's share of
`casadi-ik view` is from the browser's message to the answer's hand-over; the solver's is in it.
"""


def opened(browser: Any, url: str, *scripts: str) -> Any:
    """A page with scripts before its own."""
    page = browser.open("about:blank", *WINDOW)
    for script in scripts:
        page.call("Page.addScriptToEvaluateOnNewDocument", source=script)
    page.go(url)
    return page


def swaying(start: np.ndarray, way: np.ndarray) -> Callable[[int], np.ndarray]:
    """Places to and fro about a start, every one another [pixels]."""
    return lambda i: start + way * (np.sin(0.9 * i) + 0.1 * np.sin(0.37 * i)) * (i > 0)


def on_view(viewer: Viewer, browser: Any, steps: int, painted: bool, rest: float) -> Drags:
    """Drags on the page of `casadi-ik view`."""
    shown, served, solves, begun = viewer.page, [], [], [0.0]
    put, draw = shown.work.put, shown.draw

    def asked(key: str, change: Callable[[], None]) -> None:
        begun[0] = time.perf_counter()
        put(key, change)

    def answered(answer: Any) -> None:
        draw(answer)
        if begun[0]:
            served.append(1e3 * (time.perf_counter() - begun[0]))
            solves.append(1e3 * answer.seconds)
            begun[0] = 0.0

    page = opened(browser, viewer.url, SERVED, *([] if painted else [NO_PAINTING]))
    page.wait("document.querySelector('.ik-status') !== null")
    time.sleep(4.0)  # the camera comes to rest
    client = list(viewer._server.get_clients().values())[-1]
    box, pose = page.evaluate(BOX), shown.asked.held[FINGER].control

    def pixel(point: np.ndarray) -> np.ndarray:
        camera = client.camera
        seen = np.linalg.inv(pose_of(camera.position, camera.wxyz)) @ np.append(point, 1.0)
        focal = box[3] / 2 / np.tan(camera.fov / 2)
        return np.array(box[:2]) + np.array(box[2:]) / 2 + focal * seen[:2] / seen[2]

    here = pixel(pose[:3, 3])
    tips = [pixel(pose[:3, 3] + SIZE * pose[:3, i]) for i in range(3)]
    way = max((tip - here for tip in tips), key=lambda one: float(np.linalg.norm(one)))
    drags = Drags(notes={"still": float(np.median(page.evaluate(STILL.replace("DRAW", ""))))})
    messages = page.evaluate("window.messages")
    shown.work.put, shown.draw = asked, answered
    with cpu_of(browser, drags, server=True):
        drag(page, swaying(here + 0.92 * way, 0.25 * way), steps, rest, drags)
    shown.work.put, shown.draw = put, draw
    drags.notes["messages"] = (page.evaluate("window.messages") - messages) / len(served)
    drags.notes |= {"server": float(np.median(served)), "solve": float(np.median(solves))}
    page.call("Page.navigate", url="about:blank")
    return drags


def on_page(path: Path, browser: Any, steps: int, painted: bool, rest: float) -> Drags:
    """Drags on the page without a server."""
    page = opened(browser, path.resolve().as_uri(), *([] if painted else [NO_PAINTING]))
    page.wait("globalThis.casadiIk?.now.answer && !casadiIk.stage.asked", 60.0)
    time.sleep(1.0)
    page.evaluate(ALONE)
    still = page.evaluate(
        STILL.replace("DRAW; next()", "next()").replace(
            "took.push(", "casadiIk.stage.draw(); took.push("
        )
    )
    drags = Drags(notes={"still": float(np.median(still))})
    start = np.array(page.evaluate("casadiIk.pixel('point 0')"))
    with cpu_of(browser, drags, server=False):
        drag(page, swaying(start, np.array([9.0, -9.0])), steps, rest, drags)
    page.wait("!casadiIk.stage.asked")
    time.sleep(0.5)
    drags.notes["settled"] = 1e-3 * page.evaluate("casadiIk.now.answer.time")
    page.call("Page.navigate", url="about:blank")
    return drags


def cell(values: np.ndarray) -> str:
    """Median and nine of ten."""
    if not len(values):
        return "none"
    return f"{np.median(values):.1f} ({np.quantile(values, 0.9):.1f})"


def table(kinds: dict[str, Drags], rows: dict[str, tuple[str, str]]) -> str:
    """Times [ms] between what happened, and CPU times."""
    lines = [
        [what, *(cell(drags.between(*ends)) for drags in kinds.values())]
        for what, ends in rows.items()
    ]
    lines.append(["steps drawn", *(f"{len(d.rows)} of {d.steps}" for d in kinds.values())])
    for what in next(iter(kinds.values())).cpu:
        lines.append([f"CPU time a step: {what}", *(f"{d.cpu[what]:.1f}" for d in kinds.values())])
    notes = {
        "still": "one and the same picture painted again",
        "server": "the server's share",
        "solve": "the solver's share",
        "settled": "the solver's share, told by the page at rest",
        "messages": "messages to the browser a step (a number)",
    }
    for key, what in notes.items():
        if all(key in drags.notes for drags in kinds.values()):
            lines.append([what, *(f"{d.notes[key]:.3g}" for d in kinds.values())])
    return markdown_table(["ms", *kinds], lines)


VIEW_ROWS = {
    "**pointer to drawn answer**": ("event", "drawn"),
    "pointer to told verdict": ("event", "told"),
    "pointer to message sent": ("event", "sent"),
    "message sent to answer there": ("sent", "came"),
    "answer there to verdict told": ("came", "told"),
    "answer there to painted": ("came", "painted"),
}

PAGE_ROWS = {
    "**pointer to drawn answer**": ("event", "drawn"),
    "pointer to drawing calls made": ("event", "submitted"),
    "pointer to solve": ("event", "asked"),
    "solve, one call": ("asked", "solved"),
    "answer to everything placed": ("solved", "placed"),
    "drawing calls": ("placed", "submitted"),
    "painted": ("submitted", "drawn"),
}


def main(arguments: list[str] | None = None) -> None:
    """Measure and write the report."""
    parser = argparse.ArgumentParser(description="From the mouse to the drawn answer.")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--page", type=Path, help="index.html of the page without a server")
    parser.add_argument("--report", type=Path, default=Path("out/view_latency"), help="folder")
    options = parser.parse_args(arguments)
    loads, parts = [os.getloadavg()[0]], []
    # Painting in software may take seconds a step.
    counts = {True: max(options.steps // 8, 3), False: options.steps}
    viewer = view_grasp(ik.load_robot(ROBOT), ik.load_grasp("cup"), scene=ik.load_scene("table"))
    with browser_tools().Browser() as browser:
        found = {}
        for name, (painted, rest) in KINDS.items():
            found[name] = on_view(viewer, browser, counts[painted], painted, rest)
            loads.append(os.getloadavg()[0])
        parts += ["## `casadi-ik view cup --scene table`", table(found, VIEW_ROWS)]
        viewer.stop()
        if options.page is not None:
            found = {}
            for name, (painted, rest) in KINDS.items():
                found[name] = on_page(options.page, browser, counts[painted], painted, rest)
                loads.append(os.getloadavg()[0])
            parts += ["## The page without a server (WebAssembly)", table(found, PAGE_ROWS)]
    introduction = INTRODUCTION.format(
        robot=ROBOT,
        width=WINDOW[0],
        height=WINDOW[1],
        steps=options.steps,
        painted=counts[True],
        rest=REST,
        flow=FLOW,
        processors=os.cpu_count(),
        load=", ".join(f"{load:.1f}" for load in loads),
    )
    parts = [introduction, *parts, provenance({"viser": version("viser")})]
    write_page("From the mouse to the drawn answer", parts, options.report)
    print((options.report / "report.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
