"""Access rules of the viewer's page: viser serves it to everybody, so each of its requests is checked before."""

import contextlib
import hashlib
import http
from collections.abc import Callable, Collection, Iterator
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from jsecon.app.access import is_allowed_host, token_matches


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
