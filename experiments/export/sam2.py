"""SAM 2's video networks as ONNX graphs, in the split of axinc-ai/segment-anything-2 that
jsecon.networks.sam2.graphs reads."""

from pathlib import Path

import numpy as np
import torch

from experiments.export.graph import Agreement, declare_missing_operators, shake, write_graph
from jsecon.files import atomic_write

QUERIES = 1024
"""rows of an attention matrix at a time: 4,096 at once would take 0.5 GiB a layer with a full bank"""

STRETCH = 30.0
"""of random mask logits and object scores: those of an untrained decoder stay within 0.5 and 0.1"""
CENTRE = 4.22
"""less the random object score, stretched, of sam2.1_hiera_t at seed 0 (3.8 to 4.0; 4.6 in the dark): an object is
present in the light and absent in the dark"""


def official(config: str, weights: Path | None, *, seed: int) -> torch.nn.Module:
    """The package's own video predictor, on the CPU; without weights, random ones in every parameter.

    Holes are not filled in it: that operator exists for CUDA only. With random weights the last layers are stretched to
    logits of the size that a trained model has.
    """
    declare_missing_operators()
    from sam2.build_sam import build_sam2_video_predictor

    torch.manual_seed(seed)
    folder = "sam2.1" if config.startswith("sam2.1") else "sam2"
    model = build_sam2_video_predictor(
        f"configs/{folder}/{config}.yaml",
        None if weights is None else str(weights),
        device="cpu",
        hydra_overrides_extra=["++model.fill_hole_area=0"],
    )
    model.fill_hole_area = 0
    if weights is None:
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


def export(model: torch.nn.Module, folder: Path, *, seed: int, threads: int) -> list[Agreement]:
    """Writes the networks and constants into `folder`; each network is compared with the package's own modules."""
    generator = torch.Generator().manual_seed(seed)
    normal = lambda *shape: torch.randn(shape, generator=generator)
    size, channels, memory_channels = model.image_size, model.hidden_dim, model.mem_dim
    grid = size // 16
    low, tokens = 4 * grid, grid * grid
    rows = [
        write_graph(
            folder / "image_encoder.onnx",
            ImageEncoder(model),
            {"input_image": normal(1, 3, size, size)},
            ["backbone_fpn_0", "backbone_fpn_1", "backbone_fpn_2", "vision_pos_enc_2"],
            threads=threads,
        )
    ]
    one = {
        "coords": size * torch.rand(1, 1, 2, generator=generator),
        "labels": torch.tensor([[1]], dtype=torch.int32),
        "masks": normal(1, low, low),
        "masks_enable": torch.tensor([1], dtype=torch.int32),
    }
    many = one | {
        "coords": size * torch.rand(1, 5, 2, generator=generator),
        "labels": torch.tensor([[2, 3, 1, 0, -1]], dtype=torch.int32),
        "masks_enable": torch.tensor([0], dtype=torch.int32),
    }
    rows.append(
        write_graph(
            folder / "prompt_encoder.onnx",
            PromptEncoder(model),
            one,
            ["sparse_embeddings", "dense_embeddings", "dense_pe"],
            free={"coords": {1: "points"}, "labels": {1: "points"}, "sparse_embeddings": {1: "tokens"}},
            other=many,
            reference=lambda given: _prompt_reference(model, given),
            threads=threads,
        )
    )
    rows.append(
        write_graph(
            folder / "mask_decoder.onnx",
            MaskDecoder(model),
            {
                "image_embeddings": normal(1, channels, grid, grid),
                "image_pe": normal(1, channels, grid, grid),
                "sparse_prompt_embeddings": normal(1, 2, channels),
                "dense_prompt_embeddings": normal(1, channels, grid, grid),
                "high_res_features1": normal(1, channels // 8, low, low),
                "high_res_features2": normal(1, channels // 4, low // 2, low // 2),
            },
            ["masks", "iou_pred", "sam_tokens_out", "object_score_logits"],
            free={"sparse_prompt_embeddings": {1: "tokens"}},
            threads=threads,
        )
    )
    rows.append(
        write_graph(
            folder / "mlp.onnx", model.obj_ptr_proj, {"x": normal(1, channels)}, ["x_out"], free=_RUN, threads=threads
        )
    )
    seen = lambda frames, known: {
        "curr": normal(tokens, 1, channels),
        "memory_1": normal(frames * tokens, 1, memory_channels),
        "memory_2": normal(known, 1, memory_channels),
        "curr_pos": normal(tokens, 1, channels),
        "memory_pos_1": normal(frames * tokens, 1, memory_channels),
        "memory_pos_2": normal(known, 1, memory_channels),
    }
    spatial, named = {0: "spatial"}, {0: "pointers"}
    rows.append(
        write_graph(
            folder / "memory_attention.onnx",
            MemoryAttention(model.memory_attention, grid),
            seen(2, 8),
            ["pix_feat"],
            free={"memory_1": spatial, "memory_pos_1": spatial, "memory_2": named, "memory_pos_2": named},
            other=seen(3, 20),
            reference=lambda given: _attention_reference(model, given),
            threads=threads,
        )
    )
    rows.append(
        write_graph(
            folder / "memory_encoder.onnx",
            MemoryEncoder(model),
            {"pix_feat": normal(1, channels, grid, grid), "masks": 10 * normal(1, 1, size, size).sign()},
            ["vision_features", "vision_pos_enc"],
            threads=threads,
        )
    )
    if model.proj_tpos_enc_in_obj_ptrs:
        rows.append(
            write_graph(
                folder / "obj_ptr_tpos_proj.onnx",
                model.obj_ptr_tpos_proj,
                {"x": normal(3, channels)},
                ["x_out"],
                free=_RUN,
                other={"x": normal(16, channels)},
                threads=threads,
            )
        )
    _write_constants(model, folder / "constants.npz")
    return rows


_RUN = {"x": {0: "run"}, "x_out": {0: "run"}}


def _write_constants(model: torch.nn.Module, path: Path) -> None:
    arrays = {
        "no_mem_embed": model.no_mem_embed,
        "no_obj_ptr": model.no_obj_ptr,
        "maskmem_tpos_enc": model.maskmem_tpos_enc,
        "mask_downsample_weight": model.mask_downsample.weight,
        "mask_downsample_bias": model.mask_downsample.bias,
    }
    if model.no_obj_embed_spatial is not None:
        arrays["no_obj_embed_spatial"] = model.no_obj_embed_spatial
    with atomic_write(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, **{name: tensor.detach().numpy() for name, tensor in arrays.items()})


class ImageEncoder(torch.nn.Module):
    """Image to the three feature maps that the decoder and the memory use, and the position code of the last."""

    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, image):
        found = self.model.forward_image(image)
        return *found["backbone_fpn"], found["vision_pos_enc"][-1]


class PromptEncoder(torch.nn.Module):
    """Points and a mask to embeddings; `masks_enable` 0 means no mask."""

    def __init__(self, model):
        super().__init__()
        self.encoder = model.sam_prompt_encoder

    def forward(self, coords, labels, masks, masks_enable):
        sparse, without = self.encoder(points=(coords, labels), boxes=None, masks=None)
        given = self.encoder._embed_masks(masks[:, None])
        dense = torch.where(masks_enable.reshape(1, 1, 1, 1) > 0, given, without)
        return sparse, dense, self.encoder.get_dense_pe()


class MaskDecoder(torch.nn.Module):
    """All four masks with their scores and tokens; which one counts is the caller's choice."""

    def __init__(self, model):
        super().__init__()
        self.decoder = model.sam_mask_decoder

    def forward(self, image, image_pe, sparse, dense, fine0, fine1):
        return self.decoder.predict_masks(
            image_embeddings=image,
            image_pe=image_pe,
            sparse_prompt_embeddings=sparse,
            dense_prompt_embeddings=dense,
            repeat_image=False,
            high_res_features=[fine0, fine1],
        )


class MemoryEncoder(torch.nn.Module):
    """The frame's features and the mask, already scaled to -10..10, to a memory and its position code."""

    def __init__(self, model):
        super().__init__()
        self.encoder = model.memory_encoder

    def forward(self, pix_feat, masks):
        found = self.encoder(pix_feat, masks, skip_mask_sigmoid=True)
        return found["vision_features"], found["vision_pos_enc"][0]


class MemoryAttention(torch.nn.Module):
    """The package's memory attention with its rotation in real numbers (ONNX has no complex ones).

    Spatial memories and pointers come apart, since only the former are rotated; attention goes over the queries in
    blocks, which changes its memory and not its result.
    """

    def __init__(self, attention, grid: int):
        super().__init__()
        self.layers, self.norm = attention.layers, attention.norm
        turns = self.layers[0].self_attn.compute_cis(end_x=grid, end_y=grid)
        self.register_buffer("cosine", turns.real.contiguous())
        self.register_buffer("sine", turns.imag.contiguous())

    def forward(self, curr, memory_1, memory_2, curr_pos, memory_pos_1, memory_pos_2):
        values = torch.cat([memory_1, memory_2])[:, 0]
        keys_1, keys_2 = (memory_1 + memory_pos_1)[:, 0], (memory_2 + memory_pos_2)[:, 0]
        x = (curr + 0.1 * curr_pos)[:, 0]
        for layer in self.layers:
            own, other = layer.self_attn, layer.cross_attn_image
            y = layer.norm1(x)
            x = x + self._attend(own, self._turn(own.q_proj(y)), self._turn(own.k_proj(y)), own.v_proj(y))
            keys = torch.cat([self._turn(other.k_proj(keys_1)), other.k_proj(keys_2)])
            queries = self._turn(other.q_proj(layer.norm2(x)))
            x = x + self._attend(other, queries, keys, other.v_proj(values))
            x = x + layer.linear2(layer.activation(layer.linear1(layer.norm3(x))))
        return self.norm(x)[:, None]

    def _turn(self, x):
        pairs = x.reshape(-1, self.cosine.shape[0], self.cosine.shape[1], 2)
        first, second = pairs[..., 0], pairs[..., 1]
        turned = (first * self.cosine - second * self.sine, first * self.sine + second * self.cosine)
        return torch.stack(turned, -1).reshape(-1, 2 * self.cosine.shape[1])

    def _attend(self, module, queries, keys, values):
        queries = queries * queries.shape[-1] ** -0.5
        blocks = [torch.softmax(block @ keys.T, -1) @ values for block in queries.split(QUERIES)]
        return module.out_proj(torch.cat(blocks))


def _prompt_reference(model, given):
    encoder = model.sam_prompt_encoder
    masks = given["masks"][:, None] if int(given["masks_enable"]) else None
    sparse, dense = encoder(points=(given["coords"], given["labels"]), boxes=None, masks=masks)
    return [sparse, dense, encoder.get_dense_pe()]


def _attention_reference(model, given):
    return [
        model.memory_attention(
            curr=given["curr"],
            curr_pos=given["curr_pos"],
            memory=torch.cat([given["memory_1"], given["memory_2"]]),
            memory_pos=torch.cat([given["memory_pos_1"], given["memory_pos_2"]]),
            num_obj_ptr_tokens=len(given["memory_2"]),
        )
    ]
