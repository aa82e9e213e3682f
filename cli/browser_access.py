"""Who may reach the browser's viewer: this machine alone unless asked otherwise, and the viewer's own page alone."""

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
    """Whether a host name or address is this machine's own."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_host(host: str) -> None:
    """Refuse what is no interface of this machine: the viewer's server would wait for it, and an empty name is every one.

    Raises:
        OSError: it is none.
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
    """Whether a request may come from the viewer's own page.

    Args:
        headers: of the request, by name.
        host: the interface that is listened on. On a loopback one a request must be addressed to this machine, so that no page
            of another server gets here by giving its own name this machine's address.
    """
    addressed = headers.get("Host") or ""
    origin = headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != addressed:
        return False
    return not is_loopback(host) or is_loopback(urlsplit(f"//{addressed}").hostname or "")


@contextmanager
def own_requests_only(host: str) -> Iterator[None]:
    """Servers of web sockets that are started meanwhile refuse what does not come from their own page: viser takes any origin
    and has no setting for it.
    """
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
