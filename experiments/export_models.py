"""Exports CLIP, SigLIP and SAM from their official packages as ONNX graphs, and checks ONNX Runtime against PyTorch.

    pip install -e ".[export]"
    python -m experiments.export_models --out models --clip-weights laion2b_s34b_b88k

Without weights the true architectures are written with random ones in every parameter, which is what a check needs:
every graph's outputs. SigLIP, SigLIP 2 and MobileCLIP are put through jsecon's embedder too, from texts and crops to
embeddings; `siglip` and `sam_images` (SAM 2.1 and EdgeTAM for transformers.js) also against transformers. `sam2_video`
tracks a clip by jsecon over the five graphs of SAM 2.1 with memory, and by PyTorch. `--only` takes some of the parts;
figures of the others, and of other models of a part, are kept.
"""

import contextlib
import dataclasses
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
    threads: int = 1


def main(options: Options) -> dict:
    """Exports and checks the parts asked for, writes config.json, metrics.json and table.md."""
    import torch

    torch.set_num_threads(options.threads)
    folder = Path(options.results)
    kept = folder / "metrics.json"
    metrics = json.loads(kept.read_text()) if kept.exists() else {}
    for part in options.only:
        made = _MADE[part](options)
        metrics[part] = metrics.get(part, {}) | made if isinstance(made, dict) else made
        metrics["versions"] = metrics.get("versions", {}) | _versions()
        done = tuple(name for name in PARTS if name in metrics)
        results.save(folder, dataclasses.replace(options, out="models", only=done), metrics, table(metrics))
    print(table(metrics))
    return metrics


def _clip(options: Options) -> list[dict]:
    from experiments.export import clip

    model = clip.official(options.clip, options.clip_weights, seed=options.seed)
    folder = Path(options.out) / "clip"
    agreements = clip.export(model, options.clip, folder, seed=options.seed, threads=options.threads)
    return [dataclasses.asdict(agreement) for agreement in agreements]


def _siglip(options: Options) -> dict[str, dict]:
    from experiments.export import clip, siglip

    found, given = {}, {"seed": options.seed, "threads": options.threads}
    for name in options.siglip:
        folder = Path(options.out) / name
        if "SigLIP" in name:
            model = clip.official(name, None, seed=options.seed)
            found[name] = siglip.export_open_clip(model, name, folder, **given)
        else:
            found[name] = siglip.export_transformers(siglip.official_transformers(options.seed), folder, **given)
    return found


def _mobileclip(options: Options) -> dict[str, dict]:
    from experiments.export import clip

    found, given = {}, {"seed": options.seed, "threads": options.threads}
    for name in options.mobileclip:
        model = clip.official(name, None, seed=options.seed)
        found[name] = clip.export_mobile(model, name, Path(options.out) / name, **given)
    return found


def _sam_images(options: Options) -> dict[str, dict]:
    from experiments.export import sam_images

    exported = {}
    for name in options.sam_images:
        model = sam_images.official(name, options.seed)
        folder = Path(options.out) / name
        exported[name] = sam_images.export(model, folder, seed=options.seed, threads=options.threads)
    return exported


def _sam2_video(options: Options) -> dict[str, dict]:
    from experiments.export import sam2_video

    folder = Path(options.out) / "sam2.1-tiny-video"
    model = sam2_video.official(options.seed)
    return {folder.name: sam2_video.export(model, folder, seed=options.seed, threads=options.threads)}


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
            rows.append((model, graph["graph"], f"{worst:.1e}", f"{scale:.3g}", f"{same:.5%}", _verdict(worst, same)))
    header = ("model", "graph", "largest difference", "largest value", "same sign (least)", "within the bounds")
    return results.table(header, rows)


_MADE = dict(zip(PARTS, (_clip, _siglip, _mobileclip, _sam_images, _sam2_video)))


def _verdict(worst: float, same: float) -> str:
    return "yes" if worst <= TOLERANCE and same >= SAME_PIXELS else "no"


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
