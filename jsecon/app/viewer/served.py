"""The served page of `jsecon view`, and what it asks of its scene (extra `serve`).

The routes are beside those of `jsecon serve`, behind the same guard.
"""

import threading
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from fastapi import FastAPI
from fastapi.responses import Response
from pydantic import BaseModel, ConfigDict, Field, StrictFloat, StrictInt

from jsecon.app import verbs
from jsecon.app.records import Answer, Query, Region
from jsecon.app.scene import Scene, open_scene
from jsecon.app.server import Text, application, listen, ply_response, runner
from jsecon.app.viewer.page import answer_record, drawn_gaussians, page
from jsecon.errors import InputError
from jsecon.field.membership import SHARE_THRESHOLD
from jsecon.pipeline.progress import Console


class _Questions(BaseModel):
    """Texts and ids of regions, and the threshold of the page."""

    model_config = ConfigDict(extra="forbid")
    questions: list[Text | StrictInt] = Field(max_length=32)
    threshold: Annotated[StrictFloat | StrictInt, Field(ge=0, le=1)] = SHARE_THRESHOLD

    def ask(self, scene: Scene) -> list[Answer | InputError]:
        """The answer or the error of each question."""
        questions = [Region(question) if isinstance(question, int) else question for question in self.questions]
        return scene.ask_all([Query(question, threshold=self.threshold) for question in questions])


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

    @app.post("/selection.ply", summary="The Gaussians of all answers in the capture's world")
    def selection(request: _Questions) -> Response:
        answers = request.ask(scenes[scene.name])
        masks = [answer.mask for answer in answers if isinstance(answer, Answer)]
        return ply_response(scene, np.any(masks, axis=0) if masks else np.zeros(len(drawn), bool))

    return app


def serve_page(verb: verbs.View, console: Console) -> verbs.VerbResult:
    """Opens a scene and its page: address, and under "then" what answers requests until it is stopped."""
    listening, address = listen("127.0.0.1", verb.port)
    # Without its model a field can be clicked, so the model is opened when the first text is asked.
    scene = open_scene(verb.field, embedder=verb.embedder, console=console)
    app = page_application(scene, list(dict.fromkeys(verb.texts)))
    console.print_line(f"{scene}\n{address}")
    threading.Thread(target=scene.prepare).start()
    return {"address": address, "then": runner(app, listening)}
