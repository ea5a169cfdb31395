"""The web server of the explorer: viser's, which answers its own page and refuses requests from other sites."""

import errno
import re
import socket
import threading
from collections.abc import Sequence
from typing import Any
from urllib.parse import urlsplit

import viser
from websockets.asyncio import server as websocket

from nextview.checks import whole
from nextview.errors import UsageError

_starting = threading.Lock()


def serve(host: str, port: int) -> viser.ViserServer:
    """Serve a page that only its own scripts can drive, at a port or the next free one."""
    _check_address(host, port)
    plain = websocket.serve

    def guarded(handler: Any, *address: Any, process_request: Any, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            headers = request.headers
            reason = refused(headers.get_all("Host"), headers.get_all("Origin"), host)
            return connection.respond(403, f"{reason}\n") if reason else process_request(connection, request)

        return plain(handler, *address, process_request=check, **options)

    with _starting:  # viser has no option for a check of requests
        websocket.serve = guarded  # type: ignore[assignment, misc]
        try:
            server = viser.ViserServer(host, port, label="nextview explore", verbose=False)
        finally:
            websocket.serve = plain  # type: ignore[misc]
    server.request_share_url = lambda verbose=True: None  # no visitor opens a tunnel
    return server


def refused(hosts: Sequence[str], origins: Sequence[str], served: str) -> str | None:
    """Why a request is refused, by its headers Host and Origin; None if it is answered.

    A page of another site can reach this machine in two ways. By this machine's address: then Origin names the site.
    By a name of its own that points to this address: then Host has that name.
    """
    if len(hosts) != 1 or not (name := urlsplit(f"//{hosts[0]}").hostname):
        return "the header Host has to name one host"
    own = socket.gethostname().lower()
    is_number = ":" in name or re.fullmatch(r"[\d.]+", name)
    if not is_number and name not in ("localhost", served.lower(), own, f"{own}.local"):
        return f"no page is served under the name {name}"
    if any(urlsplit(origin).netloc.lower() != hosts[0].lower() for origin in origins):
        return "a page of another site may not drive this one"
    return None


def _check_address(host: str, port: int) -> None:
    """Try the address: viser would wait for ever."""
    whole(port, "a port", 0, 65535)
    try:
        if not host:
            raise OSError("there is no name")
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as tried:
            tried.bind(address)
    except (OSError, UnicodeError) as error:
        if getattr(error, "errno", None) != errno.EADDRINUSE:
            raise UsageError(f"no page can be served at {host!r}, port {port} ({error})") from None
