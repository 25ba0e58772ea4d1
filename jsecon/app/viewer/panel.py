"""The viewer's panel: its controls, and what it says in HTML."""

import base64
import html
import time
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from jsecon.app.ask import Answer, quantile_message
from jsecon.app.viewer import view_state
from jsecon.app.viewer.candidates import Candidate
from jsecon.app.viewer.view_state import PAINTS, ViewState, tints
from jsecon.errors import InputError
from jsecon.language.membership import probability_inside
from jsecon.query.match import CONTRAST_THRESHOLD, PRESENCE_THRESHOLD, QUANTILE
from jsecon.types import LanguageField

THUMBNAIL = 88
"""px"""


SAME_CLICK = 0.5
"""seconds within which the scene hears of a click on a frustum"""


class Panel:
    """The controls, and what they tell the viewer."""

    def __init__(self, viewer: Any, server: Any, field: LanguageField):
        gui, self._names, self._busy = server.gui, field.names, False
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="medium")
        gui.set_panel_label(f"jsecon · {viewer.name}")
        usual = ViewState()
        with gui.add_form(None) as asking:
            hint = "What to find, then enter. Several things between semicolons, each in a colour of its own."
            self._text = gui.add_text("find", "", hint=hint)
        self._told = gui.add_html("")
        self._notice = gui.add_html("", visible=False)
        self._every = gui.add_checkbox("all that fit", usual.every, hint="Every region that answers, not only the best")
        hint = "The least share of a Gaussian that has to lie in what answers"
        self._threshold = gui.add_slider("threshold", 0.0, 1.0, 0.01, usual.threshold, hint=hint)
        known = field.votes.overlap is not None
        hint = "0: the best region alone; 1: all that overlaps it and is nearer to what was asked than most"
        hint = hint if known else "This field does not know which regions overlap"
        self._whole = gui.add_slider("part or whole", 0.0, 1.0, 0.05, usual.whole, disabled=not known, hint=hint)
        self._paint = gui.add_dropdown("colour", PAINTS, initial_value=usual.paint)
        acts = gui.add_button_group("what is lit up", ("show only", "hide", "export"))
        back = gui.add_button_group("", ("show all", "undo"))
        with gui.add_folder("what else it might be", expand_by_default=True) as self._else:
            self._sheet = gui.add_html("")
            self._take = gui.add_button_group("instead", ("1",), hint="That region in place of the answer")
        self._else.visible = False
        with gui.add_folder("frames", expand_by_default=False):
            hint = "Goes to where the frame was taken"
            self._frame = gui.add_dropdown("frame", ("choose", *field.names), initial_value="choose", hint=hint)
            cameras = gui.add_checkbox("show cameras", False, hint="Click one to go there")
            self._picture = gui.add_image(np.zeros((2, 2, 3), np.uint8), visible=False)
        with gui.add_form(None) as restoring:
            hint = "Copy it to keep what is seen; paste one and press enter to have it back"
            self._link = gui.add_text("link", "", hint=hint)

        on = lambda handle: handle.on_update
        asking.on_submit(_later(lambda e: viewer.then(lambda s: view_state.asked(s, self._text.value))))
        restoring.on_submit(_later(lambda e: viewer.restore(self._link.value)))
        for name in ("every", "threshold", "whole", "paint"):
            on(getattr(self, f"_{name}"))(_later(lambda e, name=name: self._moved(viewer, name, e.target.value)))
        steps = {"show only": view_state.shown_only, "hide": view_state.hidden, "show all": view_state.all_shown}
        for group in (acts, back):

            @group.on_click
            async def _(event: Any) -> None:
                act = event.target.value
                if act in steps:
                    viewer.then(steps[act], whole=True)
                elif act == "undo":
                    viewer.undo()
                else:
                    viewer.export(event.client)

        self._take.on_click(_later(lambda e: viewer.take(int(e.target.value) - 1)))
        on(self._frame)(_later(lambda e: self._chosen(viewer, e)))
        on(cameras)(_later(lambda e: viewer.layers.show_frames(e.target.value)))
        for frame, frustum in viewer.layers.frustums.items():
            frustum.on_click(_later(lambda e, frame=frame: self._clicked(viewer, e, frame)))
        for modifier in (None, "shift"):
            server.scene.on_click(modifier=modifier)(_later(lambda e: self._clicked(viewer, e, None)))

        @server.on_client_connect
        async def _(client: Any) -> None:
            client.camera.on_update(_later(viewer.seen_from))

        self._ray, self._then = np.zeros(3), 0.0
        """of the last click on a frustum, which the scene hears of too, by a ray that is rounded otherwise; and when"""

    def _moved(self, viewer: Any, name: str, value: Any) -> None:
        if getattr(viewer.history.state, name) != value:
            viewer.then(lambda state: view_state.moved(state, **{name: value}))

    def _chosen(self, viewer: Any, event: Any) -> None:
        if event.client is not None and event.target.value in self._names:
            viewer.frame(event.client, self._names.index(event.target.value))

    def _clicked(self, viewer: Any, event: Any, frame: int | None) -> None:
        if frame is not None:
            self._ray, self._then = np.asarray(event.ray_direction), time.monotonic()
            viewer.frame(event.client, frame)
        elif time.monotonic() - self._then > SAME_CLICK or not np.allclose(event.ray_direction, self._ray, atol=0.02):
            camera = event.client.camera
            focal = camera.image_height / 2 / np.tan(camera.fov / 2)
            viewer.click(event.ray_origin, event.ray_direction, focal, more=event.modifier == "shift")

    def show(self, state: ViewState) -> None:
        """Sets the controls as a state has them."""
        self._text.value = view_state.line_of(state)
        self._every.value, self._paint.value = state.every, state.paint
        self._threshold.value, self._whole.value = state.threshold, state.whole

    def tell(self, content: str) -> None:
        self._told.content = content
        self._notice.visible = False

    def notice(self, text: str | InputError) -> None:
        content = _error(text) if isinstance(text, InputError) else html.escape(text)
        self._notice.content, self._notice.visible = _box(content), True

    def candidates(self, content: str, count: int) -> None:
        self._sheet.content, self._else.visible = content, count > 0
        if count:
            self._take.options = tuple(str(k + 1) for k in range(count))

    def frame(self, frame: int, picture: np.ndarray) -> None:
        self._frame.value = self._names[frame]
        self._picture.image, self._picture.visible = picture, True

    def link(self, text: str) -> None:
        self._link.value = text


def _later(act: Any) -> Any:
    """A callback that runs in the order of what the page tells, as viser's coroutines do."""

    async def told_of(event: Any) -> None:
        act(event)

    return told_of


def _error(error: InputError) -> str:
    told, remedy = error.sentence, error.remedy
    return f"<details><summary>{html.escape(told)}</summary>{html.escape(remedy)}</details>"


def _box(text: str) -> str:
    return f'<div style="margin:0 .8em .5em;padding:.4em .6em;border-left:3px solid #fa0;font-size:.8em">{text}</div>'


def _colour(place: int) -> str:
    return "#{:02x}{:02x}{:02x}".format(*tints(place + 1)[place])


def _swatch(place: int) -> str:
    shape = "display:inline-block;width:.8em;height:.8em;border-radius:2px"
    return f'<span style="{shape};background:{_colour(place)}"></span>'


def told(field: LanguageField, state: ViewState, answers: Sequence[Answer | InputError]) -> str:
    """What there is to say about each answer: how many Gaussians, how sure, or why there is none."""
    lines = []
    for place, (thing, found) in enumerate(zip(state.things, answers, strict=True)):
        name = thing if isinstance(thing, str) else f"region {thing}"
        head = f"{_swatch(place)} <b>{html.escape(name)}</b>"
        if isinstance(found, InputError):
            lines.append(_box(f"{head}: {_error(found)}"))
            continue
        score, count = float(found.selection.score), int(found.mask.sum())
        if int(found.selection.region) < 0 and not np.asarray(found.selection.mask).any():
            if found.quantile is not None:
                best, least = quantile_message(found.quantile), f"{100 * QUANTILE:.0f} %"
            elif found.there is not None:
                best, least = f"it is there with a probability of {found.there:.2g}", PRESENCE_THRESHOLD
            else:
                best, least = f"the best score is {score:.2f}", CONTRAST_THRESHOLD
            why = f"nothing here answers it: {best}, and {least} is the least"
            lines.append(_box(f"{head}: {why}. Below is what comes nearest."))
        elif not count:
            lines.append(_box(f"{head}: no Gaussian reaches the threshold {state.threshold:.2f}."))
        else:
            sure = probability_inside(found.selection.similarity, field.votes, found.mask).mean()
            kind = f"score {score:.2f}, " if isinstance(thing, str) else ""
            lines.append(f'<div style="margin:0 .8em .4em;font-size:.85em">{head}: {count} Gaussians, {kind}')
            lines[-1] += (
                "by its parts, as no region holds it" if "regions" in found.left_out else f"sure to {100 * sure:.0f} %"
            )
            lines[-1] += "</div>"
    return "".join(lines)


def sheet(
    state: ViewState, answers: Sequence[Answer | InputError], found: Sequence[tuple[int, Candidate, np.ndarray]]
) -> str:
    """The candidates with their pictures and scores, as HTML; the region that was taken has a frame of its colour."""
    cells = []
    for number, (place, candidate, picture) in enumerate(found):
        side = THUMBNAIL / max(picture.shape[:2])
        small = cv2.resize(picture, None, fx=side, fy=side, interpolation=cv2.INTER_AREA)
        packed = base64.b64encode(cv2.imencode(".jpg", small[..., ::-1])[1].tobytes()).decode()
        answer = answers[place]
        taken = not isinstance(answer, InputError) and int(answer.selection.region) == candidate.region
        edge = _colour(place) if taken else "transparent"
        cells.append(
            f'<figure style="margin:0;text-align:center;font-size:.75em"><img src="data:image/jpeg;base64,{packed}" '
            f'style="border:3px solid {edge};border-radius:4px;max-width:100%"><figcaption>{_swatch(place)} '
            f"{number + 1}: {candidate.score:.2f}{', taken' if taken else ''}</figcaption></figure>"
        )
    grid = "display:grid;grid-template-columns:repeat(3,1fr);gap:.4em;margin:.4em .6em;align-items:end"
    return f'<div style="{grid}">{"".join(cells)}</div>'
