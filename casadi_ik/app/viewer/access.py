"""Servers of pages, and access control.

Host, Origin and token of every request are checked before viser handles it. Browsers send requests
of any web page, websockets included, to this machine and name the page in `Origin`. A page whose
host name resolves to this machine (DNS rebinding) is recognisable by `Host`. viser checks neither.
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

connection_logger = logging.getLogger(f"{__name__}.connections")
"""Logger of connections and the reasons for their end; silent unless a handler is added."""
connection_logger.addHandler(logging.NullHandler())
connection_logger.propagate = False

HOST = "127.0.0.1"
"""Default host: only this machine can open a page."""

PORT = 8080
"""First port to try."""


Handler = Callable[[ServerConnection], Awaitable[None]]

LOOPBACK = ("127.0.0.1", "localhost", "::1")
"""Hosts at which only this machine can open a page."""

_PATCH_LOCK = threading.Lock()
"""Lock held while `websockets.asyncio.server.serve`, which viser calls, is patched."""


@dataclass
class Access:
    """Access control of a page.

    Attributes:
        host: Address at which the page is served.
        token: First component of the path of every request; "": no token is required.
        title: Title of the browser's tab.
        on_dark_theme: Function that receives whether the first browser prefers dark pages; None if
            the theme is set.
    """

    host: str
    token: str = ""
    title: str = "casadi_ik"
    on_dark_theme: Callable[[bool], None] | None = None

    def refusal(self, request: Request) -> str:
        """Return the reason why a request is refused; "" if it is allowed."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_valid_host(hosts[0]):
            return "Host: expected the address of this machine"
        if any(urlsplit(origin).netloc.lower() != hosts[0].lower() for origin in origins):
            return "Origin: expected this page"
        path_token = request.path.split("?")[0].split("/")[1:2]
        if self.token and not hmac.compare_digest(
            "".join(path_token).encode(), self.token.encode()
        ):
            return "path: expected the complete address that was printed, with its token"
        return ""

    def _is_valid_host(self, host: str) -> bool:
        """Return True if a Host header names this machine or is an address.

        An address cannot be rebound to another machine, a name can.
        """
        name = urlsplit(f"//{host}").hostname or ""
        if name in LOOPBACK or name == self.host.lower():
            return True
        if self.host in LOOPBACK:
            return False
        machine = socket.gethostname().lower()
        return name in (machine, f"{machine}.local") or _is_address(name)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


@contextlib.contextmanager
def checked_server(access: Access) -> Iterator[threading.Event]:
    """Patch viser so that every request is checked, and clients and messages are validated.

    Yields:
        Event that is set once the access control is installed.
    """
    installed = threading.Event()

    def serve(handler: Handler, *arguments: Any, **options: Any) -> Any:
        installed.set()
        options["process_request"] = _checking(access, options.get("process_request"))
        return original_serve(_validating(handler), *arguments, **options, logger=connection_logger)

    # viser warns about every browser that disconnects early.
    warnings.filterwarnings("ignore", r"\[viser\]|Queued a ")
    with _PATCH_LOCK:
        original_serve = websocket_server.serve
        websocket_server.serve = serve  # type: ignore[assignment, misc]
        try:
            yield installed
        finally:
            websocket_server.serve = original_serve  # type: ignore[misc]


def _checking(access: Access, process: Any) -> Any:
    def process_request(connection: ServerConnection, request: Request) -> Response | None:
        try:
            refusal = access.refusal(request)
        except ValueError as error:  # the Host header is not an address
            refusal = str(error)
        if refusal:
            return connection.respond(HTTPStatus.FORBIDDEN, f"{refusal}\n")
        path = request.path.removeprefix(f"/{access.token}") if access.token else request.path
        if path in (f"{THEME_PATH}dark", f"{THEME_PATH}light"):
            callback, access.on_dark_theme = access.on_dark_theme, None
            if callback is not None:
                callback(path == f"{THEME_PATH}dark")
            return connection.respond(HTTPStatus.OK, "")
        if path.split("?")[0] not in ("", "/"):
            return process(connection, Request(path, request.headers))
        # The body is changed below, so it must not be compressed.
        headers = ((k, v) for k, v in request.headers.raw_items() if k.lower() != "accept-encoding")
        return _set_page_title(
            process(connection, Request(path or "/", Headers(headers))), access.title
        )

    return process_request


THEME_PATH = "/theme/"
"""Path below which a browser reports whether it prefers dark pages."""

HEAD_SCRIPT = """<noscript>This page needs JavaScript.</noscript><script>
if (!document.createElement("canvas").getContext("webgl2")) document.addEventListener(
  "DOMContentLoaded", () => document.body.insertAdjacentHTML("afterbegin",
  "<p role='alert' style='position:fixed;z-index:9999;margin:1em;padding:1em;background:#fff3cd;"
  + "color:#333;border-radius:0.4em'>This page needs WebGL 2: enable hardware acceleration in the "
  + "settings of the browser, or use another browser.</p>"));
fetch(location.pathname.replace(/\\/?$/, "/theme/")
  + (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"));
</script></head>"""
"""Notice in browsers without JavaScript or WebGL 2, and the report of the preferred theme."""


def _set_page_title(page: Response | None, title: str) -> Response | None:
    """Set the title of the browser's tab, and add `HEAD_SCRIPT`."""
    if page is not None:
        title_tag = f"<title>{html.escape(title)} · casadi_ik</title>"
        page.body = page.body.replace(b"<title>Viser</title>", title_tag.encode())
        page.body = page.body.replace(b"</head>", HEAD_SCRIPT.encode(), 1)
        del page.headers["Content-Length"]
        page.headers["Content-Length"] = str(len(page.body))
    return page


def _validating(handler: Handler) -> Handler:
    """Wrap a handler: close connections of other clients, and refuse invalid messages.

    Both are logged at debug level only.
    """

    def log_exception(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        logger.debug("%s", context.get("message"), exc_info=context.get("exception"))

    async def handle(connection: ServerConnection) -> None:
        asyncio.get_running_loop().set_exception_handler(log_exception)
        expected, actual = f"viser-v{viser.__version__}", connection.subprotocol
        if actual != expected:
            await connection.close(1002, f"Version mismatch. Client: {actual}, Server: {expected}")
            return
        receive = connection.recv

        async def receive_valid(*arguments: Any, **options: Any) -> Any:
            message = await receive(*arguments, **options)
            reject_invalid_update(message)
            return message

        connection.recv = receive_valid  # type: ignore[method-assign]
        await handler(connection)

    return handle


def reject_invalid_update(message: str | bytes) -> None:
    """Reject messages that update any property of a control but its value; viser accepts them.

    Raises:
        ValueError: The message is malformed or updates another property.
    """
    if not isinstance(message, bytes):
        raise ValueError("message: found a text, expected bytes")
    content = msgspec.msgpack.decode(message)
    if content.get("type") == "GuiUpdateMessage" and set(content["updates"]) != {"value"}:
        raise ValueError(f"updates: found {set(content['updates'])}, expected the value")


# Servers.


class Server(viser.ViserServer):
    """A viser server without the public tunnel that any browser could request.

    Attributes:
        access: Access control.
        camera: Initial camera of browsers that open the page; None: not set yet.
    """

    access: Access
    camera: Any = None

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing: pages are not shared publicly."""

    def disconnect_share_url(self) -> None:
        """Do nothing: pages are not shared publicly."""


class Viewer:
    """Running page; all browsers that open it display and move the same robot.

    Attributes:
        url: Address of the page.
        page: Content of the page.
    """

    def __init__(self, server: Server, page: Any) -> None:
        """Store server and page, and follow the page when another one replaces it."""
        self._server, self.page = server, page
        page.on_replaced = self._replace_page
        self.url = f"http://{_url_host(server.get_host())}:{server.get_port()}"
        if server.access.token:
            self.url += f"/{server.access.token}/"

    def __repr__(self) -> str:
        return f"<Viewer {self.url}>"

    def _repr_html_(self) -> str:
        """Return the page as a frame for notebooks."""
        return f'<iframe src="{self.url}" width="100%" height="600" frameborder="0"></iframe>'

    def _replace_page(self, page: Any) -> None:
        self.page, page.on_replaced = page, self._replace_page

    def to_html(self, path: str | os.PathLike[str] | None = None, dark: bool = False) -> str:
        """Return the scene as a page that needs no server; its camera moves, its content is fixed.

        Args:
            path: File to write; None: none.
            dark: Use the dark theme.

        Returns:
            The page, about a megabyte of text, for documents and notebooks.

        Example:
            >>> viewer = robot.view()
            >>> text = viewer.to_html()
            >>> viewer.stop()
        """
        selection = self.page.selection
        self.page.select("")  # drag handles of a selection need a server
        self.page.work.settle()
        text = self._server.scene.as_html(dark_mode=dark)
        self.page.select(selection)
        text = text.replace("<title>Viser</title>", f"<title>{self._server.access.title}</title>")
        if path is not None:
            with atomic_write(Path(path)) as part:
                part.write_text(text, encoding="utf-8")
        return text

    def stop(self) -> None:
        """Stop the page and its server."""
        self.page.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def wait(self) -> None:
        """Serve until a keyboard interrupt, then stop."""
        with contextlib.suppress(KeyboardInterrupt):
            self._server.sleep_forever()
        self.stop()


def serve(host: str = HOST, port: int | None = None, secret: bool = False) -> Server:
    """Start a server with an empty page.

    Args:
        host: Address at which the page is served; "0.0.0.0": reachable from the network.
        port: Port; None: the first free one from 8080 on.
        secret: Require a token in the address.

    Raises:
        InputError: The port is in use, or the host is not an address of this machine.
        UnsupportedError: Access control cannot be installed in this version of viser.
    """
    ports = range(PORT, PORT + 100) if port is None else (port,)
    free = next((candidate for candidate in ports if _is_free(host, candidate)), None)
    if free is None:
        ports_text = f"{port}" if port is not None else f"{PORT} to {PORT + 99}"
        raise InputError(f"port: {ports_text} is in use on {host}; expected a free port")
    access = Access(host, secrets.token_urlsafe(16) if secret else "")
    with checked_server(access) as installed, contextlib.redirect_stdout(io.StringIO()):
        server = Server(host=host, port=free, verbose=False)
    if not installed.is_set():
        server.stop()
        raise UnsupportedError(
            f"viser {viser.__version__} is not supported: access control could not be installed"
        )
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


def _url_host(host: str) -> str:
    if host in ("0.0.0.0", "::", ""):
        return "127.0.0.1"
    return f"[{host}]" if ":" in host else host
