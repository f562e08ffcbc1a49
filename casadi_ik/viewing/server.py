"""A page that is served: where it is, how it ends, how a notebook shows it."""

from __future__ import annotations

import contextlib
import errno
import io
import secrets
import socket
from collections.abc import Callable
from typing import Any

import viser

from casadi_ik.errors import InputError, UnsupportedError
from casadi_ik.viewing.access import Access, asking

HOST = "127.0.0.1"
"""Only this machine sees a page unless more is asked for."""

PORT = 8080
"""The first that is tried."""

TRIED = 100
"""Ports that are tried where none is asked for."""


class Server(viser.ViserServer):
    """viser's server without its public tunnel, which any browser could ask for.

    Attributes:
        token: First part of its address's path; "": it has none.
    """

    token = ""

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

    def __init__(self, server: Server, page: Any, stop: Callable[[], None]) -> None:
        """Take what runs."""
        self._server, self._stop, self.page = server, stop, page
        self.url = f"http://{_shown(server.get_host())}:{server.get_port()}"
        if server.token:
            self.url += f"/{server.token}/"

    def __repr__(self) -> str:
        return f"<Viewer {self.url}>"

    def _repr_html_(self) -> str:
        """In a notebook: the page itself."""
        return f'<iframe src="{self.url}" width="100%" height="600" frameborder="0"></iframe>'

    def stop(self) -> None:
        """End the page."""
        self._stop()
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
    wanted = range(PORT, PORT + TRIED) if port is None else (port,)
    free = next((one for one in wanted if _is_free(host, one)), None)
    if free is None:
        found = f"{port}" if port is not None else f"{PORT} to {PORT + TRIED - 1}"
        raise InputError(f"port: found {found}, which cannot be had at {host}; expected a free one")
    access = Access(host, secrets.token_urlsafe(16) if secret else "")
    with asking(access) as asked, contextlib.redirect_stdout(io.StringIO()):
        server = Server(host=host, port=free, verbose=False)
    if not asked.is_set():
        server.stop()
        raise UnsupportedError(f"viser {viser.__version__} cannot be told whom to refuse")
    server.token = access.token
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
