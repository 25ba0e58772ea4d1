"""Fields, answers and captures in a notebook: a picture and a line of each, and `show`, which draws with matplotlib.

jsecon.types calls `to_html` and `to_png` through the table of contents when a notebook asks.
"""

import html
from typing import Any

import cv2
import jax
import numpy as np
from jaxtyping import UInt8

from jsecon.app import pictures, report
from jsecon.app.scene import Scene
from jsecon.errors import InputError
from jsecon.fit.resize import resize_frame, scale_cameras
from jsecon.read.captures.frames import evenly_spaced
from jsecon.types import Capture, LanguageField, Selection

LONG_SIDE = 240
"""longer side of a picture, px"""
CAPTURE_FRAMES = 4
"""number of frames in the picture of a capture"""
HISTOGRAM_HEIGHT = 80
"""height of the histogram of a selection, px"""


def to_html(value: Any) -> str:
    """Shows a value as HTML.

    Args:
      value: A LanguageField, a Selection or a Capture.

    Returns:
      Its picture and a line of words.
    """
    image, words = _picture(value)
    return f'<div><img alt="" src="{report.data_uri(image)}"><br>{html.escape(words)}</div>'


def to_png(value: Any) -> bytes:
    """Draws the picture of a value.

    Args:
      value: A LanguageField, a Selection or a Capture.

    Returns:
      The content of a PNG file.
    """
    return cv2.imencode(".png", cv2.cvtColor(_picture(value)[0], cv2.COLOR_RGB2BGR))[1].tobytes()


def show(scene: Scene | LanguageField, text: str, *, views: int = 3, **options: Any) -> Any:
    """Draws the frames that show best what a text selects, rendered without and with the selection, by matplotlib.

    Args:
      scene: The scene, or a field.
      text: The text.
      views: Number of frames.
      **options: Options of `Scene.ask`.

    Returns:
      Axes (2, views) of the figure.

    Raises:
      InputError: matplotlib is missing, or the embedder has no words for the text.
    """
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        remedy = "Run: pip install 'jsecon[figures]'"
        raise InputError("jsecon.show", "the package matplotlib is missing", remedy=remedy) from error
    scene = scene if isinstance(scene, Scene) else Scene(scene)
    answer = scene.ask(text, **options)
    frames = scene.best_frames(answer, views) or [0]
    size = (3.2 * len(frames), 4.8)
    figure, axes = plt.subplots(2, len(frames), squeeze=False, figsize=size, layout="constrained")
    for column, t in zip(axes.T, frames):
        images = (scene.render(t), scene.render(t, answer))
        for axis, image, title in zip(column, images, (scene.field.names[t], "")):
            axis.imshow(image)
            axis.set_title(title, fontsize="small")
            axis.set_axis_off()
    score = float(answer.selection.score)
    figure.suptitle(f"{text}: {len(answer.rows):,} Gaussians, score {score:.2f}")
    return axes


def _picture(value: LanguageField | Selection | Capture) -> tuple[UInt8[np.ndarray, "h w 3"], str]:
    """Returns the picture and the line of a value."""
    if isinstance(value, LanguageField):
        return _field_picture(value)
    return _capture_picture(value) if isinstance(value, Capture) else _selection_picture(value)


def _field_picture(field: LanguageField) -> tuple[np.ndarray, str]:
    """Renders the first view in the scene's colours and in those of the regions."""
    cameras = jax.tree.map(np.asarray, field.cameras)
    renderer = pictures.Renderer(field.gaussians, scale_cameras(cameras, _scale(cameras.width, cameras.height)))
    image = np.concatenate([renderer.photo(0), renderer.colours(0, pictures.region_colours(field))], axis=1)
    words = f"LanguageField of {field.gaussians.count:,} Gaussians, {field.regions.count} regions and "
    return image, f"{words}{len(field.names)} frames, texts by {field.embedder or 'no embedder'}"


def _capture_picture(capture: Capture) -> tuple[np.ndarray, str]:
    """Puts some of the frames side by side."""
    cameras = capture.cameras
    small = scale_cameras(cameras, _scale(cameras.width, cameras.height))
    chosen = evenly_spaced(len(capture.names), CAPTURE_FRAMES)
    image = np.concatenate([resize_frame(np.asarray(capture.frames[t]), small) for t in chosen], axis=1)
    words = f"Capture of {len(capture.names)} frames of {cameras.width}x{cameras.height}, "
    words += f"{int(np.asarray(capture.held_out).sum())} held out, {len(capture.points):,} sparse points"
    return image, words + ("" if capture.depths is None else ", with depth")


def _selection_picture(selection: Selection) -> tuple[np.ndarray, str]:
    """Draws a logarithmic histogram of the similarities; the selected Gaussians have their colour."""
    mask = np.asarray(selection.mask)
    similarity = np.nan_to_num(np.asarray(selection.similarity, np.float64))
    low = min(similarity.min(initial=0.0), 0.0)
    high = max(similarity.max(initial=0.0), 1e-6)
    image = np.full((HISTOGRAM_HEIGHT, LONG_SIDE, 3), 255, np.uint8)
    for rows, colour in ((np.ones_like(mask), (190, 190, 190)), (mask, pictures.SELECTED)):
        counts = np.histogram(similarity[rows], LONG_SIDE // 4, (low, high))[0]
        heights = (HISTOGRAM_HEIGHT - 4) * np.log1p(counts) / np.log1p(max(len(mask), 1))
        for n, height in enumerate(np.rint(heights).astype(int).tolist()):
            image[HISTOGRAM_HEIGHT - height :, 4 * n : 4 * n + 3] = colour
    words = f"Selection of {int(mask.sum()):,} of {len(mask):,} Gaussians, score {float(selection.score):.3f}, "
    return image, words + f"region {int(selection.region)}; similarity from {low:.2g} to {high:.2g}"


def _scale(width: int, height: int) -> float:
    """Returns the scale at which a frame fits a picture."""
    return min(LONG_SIDE / max(width, height), 1.0)
