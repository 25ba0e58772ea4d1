"""Who sees the viewer's page: viser serves it to everybody, so each of its requests is looked at before."""

import contextlib
import hashlib
import http
from collections.abc import Callable, Collection, Iterator
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from jsecon.app.access import named, right_token


@contextlib.contextmanager
def guarded_pages(token: str, hosts: Collection[str]) -> Iterator[None]:
    """Within it viser servers are made whose pages and sockets need the token, or without one a name of this machine.

    viser takes no hook for requests, so the function of the package websockets that it listens by is wrapped while the
    server starts. Raises RuntimeError where a viser listens otherwise: it would be open to everybody.
    """
    import websockets.asyncio.server as sockets

    listen, wrapped = sockets.serve, []

    def serve(handler: Any, *place: Any, process_request: Callable[..., Any], **given: Any) -> Any:
        def looked_at(connection: Any, request: Any) -> Any:
            return refusal(request, token, hosts) or process_request(connection, request)

        wrapped.append(True)
        return listen(handler, *place, process_request=looked_at, **given)

    sockets.serve = serve  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        sockets.serve = listen
    if not wrapped:
        raise RuntimeError("this viser does not listen through websockets.asyncio.server.serve")


def refusal(request: Any, token: str, hosts: Collection[str]) -> Any:
    """The response to a request that must not see the page, or that brings the token for the first time, which then
    becomes a cookie; None for a request that may go on."""
    host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
        return _response(http.HTTPStatus.FORBIDDEN, "A page of another site asked for this one.")
    if not token:
        if named(host, hosts):
            return None
        words = "The Host header does not name this server. Allow it with jsecon view --allow-host NAME."
        return _response(http.HTTPStatus.FORBIDDEN, words)
    name = f"jsecon_{hashlib.sha256(token.encode('utf-8', 'surrogateescape')).hexdigest()[:12]}"
    try:
        kept = SimpleCookie(request.headers.get("Cookie", "")).get(name)
    except CookieError:
        kept = None
    secret = hashlib.sha256(b"cookie " + token.encode("utf-8", "surrogateescape")).hexdigest()
    if kept is not None and right_token(kept.value, secret):
        return None
    given = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
    if right_token(given, token):
        cookie = f"{name}={secret}; Path=/; HttpOnly; SameSite=Strict"
        return _response(http.HTTPStatus.FOUND, "", {"Location": "/", "Set-Cookie": cookie})
    return _response(http.HTTPStatus.UNAUTHORIZED, "A token is required. Open the address that jsecon view printed.")


def _response(status: http.HTTPStatus, words: str, headers: dict[str, str] | None = None) -> Any:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    body = words.encode()
    told = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body)), "Cache-Control": "no-store"}
    return Response(status, status.phrase, Headers(**told, **(headers or {})), body)
