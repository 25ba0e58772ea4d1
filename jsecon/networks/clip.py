"""CLIP on ONNX Runtime: a joint space of images and texts, from a model folder of either common layout. So are SigLIP,
SigLIP 2 and MobileCLIP.

A region is embedded as LangSplat does it: masked, cropped to its box, padded to a black square (preprocess.py). A text
is embedded as it stands; with several `templates`, as the mean over them.
"""

import functools
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from jsecon.errors import InputError, require
from jsecon.networks.clip_folder import ClipFiles, find_clip
from jsecon.networks.file_tokenizer import FileTokenizer
from jsecon.networks.onnx_graph import Graph, Tensor, batches, describe
from jsecon.networks.sigmoid import fitted_logits, read_logits
from jsecon.networks.tokenizer import CONTEXT_LENGTH, ClipTokenizer, load_tokenizer
from jsecon.vision.protocols import CANONICAL, Logits
from jsecon.vision.reference_words import cached_reference
from jsecon.vision.stores import EmbeddingStore, lookup_vectors, mask_key


def masked_crop(
    frame: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], size: int
) -> UInt8[np.ndarray, "size size 3"]:
    """One region of a frame (H, W, 3), black outside of `mask` (H, W), in the middle of a black square of `size` px.

    The crop is SAM's box with LangSplat's rule for its extent, largest minus smallest coordinate: the last row and
    column are lost, unless the region has no other. Resized bilinearly. Raises ValueError for an empty mask or other
    shapes.
    """
    fits, got = mask.shape == frame.shape[:2] and bool(mask.any()), f"{mask.shape}, {int(mask.sum())} pixels"
    require(fits, "mask", got, f"{frame.shape[:2]}, at least one pixel", "Leave out empty masks.")
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    height, width = max(int(rows[-1] - rows[0]), 1), max(int(columns[-1] - columns[0]), 1)
    box = slice(rows[0], rows[0] + height), slice(columns[0], columns[0] + width)
    side = max(height, width)
    top, left = (side - height) // 2, (side - width) // 2
    square = np.zeros((side, side, 3), np.uint8)
    square[top : top + height, left : left + width] = frame[box] * mask[box][..., None]
    return np.asarray(cv2.resize(square, (size, size)), np.uint8)


DEFAULT_SIZE = 224
"""px of an image, where neither the configuration nor the graph fixes it"""
_VISUAL_OUTPUTS = ("embedding", "image_embeds", "image_features", "image_embedding")
_TEXTUAL_OUTPUTS = ("embedding", "text_embeds", "text_features", "text_embedding")
_POOLED = "pooler_output"
"""of a SigLIP by transformers: its poolers are the last step, with the projection in them"""


def clip_name(files: ClipFiles) -> str:
    """What the space of a CLIP model is called: it follows from the content of its files."""
    return f"clip-{files.digest()}"


class ClipEmbedder:
    """Embedder (jsecon.vision.protocols) by a CLIP model's two graphs.

    `model` is a model folder or its ClipFiles; `templates` are phrases with `{}` for the text, whose unit embeddings
    are averaged; `batch` crops or texts go through a graph at once, where it fixes no batch of its own; `threads` as
    for `Graph`; `store` is a folder that keeps the regions' embeddings by content, or None.

    A graph is opened when it is first needed and kept until `close`. `name` follows from the content of the files, so
    that fields and texts of unlike models are told apart. Raises InputError where the folder is no CLIP model, and
    later where a graph is of another kind, naming the tensor.
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
            given = ", ".join(map(repr, templates)) or "none"
            remedy = 'For example "a photo of a {}.", or "{}", the text alone.'
            raise InputError("--template", given, "a phrase that holds {}", remedy)
        self.files = model if isinstance(model, ClipFiles) else find_clip(model)
        self.templates, self._batch, self._threads = tuple(templates), batch, threads
        self.name = clip_name(self.files)
        self._store = None if store is None else EmbeddingStore(Path(store), self.name)

    @functools.cached_property
    def dim(self) -> int:
        """E."""
        return self._visual_output.fixed(1) or self._through_visual(self._black()).shape[1]

    @functools.cached_property
    def canonical(self) -> Float32[np.ndarray, "c e"]:
        """(C, E) float32 unit: the bare texts of CANONICAL, without templates."""
        return self._embedded(list(CANONICAL))

    @functools.cached_property
    def reference(self) -> Float32[np.ndarray, "w e"]:
        """(W, E) float32 unit: REFERENCE_WORDS, in the templates, as texts are. They are embedded once for each model
        and its templates, and kept in the user's cache folder."""
        return cached_reference(f"{self.name} {self.templates}", self.embed_text)

    @functools.cached_property
    def logits(self) -> Logits | None:
        """Scale and bias of a model trained with a sigmoid, where its folder has them; None for every other. Raises
        InputError where they cannot be read."""
        path = self.files.logits
        if path is None or path.suffix == ".json":
            return None if path is None else read_logits(path)
        tints = np.array([[0, 0, 0], [1, 1, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]], np.float32)
        shades = np.linspace(40, 255, self.size)[:, None] * tints[:, None, None]
        images = self._normalised(np.repeat(shades.astype(np.uint8), self.size, axis=1))
        graph = Graph(path, threads=self._threads)
        length = (self.files.rules and self.files.rules.length) or CONTEXT_LENGTH
        return fitted_logits(graph, images, self._tokenizer([*CANONICAL], length))

    @property
    def size(self) -> int:
        """Side of an image in px."""
        return self.files.size or self._visual_input.fixed(3) or DEFAULT_SIZE

    def embed_regions(
        self, frame: UInt8[np.ndarray, "h w 3"], masks: Bool[np.ndarray, "m h w"]
    ) -> Float32[np.ndarray, "m e"]:
        """frame (H, W, 3) uint8, masks (M, H, W) bool -> (M, E) float32 unit; zero for an empty mask."""
        keys = [mask_key(mask) for mask in masks]
        known = {} if self._store is None else self._store.read(frame)
        rows, missing = lookup_vectors(known, keys, self.dim)
        missing = [index for index in missing if masks[index].any()]
        for start in range(0, len(missing), self._batch):
            chunk = missing[start : start + self._batch]
            crops = np.stack([masked_crop(frame, masks[index], self.size) for index in chunk])
            rows[chunk] = _unit(self._through_visual(crops), self.files.visual)
        if self._store is not None and missing:
            self._store.write(frame, known | {keys[index]: rows[index] for index in missing})
        return rows

    def embed_text(self, texts: list[str]) -> Float32[np.ndarray, "q e"]:
        """Q texts -> (Q, E) float32 unit, the mean over the templates. Raises InputError on an empty text."""
        for text in texts:
            if not text.strip():
                raise InputError("text", repr(text), "a text", 'Say what to find, for example "red mug".')
        phrases = [template.replace("{}", text) for text in texts for template in self.templates]
        found = self._embedded(phrases).reshape(len(texts), len(self.templates), -1)
        return _unit(found.mean(1), self.files.textual)

    def check(self) -> None:
        """Puts a black image and a word through the graphs and closes them. Raises InputError where they are damaged,
        or no CLIP model's."""
        self._through_visual(self._black())
        self._embedded(["word"])
        self.close()

    def _black(self) -> UInt8[np.ndarray, "1 s s 3"]:
        return np.zeros((1, self.size, self.size, 3), np.uint8)

    def close(self) -> None:
        """Drops the graphs and their memory; they are opened again when needed."""
        for name in ("_visual", "_textual"):
            self.__dict__.pop(name, None)

    @functools.cached_property
    def _visual(self) -> Graph:
        return Graph(self.files.visual, threads=self._threads)

    @functools.cached_property
    def _textual(self) -> Graph:
        return Graph(self.files.textual, threads=self._threads)

    @property
    def _visual_input(self) -> Tensor:
        name = next(iter(self._visual.inputs), "image")
        if len(self._visual.inputs) > 1:
            name = next((n for n in ("image", "pixel_values") if n in self._visual.inputs), "image")
        return self._visual.require("input", name, (None, 3, None, None), "CLIP's graph of images")

    @property
    def _visual_output(self) -> Tensor:
        return embedding_output(self._visual, self._outputs(_VISUAL_OUTPUTS), "CLIP's graph of images")

    def _outputs(self, names: tuple[str, ...]) -> tuple[str, ...]:
        return names if self.files.rules is None else (*names, _POOLED)

    @functools.cached_property
    def _tokenizer(self) -> ClipTokenizer | FileTokenizer:
        rules = self.files.rules
        return load_tokenizer(self.files.tokenizer) if rules is None else FileTokenizer(self.files.tokenizer, rules)

    def _normalised(self, crops: UInt8[np.ndarray, "b s s 3"]) -> Float32[np.ndarray, "b 3 s s"]:
        mean, std = np.asarray(self.files.mean, np.float32), np.asarray(self.files.std, np.float32)
        return np.ascontiguousarray(((crops.astype(np.float32) / 255.0 - mean) / std).transpose(0, 3, 1, 2))

    def _through_visual(self, crops: UInt8[np.ndarray, "b s s 3"]) -> np.ndarray:
        """(B, S, S, 3) uint8 RGB -> (B, E) as the graph gives them."""
        images = self._normalised(crops)
        tensor, output = self._visual_input, self._visual_output.name
        parts = [
            _rows(self._visual, {tensor.name: part}, output, count)
            for part, count in batches(images, tensor.fixed(0), self._batch)
        ]
        return np.concatenate(parts)

    def _embedded(self, phrases: list[str]) -> Float32[np.ndarray, "p e"]:
        """(P, E) float32 unit."""
        graph, what = self._textual, "CLIP's graph of texts"
        output = embedding_output(graph, self._outputs(_TEXTUAL_OUTPUTS), what)
        masks = [name for name in graph.inputs if "mask" in name]
        names = [name for name in graph.inputs if name not in masks]
        tensor = graph.require("input", names[0] if len(names) == 1 else "input_ids", (None, None), what)
        length = tensor.fixed(1) or (self.files.rules and self.files.rules.length) or CONTEXT_LENGTH
        ids = self._tokenizer(phrases, length)
        parts = []
        for part, count in batches(ids, tensor.fixed(0), self._batch):
            feeds = {tensor.name: part} | {name: self._tokenizer.mask(part) for name in masks}
            parts.append(_rows(graph, feeds, output.name, count))
        rows = np.concatenate(parts)
        if rows.shape[1] != self.dim:
            expected = f"{self.dim}, like the images of {self.files.visual.name}"
            remedy = "Take both graphs from one model, with their projections."
            raise InputError(self.files.textual, f"texts of {rows.shape[1]} numbers", expected, remedy)
        return _unit(rows, self.files.textual)


def embedding_output(graph: Graph, names: Sequence[str], what: str) -> Tensor:
    """The output (B, E) of a graph: of one of `names`, else its only one of two axes.

    A pooler's that is not named does not count: CLIP's lies before the projection into the joint space. Raises
    InputError where there is none, or more than one.
    """
    for name in names:
        if name in graph.outputs:
            return graph.require("output", name, (None, None), what)
    flat = [t for t in graph.outputs.values() if t.shape is not None and len(t.shape) == 2 and "pooler" not in t.name]
    if len(flat) != 1:
        where, found = f"{graph.path}, output {names[0]!r}", describe(graph.outputs.values())
        expected = f"one output of two axes, as {what} has, called {', '.join(names)} or otherwise"
        raise InputError(where, found, expected, "Export the graph with its projection.")
    return flat[0]


def _rows(graph: Graph, feeds: dict[str, np.ndarray], output: str, count: int) -> np.ndarray:
    """The first `count` rows (count, E) of an output."""
    found = graph.run(feeds, [output])[output]
    if found.ndim != 2 or len(found) < count:
        remedy = "Export the graph with its projection."
        raise InputError(f"{graph.path}, output {output!r}", f"shape {found.shape}", f"{count} embeddings", remedy)
    return found[:count]


def _unit(rows: np.ndarray, path: Path) -> Float32[np.ndarray, "b e"]:
    rows = np.asarray(rows, np.float64)
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    if not (np.isfinite(length).all() and (length > 0).all()):
        found, remedy = "an embedding that is zero or not finite", "Export the graph again, best in 32 bit floats."
        raise InputError(path, found, "finite numbers", remedy)
    return (rows / length).astype(np.float32)
