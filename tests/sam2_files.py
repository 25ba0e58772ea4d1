"""A SAM 2 folder in small: the five graphs of the public export with its signatures, and random weights.

The networks are shallow, but each output depends on every input, so that a wrong memory, code or order shows.
"""

import json
from pathlib import Path

import numpy as np
from onnx_files import Sketch

SIZE, GRID, LOW, CHANNELS, MEMORY = 64, 4, 16, 8, 4
TOKENS, SLOTS, POINTERS = GRID * GRID, 7, 16
MEAN, STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]


class RandomSketch(Sketch):
    """A sketch with random weights."""

    def __init__(self, rng: np.random.Generator):
        super().__init__()
        self.rng = rng

    def weight(self, *shape: int, scale: float | None = None) -> str:
        """The name of random numbers; by default of the deviation that keeps a layer's size."""
        return self.constant(self.rng.normal(size=shape) * (scale or np.prod(shape[1:]) ** -0.5))

    def save(self, path: Path, inputs: dict, outputs: dict) -> Path:
        """`inputs` and `outputs` have shapes alone."""

        def kind(name):
            return "int32" if name == "input_labels" else "float32"

        typed = [{name: (kind(name), list(shape)) for name, shape in side.items()} for side in (inputs, outputs)]
        return super().save(path, *typed)


def write_sam2(folder: Path, *, seed: int = 1, memory: int = MEMORY) -> Path:
    """Writes a folder of small SAM 2 graphs; `memory` is the memory's width in the memory encoder alone."""
    (folder / "onnx").mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    image, fine = (1, CHANNELS, GRID, GRID), {"feats0": (1, 1, LOW, LOW), "feats1": (1, 2, LOW // 2, LOW // 2)}

    g = RandomSketch(rng)
    for level, (out, stride) in enumerate(((1, 4), (2, 8), (CHANNELS, 16))):
        weight = g.weight(out, 3, stride, stride, scale=0.7 / stride)
        g("Conv", "pixel_values", weight, kernel_shape=[stride] * 2, strides=[stride] * 2, into=f"feats{level}")
    g("Add", "feats2", g.weight(1, CHANNELS, 1, 1, scale=0.5), into="feats2_no_mem")
    g("Identity", g.weight(*image, scale=1.0), into="vision_pos_embed")
    coarsest = ("batch", CHANNELS, "rows", "columns")  # as PyTorch's exporter declares it
    outputs = fine | dict.fromkeys(("feats2", "feats2_no_mem", "vision_pos_embed"), coarsest)
    g.save(folder / "onnx" / "vision_encoder.onnx", {"pixel_values": (1, 3, SIZE, SIZE)}, outputs)

    g = RandomSketch(rng)
    label = g("Unsqueeze", g("Cast", "input_labels", to=1), [3])  # (1, 1, N, 1)
    label = g("Mul", label, g.weight(CHANNELS, scale=0.3))
    prompt = g("Add", g("MatMul", "input_points", g.weight(2, CHANNELS, scale=0.02)), label)
    prompt = g("ReduceMean", prompt, axes=[1, 2], keepdims=0)  # (1, C)
    seen = g("ReduceMean", "feats2_cond", axes=[2, 3], keepdims=0)
    both = g("Tanh", g("Add", prompt, seen))
    weight = g.weight(CHANNELS, 1, 4, 4, scale=0.3)
    coarse = g("ConvTranspose", "feats2_cond", weight, kernel_shape=[4] * 2, strides=[4] * 2)
    middle = g("ConvTranspose", "feats1", g.weight(2, 1, 2, 2), kernel_shape=[2, 2], strides=[2, 2])
    turned = g("Reshape", g("MatMul", both, g.weight(CHANNELS, 1)), [1, 1, 1, 1])
    mask = g("Add", g("Add", g("Add", coarse, middle), turned), "feats0")
    score = g("Add", g("MatMul", g("Tanh", seen), g.weight(CHANNELS, 1, scale=1.5)), [0.3])
    g("Reshape", score, [1, 1, 1], into="object_score_logits")
    present = g("Greater", score, 0.0)
    shown = g("Reshape", present, [1, 1, 1, 1])
    g("Where", shown, mask, -1024.0, into="low_res_mask")
    scales = [1, 1, SIZE / LOW, SIZE / LOW]
    g("Resize", "low_res_mask", "", scales, mode="linear", into="high_res_mask")
    pointer = g("Where", present, g("MatMul", both, g.weight(CHANNELS, CHANNELS)), g.weight(1, CHANNELS))
    g("Reshape", pointer, [1, 1, CHANNELS], into="object_pointer")
    g("Tanh", g("MatMul", both, g.weight(CHANNELS, 1)), into="iou")
    inputs = fine | {"feats2_cond": image, "input_points": (1, 1, "points", 2), "input_labels": (1, 1, "points")}
    outputs = {"low_res_mask": (1, 1, LOW, LOW), "high_res_mask": (1, 1, SIZE, SIZE), "iou": (1, 1)}
    outputs |= {"object_score_logits": (1, 1, 1), "object_pointer": (1, 1, CHANNELS)}
    g.save(folder / "onnx" / "mask_decoder.onnx", inputs, outputs)

    g = RandomSketch(rng)
    hard = g("Cast", g("Greater", "high_res_mask", 0.0), to=1)
    binary = g("Greater", "binarize", 0.5)
    mask = g("Where", binary, hard, g("Sigmoid", "high_res_mask"))
    mask = g("Sub", g("Mul", mask, 20.0), 10.0)
    mask = g("Conv", mask, g.weight(memory, 1, 16, 16, scale=0.01), kernel_shape=[16, 16], strides=[16, 16])
    features = g("Add", mask, g("Conv", "feats2", g.weight(memory, CHANNELS, 1, 1)))
    occluded = g("Cast", g("LessOrEqual", "object_score_logits", 0.0), to=1)
    occluded = g("Reshape", occluded, [1, 1, 1, 1])
    features = g("Add", features, g("Mul", occluded, g.weight(1, memory, 1, 1)))
    flat = g("Reshape", features, [memory, TOKENS, 1])
    g("Transpose", flat, perm=[1, 2, 0], into="memory_tokens")
    g("Identity", g.weight(TOKENS, 1, memory, scale=0.5), into="memory_pos")
    inputs = {"feats2": image, "high_res_mask": (1, 1, SIZE, SIZE), "object_score_logits": (1, 1), "binarize": ()}
    outputs = dict.fromkeys(("memory_tokens", "memory_pos"), (TOKENS, 1, memory))
    g.save(folder / "onnx" / "memory_encoder.onnx", inputs, outputs)

    g = RandomSketch(rng)
    keys = g("MatMul", g("Add", "memory", "memory_pos"), g.weight(MEMORY, CHANNELS, scale=0.7))
    keys = g("Transpose", keys, perm=[1, 2, 0])  # (1, C, K)
    queries = g("Add", "current_vision_features", "current_vision_position_embeddings")
    weights = g("Softmax", g("MatMul", g("Transpose", queries, perm=[1, 0, 2]), keys), axis=-1)  # (1, T, K)
    values = g("Transpose", g("MatMul", "memory", g.weight(MEMORY, CHANNELS, scale=1.0)), perm=[1, 0, 2])
    read = g("Transpose", g("MatMul", weights, values), perm=[0, 2, 1])  # (1, C, T)
    current = g("Transpose", "current_vision_features", perm=[1, 2, 0])
    g("Reshape", g("Add", current, read), image, into="conditioned_feats")
    rows = SLOTS * TOKENS + POINTERS * (CHANNELS // MEMORY)
    names = "current_vision_features", "current_vision_position_embeddings"
    inputs = dict.fromkeys(names, (TOKENS, 1, CHANNELS)) | dict.fromkeys(("memory", "memory_pos"), (rows, 1, MEMORY))
    g.save(folder / "onnx" / "memory_attention.onnx", inputs, {"conditioned_feats": image})

    g = RandomSketch(rng)
    column = g("Unsqueeze", "normalized_diffs", [1])
    waves = g("Sin", g("MatMul", column, g.weight(1, CHANNELS, scale=5.0)))
    g("MatMul", waves, g.weight(CHANNELS, MEMORY, scale=0.6), into="pointer_pos")
    inputs, outputs = {"normalized_diffs": ("pointers",)}, {"pointer_pos": ("pointers", MEMORY)}
    g.save(folder / "onnx" / "pointer_tpos.onnx", inputs, outputs)

    codes = (0.7 * rng.normal(size=(SLOTS, MEMORY))).tolist()
    constants = {"image_size": SIZE, "image_mean": MEAN, "image_std": STD, "memory_temporal_positional_encoding": codes}
    (folder / "constants.json").write_text(json.dumps(constants))
    return folder
