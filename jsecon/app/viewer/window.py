"""A field in a browser, asked as one types (extra `viewer`): viser's window around the states of app/viewing.

One thread owns the state. What the page tells becomes a step in a queue; when the queue is empty the last state is
drawn, so that a slider that moves faster than answers come skips what lies between.
"""

import contextlib
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

from jsecon.app.access import bracketed, listen, token_for
from jsecon.app.ask import Answer, ask_region, ask_text
from jsecon.app.outputs import answer_masks, file_stem, write_answer
from jsecon.app.pictures import UNKNOWN, code_colours, palette
from jsecon.app.viewer import view_state
from jsecon.app.viewer.access import guarded_pages
from jsecon.app.viewer.candidates import Candidate, Pictures, candidates, region_along
from jsecon.app.viewer.panel import Panel, sheet, told
from jsecon.app.viewer.scene import Layers
from jsecon.app.viewer.static_page import NOWHERE
from jsecon.app.viewer.view_state import Ask, History, ViewState
from jsecon.errors import InputError
from jsecon.language.field import load_field
from jsecon.pipeline.networks import ExternalSpace, external_dim
from jsecon.types import LanguageField

REMEDY = 'pip install "jsecon[viewer]"'
KEPT = 32
"""answers, of five bytes a Gaussian each"""
IDLE = 0.6
"""seconds without a step after which the link follows the camera"""
VIEWS = 3
"""masks in an export"""


class Viewer:
    """A field, its window, and the thread that draws."""

    def __init__(self, field: LanguageField, embedder: Any, server: Any, *, name: str):
        self.field, self.embedder, self.server, self.name = field, embedder, server, name
        self.history = History()
        self.drawn: ViewState | None = None
        """the state that the window shows"""
        self.layers = Layers(server, field)
        self.panel = Panel(self, server, field)
        self.answer = functools.lru_cache(KEPT)(self._answer)
        self.base = functools.cache(self._base)
        self._steps: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._camera, self._candidates = (), []
        self._thread = threading.Thread(target=self._work, daemon=True)

    @functools.cached_property
    def pictures(self) -> Pictures:
        return Pictures(self.field)

    def start(self, state: ViewState) -> None:
        """Draws a first state, and from then on what the page asks for; all that a question needs is compiled."""
        self._go(state, whole=True)
        self._paint(self.history.state)
        warm = view_state.asked(ViewState(), "red")
        answers = [self.answer(ask) for ask in warm.asks]
        told(self.field, warm, answers)
        self._sure(warm, answers)

        def act() -> None:
            self.pictures.renderer.photo(0)
            self._tell(self.history.state)

        self.do(act)
        self._thread.start()

    def stop(self) -> None:
        self._steps.put(None)
        self._thread.join()

    def then(self, step: Callable[[ViewState], ViewState], *, whole: bool = False) -> None:
        """Later, in turn: the state that follows; `whole`, where controls and camera are to follow it too."""
        self._steps.put(lambda: self._go(step(self.history.state), whole=whole))

    def do(self, act: Callable[[], None]) -> None:
        """Later, in turn: an act that leaves the state as it is."""
        self._steps.put(act)

    def undo(self) -> None:
        self._steps.put(self._undo)

    def _undo(self) -> None:
        self.history = self.history.back()
        self.panel.show(self.history.state)

    def restore(self, link: str) -> None:
        """The state of a link."""
        self.then(lambda state: view_state.state_of(link), whole=True)

    def seen_from(self, camera: Any) -> None:
        """Where a client looks from, in the field's world."""
        numbers = np.concatenate([camera.position, camera.look_at]) / self.layers.scale
        self._camera = tuple(np.round(np.concatenate([numbers, camera.up_direction]), 5).tolist())

    def click(self, origin: Sequence[float], direction: Sequence[float], focal: float, *, more: bool) -> None:
        """Lights up what a ray of the window meets."""
        start = np.asarray(origin) / self.layers.scale

        def step(state: ViewState) -> ViewState:
            seen = self._shown(state)
            region = region_along(self.field, start, np.asarray(direction), focal=focal, seen=seen)
            if region < 0:
                self.panel.notice("No region is known there: it is background, or no frame shows it.")
                return state
            return view_state.clicked(state, region, more=more)

        self.then(step, whole=True)

    def take(self, number: int) -> None:
        """One of the candidates instead of the thing that it is a candidate for."""

        def step(state: ViewState) -> ViewState:
            place, candidate = self._candidates[number]
            return view_state.instead(state, place, candidate.region)

        self.then(step, whole=True)

    def frame(self, client: Any, frame: int) -> None:
        """Goes to where a frame was taken, and shows the frame with its regions."""

        def act() -> None:
            if client is not None:
                self.layers.fly(client, frame)
            photo = self.pictures.renderer.photo(frame)
            painted = self.pictures.renderer.colours(frame, self.base("region") / np.float32(255))
            self.panel.frame(frame, np.concatenate([photo, (photo * 0.35 + painted * 0.65).astype(np.uint8)]))

        self.do(act)

    def export(self, client: Any) -> None:
        """Sends the answers that are lit up as a .zip: .ply, .json and masks of each."""

        def act() -> None:
            found = [a for a in map(self.answer, self.history.state.asks) if isinstance(a, Answer) and a.mask.any()]
            if not found:
                self.panel.notice("Nothing is lit up, so there is nothing to export.")
            else:
                client.send_file_download(f"{file_stem(found[0])}.zip", self.packed(found), save_immediately=True)

        self.do(act)

    def packed(self, answers: Sequence[Answer]) -> bytes:
        """A .zip of the answers' files."""
        packed = io.BytesIO()
        how = {"compression": zipfile.ZIP_DEFLATED, "strict_timestamps": False}  # a clock may stand before 1980
        with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(packed, "w", **how) as archive:
            for answer in answers:
                write_answer(self.field, answer, Path(folder), answer_masks(self.field, answer, VIEWS))
            for file in sorted(Path(folder).iterdir()):
                archive.write(file, file.name)
        return packed.getvalue()

    def _work(self) -> None:
        while True:
            try:
                step = self._steps.get(timeout=IDLE)
            except queue.Empty:
                self._link()
                continue
            if step is None:
                return
            try:
                step()
                if self._steps.empty() and self.history.state != self.drawn:
                    self._paint(self.history.state)
                    self._tell(self.history.state)
            except InputError as error:
                self.panel.notice(error)
            except Exception:
                self.panel.notice("An error inside; the terminal has it.")
                traceback.print_exc()

    def _go(self, state: ViewState, *, whole: bool) -> None:
        self.history = self.history.then(view_state.moved(state, camera=()))
        if whole:
            self.panel.show(state)
        if state.camera:
            self.layers.look(state.camera)

    def _link(self) -> None:
        self.panel.link(view_state.link_of(view_state.moved(self.history.state, camera=self._camera)))

    def _answer(self, ask: Ask) -> Answer | InputError:
        how: dict[str, Any] = {"several": ask.every, "piece_threshold": 1 - ask.whole}
        try:
            if isinstance(ask.thing, str):
                return ask_text(self.field, self.embedder, ask.thing, threshold=ask.threshold, **how)
            return ask_region(self.field, ask.thing, similarity_threshold=ask.threshold, **how)
        except InputError as error:
            return error

    def _found(self, ask: Ask) -> tuple[np.ndarray, np.ndarray]:
        """(N,) mask and (N,) similarity of an answer; nothing where there is none."""
        found = self.answer(ask)
        if isinstance(found, InputError):
            return np.zeros(self.field.gaussians.count, bool), np.zeros(self.field.gaussians.count, np.float32)
        return found.mask, np.asarray(found.selection.similarity)

    def _shown(self, state: ViewState) -> np.ndarray:
        only, hidden = ([self._found(ask)[0] for ask in asks] for asks in (state.only, state.hidden))
        return view_state.shown(self.field.gaussians.count, only, hidden)

    def _base(self, paint: str) -> np.ndarray:
        """(N, 3) RGB of the Gaussians without an answer."""
        if paint == "code":
            return (255 * code_colours(self.field)).astype(np.uint8)
        if paint == "region":
            regions = self.pictures.regions
            table = np.concatenate([palette(self.field.regions.count), np.full((1, 3), 255 * UNKNOWN, np.uint8)])
            return table[np.where(regions == NOWHERE, -1, regions)]
        return self.layers.photo

    def _paint(self, state: ViewState) -> None:
        """The state in colours."""
        found = [self._found(ask) for ask in state.asks]
        masks, similarities = [mask for mask, _ in found], [similarity for _, similarity in found]
        if state.paint == "score":
            colours = view_state.scored(similarities, self.field.gaussians.count)
        else:
            colours = view_state.lit(self.base(state.paint), masks if any(m.any() for m in masks) else [], similarities)
        self.layers.paint(colours, self._shown(state))
        self.drawn = state

    def _tell(self, state: ViewState) -> None:
        """What there is to say about a state; pictures as long as nothing else is asked."""
        answers = [self.answer(ask) for ask in state.asks]
        self.panel.tell(told(self.field, state, answers))
        self._link()
        self._candidates = self._sure(state, answers)
        pictured = []
        for place, candidate in self._candidates:
            if not self._steps.empty():
                return
            pictured.append((place, candidate, self.pictures.region(candidate.region, candidate.frame)))
        self.panel.candidates(sheet(state, answers, pictured), len(pictured))

    def _sure(self, state: ViewState, answers: Sequence[Answer | InputError]) -> list[tuple[int, Candidate]]:
        """What else the answers might be: (place, candidate)."""
        each = 6 if len(answers) == 1 else 3
        asked = [(k, thing) for k, thing in enumerate(state.things) if not isinstance(answers[k], InputError)][:4]
        return [(k, found) for k, thing in asked for found in candidates(self.field, self.embedder, thing, each)]


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
    """A viewer that listens, and shows its page to who has the token, or on loopback without one asks for it by a name
    of this machine (one of `hosts` too).

    Raises InputError where the extra is missing, the address can't be had, or others can reach it without a token.
    """
    try:
        import viser
    except ImportError as error:
        raise InputError(
            "jsecon view", "the package viser is missing", remedy=f"Run: {REMEDY}. Or write a page with --export."
        ) from error
    listen(host, port).close()  # viser would go on to the next port
    token = token_for(host, token)
    quiet = contextlib.redirect_stdout(io.StringIO())  # its banner comes before anything can be asked
    with quiet, guarded_pages(token, (host, *hosts)):
        server = viser.ViserServer(host.strip("[]"), port, label=f"jsecon · {name}", verbose=False)
    viewer = Viewer(field, embedder, server, name=name)
    viewer.start(state)
    return viewer


def view(asked: Any, embedder_of: Callable[..., Any], say: Callable[[str], object]) -> dict[str, Any]:
    """Shows a field as `jsecon view` asks until it is stopped; raises as `open_viewer` does."""
    token = token_for(asked.host, asked.token)
    state = view_state.state_of(asked.link) if asked.link else ViewState()
    state = view_state.asked(state, "; ".join(asked.texts)) if asked.texts else state
    field, name, dim = load_field(asked.field), asked.field.resolve().parent.name, None
    if not asked.texts and asked.embedder is None:
        dim = external_dim(field.embedder)  # of a space whose model isn't here: it can be clicked, and not asked
    embedder = embedder_of(field, asked) if dim is None else ExternalSpace(dim)
    place = {"host": asked.host, "port": asked.port, "token": token, "hosts": asked.allow_host}
    viewer = open_viewer(field, embedder, name=name, state=state, **place)
    say(f"{name}: {field.gaussians.count} Gaussians, {field.regions.count} regions")
    carried = f"/?{urlencode({'token': token})}" if token else ""
    say(f"http://{bracketed(asked.host)}:{viewer.server.get_port()}{carried}")
    try:
        viewer.server.sleep_forever()
    finally:
        viewer.stop()  # a thread inside XLA at the interpreter's end aborts it
    return {}
