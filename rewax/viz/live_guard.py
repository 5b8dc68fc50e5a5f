"""Keeps pages of other sites away from the live view: a browser lets any page open a socket to this machine."""

import contextlib
import ipaddress
import socket
from collections.abc import Collection, Iterator, Mapping
from typing import Any
from unittest import mock
from urllib.parse import urlsplit


def refusal(headers: Mapping[str, str], names: Collection[str]) -> str | None:
    """Why a request is refused, or None.

    Args:
      headers: of the request. A browser names in ``Origin`` the site whose page opens a socket, and in ``Host`` the
        address that it connects to; the two must be the same. Programs other than browsers send no ``Origin``.
      names: what ``Host`` may be besides an IP address, in lower case. A site may give its own name the address of this
        machine (DNS rebinding).
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    named = urlsplit(f"//{host}").hostname or ""
    if named not in names and not _is_number(named):
        return f"this page is not served as {host}: open it as {' or '.join(sorted(names))}, or by an IP address"
    if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
        return f"pages of {origin} may not connect to {host}"
    return None


def is_loopback(host: str) -> bool:
    """Whether a host's address is seen by this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def names_of(host: str) -> frozenset[str]:
    """Names by which a page that is served at this address may be opened: ``localhost``, and this machine's own."""
    if is_loopback(host):
        return frozenset({"localhost"})
    own = {name.lower() for name in (host, socket.gethostname(), socket.getfqdn())}
    return frozenset({"localhost", *(name for name in own if not _is_number(name))})


def _is_number(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


@contextlib.contextmanager
def guarded(host: str) -> Iterator[None]:
    """Servers that ``websockets`` starts in this block refuse other sites; viser offers no option for it.

    Raises:
      ValueError: nothing was started in the block, so that nothing would be guarded.
    """
    from websockets.asyncio import server

    serve, started, names = server.serve, [], names_of(host)

    def guarded_serve(*args: Any, process_request: Any = None, **options: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            reason = refusal(request.headers, names)
            if reason is not None:
                return connection.respond(403, reason + "\n")
            return None if process_request is None else process_request(connection, request)

        started.append(host)
        return serve(*args, process_request=checked, **options)

    with mock.patch.object(server, "serve", guarded_serve):
        yield
    if not started:
        raise ValueError("this version of viser cannot be kept from other sites: pip install 'viser<1.2'")


__all__ = ["guarded", "is_loopback", "names_of", "refusal"]
