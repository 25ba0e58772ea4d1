"""`jsecon view`: a field in a browser, queried as one types (extra `viewer`).

One thread owns the state. Each event of the page becomes a step in a queue. The last state is drawn when the queue is
empty, so that a slider that moves faster than answers come skips what lies between.
"""

import contextlib
import dataclasses
import functools
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

import numpy as np

from jsecon.app import verbs
from jsecon.app.access import bracketed, guarded_pages, listen, token_for
from jsecon.app.models import open_embedder
from jsecon.app.outputs import file_stem, write_answer
from jsecon.app.pictures import UNKNOWN, Renderer, palette
from jsecon.app.records import Answer, Region
from jsecon.app.scene import Scene
from jsecon.app.viewer import view_state
from jsecon.app.viewer.candidates import Candidate, candidates, region_along
from jsecon.app.viewer.panel import Panel, candidate_grid, messages
from jsecon.app.viewer.scene import FieldScene
from jsecon.app.viewer.static_page import export_page
from jsecon.app.viewer.view_state import History, ViewQuery, ViewState
from jsecon.errors import InputError
from jsecon.field.field import load_field
from jsecon.pipeline.model_loading import ExternalSpace, external_dim
from jsecon.pipeline.progress import Console
from jsecon.query.edits import grow, mutual_neighbours, shrink
from jsecon.types import LanguageField

REMEDY = 'Run: pip install "jsecon[viewer]". Or write a page with --export.'
MAX_ANSWERS = 32
"""number of answers that are kept, of five bytes a Gaussian each"""
IDLE_SECONDS = 0.6
"""s without a step after which the link follows the camera"""
EXPORTED_MASKS = 3
"""number of masks of an answer in an export"""


class Viewer:
    """A field, its window, and the thread that draws.

    Args:
      field: The field.
      embedder: Its embedder.
      server: The viser server.
      name: Name of the field.

    Attributes:
      history: The present state, and those before it.
      drawn: The state that the window shows.
      scene: The field in the window.
      panel: The controls.
      answer: Answers a `ViewQuery`, by an Answer or an InputError. It keeps the last answers.
    """

    def __init__(self, field: LanguageField, embedder: Any, server: Any, *, name: str):
        self.field = field
        self.embedder = embedder
        self.server = server
        self.name = name
        self.history = History()
        self.drawn: ViewState | None = None
        self.scene = FieldScene(server, field)
        self.panel = Panel(self, server, field)
        self.answer = functools.lru_cache(MAX_ANSWERS)(self._answer)
        self._base_colours = functools.cache(self._compute_base_colours)
        self._steps: queue.SimpleQueue[Callable[[], Any] | None] = queue.SimpleQueue()
        self._camera: tuple[float, ...] = ()
        self._candidates: list[tuple[int, Candidate]] = []
        self._thread = threading.Thread(target=self._work, daemon=True)

    @functools.cached_property
    def renderer(self) -> Renderer:
        """Renders the frames."""
        return Renderer(self.field.gaussians, self.field.cameras)

    @functools.cached_property
    def asked(self) -> Scene:
        """The field as a scene that is asked."""
        return Scene(self.field, self.embedder, name=self.name)

    @functools.cached_property
    def _neighbours(self) -> np.ndarray:
        """The Gaussians next to each."""
        return mutual_neighbours(self.field.gaussians.means)

    def start(self, state: ViewState) -> None:
        """Draws the first state, compiles what queries need, and starts the thread.

        Args:
          state: The first state.
        """
        self._set_state(state, update_controls=True)
        self._paint(self.history.state)
        example = ViewState().with_texts("red")
        answers = [self.answer(query) for query in example.view_queries]
        messages(self.field, example, answers)
        self._find_candidates(example, answers)
        for act in (lambda: self.renderer.photo(0), lambda: self._describe(self.history.state), self._prepare_objects):
            self._steps.put(act)
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

    def then(self, step: Callable[[ViewState], ViewState], *, update_controls: bool = False) -> None:
        """Queues a step.

        Args:
          step: Makes the next state of the present one.
          update_controls: Also sets the controls.
        """
        self._steps.put(lambda: self._set_state(step(self.history.state), update_controls=update_controls))

    def undo(self) -> None:
        """Queues the step back to the state before."""

        def back() -> None:
            self.history = self.history.back()
            self.panel.show_state(self.history.state)

        self._steps.put(back)

    def set_camera(self, camera: Any) -> None:
        """Records where a client looks from, for the link.

        Args:
          camera: Camera of the viser client.
        """
        numbers = np.concatenate([camera.position, camera.look_at]) / self.scene.scale
        self._camera = tuple(np.round(np.concatenate([numbers, camera.up_direction]), 5).tolist())

    def click(self, origin: Sequence[float], direction: Sequence[float], focal: float, *, add: bool) -> None:
        """Queues highlighting the region that a ray meets.

        Args:
          origin: (3,) origin of the ray, in the window's world.
          direction: (3,) its direction.
          focal: Focal length of the client's view, px.
          add: Keeps the other queries.
        """
        start = np.asarray(origin) / self.scene.scale

        def step(state: ViewState) -> ViewState:
            visible = self._visible(state)
            region = region_along(self.field, start, np.asarray(direction), focal=focal, visible=visible)
            if region < 0:
                self.panel.show_notice("No region is known there: it is background, or no frame shows it.")
                return state
            return state.toggle_region(region, add=add)

        self.then(step, update_controls=True)

    def select(self, number: int) -> None:
        """Queues highlighting a candidate in place of its query.

        Args:
          number: Index of the candidate in the panel.
        """

        def step(state: ViewState) -> ViewState:
            place, candidate = self._candidates[number]
            return state.replace_match(place, candidate.region)

        self.then(step, update_controls=True)

    def go_to_frame(self, client: Any, frame: int) -> None:
        """Queues a flight to a frame, and its picture with its regions.

        Args:
          client: The viser client, or None for the picture alone.
          frame: Index of the frame.
        """

        def act() -> None:
            if client is not None:
                self.scene.fly(client, frame)
            photo = self.renderer.photo(frame)
            regions = self.renderer.colours(frame, self._base_colours("region") / np.float32(255))
            self.panel.show_frame(frame, np.concatenate([photo, (photo * 0.35 + regions * 0.65).astype(np.uint8)]))

        self._steps.put(act)

    def export(self, client: Any) -> None:
        """Queues sending the highlighted answers as a .zip: .ply, .json and masks of each.

        Args:
          client: The viser client.
        """

        def act() -> None:
            answers = [self.answer(query) for query in self.history.state.view_queries]
            answers = [answer for answer in answers if isinstance(answer, Answer) and answer.mask.any()]
            if not answers:
                self.panel.show_notice("No Gaussian is selected, so there is no file to export.")
            else:
                client.send_file_download(f"{file_stem(answers[0])}.zip", self._zipped(answers), save_immediately=True)

        self._steps.put(act)

    def _zipped(self, answers: Sequence[Answer]) -> bytes:
        """Returns a .zip of the files of answers."""
        packed = io.BytesIO()
        options: dict[str, Any] = {"strict_timestamps": False}  # clocks before 1980
        options["compression"] = zipfile.ZIP_DEFLATED
        with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(packed, "w", **options) as archive:
            for answer in answers:
                write_answer(answer, self.asked, Path(folder), self.asked.masks(answer, EXPORTED_MASKS))
            for file in sorted(Path(folder).iterdir()):
                archive.write(file, file.name)
        return packed.getvalue()

    def _work(self) -> None:
        """Takes the steps in turn, and draws the last state when no step waits."""
        while True:
            try:
                step = self._steps.get(timeout=IDLE_SECONDS)
            except queue.Empty:
                self._update_link()
                continue
            if step is None:
                return
            try:
                step()
                if self._steps.empty() and self.history.state != self.drawn:
                    self._paint(self.history.state)
                    self._describe(self.history.state)
            except InputError as error:
                self.panel.show_notice(error)
            except Exception:
                self.panel.show_notice("Internal error. The terminal shows its trace.")
                traceback.print_exc()

    def _set_state(self, state: ViewState, *, update_controls: bool) -> None:
        """Makes a state the present one."""
        self.history = self.history.then(state.with_controls(camera=()))
        if update_controls:
            self.panel.show_state(state)
        if state.camera:
            self.scene.look(state.camera)

    def _update_link(self) -> None:
        """Shows the link of the state and the camera."""
        self.panel.link.value = self.history.state.with_controls(camera=self._camera).link

    def _answer(self, query: ViewQuery) -> Answer | InputError:
        """Answers a query that is not among the last ones."""
        question = query.query if isinstance(query.query, str) else Region(query.query)
        options: dict[str, Any] = {"all_of_class": query.all_matches, "fragment_score": 1 - query.part_vs_whole}
        try:
            answer = self.asked.ask(question, threshold=query.threshold, **options)
            if not query.shells or not len(answer.rows):
                return answer
            edit = grow if query.shells > 0 else shrink
            mask = np.asarray(edit(answer.mask, self._neighbours, abs(query.shells)))
            return dataclasses.replace(answer, mask=mask, selection=dataclasses.replace(answer.selection, mask=mask))
        except InputError as error:
            return error

    def _prepare_objects(self) -> None:
        """Measures the objects, so that the first relation is answered as fast as later ones."""
        with contextlib.suppress(InputError):  # an embedder without words: each text then has this error
            self.asked.prepare()

    def _selection(self, query: ViewQuery) -> tuple[np.ndarray, np.ndarray]:
        """Returns mask (N,) and similarity (N,) of an answer; zeros for an error."""
        answer = self.answer(query)
        if isinstance(answer, InputError):
            return np.zeros(self.field.gaussians.count, bool), np.zeros(self.field.gaussians.count, np.float32)
        return answer.mask, np.asarray(answer.selection.similarity)

    def _visible(self, state: ViewState) -> np.ndarray:
        """Returns the visible Gaussians of a state (N,)."""
        isolated, hidden = ([self._selection(q)[0] for q in queries] for queries in (state.isolated, state.hidden))
        visible = np.any(isolated, axis=0) if isolated else np.ones(self.field.gaussians.count, bool)
        return visible & ~np.any(hidden, axis=0) if hidden else visible

    def _compute_base_colours(self, colouring: str) -> np.ndarray:
        """Returns the RGB (N, 3) of the Gaussians without an answer."""
        if colouring == "region":
            table = np.concatenate([palette(self.field.regions.count), np.full((1, 3), 255 * UNKNOWN, np.uint8)])
            return table[self.scene.regions]
        return self.scene.photo

    def _paint(self, state: ViewState) -> None:
        """Colours the Gaussians of the window."""
        selections = [self._selection(query) for query in state.view_queries]
        masks = [mask for mask, _ in selections]
        similarities = [similarity for _, similarity in selections]
        if state.colouring == "score":
            colours = view_state.score_colours(similarities, self.field.gaussians.count)
        else:
            base = self._base_colours(state.colouring)
            colours = view_state.highlight(base, masks if any(m.any() for m in masks) else [], similarities)
        self.scene.paint(colours, self._visible(state))
        self.drawn = state

    def _describe(self, state: ViewState) -> None:
        """Shows messages and candidates of a state. It stops at the pictures if another step waits."""
        answers = [self.answer(query) for query in state.view_queries]
        self.panel.messages.content = messages(self.field, state, answers)
        self.panel.show_notice("")
        self._update_link()
        self._candidates = self._find_candidates(state, answers)
        pictured = []
        for place, candidate in self._candidates:
            if not self._steps.empty():
                return
            picture = self.renderer.crop(candidate.frame, self.scene.regions == candidate.region)
            pictured.append((place, candidate, picture))
        self.panel.show_candidates(candidate_grid(answers, pictured), len(pictured))

    def _find_candidates(self, state: ViewState, answers: Sequence[Answer | InputError]) -> list[tuple[int, Candidate]]:
        """Returns the index of a query with each of its candidates, for up to four queries."""
        count = 6 if len(answers) == 1 else 3
        named = [isinstance(answer, Answer) and answer.by != "relation" for answer in answers]
        queries = [(k, q) for k, q in enumerate(state.queries) if named[k]][:4]
        return [(k, c) for k, query in queries for c in candidates(self.asked.text_field, self.embedder, query, count)]


def open_viewer(
    field: LanguageField,
    embedder: Any,
    *,
    host: str,
    port: int,
    name: str,
    state: ViewState,
    token: str = "",
    hosts: Collection[str] = (),
) -> Viewer:
    """Opens a viewer.

    Args:
      field: The field.
      embedder: Its embedder.
      host: Address to listen on.
      port: Port to listen on; 0 takes a free one.
      name: Name of the field.
      state: First state.
      token: Token that the page's address must carry; "" is that of the environment, if any.
      hosts: Names of this machine besides those of loopback and `host`.

    Returns:
      The viewer, which listens. Without a token its page is shown to requests that name this machine.

    Raises:
      InputError: The extra is missing, the address cannot be listened on, or others can reach it without a token.
    """
    try:
        import viser
    except ImportError as error:
        raise InputError("jsecon view", "the package viser is missing", remedy=REMEDY) from error
    listen(host, port).close()  # viser would go on to the next port
    token = token_for(host, token)
    no_banner = contextlib.redirect_stdout(io.StringIO())  # it would come before the viewer can answer
    with no_banner, guarded_pages(token, (host, *hosts)):
        server = viser.ViserServer(host.strip("[]"), port, label=f"jsecon · {name}", verbose=False)
    viewer = Viewer(field, embedder, server, name=name)
    viewer.start(state)
    return viewer


def _view(verb: verbs.View, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon view`; the result is {} once the viewer is stopped."""
    if verb.export is not None:
        return export_page(verb, verb.export, console)
    token = token_for(verb.host, verb.token)
    state = view_state.from_link(verb.link) if verb.link else ViewState()
    if verb.texts:
        state = state.with_texts("; ".join(verb.texts))
    field = load_field(verb.field)
    name = verb.field.resolve().parent.name
    dim = None
    if not verb.texts and verb.embedder is None:
        dim = external_dim(field.embedder)  # without its model a field can be clicked, but not searched by texts
    embedder = open_embedder(field, verb, console) if dim is None else ExternalSpace(dim)
    access = {"host": verb.host, "port": verb.port, "token": token, "hosts": verb.allow_host}
    viewer = open_viewer(field, embedder, name=name, state=state, **access)
    console.say(f"{name}: {field.gaussians.count} Gaussians, {field.regions.count} regions")
    query = f"/?{urlencode({'token': token})}" if token else ""
    console.say(f"http://{bracketed(verb.host)}:{viewer.server.get_port()}{query}")
    viewer.run()
    return {}


VERBS = {verbs.View: _view}
"""what does the work of each verb"""
