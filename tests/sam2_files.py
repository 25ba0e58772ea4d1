"""A SAM 2 folder in small: graphs of the true signatures, with random weights, written with onnx.

The networks are shallow, but each output depends on every input, so that a wrong memory, code or order shows.
"""

from pathlib import Path

import numpy as np
from onnx_files import node, write_graph

SIZE, GRID, LOW, CHANNELS, MEMORY = 64, 4, 16, 8, 4
TOKENS, SLOTS = GRID * GRID, 7


class Sketch:
    """Nodes and weights of a graph in the making."""

    def __init__(self, rng: np.random.Generator):
        self.rng, self.nodes, self.weights = rng, [], {}

    def weight(self, *shape: int, scale: float | None = None) -> str:
        """The name of random numbers; by default of the deviation that keeps a layer's size."""
        return self.constant(self.rng.normal(size=shape) * (scale or np.prod(shape[1:]) ** -0.5))

    def constant(self, array, dtype=np.float32) -> str:
        self.weights[f"w{len(self.weights)}"] = np.asarray(array, dtype)
        return f"w{len(self.weights) - 1}"

    def __call__(self, kind: str, *inputs: str, into: str | None = None, **attributes) -> str:
        name = into or f"x{len(self.nodes)}"
        self.nodes.append(node(kind, list(inputs), [name], **attributes))
        return name

    def save(self, path: Path, inputs: dict, outputs: dict) -> None:
        kind = lambda name: "int32" if name in ("labels", "masks_enable") else "float32"
        typed = [{name: (kind(name), list(shape)) for name, shape in side.items()} for side in (inputs, outputs)]
        write_graph(path, self.nodes, *typed, self.weights)


def write_sam2(folder: Path, *, version: str = "2.1", seed: int = 1, memory: int = MEMORY) -> Path:
    """Writes a folder of small SAM 2 graphs; `memory` is the memory's width in the memory encoder alone."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    image, grid = (1, CHANNELS, GRID, GRID), (1, None, CHANNELS)

    g = Sketch(rng)
    for level, (out, stride) in enumerate(((1, 4), (2, 8), (CHANNELS, 16))):
        weight = g.weight(out, 3, stride, stride, scale=0.7 / stride)
        g("Conv", "input_image", weight, kernel_shape=[stride] * 2, strides=[stride] * 2, into=f"backbone_fpn_{level}")
    g("Identity", g.weight(*image, scale=1.0), into="vision_pos_enc_2")
    fine = {"backbone_fpn_0": (1, 1, LOW, LOW), "backbone_fpn_1": (1, 2, LOW // 2, LOW // 2)}
    g.save(
        folder / "image_encoder_small.onnx",
        {"input_image": (1, 3, SIZE, SIZE)},
        fine | {"backbone_fpn_2": image, "vision_pos_enc_2": image},
    )

    g = Sketch(rng)
    label = g("Unsqueeze", g("Cast", "labels", to=1), g.constant([2], np.int64))
    label = g("Mul", label, g.weight(CHANNELS, scale=0.3))
    own = g("Add", g("MatMul", "coords", g.weight(2, CHANNELS, scale=0.02)), label)
    g("Concat", own, g.weight(1, 1, CHANNELS, scale=0.5), axis=1, into="sparse_embeddings")
    hint = g("Unsqueeze", "masks", g.constant([1], np.int64))
    hinted = g("Conv", hint, g.weight(CHANNELS, 1, 4, 4), kernel_shape=[4, 4], strides=[4, 4])
    enabled = g("Reshape", g("Cast", "masks_enable", to=1), g.constant([1, 1, 1, 1], np.int64))
    g("Add", g("Mul", enabled, hinted), g.weight(1, CHANNELS, 1, 1, scale=0.2), into="dense_embeddings")
    g("Identity", g.weight(*image, scale=0.3), into="dense_pe")
    g.save(
        folder / "prompt_encoder_small.onnx",
        {"coords": (1, "points", 2), "labels": (1, "points"), "masks": (1, LOW, LOW), "masks_enable": (1,)},
        {"sparse_embeddings": grid, "dense_embeddings": image, "dense_pe": image},
    )

    g = Sketch(rng)
    source = g("Add", g("Add", "image_embeddings", "image_pe"), "dense_prompt_embeddings")
    said = g("ReduceMean", "sparse_prompt_embeddings", axes=[1], keepdims=0)  # (1, C)
    seen = g("ReduceMean", source, axes=[2, 3], keepdims=0)
    both = g("Tanh", g("Add", said, seen))
    coarse = g("ConvTranspose", source, g.weight(CHANNELS, 4, 4, 4, scale=0.3), kernel_shape=[4, 4], strides=[4, 4])
    middle = g("ConvTranspose", "high_res_features2", g.weight(2, 4, 2, 2), kernel_shape=[2, 2], strides=[2, 2])
    turned = g("Reshape", g("MatMul", both, g.weight(CHANNELS, 4)), g.constant([1, 4, 1, 1], np.int64))
    g("Add", g("Add", g("Add", coarse, middle), turned), "high_res_features1", into="masks")
    g("Tanh", g("MatMul", both, g.weight(CHANNELS, 4)), into="iou_pred")
    tokens = g("MatMul", both, g.weight(CHANNELS, 4 * CHANNELS, scale=1.0))
    g("Reshape", tokens, g.constant([1, 4, CHANNELS], np.int64), into="sam_tokens_out")
    score = g("MatMul", g("Tanh", seen), g.weight(CHANNELS, 1, scale=1.5))
    g("Add", score, g.constant([0.3]), into="object_score_logits")
    g.save(
        folder / "mask_decoder_small.onnx",
        {
            "image_embeddings": image,
            "image_pe": image,
            "sparse_prompt_embeddings": grid,
            "dense_prompt_embeddings": image,
            "high_res_features1": (1, 1, LOW, LOW),
            "high_res_features2": (1, 2, LOW // 2, LOW // 2),
        },
        {
            "masks": (1, 4, LOW, LOW),
            "iou_pred": (1, 4),
            "sam_tokens_out": (1, 4, CHANNELS),
            "object_score_logits": (1, 1),
        },
    )

    _linear(folder / "mlp_small.onnx", rng, CHANNELS, CHANNELS)

    g = Sketch(rng)
    keys = g("Concat", g("Add", "memory_1", "memory_pos_1"), g("Add", "memory_2", "memory_pos_2"), axis=0)
    keys = g("Transpose", g("MatMul", keys, g.weight(MEMORY, CHANNELS, scale=0.7)), perm=[1, 2, 0])  # (1, C, K)
    queries = g("Transpose", g("Add", "curr", "curr_pos"), perm=[1, 0, 2])
    weights = g("Softmax", g("MatMul", queries, keys), axis=-1)  # (1, T, K)
    values = g("Concat", "memory_1", "memory_2", axis=0)
    values = g("Transpose", g("MatMul", values, g.weight(MEMORY, CHANNELS, scale=1.0)), perm=[1, 0, 2])
    g("Add", "curr", g("Transpose", g("MatMul", weights, values), perm=[1, 0, 2]), into="pix_feat")
    tokens, spatial, known = (TOKENS, 1, CHANNELS), ("spatial", 1, MEMORY), ("pointers", 1, MEMORY)
    g.save(
        folder / "memory_attention_small.onnx",
        {
            "curr": tokens,
            "memory_1": spatial,
            "memory_2": known,
            "curr_pos": tokens,
            "memory_pos_1": spatial,
            "memory_pos_2": known,
        },
        {"pix_feat": tokens},
    )

    g = Sketch(rng)
    mask = g("Conv", "masks", g.weight(memory, 1, 16, 16, scale=0.01), kernel_shape=[16, 16], strides=[16, 16])
    g("Add", mask, g("Conv", "pix_feat", g.weight(memory, CHANNELS, 1, 1)), into="vision_features")
    g("Identity", g.weight(1, memory, GRID, GRID, scale=0.5), into="vision_pos_enc")
    made = (1, memory, GRID, GRID)
    g.save(
        folder / "memory_encoder_small.onnx",
        {"pix_feat": image, "masks": (1, 1, SIZE, SIZE)},
        {"vision_features": made, "vision_pos_enc": made},
    )

    constants = {
        "no_mem_embed": rng.normal(size=(1, 1, CHANNELS)),
        "no_obj_ptr": rng.normal(size=(1, CHANNELS)),
        "maskmem_tpos_enc": 0.7 * rng.normal(size=(SLOTS, 1, 1, MEMORY)),
        "mask_downsample_weight": rng.normal(size=(1, 1, 4, 4)),
        "mask_downsample_bias": rng.normal(size=1),
    }
    if version == "2.1":
        _linear(folder / "obj_ptr_tpos_proj_small.onnx", rng, CHANNELS, MEMORY)
        constants["no_obj_embed_spatial"] = rng.normal(size=(1, MEMORY))
    np.savez(folder / "constants.npz", **{name: array.astype(np.float32) for name, array in constants.items()})
    return folder


def _linear(path: Path, rng: np.random.Generator, count: int, width: int) -> None:
    g = Sketch(rng)
    g("Add", g("MatMul", "x", g.weight(count, width, scale=0.6)), g.weight(width, scale=0.3), into="x_out")
    g.save(path, {"x": ("rows", count)}, {"x_out": ("rows", width)})
