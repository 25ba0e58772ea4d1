"""Access rules of jsecon's servers: where they listen, and what a request must carry.

A page of another site can send requests to a server on loopback under a name that it has made to stand for 127.0.0.1
(DNS rebinding). So without a token, a request must name this machine in its Host header. Beyond loopback it must carry
the token.
"""

import contextlib
import hashlib
import hmac
import http
import ipaddress
import os
import socket
from collections.abc import Callable, Collection, Iterator
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from jsecon.errors import InputError, describe_error

TOKEN = "JSECON_TOKEN"
"""environment variable with the token, used without --token"""


def _is_loopback(host: str) -> bool:
    """Returns whether a host is this machine and cannot be reached by others: localhost, 127.0.0.0/8 or ::1."""
    try:
        return ipaddress.ip_address(host.strip("[]").partition("%")[0]).is_loopback
    except ValueError:
        return host.rstrip(".").lower() == "localhost"


def _host_of(header: str) -> str:
    """Returns the host of a Host header in lower case, without port and brackets; "" if the header has no host."""
    try:
        name = urlsplit(f"//{header}").hostname
    except ValueError:
        return ""
    return (name or "").rstrip(".")


def is_allowed_host(header: str, hosts: Collection[str]) -> bool:
    """Checks whether a Host header names this machine.

    Args:
      header: Value of the header.
      hosts: Names of this machine besides those of loopback.

    Returns:
      Whether it does.
    """
    host = _host_of(header)
    return bool(host) and (_is_loopback(host) or host in {_host_of(bracketed(name)) for name in hosts})


def token_matches(sent: str | bytes, token: str) -> bool:
    """Compares tokens in a time that does not depend on where they differ.

    Args:
      sent: Token of the request.
      token: The right token.

    Returns:
      Whether they are equal.
    """
    sent = sent.encode("utf-8", "surrogateescape") if isinstance(sent, str) else sent
    return hmac.compare_digest(sent, token.encode("utf-8", "surrogateescape"))


def token_for(host: str, token: str) -> str:
    """Finds the token that clients must have.

    Args:
      host: Address to listen on.
      token: Token of the user; "" is that of the environment.

    Returns:
      The token, or "" if no token is needed.

    Raises:
      InputError: Others can reach the host, and there is no token.
    """
    token = token or os.environ.get(TOKEN, "")
    if not token and not _is_loopback(host):
        problem = f"others can reach {host}, so there must be a token that clients must have"
        raise InputError("--host", problem, remedy="Set --token, or leave --host out to listen on 127.0.0.1 alone.")
    return token


def listen(host: str, port: int) -> socket.socket:
    """Opens a socket that listens, of IPv4 or IPv6.

    Args:
      host: Name or address of this machine.
      port: Port; 0 takes a free one.

    Returns:
      The socket.

    Raises:
      InputError: The address cannot be used.
    """
    try:
        addresses = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)
        family, _, _, _, address = min(addresses, key=lambda info: info[0] != socket.AF_INET)
        return socket.create_server((address[0], port, *address[2:]), family=family)
    except (OSError, OverflowError, ValueError) as error:
        reason = describe_error(error) if isinstance(error, OSError) else "it is not an address"
        remedy = "Take another --port, or 0 to have one chosen. --host must be an address of this machine."
        raise InputError("--port", f"cannot listen on {bracketed(host)}:{port} ({reason})", remedy=remedy) from error


def bracketed(host: str) -> str:
    """Writes a host as it stands in a URL.

    Args:
      host: Name or address.

    Returns:
      The host, an IPv6 address in brackets.
    """
    return f"[{host}]" if ":" in host and not host.startswith("[") else host


@contextlib.contextmanager
def guarded_pages(token: str, hosts: Collection[str]) -> Iterator[None]:
    """Guards the viser servers that are started inside of this context.

    viser has no hook for requests, so this wraps the function of the package websockets by which it listens, while the
    server starts.

    Args:
      token: Token that pages and sockets need; "" takes requests whose Host header names this machine.
      hosts: Names of this machine besides those of loopback.

    Yields:
      None.

    Raises:
      RuntimeError: This viser listens in another way, so its page would be open to everybody.
    """
    import websockets.asyncio.server as sockets

    listen = sockets.serve
    wrapped = []

    def serve(handler: Any, *address: Any, process_request: Callable[..., Any], **kwargs: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            return _refusal(request, token, hosts) or process_request(connection, request)

        wrapped.append(True)
        return listen(handler, *address, process_request=checked, **kwargs)

    sockets.serve = serve  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        sockets.serve = listen
    if not wrapped:
        raise RuntimeError("this viser does not listen through websockets.asyncio.server.serve")


def _refusal(request: Any, token: str, hosts: Collection[str]) -> Any:
    """Returns the response to a request that may not see the page, None for one that may go on.

    A request whose address carries the token is sent to the page with a cookie in its place.
    """
    host = request.headers.get("Host", "")
    origin = request.headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
        return _response(http.HTTPStatus.FORBIDDEN, "A page of another site asked for this one.")
    if not token:
        if is_allowed_host(host, hosts):
            return None
        words = "The Host header does not name this server. Allow it with jsecon view --allow-host NAME."
        return _response(http.HTTPStatus.FORBIDDEN, words)
    name = f"jsecon_{hashlib.sha256(token.encode('utf-8', 'surrogateescape')).hexdigest()[:12]}"
    try:
        cookie = SimpleCookie(request.headers.get("Cookie", "")).get(name)
    except CookieError:
        cookie = None
    secret = hashlib.sha256(b"cookie " + token.encode("utf-8", "surrogateescape")).hexdigest()
    if cookie is not None and token_matches(cookie.value, secret):
        return None
    sent = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
    if token_matches(sent, token):
        headers = {"Location": "/", "Set-Cookie": f"{name}={secret}; Path=/; HttpOnly; SameSite=Strict"}
        return _response(http.HTTPStatus.FOUND, "", headers)
    return _response(http.HTTPStatus.UNAUTHORIZED, "A token is required. Open the address that jsecon view printed.")


def _response(status: http.HTTPStatus, words: str, headers: dict[str, str] | None = None) -> Any:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    body = words.encode()
    fields = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))}
    fields |= {"Cache-Control": "no-store"} | (headers or {})
    return Response(status, status.phrase, Headers(**fields), body)
