"""Are our masks those of segment-anything's own automatic mask generator? The same weights through both.

    pip install segment-anything onnx onnxscript            (brings torch; see export_models.py)
    python -m experiments.sam_generator

The decoder is SAM's, the encoder has its layout but two narrow layers (the generator does not depend on it), all
weights are random. Random masks are large and ragged, so no box may suppress another here: what is compared is the
preparation of frames and crops, the prompts, the upscaling, scores, stability, crop edges and the removal of small
holes and islands.
"""

import dataclasses
import tempfile
import time
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import torch

from experiments import results
from experiments.export import sam
from experiments.export.graph import declare_missing_operators
from jsecon.networks.sam.graphs import SamFiles, SamGraphs
from jsecon.networks.sam.masks import point_grid
from jsecon.networks.sam.segmenter import SamSegmenter, SamSettings


@dataclasses.dataclass(frozen=True)
class Options:
    """What is compared, and where it is written."""

    width: int = 320
    height: int = 230
    points_per_side: int = 4
    crop_layers: int = 1
    stability: float = 0.5
    stability_offset: float = 0.02
    """random logits are near 0"""
    seed: int = 0
    threads: int = 1
    out: str = str(results.HOME / "results" / "sam_generator")


def small_sam(seed: int) -> torch.nn.Module:
    """SAM with an encoder of two layers and random weights, mask logits stretched."""
    from segment_anything.build_sam import _build_sam

    torch.manual_seed(seed)
    model = _build_sam(
        encoder_embed_dim=64, encoder_depth=2, encoder_num_heads=2, encoder_global_attn_indexes=[1], checkpoint=None
    )
    sam.make_random(model, seed)
    return model.eval().requires_grad_(False)


def best_first(boxes, scores, idxs, iou_threshold):
    """In place of torchvision's compiled suppression, where no box may suppress another."""
    assert iou_threshold >= 1
    return torch.argsort(scores, descending=True, stable=True)


def main(options: Options) -> dict:
    """Compares every mask of `default`, and prints how many are equal."""
    declare_missing_operators()
    import segment_anything.automatic_mask_generator as official

    torch.set_num_threads(options.threads)
    model = small_sam(options.seed)
    colours = np.random.default_rng(options.seed).integers(0, 255, (12, 16, 3)).astype(np.uint8)
    frame = cv2.resize(colours, (options.width, options.height), interpolation=cv2.INTER_CUBIC)
    with tempfile.TemporaryDirectory() as folder:
        sam.export(model, Path(folder), seed=options.seed, threads=options.threads)
        files = SamFiles(Path(folder) / "encoder.onnx", Path(folder) / "mask_decoder.onnx")
        graphs = SamGraphs(files, threads=options.threads)
        points = point_grid(options.points_per_side) * np.float32([options.width, options.height])
        ious = np.concatenate([found for _, found in graphs.decode(graphs.encode(frame), points)])
        threshold = float(np.median(ious))
        settings = SamSettings(
            "default",
            options.points_per_side,
            threshold,
            options.stability,
            options.stability_offset,
            box_iou=1.0,
            crop_layers=options.crop_layers,
            mask_iou=1.0,
            mask_score=-np.inf,
            mask_inner=0.0,
        )
        start = time.perf_counter()
        ours, scores = SamSegmenter(files, settings, threads=options.threads).levels(frame, ("default",))["default"]
        own_s = time.perf_counter() - start
    generator = official.SamAutomaticMaskGenerator(
        model,
        points_per_side=options.points_per_side,
        pred_iou_thresh=threshold,
        stability_score_thresh=options.stability,
        stability_score_offset=options.stability_offset,
        box_nms_thresh=1.0,
        crop_n_layers=options.crop_layers,
        crop_nms_thresh=1.0,
        min_mask_region_area=settings.least_area,
    )
    start = time.perf_counter()
    with mock.patch.object(official, "batched_nms", best_first):
        theirs = generator.generate(frame)
    official_s = time.perf_counter() - start
    left = {n: record["segmentation"] for n, record in enumerate(theirs)}
    equal, apart = 0, 0.0
    for mask, score in zip(ours, scores):
        twin = next((n for n, other in left.items() if np.array_equal(mask, other)), None)
        if twin is not None:
            del left[twin]
            equal += 1
            apart = max(apart, abs(score - theirs[twin]["predicted_iou"] * theirs[twin]["stability_score"]))
    metrics = {
        "masks": len(ours),
        "of_the_package": len(theirs),
        "equal_to_the_pixel": equal,
        "largest_difference_of_scores": apart,
        "seconds": round(own_s, 1),
        "seconds_of_the_package": round(official_s, 1),
    }
    table = results.table(
        tuple(metrics), [tuple(f"{v:.1e}" if isinstance(v, float) and v < 1e-2 else v for v in metrics.values())]
    )
    results.save(Path(options.out), options, metrics, table)
    print(table)
    return metrics


if __name__ == "__main__":
    main(Options())
