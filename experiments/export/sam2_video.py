"""SAM 2.1 with memory as the five graphs of its public export with constants.json, from Meta's package `sam2`.

How that exporter chose a mask by the number of points is not published: here the decoder always chooses among three.
"""

import dataclasses
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from experiments.export.graph import STRETCH, Agreement, Wrapped, declare_missing_operators, shake, write_graph
from jsecon.files import write_text
from jsecon.networks.sam2 import POINTERS, SLOTS, _open_sam2, _Sam2Graphs, follow

CONFIG = "sam2.1/sam2.1_hiera_t"
CENTRE = 4.22
"""less the random object score, stretched, at seed 0 (3.8 to 4.0; 4.6 in the dark): an object is present in the light
and absent in the dark"""
QUERIES = 1024
"""rows of an attention matrix at a time: 4,096 at once would take 0.5 GiB a layer"""


def official(seed: int) -> Any:
    """Builds the package's video predictor with random weights in every parameter.

    It fills no holes: that operator exists for CUDA only. The last layers are stretched to logits of a trained model's
    size.
    """
    declare_missing_operators()
    from sam2.build_sam import build_sam2_video_predictor

    torch.manual_seed(seed)
    overrides = ["++model.fill_hole_area=0"]
    model = build_sam2_video_predictor(f"configs/{CONFIG}.yaml", None, device="cpu", hydra_overrides_extra=overrides)
    model.fill_hole_area = 0
    shake(model, seed)
    decoder = model.sam_mask_decoder
    with torch.no_grad():
        for head in decoder.output_hypernetworks_mlps:
            head.layers[-1].weight *= STRETCH
            head.layers[-1].bias *= STRETCH
        score = decoder.pred_obj_score_head.layers[-1]
        score.weight *= -STRETCH
        score.bias.mul_(-STRETCH).add_(CENTRE)
    return model.requires_grad_(False)


def export(model: Any, folder: Path, *, seed: int) -> dict:
    """Writes the folder, compares each graph with its module, and the tracking of a clip with the predictor's.

    Args:
      model: The predictor.
      folder: Where to write.
      seed: Seed of the inputs that are compared.

    Returns:
      {"graphs": agreements, "tracking": figures of the clip}.
    """
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(shape, generator=generator)

    side, channels, memory = model.image_size, model.hidden_dim, model.mem_dim
    grid = side // 16
    tokens, rows = grid * grid, SLOTS * grid * grid + POINTERS * channels // memory
    fine = {
        "feats0": normal(1, channels // 8, 4 * grid, 4 * grid),
        "feats1": normal(1, channels // 4, 2 * grid, 2 * grid),
    }

    def points(count):
        return {
            "input_points": side * torch.rand(1, 1, count, 2, generator=generator),
            "input_labels": torch.arange(count, dtype=torch.int32).reshape(1, 1, count) + 1,
        }

    image = {"feats2": normal(1, channels, grid, grid)}
    score = {"object_score_logits": torch.tensor([[-1.0]]), "binarize": torch.tensor(0.0)}
    current = {
        "current_vision_features": normal(tokens, 1, channels),
        "current_vision_position_embeddings": normal(tokens, 1, channels),
    }
    memories = {"memory": normal(rows, 1, memory), "memory_pos": normal(rows, 1, memory)}
    decoder_inputs = fine | {"feats2_cond": normal(1, channels, grid, grid)}
    parts: dict[str, tuple[torch.nn.Module, dict, list[str], dict]] = {
        "vision_encoder": (
            VisionEncoder(model),
            {"pixel_values": normal(1, 3, side, side)},
            ["feats0", "feats1", "feats2", "feats2_no_mem", "vision_pos_embed"],
            {},
        ),
        "mask_decoder": (
            MaskDecoder(model),
            decoder_inputs | points(1),
            ["low_res_mask", "high_res_mask", "iou", "object_score_logits", "object_pointer"],
            {
                "free": {"input_points": {2: "points"}, "input_labels": {2: "points"}},
                "other": decoder_inputs | points(3),
            },
        ),
        "memory_encoder": (
            MemoryEncoder(model),
            image | {"high_res_mask": 10 * normal(1, 1, side, side).sign()} | score,
            ["memory_tokens", "memory_pos"],
            {},
        ),
        "memory_attention": (
            MemoryAttention(model, grid),
            current | memories,
            ["conditioned_feats"],
            {"reference": lambda given: [_attended(model, grid, *given.values(), POINTERS * channels // memory)]},
        ),
        "pointer_tpos": (
            PointerCodes(model),
            {"normalized_diffs": torch.linspace(0, 1, 3)},
            ["pointer_pos"],
            {
                "free": {"normalized_diffs": {0: "pointers"}, "pointer_pos": {0: "pointers"}},
                "other": {"normalized_diffs": torch.linspace(0, 1, POINTERS)},
            },
        ),
    }
    agreements = [
        write_graph(folder / "onnx" / f"{name}.onnx", module, inputs, outputs, **options)
        for name, (module, inputs, outputs, options) in parts.items()
    ]
    codes = model.maskmem_tpos_enc.detach().numpy().reshape(SLOTS, memory).tolist()
    constants = {
        "image_size": side,
        "image_mean": [0.485, 0.456, 0.406],
        "image_std": [0.229, 0.224, 0.225],
        "memory_temporal_positional_encoding": codes,
    }
    write_text(folder / "constants.json", json.dumps(constants) + "\n")
    modules = {name: (part[0], list(part[1]), part[2]) for name, part in parts.items()}
    tracked, tracking = _tracked(model, modules, folder)
    return {"graphs": [dataclasses.asdict(row) for row in (*agreements, tracked)], "tracking": tracking}


class VisionEncoder(Wrapped):
    """Image to features at three scales, and the coarsest as a prompted frame's."""

    def forward(self, pixel_values):
        output = self.model.forward_image(pixel_values)
        first, second, third = output["backbone_fpn"]
        without_memory = third + self.model.no_mem_embed.reshape(1, -1, 1, 1)
        return first, second, third, without_memory, output["vision_pos_enc"][-1]


class MaskDecoder(Wrapped):
    """Points to the best of three masks, and the object pointer."""

    def forward(self, feats0, feats1, feats2_cond, input_points, input_labels):
        _, _, scores, low, high, pointer, present = self.model._forward_sam_heads(
            backbone_features=feats2_cond,
            point_inputs={"point_coords": input_points[0], "point_labels": input_labels[0]},
            high_res_features=[feats0, feats1],
            multimask_output=True,
        )
        return low, high, scores.max(-1, keepdim=True).values, present[None], pointer[None]


class MemoryEncoder(Wrapped):
    """The features and the mask of a frame to memory tokens and their spatial code."""

    def forward(self, feats2, high_res_mask, object_score_logits, binarize):
        model = self.model
        hard = (high_res_mask > 0).float()
        mask = torch.where(binarize > 0.5, hard, torch.sigmoid(high_res_mask))
        mask = mask * model.sigmoid_scale_for_mem_enc + model.sigmoid_bias_for_mem_enc
        output = model.memory_encoder(feats2, mask, skip_mask_sigmoid=True)
        features, position = output["vision_features"], output["vision_pos_enc"][0]
        absent = (object_score_logits <= 0).float().reshape(1, 1, 1, 1)
        features = features + absent * model.no_obj_embed_spatial.reshape(1, -1, 1, 1)
        return features.flatten(2).permute(2, 0, 1), position.flatten(2).permute(2, 0, 1)


class PointerCodes(Wrapped):
    """Distances of object pointers in time to their codes."""

    def forward(self, normalized_diffs):
        from sam2.modeling.sam2_utils import get_1d_sine_pe

        return self.model.obj_ptr_tpos_proj(get_1d_sine_pe(normalized_diffs, dim=self.model.hidden_dim))


class MemoryAttention(torch.nn.Module):
    """The package's memory attention with its rotation in real numbers, which ONNX lacks complex ones for.

    Attention goes over the queries in blocks, which changes its memory and not its result.
    """

    def __init__(self, model: Any, grid: int):
        super().__init__()
        self.layers, self.norm = model.memory_attention.layers, model.memory_attention.norm
        self.grid, self.pointers = grid, POINTERS * model.hidden_dim // model.mem_dim
        turns = self.layers[0].self_attn.compute_cis(end_x=grid, end_y=grid)
        self.register_buffer("cosine", turns.real.contiguous())
        self.register_buffer("sine", turns.imag.contiguous())

    def forward(self, current_vision_features, current_vision_position_embeddings, memory, memory_pos):
        values, keys = memory[:, 0], (memory + memory_pos)[:, 0]
        x = (current_vision_features + 0.1 * current_vision_position_embeddings)[:, 0]
        for layer in self.layers:
            own, other = layer.self_attn, layer.cross_attn_image
            y = layer.norm1(x)
            x = x + self._attend(own, self._turn(own.q_proj(y)), self._turn(own.k_proj(y)), own.v_proj(y))
            rotated = other.k_proj(keys)
            rotated = torch.cat([self._turn(rotated[: -self.pointers]), rotated[-self.pointers :]])
            x = x + self._attend(other, self._turn(other.q_proj(layer.norm2(x))), rotated, other.v_proj(values))
            x = x + layer.linear2(layer.activation(layer.linear1(layer.norm3(x))))
        return self.norm(x).T.reshape(1, -1, self.grid, self.grid)

    def _turn(self, x):
        pairs = x.reshape(-1, self.cosine.shape[0], self.cosine.shape[1], 2)
        first, second = pairs[..., 0], pairs[..., 1]
        turned = (first * self.cosine - second * self.sine, first * self.sine + second * self.cosine)
        return torch.stack(turned, -1).reshape(-1, 2 * self.cosine.shape[1])

    def _attend(self, module, queries, keys, values):
        queries = queries * queries.shape[-1] ** -0.5
        blocks = [torch.softmax(block @ keys.T, -1) @ values for block in queries.split(QUERIES)]
        return module.out_proj(torch.cat(blocks))


def _attended(model: Any, grid: int, current, current_pos, memory, memory_pos, pointers: int) -> torch.Tensor:
    """The package's own memory attention."""
    inputs = {"curr": current, "curr_pos": current_pos, "memory": memory, "memory_pos": memory_pos}
    tokens = model.memory_attention(**inputs, num_obj_ptr_tokens=pointers)
    return tokens[:, 0].T.reshape(1, -1, grid, grid)


class DistinctMemories(torch.nn.Module):
    """The package's own memory attention, over the memories and pointers without the repeats that fill them up."""

    def __init__(self, model: Any, grid: int):
        super().__init__()
        self.model, self.grid = model, grid

    def forward(self, current_vision_features, current_vision_position_embeddings, memory, memory_pos):
        split = SLOTS * self.grid**2
        rows = torch.cat([memory, memory_pos], -1)
        spatial = _distinct(rows[:split], self.grid**2)
        pointers = _distinct(rows[split:], self.model.hidden_dim // self.model.mem_dim)
        values, codes = torch.cat([spatial, pointers]).chunk(2, -1)
        current = current_vision_features, current_vision_position_embeddings
        return _attended(self.model, self.grid, *current, values, codes, len(pointers))


def _distinct(rows: torch.Tensor, size: int) -> torch.Tensor:
    """Leaves out the blocks of `size` rows that repeat an earlier one."""
    blocks = rows.split(size)
    return torch.cat([b for n, b in enumerate(blocks) if not any(torch.equal(b, other) for other in blocks[:n])])


class _TorchGraph:
    """Runs a module as `Graph.run` runs its export."""

    def __init__(self, module: torch.nn.Module, inputs: list[str], outputs: list[str]):
        self._module, self._inputs, self._outputs = module.eval(), inputs, outputs

    def run(self, feeds: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        with torch.inference_mode():
            arrays = self._module(*(torch.from_numpy(np.ascontiguousarray(feeds[name])) for name in self._inputs))
        arrays = [arrays] if isinstance(arrays, torch.Tensor) else arrays
        return {name: array.numpy() for name, array in zip(self._outputs, arrays, strict=True)}


def _tracked(model: Any, modules: dict[str, tuple], folder: Path, *, count: int = 4) -> tuple[Agreement, dict]:
    """Tracks a disc from a point by ONNX Runtime, by the same steps in PyTorch, and by the package's predictor.

    The predictor attends to the memories that there are, the export to a fixed number. So the steps are also compared
    with the predictor without the repeats.
    """
    frames, point = _moving_disc(count)
    prompt = point, np.array([1], np.int32)
    opened = _open_sam2(folder)
    in_torch = _Sam2Graphs(
        {name: _TorchGraph(*parts) for name, parts in modules.items()}, opened.constants, opened.sizes
    )
    attention = (DistinctMemories(model, opened.sizes["G"]), *modules["memory_attention"][1:])
    without_repeats = {**in_torch.graphs, "memory_attention": _TorchGraph(*attention)}
    distinct = _Sam2Graphs(without_repeats, opened.constants, opened.sizes)
    logits, seconds = {}, {}
    for name, graphs in (("onnxruntime", opened), ("torch", in_torch), ("distinct", distinct)):
        started = time.perf_counter()
        tracked = dict(follow(graphs, frames, 0, [prompt]))
        logits[name] = np.stack([cv2.resize(tracked[t][0], frames.shape[2:0:-1]) for t in range(count)])
        seconds[name] = time.perf_counter() - started
    logits["predictor"] = _by_predictor(model, frames, point)

    def same(one, other):
        return ((logits[one] > 0) == (logits[other] > 0)).mean((1, 2)).tolist()

    agreement = Agreement(
        f"{count} frames by follow",
        {"logits": float(np.abs(logits["onnxruntime"] - logits["torch"]).max())},
        {"logits": float(np.abs(logits["torch"]).max())},
        {"logits": min(same("onnxruntime", "torch"))},
        0.0,
    )
    return agreement, {
        "frames": count,
        "same_pixels_as_predictor": same("onnxruntime", "predictor"),
        "same_pixels_as_predictor_without_repeats": same("distinct", "predictor"),
        "share_of_foreground": float((logits["onnxruntime"] > 0).mean()),
        "seconds_a_frame": seconds["onnxruntime"] / count,
    }


def _by_predictor(model: Any, frames: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Logits (T, H, W) by the package's own video predictor."""
    logits = np.zeros(frames.shape[:3], np.float32)
    with tempfile.TemporaryDirectory() as folder, torch.inference_mode():
        for t, frame in enumerate(frames):  # PNG bytes under the one name that it reads: nothing is lost
            written = cv2.imencode(".png", cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))[1]
            (Path(folder) / f"{t:05d}.jpg").write_bytes(written.tobytes())
        state = model.init_state(folder)
        model.add_new_points_or_box(state, 0, 0, points=point, labels=np.array([1], np.int32))
        for t, _, found in model.propagate_in_video(state):
            logits[t] = found[0, 0].numpy()
    return logits


def _moving_disc(count: int, size: tuple[int, int] = (180, 240)) -> tuple[np.ndarray, np.ndarray]:
    """Frames (T, H, W, 3) of a disc that crosses a patterned wall, and a point (1, 2) in it in the first."""
    height, width = size
    rng = np.random.default_rng(0)
    wall = cv2.resize(rng.integers(0, 256, (9, 12, 3), dtype=np.uint8), (width, height), interpolation=cv2.INTER_CUBIC)
    frames = np.repeat(wall[None], count, 0)
    for t, frame in enumerate(frames):
        cv2.circle(frame, (80 + 6 * t, 90), height // 7, (230, 40, 30), -1)
    return frames, np.array([[80.0, 90.0]], np.float32)
