"""SAM folders for tests: graphs of the true signatures that segment by colour. A point's masks are what is connected or
not, but of about the colour at the point: three widths of "about", from the narrowest to the widest."""

import json
from pathlib import Path

import numpy as np
from onnx_files import Sketch

CHANNELS = 8
WIDTHS = (0.02, 0.01, 0.02, 0.08)
"""squared distance of normalised colour: of the single mask, then of s, m, l"""
SHARPNESS = 400.0
IOUS = (0.99, 0.90, 0.92, 0.94)
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""of RGB in 0..1, as SAM was trained with"""


def write_encoder(path: Path, side: int, outputs: tuple[str, ...] = ("image_embeddings",)) -> Path:
    """Mean colours of 16 x 16 px cells, (1, CHANNELS, S/16, S/16)."""
    grid = side // 16
    g = Sketch()
    cells = g("AveragePool", "pixel_values", kernel_shape=[16, 16], strides=[16, 16])
    g("Pad", cells, [0, 0, 0, 0, 0, CHANNELS - 3, 0, 0], into=outputs[0])
    for name in outputs[1:]:
        g("Identity", outputs[0], into=name)
    declared = {name: ("float32", [1, CHANNELS, grid, grid]) for name in outputs}
    return g.save(path, {"pixel_values": ("float32", [1, 3, side, side])}, declared)


def write_decoder(path: Path, side: int, kind: str, batch: int | str, *, masks: int = 3) -> Path:
    """Kinds: "sam", and "sam2" with the frame at three scales and boxes."""
    grid, low, boxed = side // 16, side // 4, kind == "sam2"
    embedding = "image_embeddings.2" if boxed else "image_embeddings"
    coords, labels, scores, logits = "input_points", "input_labels", "iou_scores", "pred_masks"
    g = Sketch()
    point = g("Squeeze", g("Slice", g("Squeeze", coords, [0]), [0], [1], [1]), [1])  # (B, 2)
    cell = g("Cast", g("Clip", g("Div", point, 16.0), 0.0, grid - 1.0), to=7)
    x, y = (g("Gather", cell, [axis], axis=1) for axis in (0, 1))
    at = g("Squeeze", g("Add", g("Mul", y, grid), x), [1])
    colours = g("Reshape", embedding, [CHANNELS, grid * grid])
    own = g("Transpose", g("Gather", colours, at, axis=1), perm=[1, 0])  # (B, C)
    difference = g("Sub", g("Unsqueeze", colours, [0]), g("Unsqueeze", own, [2]))  # (B, C, G^2)
    distance = g("ReduceSum", g("Mul", difference, difference), [1], keepdims=0)
    within = g("Sub", np.reshape(WIDTHS[-masks:], (1, -1, 1, 1)), g("Reshape", distance, [-1, 1, grid, grid]))
    maps = g("Resize", g("Mul", within, SHARPNESS), "", [1.0, 1.0, 4.0, 4.0], mode="linear")
    g("Unsqueeze", maps, [0], into=logits)
    kinds = g("Cast", g("Squeeze", labels, [0]), to=1)
    last = g("Slice", kinds, [-1], [np.iinfo(np.int64).max], [1])
    g("Unsqueeze", g("Mul", last, np.asarray(IOUS[-masks:])[None]), [0], into=scores)
    inputs = {
        embedding: ("float32", [1, CHANNELS, grid, grid]),
        coords: ("float32", [1, batch, "points", 2]),
        labels: ("int64", [1, batch, "points"]),
    }
    outputs = {logits: ("float32", [1, batch, masks, low, low]), scores: ("float32", [1, batch, masks])}
    if boxed:  # as the published graphs do it: no boxes, and so one prompt a call
        inputs |= {f"image_embeddings.{n}": ("float32", [1, CHANNELS, grid, grid]) for n in (0, 1)}
        inputs["input_boxes"] = ("float32", ["images", "boxes", 4])
        outputs["object_score_logits"] = ("float32", [1, batch, 1])
        g("ReduceMax", scores, axes=[2], into="object_score_logits")
    else:
        inputs["image_positional_embeddings"] = ("float32", [1, CHANNELS, grid, grid])
    return g.save(path, inputs, outputs)


def write_sam(folder: Path, kind: str = "sam", *, side: int = 256, batch: int | str = "batch") -> Path:
    """A SAM folder of one of the kinds, with the file names of its publishers."""
    encoder, decoder = folder / "onnx" / "vision_encoder.onnx", folder / "onnx" / "prompt_encoder_mask_decoder.onnx"
    if kind == "sam2":
        write_encoder(encoder, side, tuple(f"image_embeddings.{n}" for n in range(3)))
        size = {"height": side, "width": side}
    else:
        write_encoder(encoder, side, ("image_embeddings", "image_positional_embeddings"))
        size = {"longest_edge": side}
    content = {"image_mean": MEAN, "image_std": STD, "rescale_factor": 1 / 255}
    content |= {"do_normalize": True, "do_rescale": True, "size": size}
    (folder / "preprocessor_config.json").write_text(json.dumps(content))
    write_decoder(decoder, side, kind, batch)
    return folder
