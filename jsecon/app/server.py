"""`jsecon serve`: fields over HTTP (extra `serve`).

FastAPI makes /openapi.json from the models below. Answers that a scene still knows are sent at once; others are
computed by as many threads as there are cores. A request reads only the fields: no name in it is a path.
"""

import asyncio
import contextlib
import json
import re
import tempfile
from collections.abc import AsyncIterator, Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import cv2
import numpy as np
import uvicorn
from fastapi import FastAPI, HTTPException, Query as Parameters, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, Response
from pydantic import BaseModel, ConfigDict, Field, StrictBool, StrictFloat, StrictInt, StrictStr, StringConstraints
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException as AnyHTTPException

import jsecon
from jsecon.app import verbs
from jsecon.app.access import bracketed, is_allowed_host, listen, token_for, token_matches
from jsecon.app.exports import object_records
from jsecon.app.models import with_models
from jsecon.app.records import At, Query
from jsecon.app.scene import Scene
from jsecon.app.scenes import describe_scene, find_scene, open_scenes
from jsecon.errors import InputError
from jsecon.pipeline.progress import Console
from jsecon.process import cores

MAX_BODY = 64 * 1024
"""bytes of a request's body"""
MAX_WAITING = 64
"""questions that wait for a thread; others are refused (503)"""
MAX_REQUESTS = 256
"""requests at once, the cheap ones included; uvicorn refuses others (503)"""

Text = Annotated[str, StringConstraints(strict=True, min_length=1, max_length=500, pattern=r"\S")]
Frame: TypeAlias = StrictStr | StrictInt
Name = Annotated[str | None, Field(description="Name of a field; the first by default")]
Seen = Annotated[Frame | None, Field(description="Frame from which left, right, front and behind are seen")]


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid")
    field: Name = None


class _Question(_Request):
    text: Text | None = None
    at: tuple[Frame, StrictInt, StrictInt] | None = Field(None, description="[frame, column, row]")
    by: verbs.By = "votes"
    threshold: Annotated[StrictFloat | StrictInt, Field(ge=-1, le=1)] | None = None
    all: StrictBool = False
    frame: Seen = None


class _Pair(_Request):
    a: Text
    b: Text
    frame: Seen = None


class _Selection(_Request):
    text: Text
    by: verbs.By = "votes"


class _MaskOf(_Selection):
    frame: str | None = None


class _Failure(BaseModel):
    error: str


MODELS: dict[str, type[BaseModel]] = {
    "/query": _Question,
    "/measure": _Pair,
    "/objects": _Request,
    "/selection.ply": _Selection,
    "/mask.png": _MaskOf,
}


class _AsciiResponse(JSONResponse):
    """JSON in ASCII, which can hold any text of a request."""

    def render(self, content: Any) -> bytes:
        return json.dumps(content, allow_nan=False).encode()


class _Guard:
    """Middleware that refuses requests by the rules of `jsecon.app.access`, and bodies that are too large."""

    def __init__(self, app: Any, token: str, hosts: Collection[str]):
        self._app = app
        self._token = token
        self._hosts = hosts

    async def __call__(self, scope: dict, receive: Callable, send: Callable) -> None:
        if scope["type"] != "http":
            return await self._app(scope, receive, send)
        if (refusal := self._refusal(Headers(scope=scope), scope["method"])) is not None:
            response = JSONResponse({"error": refusal[1]}, refusal[0], headers={"connection": "close"})
            return await response(scope, receive, send)
        size = 0

        async def limited() -> Any:
            nonlocal size
            message = await receive()
            size += len(message.get("body", b""))
            if size > MAX_BODY:
                raise HTTPException(413, f"The body has more than {MAX_BODY} bytes.", {"connection": "close"})
            return message

        await self._app(scope, limited, send)

    def _refusal(self, headers: Headers, method: str) -> tuple[int, str] | None:
        """The status and the message of a request that is refused."""
        if self._token:
            if not token_matches(headers.get("authorization", "").encode("latin-1"), f"Bearer {self._token}"):
                return 401, "A token is required. Send the header Authorization: Bearer TOKEN."
        elif not is_allowed_host(headers.get("host", ""), self._hosts):
            return 403, "The Host header does not name this server. Allow it with jsecon serve --allow-host NAME."
        kind = headers.get("content-type", "").partition(";")[0].strip().lower()
        if method == "POST" and kind != "application/json":  # what a page of another site can send without asking
            return 415, "The body must be JSON. Send the header Content-Type: application/json."
        return None


def application(scenes: Mapping[str, Scene], *, token: str = "", hosts: Collection[str] = ()) -> FastAPI:
    """Makes the ASGI application of scenes by name, the first of which is the default.

    Requests must carry the token, or without one name this machine: by loopback or one of `hosts`.
    """
    threads = ThreadPoolExecutor(cores(), thread_name_prefix="jsecon-answer")
    pending = 0

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        yield
        threads.shutdown(cancel_futures=True)

    app = FastAPI(
        title="jsecon",
        version=jsecon.__version__,
        docs_url=None,  # its page loads scripts of another host; the page at / lists the paths instead
        redoc_url=None,
        redirect_slashes=False,
        default_response_class=_AsciiResponse,
        lifespan=lifespan,
        responses={status: {"model": _Failure} for status in (400, 404, 422, 503)},
    )
    app.add_middleware(_Guard, token=token, hosts=hosts)

    def scene_of(request: _Request) -> Scene:
        try:
            return find_scene(scenes, request.field)
        except InputError as error:
            raise HTTPException(404, f'Field "field": {error}') from error

    async def compute(work: Callable[[], Any], part: str) -> Any:
        """Runs a function in a thread; `part` is the part of the request that its InputError is about."""
        nonlocal pending
        if pending >= cores() + MAX_WAITING:
            raise HTTPException(503, "Too many questions wait for an answer. Try again.")
        pending += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(threads, work)
        except InputError as error:
            raise HTTPException(422, f'Field "{part}": {_in_words_of_the_api(str(error))}') from error
        finally:
            pending -= 1

    @app.post("/query", summary="Count, score and place of the answer to a text or a pixel")
    async def query(request: _Question) -> Response:
        scene = scene_of(request)
        if (request.text is None) == (request.at is None):
            raise HTTPException(422, 'Field "text": give it, or "at", and not both.')
        part, question = ("text", request.text) if request.at is None else ("at", At(*request.at))
        options = {"by": request.by, "threshold": request.threshold, "all_of_class": request.all}

        def work() -> Any:
            return scene.ask(Query(question, frame=request.frame, **options))

        answer = await compute(work, part)
        return _AsciiResponse({"field": scene.name} | answer.as_dict())

    @app.post("/measure", summary="Distances between two objects: surfaces, centres, free gap, angle")
    async def measure(request: _Pair) -> Response:
        scene = scene_of(request)
        distances = await compute(lambda: scene.measure(request.a, request.b, frame=request.frame), "a or b")
        return _AsciiResponse({"field": scene.name} | distances)

    @app.get("/objects", summary="The objects of a field: names, boxes, Gaussians")
    async def objects(request: Annotated[_Request, Parameters()]) -> Response:
        scene = scene_of(request)
        rows = await compute(lambda: object_records(scene.objects()), "field")
        return _AsciiResponse({"field": scene.name, "objects": rows})

    @app.get("/selection.ply", summary="The selected Gaussians in the capture's world")
    async def selection(request: Annotated[_Selection, Parameters()]) -> Response:
        scene = scene_of(request)

        def work() -> bytes:
            answer = scene.ask(request.text, by=request.by)
            if not len(answer.rows):
                raise InputError(f"query {request.text!r}", "no Gaussian is selected", remedy="Ask with other words.")
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder, "selection.ply")
                scene.export(file, answer)
                return file.read_bytes()

        return Response(await compute(work, "text"), media_type="application/octet-stream")

    @app.get("/mask.png", summary="The selection alone in a frame, alpha above 0.7")
    async def mask(request: Annotated[_MaskOf, Parameters()]) -> Response:
        scene = scene_of(request)
        frame = None
        if request.frame is not None:
            frame = await compute(lambda: scene.frame_index(request.frame), "frame")

        def work() -> tuple[int, np.ndarray]:
            answer = scene.ask(request.text, by=request.by)
            index = [*scene.best_frames(answer, 1), 0][0] if frame is None else frame
            return index, scene.mask(answer, index)

        index, pixels = await compute(work, "text")
        image = cv2.imencode(".png", pixels.astype(np.uint8) * 255)[1].tobytes()
        name = re.sub("[^ -~]", "?", scene.field.names[index])
        return Response(image, media_type="image/png", headers={"x-frame": name})

    @app.get("/healthz", summary="The fields and their frames")
    async def health() -> Response:
        return _AsciiResponse({"status": "ok", "fields": [describe_scene(scene) for scene in scenes.values()]})

    @app.get("/", include_in_schema=False)
    async def page() -> Response:
        rows = ""
        for path, operations in app.openapi()["paths"].items():
            for method, operation in operations.items():
                rows += f"<li><code>{method.upper()} {path}</code> {operation['summary']}</li>"
        return HTMLResponse(f"<!doctype html><title>jsecon</title><h1>jsecon</h1><ul>{rows}</ul>")

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        status, message = _invalid(request.url.path, error)
        return _AsciiResponse({"error": message}, status)

    @app.exception_handler(AnyHTTPException)
    async def refused(request: Request, error: Exception) -> Response:
        assert isinstance(error, AnyHTTPException)
        return _AsciiResponse({"error": error.detail}, error.status_code, error.headers)

    @app.exception_handler(500)
    async def failed(request: Request, error: Exception) -> Response:
        return _AsciiResponse({"error": "Internal error. The server's log has it."}, 500)

    return app


def _invalid(path: str, error: RequestValidationError) -> tuple[int, str]:
    """The status and the message of a request that does not fit its model."""
    faults = error.errors()
    known = MODELS[path].model_fields
    unknown = [fault["loc"][1] for fault in faults if fault["type"] == "extra_forbidden"]
    if isinstance(error.body, dict):  # pydantic does not tell which of odd names
        unknown = [name for name in error.body if name not in known]
    if unknown:
        names = ", ".join(sorted(repr(name)[:60] for name in unknown)[:5])
        return 422, f"Unknown fields: {names}. {path} takes {', '.join(known)}."
    if faults[0]["type"] == "json_invalid":
        return 400, f"The body is not JSON: {faults[0]['ctx']['error']}."
    if len(faults[0]["loc"]) < 2:
        return 400, 'The body must be a JSON object, such as {"text": "red mug"}.'
    return 422, f'Field "{faults[0]["loc"][1]}": {faults[0]["msg"]}.'


def _in_words_of_the_api(message: str) -> str:
    """Replaces the options of the command line in a message by the fields of a request: --at becomes "at"."""
    message = message.replace("--at FRAME X Y", '"at": [frame, column, row]')
    return re.sub(r"--([a-z]+)", r'"\1"', message)


def prepare(
    files: Sequence[Path], *, host: str, port: int, token: str, embedder: Path | None, hosts: Collection[str] = ()
) -> tuple[dict[str, Any], Callable[[], None]]:
    """Opens fields and listens; returns address and fields, and the function that answers requests until it is stopped.

    `port` 0 takes a free one, `token` "" that of the environment, and `hosts` are names of this machine.
    """
    token = token_for(host, token)
    listening = listen(host, port)
    scenes = open_scenes(files, embedder)
    app = application(scenes, token=token, hosts=(host, *hosts))
    options: dict[str, Any] = {"timeout_keep_alive": 5, "limit_concurrency": MAX_REQUESTS}
    config = uvicorn.Config(app, log_level="warning", ws="none", server_header=False, **options)
    address = f"http://{bracketed(host)}:{listening.getsockname()[1]}"
    description = {"address": address, "fields": [describe_scene(scene) for scene in scenes.values()]}
    return description, lambda: uvicorn.Server(config).run(sockets=[listening])


def _serve(verb: verbs.Serve, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon serve`; the result is as of `prepare`, with its function under "then"."""
    access = {"host": verb.host, "port": verb.port, "token": verb.token, "hosts": verb.allow_host}
    with console.progress("fields"):
        embedder = with_models(verb, console, yes=False).embedder
        result, serve = prepare(verb.fields, embedder=embedder, **access)
    for scene in result["fields"]:
        console.print_line(f"{scene['name']}: {scene['gaussians']} Gaussians, {scene['regions']} regions")
    console.print_line(result["address"])
    return result | {"then": serve}
