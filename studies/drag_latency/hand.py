"""A hand on a page: drags in steps, each waited for, and what they took."""

from __future__ import annotations

import importlib
import json
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from websockets.sync.client import connect

PATIENCE = 20.0
"""A step that is not drawn after so long is counted as lost [s]."""

WARM = 2
"""Steps before the first that counts: they take hold, and compile what the others use."""

HELD = {"button": "left", "buttons": 1}


@dataclass
class Drags:
    """What steps of a drag took.

    Attributes:
        rows: Times of each step that was drawn, by the page's clock [ms].
        steps: How many there were.
        cpu: CPU time a step by process [ms], with all that follows until the next step.
        notes: Other figures, by what they are.
    """

    rows: list[dict[str, float]] = field(default_factory=list)
    steps: int = 0
    cpu: dict[str, float] = field(default_factory=dict)
    notes: dict[str, float] = field(default_factory=dict)

    def between(self, start: str, end: str) -> np.ndarray:
        """Times [ms] from one to another."""
        return np.array([row[end] - row[start] for row in self.rows])


def browser_tools() -> ModuleType:
    """The tests' browser, which studies use as well."""
    sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
    try:
        tools = importlib.import_module("browser")
    finally:
        del sys.path[0]
    vars(tools)["PATIENCE"] = 300.0  # a picture painted in software on a busy machine
    return tools


def cpu_times(browser: Any) -> dict[str, float]:
    """CPU time of a browser's processes by kind [s]."""
    with urllib.request.urlopen(f"{browser._address}/json/version") as answer:
        address = json.loads(answer.read())["webSocketDebuggerUrl"]
    with connect(address) as socket:
        socket.send(json.dumps({"id": 1, "method": "SystemInfo.getProcessInfo"}))
        found: dict[str, float] = {}
        for one in json.loads(socket.recv(PATIENCE))["result"]["processInfo"]:
            found[one["type"]] = found.get(one["type"], 0.0) + float(one["cpuTime"])
    return found


@contextmanager
def cpu_of(browser: Any, drags: Drags, server: bool) -> Iterator[None]:
    """Notes what the steps in between take of each processor, a step."""
    before, here = cpu_times(browser), time.process_time()
    yield
    after, done = cpu_times(browser), time.process_time()
    drags.cpu = {
        name: 1e3 * (after.get(kind, 0.0) - before.get(kind, 0.0)) / (drags.steps + WARM)
        for name, kind in (("page", "renderer"), ("painting", "GPU"))
    }
    if server:
        drags.cpu["server"] = 1e3 * (done - here) / (drags.steps + WARM)


def drag(
    page: Any, places: Callable[[int], np.ndarray], steps: int, rest: float, drags: Drags
) -> None:
    """Drag something from place to place, each step once the one before is drawn.

    Args:
        page: The page.
        places: Where the pointer is at a step [pixels]; step 0 is where it takes hold.
        steps: How many.
        rest: Between what is drawn and the next step [s].
        drags: Where times go.
    """
    x, y = places(0)
    page.mouse("Moved", float(x), float(y))
    page.mouse("Pressed", float(x), float(y), clickCount=1, **HELD)
    for i in range(1, steps + WARM + 1):
        if i == WARM + 1:
            page.evaluate("window.rows = []")
        x, y = places(i)
        before, end = page.evaluate("window.rows.length"), time.monotonic() + PATIENCE
        page.mouse("Moved", float(x), float(y), **HELD)
        while page.evaluate("window.rows.length") == before and time.monotonic() < end:
            time.sleep(0.02)
        time.sleep(rest)
    page.mouse("Released", float(x), float(y), button="left", buttons=0, clickCount=1)
    drags.steps += steps
    drags.rows += page.evaluate("window.rows")
