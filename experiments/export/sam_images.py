"""SAM 2.1 and EdgeTAM on single images as transformers has them, in the layout of onnx-community's folders.

Names, shapes and colours are theirs. How their exporter joins points and boxes is not published, so that this decoder
takes points alone, and `input_boxes` without any.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from experiments.export.embedder import regions
from experiments.export.graph import STRETCH, Agreement, Wrapped, declare_missing_operators, shake, write_graph
from jsecon.files import write_text
from jsecon.networks.hub import find_files
from jsecon.networks.sam import _SamGraphs

FEATURES = ["image_embeddings.0", "image_embeddings.1", "image_embeddings.2"]
POINTS = np.array([[40, 40], [120, 60], [60, 95], [3, 110]], np.float32)
MEAN, STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]


def official(name: str, seed: int) -> torch.nn.Module:
    """transformers' model of that name (sam2.1-hiera-tiny, edgetam) with random weights; mask logits stretched."""
    declare_missing_operators()
    import transformers

    torch.manual_seed(seed)
    if name == "edgetam":
        model = transformers.EdgeTamModel(_edgetam_config())
    else:
        model = transformers.Sam2Model(transformers.Sam2Config())  # its defaults are hiera-tiny
    shake(model, seed)
    with torch.no_grad():
        for head in model.mask_decoder.output_hypernetworks_mlps:
            head.proj_out.weight *= STRETCH
            head.proj_out.bias *= STRETCH
    return model.eval().requires_grad_(False)


def _edgetam_config() -> Any:
    """transformers' defaults for EdgeTAM, without the request for the backbone's configuration."""
    from transformers import EdgeTamConfig, EdgeTamVisionConfig, TimmWrapperConfig

    stages = {"in_chans": 3, "features_only": True, "out_indices": [0, 1, 2, 3]}
    backbone = TimmWrapperConfig(architecture="repvit_m1", model_args=stages)
    return EdgeTamConfig(vision_config=EdgeTamVisionConfig(backbone_config=backbone))


def export(model: Any, folder: Path, *, seed: int) -> dict:
    """Writes the folder; compares its graphs, and the masks that jsecon asks of them for points of a frame with those
    of the model."""
    side, onnx = model.prompt_encoder.input_image_size, folder / "onnx"
    image = torch.randn(1, 3, side, side, generator=torch.Generator().manual_seed(seed))
    rows = [write_graph(onnx / "vision_encoder.onnx", Encoder(model), {"pixel_values": image}, FEATURES)]
    with torch.inference_mode():
        features = dict(zip(FEATURES, model.get_image_embeddings(image)))
    points = torch.from_numpy(POINTS)[None, :, None] * 4

    def given(count: int) -> dict[str, torch.Tensor]:
        own = points[:, -1:, :1].expand(1, 1, count, 2).contiguous()
        labels = torch.ones(1, 1, count, dtype=torch.int64)
        return {"input_points": own, "input_labels": labels, "input_boxes": torch.zeros(1, 0, 4)} | features

    outputs = ["iou_scores", "pred_masks", "object_score_logits"]
    free = {"input_points": {1: "prompts", 2: "points"}, "input_labels": {1: "prompts", 2: "points"}}
    free |= {"input_boxes": {1: "boxes"}} | {name: {1: "prompts"} for name in outputs}
    decoder = onnx / "prompt_encoder_mask_decoder.onnx"
    rows.append(write_graph(decoder, Decoder(model), given(2), outputs, free=free, other=given(1)))
    told: dict[str, Any] = {
        "do_normalize": True,
        "do_rescale": True,
        "rescale_factor": 1 / 255,
        "image_mean": MEAN,
        "image_std": STD,
    }
    told |= {"size": {"height": side, "width": side}}
    write_text(folder / "preprocessor_config.json", json.dumps(told, indent=2) + "\n")
    return {"graphs": [dataclasses.asdict(row) for row in (*rows, _asked(model, folder, side))]}


class Encoder(Wrapped):
    """Image to the three feature maps that the decoder takes."""

    def forward(self, pixel_values):
        return tuple(self.model.get_image_embeddings(pixel_values))


class Decoder(Wrapped):
    """Points to three masks."""

    def forward(self, input_points, input_labels, input_boxes, first, second, third):
        found = self.model(
            input_points=input_points + 0 * input_boxes.sum(),  # keeps the input, of which none is given
            input_labels=input_labels,
            image_embeddings=[first, second, third],
            multimask_output=True,
        )
        return found.iou_scores, found.pred_masks, found.object_score_logits


def _asked(model: Any, folder: Path, side: int) -> Agreement:
    """Points of a frame put to the folder as SAM's proposals put them, and to the model."""
    frame = regions()[0]
    graphs = _SamGraphs(*find_files(folder, "segmenter"))
    encoded = graphs.encode(frame)
    found = [graphs.decode(encoded, point) for point in POINTS]
    pixels = np.asarray(Image.fromarray(frame).resize((side, side), Image.Resampling.BILINEAR), np.float64) / 255
    image = torch.from_numpy(((pixels - MEAN) / STD).astype(np.float32)).permute(2, 0, 1)[None]
    scale = torch.tensor([side / frame.shape[1], side / frame.shape[0]])
    points = torch.from_numpy(POINTS)[None, :, None] * scale
    with torch.inference_mode():
        wanted = model(pixel_values=image, input_points=points, multimask_output=True)
    pairs = {
        "pred_masks": (np.stack([masks for masks, _ in found]), wanted.pred_masks[0].numpy()),
        "iou_scores": (np.stack([scores for _, scores in found]), wanted.iou_scores[0].numpy()),
    }
    return Agreement(
        f"{len(POINTS)} points by SamGraphs",
        {name: float(np.abs(one - other).max()) for name, (one, other) in pairs.items()},
        {name: float(np.abs(other).max()) for name, (_, other) in pairs.items()},
        {name: float(((one > 0) == (other > 0)).mean()) for name, (one, other) in pairs.items()},
        0.0,
    )
