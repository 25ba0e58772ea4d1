"""The viewer's panel: its controls, and what it says about the answers."""

import dataclasses
import html
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jsecon.app.records import Answer
from jsecon.app.viewer.state import COLOURINGS, ViewState, answer_colours
from jsecon.errors import InputError

SAME_CLICK_SECONDS = 0.5
"""s after a click on a frame's camera within which viser reports it for the scene too, by a ray rounded otherwise"""


class Panel:
    """The controls, and the events by which they act on the viewer.

    Args:
      viewer: The viewer.
      server: The viser server.
    """

    def __init__(self, viewer: Any, server: Any):
        self._viewer = viewer
        self._names = viewer.scene.field.names
        self._ray = np.zeros(3)
        self._clicked_at = 0.0
        gui = server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="medium")
        gui.set_panel_label(f"jsecon · {viewer.scene.name}")
        default = ViewState()
        with gui.add_form(None) as text_form:
            self._text = gui.add_text("find", "", hint="Text to find, then press enter")
        hint = "Keep what is selected when you find or click something else"
        self._add = gui.add_checkbox("add to selection", False, hint=hint)
        self._messages = gui.add_html("")
        self._notice = gui.add_html("", visible=False)
        hint = "Select every region that matches, not only the best one"
        all_of_class = gui.add_checkbox("all of its kind", default.all_of_class, hint=hint)
        hint = "Smallest share of a Gaussian that must lie in the matching regions"
        threshold = gui.add_slider("threshold", 0.0, 1.0, 0.01, default.threshold, hint=hint)
        colouring = gui.add_dropdown("colour", COLOURINGS, initial_value=default.colouring)
        self._controls = {"all_of_class": all_of_class, "threshold": threshold, "colouring": colouring}
        buttons = gui.add_button_group("selection", ("isolate", "hide", "show all", "export"))
        with gui.add_folder("frames", expand_by_default=False):
            hint = "Go to the camera of a frame"
            self._frame = gui.add_dropdown("frame", ("choose", *self._names), initial_value="choose", hint=hint)
            cameras = gui.add_checkbox("show cameras", False, hint="Click a camera to go there")

        text_form.on_submit(_in_order(self._find))
        for name, control in self._controls.items():
            control.on_update(_in_order(lambda event, name=name: self._set_control(name, event.target.value)))
        buttons.on_click(_in_order(self._press))
        self._frame.on_update(_in_order(self._choose_frame))
        cameras.on_update(_in_order(lambda event: viewer.layer.show_frames(event.target.value)))
        for frame, frustum in viewer.layer.frustums.items():
            frustum.on_click(_in_order(lambda event, frame=frame: self._click_frame(event, frame)))
        for modifier in (None, "shift"):
            server.scene.on_click(modifier=modifier)(_in_order(self._click_scene))

    def _find(self, event: Any) -> None:
        text, add = self._text.value, self._add.value
        self._viewer.then(lambda state: state.with_question(text, add=add))

    def _press(self, event: Any) -> None:
        if event.target.value == "export":
            self._viewer.export(event.client)
        else:
            steps = {"isolate": ViewState.isolate, "hide": ViewState.hide, "show all": ViewState.show_all}
            self._viewer.then(steps[event.target.value])

    def _set_control(self, name: str, value: Any) -> None:
        if getattr(self._viewer.state, name) != value:
            self._viewer.then(lambda state: dataclasses.replace(state, **{name: value}))

    def _choose_frame(self, event: Any) -> None:
        if event.client is not None and event.target.value in self._names:
            self._viewer.go_to_frame(event.client, self._names.index(event.target.value))

    def _click_frame(self, event: Any, frame: int) -> None:
        self._ray = np.asarray(event.ray_direction)
        self._clicked_at = time.monotonic()
        self._frame.value = self._names[frame]
        self._viewer.go_to_frame(event.client, frame)

    def _click_scene(self, event: Any) -> None:
        """Handles a click on the scene, unless it was one on a frame's camera."""
        recent = time.monotonic() - self._clicked_at <= SAME_CLICK_SECONDS
        if recent and np.allclose(event.ray_direction, self._ray, atol=0.02):
            return
        camera = event.client.camera
        focal = camera.image_height / 2 / np.tan(camera.fov / 2)
        add = self._add.value or event.modifier == "shift"
        self._viewer.click(event.ray_origin, event.ray_direction, focal, add=add)

    def show(self, state: ViewState, answers: Sequence[Answer | InputError]) -> None:
        """Sets the controls to a state, and describes the answer or the error of each of its questions."""
        texts = [question for question in state.questions if isinstance(question, str)]
        self._text.value = texts[-1] if texts else ""
        for name, control in self._controls.items():
            control.value = getattr(state, name)
        self._messages.content = "".join(map(_message, range(len(answers)), state.queries, answers))
        self.show_notice("")

    def show_notice(self, text: str | InputError) -> None:
        """Shows a notice above the answers; "" removes it."""
        self._notice.content = _box(_error(text) if isinstance(text, InputError) else html.escape(text))
        self._notice.visible = text != ""


def _in_order(act: Callable[[Any], Any]) -> Any:
    """Returns a callback that runs in the order of the page's events, as viser's coroutines do."""

    async def callback(event: Any) -> None:
        act(event)

    return callback


def _message(place: int, query: Any, answer: Answer | InputError) -> str:
    """An answer or an error behind a square in its colour."""
    colour = "#{:02x}{:02x}{:02x}".format(*answer_colours(place + 1)[place])
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
