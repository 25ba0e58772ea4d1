"""CLIP, MobileCLIP, SigLIP and SigLIP 2 on ONNX Runtime: a joint space of images and texts.

A model folder has one of three layouts:
    immich            visual/model.onnx, textual/model.onnx, visual/preprocess_cfg.json, textual/tokenizer.json
    transformers.js   onnx/vision_model.onnx, onnx/text_model.onnx, preprocessor_config.json, tokenizer.json
    flat              two .onnx files, which differ in their inputs, with those JSON files beside them
MobileCLIP has CLIP's vocabulary. SigLIP and SigLIP 2 are recognised by config.json (`tokenizer.read_text_rules`).

A region is embedded as LangSplat does it: masked, cropped to its box, padded to a black square. A text is embedded as
it is; with several templates its embedding is the mean over them.
"""

import dataclasses
import functools
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from jsecon.errors import InputError, require
from jsecon.files import read_json, reading
from jsecon.networks.hub import Precision, graph_variants
from jsecon.networks.session import Graph, Tensor, batches, content_digest, describe, graph_files
from jsecon.networks.tokenizer import CLIP_LENGTH, TextRules, TextTokenizer, read_text_rules
from jsecon.numerics import is_finite_and_bounded
from jsecon.vision.protocols import CANONICAL, Logits
from jsecon.vision.reference_words import cached_reference
from jsecon.vision.stores import EmbeddingStore, mask_key

CLIP_MEAN, CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
"""mean and deviation of RGB in 0..1, for folders that do not state them"""
LAYOUTS = {
    "immich": ("visual/model.onnx", "textual/model.onnx"),
    "transformers.js": ("onnx/vision_model.onnx", "onnx/text_model.onnx"),
}
"""layout -> graph of images, graph of texts"""
DEFAULT_SIDE = 224
"""px of an image if neither the configuration nor the graph fixes it"""
MAX_SIDE = 4096
"""px of an image"""
CONFIGS = ("visual/preprocess_cfg.json", "preprocess_cfg.json", "preprocessor_config.json", "open_clip_config.json")
TOKENIZERS = ("textual/tokenizer.json", "tokenizer.json")
LOGITS = "logits.json"
MAX_SCALE, MAX_BIAS = 1e4, 1e3
"""far above trained values: published SigLIP models have scales near 110 and biases near -15"""
LOGITS_REMEDY = (
    f'Write {LOGITS} into the folder, {{"scale": ..., "bias": ...}}: exp of the checkpoint\'s logit_scale, and its '
    "logit_bias."
)
PUBLISHED = (
    "CLIP folders are published on huggingface.co: immich-app/ViT-B-32__laion2b-s34b-b79k and others of immich-app, "
    "Xenova/clip-vit-base-patch16, Xenova/mobileclip_s0, Xenova/siglip-base-patch16-224, "
    "onnx-community/siglip2-base-patch16-224-ONNX and others of theirs."
)
_VISUAL_OUTPUTS = ("embedding", "image_embeds", "image_features", "image_embedding")
_TEXTUAL_OUTPUTS = ("embedding", "text_embeds", "text_features", "text_embedding")
_SIGLIP_OUTPUT = "pooler_output"
"""of a SigLIP by transformers, whose pooler is the last step and includes the projection"""
_VISUAL, _TEXTUAL = "CLIP's graph of images", "CLIP's graph of texts"
_PROJECTION = "Export the graph with its projection."


@dataclasses.dataclass(frozen=True)
class ClipFiles:
    """Files and settings of a CLIP model."""

    visual: Path
    """Graph of images: (B, 3, S, S) to (B, E)."""
    textual: Path
    """Graph of texts: token ids (B, L) to (B, E)."""
    tokenizer: Path
    mean: tuple[float, ...] = CLIP_MEAN
    """Mean of RGB in 0..1."""
    std: tuple[float, ...] = CLIP_STD
    """Standard deviation of RGB in 0..1."""
    size: int | None = None
    """S in px; None to take it from the graph, else DEFAULT_SIDE."""
    layout: str = "separate"
    """immich, transformers.js, flat, or separate if the files were named one by one."""
    rules: TextRules | None = None
    """How the model takes its texts; None for CLIP."""
    logits: Path | None = None
    """File with the scale and bias of a model trained with a sigmoid, or None."""

    @functools.cached_property
    def name(self) -> str:
        """Name of the space: "clip-" and hex digits of all that the embeddings depend on."""
        files = [*graph_files(self.visual), *graph_files(self.textual), self.tokenizer]
        settings = (self.mean, self.std, self.size)
        extra = repr(settings if self.rules is None else (*settings, *self.rules))
        return f"clip-{content_digest(files, extra=extra)}"


def find_clip(folder: str | Path, precision: Precision | None = None) -> ClipFiles:
    """Finds the files of the CLIP model in a folder.

    Args:
      folder: The folder.
      precision: Precision of its graphs; None takes the highest that is there.

    Returns:
      The files, and how the model takes images and texts.

    Raises:
      InputError: A file is missing or cannot be read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "a folder with a CLIP model", PUBLISHED)
    layout, visual, textual = _find_graphs(folder, precision)
    tokenizer = next((folder / name for name in TOKENIZERS if (folder / name).is_file()), None)
    if tokenizer is None:
        raise InputError(folder, f"graphs in the layout of {layout}, no tokenizer", TOKENIZERS[1], PUBLISHED)
    config = next((folder / name for name in CONFIGS if (folder / name).is_file()), None)
    rules = read_text_rules(folder, tokenizer)
    if config is None and rules is not None:
        problem = "a SigLIP model that does not state how it takes images"
        raise InputError(folder, problem, f"{CONFIGS[0]} or {CONFIGS[2]}", f"Fetch the missing file. {PUBLISHED}")
    numbers = (CLIP_MEAN, CLIP_STD, None) if config is None else read_preprocessing(config, complete=rules is not None)
    logits = folder / LOGITS if rules is not None and (folder / LOGITS).is_file() else None
    return ClipFiles(visual, textual, tokenizer, *numbers, layout, rules, logits)


def _find_graphs(folder: Path, precision: Precision | None) -> tuple[str, Path, Path]:
    """Returns the layout, the graph of images and the graph of texts."""
    for layout, plain in LAYOUTS.items():
        halves = []
        for names in graph_variants(plain, precision):
            present = [name for name in names if (folder / name).is_file()]
            if len(present) == 2:
                return layout, folder / names[0], folder / names[1]
            halves += present
        if halves:
            expected = f"{' and '.join(plain)}, the layout of {layout}"
            problem = f"{halves[0]} without its other half"
            raise InputError(folder, problem, expected, f"Fetch the missing file. {PUBLISHED}")
    graphs = {path: Graph(path, threads=1, optimise=False) for path in sorted(folder.glob("*.onnx"))}
    visual = [path for path, graph in graphs.items() if _is_visual(graph)]
    textual = [path for path, graph in graphs.items() if _is_textual(graph)]
    if len(visual) != 1 or len(textual) != 1:
        inputs = "; ".join(f"{path.name} takes {describe(graph.inputs.values())}" for path, graph in graphs.items())
        known = ", or ".join(" and ".join(names) for names in LAYOUTS.values())
        expected = f"one graph of images and one of texts: {known}, or two .onnx files"
        raise InputError(folder, inputs or "no .onnx file in a place known", expected, PUBLISHED)
    return "flat", visual[0], textual[0]


def _has_vectors(graph: Graph) -> bool:
    return any(tensor.shape is not None and len(tensor.shape) == 2 for tensor in graph.outputs.values())


def _is_visual(graph: Graph) -> bool:
    """Whether a graph could embed images: its only input is (B, 3, S, S), and an output is (B, E)."""
    images = [t for t in graph.inputs.values() if t.fits((None, 3, None, None)) and t.dtype.startswith("float")]
    return len(graph.inputs) == len(images) == 1 and _has_vectors(graph)


def _is_textual(graph: Graph) -> bool:
    """Whether a graph could embed texts: it takes token ids (B, L), perhaps with a mask, and an output is (B, E)."""
    ids = [t for t in graph.inputs.values() if t.fits((None, None)) and t.dtype in ("int32", "int64")]
    return 1 <= len(ids) == len(graph.inputs) <= 2 and _has_vectors(graph)


def read_preprocessing(
    path: Path, *, complete: bool = False
) -> tuple[tuple[float, ...], tuple[float, ...], int | None]:
    """Reads how a model takes images.

    Args:
      path: A preprocess_cfg.json, preprocessor_config.json or open_clip_config.json.
      complete: Whether mean and deviation must be stated; else those of CLIP are the defaults.

    Returns:
      Mean and standard deviation of RGB in 0..1 (0 and 1 if the file says not to normalise), and the side of the square
      image in px or None.

    Raises:
      InputError: The file cannot be read.
    """
    expected = "mean and std of three channels, and a size in px"
    remedy = "Fetch the file again."
    content = read_json(path, expected, remedy)
    with reading(path, expected, remedy):
        content = content.get("preprocess_cfg", content)
        mean = content.get("mean", content.get("image_mean", None if complete else CLIP_MEAN))
        std = content.get("std", content.get("image_std", None if complete else CLIP_STD))
        if content.get("do_normalize") is False:  # MobileCLIP
            mean, std = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
        rescale = float(content.get("rescale_factor", 1 / 255)) if content.get("do_rescale", True) else 1.0
        if abs(255 * rescale - 1) > 1e-3:
            raise ValueError(f"pixels times {rescale:g}, not 1/255")
        size = _square_side(content.get("crop_size", content.get("size")))
        mean, std = tuple(map(float, mean)), tuple(map(float, std))
    is_valid = len(mean) == len(std) == 3 and is_finite_and_bounded(mean, std) and min(std) >= 1e-6
    if not is_valid or not 1 <= (size or 1) <= MAX_SIDE:
        raise InputError(path, f"mean {mean}, std {std}, size {size}", expected, remedy)
    return mean, std, size


def _square_side(size: object) -> int | None:
    """The side of a square image, which files write as 224, [224, 224] or {"height": 224, "width": 224}."""
    if isinstance(size, dict):
        size = list(size.values())
    if isinstance(size, Sequence):
        sides = set(map(int, size))
        if len(sides) != 1:
            raise ValueError(f"a size of {sorted(sides)}, not of a square")
        return sides.pop()
    return None if size is None else int(str(size))


def _read_logits(path: Path) -> Logits:
    """Reads scale and bias of a model trained with a sigmoid (SigLIP, arXiv 2303.15343), which its graphs do not hold.

    The text is true of the image with probability sigmoid(scale * cosine + bias).
    """
    expected = f'{{"scale": s, "bias": b}}, 0 < s <= {MAX_SCALE:g}, |b| <= {MAX_BIAS:g}'
    content = read_json(path, expected, LOGITS_REMEDY)
    with reading(path, expected, LOGITS_REMEDY):
        logits = Logits(float(content["scale"]), float(content["bias"]))
    if not (is_finite_and_bounded(*logits) and 0 < logits.scale <= MAX_SCALE and abs(logits.bias) <= MAX_BIAS):
        raise InputError(path, f"scale {logits.scale:g}, bias {logits.bias:g}", expected, LOGITS_REMEDY)
    return logits


def masked_crop(
    frame: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], size: int
) -> UInt8[np.ndarray, "size size 3"]:
    """Crops a region: black outside of its mask, centred in a black square, resized bilinearly.

    The crop is SAM's box with LangSplat's extent, largest minus smallest coordinate: the last row and column are cut
    off unless the region has no other.

    Args:
      frame: (H, W, 3) RGB.
      mask: (H, W), at least one pixel.
      size: Side of the result in px.

    Returns:
      (size, size, 3).

    Raises:
      ValueError: The mask is empty, or has another shape.
    """
    fits = mask.shape == frame.shape[:2] and bool(mask.any())
    got = f"{mask.shape}, {int(mask.sum())} pixels"
    require(fits, "mask", got, f"{frame.shape[:2]}, at least one pixel", "Leave out empty masks.")
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    height, width = max(int(rows[-1] - rows[0]), 1), max(int(columns[-1] - columns[0]), 1)
    box = slice(rows[0], rows[0] + height), slice(columns[0], columns[0] + width)
    side = max(height, width)
    top, left = (side - height) // 2, (side - width) // 2
    square = np.zeros((side, side, 3), np.uint8)
    square[top : top + height, left : left + width] = frame[box] * mask[box][..., None]
    return np.asarray(cv2.resize(square, (size, size)), np.uint8)


class ClipEmbedder:
    """Embedder (jsecon.vision.protocols) that runs the two graphs of a CLIP model.

    A graph is opened when it is first needed and stays open until `close`.

    Args:
      model: The model folder, or its files.
      templates: Phrases with `{}` for the text, whose unit embeddings are averaged.
      batch: Number of crops or texts of one run, if the graph does not fix it.
      threads: Number of cores of one run, as for `Graph`.
      store: Folder that caches embeddings of regions by content, and of the reference words; or None.

    Attributes:
      name: Name of the space. It follows from the content of the files, so that models are told apart.

    Raises:
      InputError: The folder holds no CLIP model, or a template has no `{}`. Methods raise it if a graph has other
        tensors than CLIP.
    """

    def __init__(
        self,
        model: str | Path | ClipFiles,
        *,
        templates: Sequence[str] = ("{}",),
        batch: int = 16,
        threads: int | None = None,
        store: str | Path | None = None,
    ):
        if not templates or not all("{}" in template for template in templates):
            problem = ", ".join(map(repr, templates)) or "no template"
            remedy = 'For example "a photo of a {}.", or "{}", the text alone.'
            raise InputError("--template", problem, "a phrase that holds {}", remedy)
        self.files = model if isinstance(model, ClipFiles) else find_clip(model)
        self.templates = tuple(templates)
        self.name = self.files.name
        self._batch = batch
        self._threads = threads
        self._store = None if store is None else EmbeddingStore(Path(store), self.name)

    @functools.cached_property
    def dim(self) -> int:
        """E, the length of an embedding."""
        return self._visual_output.fixed(1) or self._run_visual(self._black_image()).shape[1]

    @functools.cached_property
    def canonical(self) -> Float32[np.ndarray, "c e"]:
        """(C, E) unit embeddings of CANONICAL, without templates."""
        return self._embed_phrases(list(CANONICAL))

    @functools.cached_property
    def reference(self) -> Float32[np.ndarray, "w e"]:
        """(W, E) unit embeddings of the reference words, in the templates like other texts.

        They are embedded once for each model and its templates, and kept in the user's cache folder.
        """
        return cached_reference(f"{self.name} {self.templates}", self.embed_text)

    @functools.cached_property
    def logits(self) -> Logits | None:
        """Scale and bias of a model trained with a sigmoid if the folder has them, else None."""
        return None if self.files.logits is None else _read_logits(self.files.logits)

    @property
    def size(self) -> int:
        """Side of an image in px."""
        return self.files.size or self._visual_input.fixed(3) or DEFAULT_SIDE

    def embed_regions(
        self, frame: UInt8[np.ndarray, "h w 3"], masks: Bool[np.ndarray, "m h w"]
    ) -> Float32[np.ndarray, "m e"]:
        """Embeds the regions of a frame.

        Args:
          frame: (H, W, 3) RGB.
          masks: (M, H, W).

        Returns:
          (M, E) unit embeddings; zero for an empty mask.
        """
        keys = [mask_key(mask) for mask in masks]
        known = {} if self._store is None else self._store.read(frame)
        rows = np.zeros((len(keys), self.dim), np.float32)
        missing = []
        for index, key in enumerate(keys):
            if key in known and known[key].shape == (self.dim,):
                rows[index] = known[key]
            elif masks[index].any():
                missing.append(index)
        for start in range(0, len(missing), self._batch):
            chunk = missing[start : start + self._batch]
            crops = np.stack([masked_crop(frame, masks[index], self.size) for index in chunk])
            rows[chunk] = _normalize(self._run_visual(crops), self.files.visual)
        if self._store is not None and missing:
            self._store.write(frame, known | {keys[index]: rows[index] for index in missing})
        return rows

    def embed_text(self, texts: list[str]) -> Float32[np.ndarray, "q e"]:
        """Embeds texts.

        Args:
          texts: Q texts.

        Returns:
          (Q, E) unit embeddings, the mean over the templates.

        Raises:
          InputError: A text is empty.
        """
        for text in texts:
            if not text.strip():
                raise InputError("text", repr(text), "a text", 'Say what to find, for example "red mug".')
        phrases = [template.replace("{}", text) for text in texts for template in self.templates]
        rows = self._embed_phrases(phrases).reshape(len(texts), len(self.templates), -1)
        return _normalize(rows.mean(1), self.files.textual)

    def seconds_per_crop(self) -> float:
        """Measures the time of a region in a full batch.

        The crops are blank: which regions are embedded is known only after their masks were tracked.

        Returns:
          Seconds.
        """
        crops = np.zeros((self._batch, self.size, self.size, 3), np.uint8)
        self._run_visual(crops)  # opens the graph
        started = time.monotonic()
        self._run_visual(crops)
        return (time.monotonic() - started) / self._batch

    def check(self) -> None:
        """Runs the graphs on a black image and a word, and closes them.

        Raises:
          InputError: A graph is damaged, or not a CLIP model's.
        """
        self._run_visual(self._black_image())
        self._embed_phrases(["word"])
        self.close()

    def close(self) -> None:
        """Closes the graphs and frees their memory; they are opened again when needed."""
        for name in ("_visual", "_textual"):
            self.__dict__.pop(name, None)

    def _black_image(self) -> UInt8[np.ndarray, "1 s s 3"]:
        return np.zeros((1, self.size, self.size, 3), np.uint8)

    @functools.cached_property
    def _visual(self) -> Graph:
        return Graph(self.files.visual, threads=self._threads)

    @functools.cached_property
    def _textual(self) -> Graph:
        return Graph(self.files.textual, threads=self._threads)

    @functools.cached_property
    def _tokenizer(self) -> TextTokenizer:
        return TextTokenizer(self.files.tokenizer, self.files.rules)

    @property
    def _visual_input(self) -> Tensor:
        name = next(iter(self._visual.inputs), "image")
        if len(self._visual.inputs) > 1:
            name = next((n for n in ("image", "pixel_values") if n in self._visual.inputs), "image")
        return self._visual.require("input", name, (None, 3, None, None), _VISUAL)

    @property
    def _visual_output(self) -> Tensor:
        return _embedding_output(self._visual, self._output_names(_VISUAL_OUTPUTS), _VISUAL)

    def _output_names(self, names: tuple[str, ...]) -> tuple[str, ...]:
        return names if self.files.rules is None else (*names, _SIGLIP_OUTPUT)

    def _run_visual(self, crops: UInt8[np.ndarray, "b s s 3"]) -> np.ndarray:
        """(B, S, S, 3) RGB to (B, E), not normalised."""
        mean, std = np.asarray(self.files.mean, np.float32), np.asarray(self.files.std, np.float32)
        images = np.ascontiguousarray(((crops.astype(np.float32) / 255.0 - mean) / std).transpose(0, 3, 1, 2))
        tensor, output = self._visual_input, self._visual_output.name
        parts = [
            _run_rows(self._visual, {tensor.name: part}, output, count)
            for part, count in batches(images, tensor.fixed(0), self._batch)
        ]
        return np.concatenate(parts)

    def _embed_phrases(self, phrases: list[str]) -> Float32[np.ndarray, "p e"]:
        """(P, E) unit embeddings of phrases as they are."""
        graph = self._textual
        output = _embedding_output(graph, self._output_names(_TEXTUAL_OUTPUTS), _TEXTUAL)
        masks = [name for name in graph.inputs if "mask" in name]
        names = [name for name in graph.inputs if name not in masks]
        tensor = graph.require("input", names[0] if len(names) == 1 else "input_ids", (None, None), _TEXTUAL)
        length = tensor.fixed(1) or (self.files.rules and self.files.rules.length) or CLIP_LENGTH
        ids = self._tokenizer(phrases, length)
        parts = []
        for part, count in batches(ids, tensor.fixed(0), self._batch):
            feeds = {tensor.name: part} | {name: self._tokenizer.mask(part) for name in masks}
            parts.append(_run_rows(graph, feeds, output.name, count))
        rows = np.concatenate(parts)
        if rows.shape[1] != self.dim:
            expected = f"{self.dim}, like the images of {self.files.visual.name}"
            remedy = "Take both graphs from one model, with their projections."
            raise InputError(self.files.textual, f"texts of {rows.shape[1]} numbers", expected, remedy)
        return _normalize(rows, self.files.textual)


def _embedding_output(graph: Graph, names: Sequence[str], what: str) -> Tensor:
    """Returns the output (B, E) of a graph: the first of `names` that it has, else its only output with two axes.

    A pooler's output counts only if it is named: CLIP's lies before the projection into the joint space.
    """
    for name in names:
        if name in graph.outputs:
            return graph.require("output", name, (None, None), what)
    flat = [t for t in graph.outputs.values() if t.shape is not None and len(t.shape) == 2 and "pooler" not in t.name]
    if len(flat) != 1:
        where = f"{graph.path}, output {names[0]!r}"
        expected = f"one output of two axes, as {what} has, called {', '.join(names)} or otherwise"
        raise InputError(where, describe(graph.outputs.values()), expected, _PROJECTION)
    return flat[0]


def _run_rows(graph: Graph, feeds: dict[str, np.ndarray], output: str, count: int) -> np.ndarray:
    """Returns the first `count` rows (count, E) of an output."""
    rows = graph.run(feeds, [output])[output]
    if rows.ndim != 2 or len(rows) < count:
        where = f"{graph.path}, output {output!r}"
        raise InputError(where, f"shape {rows.shape}", f"{count} embeddings", _PROJECTION)
    return rows[:count]


def _normalize(rows: np.ndarray, path: Path) -> Float32[np.ndarray, "b e"]:
    """Scales rows to unit length; raises InputError if one is zero or not finite."""
    rows = np.asarray(rows, np.float64)
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    if not (np.isfinite(length).all() and (length > 0).all()):
        remedy = "Export the graph again, best in 32 bit floats."
        raise InputError(path, "an embedding that is zero or not finite", "finite numbers", remedy)
    return (rows / length).astype(np.float32)
