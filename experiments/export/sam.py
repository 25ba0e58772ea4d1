"""SAM's image encoder and mask decoder as ONNX graphs of the layout of transformers.js, for many prompts at once."""

from pathlib import Path
from unittest import mock

import torch

from experiments.export.graph import Agreement, declare_missing_operators, shake, write_graph

STRETCH = 30.0
"""of random mask logits, which an untrained decoder keeps near 0"""


def official(kind: str, weights: Path | None, *, seed: int) -> torch.nn.Module:
    """segment_anything's model (vit_b, vit_l, vit_h, or slimsam: vit_b pruned to the sizes of slimsam-77-uniform);
    without weights, random ones in every parameter."""
    declare_missing_operators()
    from segment_anything import sam_model_registry

    torch.manual_seed(seed)
    model = sam_model_registry["vit_b" if kind == "slimsam" else kind](
        checkpoint=None if weights is None else str(weights)
    )
    if kind == "slimsam":
        model.image_encoder = slim_encoder()
    if weights is None:
        make_random(model, seed)
    return model.eval().requires_grad_(False)


def slim_encoder() -> torch.nn.Module:
    """The image encoder of slimsam-77-uniform."""
    from functools import partial

    from segment_anything.modeling import ImageEncoderViT

    width, hidden = 168, 696
    return ImageEncoderViT(
        embed_dim=width,
        depth=12,
        num_heads=12,
        mlp_ratio=hidden / width,
        norm_layer=partial(torch.nn.LayerNorm, eps=1e-6),
        use_rel_pos=True,
        window_size=14,
        global_attn_indexes=[2, 5, 8, 11],
        out_chans=256,
    )


def make_random(model: torch.nn.Module, seed: int) -> None:
    """Random numbers in every parameter, mask logits stretched."""
    shake(model, seed)
    with torch.no_grad():
        for head in model.mask_decoder.output_hypernetworks_mlps:
            head.layers[-1].weight *= STRETCH
            head.layers[-1].bias *= STRETCH


def export(model: torch.nn.Module, folder: Path, *, seed: int, threads: int) -> list[Agreement]:
    """Writes onnx/vision_encoder.onnx and onnx/prompt_encoder_mask_decoder.onnx into `folder`, and compares both.

    The decoder is compared on the features of a random image and 7 prompts, with the package's prompt encoder and mask
    decoder.
    """
    generator = torch.Generator().manual_seed(seed)
    side = model.image_encoder.img_size
    image = torch.randn(1, 3, side, side, generator=generator)
    outputs = ["image_embeddings", "image_positional_embeddings"]
    rows = [
        write_graph(
            folder / "onnx" / "vision_encoder.onnx", Encoder(model), {"pixel_values": image}, outputs, threads=threads
        )
    ]
    with torch.inference_mode():
        features = dict(zip(outputs, Encoder(model)(image)))

    def prompts(batch: int) -> dict[str, torch.Tensor]:
        points = side * torch.rand(1, batch, 1, 2, generator=generator)
        return features | {"input_points": points, "input_labels": torch.ones(1, batch, 1, dtype=torch.int64)}

    with mock.patch("torch.repeat_interleave", _expanded):
        rows.append(
            write_graph(
                folder / "onnx" / "prompt_encoder_mask_decoder.onnx",
                Decoder(model),
                prompts(3),
                ["iou_scores", "pred_masks"],
                free={
                    "input_points": {1: "prompts", 2: "points"},
                    "input_labels": {1: "prompts", 2: "points"},
                    "iou_scores": {1: "prompts"},
                    "pred_masks": {1: "prompts"},
                },
                other=prompts(7),
                reference=lambda given: _masks_and_scores(model, given),
                threads=threads,
            )
        )
    return rows


class Encoder(torch.nn.Module):
    """Image to its features and the code of their places."""

    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, pixel_values):
        return self.model.image_encoder(pixel_values), self.model.prompt_encoder.get_dense_pe()


class Decoder(torch.nn.Module):
    """Points (1, B, P) on one image to three masks and scores each, at a quarter of the network's image."""

    def __init__(self, model):
        super().__init__()
        from segment_anything.utils.onnx import SamOnnxModel

        self.stock = SamOnnxModel(model, return_single_mask=False)

    def forward(self, image_embeddings, image_positional_embeddings, input_points, input_labels):
        points, labels = input_points[0], input_labels[0].to(torch.float32)
        points = torch.cat([points, torch.zeros_like(points[:, :1])], 1)  # the point that ends a prompt without a box
        labels = torch.cat([labels, -torch.ones_like(labels[:, :1])], 1)
        side = self.stock.model.image_encoder.img_size // 4
        masks, scores = self.stock.mask_decoder.predict_masks(
            image_embeddings=image_embeddings,
            image_pe=image_positional_embeddings,
            sparse_prompt_embeddings=self.stock._embed_points(points, labels),
            dense_prompt_embeddings=self.stock._embed_masks(torch.zeros(1, 1, side, side), torch.zeros(1)),
        )
        return scores[None, :, 1:], masks[None, :, 1:]


def _expanded(tensor: torch.Tensor, repeats: int, dim: int) -> torch.Tensor:
    """repeat_interleave of one row; the package's own traces to a fixed batch."""
    assert (dim, tensor.shape[0]) == (0, 1)
    return tensor.expand(repeats, *tensor.shape[1:])


def _masks_and_scores(model, given) -> list[torch.Tensor]:
    """The package's modules on the same prompts; they add the padding point themselves."""
    sparse, dense = model.prompt_encoder(
        points=(given["input_points"][0], given["input_labels"][0]), boxes=None, masks=None
    )
    masks, scores = model.mask_decoder.predict_masks(
        image_embeddings=given["image_embeddings"],
        image_pe=given["image_positional_embeddings"],
        sparse_prompt_embeddings=sparse,
        dense_prompt_embeddings=dense,
    )
    return [scores[None, :, 1:], masks[None, :, 1:]]
