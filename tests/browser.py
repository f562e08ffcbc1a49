"""Headless Chromium for tests, controlled by the DevTools protocol."""

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
"""Path of Chromium, or None."""

FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
    *("--disable-extensions", "--disable-background-networking", "--remote-debugging-port=0"),
)

TIMEOUT = 180.0
"""Timeout of every operation [s]."""


class BrowserError(AssertionError):
    """Error of the browser or of a page."""


class Browser:
    """Browser process with an empty profile; use it in a `with` statement."""

    def __init__(self) -> None:
        assert CHROMIUM is not None
        self._folder = tempfile.mkdtemp(prefix="browser")
        self._pages: list[Page] = []
        self._process = subprocess.Popen(
            [CHROMIUM, *FLAGS, f"--user-data-dir={self._folder}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        port_file, end = Path(self._folder) / "DevToolsActivePort", time.monotonic() + TIMEOUT
        while not (port_file.is_file() and port_file.read_text().count("\n")):
            if self._process.poll() is not None or time.monotonic() > end:
                self.close()
                raise BrowserError("Chromium does not start")
            time.sleep(0.05)
        self._address = f"http://127.0.0.1:{port_file.read_text().split()[0]}"

    def open(self, url: str, width: int = 1280, height: int = 800, phone: bool = False) -> Page:
        """Open a page.

        Args:
            url: Address of the page.
            width: Width of the window [CSS pixels].
            height: Height of the window [CSS pixels].
            phone: Whether the page gets touch events and twice as many pixels.
        """
        request = urllib.request.Request(f"{self._address}/json/new?about:blank", method="PUT")
        with urllib.request.urlopen(request, timeout=TIMEOUT) as response:
            socket = json.loads(response.read())["webSocketDebuggerUrl"]
        page = Page(socket)
        self._pages.append(page)
        page.resize(width, height, phone)
        page.go(url)
        return page

    def close(self) -> None:
        """Close all pages and stop the process."""
        for page in self._pages:
            page.close()
        self._process.terminate()
        try:
            self._process.wait(TIMEOUT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        # Child processes may still write to the folder.
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
    """Page of a browser: scripts, messages, and events of mouse and touch."""

    def __init__(self, socket: str) -> None:
        # Tests of adapters run where this package is not installed.
        from websockets.sync.client import connect

        self._socket = connect(socket, max_size=None, open_timeout=TIMEOUT)
        self._numbers = itertools.count(1)
        self._complaints: list[str] = []
        self._console: list[str] = []
        self._loaded: set[str] = set()
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.call("Page.setLifecycleEventsEnabled", enabled=True)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the DevTools protocol.

        Raises:
            BrowserError: The browser rejects the call.
        """
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(TIMEOUT))
            if message.get("id") != number:
                self._record(message)
            elif "error" in message:
                raise BrowserError(f"{method}: {message['error']}")
            else:
                return message["result"]

    def go(self, url: str) -> None:
        """Load another page and wait for its end of loading."""
        navigation = self.call("Page.navigate", url=url)
        if navigation.get("errorText"):
            raise BrowserError(f"{url}: {navigation['errorText']}")
        end = time.monotonic() + TIMEOUT
        # The end of loading of the previous page may still be reported.
        while navigation.get("loaderId", "") not in {"", *self._loaded}:
            self._listen(max(end - time.monotonic(), 0.0))
            if time.monotonic() > end:
                raise BrowserError(f"{url}: not loaded in {TIMEOUT} s")

    def resize(self, width: int, height: int, phone: bool = False) -> None:
        """Set the size of the window [CSS pixels]."""
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
        """Return the JSON value of an expression, or of the promise that it returns.

        Raises:
            BrowserError: The expression throws.
        """
        result = self.call(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        if "exceptionDetails" in result:
            raise BrowserError(f"{script}: {_exception_text(result['exceptionDetails'])}")
        return result["result"].get("value")

    def wait(self, script: str, seconds: float = TIMEOUT) -> Any:
        """Wait until an expression is true, and return its value.

        Raises:
            BrowserError: The expression is still false after `seconds`.
        """
        end = time.monotonic() + seconds
        while not (value := self.evaluate(script)):
            if time.monotonic() > end:
                raise BrowserError(
                    f"{script}: {value!r} after {seconds} s; messages: {self.complaints}"
                )
            time.sleep(0.05)
        return value

    def mouse(self, kind: str, x: float, y: float, **details: Any) -> None:
        """Send a mouse event: Pressed, Moved, Released or Wheel, at x, y [CSS pixels]."""
        self.call("Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, **details)

    def click(self, x: float, y: float) -> None:
        """Press and release the left button at x, y [CSS pixels]."""
        self.drag((x, y), (x, y), steps=0)

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 10) -> None:
        """Drag with the left button from start to end [CSS pixels]."""
        button = {"button": "left", "buttons": 1}
        self.mouse("Moved", *start)
        self.mouse("Pressed", *start, clickCount=1, **button)
        for i in range(1, steps + 1):
            x, y = (a + (b - a) * i / steps for a, b in zip(start, end, strict=True))
            self.mouse("Moved", x, y, **button)
        self.mouse("Released", *end, button="left", buttons=0, clickCount=1)

    def touch(self, start: tuple[float, float], end: tuple[float, float], steps: int = 10) -> None:
        """Drag with a finger on a touch screen from start to end [CSS pixels]."""

        def send(kind: str, *positions: tuple[float, float]) -> None:
            points = [{"x": x, "y": y} for x, y in positions]
            self.call("Input.dispatchTouchEvent", type=f"touch{kind}", touchPoints=points)

        send("Start", start)
        for i in range(1, steps + 1):
            x, y = (a + (b - a) * i / steps for a, b in zip(start, end, strict=True))
            send("Move", (x, y))
        send("End")

    def screenshot(self, path: str | Path) -> None:
        """Write a PNG picture of the visible part of the page."""
        data = self.call("Page.captureScreenshot", format="png")["data"]
        Path(path).write_bytes(base64.b64decode(data))

    @property
    def complaints(self) -> list[str]:
        """Errors and warnings of the console, exceptions, and failed loads."""
        self._listen(0.0)
        return list(self._complaints)

    @property
    def console(self) -> list[str]:
        """Messages of the console."""
        self._listen(0.0)
        return list(self._console)

    def close(self) -> None:
        """Close the connection to the page."""
        self._socket.close()

    def _listen(self, seconds: float) -> None:
        """Record pending events; wait for the first one for up to `seconds`."""
        with contextlib.suppress(TimeoutError):
            while True:
                self._record(json.loads(self._socket.recv(seconds)))
                seconds = 0.0

    def _record(self, message: dict[str, Any]) -> None:
        kind, event = message.get("method"), message.get("params", {})
        if kind == "Page.lifecycleEvent":
            if event["name"] == "load":
                self._loaded.add(event["loaderId"])
        elif kind == "Runtime.consoleAPICalled":
            words = (str(a.get("value", a.get("description", ""))) for a in event["args"])
            line = f"{event['type']}: {' '.join(words)}"
            self._console.append(line)
            if event["type"] in ("error", "warning", "assert"):
                self._complaints.append(line)
        elif kind == "Runtime.exceptionThrown":
            self._complaints.append(f"exception: {_exception_text(event['exceptionDetails'])}")
        elif kind == "Log.entryAdded" and event["entry"]["level"] in ("error", "warning"):
            self._complaints.append(f"{event['entry']['level']}: {event['entry']['text']}")
        elif kind == "Network.loadingFailed" and not event.get("canceled"):
            self._complaints.append(f"not loaded: {event['errorText']}")


def _exception_text(details: dict[str, Any]) -> str:
    """Return the description of an exception."""
    return str(details.get("exception", {}).get("description", details["text"]))
