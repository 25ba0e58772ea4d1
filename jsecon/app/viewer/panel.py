"""The viewer's panel: its controls, and messages and candidates as HTML."""

import html
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jsecon.app.pictures import fitted
from jsecon.app.records import Answer
from jsecon.app.report import data_uri
from jsecon.app.viewer.candidates import Candidate
from jsecon.app.viewer.view_state import COLOURINGS, MAX_SHELLS, ViewState, answer_colours, from_link
from jsecon.errors import InputError
from jsecon.field.membership import probability_inside
from jsecon.query.rules import MIN_COSINE, MIN_PRESENCE, MIN_RANK
from jsecon.types import LanguageField

THUMBNAIL = 88
"""longer side of a candidate's picture, px"""
SAME_CLICK_SECONDS = 0.5
"""s after a click on a frame's camera within which viser reports it for the scene too, by a ray rounded otherwise"""
SAME_CLICK_ANGLE = 0.02
"""largest difference of the directions of these two rays"""


class Panel:
    """The controls, and the events by which they act on the viewer.

    Args:
      viewer: The viewer.
      server: The viser server.
      field: The field.

    Attributes:
      messages: HTML about the answers.
      link: Text box of the view's link.
    """

    def __init__(self, viewer: Any, server: Any, field: LanguageField):
        self._viewer = viewer
        self._names = field.names
        self._ray = np.zeros(3)
        self._clicked_at = 0.0
        gui = server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="medium")
        gui.set_panel_label(f"jsecon · {viewer.name}")
        default = ViewState()
        with gui.add_form(None) as text_form:
            hint = "Text to find, then press enter. Separate several texts by semicolons; each has another colour."
            self._text = gui.add_text("find", "", hint=hint)
        self.messages = gui.add_html("")
        self._notice = gui.add_html("", visible=False)
        hint = "Select every region that matches, not only the best one"
        all_matches = gui.add_checkbox("all matches", default.all_matches, hint=hint)
        hint = "Smallest share of a Gaussian that must lie in the matching regions"
        threshold = gui.add_slider("threshold", 0.0, 1.0, 0.01, default.threshold, hint=hint)
        has_overlap = field.votes.overlap is not None
        hint = "0 selects the best region alone, 1 also all regions that overlap it and match better than most"
        hint = hint if has_overlap else "This field does not record which regions overlap"
        part_vs_whole = gui.add_slider(
            "part or whole", 0.0, 1.0, 0.05, default.part_vs_whole, disabled=not has_overlap, hint=hint
        )
        hint = "Shells of neighbouring Gaussians that each selection is grown by; below 0 it is shrunk"
        shells = gui.add_slider("grow or shrink", -MAX_SHELLS, MAX_SHELLS, 1, default.shells, hint=hint)
        colouring = gui.add_dropdown("colour", COLOURINGS, initial_value=default.colouring)
        self._controls = {"all_matches": all_matches, "threshold": threshold, "part_vs_whole": part_vs_whole}
        self._controls |= {"shells": shells, "colouring": colouring}
        selection_buttons = gui.add_button_group("selection", ("isolate", "hide", "export"))
        view_buttons = gui.add_button_group("", ("show all", "undo"))
        with gui.add_folder("other candidates", expand_by_default=True) as self._candidate_folder:
            self._candidates = gui.add_html("")
            self._select = gui.add_button_group("select", ("1",), hint="Select that region in place of the answer")
        self._candidate_folder.visible = False
        with gui.add_folder("frames", expand_by_default=False):
            hint = "Go to the camera of a frame"
            self._frame = gui.add_dropdown("frame", ("choose", *field.names), initial_value="choose", hint=hint)
            cameras = gui.add_checkbox("show cameras", False, hint="Click a camera to go there")
            self._picture = gui.add_image(np.zeros((2, 2, 3), np.uint8), visible=False)
        with gui.add_form(None) as link_form:
            hint = "Copy this line to keep the view. Paste a line and press enter to restore it."
            self.link = gui.add_text("link", "", hint=hint)

        text_form.on_submit(_in_order(lambda _: viewer.then(lambda s: s.with_texts(self._text.value))))
        link_form.on_submit(
            _in_order(lambda _: viewer.then(lambda _: from_link(self.link.value), update_controls=True))
        )
        for name, control in self._controls.items():
            control.on_update(_in_order(lambda event, name=name: self._set_control(name, event.target.value)))
        for buttons in (selection_buttons, view_buttons):
            buttons.on_click(_in_order(self._press))
        self._select.on_click(_in_order(lambda event: viewer.select(int(event.target.value) - 1)))
        self._frame.on_update(_in_order(self._choose_frame))
        cameras.on_update(_in_order(lambda event: viewer.scene.show_frames(event.target.value)))
        for frame, frustum in viewer.scene.frustums.items():
            frustum.on_click(_in_order(lambda event, frame=frame: self._click_frame(event, frame)))
        for modifier in (None, "shift"):
            server.scene.on_click(modifier=modifier)(_in_order(self._click_scene))

        @server.on_client_connect
        async def _(client: Any) -> None:
            client.camera.on_update(_in_order(viewer.set_camera))

    def _press(self, event: Any) -> None:
        """Handles a button."""
        steps = {"isolate": ViewState.isolate, "hide": ViewState.hide, "show all": ViewState.show_all}
        button = event.target.value
        if button in steps:
            self._viewer.then(steps[button], update_controls=True)
        elif button == "undo":
            self._viewer.undo()
        else:
            self._viewer.export(event.client)

    def _set_control(self, name: str, value: Any) -> None:
        """Handles a control that a user moved."""
        if getattr(self._viewer.history.state, name) != value:
            self._viewer.then(lambda state: state.with_controls(**{name: value}))

    def _choose_frame(self, event: Any) -> None:
        """Handles a frame of the list."""
        if event.client is not None and event.target.value in self._names:
            self._viewer.go_to_frame(event.client, self._names.index(event.target.value))

    def _click_frame(self, event: Any, frame: int) -> None:
        """Handles a click on a frame's camera."""
        self._ray = np.asarray(event.ray_direction)
        self._clicked_at = time.monotonic()
        self._viewer.go_to_frame(event.client, frame)

    def _click_scene(self, event: Any) -> None:
        """Handles a click on the scene, unless it was one on a frame's camera."""
        recent = time.monotonic() - self._clicked_at <= SAME_CLICK_SECONDS
        if recent and np.allclose(event.ray_direction, self._ray, atol=SAME_CLICK_ANGLE):
            return
        camera = event.client.camera
        focal = camera.image_height / 2 / np.tan(camera.fov / 2)
        self._viewer.click(event.ray_origin, event.ray_direction, focal, add=event.modifier == "shift")

    def show_state(self, state: ViewState) -> None:
        """Sets the controls.

        Args:
          state: State that they show.
        """
        self._text.value = state.text_line
        for name, control in self._controls.items():
            control.value = getattr(state, name)

    def show_notice(self, text: str | InputError) -> None:
        """Shows a notice above the answers, or removes it.

        Args:
          text: Plain text, or an error; "" removes the notice.
        """
        self._notice.content = _box(_error(text) if isinstance(text, InputError) else html.escape(text))
        self._notice.visible = text != ""

    def show_candidates(self, content: str, count: int) -> None:
        """Shows candidates, with a button for each.

        Args:
          content: HTML (`candidate_grid`).
          count: Number of candidates; 0 hides the folder.
        """
        self._candidates.content = content
        self._candidate_folder.visible = count > 0
        if count:
            self._select.options = tuple(str(k + 1) for k in range(count))

    def show_frame(self, frame: int, picture: np.ndarray) -> None:
        """Shows a frame in the panel.

        Args:
          frame: Index of the frame.
          picture: (H, W, 3) uint8 RGB.
        """
        self._frame.value = self._names[frame]
        self._picture.image = picture
        self._picture.visible = True


def _in_order(act: Callable[[Any], Any]) -> Any:
    """Returns a callback that runs in the order of the page's events, as viser's coroutines do."""

    async def callback(event: Any) -> None:
        act(event)

    return callback


def _error(error: InputError) -> str:
    """Returns an error as HTML, whose remedy a click shows."""
    return f"<details><summary>{html.escape(error.sentence)}</summary>{html.escape(error.remedy)}</details>"


def _box(text: str) -> str:
    """Returns a box around HTML."""
    return f'<div style="margin:0 .8em .5em;padding:.4em .6em;border-left:3px solid #fa0;font-size:.8em">{text}</div>'


def _colour(place: int) -> str:
    """Returns the colour of an answer for CSS."""
    return "#{:02x}{:02x}{:02x}".format(*answer_colours(place + 1)[place])


def _swatch(place: int) -> str:
    """Returns a square in the colour of an answer."""
    shape = "display:inline-block;width:.8em;height:.8em;border-radius:2px"
    return f'<span style="{shape};background:{_colour(place)}"></span>'


def messages(field: LanguageField, state: ViewState, answers: Sequence[Answer | InputError]) -> str:
    """Describes answers.

    Args:
      field: The field.
      state: The state.
      answers: The answer or the error of each of its queries.

    Returns:
      HTML: of each query how many Gaussians with which mean membership, or why no Gaussian is selected.
    """
    lines = []
    for place, (query, answer) in enumerate(zip(state.queries, answers, strict=True)):
        name = query if isinstance(query, str) else f"region {query}"
        head = f"{_swatch(place)} <b>{html.escape(name)}</b>"
        if isinstance(answer, InputError):
            lines.append(_box(f"{head}: {_error(answer)}"))
            continue
        if answer.by == "relation":
            lines.append(_box(f"{head}: {html.escape(answer.describe())}"))
            continue
        score = float(answer.selection.score)
        count = int(answer.mask.sum())
        if int(answer.selection.region) < 0 and not np.asarray(answer.selection.mask).any():
            lines.append(_box(f"{head}: no match: {_refusal(answer)}. The nearest candidates are below."))
        elif not count:
            lines.append(_box(f"{head}: no Gaussian reaches the threshold {state.threshold:.2f}."))
        else:
            parts = [f"{count} Gaussians"]
            if isinstance(query, str):
                parts.append(f"score {score:.2f}")
            if "regions" in answer.skipped:
                parts.append("parts in place of a region")
            else:
                inside = probability_inside(answer.selection.similarity, field.votes, answer.mask).mean()
                parts.append(f"membership {100 * inside:.0f} %")
            lines.append(f'<div style="margin:0 .8em .4em;font-size:.85em">{head}: {", ".join(parts)}</div>')
    return "".join(lines)


def _refusal(answer: Answer) -> str:
    """Returns the measure by which a query has no match, and its threshold."""
    if answer.rank_words:
        return f"{answer.rank_words}, and {100 * MIN_RANK:.0f} % are required"
    if answer.presence is not None:
        return f"the probability that it is there is {answer.presence:.2g}, and {MIN_PRESENCE} is required"
    return f"the best score is {float(answer.selection.score):.2f}, and {MIN_COSINE} is required"


def candidate_grid(
    answers: Sequence[Answer | InputError], pictured: Sequence[tuple[int, Candidate, np.ndarray]]
) -> str:
    """Lays out candidates.

    Args:
      answers: The answers.
      pictured: Index of an answer, one of its candidates, and that candidate's picture.

    Returns:
      HTML. A region that is selected has a frame in the colour of its answer.
    """
    cells = []
    for number, (place, candidate, picture) in enumerate(pictured):
        data = data_uri(fitted(picture, THUMBNAIL))
        answer = answers[place]
        selected = not isinstance(answer, InputError) and int(answer.selection.region) == candidate.region
        edge = _colour(place) if selected else "transparent"
        cells.append(
            f'<figure style="margin:0;text-align:center;font-size:.75em"><img src="{data}" '
            f'style="border:3px solid {edge};border-radius:4px;max-width:100%"><figcaption>{_swatch(place)} '
            f"{number + 1}: {candidate.score:.2f}{', selected' if selected else ''}</figcaption></figure>"
        )
    grid = "display:grid;grid-template-columns:repeat(3,1fr);gap:.4em;margin:.4em .6em;align-items:end"
    return f'<div style="{grid}">{"".join(cells)}</div>'
