"""A real browser for tests: Chromium without a window, driven over its DevTools protocol."""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path
from types import TracebackType
from typing import Any, Self

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")

CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
"""The program, if there is one."""

FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
    *("--disable-extensions", "--disable-background-networking", "--remote-debugging-port=0"),
)

PATIENCE = 180.0
"""How long [s] anything may take."""


class BrowserError(AssertionError):
    """The page did not do what was expected."""


class Browser:
    """A browser of its own, with nothing remembered; ends with its `with` block."""

    def __init__(self) -> None:
        assert CHROMIUM is not None
        self._folder = tempfile.mkdtemp(prefix="browser")
        self._pages: list[Page] = []
        self._process = subprocess.Popen(
            [CHROMIUM, *FLAGS, f"--user-data-dir={self._folder}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        said, end = Path(self._folder) / "DevToolsActivePort", time.monotonic() + PATIENCE
        while not (said.is_file() and said.read_text().count("\n")):
            if self._process.poll() is not None or time.monotonic() > end:
                self.close()
                raise BrowserError("Chromium does not start")
            time.sleep(0.05)
        self._address = f"http://127.0.0.1:{said.read_text().split()[0]}"

    def open(self, url: str, width: int = 1280, height: int = 800, phone: bool = False) -> Page:
        """A new page of a size [CSS pixels]; `phone`: touched, twice the pixels."""
        request = urllib.request.Request(f"{self._address}/json/new?about:blank", method="PUT")
        with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
            socket = json.loads(answer.read())["webSocketDebuggerUrl"]
        page = Page(socket)
        self._pages.append(page)
        page.resize(width, height, phone)
        page.go(url)
        return page

    def close(self) -> None:
        """End it."""
        for page in self._pages:
            page.close()
        self._process.terminate()
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        # Its helpers may be writing yet.
        for _ in range(20):
            shutil.rmtree(self._folder, ignore_errors=True)
            if not Path(self._folder).exists():
                break
            time.sleep(0.05)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class Page:
    """A page: what runs in it, what it says, what a hand does to it."""

    def __init__(self, socket: str) -> None:
        # Tests of adapters run where this package is not installed.
        from websockets.sync.client import connect

        self._socket = connect(socket, max_size=None, open_timeout=PATIENCE)
        self._numbers = itertools.count(1)
        self._complaints: list[str] = []
        self._console: list[str] = []
        self._loaded: set[str] = set()
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.call("Page.setLifecycleEventsEnabled", enabled=True)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """A command of the DevTools protocol.

        Raises:
            BrowserError: It was refused.
        """
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(PATIENCE))
            if message.get("id") != number:
                self._note(message)
            elif "error" in message:
                raise BrowserError(f"{method}: {message['error']}")
            else:
                return message["result"]

    def go(self, url: str) -> None:
        """To another page, loaded when this returns."""
        went = self.call("Page.navigate", url=url)
        if went.get("errorText"):
            raise BrowserError(f"{url}: {went['errorText']}")
        end = time.monotonic() + PATIENCE
        # Of the page that was there before, the end of loading may be told yet.
        while went.get("loaderId", "") not in {"", *self._loaded}:
            self._listen(max(end - time.monotonic(), 0.0))
            if time.monotonic() > end:
                raise BrowserError(f"{url}: not loaded in {PATIENCE} s")

    def resize(self, width: int, height: int, phone: bool = False) -> None:
        """To a size [CSS pixels]."""
        scale = 2 if phone else 1
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=scale,
            mobile=phone,
        )
        self.call("Emulation.setTouchEmulationEnabled", enabled=phone)

    def evaluate(self, script: str) -> Any:
        """What an expression comes to (a promise: when it is kept), as JSON has it.

        Raises:
            BrowserError: It threw.
        """
        done = self.call(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        if "exceptionDetails" in done:
            raise BrowserError(f"{script}: {_thrown(done['exceptionDetails'])}")
        return done["result"].get("value")

    def wait(self, script: str, seconds: float = PATIENCE) -> Any:
        """The value of an expression, as soon as it is true.

        Raises:
            BrowserError: It never was.
        """
        end = time.monotonic() + seconds
        while not (value := self.evaluate(script)):
            if time.monotonic() > end:
                raise BrowserError(
                    f"{script}: {value!r} after {seconds} s; the page says {self.complaints}"
                )
            time.sleep(0.05)
        return value

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """A mouse event (`kind`: Pressed, Moved, Released, Wheel) [CSS pixels]."""
        self.call("Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, **more)

    def click(self, x: float, y: float) -> None:
        """Press and release the left button."""
        self.drag((x, y), (x, y), steps=0)

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 10) -> None:
        """The left button pressed at one place, moved, released at another [CSS pixels]."""
        held = {"button": "left", "buttons": 1}
        self.mouse("Moved", *start)
        self.mouse("Pressed", *start, clickCount=1, **held)
        for i in range(1, steps + 1):
            x, y = (a + (b - a) * i / steps for a, b in zip(start, end, strict=True))
            self.mouse("Moved", x, y, **held)
        self.mouse("Released", *end, button="left", buttons=0, clickCount=1)

    def touch(self, start: tuple[float, float], end: tuple[float, float], steps: int = 10) -> None:
        """A finger put down at one place, moved, lifted at another [CSS pixels]."""

        def send(kind: str, *places: tuple[float, float]) -> None:
            points = [{"x": x, "y": y} for x, y in places]
            self.call("Input.dispatchTouchEvent", type=f"touch{kind}", touchPoints=points)

        send("Start", start)
        for i in range(1, steps + 1):
            x, y = (a + (b - a) * i / steps for a, b in zip(start, end, strict=True))
            send("Move", (x, y))
        send("End")

    def screenshot(self, path: str | Path) -> None:
        """A picture of what is seen (PNG)."""
        data = self.call("Page.captureScreenshot", format="png")["data"]
        Path(path).write_bytes(base64.b64decode(data))

    @property
    def complaints(self) -> list[str]:
        """Errors and warnings of the console, exceptions and what could not be loaded, so far."""
        self._listen(0.0)
        return list(self._complaints)

    @property
    def console(self) -> list[str]:
        """All that was said to the console so far."""
        self._listen(0.0)
        return list(self._console)

    def close(self) -> None:
        """Forget the page."""
        self._socket.close()

    def _listen(self, seconds: float) -> None:
        """Note what was said; the first message is waited for so long."""
        with contextlib.suppress(TimeoutError):
            while True:
                self._note(json.loads(self._socket.recv(seconds)))
                seconds = 0.0

    def _note(self, message: dict[str, Any]) -> None:
        kind, said = message.get("method"), message.get("params", {})
        if kind == "Page.lifecycleEvent":
            if said["name"] == "load":
                self._loaded.add(said["loaderId"])
        elif kind == "Runtime.consoleAPICalled":
            words = (str(a.get("value", a.get("description", ""))) for a in said["args"])
            line = f"{said['type']}: {' '.join(words)}"
            self._console.append(line)
            if said["type"] in ("error", "warning", "assert"):
                self._complaints.append(line)
        elif kind == "Runtime.exceptionThrown":
            self._complaints.append(f"exception: {_thrown(said['exceptionDetails'])}")
        elif kind == "Log.entryAdded" and said["entry"]["level"] in ("error", "warning"):
            self._complaints.append(f"{said['entry']['level']}: {said['entry']['text']}")
        elif kind == "Network.loadingFailed" and not said.get("canceled"):
            self._complaints.append(f"not loaded: {said['errorText']}")


def _thrown(details: dict[str, Any]) -> str:
    return str(details.get("exception", {}).get("description", details["text"]))
