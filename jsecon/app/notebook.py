"""Fields and captures in a notebook: a picture and a line of each.

jsecon.types calls `to_html` through the table of contents when a notebook asks.
"""

import jax
import numpy as np
from jaxtyping import UInt8

from jsecon.app import pictures, report
from jsecon.fit.resize import resize_frame, scale_cameras
from jsecon.read.captures.frames import evenly_spaced
from jsecon.types import Capture, LanguageField


def to_html(value: LanguageField | Capture) -> str:
    """Shows a value as HTML.

    Args:
      value: A LanguageField or a Capture.

    Returns:
      Its picture and a line of words.
    """
    image, words = _picture(value)
    return report.figure(image, words)


def _picture(value: LanguageField | Capture) -> tuple[UInt8[np.ndarray, "h w 3"], str]:
    """Returns the picture and the line of a value."""
    cameras = jax.tree.map(np.asarray, value.cameras)
    small = scale_cameras(cameras, min(240 / max(cameras.width, cameras.height), 1.0))
    if isinstance(value, Capture):
        chosen = evenly_spaced(len(value.names), 4)
        image = np.concatenate([resize_frame(np.asarray(value.frames[t]), small) for t in chosen], axis=1)
        words = f"Capture of {len(value.names)} frames of {cameras.width}x{cameras.height}, "
        words += f"{int(np.asarray(value.held_out).sum())} held out, {len(value.points):,} sparse points"
        return image, words + ("" if value.depths is None else ", with depth")
    views = [pictures.render_picture(value.gaussians, small[0], rgb) for rgb in (None, pictures.region_colours(value))]
    image = np.concatenate(views, axis=1)
    words = f"LanguageField of {value.gaussians.count:,} Gaussians, {value.regions.count} regions and "
    return image, f"{words}{len(value.names)} frames, texts by {value.embedder or 'no embedder'}"
