"""SAM folders for tests: graphs of the true signatures that segment by colour. A point's masks are what is connected or
not, but of about the colour at the point: three widths of "about", from the narrowest to the widest."""

import json
from pathlib import Path

import numpy as np
from onnx_files import node, write_graph

CHANNELS = 8
WIDTHS = (0.02, 0.01, 0.02, 0.08)
"""squared distance of normalised colour: of the single mask, then of s, m, l"""
SHARPNESS = 400.0
IOUS = (0.99, 0.90, 0.92, 0.94)


def write_encoder(path: Path, side: int, outputs: tuple[str, ...] = ("image_embeddings",)) -> Path:
    """Mean colours of 16 x 16 px cells, (1, CHANNELS, S/16, S/16)."""
    grid = side // 16
    nodes = [
        node("AveragePool", ["pixel_values"], ["cells"], kernel_shape=[16, 16], strides=[16, 16]),
        node("Pad", ["cells", "pads"], [outputs[0]]),
        *(node("Identity", [outputs[0]], [name]) for name in outputs[1:]),
    ]
    declared = {name: ("float32", [1, CHANNELS, grid, grid]) for name in outputs}
    constants = {"pads": np.asarray([0, 0, 0, 0, 0, CHANNELS - 3, 0, 0])}
    return write_graph(path, nodes, {"pixel_values": ("float32", [1, 3, side, side])}, declared, constants)


def write_decoder(path: Path, side: int, kind: str, batch: int | str, *, masks: int = 3) -> Path:
    """Kinds: "sam", and "sam2" with the frame at three scales and boxes."""
    grid, low, boxed = side // 16, side // 4, kind == "sam2"
    embedding = "image_embeddings.2" if boxed else "image_embeddings"
    coords, labels, scores, logits = "input_points", "input_labels", "iou_scores", "pred_masks"
    constants = {
        "sixteen": np.float32(16),
        "highest": np.float32(grid - 1),
        "least": np.float32(0),
        "grid": np.asarray(grid),
        "flat": np.asarray([CHANNELS, grid * grid]),
        "maps": np.asarray([-1, 1, grid, grid]),
        "zero": np.asarray([0]),
        "one": np.asarray([1]),
        "minus": np.asarray([-1]),
        "widths": np.float32(WIDTHS[-masks:]).reshape(1, -1, 1, 1),
        "sharpness": np.float32(SHARPNESS),
        "ious": np.float32(IOUS[-masks:])[None],
        "fourfold": np.float32([1, 1, 4, 4]),
        "two": np.asarray([2]),
    }
    nodes = [
        node("Squeeze", [coords, "zero"], ["prompts"]),
        node("Squeeze", [labels, "zero"], ["kinds_in"]),
        node("Cast", ["kinds_in"], ["kinds"], to=1),
        node("Slice", ["prompts", "zero", "one", "one"], ["first"]),
        node("Squeeze", ["first", "one"], ["point"]),
        node("Div", ["point", "sixteen"], ["cell_f"]),
        node("Clip", ["cell_f", "least", "highest"], ["clipped"]),
        node("Cast", ["clipped"], ["cell"], to=7),
        node("Gather", ["cell", "zero"], ["x"], axis=1),
        node("Gather", ["cell", "one"], ["y"], axis=1),
        node("Mul", ["y", "grid"], ["row"]),
        node("Add", ["row", "x"], ["at_column"]),
        node("Squeeze", ["at_column", "one"], ["at"]),
        node("Reshape", [embedding, "flat"], ["colours"]),
        node("Gather", ["colours", "at"], ["own_columns"], axis=1),  # (C, B)
        node("Transpose", ["own_columns"], ["own"], perm=[1, 0]),
        node("Unsqueeze", ["own", "two"], ["own_here"]),  # (B, C, 1)
        node("Unsqueeze", ["colours", "zero"], ["all"]),  # (1, C, G^2)
        node("Sub", ["all", "own_here"], ["difference"]),
        node("Mul", ["difference", "difference"], ["squares"]),
        node("ReduceSum", ["squares", "one"], ["distance"], keepdims=0),
        node("Reshape", ["distance", "maps"], ["distances"]),
        node("Sub", ["widths", "distances"], ["within"]),
        node("Mul", ["within", "sharpness"], ["coarse"]),
        node("Resize", ["coarse", "", "fourfold"], ["logits"], mode="linear"),
        node("Slice", ["kinds", "minus", "last", "one"], ["last_kind"]),
        node("Mul", ["last_kind", "ious"], ["found_ious"]),
    ]
    constants |= {"last": np.asarray([np.iinfo(np.int64).max])}
    nodes += [node("Unsqueeze", ["logits", "zero"], [logits]), node("Unsqueeze", ["found_ious", "zero"], [scores])]
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
        nodes.append(node("ReduceMax", [scores], ["object_score_logits"], axes=[2]))
    else:
        inputs["image_positional_embeddings"] = ("float32", [1, CHANNELS, grid, grid])
    return write_graph(path, nodes, inputs, outputs, constants)


def write_sam(folder: Path, kind: str = "sam", *, side: int = 256, batch: int | str = "batch") -> Path:
    """A SAM folder of one of the kinds, with the file names of its publishers."""
    encoder, decoder = folder / "onnx" / "vision_encoder.onnx", folder / "onnx" / "prompt_encoder_mask_decoder.onnx"
    if kind == "sam2":
        write_encoder(encoder, side, tuple(f"image_embeddings.{n}" for n in range(3)))
        content = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225], "rescale_factor": 1 / 255}
        content |= {"do_normalize": True, "do_rescale": True, "size": {"height": side, "width": side}}
        (folder / "preprocessor_config.json").write_text(json.dumps(content))
    else:
        write_encoder(encoder, side, ("image_embeddings", "image_positional_embeddings"))
    write_decoder(decoder, side, kind, batch)
    return folder
