"""Pages that are served, and who may open them.

Host, Origin and token of every request are looked at before viser is: a browser sends any web
page's requests to this machine, websockets too, and says in `Origin` whose they are; a page that
had its own name lead here says so in `Host`. viser looks at neither.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hmac
import html
import io
import ipaddress
import logging
import os
import secrets
import socket
import threading
import warnings
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec.msgpack
import viser
from websockets.asyncio import server as websocket_server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from casadi_ik.errors import InputError, UnsupportedError
from casadi_ik.files.writing import atomic_write

logger = logging.getLogger(__name__)

connections = logging.getLogger(f"{__name__}.connections")
"""Told of every connection and why it ended; goes nowhere unless somebody adds a handler."""
connections.addHandler(logging.NullHandler())
connections.propagate = False

HOST = "127.0.0.1"
"""Only this machine sees a page unless more is asked for."""

PORT = 8080
"""The first that is tried."""


Handler = Callable[[ServerConnection], Awaitable[None]]

LOOPBACK = ("127.0.0.1", "localhost", "::1")
"""Where nobody else sees a page."""

_HOOK = threading.Lock()
"""Pages are made one after the other: what viser calls is exchanged meanwhile."""


@dataclass
class Access:
    """Who may open a page, and what it is called.

    Attributes:
        host: The address it is served at.
        token: First part of the path of every request; "": none is expected.
        title: On the browser's tab.
    """

    host: str
    token: str = ""
    title: str = "casadi_ik"

    def refusal(self, request: Request) -> str:
        """Why a request is refused, "" if it is not."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_own(hosts[0]):
            return "Host: expected the address of this machine"
        if any(urlsplit(one).netloc.lower() != hosts[0].lower() for one in origins):
            return "Origin: expected this page"
        given = request.path.split("?")[0].split("/")[1:2]
        if self.token and not hmac.compare_digest("".join(given).encode(), self.token.encode()):
            return "path: expected the whole address that was printed"
        return ""

    def _is_own(self, host: str) -> bool:
        """Whether a Host leads here wherever it is looked up; only names can be led elsewhere."""
        name = urlsplit(f"//{host}").hostname or ""
        if name in LOOPBACK or name == self.host.lower():
            return True
        if self.host in LOOPBACK:
            return False
        own = socket.gethostname().lower()
        return name in (own, f"{own}.local") or _is_address(name)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


@contextlib.contextmanager
def asking(access: Access) -> Iterator[threading.Event]:
    """A viser server made here asks first, and says nothing of what is no message of its pages.

    Yields:
        Set once it does: viser has no place for it but the function by which it serves.
    """
    asked = threading.Event()

    def serve(handler: Handler, *rest: Any, **how: Any) -> Any:
        asked.set()
        how["process_request"] = _asking_first(access, how.get("process_request"))
        return plain(_quiet(handler), *rest, **how, logger=connections)

    # Of browsers that are gone before they are answered it says more than anybody needs.
    warnings.filterwarnings("ignore", r"\[viser\]|Queued a ")
    with _HOOK:
        plain = websocket_server.serve
        websocket_server.serve = serve  # type: ignore[assignment, misc]
        try:
            yield asked
        finally:
            websocket_server.serve = plain  # type: ignore[misc]


def _asking_first(access: Access, then: Any) -> Any:
    def process_request(connection: ServerConnection, request: Request) -> Response | None:
        try:
            refusal = access.refusal(request)
        except ValueError as error:  # no address at all
            refusal = str(error)
        if refusal:
            return connection.respond(HTTPStatus.FORBIDDEN, f"{refusal}\n")
        path = request.path.removeprefix(f"/{access.token}") if access.token else request.path
        if path.split("?")[0] not in ("", "/"):
            return then(connection, Request(path, request.headers))
        plain = ((k, v) for k, v in request.headers.raw_items() if k.lower() != "accept-encoding")
        return _titled(then(connection, Request(path or "/", Headers(plain))), access.title)

    return process_request


WITHOUT = """<noscript>This page needs JavaScript.</noscript><script>
if (!document.createElement("canvas").getContext("webgl2")) document.addEventListener(
  "DOMContentLoaded", () => document.body.insertAdjacentHTML("afterbegin",
  "<p role='alert' style='position:fixed;z-index:9999;margin:1em;padding:1em;background:#fff3cd;"
  + "color:#333;border-radius:0.4em'>This browser has no WebGL 2, so nothing can be drawn: turn on "
  + "hardware acceleration in its settings, or use another one.</p>"));
</script></head>"""
"""What is said where a browser cannot show the page."""


def _titled(page: Response | None, title: str) -> Response | None:
    """The page itself, with its own name on the browser's tab, and words where nothing is drawn."""
    if page is not None:
        named = f"<title>{html.escape(title)} · casadi_ik</title>"
        page.body = page.body.replace(b"<title>Viser</title>", named.encode())
        page.body = page.body.replace(b"</head>", WITHOUT.encode(), 1)
        del page.headers["Content-Length"]
        page.headers["Content-Length"] = str(len(page.body))
    return page


def _quiet(handler: Handler) -> Handler:
    """The same without words about clients that are not viser's, or send what it cannot use."""

    def told(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        logger.debug("%s", context.get("message"), exc_info=context.get("exception"))

    async def handle(connection: ServerConnection) -> None:
        asyncio.get_running_loop().set_exception_handler(told)
        wanted, found = f"viser-v{viser.__version__}", connection.subprotocol
        if found != wanted:
            await connection.close(1002, f"Version mismatch. Client: {found}, Server: {wanted}")
            return
        receive = connection.recv

        async def checked(*how: Any, **more: Any) -> Any:
            message = await receive(*how, **more)
            refuse_other_updates(message)
            return message

        connection.recv = checked  # type: ignore[method-assign]
        await handler(connection)

    return handle


def refuse_other_updates(message: str | bytes) -> None:
    """Refuse what sets more of a control than its value, as no browser does: viser would.

    Raises:
        ValueError: It does, or it is no message.
    """
    if not isinstance(message, bytes):
        raise ValueError("found a text")
    found = msgspec.msgpack.decode(message)
    if found.get("type") == "GuiUpdateMessage" and set(found["updates"]) != {"value"}:
        raise ValueError(f"found updates of {set(found['updates'])}, expected the value")


# Servers.


class Server(viser.ViserServer):
    """viser's server without its public tunnel, which any browser could ask for.

    Attributes:
        access: Who may open it.
        camera: Where a browser that opens it looks from; None: not said yet.
    """

    access: Access
    camera: Any = None

    def request_share_url(self, verbose: bool = True) -> None:
        """Share nothing."""

    def disconnect_share_url(self) -> None:
        """Nothing is shared."""


class Viewer:
    """A running page; every browser that opens it sees and moves the same robot.

    Attributes:
        url: Where it is.
        page: What is on it.
    """

    def __init__(self, server: Server, page: Any) -> None:
        """Take what runs; a page that another one takes the place of tells by `opened`."""
        self._server, self.page = server, page
        page.opened = self._take
        self.url = f"http://{_shown(server.get_host())}:{server.get_port()}"
        if server.access.token:
            self.url += f"/{server.access.token}/"

    def __repr__(self) -> str:
        return f"<Viewer {self.url}>"

    def _repr_html_(self) -> str:
        """In a notebook: the page itself."""
        return f'<iframe src="{self.url}" width="100%" height="600" frameborder="0"></iframe>'

    def _take(self, page: Any) -> None:
        self.page, page.opened = page, self._take

    def to_html(self, path: str | os.PathLike[str] | None = None, dark: bool = False) -> str:
        """What is seen as a page that needs no server: it can be turned, not changed.

        Args:
            path: Where it is written as well, if anywhere.
            dark: Whether it is dark.

        Returns:
            The page, about a megabyte of text, for documents and notebooks.

        Example:
            >>> viewer = robot.view()
            >>> text = viewer.to_html()
            >>> viewer.stop()
        """
        held = self.page.held
        self.page.select("")  # nobody can drag there
        self.page.work.settle()
        text = self._server.scene.as_html(dark_mode=dark)
        self.page.select(held)
        text = text.replace("<title>Viser</title>", f"<title>{self._server.access.title}</title>")
        if path is not None:
            with atomic_write(Path(path)) as part:
                part.write_text(text, encoding="utf-8")
        return text

    def stop(self) -> None:
        """End the page."""
        self.page.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def wait(self) -> None:
        """Go on until somebody interrupts, then end the page."""
        with contextlib.suppress(KeyboardInterrupt):
            self._server.sleep_forever()
        self.stop()


def serve(host: str = HOST, port: int | None = None, secret: bool = False) -> Server:
    """An empty page.

    Args:
        host: Who may see it: the address it is served at; "0.0.0.0" is everybody in the network.
        port: Of the address; None: the first free one from 8080 on.
        secret: Whether only who has the whole address, with its token, may open it.

    Raises:
        InputError: The port is taken, or nothing can be served there.
        UnsupportedError: viser serves in a way in which nobody can be refused.
    """
    wanted = range(PORT, PORT + 100) if port is None else (port,)
    free = next((one for one in wanted if _is_free(host, one)), None)
    if free is None:
        found = f"{port}" if port is not None else f"{PORT} to {PORT + 99}"
        raise InputError(f"port: found {found}, which cannot be had at {host}; expected a free one")
    access = Access(host, secrets.token_urlsafe(16) if secret else "")
    with asking(access) as asked, contextlib.redirect_stdout(io.StringIO()):
        server = Server(host=host, port=free, verbose=False)
    if not asked.is_set():
        server.stop()
        raise UnsupportedError(f"viser {viser.__version__} cannot be told whom to refuse")
    server.access = access
    return server


def _is_free(host: str, port: int) -> bool:
    try:
        with socket.create_server((host, port)):
            return True
    except OSError as error:
        if error.errno in (errno.EADDRINUSE, errno.EACCES):
            return False
        raise InputError(f"host: found {host!r}, expected an address of this machine") from error


def _shown(host: str) -> str:
    if host in ("0.0.0.0", "::", ""):
        return "127.0.0.1"
    return f"[{host}]" if ":" in host else host
