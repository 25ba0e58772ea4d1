"""The served page of `jsecon view`, and what it asks of its scene (extra `serve`).

The routes are beside those of `jsecon serve`, behind the same guard.
"""

import contextlib
import io
import tempfile
import threading
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from fastapi import FastAPI
from fastapi.responses import Response
from pydantic import BaseModel, ConfigDict, Field, StrictBool, StrictFloat, StrictInt

from jsecon.app import verbs
from jsecon.app.measuring import LENGTH_COLUMNS
from jsecon.app.querying import write_answer
from jsecon.app.records import Answer, Query, Region, source_points
from jsecon.app.scene import Scene, open_scene
from jsecon.app.server import Place, Text, application, listen, runner
from jsecon.app.viewer.page import answer_record, drawn_gaussians, page
from jsecon.errors import InputError
from jsecon.field.membership import SHARE_THRESHOLD
from jsecon.files import csv_text
from jsecon.pipeline.progress import Console

_Point = tuple[Place, Place, Place]


class _Questions(BaseModel):
    """Texts and ids of regions, and the options of the page."""

    model_config = ConfigDict(extra="forbid")
    questions: list[Text | StrictInt] = Field(max_length=32)
    threshold: Annotated[StrictFloat | StrictInt, Field(ge=0, le=1)] = SHARE_THRESHOLD
    all: StrictBool = False

    def ask(self, scene: Scene) -> list[Answer | InputError]:
        """The answer or the error of each question."""
        questions = [Region(question) if isinstance(question, int) else question for question in self.questions]
        options = {"threshold": self.threshold, "all_of_class": self.all}
        return scene.ask_all([Query(question, **options) for question in questions])


class _Export(_Questions):
    lengths: list[tuple[_Point, _Point]] = Field([], max_length=256, description="ends in the field's world")


def page_application(scene: Scene, texts: Sequence[str] = ()) -> FastAPI:
    """Makes the ASGI application of a scene's page, which highlights some texts when it opens."""
    scenes = {scene.name: scene}
    drawn = drawn_gaussians(scene.field)[0]
    content = page(scene.field, dict.fromkeys(texts), title=scene.name, served=True).encode()
    app = application(scenes)

    @app.get("/", summary="The page")
    async def index() -> Response:
        return Response(content, media_type="text/html; charset=utf-8")

    @app.post("/ask", summary="The words of each answer, and a bit for each Gaussian of the page")
    def ask(request: _Questions) -> dict[str, list]:
        return {"answers": [answer_record(result, drawn) for result in request.ask(scenes[scene.name])]}

    @app.post("/selection.zip", summary="The .ply and .json of each answer, and the lengths as lengths.csv")
    def selection(request: _Export) -> Response:
        scene_now = scenes[scene.name]
        found = [answer for answer in request.ask(scene_now) if isinstance(answer, Answer) and len(answer.rows)]
        ends = [source_points(scene.field, np.array(pair, np.float64)).tolist() for pair in request.lengths]
        if not found and not ends:
            raise InputError("export", "no Gaussian is selected", remedy="Ask a text, or click an object.")
        packed = io.BytesIO()
        with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for answer in found:
                write_answer(answer, scene_now, Path(folder), {})
            for file in Path(folder).iterdir():
                archive.write(file, file.name)
            if ends:
                rows = [scene_now.measure(*pair) for pair in ends]
                archive.writestr("lengths.csv", csv_text(LENGTH_COLUMNS, rows))
        return Response(packed.getvalue(), media_type="application/zip")

    return app


def serve_page(verb: verbs.View, console: Console) -> verbs.VerbResult:
    """Opens a scene and its page: address, and under "then" what answers requests until it is stopped."""
    listening, address = listen("127.0.0.1", verb.port)
    # Without its model a field can be clicked, so the model is opened when the first text is asked.
    scene = open_scene(verb.field, embedder=verb.embedder, console=console)
    if verb.texts:
        _ = scene.embedder
    app = page_application(scene, list(dict.fromkeys(verb.texts)))
    console.print_line(f"{scene}\n{address}")

    def prepare() -> None:
        with contextlib.suppress(InputError):  # an embedder without words: each text then has this error
            scene.prepare()

    threading.Thread(target=prepare).start()
    return {"address": address, "then": runner(app, listening)}
