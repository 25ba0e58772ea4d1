"""SAM's image encoder and two decoders as ONNX graphs: the package's own (one prompt) and one for many prompts."""

from pathlib import Path
from unittest import mock

import torch
import torch.nn.functional as F

from experiments.export.graph import Agreement, declare_missing_operators, shake, write_graph

STRETCH = 30.0
"""of random mask logits, which an untrained decoder keeps near 0"""


def official(kind: str, weights: Path | None, *, seed: int) -> torch.nn.Module:
    """segment_anything's model (vit_b, vit_l, vit_h); without weights, random ones in every parameter."""
    declare_missing_operators()
    from segment_anything import sam_model_registry

    torch.manual_seed(seed)
    model = sam_model_registry[kind](checkpoint=None if weights is None else str(weights))
    if weights is None:
        make_random(model, seed)
    return model.eval().requires_grad_(False)


def make_random(model: torch.nn.Module, seed: int) -> None:
    """Random numbers in every parameter, mask logits stretched."""
    shake(model, seed)
    with torch.no_grad():
        for head in model.mask_decoder.output_hypernetworks_mlps:
            head.layers[-1].weight *= STRETCH
            head.layers[-1].bias *= STRETCH


def export(model: torch.nn.Module, folder: Path, *, seed: int, threads: int) -> list[Agreement]:
    """Writes encoder.onnx, mask_decoder.onnx (many prompts) and decoder.onnx (stock) into `folder`; each is compared.

    The decoders are compared on the features of a random image: the stock one against the package's own module, the
    other on 7 prompts against its prompt encoder and mask decoder. jsecon.networks.sam.segmenter takes the latter where
    both are.
    """
    from segment_anything.utils.onnx import SamOnnxModel

    generator = torch.Generator().manual_seed(seed)
    side = model.image_encoder.img_size
    image = torch.randn(1, 3, side, side, generator=generator)
    rows = [
        write_graph(
            folder / "encoder.onnx", model.image_encoder, {"input_image": image}, ["image_embeddings"], threads=threads
        )
    ]
    with torch.inference_mode():
        features = model.image_encoder(image)

    def prompts(batch: int, points: int) -> dict[str, torch.Tensor]:
        labels = torch.ones(batch, points)
        labels[:, -1] = -1
        return {
            "image_embeddings": features,
            "point_coords": side * torch.rand(batch, points, 2, generator=generator),
            "point_labels": labels,
            "mask_input": torch.zeros(1, 1, side // 4, side // 4),
            "has_mask_input": torch.zeros(1),
        }

    graph, eager = (SamOnnxModel(model, return_single_mask=False) for _ in range(2))
    graph.mask_postprocessing = lambda masks, size: _at_frame(graph, masks, size)
    stock = prompts(1, 2) | {"orig_im_size": torch.tensor([300.0, 400.0])}
    rows.append(
        write_graph(
            folder / "decoder.onnx",
            graph,
            stock,
            ["masks", "iou_predictions", "low_res_masks"],
            free={"point_coords": {1: "points"}, "point_labels": {1: "points"}},
            other=prompts(1, 3) | {"orig_im_size": torch.tensor([240.0, 135.0])},
            reference=lambda given: eager(*given.values()),
            threads=threads,
        )
    )
    with mock.patch("torch.repeat_interleave", _expanded):
        rows.append(
            write_graph(
                folder / "mask_decoder.onnx",
                BatchedDecoder(model),
                prompts(3, 2),
                ["iou_predictions", "low_res_masks"],
                free={
                    "point_coords": {0: "prompts", 1: "points"},
                    "point_labels": {0: "prompts", 1: "points"},
                    "iou_predictions": {0: "prompts"},
                    "low_res_masks": {0: "prompts"},
                },
                other=prompts(7, 2),
                reference=lambda given: _masks_and_scores(model, given),
                threads=threads,
            )
        )
    return rows


class BatchedDecoder(torch.nn.Module):
    """Prompts (B, P) on one image to four masks and scores each, at a quarter of the network's image."""

    def __init__(self, model):
        super().__init__()
        from segment_anything.utils.onnx import SamOnnxModel

        self.stock = SamOnnxModel(model, return_single_mask=False)

    def forward(self, image_embeddings, point_coords, point_labels, mask_input, has_mask_input):
        masks, scores = self.stock.mask_decoder.predict_masks(
            image_embeddings=image_embeddings,
            image_pe=self.stock.model.prompt_encoder.get_dense_pe(),
            sparse_prompt_embeddings=self.stock._embed_points(point_coords, point_labels),
            dense_prompt_embeddings=self.stock._embed_masks(mask_input, has_mask_input),
        )
        return scores, masks


def _at_frame(module, masks: torch.Tensor, size: torch.Tensor) -> torch.Tensor:
    """Mask logits at the frame's size, its shape an input: segment-anything 1.0 on PyPI turns it into Python numbers,
    which a trace keeps as they were."""
    side = module.img_size
    whole = F.interpolate(masks, size=(side, side), mode="bilinear", align_corners=False)
    inside = module.resize_longest_image_size(size, side)
    height, width = size.to(torch.int64)
    whole = whole[..., : inside[0], : inside[1]]
    return F.interpolate(whole, size=(height, width), mode="bilinear", align_corners=False)


def _expanded(tensor: torch.Tensor, repeats: int, dim: int) -> torch.Tensor:
    """repeat_interleave of one row; the package's own traces to a fixed batch."""
    assert (dim, tensor.shape[0]) == (0, 1)
    return tensor.expand(repeats, *tensor.shape[1:])


def _masks_and_scores(model, given) -> list[torch.Tensor]:
    """The package's modules on the same prompts; they add the padding point themselves."""
    points = (given["point_coords"][:, :-1], given["point_labels"][:, :-1])
    sparse, dense = model.prompt_encoder(points=points, boxes=None, masks=None)
    masks, scores = model.mask_decoder.predict_masks(
        image_embeddings=given["image_embeddings"],
        image_pe=model.prompt_encoder.get_dense_pe(),
        sparse_prompt_embeddings=sparse,
        dense_prompt_embeddings=dense,
    )
    return [scores, masks]
