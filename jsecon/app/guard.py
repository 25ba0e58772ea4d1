"""What stands before the server's application: who may ask, how much, how slowly; and what can be asked."""

import asyncio
import dataclasses
import hmac
import json
from collections.abc import Callable
from typing import Any

import jsecon
from jsecon.app.question import METHODS


@dataclasses.dataclass(frozen=True)
class Limits:
    """What one request may take."""

    body: int = 64 * 1024
    """bytes."""
    seconds_to_send: float = 10.0
    seconds: float = 30.0
    """of an answer."""
    waiting: int = 64
    """requests at once."""
    text: int = 500
    """characters."""


LIMITS = Limits()


class Guard:
    """Before the application: who may ask, how much, how slowly, and how many at once."""

    def __init__(self, app: Any, token: str, limits: Limits):
        self.app, self.token, self.limits, self.now = app, token, limits, 0

    async def __call__(self, scope: dict, receive: Callable, send: Callable) -> None:
        if scope["type"] == "lifespan":
            return await self.app(scope, receive, send)
        if scope["type"] != "http":
            return await send({"type": "websocket.close", "code": 1008})
        status, told, content = 503, "too many at once: come back", b""
        if self.now < self.limits.waiting:
            self.now += 1
            try:
                status, told, content = await self._body(scope, receive)
                if status == 200:
                    return await self.app(scope, _once(content, receive), send)
            finally:
                self.now -= 1
        headers = [(b"content-type", b"application/json"), (b"connection", b"close")]
        await send({"type": "http.response.start", "status": status, "headers": headers})
        await send({"type": "http.response.body", "body": json.dumps({"error": told}).encode()})

    async def _body(self, scope: dict, receive: Callable) -> tuple[int, str, bytes]:
        """(200, "", body), or a status and why."""
        headers = dict(scope["headers"])
        given = headers.get(b"authorization", b"")
        if self.token and not hmac.compare_digest(given, b"Bearer " + self.token.encode()):
            return 401, "a token is wanted: Authorization: Bearer TOKEN", b""
        parts, size = [], 0
        try:
            async with asyncio.timeout(self.limits.seconds_to_send):
                while True:
                    message = await receive()
                    if message["type"] != "http.request":
                        return 400, "the sender went away", b""
                    parts.append(message.get("body", b""))
                    size += len(parts[-1])
                    if size > self.limits.body:
                        return 413, f"at most {self.limits.body} bytes", b""
                    if not message.get("more_body"):
                        return 200, "", b"".join(parts)
        except TimeoutError:
            return 408, f"not sent within {self.limits.seconds_to_send:g} s", b""


def _once(content: bytes, receive: Callable) -> Callable:
    """A `receive` that has the whole body, and then what the server tells."""
    waiting = [{"type": "http.request", "body": content, "more_body": False}]

    async def replay() -> Any:
        return waiting.pop() if waiting else await receive()

    return replay


def paths_told() -> dict[str, str]:
    """What can be asked: verb and path -> what it takes and gives."""
    return {
        "POST /query": "{text or at: [frame, column, row], field, by, threshold, all}: count, score, and where it is",
        "GET /regions": "?field: pixels and views of each region",
        "GET /selection.ply": "?text&field&by: the selected Gaussians, in the capture's own world",
        "GET /mask.png": "?text&frame&field&by: the selection alone in a frame, alpha above 0.7",
        "GET /healthz": "the fields and their frames",
    }


def openapi(limits: Limits) -> dict[str, Any]:
    """The OpenAPI 3.1 document."""
    whole = {"type": "integer"}
    text = {"type": "string", "minLength": 1, "maxLength": limits.text}
    options: dict[str, Any] = {"text": text, "field": {"type": "string"}, "by": {"enum": list(METHODS)}}
    asked = options | {
        "at": {"type": "array", "prefixItems": [{"type": ["string", "integer"]}, whole, whole]},
        "threshold": {"type": "number", "minimum": -1, "maximum": 1},
        "all": {"type": "boolean"},
    }
    paths: dict[str, Any] = {}
    for line, told in paths_told().items():
        verb, path = line.split()
        names = {"/regions": ("field",), "/healthz": ()}.get(path, ("text", "field", "by"))
        names += ("frame",) if path == "/mask.png" else ()
        inputs = [{"name": n, "in": "query", "schema": options.get(n, {"type": "string"})} for n in names]
        operation: dict[str, Any] = {"summary": told, "responses": {"200": {"description": "the answer"}}}
        if verb == "POST":
            schema = {"type": "object", "properties": asked, "additionalProperties": False}
            operation["requestBody"] = {"content": {"application/json": {"schema": schema}}}
        else:
            operation["parameters"] = inputs
        paths[path] = {verb.lower(): operation}
    return {"openapi": "3.1.0", "info": {"title": "jsecon", "version": jsecon.__version__}, "paths": paths}
