"""Cross-origin requests, non-browser clients, and malformed messages."""

from __future__ import annotations

import socket
import subprocess
import sys
import urllib.error
import urllib.request
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec.msgpack
import numpy as np
import pytest
import viser
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.typing import Origin, Subprotocol

VERSION = f"viser-v{viser.__version__}"
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1, 0, 0, 0],
    "position": [1, 1, 1],
    "fov": 1.0,
    "near": 0.1,
    "far": 10.0,
    "image_height": 10,
    "image_width": 10,
    "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1],
}


def opened(
    url: str, host: str = "", origin: str | None = None, version: str | None = VERSION
) -> Connection:
    """Open a websocket to the address of a page, like a browser that used another host name."""
    address = urlsplit(url)
    assert address.hostname is not None
    assert address.port is not None
    named = f"ws://{host or address.netloc}{address.path.rstrip('/')}"
    connection = socket.create_connection((address.hostname, address.port))
    spoken = None if version is None else [Subprotocol(version)]
    whose = None if origin is None else Origin(origin)
    return connect(named, sock=connection, origin=whose, subprotocols=spoken, max_size=None)


def send(page: Connection, *messages: Any) -> None:
    for message in messages:
        page.send(message if isinstance(message, bytes | str) else msgspec.msgpack.encode(message))


def greeted(page: Connection) -> bool:
    """Return whether the page delivers its content."""
    send(page, CAMERA)
    return len(page.recv(120)) > 100


def fetch_page(url: str, **headers: str) -> tuple[int, bytes]:
    """Return status and text of a page."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers)) as response:
            return response.status, response.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def dragged(viewer: Any) -> dict[str, Any]:
    """Return the message of a browser that moves the first contact."""
    control = viewer.page._handles._controls[viewer.page.robot.fingers[0]].handle
    position = control.position + np.array([0.0, 0.002, 0.0])
    return {
        "type": "TransformControlsUpdateMessage",
        "name": control.name,
        "wxyz": [1, 0, 0, 0],
        "position": position.tolist(),
    }


def pressed(handle: Any) -> dict[str, Any]:
    """Return the message of a browser that presses a button."""
    return {"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": True}}


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("", "http://evil.example"),
        ("", "http://127.0.0.1:1"),
        ("", "null"),
        ("evil.example", "http://evil.example"),
        ("127.0.0.1.evil.example:8080", None),
    ],
)
def test_foreign_page_is_refused(cup: Any, host: str, origin: str | None) -> None:
    with pytest.raises(InvalidStatus) as caught:
        opened(cup.url, host, origin)
    assert caught.value.response.status_code == 403
    headers = {"Host": host or urlsplit(cup.url).netloc} | ({"Origin": origin} if origin else {})
    assert fetch_page(cup.url, **headers)[0] == 403


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost"])
def test_own_page_is_answered(cup: Any, name: str) -> None:
    """The page answers through a tunnel with another port, too."""
    address = urlsplit(cup.url)
    assert b"<html" in fetch_page(cup.url, Host=f"{name}:9999")[1].lower()
    for host in (f"{name}:{address.port}", f"{name}:9999"):
        with opened(cup.url, host, f"http://{host}") as page:
            assert greeted(page)


def test_writable_page_needs_a_token(pads, description: Path) -> None:
    address, text_before = urlsplit(pads.url), description.read_text()
    assert len(address.path) > 20
    assert fetch_page(pads.url)[0] == 200
    for path in ("", "/", "/x", address.path[:-2]):
        bare = f"http://{address.netloc}{path}"
        assert fetch_page(bare)[0] == 403
        with pytest.raises(InvalidStatus):
            opened(bare)
    with opened(pads.url, origin=f"http://{address.netloc}") as page:
        assert greeted(page)
        send(page, dragged(pads), pressed(pads.page._save_button))
        while not pads.page.message:
            page.recv(120)
    assert pads.page.work.settle(300)
    assert pads.page.message.startswith("saved to")
    assert description.read_text() != text_before


def test_disabled_button_cannot_be_pressed(description: Path, view: Any) -> None:
    text_before, viewer = (
        description.read_text(),
        view("--pads", str(description), "--host", "0.0.0.0"),
    )
    assert viewer.page._save_button.disabled
    with opened(viewer.url) as page:
        assert greeted(page)
        send(page, dragged(viewer))
        assert viewer.page.work.settle(300)
        send(page, pressed(viewer.page._save_button), CAMERA | {"fov": 0.5})
        page.ping().wait(120)
    assert viewer.page.work.settle(300)
    assert description.read_text() == text_before
    with opened(viewer.url, f"192.0.2.1:{urlsplit(viewer.url).port}") as page:  # seen from afar
        assert greeted(page)
    with pytest.raises(InvalidStatus):
        opened(viewer.url, "evil.example")


def test_sessions_share_nothing(cup: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    servers: list[Any] = []

    def tunnel(*words: Any) -> None:
        servers.append(words)
        raise RuntimeError

    monkeypatch.setattr("viser._viser.ViserTunnel", tunnel)
    with opened(cup.url) as page:
        assert greeted(page)
        send(page, {"type": "ShareUrlRequest"}, CAMERA, {"type": "ShareUrlDisconnect"})
        page.ping().wait(120)
        assert cup._server.request_share_url() is None
    assert servers == []


def test_malformed_messages_are_harmless(tmp_path: Path) -> None:
    code = (
        "import casadi_ik as ik, sys\n"
        "grasp = ik.load_grasp('cup')\n"
        "solution = ik.Solver(ik.load_robot('kuka_lwr_barrett')).solve(grasp)\n"
        "viewer = solution.view(grasp=grasp)\n"
        "panel, controls = viewer.page._panel, viewer.page._handles._controls\n"
        "print(viewer.url, panel._drag._impl.uuid, controls['thumb'].handle.name,\n"
        "      panel._motors[0]._impl.uuid, flush=True)\n"
        "sys.stdin.read(); assert viewer.page.work.settle(300); viewer.stop()\n"
        "print(viewer.page.request.grasp.contacts['thumb'].point.tolist())\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
    )
    assert process.stdout is not None
    url, menu, control, slider = process.stdout.readline().split()
    nan = float("nan")
    drag = {"type": "TransformControlsUpdateMessage", "name": control}
    values = {"type": "GuiUpdateMessage", "uuid": menu}
    broken: list[Any] = [
        "text",
        b"",
        b"\xc1",
        b"\x93\x01\x02\x03",
        {},
        {"type": "Nothing"},
        {"type": []},
        {"type": "GuiUpdateMessage"},
        CAMERA | {"fov": "wide"},
        CAMERA | {"wxyz": [1]},
        values | {"updates": {"nothing": 1}},
        values | {"updates": {"update_cb": "x"}},
        values | {"updates": {"value": "finger_2"}},
        values | {"updates": {"value": {"a": 1}}},
        values | {"updates": {"value": "no such finger"}},
        values | {"uuid": slider, "updates": {"value": "x"}},
        values | {"uuid": slider, "updates": {"value": nan}},
        drag | {"wxyz": [1, 0, 0, 0], "position": [nan, nan, nan]},
        drag | {"wxyz": [0, 0, 0, 0], "position": [0, 0, 0]},
        drag | {"wxyz": [1, 0], "position": [0.1]},
        drag | {"wxyz": [1, 0, 0, 0], "position": {"a": 1}},
        drag | {"wxyz": [1, 0, 0, 0], "position": [1e300, 0, 0]},
    ]
    with socket.create_connection((str(urlsplit(url).hostname), urlsplit(url).port or 0)) as raw:
        raw.sendall(b"\x16\x03\x01 no request at all\r\n\r\n")
        raw.recv(100)
    for version in ("viser-v0", None):
        with opened(url, version=version) as page, pytest.raises(ConnectionClosed):
            page.recv(120)
    for message in broken:
        with opened(url) as page:
            assert greeted(page)
            with suppress(ConnectionClosed):
                send(page, message)
                page.ping().wait(120)
    good = drag | {"wxyz": [1, 0, 0, 0], "position": [-0.83, 0.15, 0.41]}
    with opened(url) as page:
        assert greeted(page)
        send(page, good)
        page.ping().wait(120)
    out, err = process.communicate("", timeout=600)
    # There is no error output, and the last message takes effect.
    assert err.splitlines() == []
    assert out.splitlines() == ["[-0.83, 0.15, 0.41]"]
