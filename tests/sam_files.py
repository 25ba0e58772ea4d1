"""SAM folders for tests: graphs of the true signatures that segment by colour. A point's masks are what is connected or
not, but of about the colour at the point: three widths of "about", from the narrowest to the widest."""

import json
from pathlib import Path

import numpy as np
from onnx_files import node, write_graph

from jsecon.networks.sam.graphs import MEAN, STD

CHANNELS = 8
WIDTHS = (0.02, 0.01, 0.02, 0.08)
"""squared distance of normalised colour: of the single mask, then of s, m, l"""
SHARPNESS = 400.0
IOUS = (0.99, 0.90, 0.92, 0.94)


def write_encoder(
    path: Path, side: int, outputs: tuple[str, ...] = ("image_embeddings",), *, raw: bool = False
) -> Path:
    """Mean colours of 16 x 16 px cells, (1, CHANNELS, S/16, S/16); `raw` takes (H, W, 3) of 0..255 and pads it."""
    grid = side // 16
    constants = {"pads": np.asarray([0, 0, 0, 0, 0, CHANNELS - 3, 0, 0])}
    pooled = [
        node("AveragePool", ["square"], ["cells"], kernel_shape=[16, 16], strides=[16, 16]),
        node("Pad", ["cells", "pads"], [outputs[0]]),
        *(node("Identity", [outputs[0]], [name]) for name in outputs[1:]),
    ]
    declared = {name: ("float32", [1, CHANNELS, grid, grid]) for name in outputs}
    if not raw:
        nodes = [node("Identity", ["pixel_values"], ["square"]), *pooled]
        return write_graph(path, nodes, {"pixel_values": ("float32", [1, 3, side, side])}, declared, constants)
    constants |= {
        "mean": MEAN,
        "std": STD,
        "side": np.asarray([side, side]),
        "two": np.asarray([2]),
        "zeros": np.zeros(4, np.int64),
        "zero": np.asarray([0]),
        "three": np.asarray([3]),
    }
    nodes = [
        node("Sub", ["input_image", "mean"], ["centred"]),
        node("Div", ["centred", "std"], ["scaled"]),
        node("Transpose", ["scaled"], ["planes"], perm=[2, 0, 1]),
        node("Unsqueeze", ["planes", "zero"], ["one"]),
        node("Shape", ["one"], ["shape"]),
        node("Slice", ["shape", "two", "four"], ["size"]),
        node("Sub", ["side", "size"], ["lack"]),
        node("Concat", ["zeros", "zero", "zero", "lack"], ["padding"], axis=0),
        node("Pad", ["one", "padding"], ["square"]),
        *pooled,
    ]
    constants["four"] = np.asarray([4])
    del constants["three"]
    return write_graph(path, nodes, {"input_image": ("float32", ["h", "w", 3])}, declared, constants)


def write_decoder(path: Path, side: int, dialect: str, batch: int | str, *, masks: int = 4) -> Path:
    """Dialects: "segment-anything", "transformers.js", "sam2", "sam2 transformers.js". The first gives a score of 0
    unless the prompt ends in a point of label -1."""
    grid, low = side // 16, side // 4
    own, nested, boxed = dialect == "segment-anything", "transformers.js" in dialect, dialect == "sam2 transformers.js"
    embedding = {"sam2": "image_embed", "sam2 transformers.js": "image_embeddings.2"}.get(dialect, "image_embeddings")
    coords, labels, scores, logits = {
        "segment-anything": ("point_coords", "point_labels", "iou_predictions", "low_res_masks"),
        "transformers.js": ("input_points", "input_labels", "iou_scores", "pred_masks"),
        "sam2": ("point_coords", "point_labels", "iou_predictions", "masks"),
    }[dialect.removeprefix("sam2 ")]
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
        *(
            [node("Squeeze", [coords, "zero"], ["prompts"]), node("Squeeze", [labels, "zero"], ["kinds_in"])]
            if nested
            else [node("Identity", [coords], ["prompts"]), node("Identity", [labels], ["kinds_in"])]
        ),
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
        node("Mul", ["last_kind", "sign"], ["ends_well"]),
        node("Mul", ["ends_well", "ious"], ["found_ious"]),
    ]
    constants |= {"last": np.asarray([np.iinfo(np.int64).max]), "sign": np.float32(-1 if own else 1)}
    if nested:
        nodes += [node("Unsqueeze", ["logits", "zero"], [logits]), node("Unsqueeze", ["found_ious", "zero"], [scores])]
    else:
        nodes += [node("Identity", ["logits"], [logits]), node("Identity", ["found_ious"], [scores])]
    lead, kind = ([1], "int64") if nested else ([], "float32")
    inputs = {
        embedding: ("float32", [1, CHANNELS, grid, grid]),
        coords: ("float32", [*lead, batch, "points", 2]),
        labels: (kind, [*lead, batch, "points"]),
    }
    outputs = {
        logits: ("float32", [*lead, batch, masks, low, low]),
        scores: ("float32", [*lead, batch, masks]),
    }
    if boxed:  # as the published graphs do it: no boxes, and so one prompt a call
        inputs |= {f"image_embeddings.{n}": ("float32", [1, CHANNELS, grid, grid]) for n in (0, 1)}
        inputs["input_boxes"] = ("float32", ["images", "boxes", 4])
        outputs["object_score_logits"] = ("float32", [1, batch, 1])
        nodes.append(node("ReduceMax", [scores], ["object_score_logits"], axes=[2]))
    elif nested:
        inputs["image_positional_embeddings"] = ("float32", [1, CHANNELS, grid, grid])
    else:
        inputs["mask_input"] = ("float32", [batch if dialect == "sam2" else 1, 1, low, low])
        inputs["has_mask_input"] = ("float32", [batch if dialect == "sam2" else 1])
    if dialect == "sam2":
        inputs |= {f"high_res_feats_{n}": ("float32", [1, CHANNELS, grid, grid]) for n in (0, 1)}
    if own:
        inputs["orig_im_size"] = ("float32", [2])
        nodes += [
            node("Shape", ["logits"], ["low_shape"]),
            node("Slice", ["low_shape", "zero", "two"], ["counts"]),
            node("Cast", ["orig_im_size"], ["size"], to=7),
            node("Concat", ["counts", "size"], ["sizes"], axis=0),
            node("Resize", ["logits", "", "", "sizes"], ["masks"], mode="linear"),
        ]
        outputs = {"masks": ("float32", [batch, masks, "height", "width"])} | outputs
    return write_graph(path, nodes, inputs, outputs, constants)


def write_sam(folder: Path, dialect: str = "segment-anything", *, side: int = 256, batch: int | str = "batch") -> Path:
    """A SAM folder of one of the dialects, with the file names of who publishes it."""
    if dialect == "transformers.js":
        names = ("image_embeddings", "image_positional_embeddings")
        write_encoder(folder / "onnx" / "vision_encoder.onnx", side, names)
        write_decoder(folder / "onnx" / "prompt_encoder_mask_decoder.onnx", side, dialect, batch, masks=3)
    elif dialect == "sam2 transformers.js":
        write_encoder(folder / "onnx" / "vision_encoder.onnx", side, tuple(f"image_embeddings.{n}" for n in range(3)))
        write_decoder(folder / "onnx" / "prompt_encoder_mask_decoder.onnx", side, dialect, batch, masks=3)
        told = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225], "rescale_factor": 1 / 255}
        told |= {"do_normalize": True, "do_rescale": True, "size": {"height": side, "width": side}}
        (folder / "preprocessor_config.json").write_text(json.dumps(told))
    elif dialect == "sam2":
        names = ("image_embed", "high_res_feats_0", "high_res_feats_1")
        write_encoder(folder / "sam2_tiny.encoder.onnx", side, names)
        write_decoder(folder / "sam2_tiny.decoder.onnx", side, dialect, batch, masks=3)
    else:
        write_encoder(folder / "sam_vit_b_encoder.onnx", side, ("embeddings",))
        write_decoder(folder / "sam_vit_b_decoder.onnx", side, dialect, batch)
    return folder
