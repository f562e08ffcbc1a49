"""The page: its module compared with Python in node, and its use by mouse and keys in Chromium."""

from __future__ import annotations

import importlib.util
import json
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from bench_view import NO_PAINTING
from browser import Browser, Page
from collision_queries import query_of_contacts

import casadi_ik as ik
from casadi_ik.collision.clearance_kernel import ClearanceKernel
from casadi_ik.export import project
from casadi_ik.export.project import export_prefix, wasm_project, write_folder

BUILD = Path(__file__).parents[2] / "page" / "build.py"
ROBOT, BODY = "kuka_lwr_barrett", "two_ur10e+barrett_bh8_280"
ANSWERED = "globalThis.casadiIk?.now.answer && casadiIk.now.shown === casadiIk.now.answer.q"


def build(out: Path, module: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page of two robots, and their exported modules.

    Compiled without optimisation, in a third of the time: that both give the same bits is what the
    test of the module without a scene finds.
    """
    if shutil.which("npm") is None or importlib.util.find_spec("ziglang") is None:
        pytest.skip("the page needs npm and ziglang")
    assert "-O2" in project.COMMAND
    plainly = tuple("-O0" if word == "-O2" else word for word in project.COMMAND)
    # Without optimisation zig protects the stack by a function that browsers lack.
    monkeypatch.setattr(project, "COMMAND", (*plainly, "-fno-stack-protector"))
    words = ["build", "--robots", ROBOT, BODY, "--out", str(out), "--keep", str(module)]
    monkeypatch.setattr(sys, "argv", words)
    try:
        runpy.run_path(str(BUILD), run_name="__main__")
    except SystemExit as end:
        if "npm ci" in str(end):
            pytest.skip("npm cannot fetch what the page is built from")
        raise


def opened(browser: Browser, url: str, width: int, height: int, phone: bool = False) -> Page:
    """Open the page, paint its first picture, and then disable painting, which takes longest."""
    page = browser.open(url, width, height, phone)
    settled(page)
    assert page.complaints == []
    page.evaluate(NO_PAINTING)
    return page


def current(page: Page, name: str) -> object:
    return page.evaluate(f"casadiIk.now.{name}")


def joint_positions(page: Page) -> np.ndarray:
    return np.array(page.evaluate("casadiIk.now.points.map((p) => p.toArray())"))


def settled(page: Page) -> None:
    """Wait until all requests are answered and the robot stands still."""
    page.wait(f"{ANSWERED} && !casadiIk.viewport.framePending")


def the_page_follows(page: Page, robot: ik.ArmHand) -> None:
    """A dragged contact moves the drawn fingertip as Python's kinematics does."""
    q_before = joint_positions(page)
    x, y = page.evaluate("casadiIk.pixel('point 0')")
    page.drag((x, y), (x + 9, y - 9), steps=4)
    settled(page)
    after = joint_positions(page)
    assert 2e-3 < np.linalg.norm(after[0] - q_before[0]) < 0.1
    assert current(page, "answer.status") == ik.Status.SOLVED
    q = np.array(page.evaluate("[...casadiIk.now.shown]"))
    points, _ = robot.contacts(q)
    assert np.linalg.norm(points - after, axis=1).max() <= 5.001e-3
    # The drawn shapes are the collision shapes of Python.
    drawn_poses = page.evaluate(
        "casadiIk.now.body.parts.map(({ kind, at, mesh }) => [kind, at, mesh.position.toArray()])"
    )
    (placed,) = ClearanceKernel(robot.description).shape_poses(q[None])
    shapes = page.evaluate("[...casadiIk.now.solving.solver.shapes(casadiIk.now.shown)]")
    assert np.abs(np.array(shapes) - placed.ravel()).max() < 1e-12
    assert len(drawn_poses) > 20
    assert {kind for kind, _, _ in drawn_poses} == {"capsule", "box", "cylinder", "pad"}
    for kind, at, place in drawn_poses:
        coordinates = placed.ravel()[at:] if kind == "capsule" else placed.ravel()[at + 9 :]
        nearest_points = points.ravel()[at:] if kind == "pad" else coordinates
        assert np.allclose(place, nearest_points[:3], atol=1e-9)


def a_normal_turns(page: Page) -> None:
    normal_expression = "casadiIk.now.normals[1].toArray()"
    normal_before = page.evaluate(normal_expression)
    x, y = page.evaluate("casadiIk.pixel('normal 1')")
    page.drag((x, y), (x + 6, y + 4), steps=3)
    settled(page)
    after = page.evaluate(normal_expression)
    assert np.linalg.norm(after) == pytest.approx(1.0)
    assert 0.02 < np.linalg.norm(np.subtract(after, normal_before)) < 0.6


def the_object_takes_its_contacts_along(page: Page) -> None:
    q_before = joint_positions(page)
    x, y = page.evaluate("casadiIk.pixel('object')")
    assert page.evaluate(f"casadiIk.under({x}, {y})") == "object"
    page.drag((x, y), (x + 25, y), steps=4)
    settled(page)
    steps = joint_positions(page) - q_before
    assert np.linalg.norm(steps[0]) > 5e-3
    assert np.ptp(steps, axis=0).max() < 1e-9


def steps_are_taken_back(page: Page) -> None:
    """Keys move the object up by 5 mm; undo and redo work."""
    q_before = joint_positions(page)
    page.evaluate("document.getElementById('canvas').focus()")
    pressed(page, "Escape")
    pressed(page, "ArrowUp")
    settled(page)
    up = [0.0, 0.0, 5e-3]
    assert np.allclose(joint_positions(page) - q_before, up, atol=1e-9)
    pressed(page, "z", CONTROL)
    settled(page)
    assert np.allclose(joint_positions(page), q_before, atol=1e-9)
    pressed(page, "z", CONTROL + SHIFT)
    settled(page)
    assert np.allclose(joint_positions(page) - q_before, up, atol=1e-9)


CONTROL, SHIFT = 2, 8
"""Size of the heap according to DevTools."""


def pressed(page: Page, key: str, duration: int = 0) -> None:
    for kind in ("keyDown", "keyUp"):
        page.call("Input.dispatchKeyEvent", type=kind, key=key, code=key, modifiers=duration)


def copied(page: Page, button: str) -> str:
    """Return the text that a button copies to the clipboard."""
    page.evaluate(
        "globalThis.clip = '';"
        "Object.defineProperty(navigator, 'clipboard', { configurable: true,"
        " value: { writeText: async (text) => { globalThis.clip = text; } } })"
    )
    page.evaluate(f"document.getElementById('{button}').click()")
    return str(page.wait("globalThis.clip"))


def the_answer_is_copied(page: Page) -> None:
    page.evaluate("document.getElementById('format').value = 'dict rad'")
    named = json.loads(copied(page, "copy"))
    assert list(named) == page.evaluate("casadiIk.now.solving.robot.motors")
    q = page.evaluate("[...casadiIk.now.answer.q]")
    assert np.allclose(list(named.values()), q, atol=1e-6)


def a_link_has_the_question(page: Page, browser: Browser, url: str) -> None:
    """A link restores the request; a broken link is reported."""
    shown_expression = "[...casadiIk.now.shown]"
    page.evaluate("document.getElementById('reset').click()")
    pressed(page, "ArrowUp")
    settled(page)
    linked_page = opened(browser, copied(page, "link"), 900, 600)
    assert np.allclose(joint_positions(linked_page), joint_positions(page), atol=1e-4)
    assert np.allclose(
        linked_page.evaluate(shown_expression), page.evaluate(shown_expression), atol=2e-3
    )
    assert current(linked_page, "answer.status") == ik.Status.SOLVED
    note_text = "document.getElementById('note').textContent"
    linked_page = opened(browser, f"{url}#robot={ROBOT}&grasp=apple&points=1,nan,2", 900, 600)
    assert "points: found 1 of the 3 fingers" in linked_page.evaluate(note_text)
    linked_page = opened(browser, f"{url}#robot=<b>none</b>&grasp=apple", 900, 600)
    assert "is not on this page" in linked_page.evaluate(note_text)


def out_of_reach_is_explained(page: Page) -> None:
    height = "document.querySelector('.verdict').offsetHeight"
    height_before = page.evaluate(height)
    for _ in range(3):
        x, y = page.evaluate("casadiIk.pixel('object')")
        page.mouse("Wheel", x, y, deltaX=0, deltaY=240)
    settled(page)
    x, y = page.evaluate("casadiIk.pixel('point 0')")
    page.drag((x, y), (530 if x < 270 else 10, 590 if y < 300 else 10), steps=3)
    settled(page)
    assert page.evaluate("document.getElementById('status').textContent") == "not reached"
    reason_text = page.evaluate("document.getElementById('reason').textContent")
    assert reason_text.startswith("Out of reach: ")
    assert "apart" in reason_text
    assert page.evaluate(height) == height_before
    unchecked = page.evaluate("document.getElementById('clearance').textContent")
    assert unchecked == "collision not checked"
    page.evaluate("document.getElementById('reset').click()")
    settled(page)
    assert page.evaluate("document.getElementById('status').textContent") == "solved"


def an_obstacle_is_kept_clear_of(page: Page, robot: ik.ArmHand) -> None:
    """With an object dragged into the arm, the clearance of every answer equals Python's."""
    page.evaluate("document.getElementById('obstacle').click()")
    settled(page)
    goal = page.evaluate("casadiIk.pixel('point 0')")
    ends = set()
    for part in (0.05, 0.7):
        x, y = page.evaluate("casadiIk.pixel('obstacle')")
        page.drag((x, y), (x + part * (goal[0] - x), y + part * (goal[1] - y)), steps=3)
        settled(page)
        apple, post = (current(page, f"{name}.solids[0]") for name in ("object", "obstacle"))
        assert isinstance(apple, dict)
        assert isinstance(post, dict)
        ball = {"kind": "sphere", "radius": apple["size"][0], "xyz": apple["pose"][9:]}
        box = {"kind": "box", "size": post["size"], "xyz": post["pose"][9:]}
        scene = ik.Scene({"apple": ball, "post": box}, grasped="apple")
        solver, points = ik.Solver(robot, scene=scene), joint_positions(page)[None]
        around = query_of_contacts(solver, points, np.full_like(points, np.nan))
        q = np.array(page.evaluate("[...casadiIk.now.answer.q]"))
        clear = around.check(q[None])
        assert current(page, "answer.clearance") == pytest.approx(
            float(clear.distance[0]), abs=1e-9
        )
        ends.add(current(page, "answer.status"))
        assert (current(page, "answer.status") == ik.Status.SOLVED) == bool(clear.free[0])
    assert ik.Status.SOLVED in ends


def used_by_mouse(page: Page, robot: ik.ArmHand, browser: Browser, url: str) -> None:
    assert current(page, "answer.status") == ik.Status.SOLVED
    assert page.evaluate("document.title").startswith("apple · ")
    the_page_follows(page, robot)
    page.wait("/^[0-9.]+ (µs|ms)$/.test(document.getElementById('time').textContent)")
    a_normal_turns(page)
    the_object_takes_its_contacts_along(page)
    steps_are_taken_back(page)
    the_answer_is_copied(page)
    out_of_reach_is_explained(page)
    an_obstacle_is_kept_clear_of(page, robot)
    assert page.complaints == []
    a_link_has_the_question(page, browser, url)


def used_on_a_phone(page: Page) -> None:
    assert page.evaluate("document.documentElement.scrollWidth") == 360
    q_before = joint_positions(page)
    x, y = page.evaluate("casadiIk.pixel('point 0')")
    page.touch((x, y), (x + 6, y - 5), steps=3)
    settled(page)
    assert np.linalg.norm(joint_positions(page)[0] - q_before[0]) > 2e-3
    assert page.evaluate("document.getElementById('canvas').clientHeight") > 300
    assert page.complaints == []


def two_hands_hold(page: Page) -> None:
    """For a robot with two arms the contacts of one hand can be moved while the other stays."""
    robot = ik.load_robot(BODY)
    page.evaluate(f"document.querySelector('[data-robot=\"{BODY}\"]').click()")
    page.wait(f"casadiIk.now.robot?.name === '{BODY}' && {ANSWERED}")
    settled(page)
    assert page.evaluate("casadiIk.now.solving.robot.fingers") == list(robot.fingers)
    dots = "[...document.querySelectorAll('#fingers i')].map((dot) => dot.style.background)"
    assert len(set(page.evaluate(dots))) == len(robot.fingers) == 6
    side = "document.querySelector('aside')"
    assert page.evaluate(f"{side}.scrollWidth <= {side}.clientWidth")
    q_before = joint_positions(page)
    x, y = page.evaluate("casadiIk.pixel('point 3')")
    page.drag((x, y), (x + 3, y - 3), steps=2)
    settled(page)
    after = joint_positions(page)
    assert np.linalg.norm(after[3] - q_before[3]) > 1e-3
    assert np.array_equal(after[:3], q_before[:3])
    assert current(page, "answer.status") == ik.Status.SOLVED
    points, _ = robot.contacts(np.array(page.evaluate("[...casadiIk.now.answer.q]")))
    assert np.linalg.norm(points - after, axis=1).max() <= 5.001e-3
    assert page.complaints == []


def as_in_python(module: Path) -> None:
    """The exported module gives the stored answers bit for bit, in its scene if it has one."""
    done = subprocess.run(["node", "test.mjs"], cwd=module, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads(done.stdout)
    assert (report["targets"], report["wrong"], report["refused"]) == (1000, 0, True)


# This is a single test, since building takes as long as all that follows.
def test_page_works_in_a_browser(
    tmp_path: Path,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    robot: ik.ArmHand,
) -> None:
    out, module = tmp_path / "page", tmp_path / "module"
    build(out, module, monkeypatch)
    as_in_python(module / ROBOT)
    as_in_python(module / export_prefix(None, BODY))
    browser: Browser = request.getfixturevalue("browser")
    url = (out / "index.html").as_uri()
    assert opened(browser, url, 900, 600).evaluate("document.title").startswith("cup · ")
    apple_page = opened(browser, f"{url}#robot={ROBOT}&grasp=apple", 900, 600)
    used_by_mouse(apple_page, robot, browser, url)
    two_hands_hold(opened(browser, url, 900, 600))
    used_on_a_phone(opened(browser, url, 360, 740, phone=True))


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        shutil.which("node") is None or importlib.util.find_spec("ziglang") is None,
        reason="needs node and the package ziglang",
    ),
]

WRAPPER = """
import { Solver, Status, home, motors, fingers } from "./arm.js";
const solver = await Solver.load(), found = [];
const { points, normals } = solver.contacts(home);
found.push(solver.solve(points, normals).status === Status.SOLVED);
solver.setRange(0, home[0], home[0]);
found.push(solver.solve(points, normals, home).q[0] === home[0]);
solver.setTolerance(-1, -1);
found.push(solver.solve(points, normals).status !== Status.SOLVED);
for (const wrong of [() => solver.solve([1], normals), () => solver.setRange(99, 0, 0)]) {
  try { wrong(); found.push(false); } catch (error) { found.push(error instanceof RangeError); }
}
found.push("setSolid" in solver || "COLLISION" in Status);
console.log(JSON.stringify({ found, motors, fingers }));
"""


def test_page_of_a_hand_without_a_scene(tmp_path):
    robot = ik.load_robot("ar10")
    module = tmp_path / "module"
    write_folder(module, wasm_project(robot, "arm"))
    as_in_python(module)

    (module / "use.mjs").write_text(WRAPPER)
    done = subprocess.run(["node", "use.mjs"], cwd=module, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["found"] == [True, True, True, True, True, False]
    assert tuple(report["motors"]) == tuple(robot.actuators)
    assert tuple(report["fingers"]) == tuple(robot.fingers)
    assert "setSolid" not in (module / "arm.d.ts").read_text()
