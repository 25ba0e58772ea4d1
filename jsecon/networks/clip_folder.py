"""Where the parts of a CLIP model lie in a folder, and how it wants its images and texts: read from its own files.

Three layouts are known:
    immich            visual/model.onnx, textual/model.onnx, visual/preprocess_cfg.json, textual/tokenizer.json
    transformers.js   onnx/vision_model.onnx, onnx/text_model.onnx, preprocessor_config.json, tokenizer.json
    flat              two .onnx files, told apart by their inputs, with those JSON files beside them
MobileCLIP is a CLIP of other graphs, and comes in the same layouts with CLIP's own vocabulary. SigLIP and SigLIP 2 are
known by config.json (text_rules.py).
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from jsecon.errors import InputError, describe_error
from jsecon.files import read_json
from jsecon.networks.file_tokenizer import TextRules
from jsecon.networks.onnx_graph import Graph, content_digest, describe, graph_files
from jsecon.networks.sigmoid import LOGITS
from jsecon.networks.text_rules import read_text_rules
from jsecon.numerics import is_finite_and_bounded

CLIP_MEAN, CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
"""of RGB in 0..1, where a folder does not say"""
LAYOUTS = {
    "immich": ("visual/model.onnx", "textual/model.onnx"),
    "transformers.js": ("onnx/vision_model.onnx", "onnx/text_model.onnx"),
}
"""layout -> its graphs of images and of texts"""
MOST_SIDE = 4096
"""px of an image that a network takes"""
CONFIGS = ("visual/preprocess_cfg.json", "preprocess_cfg.json", "preprocessor_config.json", "open_clip_config.json")
TOKENIZERS = ("textual/tokenizer.json", "tokenizer.json", "textual/vocab.json", "vocab.json")
PUBLISHED = (
    "CLIP folders are published on huggingface.co: immich-app/ViT-B-32__laion2b-s34b-b79k and others of immich-app, "
    "Xenova/clip-vit-base-patch16, Xenova/mobileclip_s0, Xenova/siglip-base-patch16-224, "
    "onnx-community/siglip2-base-patch16-224-ONNX and others of theirs."
)


@dataclasses.dataclass(frozen=True)
class ClipFiles:
    """The parts of a CLIP model."""

    visual: Path
    """graph: images (B, 3, S, S) -> embeddings (B, E)."""
    textual: Path
    """graph: ids (B, 77) -> embeddings (B, E)."""
    tokenizer: Path
    """tokenizer.json, or vocab.json with merges.txt beside it."""
    mean: tuple[float, ...] = CLIP_MEAN
    """of RGB in 0..1."""
    std: tuple[float, ...] = CLIP_STD
    """of RGB in 0..1."""
    size: int | None = None
    """S in px; None: as the graph fixes it, else 224."""
    layout: str = "given"
    """immich, transformers.js, flat, or given: the files were named one by one."""
    rules: TextRules | None = None
    """how it takes its texts; None: as CLIP does."""
    logits: Path | None = None
    """logits.json, or a graph of both encoders, which know the scale and bias of a sigmoid; None: nothing does."""

    def digest(self) -> str:
        """Hex digits of all that the embeddings depend on: the files' contents, the three numbers, and the rules."""
        files = [*graph_files(self.visual), *graph_files(self.textual), self.tokenizer]
        if self.tokenizer.name == "vocab.json":
            files.append(self.tokenizer.with_name("merges.txt"))
        told = (self.mean, self.std, self.size)
        return content_digest(files, extra=repr(told if self.rules is None else (*told, *self.rules)))


def find_clip(folder: str | Path) -> ClipFiles:
    """The parts of the CLIP model in a folder. Raises InputError naming what is missing or cannot be read."""
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "a folder with a CLIP model", PUBLISHED)
    layout, (visual, textual) = _graphs(folder)
    tokenizer = next((folder / name for name in TOKENIZERS if (folder / name).is_file()), None)
    if tokenizer is None:
        raise InputError(folder, f"graphs in the layout of {layout}, no tokenizer", TOKENIZERS[1], PUBLISHED)
    config = next((folder / name for name in CONFIGS if (folder / name).is_file()), None)
    rules = read_text_rules(folder, tokenizer)
    if config is None and rules is not None:
        found, needed = "a SigLIP model that does not say how it takes images", f"{CONFIGS[0]} or {CONFIGS[2]}"
        raise InputError(folder, found, needed, f"Fetch the missing file. {PUBLISHED}")
    numbers = (CLIP_MEAN, CLIP_STD, None) if config is None else read_preprocessing(config, whole=rules is not None)
    known = (folder / LOGITS, folder / "onnx" / "model.onnx") if rules is not None else ()
    logits = next((path for path in known if path.is_file()), None)
    return ClipFiles(visual, textual, tokenizer, *numbers, layout, rules, logits)


def _graphs(folder: Path) -> tuple[str, tuple[Path, Path]]:
    """The layout, and the graphs of images and of texts."""
    for layout, names in LAYOUTS.items():
        present = [name for name in names if (folder / name).is_file()]
        if len(present) == 1:
            found, expected = f"{present[0]} without its other half", f"{' and '.join(names)}, the layout of {layout}"
            raise InputError(folder, found, expected, f"Fetch the missing file. {PUBLISHED}")
        if present:
            return layout, (folder / names[0], folder / names[1])
    graphs = {path: Graph(path, threads=1, optimise=False) for path in sorted(folder.glob("*.onnx"))}
    visual = [path for path, graph in graphs.items() if is_visual(graph)]
    textual = [path for path, graph in graphs.items() if is_textual(graph)]
    if len(visual) != 1 or len(textual) != 1:
        seen = "; ".join(f"{path.name} takes {describe(graph.inputs.values())}" for path, graph in graphs.items())
        known = ", or ".join(" and ".join(names) for names in LAYOUTS.values())
        expected = f"one graph of images and one of texts: {known}, or two .onnx files"
        raise InputError(folder, seen or "no .onnx file in a place known", expected, PUBLISHED)
    return "flat", (visual[0], textual[0])


def is_visual(graph: Graph) -> bool:
    """Whether a graph could embed images: its one input is (B, 3, S, S), and an output is (B, E)."""
    images = [t for t in graph.inputs.values() if t.fits((None, 3, None, None)) and t.dtype.startswith("float")]
    vectors = [t for t in graph.outputs.values() if t.shape is not None and len(t.shape) == 2]
    return len(graph.inputs) == len(images) == 1 and bool(vectors)


def is_textual(graph: Graph) -> bool:
    """Whether a graph could embed texts: it takes ids (B, L), perhaps with a mask of them, and an output is (B, E)."""
    ids = [t for t in graph.inputs.values() if t.fits((None, None)) and t.dtype in ("int32", "int64")]
    vectors = [t for t in graph.outputs.values() if t.shape is not None and len(t.shape) == 2]
    return 1 <= len(ids) == len(graph.inputs) <= 2 and bool(vectors)


def read_preprocessing(path: Path, *, whole: bool = False) -> tuple[tuple[float, ...], tuple[float, ...], int | None]:
    """(mean, std, size) of a preprocess_cfg.json, preprocessor_config.json or open_clip_config.json; what a file leaves
    out is CLIP's own, or None for the size; 0 and 1 where it says not to normalise. With `whole`, mean and std may not
    be left out. Raises InputError where it cannot be read."""
    expected = "mean and std of three channels, and a size in px"
    content = read_json(path, expected, "Fetch the file again.")
    try:
        content = content.get("preprocess_cfg", content)
        mean = content.get("mean", content.get("image_mean", None if whole else CLIP_MEAN))
        std = content.get("std", content.get("image_std", None if whole else CLIP_STD))
        if content.get("do_normalize") is False:  # MobileCLIP's
            mean, std = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
        rescale = float(content.get("rescale_factor", 1 / 255)) if content.get("do_rescale", True) else 1.0
        if abs(255 * rescale - 1) > 1e-3:
            raise ValueError(f"pixels times {rescale:g}, not 1/255")
        size = _side(content.get("crop_size", content.get("size")))
        mean, std = tuple(map(float, mean)), tuple(map(float, std))
    except (ValueError, TypeError, AttributeError, KeyError, OverflowError) as error:
        raise InputError(
            path, f"it cannot be read ({describe_error(error)})", expected, "Fetch the file again."
        ) from error
    if (
        len(mean) != 3
        or len(std) != 3
        or not is_finite_and_bounded(mean, std)
        or min(std) < 1e-6
        or not 1 <= (size or 1) <= MOST_SIDE
    ):
        raise InputError(path, f"mean {mean}, std {std}, size {size}", expected, "Fetch the file again.")
    return mean, std, size


def _side(size: object) -> int | None:
    """The side of a square image, which files write as 224, [224, 224] or {"height": 224, "width": 224}."""
    if isinstance(size, dict):
        size = list(size.values())
    if isinstance(size, Sequence):
        sides = set(map(int, size))
        if len(sides) != 1:
            raise ValueError(f"a size of {sorted(sides)}, not of a square")
        return sides.pop()
    return None if size is None else int(str(size))
