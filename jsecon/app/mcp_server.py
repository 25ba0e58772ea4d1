"""`jsecon mcp`: fields as tools of language models, over the Model Context Protocol on standard input and output.

Extra `mcp`. Every tool reads, none writes; a name in a call is never a path. Bad input is the error of a call, in words
that tell the model what to change.

Clients wait ten seconds or less for the first answer. So the protocol starts when the paths of the fields are checked;
jax is imported and the fields are opened in a thread, and a call waits for its field.
"""

import contextlib
import functools
import inspect
import os
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import anyio
import numpy as np
from mcp.server.mcpserver import Context, Image, MCPServer
from mcp.server.mcpserver.exceptions import ToolError
from mcp.types import ToolAnnotations
from pydantic import Field

import jsecon
from jsecon.app import verbs
from jsecon.app.opening import find_scene, name_fields
from jsecon.errors import InputError, describe_error
from jsecon.pipeline.progress import Console

PROGRESS_SECONDS = 2.0
"""s between messages to the client while a call waits for its field"""

Words: TypeAlias = Annotated[str, Field(description="What is asked for, in words", pattern=r"\S", max_length=500)]
Frame: TypeAlias = Annotated[str | None, Field(description="Name of the frame that it is seen from, or its place: #3")]
FieldName: TypeAlias = Annotated[str | None, Field(description="Name of the field; the first by default")]


class _Tools:
    """The tools: plain values out, InputError for bad input. Models read their docstrings and annotations."""

    def __init__(self, scenes: Mapping[str, Future[Any]]):
        self._scenes = scenes

    def _scene(self, field: str | None) -> Any:
        return find_scene(self._scenes, field).result()

    async def wait(self, field: str | None, context: Context) -> None:
        """Waits until a field is open or has failed, and reports progress so that the client does not give up."""
        opening, began = find_scene(self._scenes, field), time.monotonic()
        while not opening.done():
            seconds = time.monotonic() - began
            await context.report_progress(seconds, message=f"the field is being opened, {seconds:.0f} s so far")
            with anyio.move_on_after(PROGRESS_SECONDS):
                while not opening.done():
                    await anyio.sleep(0.05)

    def find(self, text: Words, frame: Frame = None, field: FieldName = None) -> dict[str, Any]:
        """Finds or counts what a text names: number of Gaussians and objects, score, centre and box, or why not.

        "state" is "found", "unsure" (the best match is given, and what the text names may be absent) or "absent".
        Of a text with a relation, an order or a number, "relation" has the objects, how the text was read, and a
        question where it leaves open which object is meant.
        """
        scene = self._scene(field)
        return {"field": scene.name} | scene.ask(text, frame=frame).as_dict()

    def objects(self, field: FieldName = None) -> dict[str, Any]:
        """Lists the objects of a scene with names, sizes and places, the largest first; at most 100."""
        listed = self._scene(field).objects().as_dict()
        return listed | {"count": len(listed["objects"]), "objects": listed["objects"][:100]}

    def history(self, field: FieldName = None) -> dict[str, Any]:
        """Lists what moved, is gone, is new or looks another way since a field was made, in order of time."""
        from jsecon.change.history import events  # late: it imports jax

        return {"changes": events(self._scene(field).field)}

    def changes(
        self, later: Annotated[str, Field(description="Name of the later field")], field: FieldName = None
    ) -> dict[str, Any]:
        """Lists what moved, is gone, is new, looks another way or is unsure in a later field of the same place."""
        found = self._scene(field).changes(self._scene(later)).records()
        return {"changes": [record for record in found if record["kind"] != "same"]}

    def locate(self, text: Words, frame: Frame = None, field: FieldName = None) -> dict[str, Any]:
        """Locates one thing: oriented box, and the middle of its top, where a gripper from above would close."""
        scene = self._scene(field)
        answer = scene.locate(text, frame=frame)
        listed = scene.objects()
        center, up = answer.place.center, listed.up
        top = center + (np.quantile(answer.points @ up, 0.98) - center @ up) * up
        return answer.as_dict() | {"top": np.round(top, 6).tolist(), "up_evidence": listed.up_evidence}

    def measure(self, a: Words, b: Words, frame: Frame = None, field: FieldName = None) -> dict[str, Any]:
        """Measures the distance of two things: between surfaces, between centres, angle above horizontal."""
        return self._scene(field).measure(a, b, frame=frame)

    def render(self, text: Words, frame: Frame = None, field: FieldName = None) -> Image:
        """Renders a frame with what a text names lit up, as a PNG; by default the frame that shows it best."""
        import cv2  # late: it takes a tenth of the time to the first answer

        scene = self._scene(field)
        answer = scene.ask(text, frame=frame)
        seen = [*scene.best_frames(answer, 1), 0][0] if frame is None else frame
        image = cv2.cvtColor(scene.render(seen, answer), cv2.COLOR_RGB2BGR)
        return Image(data=cv2.imencode(".png", image)[1].tobytes(), format="png")


def make_server(scenes: Mapping[str, Future[Any]]) -> MCPServer:
    """Makes the server of scenes by name, which need not be open yet; the first is the default."""
    instructions = (
        "Finds things in 3D scenes. Coordinates are in the scene's own world and in the answer's unit. "
        'A text names a thing, or tells it apart by place, order or number: "the second red mug from the left", "the '
        'ball on the plate next to the bowl", "how many bottles".'
    )
    words = f"{instructions} Fields: {', '.join(scenes)}."
    server = MCPServer("jsecon", instructions=words, version=jsecon.__version__)
    tools = _Tools(scenes)
    annotations = ToolAnnotations(read_only_hint=True, open_world_hint=False, idempotent_hint=True)
    methods = tools.find, tools.objects, tools.changes, tools.history, tools.locate, tools.measure, tools.render
    for method in methods:
        text = inspect.getdoc(method)
        structured = method != tools.render
        server.add_tool(_tool(method, tools), description=text, annotations=annotations, structured_output=structured)
    return server


def _tool(method: Callable[..., Any], tools: _Tools) -> Callable[..., Awaitable[Any]]:
    """Makes a tool of a method: a call waits for its field, computes in a thread, and reports an InputError."""

    @functools.wraps(method)
    async def call(*, context: Context, **arguments: Any) -> Any:
        try:
            await tools.wait(arguments.get("field"), context)
            return await anyio.to_thread.run_sync(functools.partial(method, **arguments))
        except InputError as error:
            raise ToolError(str(error)) from error

    call.__annotations__ = {**method.__annotations__, "context": Context}  # by which the server passes it
    return call


def _open_fields(
    fields: Mapping[str, Path], scenes: Mapping[str, Future[Any]], embedder: str | Path | None, console: Console
) -> None:
    """Opens fields one after the other. One that fails is an error of its calls, and is printed."""
    for name, path in fields.items():
        try:
            from jsecon.app.scene import open_prepared  # late: it imports jax

            scene = open_prepared(name, path, embedder, console)
            scenes[name].set_result(scene)
            line = str(scene)
        except Exception as error:  # of a bug too: a call waits for it
            if not isinstance(error, InputError):
                problem = f"the field cannot be opened ({describe_error(error)})"
                error = InputError(path, problem, remedy="Run jsecon doctor.")
            scenes[name].set_exception(error)
            line = f"jsecon: {error}"
        with contextlib.suppress(OSError):  # nobody reads standard error
            console.print_line(line)


def _mcp(verb: verbs.Mcp, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon mcp`; standard output belongs to the protocol, so the console is on standard error."""
    console = Console(sys.stderr, sys.stderr)
    fields = name_fields(verb.fields)
    scenes: dict[str, Future[Any]] = {name: Future() for name in fields}
    server = make_server(scenes)

    def serve() -> None:
        # Half a second later: the import of jax would slow the first answers down.
        opening = threading.Timer(0.5, _open_fields, (fields, scenes, verb.embedder, console))
        opening.daemon = True
        opening.start()
        try:
            server.run()
        finally:
            if not all(scene.done() for scene in scenes.values()):
                os._exit(0)  # the interpreter would end the thread amid a compilation, by SIGSEGV

    return {"then": serve}
