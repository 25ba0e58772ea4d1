"""Limits of the server: who may send requests, how large and slow they may be, how many are computed at once."""

import asyncio
import dataclasses
import threading
from collections.abc import Callable, Collection
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse

from jsecon.app.access import is_allowed_host, token_matches


@dataclasses.dataclass(frozen=True)
class Limits:
    """Limits of one request.

    Attributes:
      body: Size of the body, bytes.
      seconds_to_send: Time to send the body, s.
      seconds: Time to compute an answer, s.
      waiting: Number of queries that are computed or wait for it.
      requests: Number of requests at once, the cheap ones included.
    """

    body: int = 64 * 1024
    seconds_to_send: float = 10.0
    seconds: float = 30.0
    waiting: int = 64
    requests: int = 256


LIMITS = Limits()


class Busy(Exception):
    """The maximum number of queries waits already."""


class Workers:
    """Threads that compute answers.

    A query keeps its place until its thread has finished it, also after its client was told that it took too long.

    Args:
      threads: Maximum number of threads.
      most: Maximum number of queries in the threads or waiting for one.
    """

    def __init__(self, threads: int, most: int):
        self.most = most
        self.taken = 0
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="jsecon-answer")
        self._lock = threading.Lock()

    async def compute(self, work: Callable[[], Any], seconds: float) -> Any:
        """Runs a function in a thread.

        Args:
          work: The function.
          seconds: Time limit, s. Work that has not begun by then never does.

        Returns:
          What `work` returns; its exceptions are raised here.

        Raises:
          Busy: All places are taken.
          TimeoutError: The time limit has passed.
        """
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
        """Ends the threads. Work that has begun is finished, work that waits is dropped."""
        self._pool.shutdown(cancel_futures=True)


class Guard:
    """Middleware in front of the application.

    With a token, requests must carry it. Without one they must name this machine in their Host header, so that a page
    of another site cannot send requests under a name of its own (DNS rebinding).

    Args:
      app: The ASGI application.
      token: The token, or "".
      limits: Limits of a request.
      hosts: Names of this machine besides those of loopback.
    """

    def __init__(self, app: Any, token: str, limits: Limits, hosts: Collection[str] = ()):
        self.app = app
        self.token = token
        self.limits = limits
        self.hosts = hosts
        self.active = 0

    async def __call__(self, scope: dict, receive: Callable, send: Callable) -> None:
        """Answers a request that is refused, and passes the others on with their whole body."""
        if scope["type"] == "lifespan":
            return await self.app(scope, receive, send)
        if scope["type"] != "http":
            return await send({"type": "websocket.close", "code": 1008})
        if self.active >= self.limits.requests:
            return await _refusal(503, "Too many requests at once. Try again.")(scope, receive, send)
        self.active += 1
        try:
            response = self._refused(Headers(scope=scope), scope.get("method", "GET"))
            if response is None:
                body, response = await self._body(Request(scope, receive))
            if response is not None:
                return await response(scope, receive, send)
            await self.app(scope, _replay(body, receive), send)
        finally:
            self.active -= 1

    def _refused(self, headers: Headers, method: str) -> JSONResponse | None:
        """Returns the refusal that follows from the headers, or None."""
        if self.token:
            if not token_matches(headers.get("authorization", "").encode("latin-1"), f"Bearer {self.token}"):
                return _refusal(401, "A token is required. Send the header Authorization: Bearer TOKEN.")
        elif not is_allowed_host(headers.get("host", ""), self.hosts):
            words = "The Host header does not name this server. Allow it with jsecon serve --allow-host NAME."
            return _refusal(403, words)
        kind = headers.get("content-type", "").partition(";")[0].strip().lower()
        if method == "POST" and kind != "application/json":
            return _refusal(415, "The body must be JSON. Send the header Content-Type: application/json.")
        return None

    async def _body(self, request: Request) -> tuple[bytes, JSONResponse | None]:
        """Reads the body. Returns it, or a refusal."""
        body = bytearray()
        try:
            async with asyncio.timeout(self.limits.seconds_to_send):
                async for part in request.stream():
                    body += part
                    if len(body) > self.limits.body:
                        return b"", _refusal(413, f"The body has more than {self.limits.body} bytes.")
        except ClientDisconnect:
            return b"", _refusal(400, "The sender closed the connection.")
        except TimeoutError:
            return b"", _refusal(408, f"The body did not arrive within {self.limits.seconds_to_send:g} s.")
        return bytes(body), None


def _refusal(status: int, message: str) -> JSONResponse:
    return JSONResponse({"error": message}, status, headers={"connection": "close"})


def _replay(body: bytes, receive: Callable) -> Callable:
    """Returns a `receive` with the whole body first, and then the messages of the server."""
    waiting = [{"type": "http.request", "body": body, "more_body": False}]

    async def replay() -> Any:
        return waiting.pop() if waiting else await receive()

    return replay
