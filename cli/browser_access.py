"""Limit access to the browser's viewer: to this machine unless asked otherwise, and to the viewer's own page."""

from __future__ import annotations

import errno
import ipaddress
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server


def is_loopback(host: str) -> bool:
    """Return whether a host name or address is this machine's own."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_host(host: str) -> None:
    """Refuse a host that is not an interface of this machine: the server would wait for it; an empty name means every interface.

    Raises:
        OSError: the host is not an interface of this machine.
    """
    if not host:
        raise OSError(errno.EINVAL, "an empty name would be every interface of this machine")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
    except UnicodeError as error:
        raise OSError(errno.EINVAL, "it is no name of a machine") from error
    with socket.socket(family, kind, protocol) as probe:
        probe.bind(address)


def is_own_request(headers: Any, host: str) -> bool:
    """Return whether a request with these headers may come from the viewer's own page.

    On a loopback ``host`` a request must be addressed to this machine: another server's name may resolve to this machine's address.
    """
    addressed = headers.get("Host") or ""
    origin = headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != addressed:
        return False
    return not is_loopback(host) or is_loopback(urlsplit(f"//{addressed}").hostname or "")


@contextmanager
def own_requests_only(host: str) -> Iterator[None]:
    """Let web-socket servers that start meanwhile refuse requests from other pages; viser takes any origin, without a setting."""
    library: Any = websockets.asyncio.server
    original: Callable[..., Any] = library.serve

    def guarded(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            if not is_own_request(request.headers, host):
                return connection.respond(HTTPStatus.FORBIDDEN, "not from this page\n")
            return None if process_request is None else process_request(connection, request)

        return original(*arguments, process_request=check, **options)

    library.serve = guarded
    try:
        yield
    finally:
        library.serve = original
