"""What stands before the server's application: who may ask, how much, how slowly; how many questions are computed; and
what can be asked."""

import asyncio
import dataclasses
import json
import threading
from collections.abc import Callable, Collection
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jsecon
from jsecon.app.access import named, right_token
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
    """questions that are computed or wait for it."""
    requests: int = 256
    """at once, the cheap ones too."""
    text: int = 500
    """characters."""


LIMITS = Limits()


class Busy(Exception):
    """As many questions wait as may."""


class Workers:
    """Threads that compute answers: never more than `threads`, and never more than `most` questions in them or waiting.

    A question keeps its place until its thread is done with it, also where its client was told that it took too long.
    """

    def __init__(self, threads: int, most: int):
        self.most, self.taken = most, 0
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="jsecon-answer")
        self._lock = threading.Lock()

    async def compute(self, work: Callable[[], Any], seconds: float) -> Any:
        """What `work` returns or raises. Raises Busy, and TimeoutError after `seconds`: work that has not begun by then
        never does."""
        with self._lock:
            if self.taken >= self.most:
                raise Busy
            self.taken += 1
        future = self._pool.submit(work)
        future.add_done_callback(self._leave)
        return await asyncio.wait_for(asyncio.wrap_future(future), seconds)

    def _leave(self, future: Future) -> None:
        with self._lock:
            self.taken -= 1

    def close(self) -> None:
        """Ends the threads: what has begun is computed to its end, what waits is not begun."""
        self._pool.shutdown(cancel_futures=True)


class Guard:
    """Before the application: who may ask, how much, how slowly, and how many at once.

    With a token it must be sent; without one a request must name this machine, by a loopback name or one of `hosts`.
    """

    def __init__(self, app: Any, token: str, limits: Limits, hosts: Collection[str] = ()):
        self.app, self.token, self.limits, self.hosts, self.now = app, token, limits, hosts, 0

    async def __call__(self, scope: dict, receive: Callable, send: Callable) -> None:
        if scope["type"] == "lifespan":
            return await self.app(scope, receive, send)
        if scope["type"] != "http":
            return await send({"type": "websocket.close", "code": 1008})
        status, told, content = 503, "Too many requests at once. Try again.", b""
        if self.now < self.limits.requests:
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
        if self.token:
            if not right_token(headers.get(b"authorization", b""), f"Bearer {self.token}"):
                return 401, "A token is required. Send the header Authorization: Bearer TOKEN.", b""
        elif not named(headers.get(b"host", b"").decode("latin-1"), self.hosts):
            return 403, "The Host header does not name this server. Allow it with jsecon serve --allow-host NAME.", b""
        kind = headers.get(b"content-type", b"").partition(b";")[0].strip().lower()
        if scope.get("method") == "POST" and kind != b"application/json":
            return 415, "The body must be JSON. Send the header Content-Type: application/json.", b""
        parts, size = [], 0
        try:
            async with asyncio.timeout(self.limits.seconds_to_send):
                while True:
                    message = await receive()
                    if message["type"] != "http.request":
                        return 400, "The sender closed the connection.", b""
                    parts.append(message.get("body", b""))
                    size += len(parts[-1])
                    if size > self.limits.body:
                        return 413, f"The body has more than {self.limits.body} bytes.", b""
                    if not message.get("more_body"):
                        return 200, "", b"".join(parts)
        except TimeoutError:
            return 408, f"The body did not arrive within {self.limits.seconds_to_send:g} s.", b""


def _once(content: bytes, receive: Callable) -> Callable:
    """A `receive` that has the whole body, and then what the server tells."""
    waiting = [{"type": "http.request", "body": content, "more_body": False}]

    async def replay() -> Any:
        return waiting.pop() if waiting else await receive()

    return replay


TAKES: dict[str, tuple[str, ...]] = {
    "/query": ("text", "at", "field", "by", "threshold", "all"),
    "/regions": ("field",),
    "/selection.ply": ("text", "field", "by"),
    "/mask.png": ("text", "frame", "field", "by"),
    "/healthz": (),
}
"""path -> the fields of a question there"""


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
        kinds = [(name, options.get(name, {"type": "string"})) for name in TAKES[path]]
        inputs = [{"name": name, "in": "query", "required": name == "text", "schema": kind} for name, kind in kinds]
        operation: dict[str, Any] = {"summary": told, "responses": {"200": {"description": "the answer"}}}
        if verb == "POST":
            schema = {"type": "object", "properties": asked, "additionalProperties": False}
            operation["requestBody"] = {"content": {"application/json": {"schema": schema}}}
        else:
            operation["parameters"] = inputs
        paths[path] = {verb.lower(): operation}
    return {"openapi": "3.1.0", "info": {"title": "jsecon", "version": jsecon.__version__}, "paths": paths}
