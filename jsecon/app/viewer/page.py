"""The page of a field: its Gaussians, regions, frames and the answers to texts in one HTML text. Pure functions.

As a file it needs no server and no outside resource. Where it is served (`jsecon.app.server`), it asks for the answers.
A Gaussian takes 19 bytes before base64: its centre in 16 bits along each side of the scene's box, quaternion, sizes and
colour (spherical harmonics of degree 0) in 8 bits a number, its region in 16.
"""

import base64
import html
import json
from collections.abc import Mapping
from importlib import resources
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jsecon.app.catalogue import main_regions
from jsecon.app.records import Answer
from jsecon.errors import InputError
from jsecon.field.tree import parts_above, smallest_nodes
from jsecon.numerics import sigmoid
from jsecon.splat.sh import C0
from jsecon.types import Gaussians, LanguageField
from jsecon.views.frame import field_up

NO_REGION = 65535
"""code of a Gaussian without a region"""


def field_page(field: LanguageField, texts: Mapping[str, Answer | None], *, title: str, served: bool = False) -> str:
    """Makes the page of a field, which highlights some texts when it opens.

    A served page asks for the answers that are None.
    """
    drawn, low, high = drawn_gaussians(field)
    splats, size_range = _pack(field.gaussians, smallest_nodes(field, main_regions(field)), drawn, low, high)
    cameras = field.cameras
    scene = {
        "served": served,
        "gaussians": field.gaussians.count,
        "count": int(drawn.sum()),
        "regions": field.regions.count,
        "tree": [] if field.tree is None else parts_above(field).tolist(),
        "low": low.tolist(),
        "span": (high - low).tolist(),
        "texts": {text: answer and answer_record(answer, drawn) for text, answer in texts.items()},
        "history": ["what moved", "what is new"] if served and field.history else [],
        "up": list(field_up(field).axis),
        "unit": "units" if field.metres_per_unit is None else "m",
        "world": np.asarray(field.source_from_scene, np.float64)[:3].tolist(),
        "unit_length": field.metres_per_unit or 1.0,
        "frames": list(field.names),
        "poses": np.asarray(cameras.world_to_camera, np.float64)[:, :3].tolist(),
        "focals": np.asarray(cameras.fx, np.float64).tolist(),
        "size": [cameras.width, cameras.height],
        **size_range,
    }
    template = resources.files("jsecon.app.viewer").joinpath("page.html").read_text(encoding="utf-8")
    filled = template.replace("__TITLE__", html.escape(title))
    filled = filled.replace("__SCENE__", json.dumps(scene).replace("</", "<\\/"))
    return filled.replace("__SPLATS__", base64.b64encode(splats).decode())


def answer_record(result: Answer | InputError, drawn: Bool[np.ndarray, " n"]) -> dict[str, Any]:
    """An answer as the page shows it: its words, and a bit for each of the drawn Gaussians; or an error's words."""
    if isinstance(result, InputError):
        return {"words": result.sentence, "remedy": result.remedy or "Ask in other words.", "mask": ""}
    mask = np.packbits(np.asarray(result.mask)[drawn], bitorder="little").tobytes()
    return {"words": result.describe(), "mask": base64.b64encode(mask).decode()}


def drawn_gaussians(
    field: LanguageField,
) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Finds the Gaussians that the page draws, and the two corners of their box, in the field's world."""
    means = np.asarray(field.gaussians.means, np.float64)
    log_sizes = np.asarray(field.gaussians.log_scales, np.float64).max(1)
    opacity = np.asarray(sigmoid(np.asarray(field.gaussians.opacity_logits)))
    drawn = np.isfinite(means).all(1) & np.isfinite(log_sizes) & (opacity * 255 >= 4)
    if not drawn.any():
        raise InputError("jsecon view", "the field has no visible Gaussian", remedy="Make it again: jsecon run.")
    low, high = np.quantile(means[drawn], (0.002, 0.998), axis=0)  # else strays take the box's 16 bits
    margin = np.maximum(0.05 * (high - low), np.exp(np.median(log_sizes[drawn])))  # coincident ones have a box too
    low, high = low - margin, high + margin
    # Larger ones veil the page.
    largest = max(0.25 * np.linalg.norm(high - low), np.exp(log_sizes[drawn].min()))
    drawn &= ((means >= low) & (means <= high)).all(1) & (log_sizes <= np.log(largest))
    return drawn, low, high


def _pack(
    gaussians: Gaussians, regions: np.ndarray, drawn: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[bytes, dict[str, float]]:
    """Returns the columns of the drawn Gaussians as the page reads them, and the range of their logarithmic sizes."""
    places = (np.asarray(gaussians.means, np.float64)[drawn] - low) / np.maximum(high - low, 1e-12)
    sizes = np.asarray(gaussians.log_scales, np.float64)[drawn]
    finite = sizes[np.isfinite(sizes)]  # a flat Gaussian, of size 0, gets the smallest code
    size_low, size_high = (float(np.quantile(finite, q)) for q in (0.001, 1.0))
    size_span = max(size_high - size_low, 1e-6)
    quaternions = np.asarray(gaussians.quaternions, np.float64)[drawn]
    quaternions = quaternions / np.maximum(np.linalg.norm(quaternions, axis=1, keepdims=True), 1e-12)
    colours = 0.5 + C0 * np.asarray(gaussians.sh, np.float64)[drawn, 0]
    opacity = np.asarray(sigmoid(np.asarray(gaussians.opacity_logits)[drawn]))
    columns = (
        np.rint(65535 * np.clip(places, 0, 1)).astype("<u2"),
        np.where(regions < 0, NO_REGION, regions)[drawn].astype("<u2"),
        np.rint(127 * quaternions).astype(np.int8),
        np.rint(255 * np.clip((sizes - size_low) / size_span, 0, 1)).astype(np.uint8),
        np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8),
        np.rint(255 * opacity).astype(np.uint8),
    )
    return b"".join(column.tobytes() for column in columns), {"size_low": size_low, "size_span": size_span}
