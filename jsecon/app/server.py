"""A field behind HTTP: JSON on loopback, loaded once and compiled before the first question (extra `serve`).

    POST /query           {"text": "red mug"} -> where it is, how sure
    GET  /regions         what the field knows of each region
    GET  /selection.ply   the Gaussians that a text selects, INRIA layout
    GET  /mask.png        the selection in a frame
    GET  /healthz, /openapi.json, /

What is new is computed by as many threads as there are cores; questions beyond that wait in turn, and more than
`Limits.waiting` are told to try again. A question that takes too long keeps its place until its thread is done with it.
Known answers are told at once. Only what a field holds is ever read: no name in a request is a path.
"""

import contextlib
import functools
import json
import re
import tempfile
from collections.abc import AsyncIterator, Callable, Collection
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jsecon.app.access import bracketed, listen, token_for
from jsecon.app.answers import best_frames, selected
from jsecon.app.guard import LIMITS, TAKES, Busy, Guard, Limits, Workers, openapi, paths_told
from jsecon.app.place import place_of
from jsecon.app.question import METHODS, Answer, ask_pixel, ask_text, frame_index
from jsecon.data.ply import save_ply
from jsecon.errors import InputError, why
from jsecon.files import parsed_json
from jsecon.language.field import load_field
from jsecon.pipeline.networks import embedder_of_field
from jsecon.process import cores
from jsecon.query.masks import selection_mask
from jsecon.types import LanguageField

REMEDY = 'pip install "jsecon[serve]"'
KEPT = 64
"""answers, of five bytes a Gaussian each"""


class Scene:
    """A loaded field, and the answers that it has given."""

    def __init__(self, name: str, field: LanguageField, embedder: Any):
        self.name, self.field, self.embedder = name, field, embedder
        self._known: dict[tuple, dict[str, Any]] = {}
        self._gaussians = jax.device_put(field.gaussians)
        self._cameras = jax.tree.map(np.asarray, field.cameras)  # whose items compile nothing
        self._answer = functools.lru_cache(KEPT)(self._ask)

    def _ask(self, text: str, pixel: tuple | None, by: str, threshold: float | None, several: bool) -> Answer:
        if pixel is not None:
            return ask_pixel(self.field, *pixel, by=by, threshold=threshold)
        return ask_text(self.field, self.embedder, text, by=by, threshold=threshold, several=several)

    def ask(self, text: str, pixel: tuple | None = None, by="votes", threshold=None, several=False) -> Answer:
        """The answer to a text, or to a pixel (frame, column, row); those asked last are kept."""
        return self._answer(text, pixel, by, threshold, several)

    def _tell(self, *question: Any) -> dict[str, Any]:
        answer = self._answer(*question)
        told = {"question": answer.question, "field": self.name, "count": int(answer.mask.sum())}
        region = int(answer.selection.region)
        told |= {"region": region if region >= 0 else None, "score": round(float(answer.selection.score), 6)}
        return told | {"place": place_of(self.field, answer).as_dict() if answer.mask.any() else None}

    def tell(self, text: str, pixel: tuple | None = None, by="votes", threshold=None, several=False) -> dict[str, Any]:
        """What and where the answer is, as plain numbers; kept for longer than the answer."""
        if (told := self.known(text, pixel, by, threshold, several)) is None:
            told = self._tell(text, pixel, by, threshold, several)
            if len(self._known) >= KEPT * KEPT:
                self._known.clear()
            self._known[text, pixel, by, threshold, several] = told
        return told

    def known(
        self, text: str, pixel: tuple | None = None, by="votes", threshold=None, several=False
    ) -> dict[str, Any] | None:
        """What `tell` told before of the same question; None of a new one."""
        return self._known.get((text, pixel, by, threshold, several))

    def mask(self, answer: Answer, frame: int | None) -> tuple[str, bytes]:
        """A frame's name and the selection there as a PNG; of no frame the one that shows most of it."""
        frames = [frame] if frame is not None else best_frames(self.field, answer, 1) or [0]
        shown = selection_mask(self._gaussians, self._cameras[frames[0]], jnp.asarray(answer.mask))
        return self.field.names[frames[0]], cv2.imencode(".png", np.asarray(shown, np.uint8) * 255)[1].tobytes()

    def ply(self, answer: Answer) -> bytes:
        """The selected Gaussians as a .ply in the capture's own world."""
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "selection.ply"
            save_ply(file, selected(self.field.gaussians, answer.mask), similarity=self.field.to_source)
            return file.read_bytes()

    def told(self) -> dict[str, Any]:
        """What a client may know of it."""
        size = [self.field.cameras.width, self.field.cameras.height]
        return {
            "name": self.name,
            "gaussians": self.field.gaussians.count,
            "regions": self.field.regions.count,
            "frames": list(self.field.names),
            "size": size,
        }


def open_scenes(files: list[Path], embedder: Path | None) -> dict[str, Scene]:
    """The fields by name, each asked once so that its programs are compiled. Raises InputError for a name twice."""
    scenes: dict[str, Scene] = {}
    for file in files:
        name = file.parent.name if file.stem == "field" and file.parent.name else file.stem
        if name in scenes:
            raise InputError(file, f"it is a second field named {name!r}", remedy="Rename one of the folders.")
        field = load_field(file)
        scenes[name] = Scene(name, field, embedder_of_field(field, embedder))
        with contextlib.suppress(InputError):  # an embedder that has no word for it
            scenes[name].mask(scenes[name].ask("red"), 0)
    return scenes


def application(
    scenes: dict[str, Scene], *, token: str = "", limits: Limits = LIMITS, hosts: Collection[str] = ()
) -> Any:
    """The ASGI application. Raises InputError where the extra is not installed.

    Args:
      scenes: Name -> field; the first is the default.
      token: What clients must send; without one they must name this machine.
      limits: What requests may take.
      hosts: Names of this machine beside those of loopback.
    """
    try:
        from starlette.applications import Starlette
        from starlette.exceptions import HTTPException
        from starlette.requests import Request
        from starlette.responses import HTMLResponse, Response
        from starlette.routing import Route
    except ImportError as error:
        raise InputError("jsecon serve", "the package starlette is missing", remedy=f"Run: {REMEDY}") from error

    default = next(iter(scenes))
    workers = Workers(cores(), limits.waiting)

    def answered(told: Any, status: int = 200) -> Response:  # ASCII alone, which any text can be written in
        return Response(json.dumps(told, allow_nan=False), status, media_type="application/json")

    def wrong(field: str, told: str, status: int = 422) -> HTTPException:
        return HTTPException(status, f'Field "{field}": {told}')

    def scene_of(asked: dict) -> Scene:
        name = asked.get("field", default)
        if not isinstance(name, str) or name not in scenes:
            raise wrong("field", f"no field {_short(name)}. There are {', '.join(scenes)}.", 404)
        return scenes[name]

    def require_known(asked: dict, path: str) -> None:
        if extra := sorted(set(asked) - set(TAKES[path])):
            named, known = ", ".join(map(_short, extra[:5])), ", ".join(TAKES[path]) or "none"
            raise HTTPException(422, f"Unknown fields: {named}. {path} takes {known}.")

    def question_of(asked: dict, path: str) -> dict[str, Any]:
        require_known(asked, path)
        text, at, by, several = asked.get("text"), asked.get("at"), asked.get("by", "votes"), asked.get("all", False)
        if text is not None and not (isinstance(text, str) and text.strip() and len(text) <= limits.text):
            raise wrong("text", f"expected a string of 1 to {limits.text} characters.")
        if (text is None) == (at is None):
            raise wrong("text", 'missing, and "at" too.' if at is None else 'give it, or "at", and not both.')
        if not isinstance(by, str) or by not in METHODS:
            raise wrong("by", f"expected one of {', '.join(METHODS)}.")
        threshold = asked.get("threshold")
        number = isinstance(threshold, int | float) and not isinstance(threshold, bool) and -1 <= threshold <= 1
        if threshold is not None and not number:
            raise wrong("threshold", "expected a number from -1 to 1.")
        if not isinstance(several, bool):
            raise wrong("all", "expected true or false.")
        if at is not None:
            whole = lambda value: isinstance(value, int) and not isinstance(value, bool)
            frame = isinstance(at, list) and len(at) == 3 and (isinstance(at[0], str) or whole(at[0]))
            if not frame or not all(map(whole, at[1:])):
                raise wrong("at", "expected [frame, column, row], the frame by name or index.")
            if several:
                raise wrong("all", 'it needs a text, and "at" has none.')
            at = (at[0], at[1], at[2])
        return {"text": text or "", "pixel": at, "by": by, "threshold": threshold, "several": several}

    async def computed(work: Callable[[], Any], field: str) -> Any:
        try:
            return await workers.compute(work, limits.seconds)
        except InputError as error:
            raise wrong(field, _in_words_of_the_api(str(error))) from error
        except TimeoutError as error:
            raise HTTPException(503, f"No answer within {limits.seconds:g} s. Try again.") from error
        except Busy as error:
            raise HTTPException(503, "Too many questions wait for an answer. Try again.") from error

    async def body(request: Request) -> dict:
        try:
            asked = parsed_json(await request.body())
        except ValueError as error:
            raise HTTPException(400, f"The body is not JSON: {why(error)}.") from error
        if not isinstance(asked, dict):
            raise HTTPException(400, 'The body must be a JSON object, such as {"text": "red mug"}.')
        return asked

    def from_url(request: Request) -> dict:
        return {key: value for key, value in request.query_params.items()}

    async def query(request: Request) -> Response:
        asked = await body(request)
        scene, question = scene_of(asked), question_of(asked, "/query")
        if (told := scene.known(**question)) is None:
            told = await computed(functools.partial(scene.tell, **question), "at" if question["pixel"] else "text")
        return answered(told)

    async def regions(request: Request) -> Response:
        require_known(from_url(request), "/regions")
        scene = scene_of(from_url(request))
        pixels, names = np.asarray(scene.field.regions.pixels), scene.field.names
        told = [
            {
                "region": r,
                "pixels": int(row.sum()),
                "views": int((row > 0).sum()),
                "frame": names[row.argmax()],
            }
            for r, row in enumerate(pixels)
        ]
        return answered({"field": scene.name, "regions": told})

    async def selection(request: Request) -> Response:
        asked = from_url(request)
        scene, question = scene_of(asked), question_of(asked, "/selection.ply")

        def work() -> bytes:
            answer = scene.ask(**question)
            if not answer.mask.any():
                raise InputError(f"query {answer.question!r}", "it selects nothing", remedy="Ask with other words.")
            return scene.ply(answer)

        return Response(await computed(work, "text"), media_type="application/octet-stream")

    async def mask(request: Request) -> Response:
        asked = from_url(request)
        scene, question = scene_of(asked), question_of(asked, "/mask.png")
        try:
            frame = frame_index(scene.field, asked["frame"]) if "frame" in asked else None
        except InputError as error:
            raise wrong("frame", str(error)) from error
        name, image = await computed(lambda: scene.mask(scene.ask(**question), frame), "text")
        return Response(image, media_type="image/png", headers={"x-frame": re.sub("[^ -~]", "?", name)})

    async def health(request: Request) -> Response:
        return answered({"status": "ok", "fields": [scene.told() for scene in scenes.values()]})

    async def schema(request: Request) -> Response:
        return answered(openapi(limits))

    async def page(request: Request) -> Response:
        rows = "".join(f"<li><code>{path}</code> {told}</li>" for path, told in paths_told().items())
        return HTMLResponse(f"<!doctype html><title>jsecon</title><h1>jsecon</h1><ul>{rows}</ul>")

    async def refused(request: Request, error: Exception) -> Response:
        status = error.status_code if isinstance(error, HTTPException) else 500
        told = error.detail if isinstance(error, HTTPException) else "Internal error. The server's log has it."
        return answered({"error": told}, status)

    routes = [
        Route("/query", query, methods=["POST"]),
        Route("/regions", regions),
        Route("/selection.ply", selection),
        Route("/mask.png", mask),
        Route("/healthz", health),
        Route("/openapi.json", schema),
        Route("/", page),
    ]

    @contextlib.asynccontextmanager
    async def running(app: Any) -> AsyncIterator[None]:
        yield
        workers.close()

    app = Starlette(routes=routes, exception_handlers={HTTPException: refused, 500: refused}, lifespan=running)
    return Guard(app, token, limits, hosts)


def _short(value: Any) -> str:
    told = repr(value)
    return told if len(told) <= 60 else f"{told[:60]} ..."


def _in_words_of_the_api(message: str) -> str:
    """A message whose options of the command line are the fields of a request: --at is "at"."""
    message = message.replace("--at FRAME X Y", '"at": [frame, column, row]')
    return re.sub(r"--([a-z]+)", r'"\1"', message)


def ready(
    files: list[Path],
    *,
    host: str,
    port: int,
    token: str,
    embedder: Path | None,
    hosts: Collection[str] = (),
) -> tuple[dict[str, Any], Callable[[], None]]:
    """Where the fields can be asked and what they hold, and the function that answers until it is stopped.

    Raises InputError where the extra is missing or the address cannot be had, and for one that others can reach without
    a token. `hosts` as for `application`.
    """
    try:
        import uvicorn
    except ImportError as error:
        raise InputError("jsecon serve", "the package uvicorn is missing", remedy=f"Run: {REMEDY}") from error
    token = token_for(host, token)
    listening = listen(host, port)
    scenes = open_scenes(files, embedder)
    given = {"timeout_keep_alive": 5, "ws": "none", "server_header": False}
    app = application(scenes, token=token, hosts=(host, *hosts))
    server = uvicorn.Server(uvicorn.Config(app, log_level="warning", **given))
    address = f"http://{bracketed(host)}:{listening.getsockname()[1]}"
    told = {"address": address, "fields": [s.told() for s in scenes.values()]}
    return told, lambda: server.run(sockets=[listening])
