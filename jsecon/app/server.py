"""A field behind HTTP: JSON on loopback, loaded once and compiled before the first question (extra `serve`).

    POST /query           {"text": "red mug"} -> where it is, how sure
    GET  /regions         what the field knows of each region
    GET  /selection.ply   the Gaussians that a text selects, INRIA layout
    GET  /mask.png        the selection in a frame
    GET  /healthz, /openapi.json, /

What is new is computed by as many threads as there are cores; who waits is served in turn, and more than
`Limits.waiting` are told to come back. Only what a field holds is ever read: no name in a request is a path.
"""

import asyncio
import contextlib
import functools
import ipaddress
import socket
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jsecon.app.answers import best_frames, selected
from jsecon.app.guard import LIMITS, Guard, Limits, openapi, paths_told
from jsecon.app.place import place_of
from jsecon.app.question import METHODS, Answer, ask_pixel, ask_text, frame_index
from jsecon.data.ply import save_ply
from jsecon.errors import InputError
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
    """A loaded field. As many threads as there are cores compute an answer at a time; what is known is told at once."""

    def __init__(self, name: str, field: LanguageField, embedder: Any):
        self.name, self.field, self.embedder = name, field, embedder
        self._free = threading.BoundedSemaphore(cores())
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
        with self._free:
            return self._answer(text, pixel, by, threshold, several)

    def _tell(self, *question: Any) -> dict[str, Any]:
        answer = self._answer(*question)
        told = {"question": answer.question, "field": self.name, "count": int(answer.mask.sum())}
        region = int(answer.selection.region)
        told |= {"region": region if region >= 0 else None, "score": round(float(answer.selection.score), 6)}
        return told | {"place": place_of(self.field, answer).as_dict() if answer.mask.any() else None}

    def tell(self, text: str, pixel: tuple | None = None, by="votes", threshold=None, several=False) -> dict[str, Any]:
        """What and where the answer is, as plain numbers; kept for longer than the answer."""
        question = text, pixel, by, threshold, several
        if (told := self._known.get(question)) is None:
            with self._free:
                told = self._tell(*question)
            if len(self._known) >= KEPT * KEPT:
                self._known.clear()
            self._known[question] = told
        return told

    def mask(self, answer: Answer, frame: int | None) -> tuple[str, bytes]:
        """A frame's name and the selection there as a PNG; of no frame the one that shows most of it."""
        with self._free:
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
            raise InputError(file, f"a second field named {name!r}", "a name for each", "Rename one of the folders.")
        field = load_field(file)
        scenes[name] = Scene(name, field, embedder_of_field(field, embedder))
        with contextlib.suppress(InputError):  # an embedder that has no word for it
            scenes[name].mask(scenes[name].ask("red"), 0)
    return scenes


def application(scenes: dict[str, Scene], *, token: str = "", limits: Limits = LIMITS) -> Any:
    """The ASGI application. Raises InputError where the extra is not installed."""
    try:
        from starlette.applications import Starlette
        from starlette.concurrency import run_in_threadpool
        from starlette.exceptions import HTTPException
        from starlette.requests import Request
        from starlette.responses import HTMLResponse, JSONResponse, Response
        from starlette.routing import Route
    except ImportError as error:
        raise InputError("jsecon serve", "starlette is not installed", "the extra serve", REMEDY) from error

    default = next(iter(scenes))

    def scene_of(asked: dict) -> Scene:
        name = asked.get("field", default)
        if not isinstance(name, str) or name not in scenes:
            raise HTTPException(404, f"no field {name!r}; there are {', '.join(scenes)}")
        return scenes[name]

    def question_of(asked: dict) -> dict[str, Any]:
        known = {"field", "text", "at", "by", "threshold", "all", "frame"}
        if extra := sorted(set(asked) - known):
            raise HTTPException(422, f"unknown {', '.join(map(repr, extra[:5]))}; known are {', '.join(sorted(known))}")
        text, at, by = asked.get("text", ""), asked.get("at"), asked.get("by", "votes")
        if not isinstance(text, str) or len(text) > limits.text or (not text.strip()) == (at is None):
            raise HTTPException(422, f"text: a string of 1 to {limits.text} characters, or at: [frame, column, row]")
        if by not in METHODS:
            raise HTTPException(422, f"by: one of {', '.join(METHODS)}")
        threshold = asked.get("threshold")
        number = isinstance(threshold, int | float) and not isinstance(threshold, bool) and -1 <= threshold <= 1
        if threshold is not None and not number:
            raise HTTPException(422, "threshold: a number from -1 to 1")
        if not isinstance(asked.get("all", False), bool):
            raise HTTPException(422, "all: true or false")
        if at is not None:
            whole = lambda value: isinstance(value, int) and not isinstance(value, bool)
            fits = isinstance(at, list) and len(at) == 3 and isinstance(at[0], str | int) and all(map(whole, at[1:]))
            if not fits:
                raise HTTPException(422, "at: [frame, column, row], the frame by name or index")
            at = (at[0], at[1], at[2])
        return {"text": text, "pixel": at, "by": by, "threshold": threshold, "several": asked.get("all", False)}

    async def computed(work: Callable[[], Any]) -> Any:
        try:
            return await asyncio.wait_for(run_in_threadpool(work), limits.seconds)
        except InputError as error:
            raise HTTPException(422, str(error)) from error
        except TimeoutError as error:
            raise HTTPException(503, f"no answer within {limits.seconds:g} s") from error

    async def body(request: Request) -> dict:
        try:
            asked = parsed_json(await request.body())
        except ValueError as error:
            raise HTTPException(400, f"no JSON: {error}") from error
        if not isinstance(asked, dict):
            raise HTTPException(400, 'an object is expected, such as {"text": "red mug"}')
        return asked

    def from_url(request: Request) -> dict:
        return {key: value for key, value in request.query_params.items()}

    async def query(request: Request) -> Response:
        asked = await body(request)
        scene, question = scene_of(asked), question_of(asked)

        return JSONResponse(await computed(functools.partial(scene.tell, **question)))

    async def regions(request: Request) -> Response:
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
        return JSONResponse({"field": scene.name, "regions": told})

    async def selection(request: Request) -> Response:
        asked = from_url(request)
        scene, question = scene_of(asked), question_of(asked)

        def work() -> bytes:
            answer = scene.ask(**question)
            if not answer.mask.any():
                raise InputError(answer.question, "nothing selected", "a thing in the scene", "Ask with other words.")
            return scene.ply(answer)

        return Response(await computed(work), media_type="application/octet-stream")

    async def mask(request: Request) -> Response:
        asked = from_url(request)
        scene, question = scene_of(asked), question_of(asked)

        def work() -> tuple[str, bytes]:
            frame = frame_index(scene.field, asked["frame"]) if "frame" in asked else None
            return scene.mask(scene.ask(**question), frame)

        name, image = await computed(work)
        return Response(image, media_type="image/png", headers={"x-frame": name.encode("ascii", "replace").decode()})

    async def health(request: Request) -> Response:
        return JSONResponse({"status": "ok", "fields": [scene.told() for scene in scenes.values()]})

    async def schema(request: Request) -> Response:
        return JSONResponse(openapi(limits))

    async def page(request: Request) -> Response:
        rows = "".join(f"<li><code>{path}</code> {told}</li>" for path, told in paths_told().items())
        return HTMLResponse(f"<!doctype html><title>jsecon</title><h1>jsecon</h1><ul>{rows}</ul>")

    async def refused(request: Request, error: Exception) -> Response:
        status = error.status_code if isinstance(error, HTTPException) else 500
        told = error.detail if isinstance(error, HTTPException) else "an error inside; the server's log has it"
        return JSONResponse({"error": told}, status)

    routes = [
        Route("/query", query, methods=["POST"]),
        Route("/regions", regions),
        Route("/selection.ply", selection),
        Route("/mask.png", mask),
        Route("/healthz", health),
        Route("/openapi.json", schema),
        Route("/", page),
    ]
    app = Starlette(routes=routes, exception_handlers={HTTPException: refused, 500: refused})
    return Guard(app, token, limits)


def ready(
    files: list[Path], *, host: str, port: int, token: str, embedder: Path | None
) -> tuple[dict[str, Any], Callable[[], None]]:
    """Where the fields can be asked and what they hold, and the function that answers until it is stopped. Raises
    InputError where the extra is missing or the address cannot be had, and for one that others can reach without a
    token."""
    try:
        import uvicorn
    except ImportError as error:
        raise InputError("jsecon serve", "uvicorn is not installed", "the extra serve", REMEDY) from error
    if not token and not _loopback(host):
        remedy = "Set --token, or leave --host out."
        raise InputError("--host", host, "127.0.0.1, or a token that clients must have", remedy)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listening = socket.create_server((host, port), family=family)
    except OSError as error:
        remedy = "Take another --port; with 0 the system chooses one."
        found = str(error.strerror).partition(" (")[0]
        raise InputError(f"{host}:{port}", found, "an address of this machine and a free port", remedy) from error
    scenes = open_scenes(files, embedder)
    given = {"timeout_keep_alive": 5, "ws": "none", "server_header": False}
    server = uvicorn.Server(uvicorn.Config(application(scenes, token=token), log_level="warning", **given))
    name = f"[{host}]" if family == socket.AF_INET6 else host
    told = {"address": f"http://{name}:{listening.getsockname()[1]}", "fields": [s.told() for s in scenes.values()]}
    return told, lambda: server.run(sockets=[listening])


def _loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
