"""A field as one HTML page without server or outside resource: its Gaussians, regions and the answers to texts.

A Gaussian takes 19 bytes before base64: its centre in 16 bits along each side of the scene's box, quaternion, sizes and
colour (spherical harmonics of degree 0) in 8 bits a number, its region in 16.
"""

import base64
import html
import json
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import numpy as np

from jsecon.app import verbs
from jsecon.app.catalogue import main_regions
from jsecon.app.records import Answer
from jsecon.app.scene import open_scene
from jsecon.app.viewer.layer import first_view
from jsecon.errors import InputError
from jsecon.files import write_text
from jsecon.numerics import sigmoid
from jsecon.pipeline.options import require_writable
from jsecon.pipeline.progress import Console
from jsecon.splat.sh import C0
from jsecon.types import Gaussians, LanguageField

NO_REGION = 65535
"""code of a Gaussian without a region"""


def export_page(verb: verbs.View, file: Path, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon view --export`; the result has the texts that were answered."""
    if file.suffix != ".html":
        raise InputError("--export", f"{file} does not end in .html", remedy="For example: --export page.html")
    require_writable(file.parent)
    scene = open_scene(verb.field, embedder=verb.embedder, console=console)
    with console.progress("page"):
        if verb.texts:
            _ = scene.embedder  # without it one error stands for all texts
        results = scene.ask_all(verb.texts)
        answers = [answer for answer in results if not isinstance(answer, InputError)]
        errors = [error for error in results if isinstance(error, InputError)]
        write_text(file, page(scene.field, answers, title=scene.name))
    for answer in answers:
        console.print_line(str(answer))
    count, size = scene.field.gaussians.count, file.stat().st_size
    console.print_line(f"{count} Gaussians, texts answered: {len(answers)}, {size / 2**20:.1f} MiB  {file}")
    texts = [str(answer.query) for answer in answers]
    return {"written": {"page": file}, "gaussians": count, "answers": texts, "bytes": size, "errors": errors}


def page(field: LanguageField, answers: Sequence[Answer], *, title: str) -> str:
    """Makes the page of a field with the answers to some texts."""
    gaussians = field.gaussians
    means = np.asarray(gaussians.means, np.float64)
    log_sizes = np.asarray(gaussians.log_scales, np.float64).max(1)
    opacity = np.asarray(sigmoid(np.asarray(gaussians.opacity_logits)))
    drawn = np.isfinite(means).all(1) & np.isfinite(log_sizes) & (opacity * 255 >= 4)
    if not drawn.any():
        raise InputError("--export", "the field has no visible Gaussian", remedy="Make it again: jsecon run.")
    low, high = np.quantile(means[drawn], (0.002, 0.998), axis=0)  # else strays take the box's 16 bits
    margin = np.maximum(0.05 * (high - low), np.exp(np.median(log_sizes[drawn])))  # coincident ones have a box too
    low, high = low - margin, high + margin
    # Larger ones veil the page.
    largest = max(0.25 * np.linalg.norm(high - low), np.exp(log_sizes[drawn].min()))
    drawn &= ((means >= low) & (means <= high)).all(1) & (log_sizes <= np.log(largest))
    splats, size_range = _pack(gaussians, main_regions(field), opacity, drawn, low, high)
    texts = []
    for answer in answers:
        mask = np.packbits(np.asarray(answer.mask)[drawn], bitorder="little").tobytes()
        score = float(answer.selection.score)
        packed = base64.b64encode(mask).decode()
        texts.append({"text": str(answer.query), "state": answer.state, "score": score, "mask": packed})
    scene = {
        "count": int(drawn.sum()),
        "regions": field.regions.count,
        "low": low.tolist(),
        "span": (high - low).tolist(),
        "texts": texts,
        **{name: place.tolist() for name, place in zip(("eye", "target", "up"), first_view(field))},
        "focal": float(np.asarray(field.cameras.fx)[0]),
        "size": [field.cameras.width, field.cameras.height],
        **size_range,
    }
    template = resources.files("jsecon.app.viewer").joinpath("static_page.html").read_text(encoding="utf-8")
    filled = template.replace("__TITLE__", html.escape(title))
    filled = filled.replace("__SCENE__", json.dumps(scene).replace("</", "<\\/"))
    return filled.replace("__SPLATS__", base64.b64encode(splats).decode())


def _pack(
    gaussians: Gaussians, regions: np.ndarray, opacity: np.ndarray, drawn: np.ndarray, low: np.ndarray, high: np.ndarray
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
    columns = (
        np.rint(65535 * np.clip(places, 0, 1)).astype("<u2"),
        np.where(regions < 0, NO_REGION, regions)[drawn].astype("<u2"),
        np.rint(127 * quaternions).astype(np.int8),
        np.rint(255 * np.clip((sizes - size_low) / size_span, 0, 1)).astype(np.uint8),
        np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8),
        np.rint(255 * opacity[drawn]).astype(np.uint8),
    )
    return b"".join(column.tobytes() for column in columns), {"size_low": size_low, "size_span": size_span}
