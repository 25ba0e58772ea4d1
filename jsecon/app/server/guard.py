"""Limits of the server: who may send requests, how large and slow they may be, how many are computed at once."""

import asyncio
import dataclasses
import threading
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
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
    """

    body: int = 64 * 1024
    seconds_to_send: float = 10.0
    seconds: float = 30.0
    waiting: int = 64


LIMITS = Limits()


class Workers:
    """Threads that compute answers.

    Args:
      threads: Maximum number of threads.
      places: Maximum number of queries in the threads or waiting for one.
    """

    def __init__(self, threads: int, places: int):
        self._places = threading.Semaphore(places)
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="jsecon-answer")

    async def compute(self, work: Callable[[], Any], seconds: float) -> Any:
        """Runs a function in a thread. It keeps its place until it ends, also after its client got an error.

        Args:
          work: The function. If it has not begun within the time limit, it never does.
          seconds: Time limit, s.

        Returns:
          What `work` returns; its exceptions are raised here.

        Raises:
          HTTPException: 503, since all places are taken or the time limit has passed.
        """
        if not self._places.acquire(blocking=False):
            raise HTTPException(503, "Too many queries wait for an answer. Try again.")
        future = self._pool.submit(work)
        future.add_done_callback(lambda _: self._places.release())
        try:
            return await asyncio.wait_for(asyncio.wrap_future(future), seconds)
        except TimeoutError as error:
            raise HTTPException(503, f"No answer within {seconds:g} s. Try again.") from error

    def close(self) -> None:
        """Ends the threads. Work that has begun is finished, work that waits is dropped."""
        self._pool.shutdown(cancel_futures=True)


class Guard:
    """Middleware in front of the application, which refuses requests by the rules of `jsecon.app.access`.

    Args:
      app: The ASGI application.
      token: Token that requests must carry; "" takes requests that name this machine.
      limits: Limits of a request.
      hosts: Names of this machine besides those of loopback.
    """

    def __init__(self, app: Any, token: str, limits: Limits, hosts: Collection[str] = ()):
        self.app = app
        self.token = token
        self.limits = limits
        self.hosts = hosts

    async def __call__(self, scope: dict, receive: Callable, send: Callable) -> None:
        """Answers a request that is refused, and passes the others on."""
        if scope["type"] == "lifespan":
            return await self.app(scope, receive, send)
        if scope["type"] != "http":
            return await send({"type": "websocket.close", "code": 1008})
        refusal = self._refusal(Headers(scope=scope), scope["method"])
        if refusal is not None:
            status, message = refusal
            response = JSONResponse({"error": message}, status, headers={"connection": "close"})
            return await response(scope, receive, send)
        await self.app(scope, self._limited(receive), send)

    def _refusal(self, headers: Headers, method: str) -> tuple[int, str] | None:
        """Returns the status and the message of a request that is refused, or None."""
        if self.token:
            if not token_matches(headers.get("authorization", "").encode("latin-1"), f"Bearer {self.token}"):
                return 401, "A token is required. Send the header Authorization: Bearer TOKEN."
        elif not is_allowed_host(headers.get("host", ""), self.hosts):
            return 403, "The Host header does not name this server. Allow it with jsecon serve --allow-host NAME."
        kind = headers.get("content-type", "").partition(";")[0].strip().lower()
        if method == "POST" and kind != "application/json":
            return 415, "The body must be JSON. Send the header Content-Type: application/json."
        return None

    def _limited(self, receive: Callable) -> Callable:
        """Returns a `receive` that raises HTTPException for a body that is too large or arrives too slowly."""
        size = 0
        deadline = asyncio.get_running_loop().time() + self.limits.seconds_to_send
        complete = False

        async def limited() -> Any:
            nonlocal size, complete
            try:
                async with asyncio.timeout_at(None if complete else deadline):
                    message = await receive()
            except TimeoutError as error:
                raise _closing(408, f"The body did not arrive within {self.limits.seconds_to_send:g} s.") from error
            size += len(message.get("body", b""))
            if size > self.limits.body:
                raise _closing(413, f"The body has more than {self.limits.body} bytes.")
            complete = not message.get("more_body", False)
            return message

        return limited


def _closing(status: int, message: str) -> HTTPException:
    """Makes an error after which the server closes the connection, since the rest of the body is not read."""
    return HTTPException(status, message, {"connection": "close"})
