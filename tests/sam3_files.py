"""SAM 3 folders for tests: the three graphs of vietanhdev/samexporter's export in their names, types and shapes, and
those of the older decoders. They find the things that are of the colour that a phrase names."""

from pathlib import Path

import numpy as np
from clip_files import COLOURS, load_tokens, vocabulary, write_tokenizer
from onnx_files import Sketch

LENGTH, SIDE, CHANNELS = 32, 112, 8
TRUE = {"side": 1008, "channels": 256, "embedding": 1024}
"""sizes of the published graphs"""
WIDTH, SHARPNESS = 0.3, 40.0
"""squared distance of colours in -1..1 within which a pixel is of a phrase's colour"""
LOGITS, PRESENCE = np.float32([2.0, 3.0, 1.5, 0.5, -3.0]), 4.0
"""of five queries: the left half, the right half, the left again without its upper rows, all and all"""
KINDS = ("samexporter", "older samexporter", "sam3-onnx")


def places(rows: int) -> np.ndarray:
    """(5, rows, rows) bool: where each query looks."""
    left = np.arange(rows) < rows // 2
    low = np.arange(rows) >= rows // 16
    one = np.ones((rows, rows), bool)
    return np.stack([one & left, one & ~left, low[:, None] & left, one, one])


def colour_of(phrase: str) -> np.ndarray:
    """The colour that the graphs look for, in -1..1: the one named, or one that nothing has."""
    named = [np.float32(COLOURS[word]) * 2 - 1 for word in phrase.split() if word in COLOURS]
    return named[0] if named else np.full(3, 9.0)


def _write_image(path: Path, side: int, channels: int, kind: str) -> Path:
    """Mean colours in -1..1 of cells of 7 px, twice as fine and twice as coarse; the place's maps are zeros."""
    rows = side // 7
    g = Sketch()
    floats = g("Cast", "image", to=1) if kind == "uint8" else "image"
    square = g("Unsqueeze", g("Sub", g("Mul", floats, 2 / 255), 1.0), [0])
    cells = g("AveragePool", square, kernel_shape=[7, 7], strides=[7, 7])
    g("Pad", cells, [0, 0, 0, 0, 0, channels - 3, 0, 0], into="backbone_fpn_1")
    g("Resize", "backbone_fpn_1", "", [1.0, 1.0, 2.0, 2.0], mode="nearest", into="backbone_fpn_0")
    g("AveragePool", "backbone_fpn_1", kernel_shape=[2, 2], strides=[2, 2], into="backbone_fpn_2")
    for n in range(3):
        g("Mul", f"backbone_fpn_{n}", 0.0, into=f"vision_pos_enc_{n}")
    sizes = (2 * rows, rows, rows // 2)
    declared = {
        f"{name}_{n}": ("float32", [1, channels, size, size])
        for name in ("vision_pos_enc", "backbone_fpn")
        for n, size in enumerate(sizes)
    }
    return g.save(path, {"image": (kind, [3, side, side])}, declared)


def _write_language(path: Path, channels: int, embedding: int) -> Path:
    """Of each token its colour in -1..1, then 1 for a colour; the mask is true where the phrase is filled up."""
    table = np.zeros((len(vocabulary()), embedding), np.float32)
    table[0, :4] = 5  # what fills a phrase up: not to be read
    for word, colour in COLOURS.items():
        table[load_tokens([word])[0], :4] = *(2 * part - 1 for part in colour), 1
    g = Sketch()
    g("Equal", "tokens", 0, into="text_attention_mask")
    g("Transpose", g("Gather", table, "tokens"), perm=[1, 0, 2], into="text_embeds")
    g("Slice", "text_embeds", [0], [channels], [2], into="text_memory")
    declared = {
        "text_attention_mask": ("bool", [1, LENGTH]),
        "text_memory": ("float32", [LENGTH, 1, channels]),
        "text_embeds": ("float32", [LENGTH, 1, embedding]),
    }
    return g.save(path, {"tokens": ("int64", [1, LENGTH])}, declared)


def _write_decoder(path: Path, kind: str, side: int, channels: int, embedding: int, boxes: int) -> Path:
    """Nothing is there where a box is used."""
    rows = side // 7
    raw, queries = kind == "samexporter", len(LOGITS)
    g = Sketch()
    weights = g("Reshape", g("Cast", g("Not", "language_mask"), to=1), [-1, 1, 1])
    phrase = g("ReduceSum", g("Mul", "language_features", weights), [0], keepdims=1)  # (1, 1, C)
    away = g("Mul", g("Sub", g("Slice", phrase, [3], [4], [2]), 1.0), 9.0)  # if not exactly one colour is named
    colour = g("Reshape", g("Sub", g("Slice", phrase, [0], [3], [2]), away), [1, 3, 1, 1])
    difference = g("Sub", g("Slice", "backbone_fpn_0", [0], [3], [1]), colour)
    distance = g("ReduceSum", g("Mul", difference, difference), [1], keepdims=1)
    near = g("Mul", g("Sub", WIDTH, distance), SHARPNESS)
    g("Min", near, np.where(places(2 * rows), 99.0, -99.0)[None], into="pred_masks")  # (1, Q, h, w)
    logits = g("Min", g("ReduceMax", "pred_masks", axes=[2, 3], keepdims=0), LOGITS[None])
    g("Unsqueeze", logits, [2], into="pred_logits")
    there = g("Mul", g("ReduceMax", logits, axes=[1], keepdims=1), 100.0)
    boxed = g("ReduceMax", g("Cast", g("Not", "box_masks"), to=1), axes=[1], keepdims=1)
    g("Add", g("Min", there, PRESENCE), g("Mul", boxed, -99.0), into="presence_logit_dec")
    g("Identity", np.full((1, queries, 4), 0.5), into="pred_boxes")
    sizes, given = (2 * rows, rows, rows // 2), {}
    if kind != "sam3-onnx":
        given = {"original_height": ("int64", []), "original_width": ("int64", [])}
    given |= {f"vision_pos_enc_{n}": ("float32", [1, channels, size, size]) for n, size in enumerate(sizes)}
    given |= {f"backbone_fpn_{n}": ("float32", [1, channels, size, size]) for n, size in enumerate(sizes)}
    given |= {"language_mask": ("bool", [1, LENGTH]), "language_features": ("float32", [LENGTH, 1, channels])}
    given |= {"language_embeds": ("float32", [LENGTH, 1, embedding]), "box_coords": ("float32", [boxes, 1, 4])}
    given |= {"box_labels": ("int64", [boxes, 1]), "box_masks": ("bool", [1, boxes])}
    declared = {
        "pred_boxes": ("float32", [1, queries, 4]),
        "pred_logits": ("float32", [1, queries, 1]),
        "pred_masks": ("float32", [1, queries, 2 * rows, 2 * rows]),
        "presence_logit_dec": ("float32", [1, 1]),
    }
    if raw:
        return g.save(path, given, declared)
    for name in ("vision_pos_enc_0", "vision_pos_enc_1", "language_embeds"):  # a simplified graph lost them
        del given[name]
    all_scores = g("Mul", g("Sigmoid", logits), g("Sigmoid", "presence_logit_dec"))
    kept = g("Squeeze", g("Greater", all_scores, 0.5), [0])
    g("Compress", g("Squeeze", all_scores, [0]), kept, axis=0, into="scores")
    g("Squeeze", g("Compress", "pred_boxes", kept, axis=1), [0], into="boxes")
    small = g("Unsqueeze", g("Compress", g("Squeeze", "pred_masks", [0]), kept, axis=0), [1])
    if kind == "sam3-onnx":
        g("Sigmoid", small, into="masks")
        masks = ("float32", ["n", 1, 2 * rows, 2 * rows])
    else:
        probable = g("Sigmoid", small)
        height, width = (g("Unsqueeze", f"original_{side}", [0]) for side in ("height", "width"))
        sizes = g("Concat", g("Slice", g("Shape", probable), [0], [2]), height, width, axis=0)
        g("Greater", g("Resize", probable, "", "", sizes, mode="linear"), 0.5, into="masks")
        masks = ("bool", ["n", 1, "height_px", "width_px_of"])
    declared = {"boxes": ("float32", ["n", 4]), "scores": ("float32", ["n"]), "masks": masks}
    return g.save(path, given, declared)


def write_sam3(
    folder: Path,
    kind: str = "samexporter",
    *,
    side: int = SIDE,
    channels: int = CHANNELS,
    embedding: int = 16,
    image: str = "uint8",
) -> Path:
    """A SAM 3 folder with the decoder of one of KINDS."""
    _write_image(folder / "sam3_image_encoder.onnx", side, channels, image)
    _write_language(folder / "sam3_language_encoder.onnx", channels, embedding)
    boxes = 8 if kind == "samexporter" else 1
    _write_decoder(folder / "sam3_decoder.onnx", kind, side, channels, embedding, boxes)
    write_tokenizer(folder / "tokenizer.json")
    return folder
