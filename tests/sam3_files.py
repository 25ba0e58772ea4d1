"""SAM 3 folders for tests: the three graphs of vietanhdev/samexporter's export in their names, types and shapes, and
those of the older decoders. They find the things that are of the colour that a phrase names."""

from pathlib import Path

import numpy as np
from clip_files import COLOURS, load_tokens, vocabulary, write_tokenizer
from onnx_files import node, write_graph

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
    nodes = [
        node("Cast", ["image"], ["floats"], to=1),
        node("Mul", ["floats", "scale"], ["scaled"]),
        node("Sub", ["scaled", "one"], ["centred"]),
        node("Unsqueeze", ["centred", "zero"], ["square"]),
        node("AveragePool", ["square"], ["cells"], kernel_shape=[7, 7], strides=[7, 7]),
        node("Pad", ["cells", "pads"], ["backbone_fpn_1"]),
        node("Resize", ["backbone_fpn_1", "", "twice"], ["backbone_fpn_0"], mode="nearest"),
        node("AveragePool", ["backbone_fpn_1"], ["backbone_fpn_2"], kernel_shape=[2, 2], strides=[2, 2]),
        *(node("Mul", [f"backbone_fpn_{n}", "nought"], [f"vision_pos_enc_{n}"]) for n in range(3)),
    ]
    if kind != "uint8":
        nodes[0] = node("Mul", ["image", "one"], ["floats"])
    constants = {
        "scale": np.float32(2 / 255),
        "one": np.float32(1),
        "nought": np.float32(0),
        "zero": np.asarray([0]),
        "pads": np.asarray([0, 0, 0, 0, 0, channels - 3, 0, 0]),
        "twice": np.float32([1, 1, 2, 2]),
    }
    sizes = (2 * rows, rows, rows // 2)
    declared = {
        f"{name}_{n}": ("float32", [1, channels, size, size])
        for name in ("vision_pos_enc", "backbone_fpn")
        for n, size in enumerate(sizes)
    }
    return write_graph(path, nodes, {"image": (kind, [3, side, side])}, declared, constants)


def _write_language(path: Path, channels: int, embedding: int) -> Path:
    """Of each token its colour in -1..1, then 1 for a colour; the mask is true where the phrase is filled up."""
    table = np.zeros((len(vocabulary()), embedding), np.float32)
    table[0, :4] = 5  # what fills a phrase up: not to be read
    for word, colour in COLOURS.items():
        table[load_tokens([word])[0], :4] = *(2 * part - 1 for part in colour), 1
    nodes = [
        node("Equal", ["tokens", "zero"], ["text_attention_mask"]),
        node("Gather", ["table", "tokens"], ["rows"]),
        node("Transpose", ["rows"], ["text_embeds"], perm=[1, 0, 2]),
        node("Slice", ["text_embeds", "first", "channels", "last"], ["text_memory"]),
    ]
    constants = {"table": table, "zero": np.asarray(0), "first": np.asarray([0])}
    constants |= {"channels": np.asarray([channels]), "last": np.asarray([2])}
    declared = {
        "text_attention_mask": ("bool", [1, LENGTH]),
        "text_memory": ("float32", [LENGTH, 1, channels]),
        "text_embeds": ("float32", [LENGTH, 1, embedding]),
    }
    return write_graph(path, nodes, {"tokens": ("int64", [1, LENGTH])}, declared, constants)


def _write_decoder(path: Path, kind: str, side: int, channels: int, embedding: int, boxes: int) -> Path:
    """Nothing is there where a box is used."""
    rows = side // 7
    raw, queries = kind == "samexporter", len(LOGITS)
    nodes = [
        node("Not", ["language_mask"], ["said"]),
        node("Cast", ["said"], ["weights"], to=1),
        node("Reshape", ["weights", "column"], ["of_tokens"]),
        node("Mul", ["language_features", "of_tokens"], ["read"]),
        node("ReduceSum", ["read", "nothing"], ["phrase"], keepdims=1),  # (1, 1, C)
        node("Slice", ["phrase", "at0", "at3", "two"], ["named"]),
        node("Slice", ["phrase", "at3", "at4", "two"], ["count"]),
        node("Sub", ["count", "one"], ["extra"]),
        node("Mul", ["extra", "far"], ["away"]),
        node("Sub", ["named", "away"], ["sought"]),
        node("Reshape", ["sought", "pixel"], ["colour"]),
        node("Slice", ["backbone_fpn_0", "at0", "at3", "at1"], ["seen"]),
        node("Sub", ["seen", "colour"], ["difference"]),
        node("Mul", ["difference", "difference"], ["squares"]),
        node("ReduceSum", ["squares", "at1"], ["distance"], keepdims=1),
        node("Sub", ["width", "distance"], ["near"]),
        node("Mul", ["near", "sharpness"], ["sharp"]),
        node("Min", ["sharp", "places"], ["pred_masks"]),  # (1, Q, h, w)
        node("ReduceMax", ["pred_masks"], ["best"], axes=[2, 3], keepdims=0),
        node("Min", ["best", "most"], ["flat_logits"]),
        node("Unsqueeze", ["flat_logits", "two"], ["pred_logits"]),
        node("ReduceMax", ["flat_logits"], ["seen_best"], axes=[1], keepdims=1),
        node("Not", ["box_masks"], ["used"]),
        node("Cast", ["used"], ["used_f"], to=1),
        node("ReduceMax", ["used_f"], ["boxed"], axes=[1], keepdims=1),
        node("Mul", ["boxed", "minus"], ["hidden"]),
        node("Mul", ["seen_best", "hundred"], ["there"]),
        node("Min", ["there", "presence"], ["present"]),
        node("Add", ["present", "hidden"], ["presence_logit_dec"]),
        node("Identity", ["places_of"], ["pred_boxes"]),
    ]
    constants = {
        "column": np.asarray([-1, 1, 1]),
        "nothing": np.asarray([0]),
        "at0": np.asarray([0]),
        "at1": np.asarray([1]),
        "two": np.asarray([2]),
        "at3": np.asarray([3]),
        "at4": np.asarray([4]),
        "one": np.float32(1),
        "far": np.float32(9),
        "pixel": np.asarray([1, 3, 1, 1]),
        "width": np.float32(WIDTH),
        "sharpness": np.float32(SHARPNESS),
        "places": np.where(places(2 * rows), 99, -99).astype(np.float32)[None],
        "most": LOGITS[None],
        "minus": np.float32(-99),
        "hundred": np.float32(100),
        "presence": np.float32(PRESENCE),
        "places_of": np.full((1, queries, 4), 0.5, np.float32),
    }
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
        return write_graph(path, nodes, given, declared, constants)
    for name in ("vision_pos_enc_0", "vision_pos_enc_1", "language_embeds"):  # a simplified graph lost them
        del given[name]
    nodes += [
        node("Sigmoid", ["flat_logits"], ["likely"]),
        node("Sigmoid", ["presence_logit_dec"], ["present_p"]),
        node("Mul", ["likely", "present_p"], ["all_scores"]),
        node("Greater", ["all_scores", "half"], ["kept"]),
        node("Squeeze", ["kept", "nothing"], ["which"]),
        node("Squeeze", ["all_scores", "nothing"], ["of_queries"]),
        node("Compress", ["of_queries", "which"], ["scores"], axis=0),
        node("Compress", ["pred_boxes", "which"], ["one_boxes"], axis=1),
        node("Squeeze", ["one_boxes", "nothing"], ["boxes"]),
        node("Squeeze", ["pred_masks", "nothing"], ["of_each"]),
        node("Compress", ["of_each", "which"], ["kept_masks"], axis=0),
        node("Unsqueeze", ["kept_masks", "at1"], ["small"]),
        node("Sigmoid", ["small"], ["probable"]),
    ]
    constants["half"] = np.float32(0.5)
    if kind == "sam3-onnx":
        nodes.append(node("Identity", ["probable"], ["masks"]))
        masks = ("float32", ["n", 1, 2 * rows, 2 * rows])
    else:
        nodes += [
            node("Shape", ["probable"], ["shape"]),
            node("Slice", ["shape", "at0", "two"], ["counts"]),
            node("Unsqueeze", ["original_height", "nothing"], ["height"]),
            node("Unsqueeze", ["original_width", "nothing"], ["width_px"]),
            node("Concat", ["counts", "height", "width_px"], ["sizes"], axis=0),
            node("Resize", ["probable", "", "", "sizes"], ["full"], mode="linear"),
            node("Greater", ["full", "half"], ["masks"]),
        ]
        masks = ("bool", ["n", 1, "height_px", "width_px_of"])
    declared = {"boxes": ("float32", ["n", 4]), "scores": ("float32", ["n"]), "masks": masks}
    return write_graph(path, nodes, given, declared, constants)


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
