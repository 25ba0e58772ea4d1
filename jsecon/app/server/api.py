"""The HTTP interface of the server: its paths, the models of its requests, and its error messages.

FastAPI makes /openapi.json from them. Its page of documentation loads scripts of another host and is left out; the
page at / lists the paths instead.
"""

import contextlib
import functools
import json
import re
import tempfile
from collections.abc import AsyncIterator, Callable, Collection
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from fastapi import FastAPI, HTTPException, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, Response
from pydantic import BaseModel, ConfigDict, Field, StrictBool, StrictFloat, StrictInt, StrictStr, StringConstraints
from starlette.exceptions import HTTPException as AnyHTTPException

import jsecon
from jsecon.app.exports import object_records
from jsecon.app.records import At, Query as SceneQuery
from jsecon.app.scene import Scene
from jsecon.app.server.guard import LIMITS, Guard, Limits, Workers
from jsecon.app.server.scenes import describe_scene
from jsecon.app.verbs import By
from jsecon.errors import InputError
from jsecon.process import cores

Text = Annotated[str, StringConstraints(strict=True, min_length=1, max_length=500, pattern=r"\S")]


class Fields(BaseModel):
    """A request for a field."""

    model_config = ConfigDict(extra="forbid")
    field: Any = Field(None, description="Name of a field; the first by default.", json_schema_extra={"type": "string"})


class TextQuery(Fields):
    """A text for a field."""

    text: Text
    by: By = "votes"


class MaskQuery(TextQuery):
    """A text, and a frame to show its answer in."""

    frame: str | None = None


class AnyQuery(Fields):
    """A text or a pixel for a field."""

    text: Text | None = None
    at: tuple[StrictStr | StrictInt, StrictInt, StrictInt] | None = Field(None, description="[frame, column, row]")
    by: By = "votes"
    threshold: Annotated[StrictFloat | StrictInt, Field(ge=-1, le=1)] | None = None
    all: StrictBool = False


class RelationQuery(Fields):
    """A referring expression for a field."""

    text: Text
    frame: StrictStr | StrictInt | None = Field(None, description="Frame from which left and right are seen.")


class MeasureQuery(Fields):
    """Two referring expressions, each of one object."""

    a: Text
    b: Text
    frame: StrictStr | StrictInt | None = Field(None, description="Frame from which left and right are seen.")


MODELS: dict[str, type[BaseModel]] = {
    "/query": AnyQuery,
    "/relation": RelationQuery,
    "/measure": MeasureQuery,
    "/objects": Fields,
    "/regions": Fields,
    "/selection.ply": TextQuery,
    "/mask.png": MaskQuery,
}


class Failure(BaseModel):
    """The answer to a request that is refused."""

    error: str


class _AsciiResponse(JSONResponse):
    """JSON in ASCII, which can hold any text of a request."""

    def render(self, content: Any) -> bytes:
        return json.dumps(content, allow_nan=False).encode()


@contextlib.asynccontextmanager
async def _lifespan(workers: Workers, app: FastAPI) -> AsyncIterator[None]:
    """Closes the threads after the application."""
    yield
    workers.close()


def application(
    scenes: dict[str, Scene], *, token: str = "", limits: Limits = LIMITS, hosts: Collection[str] = ()
) -> FastAPI:
    """Makes the ASGI application.

    Args:
      scenes: Fields by name. The first is the default.
      token: Token that requests must carry, or "" for requests that name this machine.
      limits: Limits of a request.
      hosts: Names of this machine besides those of loopback.

    Returns:
      The application, behind its `Guard`.
    """
    workers = Workers(cores(), limits.waiting)
    app = FastAPI(
        title="jsecon",
        version=jsecon.__version__,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        default_response_class=_AsciiResponse,
        responses={status: {"model": Failure} for status in (400, 404, 422, 503)},
        lifespan=functools.partial(_lifespan, workers),
    )
    app.add_middleware(Guard, token=token, limits=limits, hosts=hosts)

    def scene_of(name: Any) -> Scene:
        if name is None:
            return next(iter(scenes.values()))
        if not isinstance(name, str) or name not in scenes:
            raise _wrong("field", f"no field {_short(name)}. There are {', '.join(scenes)}.", 404)
        return scenes[name]

    async def computed(work: Callable[[], Any], field: str) -> Any:
        try:
            return await workers.compute(work, limits.seconds)
        except InputError as error:
            raise _wrong(field, _in_words_of_the_api(str(error))) from error

    @app.post("/query", summary="Count, score and place of the answer to a text or a pixel")
    async def query(request: AnyQuery) -> Response:
        if (request.text is None) == (request.at is None):
            raise _wrong("text", 'missing, and "at" too.' if request.at is None else 'give it, or "at", and not both.')
        if request.at is not None and request.all:
            raise _wrong("all", 'it needs a text, not "at".')
        scene = scene_of(request.field)
        place = "text" if request.at is None else "at"
        question = request.text if request.text is not None else At(*request.at)
        try:
            query = SceneQuery(question, by=request.by, threshold=request.threshold, all_of_class=request.all)
        except InputError as error:
            raise _wrong(error.where, str(error)) from error
        answer = scene.known(query)  # is sent at once, also while all threads are taken
        record = await computed(lambda: scene.ask(query).as_dict(), place) if answer is None else answer.as_dict()
        return _AsciiResponse({"field": scene.name} | record)

    @app.post("/relation", summary="The objects that an expression such as 'the mug left of the bottle' names")
    async def relation(request: RelationQuery) -> Response:
        scene = scene_of(request.field)
        record = await computed(lambda: scene.relate(request.text, frame=request.frame).as_dict(), "text")
        return _AsciiResponse({"field": scene.name} | record)

    @app.post("/measure", summary="Distances between two objects: surfaces, centres, free gap, angle")
    async def distance(request: MeasureQuery) -> Response:
        scene = scene_of(request.field)
        distances = await computed(lambda: scene.measure(request.a, request.b, frame=request.frame), "a or b")
        return _AsciiResponse({"field": scene.name} | distances)

    @app.get("/objects", summary="The objects of a field: names, boxes, Gaussians")
    async def objects(request: Annotated[Fields, Query()]) -> Response:
        scene = scene_of(request.field)
        rows = await computed(lambda: object_records(scene.objects()), "field")
        return _AsciiResponse({"field": scene.name, "objects": rows})

    @app.get("/regions", summary="Pixels and views of each region")
    async def regions(request: Annotated[Fields, Query()]) -> Response:
        scene = scene_of(request.field)
        rows = [
            {
                "region": region,
                "pixels": int(pixels.sum()),
                "views": int((pixels > 0).sum()),
                "frame": scene.field.names[pixels.argmax()],
            }
            for region, pixels in enumerate(np.asarray(scene.field.regions.pixel_counts))
        ]
        return _AsciiResponse({"field": scene.name, "regions": rows})

    @app.get("/selection.ply", summary="The selected Gaussians in the capture's world")
    async def selection(request: Annotated[TextQuery, Query()]) -> Response:
        scene = scene_of(request.field)

        def work() -> bytes:
            answer = scene.ask(request.text, by=request.by)
            _ = answer.place  # refuses an answer of no Gaussian
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "selection.ply"
                scene.export(file, answer)
                return file.read_bytes()

        return Response(await computed(work, "text"), media_type="application/octet-stream")

    @app.get("/mask.png", summary="The selection alone in a frame, alpha above 0.7")
    async def mask(request: Annotated[MaskQuery, Query()]) -> Response:
        scene = scene_of(request.field)
        try:
            frame = None if request.frame is None else scene.frame_index(request.frame)
        except InputError as error:
            raise _wrong("frame", str(error)) from error

        def work() -> tuple[int, np.ndarray]:
            answer = scene.ask(request.text, by=request.by)
            index = frame if frame is not None else [*scene.best_frames(answer, 1), 0][0]
            return index, scene.mask(answer, index)

        index, pixels = await computed(work, "text")
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
    """Returns the status and the message of a request that does not fit its model."""
    faults = error.errors()
    known = MODELS[path].model_fields
    unknown = [fault["loc"][1] for fault in faults if fault["type"] == "extra_forbidden"]
    if isinstance(error.body, dict):  # of odd names pydantic does not tell which
        unknown = [name for name in error.body if name not in known]
    if unknown:
        names = ", ".join(sorted(map(_short, unknown))[:5])
        return 422, f"Unknown fields: {names}. {path} takes {', '.join(known)}."
    if faults[0]["type"] == "json_invalid":
        return 400, f"The body is not JSON: {faults[0]['ctx']['error']}."
    if len(faults[0]["loc"]) < 2:
        return 400, 'The body must be a JSON object, such as {"text": "red mug"}.'
    return 422, f'Field "{faults[0]["loc"][1]}": {faults[0]["msg"]}.'


def _wrong(field: str, message: str, status: int = 422) -> HTTPException:
    return HTTPException(status, f'Field "{field}": {message}')


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:60]} ..."


def _in_words_of_the_api(message: str) -> str:
    """Replaces the options of the command line in a message by the fields of a request: --at becomes "at"."""
    message = message.replace("--at FRAME X Y", '"at": [frame, column, row]')
    return re.sub(r"--([a-z]+)", r'"\1"', message)
