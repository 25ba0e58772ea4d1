"""Fields as tools of language models: a server of the Model Context Protocol over standard input and output.

Extra `mcp`. Every tool reads, none writes; a name in a call is never a path. Bad input is the error of a call, in words
that tell the model what to change.
"""

import functools
import inspect
import sys
from collections.abc import Callable
from typing import Annotated, Any, TypeAlias

import cv2
import numpy as np
from mcp.server.mcpserver import Image, MCPServer
from mcp.server.mcpserver.exceptions import ToolError
from mcp.types import ToolAnnotations
from pydantic import Field

from jsecon.app import verbs
from jsecon.app.exports import object_records
from jsecon.app.models import with_models
from jsecon.app.records import Answer
from jsecon.app.scene import Scene
from jsecon.app.server.scenes import open_scenes
from jsecon.errors import InputError
from jsecon.pipeline.progress import Console
from jsecon.query.expressions import is_expression

INSTRUCTIONS = (
    "Finds things in 3D scenes. Coordinates are in the scene's own world, in metres where the capture has metres. "
    "Ask find for a thing by its name, relation for one told apart by where it is, such as "
    '"the second red mug from the left" or "the ball on the plate next to the bowl".'
)
MAX_OBJECTS = 100
"""objects in an answer of the tool `objects`"""
Words: TypeAlias = Annotated[str, Field(description="What is asked for, in words", min_length=1, max_length=500)]
Frame: TypeAlias = Annotated[
    str | None, Field(description="Name of the frame that it is seen from, or #3 for the fourth")
]
FieldName: TypeAlias = Annotated[str | None, Field(description="Name of the field; the first by default")]


class _Tools:
    """The tools: plain values out, InputError for bad input. Models read their docstrings and annotations."""

    def __init__(self, scenes: dict[str, Scene]):
        self.scenes = scenes

    def scene(self, name: str | None) -> Scene:
        """Returns a field by its name, by default the first."""
        if name is None:
            return next(iter(self.scenes.values()))
        if name not in self.scenes:
            raise InputError(f"field {name!r}", "there is no such field", remedy=f"There are {', '.join(self.scenes)}.")
        return self.scenes[name]

    def find(self, text: Words, frame: Frame = None, field: FieldName = None) -> dict[str, Any]:
        """Finds what a text names: number of Gaussians, score, centre and box, or why there is nothing.

        A text may tell things apart by relations, orders or numbers, as relation does.
        """
        scene = self.scene(field)
        return {"field": scene.name} | scene.ask(_words(text), frame=frame).as_dict()

    def relation(self, text: Words, frame: Frame = None, field: FieldName = None) -> dict[str, Any]:
        """Finds things told apart by relations, orders or numbers: "the red mug left of the bottle".

        The answer has 0, 1 or several objects, alternatives, and a question where the text leaves open which is meant.
        Directions are seen from a frame, or as `viewpoint` says.
        """
        return self.scene(field).relate(text, frame=frame).as_dict()

    def objects(self, field: FieldName = None) -> dict[str, Any]:
        """Lists the objects of a scene with names, sizes and places, the largest first."""
        rows = object_records(self.scene(field).objects())
        return {"count": len(rows), "objects": rows[:MAX_OBJECTS]}

    def locate(self, text: Words, frame: Frame = None, field: FieldName = None) -> dict[str, Any]:
        """Locates one thing: oriented box, and the middle of its top, where a gripper from above would close."""
        scene = self.scene(field)
        answer = scene.locate(_words(text), frame=frame)
        return answer.as_dict() | {"top": np.round(_top_of(scene, answer), 6).tolist()}

    def measure(self, a: Words, b: Words, frame: Frame = None, field: FieldName = None) -> dict[str, Any]:
        """Measures the distance of two things: between surfaces, between centres, free gap, angle above horizontal."""
        return self.scene(field).measure(a, b, frame=frame)

    def count(self, text: Words, frame: Frame = None, field: FieldName = None) -> dict[str, Any]:
        """Counts the things that a text names: "bottles", "red mugs on the table"."""
        text = text if is_expression(text) else f"how many {text}"
        answer = self.scene(field).relate(text, frame=frame)
        return {"count": answer.count, "reading": answer.reading, "reason": answer.reason}

    def render(self, text: Words, frame: Frame = None, field: FieldName = None) -> Image:
        """Renders a frame with what a text names lit up, as a PNG; by default the frame that shows it best."""
        scene = self.scene(field)
        answer = scene.ask(_words(text), frame=frame)
        index = scene.frame_index(frame) if frame is not None else [*scene.best_frames(answer, 1), 0][0]
        image = cv2.cvtColor(scene.render(index, answer), cv2.COLOR_RGB2BGR)
        return Image(data=cv2.imencode(".png", image)[1].tobytes(), format="png")


def _words(text: str) -> str:
    """Returns a text that is not empty."""
    if not text.strip():
        raise InputError("text", "it is empty", remedy='For example "red mug".')
    return text


def _top_of(scene: Scene, answer: Answer) -> np.ndarray:
    """Returns the middle of the upper side of an answer's points, (3,) in the capture's world."""
    up = scene.objects().up
    return answer.place.center + (np.quantile(answer.points @ up, 0.98) - answer.place.center @ up) * up


def make_server(scenes: dict[str, Scene]) -> MCPServer:
    """Makes the server of the Model Context Protocol.

    Args:
      scenes: Fields by name. The first is the default.

    Returns:
      A server with the tools find, relation, objects, locate, measure, count and render.
    """
    server = MCPServer("jsecon", instructions=f"{INSTRUCTIONS} Fields: {', '.join(scenes)}.")
    tools = _Tools(scenes)
    annotations = ToolAnnotations(read_only_hint=True, open_world_hint=False, idempotent_hint=True)
    for method in (tools.find, tools.relation, tools.objects, tools.locate, tools.measure, tools.count, tools.render):
        text = inspect.getdoc(method)
        structured = method != tools.render
        server.add_tool(_tool(method), description=text, annotations=annotations, structured_output=structured)
    return server


def _tool(method: Callable[..., Any]) -> Callable[..., Any]:
    """Makes the InputErrors of a method errors of a call."""

    @functools.wraps(method)
    def call(*args: Any, **arguments: Any) -> Any:
        try:
            return method(*args, **arguments)
        except InputError as error:
            raise ToolError(str(error)) from error

    return call


def _mcp(verb: verbs.Mcp, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon mcp`; standard output belongs to the protocol, so the console is on standard error."""
    console = Console(sys.stderr)
    with console.progress("fields"):
        scenes = open_scenes(verb.fields, with_models(verb, console, yes=False).embedder)
    for scene in scenes.values():
        console.say(f"{scene.name}: {scene.field.gaussians.count} Gaussians, {scene.field.regions.count} regions")
    return {"then": make_server(scenes).run}


VERBS = {verbs.Mcp: _mcp}
"""what does the work of each verb"""
