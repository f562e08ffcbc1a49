"""Who may open a page: Host, Origin and token of every request are looked at before viser is.

A browser sends any web page's requests to this machine, websockets too, and says in `Origin` whose
they are; a page that had its own name lead here says so in `Host`. viser looks at neither.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import logging
import socket
import threading
import warnings
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import msgspec.msgpack
import viser
from websockets.asyncio import server as websocket_server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

logger = logging.getLogger(__name__)

connections = logging.getLogger(f"{__name__}.connections")
"""Told of every connection and why it ended; goes nowhere unless somebody adds a handler."""
connections.addHandler(logging.NullHandler())
connections.propagate = False

Handler = Callable[[ServerConnection], Awaitable[None]]

LOOPBACK = ("127.0.0.1", "localhost", "::1")
"""Where nobody else sees a page."""

_HOOK = threading.Lock()
"""Pages are made one after the other: what viser calls is exchanged meanwhile."""


@dataclass(frozen=True)
class Access:
    """Who may open a page.

    Attributes:
        host: The address it is served at.
        token: First part of the path of every request; "": none is expected.
    """

    host: str
    token: str = ""

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


@contextmanager
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

    warnings.filterwarnings("ignore", r"\[viser\]")
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
        return then(connection, Request(path or "/", request.headers))

    return process_request


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
