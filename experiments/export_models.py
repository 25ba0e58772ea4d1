"""Exports CLIP, SigLIP and SAM from their official packages as ONNX graphs, and checks ONNX Runtime against PyTorch.

    pip install -e ".[export]"
    pip install --no-build-isolation sam2
    python -m experiments.export_models --out models --clip-weights laion2b_s34b_b88k

Without weights the true architectures are written with random ones in every parameter, which is what a check needs:
every graph's outputs. SigLIP, SigLIP 2 and MobileCLIP are put through jsecon's embedder too, from texts and crops to
embeddings; `siglip` and `sam_images` (SAM 2.1 and EdgeTAM for transformers.js) also against transformers. `sam2_video`
tracks a clip by jsecon over the five graphs of SAM 2.1 with memory, and by PyTorch. `--only` takes some of the parts;
figures of the others, and of other models of a part, are kept.
"""

import contextlib
import dataclasses
import importlib.util
import json
from pathlib import Path
from typing import Literal

import tyro

from experiments import results

TOLERANCE = 1e-3
"""of every output, masks as logits"""
SAME_PIXELS = 0.999
"""of a mask"""
PARTS = ("clip", "siglip", "mobileclip", "sam_images", "sam2_video")


@dataclasses.dataclass(frozen=True)
class Options:
    """What is exported, and where to."""

    out: str = "models"
    """Folder of the graphs: clip/, and one of each further model."""
    results: str = str(results.HOME / "results" / "export_models")
    only: tuple[Literal["clip", "siglip", "mobileclip", "sam_images", "sam2_video"], ...] = PARTS
    clip: str = "ViT-B-16"
    clip_weights: str | None = None
    """an open_clip tag or a file; None: random."""
    siglip: tuple[str, ...] = ("ViT-B-16-SigLIP", "ViT-B-16-SigLIP2", "siglip-base-patch16-224")
    """of open_clip, in immich's layout; the last of transformers, in that of transformers.js. Random weights."""
    mobileclip: tuple[str, ...] = ("MobileCLIP-S1", "MobileCLIP2-S0")
    """of open_clip; random weights."""
    sam_images: tuple[str, ...] = ("sam2.1-hiera-tiny", "edgetam")
    """of transformers, in the layout of transformers.js; random weights."""
    seed: int = 0


def main(options: Options) -> dict:
    """Exports and checks the parts asked for, writes config.json, metrics.json and table.md."""
    if "sam2_video" in options.only and importlib.util.find_spec("sam2") is None:
        raise SystemExit(
            "sam2_video needs Meta's package: pip install --no-build-isolation sam2 (or leave it out: --only)"
        )
    folder = Path(options.results)
    kept = folder / "metrics.json"
    metrics = json.loads(kept.read_text()) if kept.exists() else {}
    for part in options.only:
        made = _export(part, options)
        metrics[part] = metrics.get(part, {}) | made if isinstance(made, dict) else made
        metrics["versions"] = metrics.get("versions", {}) | _versions()
        done = tuple(name for name in PARTS if name in metrics)
        results.save(folder, dataclasses.replace(options, out="models", only=done), metrics, table(metrics))
    print(table(metrics))
    return metrics


def _export(part: str, options: Options) -> list[dict] | dict[str, dict]:
    """Exports the models of a part.

    Returns:
      The figures of each model by its name; of CLIP, those of its graphs.
    """
    folder, given = Path(options.out), {"seed": options.seed}
    if part == "sam_images":
        from experiments.export import sam_images

        def write(name):
            return sam_images.export(sam_images.official(name, options.seed), folder / name, **given)

        return {name: write(name) for name in options.sam_images}
    if part == "sam2_video":
        from experiments.export import sam2_video

        name = "sam2.1-tiny-video"
        return {name: sam2_video.export(sam2_video.official(options.seed), folder / name, **given)}
    from experiments.export import clip, siglip

    if part == "clip":
        model = clip.official(options.clip, options.clip_weights, seed=options.seed)
        return [dataclasses.asdict(row) for row in clip.export(model, options.clip, folder / "clip", **given)]
    found = {}
    for name in getattr(options, part):
        if part == "siglip" and "SigLIP" not in name:
            model = siglip.official_transformers(options.seed)
            found[name] = siglip.export_transformers(model, folder / name, **given)
        else:
            export = siglip.export_open_clip if part == "siglip" else clip.export_mobile
            found[name] = export(clip.official(name, None, seed=options.seed), name, folder / name, **given)
    return found


def _versions() -> dict[str, str]:
    from importlib.metadata import PackageNotFoundError, version

    found = {}
    for name in ("torch", "onnxruntime", "open_clip_torch", "timm", "transformers"):
        with contextlib.suppress(PackageNotFoundError):  # of a part that was not asked for
            found[name] = version(name)
    return found


def table(metrics: dict) -> str:
    """Markdown: a row per graph."""
    rows = []
    groups = {"clip": metrics.get("clip", [])}
    for part in PARTS[1:]:
        groups |= {name: found["graphs"] for name, found in metrics.get(part, {}).items()}
    for model, graphs in groups.items():
        for graph in graphs:
            worst = max(graph["outputs"].values())
            same = min(graph["same_signs"].values())
            scale = max(graph["scales"].values())
            within = "yes" if worst <= TOLERANCE and same >= SAME_PIXELS else "no"
            rows.append((model, graph["graph"], f"{worst:.1e}", f"{scale:.3g}", f"{same:.5%}", within))
    header = ("model", "graph", "largest difference", "largest value", "same sign (least)", "within the bounds")
    return results.table(header, rows)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
