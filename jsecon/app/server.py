"""`jsecon serve`: fields over HTTP (extra `serve`), and the page that `jsecon view` serves.

FastAPI makes /openapi.json from the models below, and answers each question in a thread; a scene computes one at a
time. A request reads only the fields, and photographs are added in memory: no name in it is a path.

A page of another site can send requests to a server on loopback under a name that it has made to stand for 127.0.0.1
(DNS rebinding). So without a token, a request must name this machine in its Host header. Beyond loopback, where only
`jsecon serve` listens, it must carry the token.
"""

import hmac
import ipaddress
import json
import os
import re
import socket
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias
from urllib.parse import urlsplit

import numpy as np
import uvicorn
from fastapi import FastAPI, HTTPException, Query as Parameters, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from jaxtyping import Bool
from pydantic import BaseModel, ConfigDict, Field, StrictFloat, StrictInt, StrictStr, StringConstraints
from pydantic.types import Base64Bytes
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException as AnyHTTPException

import jsecon
from jsecon.app import verbs
from jsecon.app.opening import find_scene, name_fields
from jsecon.app.records import Answer, At, Query, Region
from jsecon.app.scene import Scene, open_prepared
from jsecon.app.viewer.page import answer_record, drawn_gaussians, field_page
from jsecon.change.history import events
from jsecon.errors import InputError, describe_error
from jsecon.field.membership import SHARE_THRESHOLD
from jsecon.pipeline.progress import Console

MAX_BODY, MAX_FRAME = 64 * 1024, 32 * 1024 * 1024
"""bytes of a request's body, and of one with a photograph"""

Text = Annotated[str, StringConstraints(strict=True, min_length=1, max_length=500, pattern=r"\S")]
Frame: TypeAlias = StrictStr | StrictInt
Name = Annotated[str | None, Field(description="Name of a field; the first by default")]
Seen = Annotated[Frame | None, Field(description="Frame from which left, right, front and behind are seen")]


_PoseKey = Literal["transform_matrix", "fl_x", "fl_y", "cx", "cy", "w", "h"]


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid")
    field: Name = None


Place: TypeAlias = Annotated[StrictInt | StrictFloat, Field(ge=-1e6, le=1e6)]


class _Question(_Request):
    text: Text | None = None
    at: tuple[Frame, Place, Place] | None = Field(None, description="[frame, column, row], px or shares of the frame")
    by: verbs.By = "votes"
    threshold: Annotated[StrictFloat | StrictInt, Field(ge=-1, le=1)] | None = None
    frame: Seen = None


class _Pair(_Request):
    a: Text
    b: Text
    frame: Seen = None


class _Selection(_Request):
    text: Text
    by: verbs.By = "votes"


class _NewFrame(_Request):
    name: Annotated[str, StringConstraints(pattern=r"^[\w-][\w.-]{0,80}\.(jpg|jpeg|png)$")]
    image: Base64Bytes = Field(description="The file's bytes in base64")
    pose: dict[_PoseKey, Any] | None = Field(None, description="A frame of a transforms.json; by default it is found")


class _Questions(BaseModel):
    """Texts and ids of regions, and the threshold of the page."""

    model_config = ConfigDict(extra="forbid")
    questions: list[Text | StrictInt] = Field(max_length=32)
    threshold: Annotated[StrictFloat | StrictInt, Field(ge=0, le=1)] = SHARE_THRESHOLD

    def ask(self, scene: Scene) -> list[Answer | InputError]:
        """The answer or the error of each question."""
        questions = [Region(question) if isinstance(question, int) else question for question in self.questions]
        return scene.ask_all([Query(question, threshold=self.threshold) for question in questions])


class _AsciiResponse(JSONResponse):
    """JSON in ASCII, which can hold any text of a request."""

    def render(self, content: Any) -> bytes:
        return json.dumps(content, allow_nan=False).encode()


def _is_loopback(host: str) -> bool:
    """Returns whether a host is this machine and cannot be reached by others: localhost, 127.0.0.0/8 or ::1."""
    try:
        return ipaddress.ip_address(host.strip("[]").partition("%")[0]).is_loopback
    except ValueError:
        return host.rstrip(".").lower() == "localhost"


def _is_allowed_host(header: str) -> bool:
    """Checks whether a Host header names this machine, by a name of loopback."""
    try:
        host = urlsplit(f"//{header}").hostname
    except ValueError:
        return False
    return host is not None and _is_loopback(host)


def _token_for(host: str, token: str) -> str:
    """Finds the token that clients of an address must have, or raises InputError where others reach it without one.

    A `token` of "" is that of the environment; the result is "" if no token is needed.
    """
    token = token or os.environ.get("JSECON_TOKEN", "")
    if not token and not _is_loopback(host):
        problem = f"others can reach {host}, so there must be a token that clients must have"
        raise InputError("--host", problem, remedy="Set --token, or leave --host out to listen on 127.0.0.1 alone.")
    return token


class _Guard:
    """Middleware that refuses requests from elsewhere or without the token, and bodies that are too large."""

    def __init__(self, app: Any, token: str):
        self._app = app
        self._token = token

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
            if size > (most := MAX_FRAME if scope["path"] == "/frames" else MAX_BODY):
                raise HTTPException(413, f"The body has more than {most} bytes.", {"connection": "close"})
            return message

        await self._app(scope, limited, send)

    def _refusal(self, headers: Headers, method: str) -> tuple[int, str] | None:
        """The status and the message of a request that is refused."""
        if self._token:
            sent = headers.get("authorization", "").encode("latin-1")
            if not hmac.compare_digest(sent, f"Bearer {self._token}".encode("utf-8", "surrogateescape")):
                return 401, "A token is required. Send the header Authorization: Bearer TOKEN."
        elif not _is_allowed_host(headers.get("host", "")):
            return 403, "The Host header does not name this machine. Behind a proxy, start jsecon serve with --token."
        kind = headers.get("content-type", "").partition(";")[0].strip().lower()
        if method == "POST" and kind != "application/json":  # what a page of another site can send without asking
            return 415, "The body must be JSON. Send the header Content-Type: application/json."
        return None


def application(scenes: dict[str, Scene], *, token: str = "") -> FastAPI:
    """Makes the ASGI application of scenes by name, the first of which is the default.

    Requests must carry the token, or without one name this machine.
    """
    app = FastAPI(
        title="jsecon",
        version=jsecon.__version__,
        docs_url=None,  # its page loads scripts of another host
        redoc_url=None,
        redirect_slashes=False,
        default_response_class=_AsciiResponse,
    )
    app.add_middleware(_Guard, token=token)
    adding = threading.Lock()

    @app.post("/query", summary="Count, score and place of the answer to a text or a pixel")
    def query(request: _Question) -> Response:
        scene = find_scene(scenes, request.field)
        if (request.text is None) == (request.at is None):
            raise HTTPException(422, 'Field "text": give it, or "at", and not both.')
        question = request.text or "" if request.at is None else At(*request.at)
        answer = scene.ask(question, by=request.by, threshold=request.threshold, frame=request.frame)
        return _AsciiResponse({"field": scene.name} | answer.as_dict())

    @app.post("/measure", summary="Distances between two objects: surfaces, centres, angle")
    def measure(request: _Pair) -> Response:
        scene = find_scene(scenes, request.field)
        return _AsciiResponse({"field": scene.name} | scene.measure(request.a, request.b, frame=request.frame))

    @app.get("/objects", summary="The objects of a field: names, boxes, Gaussians")
    def objects(request: Annotated[_Request, Parameters()]) -> Response:
        scene = find_scene(scenes, request.field)
        return _AsciiResponse({"field": scene.name} | scene.objects().as_dict())

    @app.get("/changes", summary="What moved, is gone or is new since a field was made, in order of time")
    def changes(request: Annotated[_Request, Parameters()]) -> Response:
        scene = find_scene(scenes, request.field)
        return _AsciiResponse({"field": scene.name, "changes": events(scene.field)})

    @app.post("/frames", summary="Adds a photograph to a field, as jsecon add does, until the server stops")
    def frames(request: _NewFrame) -> Response:
        with adding, tempfile.TemporaryDirectory() as folder:
            scene = find_scene(scenes, request.field)
            Path(folder, request.name).write_bytes(request.image)
            if request.pose is not None:
                shot = request.pose | {"file_path": request.name}
                Path(folder, "transforms.json").write_text(json.dumps({"frames": [shot]}))
            scenes[scene.name] = grown = scene.add(folder)
        return _AsciiResponse({"field": scene.name, "frames": len(grown.field.names)})

    @app.get("/selection.ply", summary="The selected Gaussians in the capture's world")
    def selection(request: Annotated[_Selection, Parameters()]) -> Response:
        scene = find_scene(scenes, request.field)
        return _ply_response(scene, scene.ask(request.text, by=request.by).mask)

    @app.get("/healthz", summary="The fields and their frames")
    async def health() -> Response:
        return _AsciiResponse({"status": "ok", "fields": [_describe(scene) for scene in scenes.values()]})

    @app.exception_handler(InputError)
    async def wrong(request: Request, error: Exception) -> Response:
        message = str(error).replace("--at FRAME X Y", '"at": [frame, column, row]')
        return _AsciiResponse({"error": re.sub(r"--([a-z]+)", r'"\1"', message)}, 422)

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        fault = error.errors()[0]
        name = next((part for part in fault["loc"][1:] if isinstance(part, str)), "body")
        return _AsciiResponse({"error": f'Field "{name[:60]}": {fault["msg"]}.'}, 422)

    @app.exception_handler(AnyHTTPException)
    async def refused(request: Request, error: Exception) -> Response:
        assert isinstance(error, AnyHTTPException)
        return _AsciiResponse({"error": error.detail}, error.status_code, error.headers)

    @app.exception_handler(500)
    async def failed(request: Request, error: Exception) -> Response:
        return _AsciiResponse({"error": "Internal error. The server's log has it."}, 500)

    return app


def page_application(scene: Scene, texts: Sequence[str] = ()) -> FastAPI:
    """Makes the ASGI application of a scene's page, which highlights some texts when it opens."""
    scenes = {scene.name: scene}
    drawn = drawn_gaussians(scene.field)[0]
    content = field_page(scene.field, dict.fromkeys(texts), title=scene.name, served=True).encode()
    app = application(scenes)

    @app.get("/", summary="The page")
    async def index() -> Response:
        return Response(content, media_type="text/html; charset=utf-8")

    @app.post("/ask", summary="The words of each answer, and a bit for each Gaussian of the page")
    def ask(request: _Questions) -> dict[str, list]:
        return {"answers": [answer_record(result, drawn) for result in request.ask(scenes[scene.name])]}

    @app.post("/selection.ply", summary="The Gaussians of all answers in the capture's world")
    def selection(request: _Questions) -> Response:
        answers = request.ask(scenes[scene.name])
        masks = [answer.mask for answer in answers if isinstance(answer, Answer)]
        return _ply_response(scene, np.any(masks, axis=0) if masks else np.zeros(len(drawn), bool))

    return app


def _ply_response(scene: Scene, mask: Bool[np.ndarray, " n"]) -> Response:
    """The Gaussians of a mask as a .ply in the capture's world; InputError if there is none."""
    if not mask.any():
        raise InputError("selection", "no Gaussian is selected", remedy="Ask with other words.")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "selection.ply")
        scene.export(file, mask)
        return Response(file.read_bytes(), media_type="application/octet-stream")


def _describe(scene: Scene) -> dict[str, Any]:
    """Plain values: name, frames and their size."""
    field = scene.field
    return {"name": scene.name, "frames": list(field.names), "size": [field.cameras.width, field.cameras.height]}


def _serve(verb: verbs.Serve, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon serve`: address, fields, and under "then" what answers requests until it is stopped."""
    token = _token_for(verb.host, verb.token)
    listening, address = listen(verb.host, verb.port)
    scenes = {
        name: open_prepared(name, path, verb.embedder, console) for name, path in name_fields(verb.fields).items()
    }
    app = application(scenes, token=token)
    fields = [_describe(scene) for scene in scenes.values()]
    console.print_line("\n".join([*map(str, scenes.values()), address]))
    return {"address": address, "fields": fields, "then": runner(app, listening)}


def listen(host: str, port: int) -> tuple[socket.socket, str]:
    """Opens a socket that listens, of IPv4 or IPv6, or raises InputError; port 0 takes a free one. Adds its URL."""
    try:
        addresses = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)
        family, _, _, _, address = min(addresses, key=lambda info: info[0] != socket.AF_INET)
        opened = socket.create_server((address[0], port, *address[2:]), family=family)
        return opened, f"http://{_bracketed(host)}:{opened.getsockname()[1]}"
    except (OSError, OverflowError, ValueError) as error:
        reason = describe_error(error) if isinstance(error, OSError) else "it is not an address"
        remedy = "Take another --port, or 0 to have one chosen. --host must be an address of this machine."
        raise InputError("--port", f"cannot listen on {_bracketed(host)}:{port} ({reason})", remedy=remedy) from error


def _bracketed(host: str) -> str:
    """Writes a host as it stands in a URL: an IPv6 address in brackets."""
    return f"[{host}]" if ":" in host and not host.startswith("[") else host


def runner(app: FastAPI, listening: socket.socket) -> Callable[[], None]:
    """Makes what answers the requests to a socket until it is stopped."""
    # The limit counts cheap requests too; those beyond it get 503.
    options: dict[str, Any] = {"timeout_keep_alive": 5, "limit_concurrency": 256}
    config = uvicorn.Config(app, log_level="warning", ws="none", server_header=False, **options)
    return lambda: uvicorn.Server(config).run(sockets=[listening])
