"""Take the pictures of the viewer and of the web page in Chromium.

The pictures show a grasp, a contact out of reach, ranked grasps, two logs, the pads of an imported
hand (`--hand`: its URDF), and the page without a server (`--page`: built by `make page`)::

    python tools/viewer_pictures.py --hand leap_hand_right.urdf --page out/page/index.html

Without a graphics card a picture takes seconds.
"""

from __future__ import annotations

import argparse
import importlib
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pillow

from casadi_ik.app.cli.main import main as command
from casadi_ik.app.cli.table import parse
from casadi_ik.app.cli.view import open_viewer
from casadi_ik.app.viewer.grasp_page import GraspPage
from casadi_ik.files.shipped import resolve_description

ROBOT = "kuka_lwr_barrett"
WINDOW = (1200, 760)

CANDIDATES = ("cup", "mug", "apple", "orange", "tennis_ball", "tomato_soup_can")
"""Candidates for the picture of ranked grasps."""

ITERATION = 8
"""Iteration of the two logs to show."""

FRAMES = 3
"""Number of frames until the page is completely drawn."""

CLOSE = "document.querySelector('.mantine-Notification-closeButton')"
"""Close button of the note about a missing graphics card, which covers the picture."""

sys.path.insert(0, str(Path(__file__).parents[1] / "studies"))
BENCH: Any = importlib.import_module("bench_view")
"""Module with the browser and the script that detects painted frames."""

Use = Callable[[Any, Any], None]
"""Actions on a page, given the viewer and the page of the browser."""


def take_picture(browser: Any, words: list[str], path: Path, use: Use) -> None:
    """Open a page of `casadi-ik view`, use it, and save a screenshot."""
    viewer = open_viewer(parse(["view", *words])[1])
    page = browser.open("about:blank", *WINDOW)
    page.call("Page.addScriptToEvaluateOnNewDocument", source=BENCH.COMMON)
    page.go(viewer.url)
    page.wait("document.querySelector('.ik-status, .ik-iteration, .ik-pad') !== null")
    time.sleep(2.0)
    page.evaluate(f"{CLOSE}?.click()")
    use(viewer.page, page)
    viewer.page.work.settle()
    save_screenshot(page, path)
    viewer.stop()


def save_screenshot(page: Any, path: Path) -> None:
    """Save a screenshot once the page is completely drawn."""
    time.sleep(1.0)
    for _ in range(FRAMES):
        page.evaluate("new Promise(done => requestAnimationFrame(() => setTimeout(done)))")
    page.evaluate("window.painted?.(document.querySelector('canvas'))")
    page.screenshot(path)
    Pillow.open(path).convert("RGB").save(path, optimize=True)
    page.call("Page.navigate", url="about:blank")
    print(path)


def drag(name: str, *by: float) -> Use:
    """Return an action that drags the object or a contact by a vector [m] in steps."""

    def use(page_state: GraspPage, _: Any) -> None:
        page_state.select(name)
        start = page_state.request.poses[name]
        for part in np.linspace(0.25, 1.0, 4):
            pose = start.copy()
            pose[:3, 3] += part * np.array(by)
            page_state.change(name, lambda request, pose=pose: request.with_pose(name, pose))
            page_state.work.settle()

    return use


def show_solutions(page_state: GraspPage, page: Any) -> None:
    """Show the best of the ranked grasps and its solutions, with the whole arm."""
    page_state.choose(next(iter(page_state.candidates)))
    page_state.work.settle()
    time.sleep(2.0)
    for element in (
        "[...document.querySelectorAll('[role=tab]')].find(one => one.innerText === 'Results')",
        "[...document.querySelectorAll('.mantine-Paper-root *')]"
        ".findLast(one => one.innerText?.trim() === 'Solutions')",
        "[...document.querySelectorAll('button')].find(one => one.innerText.trim() === 'Robot')",
    ):
        box = page.evaluate(
            "(({x, y, width, height}) => [x + width / 2, y + height / 2])"
            f"({element}.getBoundingClientRect())"
        )
        page.click(*box)
        time.sleep(1.5)


def ranked_grasps(folder: Path) -> list[str]:
    """Rank the candidates; return the arguments of `casadi-ik view`."""
    ranked = folder / "ranked.json"
    grasps = folder / "candidates"
    grasps.mkdir()
    for name in CANDIDATES:
        shutil.copy(resolve_description(name, "grasps"), grasps)
    scene = ["--scene", "table"]
    command(["choose", str(grasps), "--robot", ROBOT, *scene, "--out", str(ranked)])
    return [str(ranked), *scene]


def log_two_methods(folder: Path) -> list[str]:
    """Log two solves of the cup, by a method of the paper and by hand-first."""
    paths = []
    for method in ("enhanced-dls", "hand-first"):
        paths.append(str(folder / f"{method}.mcap"))
        command(["solve", "cup", "--method", method, "--log", paths[-1]])
    return paths


def import_hand(urdf: Path, folder: Path) -> list[str]:
    """Import a hand with guessed pads; return the arguments of `casadi-ik view`."""
    path = folder / "my_hand.yaml"
    command(["import", str(urdf), "--out", str(path)])
    return [str(path), "--pads"]


def static_page(browser: Any, path: Path, picture: Path) -> None:
    """Take a picture of the page without a server, after some solves as warm-up."""
    page = browser.open(path.resolve().as_uri(), *WINDOW)
    page.wait("globalThis.casadiIk?.now.answer && !casadiIk.viewport.framePending", 60.0)
    x, y = page.evaluate("casadiIk.pixel('object')")
    page.drag((x, y), (x + 6.0, y - 4.0), steps=12)
    page.wait("!casadiIk.viewport.framePending")
    save_screenshot(page, picture)


def main(arguments: list[str] | None = None) -> None:
    """Take the pictures that the command line names."""
    parser = argparse.ArgumentParser(description="The pictures of the pages.")
    parser.add_argument("--hand", type=Path, help="URDF of the hand whose pads are shown")
    parser.add_argument("--page", type=Path, help="index.html of the page without a server")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder")
    parser.add_argument("--only", nargs="*", default=(), help="names of pictures, without .png")
    options = parser.parse_args(arguments)
    selected = set(options.only)
    with BENCH.browser_tools().Browser() as browser, tempfile.TemporaryDirectory() as name:
        folder, cup = Path(name), ["cup", "--scene", "table"]
        pictures: dict[str, tuple[Callable[[], list[str]], Use]] = {
            "view": (lambda: cup, drag("object", 0.02, 0.03, 0.01)),
            "view_missed": (lambda: cup, drag("thumb", 0.0, 0.0, 0.05)),
            "view_choices": (lambda: ranked_grasps(folder), show_solutions),
            "view_log": (
                lambda: log_two_methods(folder),
                lambda page_state, _: page_state.show(ITERATION),
            ),
        }
        if options.hand is not None:
            pads = import_hand(options.hand, folder)
            pictures["view_pads"] = (
                lambda: pads,
                lambda page_state, _: page_state.select("finger_1"),
            )
        for name, (words, use) in pictures.items():
            if not selected or name in selected:
                take_picture(browser, words(), options.out / f"{name}.png", use)
        if options.page is not None and (not selected or "page" in selected):
            static_page(browser, options.page, options.out / "page.png")


if __name__ == "__main__":
    main()
