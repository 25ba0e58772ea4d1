"""`jsecon mcp`: fields as tools of language models, over the Model Context Protocol on standard input and output.

Extra `mcp`. Every tool reads, none writes; a name in a call is never a path. Bad input is the error of a call, in words
that tell the model what to change.
"""

import functools
import inspect
import sys
from collections.abc import Callable, Mapping
from typing import Annotated, Any, TypeAlias

import cv2
import numpy as np
from mcp.server.mcpserver import Image, MCPServer
from mcp.server.mcpserver.exceptions import ToolError
from mcp.types import ToolAnnotations
from pydantic import Field

from jsecon.app import verbs
from jsecon.app.records import unit_of
from jsecon.app.scene import Scene, find_scene, open_scenes
from jsecon.errors import InputError
from jsecon.pipeline.progress import Console

Words: TypeAlias = Annotated[str, Field(description="What is asked for, in words", pattern=r"\S", max_length=500)]
Frame: TypeAlias = Annotated[str | None, Field(description="Name of the frame that it is seen from, or its place: #3")]
FieldName: TypeAlias = Annotated[str | None, Field(description="Name of the field; the first by default")]


class _Tools:
    """The tools: plain values out, InputError for bad input. Models read their docstrings and annotations."""

    def __init__(self, scenes: Mapping[str, Scene]):
        self._scenes = scenes

    def find(self, text: Words, frame: Frame = None, field: FieldName = None) -> dict[str, Any]:
        """Finds or counts what a text names: number of Gaussians and objects, score, centre and box, or why not.

        "state" is "found", "unsure" (the best match is given, and what the text names may be absent) or "absent".
        Of a text with a relation, an order or a number, "relation" has the objects, how the text was read, and a
        question where it leaves open which object is meant.
        """
        scene = find_scene(self._scenes, field)
        return {"field": scene.name} | scene.ask(text, frame=frame).as_dict()

    def objects(self, field: FieldName = None) -> dict[str, Any]:
        """Lists the objects of a scene with names, sizes and places, the largest first; at most 100."""
        scene = find_scene(self._scenes, field)
        listed = scene.objects()
        world = {"unit": unit_of(scene.field), "up": listed.up.tolist(), "up_evidence": listed.up_evidence}
        return {"count": len(listed)} | world | {"objects": listed.records()[:100]}

    def locate(self, text: Words, frame: Frame = None, field: FieldName = None) -> dict[str, Any]:
        """Locates one thing: oriented box, and the middle of its top, where a gripper from above would close."""
        scene = find_scene(self._scenes, field)
        answer = scene.locate(text, frame=frame)
        listed = scene.objects()
        center, up = answer.place.center, listed.up
        top = center + (np.quantile(answer.points @ up, 0.98) - center @ up) * up
        return answer.as_dict() | {"top": np.round(top, 6).tolist(), "up_evidence": listed.up_evidence}

    def measure(self, a: Words, b: Words, frame: Frame = None, field: FieldName = None) -> dict[str, Any]:
        """Measures the distance of two things: between surfaces, between centres, free gap, angle above horizontal."""
        return find_scene(self._scenes, field).measure(a, b, frame=frame)

    def render(self, text: Words, frame: Frame = None, field: FieldName = None) -> Image:
        """Renders a frame with what a text names lit up, as a PNG; by default the frame that shows it best."""
        scene = find_scene(self._scenes, field)
        answer = scene.ask(text, frame=frame)
        index = scene.frame_index(frame) if frame is not None else [*scene.best_frames(answer, 1), 0][0]
        image = cv2.cvtColor(scene.render(index, answer), cv2.COLOR_RGB2BGR)
        return Image(data=cv2.imencode(".png", image)[1].tobytes(), format="png")


def make_server(scenes: Mapping[str, Scene]) -> MCPServer:
    """Makes the server of scenes by name, the first of which is the default."""
    instructions = (
        "Finds things in 3D scenes. Coordinates are in the scene's own world and in the answer's unit. "
        'A text names a thing, or tells it apart by place, order or number: "the second red mug from the left", "the '
        'ball on the plate next to the bowl", "how many bottles".'
    )
    server = MCPServer("jsecon", instructions=f"{instructions} Fields: {', '.join(scenes)}.")
    tools = _Tools(scenes)
    annotations = ToolAnnotations(read_only_hint=True, open_world_hint=False, idempotent_hint=True)
    for method in (tools.find, tools.objects, tools.locate, tools.measure, tools.render):
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
    console = Console(sys.stderr, sys.stderr)
    with console.progress("fields"):
        scenes = open_scenes(verb.fields, verb.embedder)
    for scene in scenes.values():
        field = scene.field
        console.print_line(f"{scene.name}: {field.gaussians.count} Gaussians, {field.regions.count} regions")
    return {"then": make_server(scenes).run}
