"""What a notebook shows of a field, an answer and a capture, a picture and a line; and `show`, for who draws with
matplotlib. jsecon.types calls it through the table of contents, when a notebook asks."""

import html
from typing import Any

import cv2
import jax
import numpy as np
from jaxtyping import UInt8

from jsecon.app import pictures, report
from jsecon.app.ask import ask_text
from jsecon.app.outputs import answer_masks
from jsecon.errors import InputError
from jsecon.fit.resize import resize_frame, scale_cameras
from jsecon.pipeline import networks
from jsecon.types import Capture, LanguageField, Selection

LONG_SIDE, SHOWN = 240, 4
"""px of each picture; frames of a capture"""


def to_html(thing: Any) -> str:
    """A LanguageField, a Selection or a Capture as a picture and a line, HTML."""
    image, words = _shown(thing)
    return f'<div><img alt="" src="{report.data_uri(image)}"><br>{html.escape(words)}</div>'


def to_png(thing: Any) -> bytes:
    """The picture alone, as a PNG file."""
    return cv2.imencode(".png", cv2.cvtColor(_shown(thing)[0], cv2.COLOR_RGB2BGR))[1].tobytes()


def _shown(thing: LanguageField | Selection | Capture) -> tuple[UInt8[np.ndarray, "h w 3"], str]:
    if isinstance(thing, LanguageField):
        return _of_field(thing)
    return _of_capture(thing) if isinstance(thing, Capture) else _of_selection(thing)


def _of_field(field: LanguageField) -> tuple[np.ndarray, str]:
    """The first view, in the scene's colours and in those of the codes."""
    cameras = jax.tree.map(np.asarray, field.cameras)
    renderer = pictures.Renderer(field.gaussians, scale_cameras(cameras, _scale(cameras.width, cameras.height)))
    image = np.concatenate([renderer.photo(0), renderer.colours(0, pictures.code_colours(field))], axis=1)
    words = f"LanguageField of {field.gaussians.count:,} Gaussians, {field.regions.count} regions and "
    return image, f"{words}{len(field.names)} frames, texts by {field.embedder or 'no embedder'}"


def _of_capture(capture: Capture) -> tuple[np.ndarray, str]:
    """SHOWN of its frames."""
    cameras = capture.cameras
    small = scale_cameras(cameras, _scale(cameras.width, cameras.height))
    picked = np.unique(np.linspace(0, len(capture.names) - 1, SHOWN).round().astype(int))
    image = np.concatenate([resize_frame(np.asarray(capture.frames[t]), small) for t in picked], axis=1)
    words = f"Capture of {len(capture.names)} frames of {cameras.width}x{cameras.height}, "
    words += f"{int(np.asarray(capture.held_out).sum())} held out, {len(capture.points):,} sparse points"
    return image, words + ("" if capture.depths is None else ", with depth")


def _of_selection(selection: Selection) -> tuple[np.ndarray, str]:
    """How many Gaussians have which similarity, on a logarithmic scale; those selected in their colour."""
    mask, similarity = np.asarray(selection.mask), np.nan_to_num(np.asarray(selection.similarity, np.float64))
    low, high = min(similarity.min(initial=0.0), 0.0), max(similarity.max(initial=0.0), 1e-6)
    image = np.full((80, LONG_SIDE, 3), 255, np.uint8)
    for kind, colour in ((np.ones_like(mask), (190, 190, 190)), (mask, pictures.SELECTED)):
        counts = np.histogram(similarity[kind], LONG_SIDE // 4, (low, high))[0]
        heights = np.rint(76 * np.log1p(counts) / np.log1p(max(len(mask), 1))).astype(int)
        for n, height in enumerate(heights.tolist()):
            image[80 - height :, 4 * n : 4 * n + 3] = colour
    words = f"Selection of {int(mask.sum()):,} of {len(mask):,} Gaussians, score {float(selection.score):.3f}, "
    return image, words + f"region {int(selection.region)}; similarity from {low:.2g} to {high:.2g}"


def _scale(width: int, height: int) -> float:
    return min(LONG_SIDE / max(width, height), 1.0)


def show(field: LanguageField, text: str, *, embedder: Any = None, views: int = 3, **how: Any) -> Any:
    """The `views` frames that show best what a text selects, rendered, and with the selection: a figure of matplotlib,
    whose axes (2, views) are returned.

    `embedder`: the field's own, opened where it is not given; `how` as for `jsecon.app.ask.ask_text`. Raises
    InputError where matplotlib is missing, and where the embedder has no words for the text.
    """
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        remedy = "Run: pip install 'jsecon[figures]'"
        raise InputError("jsecon.show", "the package matplotlib is missing", remedy=remedy) from error
    answer = ask_text(field, embedder or networks.field_embedder(field), text, **how)
    masks = answer_masks(field, answer, views) or {0: np.zeros((field.cameras.height, field.cameras.width), bool)}
    renderer = pictures.Renderer(field.gaussians, field.cameras)
    size = 3.2 * len(masks), 4.8
    figure, axes = plt.subplots(2, len(masks), squeeze=False, figsize=size, layout="constrained")
    for column, (t, mask) in zip(axes.T, masks.items()):
        photo = renderer.photo(t)
        for axis, image, title in zip(column, (photo, pictures.selection_overlay(photo, mask)), (field.names[t], "")):
            axis.imshow(image)
            axis.set_title(title, fontsize="small")
            axis.set_axis_off()
    score = float(answer.selection.score)
    figure.suptitle(f"{text}: {int(answer.mask.sum()):,} Gaussians, score {score:.2f}")
    return axes
