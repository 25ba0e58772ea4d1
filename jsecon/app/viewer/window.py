"""`jsecon view`: a field in a browser, asked as one types (extra `viewer`).

One thread owns the state. Each event of the page becomes a step in a queue. The last state is drawn when the queue is
empty, so that a slider that moves faster than answers come skips what lies between.
"""

import contextlib
import dataclasses
import io
import queue
import tempfile
import threading
import traceback
import zipfile
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jsecon.app import verbs
from jsecon.app.access import bracketed, guarded_pages, listen, token_for
from jsecon.app.models import open_embedder
from jsecon.app.outputs import file_stem, write_answer
from jsecon.app.pictures import UNKNOWN, palette
from jsecon.app.records import Answer, Query
from jsecon.app.scene import Scene, open_scene
from jsecon.app.viewer.layer import SplatLayer
from jsecon.app.viewer.panel import Panel
from jsecon.app.viewer.state import ViewState, highlight, score_colours
from jsecon.app.viewer.static_page import export_page
from jsecon.errors import InputError
from jsecon.pipeline.progress import Console
from jsecon.query.pointing import MIN_SHARE, region_shares_seen
from jsecon.query.render import HIDDEN_LOGIT
from jsecon.types import Camera, LanguageField

RAY_VIEW_SIDE = 1025
"""side of the view that looks along a ray, px; the ray meets the centre of its middle pixel"""


class Viewer:
    """A scene, its window, and the thread that draws.

    Args:
      scene: The scene.
      server: The viser server.

    Attributes:
      state: The present state.
      drawn: The state that the window shows.
      layer: The Gaussians in the window.
      panel: The controls.
    """

    def __init__(self, scene: Scene, server: Any):
        self.scene = scene
        self.server = server
        self.state = ViewState()
        self.drawn: ViewState | None = None
        self.layer = SplatLayer(server, scene.field)
        self.panel = Panel(self, server)
        table = np.concatenate([palette(scene.field.regions.count), np.full((1, 3), 255 * UNKNOWN, np.uint8)])
        self._base_colours = {"photo": self.layer.photo, "region": table[self.layer.regions]}
        self._steps: queue.SimpleQueue[Callable[[], Any] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def start(self, state: ViewState) -> None:
        """Draws the first state, and starts the thread, which first compiles what questions need."""
        self.state = state
        self._draw()
        self._steps.put(self._prepare)
        self._thread.start()

    def run(self) -> None:
        """Keeps the viewer running until it is interrupted."""
        try:
            self.server.sleep_forever()
        finally:
            self.stop()  # a thread inside XLA at the interpreter's end aborts it

    def stop(self) -> None:
        """Ends the thread."""
        self._steps.put(None)
        self._thread.join()

    def then(self, step: Callable[[ViewState], ViewState]) -> None:
        """Queues a step, which makes the next state of the present one."""

        def act() -> None:
            self.state = step(self.state)

        self._steps.put(act)

    def click(self, origin: Sequence[float], direction: Sequence[float], focal: float, *, add: bool) -> None:
        """Queues highlighting the region that a ray in the window's world meets; focal length in px."""
        start = np.asarray(origin) / self.layer.scale

        def act() -> None:
            visible = self._visible(self.state)
            region = region_along(self.scene.field, start, np.asarray(direction), focal=focal, visible=visible)
            if region < 0:
                raise InputError("", "no region is known there: it is background, or no frame shows it")
            self.state = self.state.toggle_region(region, add=add)

        self._steps.put(act)

    def go_to_frame(self, client: Any, frame: int) -> None:
        """Queues the flight of a client to a frame."""
        self._steps.put(lambda: self.layer.fly(client, frame))

    def export(self, client: Any) -> None:
        """Queues sending the highlighted answers as a .zip: .ply, .json and masks of each."""

        def act() -> None:
            answers = [self.answer(query) for query in self.state.queries]
            answers = [answer for answer in answers if isinstance(answer, Answer) and len(answer.rows)]
            if not answers:
                raise InputError("", "no Gaussian is selected, so there is no file to export")
            client.send_file_download(f"{file_stem(answers[0])}.zip", self._zipped(answers), save_immediately=True)

        self._steps.put(act)

    def answer(self, query: Query) -> Answer | InputError:
        """Answers a query, or returns why it cannot be answered."""
        return self.scene.ask_all([query])[0]

    def _zipped(self, answers: Sequence[Answer]) -> bytes:
        packed = io.BytesIO()
        options: dict[str, Any] = {"compression": zipfile.ZIP_DEFLATED}
        options["strict_timestamps"] = False  # for clocks before 1980
        with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(packed, "w", **options) as archive:
            for answer in answers:
                write_answer(answer, self.scene, Path(folder), self.scene.masks(answer, 3))
            for file in sorted(Path(folder).iterdir()):
                archive.write(file, file.name)
        return packed.getvalue()

    def _work(self) -> None:
        """Takes the steps in turn, and draws the last state when no step waits."""
        while (step := self._steps.get()) is not None:
            try:
                step()
                if self._steps.empty() and self.state != self.drawn:
                    self._draw()
            except InputError as error:
                self.panel.show_notice(error)
            except Exception:
                self.panel.show_notice("Internal error. The terminal shows its trace.")
                traceback.print_exc()

    def _prepare(self) -> None:
        with contextlib.suppress(InputError):  # an embedder without words: each text then has this error
            self.scene.prepare()

    def _visible(self, state: ViewState) -> Bool[np.ndarray, " n"]:
        """The visible Gaussians of a state."""
        count = self.scene.field.gaussians.count
        isolated, hidden = ([self._selection(q)[0] for q in queries] for queries in (state.isolated, state.hidden))
        visible = np.any(isolated, axis=0) if isolated else np.ones(count, bool)
        return visible & ~np.any(hidden, axis=0) if hidden else visible

    def _selection(self, query: Query) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Mask and similarities of an answer; zeros for an error."""
        answer = self.answer(query)
        if isinstance(answer, InputError):
            count = self.scene.field.gaussians.count
            return np.zeros(count, bool), np.zeros(count, np.float32)
        return answer.mask, np.asarray(answer.selection.similarity)

    def _draw(self) -> None:
        """Colours the Gaussians of the window, and describes the answers."""
        state = self.state
        selections = [self._selection(query) for query in state.queries]
        masks, similarities = [mask for mask, _ in selections], [similarity for _, similarity in selections]
        if state.colouring == "score":
            colours = score_colours(similarities, self.scene.field.gaussians.count)
        else:
            matched = masks if any(mask.any() for mask in masks) else []
            colours = highlight(self._base_colours[state.colouring], matched, similarities)
        self.layer.paint(colours, self._visible(state))
        self.panel.show(state, [self.answer(query) for query in state.queries])
        self.drawn = state


def region_along(
    field: LanguageField,
    origin: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    *,
    focal: float,
    visible: Bool[np.ndarray, " n"],
) -> int:
    """Finds the region that makes up most of what a ray in the field's world meets of the visible Gaussians, or -1.

    `focal` is the focal length (px) of the view that the ray belongs to: it decides how large a pixel is.
    """
    forward = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(origin, np.float64)
    intrinsics = (np.asarray(x, np.float32) for x in (focal, focal, RAY_VIEW_SIDE / 2, RAY_VIEW_SIDE / 2))
    camera = Camera(pose.astype(np.float32), *intrinsics, width=RAY_VIEW_SIDE, height=RAY_VIEW_SIDE)
    logits = jnp.where(jnp.asarray(visible), field.gaussians.opacity_logits, HIDDEN_LOGIT)
    field = dataclasses.replace(field, gaussians=dataclasses.replace(field.gaussians, opacity_logits=logits))
    shares = region_shares_seen(field, camera, RAY_VIEW_SIDE // 2, RAY_VIEW_SIDE // 2)
    return int(shares.argmax()) if shares.size and shares.max() >= MIN_SHARE else -1


def open_viewer(
    scene: Scene, *, host: str, port: int, state: ViewState, token: str = "", hosts: Collection[str] = ()
) -> Viewer:
    """Opens a viewer, which listens at a port (0 takes a free one).

    Without a token its page is shown to requests that name this machine: loopback, `host` or one of `hosts`.
    """
    try:
        import viser
    except ImportError as error:
        remedy = 'Run: pip install "jsecon[viewer]". Or write a page with --export.'
        raise InputError("jsecon view", "the package viser is missing", remedy=remedy) from error
    listen(host, port).close()  # viser would go on to the next port
    token = token_for(host, token)
    no_banner = contextlib.redirect_stdout(io.StringIO())  # it would come before the viewer can answer
    with no_banner, guarded_pages(token, (host, *hosts)):
        server = viser.ViserServer(host.strip("[]"), port, label=f"jsecon · {scene.name}", verbose=False)
    viewer = Viewer(scene, server)
    viewer.start(state)
    return viewer


def _view(verb: verbs.View, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon view`; the result is {} once the viewer is stopped."""
    if verb.export is not None:
        return export_page(verb, verb.export, console)
    token = token_for(verb.host, verb.token)
    # Without its model a field can be clicked, so the model is opened when the first text is asked.
    scene = open_scene(verb.field, embedder=lambda field: open_embedder(field, verb, console))
    if verb.texts:
        _ = scene.embedder
    state = ViewState(tuple(dict.fromkeys(verb.texts)))
    access = {"host": verb.host, "port": verb.port, "token": token, "hosts": verb.allow_host}
    viewer = open_viewer(scene, state=state, **access)
    console.print_line(f"{scene.name}: {scene.field.gaussians.count} Gaussians, {scene.field.regions.count} regions")
    query = f"/?{urlencode({'token': token})}" if token else ""
    console.print_line(f"http://{bracketed(verb.host)}:{viewer.server.get_port()}{query}")
    viewer.run()
    return {}
