"""The pictures of pages in the documentation: each page is opened in Chromium, used, and taken.

What `casadi-ik view` shows of a grasp, of a contact out of reach, of ranked choices, of two logs,
of the pads of an imported hand (`--hand`: its URDF), and the page without a server (`--page`: built
by `make page`)::

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
"""Grasps that are chosen among."""

ITERATION = 8
"""Of two logs, as it is shown."""

FRAMES = 3
"""After so many all that was asked for is in the picture."""

CLOSE = "document.querySelector('.mantine-Notification-closeButton')"
"""Of the note that there is no graphics card, which lies over the picture."""

sys.path.insert(0, str(Path(__file__).parents[1] / "studies"))
BENCH: Any = importlib.import_module("bench_view")
"""Its browser, and what tells a page that something is painted."""

Use = Callable[[Any, Any], None]
"""What is done on a page, with the viewer and the browser's page."""


def taken(browser: Any, words: list[str], path: Path, use: Use) -> None:
    """Open what `casadi-ik view` opens, use it, save what is seen."""
    viewer = open_viewer(parse(["view", *words])[1])
    page = browser.open("about:blank", *WINDOW)
    page.call("Page.addScriptToEvaluateOnNewDocument", source=BENCH.COMMON)
    page.go(viewer.url)
    page.wait("document.querySelector('.ik-status, .ik-iteration, .ik-pad') !== null")
    time.sleep(2.0)
    page.evaluate(f"{CLOSE}?.click()")
    use(viewer.page, page)
    viewer.page.work.settle()
    seen(page, path)
    viewer.stop()


def seen(page: Any, path: Path) -> None:
    """Save what is on the screen, once all of it is there."""
    time.sleep(1.0)
    for _ in range(FRAMES):
        page.evaluate("new Promise(done => requestAnimationFrame(() => setTimeout(done)))")
    page.evaluate("window.painted?.(document.querySelector('canvas'))")
    page.screenshot(path)
    Pillow.open(path).convert("RGB").save(path, optimize=True)
    page.call("Page.navigate", url="about:blank")
    print(path)


def dragged(name: str, *by: float) -> Use:
    """The object or a contact dragged so far [m], in steps as a hand does."""

    def use(shown: GraspPage, _: Any) -> None:
        shown.select(name)
        start = shown.request.poses[name]
        for part in np.linspace(0.25, 1.0, 4):
            pose = start.copy()
            pose[:3, 3] += part * np.array(by)
            shown.change(name, lambda request, pose=pose: request.with_pose(name, pose))
            shown.work.settle()

    return use


def gone_through(shown: GraspPage, page: Any) -> None:
    """The best of the choices, and its solutions, seen with the whole arm."""
    shown.choose(next(iter(shown.candidates)))
    shown.work.settle()
    time.sleep(2.0)
    for found in (
        "[...document.querySelectorAll('[role=tab]')].find(one => one.innerText === 'Results')",
        "[...document.querySelectorAll('.mantine-Paper-root *')]"
        ".findLast(one => one.innerText?.trim() === 'Solutions')",
        "[...document.querySelectorAll('button')].find(one => one.innerText.trim() === 'Robot')",
    ):
        box = page.evaluate(
            "(({x, y, width, height}) => [x + width / 2, y + height / 2])"
            f"({found}.getBoundingClientRect())"
        )
        page.click(*box)
        time.sleep(1.5)


def chosen(folder: Path) -> list[str]:
    """The answers that are chosen among a few grasps."""
    ranked = folder / "ranked.json"
    grasps = folder / "candidates"
    grasps.mkdir()
    for name in CANDIDATES:
        shutil.copy(resolve_description(name, "grasps"), grasps)
    scene = ["--scene", "table"]
    command(["choose", str(grasps), "--robot", ROBOT, *scene, "--out", str(ranked)])
    return [str(ranked), *scene]


def logged(folder: Path) -> list[str]:
    """Two solves of the cup, by the paper's method and by ours."""
    paths = []
    for method in ("enhanced-dls", "hand-first"):
        paths.append(str(folder / f"{method}.mcap"))
        command(["solve", "cup", "--method", method, "--log", paths[-1]])
    return paths


def imported(urdf: Path, folder: Path) -> list[str]:
    """A hand's description with guessed pads."""
    path = folder / "my_hand.yaml"
    command(["import", str(urdf), "--out", str(path)])
    return [str(path), "--pads"]


def alone(browser: Any, path: Path, picture: Path) -> None:
    """The page without a server, once it has answered often enough to be warm."""
    page = browser.open(path.resolve().as_uri(), *WINDOW)
    page.wait("globalThis.casadiIk?.now.answer && !casadiIk.viewport.framePending", 60.0)
    x, y = page.evaluate("casadiIk.pixel('object')")
    page.drag((x, y), (x + 6.0, y - 4.0), steps=12)
    page.wait("!casadiIk.viewport.framePending")
    seen(page, picture)


def main(arguments: list[str] | None = None) -> None:
    """Take them all."""
    parser = argparse.ArgumentParser(description="The pictures of the pages.")
    parser.add_argument("--hand", type=Path, help="URDF of the hand whose pads are shown")
    parser.add_argument("--page", type=Path, help="index.html of the page without a server")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder")
    parser.add_argument("--only", nargs="*", default=(), help="names of pictures, without .png")
    options = parser.parse_args(arguments)
    wanted = set(options.only)
    with BENCH.browser_tools().Browser() as browser, tempfile.TemporaryDirectory() as name:
        folder, cup = Path(name), ["cup", "--scene", "table"]
        pictures: dict[str, tuple[Callable[[], list[str]], Use]] = {
            "view": (lambda: cup, dragged("object", 0.02, 0.03, 0.01)),
            "view_missed": (lambda: cup, dragged("thumb", 0.0, 0.0, 0.05)),
            "view_choices": (lambda: chosen(folder), gone_through),
            "view_log": (lambda: logged(folder), lambda shown, _: shown.show(ITERATION)),
        }
        if options.hand is not None:
            pads = imported(options.hand, folder)
            pictures["view_pads"] = (lambda: pads, lambda shown, _: shown.select("finger_1"))
        for name, (words, use) in pictures.items():
            if not wanted or name in wanted:
                taken(browser, words(), options.out / f"{name}.png", use)
        if options.page is not None and (not wanted or "page" in wanted):
            alone(browser, options.page, options.out / "page.png")


if __name__ == "__main__":
    main()
