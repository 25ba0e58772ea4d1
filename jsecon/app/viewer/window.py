"""`jsecon view`: a field in a browser, asked as one types (extra `viewer`).

One thread owns the state. Each event of the page becomes a step in a queue. The last state is drawn when the queue is
empty, so that a slider that moves faster than answers come skips what lies between.
"""

import contextlib
import dataclasses
import html
import http
import io
import queue
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jsecon.app import verbs
from jsecon.app.access import is_allowed_host, listen
from jsecon.app.catalogue import palette
from jsecon.app.measuring import LENGTH_COLUMNS
from jsecon.app.querying import file_stem
from jsecon.app.records import Answer, Query, Region, source_points
from jsecon.app.scene import Scene, open_scene
from jsecon.app.viewer.layer import SplatLayer
from jsecon.app.viewer.static_page import export_page
from jsecon.errors import InputError
from jsecon.field.membership import SHARE_THRESHOLD
from jsecon.files import csv_text
from jsecon.numerics import axes_across
from jsecon.pipeline.progress import Console
from jsecon.query.pointing import MIN_SHARE, depth_seen, region_shares_seen
from jsecon.query.render import hide
from jsecon.types import Camera, LanguageField

RAY_VIEW_SIDE = 1025
"""side of the view that looks along a ray, px; the ray meets the centre of its middle pixel"""
ANSWER_HUE = 0.91
"""hue of the first answer in `palette`, pink: few natural objects have it"""


@dataclasses.dataclass(frozen=True)
class ViewState:
    """What the viewer shows. Two equal states look the same."""

    questions: tuple[str | Region, ...] = ()
    """Texts and clicked regions whose answers are highlighted, in the order of their colours."""
    threshold: float = SHARE_THRESHOLD
    """Smallest share of a selected Gaussian."""
    all_of_class: bool = False
    """Whether to select all regions that match instead of the best one."""
    only_selected: bool = False
    """Whether the selected Gaussians alone are visible, if there are any."""

    @property
    def queries(self) -> tuple[Query, ...]:
        """The highlighted questions with their options."""
        options = {"threshold": self.threshold, "all_of_class": self.all_of_class}
        return tuple(Query(question, **options) for question in self.questions)

    def with_question(self, question: str | Region, *, add: bool = False) -> "ViewState":
        """Highlights a question in place of the others, or beside them. A blank text highlights nothing."""
        others = tuple(other for other in self.questions if add and other != question)
        return dataclasses.replace(self, questions=(*others, *((question,) if str(question).strip() else ())))

    def with_click(self, above: Sequence[Region], *, add: bool = False) -> "ViewState":
        """Highlights the first of a region and what it belongs to, or the one after that which is highlighted.

        After the last of them nothing is highlighted.
        """
        held = next((k for k, region in enumerate(above) if region in self.questions), -1)
        state = dataclasses.replace(self, questions=tuple(q for q in self.questions if add and q != above[held]))
        return state.with_question(above[held + 1], add=True) if held + 1 < len(above) else state


def _highlight(base: UInt8[np.ndarray, "n 3"], answers: Sequence[Answer | InputError]) -> UInt8[np.ndarray, "n 3"]:
    """Tints the Gaussians of each answer in its colour, and dims the others; if none is selected the colours stay."""
    tints = palette(len(answers), ANSWER_HUE)
    found = [(tint, answer) for tint, answer in zip(tints, answers) if isinstance(answer, Answer) and len(answer.rows)]
    if not found:
        return base
    grey = base.mean(1, keepdims=True, dtype=np.float32)
    colours = (0.4 * (0.4 * base + 0.6 * grey)).astype(np.uint8)  # darker, and less of its hue
    best = np.full(len(base), -np.inf, np.float32)
    for tint, answer in found:
        similarity = np.asarray(answer.selection.similarity)
        rows = np.flatnonzero(answer.mask & (np.nan_to_num(similarity) > best))
        best[rows] = similarity[rows]
        colours[rows] = (0.45 * base[rows] + 0.55 * tint).astype(np.uint8)
    return colours


class Viewer:
    """A scene, its window with the controls, and the thread that draws.

    Args:
      scene: The scene.
      server: The viser server.
      state: The first state.

    Attributes:
      state: The present state.
      drawn: The state that the window shows.
      layer: The Gaussians in the window.
    """

    def __init__(self, scene: Scene, server: Any, state: ViewState):
        self.scene, self.server, self.state = scene, server, state
        self.layer = SplatLayer(server, scene.field)
        self._start_point: np.ndarray | None = None  # of the length that the next click ends
        self._lengths: list[dict[str, Any]] = []
        self._steps: queue.SimpleQueue[Callable[[ViewState], ViewState | None] | None] = queue.SimpleQueue()
        self._add_controls()
        self._draw()
        self.then(self._prepare)
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def _add_controls(self) -> None:
        """Makes the controls; each event of them becomes a step."""
        gui, default, names = self.server.gui, ViewState(), self.scene.field.names
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="medium")
        gui.set_panel_label(f"jsecon · {self.scene.name}")
        with gui.add_form(None) as text_form:
            self._text = gui.add_text("find", "", hint="Text to find, then press enter")
        hint = "Keep what is selected when you find or click something else"
        self._add = gui.add_checkbox("add to selection", False, hint=hint)
        self._messages = gui.add_html("")
        self._notice = gui.add_html("")
        every = "Select every region that matches, not only the best one"
        share = "Smallest share of a Gaussian that must lie in the matching regions"
        self._controls = {
            "all_of_class": gui.add_checkbox("all of its kind", default.all_of_class, hint=every),
            "threshold": gui.add_slider("threshold", 0.0, 1.0, 0.01, default.threshold, hint=share),
            "only_selected": gui.add_checkbox("only the selection", default.only_selected, hint="Hide everything else"),
        }
        hint = "Two clicks in the scene draw and tell the length between them"
        self._measuring = gui.add_checkbox("measure", False, hint=hint)
        hint = "Download the selected Gaussians as a .ply, and the measured lengths as a .csv"
        export = gui.add_button("export", hint=hint)
        hint = "Go to the camera of a frame"
        frame = gui.add_dropdown("frame", ("choose", *names), initial_value="choose", hint=hint)

        text_form.on_submit(_in_order(self._find))
        for name, control in self._controls.items():
            control.on_update(_in_order(lambda event, name=name: self._set_control(name, event.target.value)))
        export.on_click(_in_order(lambda event: self.then(lambda _: self._export(event.client))))
        frame.on_update(_in_order(self._choose_frame))
        for modifier in (None, "shift"):
            self.server.scene.on_click(modifier=modifier)(_in_order(self._click_scene))

    def _find(self, event: Any) -> None:
        text, add = self._text.value, self._add.value
        self.then(lambda state: state.with_question(text, add=add))

    def _set_control(self, name: str, value: Any) -> None:
        if getattr(self.state, name) != value:
            self.then(lambda state: dataclasses.replace(state, **{name: value}))

    def _choose_frame(self, event: Any) -> None:
        names = self.scene.field.names
        if event.client is not None and event.target.value in names:
            self.then(lambda _: self.layer.go_to(event.client, names.index(event.target.value)))

    def _click_scene(self, event: Any) -> None:
        camera = event.client.camera
        focal = camera.image_height / 2 / np.tan(camera.fov / 2)
        if self._measuring.value:
            self.then(lambda _: self._measure(event, focal))
            return
        add = self._add.value or event.modifier == "shift"
        self.then(lambda state: self._clicked(state, event, focal, add=add))

    def stop(self) -> None:
        """Ends the thread."""
        self._steps.put(None)
        self._thread.join()

    def then(self, step: Callable[[ViewState], ViewState | None]) -> None:
        """Queues a step: a function of the present state, which returns the next one, or None to keep it."""
        self._steps.put(step)

    def _clicked(self, state: ViewState, ray: Any, focal: float, *, add: bool) -> ViewState:
        """Highlights the region that the ray of an event in the window's world meets; focal length in px."""
        region = _region_along(*self._along(ray, focal))
        if region < 0:
            raise InputError("", "no region is known there: it is background, or no frame shows it")
        above = [Region(region)]
        while (wider := self.scene.wider(above[-1])) is not None:
            above.append(wider)
        return state.with_click(above, add=add)

    def _measure(self, ray: Any, focal: float) -> None:
        """Starts a length where a ray meets the scene, or ends the one that was started, draws it and tells it."""
        point = _point_along(*self._along(ray, focal))
        if point is None:
            raise InputError("", "nothing is there to measure to")
        start, self._start_point = self._start_point, point
        if start is None:
            self.layer.draw_length(len(self._lengths), point, point, "")
            return
        self._start_point = None
        row = self.scene.measure(*source_points(self.scene.field, np.stack([start, point])).tolist())
        words = f"{row['centers']:.4g} {row['unit']}"
        self.layer.draw_length(len(self._lengths), start, point, words)
        self._lengths.append(row)
        self._show_notice(words)

    def _along(self, ray: Any, focal: float) -> tuple[LanguageField, Camera]:
        """The visible part of the field, and a view whose middle pixel looks along a ray of the window's world."""
        start, direction = np.asarray(ray.ray_origin) / self.layer.scale, np.asarray(ray.ray_direction)
        field = self.scene.field
        field = dataclasses.replace(field, gaussians=hide(field.gaussians, ~self._visible()))
        return field, _view_along(start, direction, focal)

    def _export(self, client: Any) -> None:
        """Sends the highlighted Gaussians as a .ply, and the measured lengths as a .csv."""
        found = self._found()
        if self._lengths:
            lengths = csv_text(LENGTH_COLUMNS, self._lengths).encode()
            client.send_file_download("lengths.csv", lengths, save_immediately=True)
        elif not found:
            raise InputError("", "no Gaussian is selected, so there is no file to export")
        if found:
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder, f"{file_stem(found[0].query)}.ply")
                self.scene.export(file, np.any([answer.mask for answer in found], axis=0))
                client.send_file_download(file.name, file.read_bytes(), save_immediately=True)

    def _work(self) -> None:
        """Takes the steps in turn, and draws the last state when no step waits."""
        while (step := self._steps.get()) is not None:
            try:
                self.state = step(self.state) or self.state
                if self._steps.empty() and self.state != self.drawn:
                    self._draw()
            except InputError as error:
                self._show_notice(error)
            except Exception:
                self._show_notice("Internal error. The terminal shows its trace.")
                traceback.print_exc()

    def _prepare(self, state: ViewState) -> None:
        """Compiles what questions need."""
        with contextlib.suppress(InputError):  # an embedder without words: each text then has this error
            self.scene.prepare()

    def _found(self) -> list[Answer]:
        """The answers of the state that select a Gaussian."""
        answers = self.scene.ask_all(self.state.queries)
        return [answer for answer in answers if isinstance(answer, Answer) and len(answer.rows)]

    def _visible(self) -> Bool[np.ndarray, " n"]:
        """The Gaussians that the state shows."""
        if self.state.only_selected and (found := self._found()):
            return np.any([answer.mask for answer in found], axis=0)
        return np.ones(self.scene.field.gaussians.count, bool)

    def _draw(self) -> None:
        """Colours the Gaussians, sets the controls, and describes the answer or the error of each question."""
        state = self.state
        answers = self.scene.ask_all(state.queries)
        self.layer.paint(_highlight(self.layer.photo, answers), self._visible())
        texts = [question for question in state.questions if isinstance(question, str)]
        self._text.value = texts[-1] if texts else ""
        for name, control in self._controls.items():
            control.value = getattr(state, name)
        self._messages.content = "".join(map(_message, range(len(answers)), state.queries, answers))
        self._show_notice("")
        self.drawn: ViewState | None = state

    def _show_notice(self, text: str | InputError) -> None:
        """Shows a notice above the answers; "" removes it."""
        words = _error(text) if isinstance(text, InputError) else html.escape(text)
        self._notice.content = _box(words) if words else ""


def _in_order(act: Callable[[Any], Any]) -> Any:
    """Returns a callback that runs in the order of the page's events, as viser's coroutines do."""

    async def callback(event: Any) -> None:
        act(event)

    return callback


def _message(place: int, query: Any, answer: Answer | InputError) -> str:
    """An answer or an error behind a square in its colour."""
    colour = "#{:02x}{:02x}{:02x}".format(*palette(place + 1, ANSWER_HUE)[place])
    swatch = f'<span style="display:inline-block;width:.8em;height:.8em;border-radius:2px;background:{colour}"></span>'
    failed = isinstance(answer, InputError)
    words = _error(answer) if failed else html.escape(answer.describe())
    return _box(f"{swatch} <b>{html.escape(str(query))}</b>: {words}", "#fa0" if failed else colour)


def _error(error: InputError) -> str:
    """An error whose remedy a click shows."""
    return f"<details><summary>{html.escape(error.sentence)}</summary>{html.escape(error.remedy)}</details>"


def _box(text: str, colour: str = "#fa0") -> str:
    style = f"margin:0 .8em .5em;padding:.4em .6em;border-left:3px solid {colour};font-size:.8em"
    return f'<div style="{style}">{text}</div>'


def _view_along(origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"], focal: float) -> Camera:
    """A view whose middle pixel looks along a ray in the field's world.

    `focal` is the focal length (px) of the view that the ray belongs to: it decides how large a pixel is.
    """
    forward = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([*axes_across(forward), forward])
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(origin, np.float64)
    intrinsics = (np.asarray(x, np.float32) for x in (focal, focal, RAY_VIEW_SIDE / 2, RAY_VIEW_SIDE / 2))
    return Camera(pose.astype(np.float32), *intrinsics, width=RAY_VIEW_SIDE, height=RAY_VIEW_SIDE)


def _region_along(field: LanguageField, camera: Camera) -> int:
    """The region that makes up most of the middle pixel of a view, or -1."""
    shares = region_shares_seen(field, camera, RAY_VIEW_SIDE // 2, RAY_VIEW_SIDE // 2)
    return int(shares.argmax()) if shares.size and shares.max() >= MIN_SHARE else -1


def _point_along(field: LanguageField, camera: Camera) -> Float[np.ndarray, "3"] | None:
    """The point (3,) that the middle pixel of a view shows, or None."""
    depth = depth_seen(field.gaussians, camera, RAY_VIEW_SIDE // 2, RAY_VIEW_SIDE // 2)
    pose = np.asarray(camera.world_to_camera, np.float64)
    return None if depth is None else pose[:3, :3].T @ ([0, 0, depth] - pose[:3, 3])


@contextlib.contextmanager
def _guarded_pages() -> Iterator[None]:
    """Guards the viser servers that are started inside of this context.

    They take requests whose Host header names loopback, and which no page of another site sends. viser has no hook for
    requests, so this wraps the function of the package websockets by which it listens, while the server starts.
    RuntimeError: This viser listens in another way, so its page would be open to everybody.
    """
    import websockets.asyncio.server as sockets

    listen = sockets.serve
    wrapped = []

    def serve(handler: Any, *address: Any, process_request: Callable[..., Any], **kwargs: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            return _refusal(connection, request) or process_request(connection, request)

        wrapped.append(True)
        return listen(handler, *address, process_request=checked, **kwargs)

    sockets.serve = serve  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        sockets.serve = listen
    if not wrapped:
        raise RuntimeError("this viser does not listen through websockets.asyncio.server.serve")


def _refusal(connection: Any, request: Any) -> Any:
    """Returns the response to a request that may not see the page, None for one that may go on."""
    host = request.headers.get("Host", "")
    origin = request.headers.get("Origin")
    if is_allowed_host(host) and (origin is None or urlsplit(origin).netloc.lower() == host.lower()):
        return None
    words = "This page is shown to this machine alone, under the address that jsecon view printed."
    return connection.respond(http.HTTPStatus.FORBIDDEN, words)


def open_viewer(scene: Scene, *, port: int, state: ViewState) -> Viewer:
    """Opens a viewer on loopback, at a port (0 takes a free one)."""
    try:
        import viser
    except ImportError as error:
        remedy = 'Run: pip install "jsecon[viewer]". Or write a page with --export.'
        raise InputError("jsecon view", "the package viser is missing", remedy=remedy) from error
    host = "127.0.0.1"
    listen(host, port).close()  # viser would go on to the next port
    no_banner = contextlib.redirect_stdout(io.StringIO())  # it would come before the viewer can answer
    with no_banner, _guarded_pages():
        server = viser.ViserServer(host, port, label=f"jsecon · {scene.name}", verbose=False)
    return Viewer(scene, server, state)


def _view(verb: verbs.View, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon view`; the result is {} once the viewer is stopped."""
    if verb.export is not None:
        return export_page(verb, verb.export, console)
    # Without its model a field can be clicked, so the model is opened when the first text is asked.
    scene = open_scene(verb.field, embedder=verb.embedder, console=console)
    if verb.texts:
        _ = scene.embedder
    state = ViewState(tuple(dict.fromkeys(verb.texts)))
    viewer = open_viewer(scene, port=verb.port, state=state)
    console.print_line(str(scene))
    console.print_line(f"http://127.0.0.1:{viewer.server.get_port()}")
    try:
        viewer.server.sleep_forever()
    finally:
        viewer.stop()  # a thread inside XLA at the interpreter's end aborts it
    return {}
