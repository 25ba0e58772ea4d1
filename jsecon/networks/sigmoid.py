"""Scale and bias of a model trained with a sigmoid (SigLIP, arXiv 2303.15343): what makes of its cosine a probability.

    P(the text is true of the image) = sigmoid(scale * cosine + bias)

They belong to the loss: neither encoder's graph has them. In a folder for transformers.js they are in the graph of both
encoders, onnx/model.onnx, whatever its exporter called them, and are found from what it gives: its logits are a line
over its cosines. A folder of immich's layout has no such graph: there, or to spare the large graph, `logits.json` holds
them, `{"scale": ..., "bias": ...}`: the checkpoint's logit_bias, and its logit_scale's exponential.
"""

from pathlib import Path

import numpy as np

from jsecon.errors import InputError, describe_error
from jsecon.files import read_json
from jsecon.networks.onnx_graph import Graph, describe
from jsecon.numerics import is_finite_and_bounded
from jsecon.vision.protocols import Logits

LOGITS = "logits.json"
MOST_SCALE, MOST_BIAS = 1e4, 1e3
"""far above any trained one: published SigLIP models have scales about 110 and biases about -15"""
MOST_OFF = 0.02
"""of a logit from the line: more is not float rounding but a graph that was quantised, or another kind of model"""
REMEDY = (
    f'Write {LOGITS} into the folder, {{"scale": ..., "bias": ...}}: exp of the checkpoint\'s logit_scale, and its '
    "logit_bias."
)


def read_logits(path: Path) -> Logits:
    """Scale and bias from a logits.json. Raises InputError where it does not hold them."""
    expected = f'{{"scale": s, "bias": b}}, 0 < s <= {MOST_SCALE:g}, |b| <= {MOST_BIAS:g}'
    content = read_json(path, expected, REMEDY)
    try:
        found = Logits(float(content["scale"]), float(content["bias"]))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(path, f"it cannot be read ({describe_error(error)})", expected, REMEDY) from error
    return _checked(found, path, expected)


def fitted_logits(graph: Graph, images: np.ndarray, ids: np.ndarray) -> Logits:
    """Scale and bias by which the graph of both encoders makes logits of cosines, from images (B, 3, S, S), ready for
    it, and ids (Q, L). Raises InputError where the graph is of another kind, or its logits are no line."""
    what = "the graph of both of SigLIP's encoders"
    graph.require("input", "pixel_values", (None, 3, None, None), what)
    graph.require("input", "input_ids", (None, None), what)
    names = ("logits_per_image", "text_embeds", "image_embeds")
    for name in names:
        graph.require("output", name, (None, None), what)
    extra = [name for name in graph.inputs if name not in ("pixel_values", "input_ids")]
    if [name for name in extra if name != "attention_mask"]:
        raise InputError(graph.path, describe(graph.inputs.values()), f"pixel_values and input_ids, as {what}", REMEDY)
    found = graph.run({"pixel_values": images, "input_ids": ids} | {name: np.ones_like(ids) for name in extra}, names)
    logits, texts, seen = (np.asarray(found[name], np.float64) for name in names)
    lengths = np.linalg.norm(seen, axis=-1)[:, None] * np.linalg.norm(texts, axis=-1)
    expected = "logits on one line over cosines that differ"
    if (
        seen.shape[1:] != texts.shape[1:]
        or logits.shape != lengths.shape
        or not is_finite_and_bounded(logits, texts, seen)
    ):
        shapes = f"shapes {logits.shape}, {texts.shape}, {seen.shape}, or numbers that are not finite"
        raise InputError(graph.path, shapes, "finite (B, Q), (Q, E), (B, E)", REMEDY)
    if not (lengths > 0).all():
        raise InputError(graph.path, "an embedding of zeros", expected, REMEDY)
    cosines = (seen @ texts.T / lengths).ravel()
    # about the mean: the cosines lie close together, and the line is steep
    line = np.stack([cosines - cosines.mean(), np.ones_like(cosines)], 1)
    (scale, middle), *_ = np.linalg.lstsq(line, logits.ravel(), rcond=None)
    off = float(np.abs(line @ [scale, middle] - logits.ravel()).max())
    spread = float(np.ptp(cosines))
    if not (spread > 1e-4 and off <= MOST_OFF):
        told = f"logits that leave a line by {off:.3g}, over cosines that differ by {spread:.3g}"
        raise InputError(graph.path, told, expected, REMEDY)
    return _checked(Logits(float(scale), float(middle - scale * cosines.mean())), graph.path, expected)


def _checked(found: Logits, where: Path, expected: str) -> Logits:
    if not (is_finite_and_bounded(*found) and 0 < found.scale <= MOST_SCALE and abs(found.bias) <= MOST_BIAS):
        raise InputError(where, f"scale {found.scale:g}, bias {found.bias:g}", expected, REMEDY)
    return found
