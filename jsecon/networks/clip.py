"""CLIP, MobileCLIP, SigLIP and SigLIP 2 on ONNX Runtime: a joint space of images and texts.

A model folder has the layout of immich or of transformers.js (networks/hub.py). MobileCLIP has CLIP's vocabulary.
SigLIP and SigLIP 2 are recognised by config.json (`tokenizer.read_text_rules`).

A region is embedded as LangSplat does it: masked, cropped to its box, padded to a black square. A text is embedded as
it is.
"""

import functools
import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from jsecon.errors import InputError
from jsecon.files import read_json, reading
from jsecon.networks.hub import find_files
from jsecon.networks.session import Graph, Tensor, content_digest
from jsecon.networks.tokenizer import CLIP_LENGTH, TextTokenizer, read_text_rules
from jsecon.numerics import is_finite_and_bounded
from jsecon.process import cache_home
from jsecon.vision.protocols import CANONICAL
from jsecon.vision.stores import stored_array
from jsecon.vision.unrelated_words import UNRELATED_WORDS


def read_preprocessing(path: Path) -> tuple[tuple[float, ...], tuple[float, ...], int | None]:
    """Reads how a model takes images, or raises InputError.

    Args:
      path: A preprocess_cfg.json of open_clip or a preprocessor_config.json of transformers.

    Returns:
      Mean and standard deviation of RGB in 0..1 (0 and 1 if the file says not to normalise), and the side of the square
      image in px or None.
    """
    expected = "mean and std of three channels, and a size in px"
    remedy = "Fetch the file again."
    content = read_json(path, expected, remedy)
    with reading(path, expected, remedy):
        mean = content.get("mean", content.get("image_mean"))
        std = content.get("std", content.get("image_std"))
        if content.get("do_normalize") is False:  # MobileCLIP
            mean, std = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
        rescale = float(content.get("rescale_factor", 1 / 255)) if content.get("do_rescale", True) else 1.0
        if abs(255 * rescale - 1) > 1e-3:
            raise ValueError(f"pixels times {rescale:g}, not 1/255")
        size = content.get("crop_size", content.get("size"))  # 224, [224, 224] or {"height": 224, "width": 224}
        sides = set(size.values() if isinstance(size, dict) else size if isinstance(size, list) else [size])
        if len(sides) != 1:
            raise ValueError(f"a size of {size}, not of a square")
        side = None if size is None else int(sides.pop())
        mean, std = tuple(map(float, mean)), tuple(map(float, std))
    is_valid = len(mean) == len(std) == 3 and is_finite_and_bounded(mean, std) and min(std) >= 1e-6
    if not is_valid or not 1 <= (side or 1) <= 4096:
        raise InputError(path, f"mean {mean}, std {std}, size {side}", expected, remedy)
    return mean, std, side


def _masked_crop(
    frame: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], size: int
) -> UInt8[np.ndarray, "size size 3"]:
    """Crops a region: black outside of its mask, centred in a black square, resized bilinearly to `size` px.

    The crop is SAM's box with LangSplat's extent, largest minus smallest coordinate: the last row and column are cut
    off unless the region has no other.
    """
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    height, width = max(int(rows[-1] - rows[0]), 1), max(int(columns[-1] - columns[0]), 1)
    box = slice(rows[0], rows[0] + height), slice(columns[0], columns[0] + width)
    side = max(height, width)
    top, left = (side - height) // 2, (side - width) // 2
    square = np.zeros((side, side, 3), np.uint8)
    square[top : top + height, left : left + width] = frame[box] * mask[box][..., None]
    return np.asarray(cv2.resize(square, (size, size)), np.uint8)


class ClipEmbedder:
    """Embedder (jsecon.vision.protocols) that runs the two graphs of a CLIP-like model.

    A graph is opened when it is first needed and stays open until `close`. InputError is raised if the folder holds no
    such model, a graph has other tensors, or a text is empty.

    Args:
      folder: The model folder.

    Attributes:
      name: Name of the space. It follows from the content of the files, so that models are told apart.
    """

    def __init__(self, folder: str | Path):
        self._visual_path, self._textual_path, config, self._tokenizer_path = find_files(folder, "embedder")
        self._mean, self._std, self._size = read_preprocessing(config)
        self._rules = read_text_rules(Path(folder), self._tokenizer_path)
        extra = repr((self._mean, self._std, self._size, *(self._rules or ())))
        digest = content_digest([self._visual_path, self._textual_path], [self._tokenizer_path], extra=extra)
        self.name = f"clip-{digest}"

    @functools.cached_property
    def dim(self) -> int:
        """E, the length of an embedding."""
        return self._output(self._visual, "image").fixed(1) or self._run_visual(self._black_image()).shape[1]

    @functools.cached_property
    def canonical_phrases(self) -> Float32[np.ndarray, "c e"]:
        """(C, E) unit embeddings of CANONICAL."""
        return self.embed_text(list(CANONICAL))

    @functools.cached_property
    def unrelated_words(self) -> Float32[np.ndarray, "w e"]:
        """(W, E) unit embeddings of UNRELATED_WORDS; the user's cache folder keeps them for each model."""
        home, words = cache_home(os.environ), list(UNRELATED_WORDS)
        if home is None:
            return self.embed_text(words)
        digest = hashlib.blake2b(repr((self.name, UNRELATED_WORDS)).encode(), digest_size=12).hexdigest()
        return stored_array(home / "jsecon" / f"words-{digest}.safetensors", lambda: self.embed_text(words))

    @property
    def _side(self) -> int:
        """Side of an image in px."""
        return self._size or self._visual_input.fixed(3) or 224

    def embed_regions(
        self, frame: UInt8[np.ndarray, "h w 3"], masks: Bool[np.ndarray, "m h w"]
    ) -> Float32[np.ndarray, "m e"]:
        """Embeds the regions of a frame: unit rows, zero for an empty mask."""
        rows = np.zeros((len(masks), self.dim), np.float32)
        shown = np.flatnonzero(masks.any((1, 2)))
        if len(shown):
            crops = np.stack([_masked_crop(frame, masks[index], self._side) for index in shown])
            rows[shown] = _normalize(self._run_visual(crops), self._visual_path)
        return rows

    def embed_text(self, texts: list[str]) -> Float32[np.ndarray, "q e"]:
        """Embeds texts: unit rows."""
        for text in texts:
            if not text.strip():
                raise InputError("text", repr(text), "a text", 'Say what to find, for example "red mug".')
        graph, what = self._textual, "CLIP's graph of texts with its projection"
        output = self._output(graph, "text")
        masks = [name for name in graph.inputs if "mask" in name]
        names = [name for name in graph.inputs if name not in masks]
        tensor = graph.require("input", names[0] if len(names) == 1 else "input_ids", (None, None), what)
        length = tensor.fixed(1) or (CLIP_LENGTH if self._rules is None else self._rules.length)

        def feed(part: np.ndarray) -> dict[str, np.ndarray]:
            return {tensor.name: part[:, 0]} | {name: part[:, 1] for name in masks}

        tokens = np.stack(self._tokenizer(texts, length), axis=1)
        rows = _run_in_batches(graph, tokens, tensor.fixed(0), feed, output.name)
        if rows.shape[1] != self.dim:
            expected = f"{self.dim}, like the images of {self._visual_path.name}"
            remedy = "Take both graphs from one model, with their projections."
            raise InputError(self._textual_path, f"texts of {rows.shape[1]} numbers", expected, remedy)
        return _normalize(rows, self._textual_path)

    def check(self) -> None:
        """Runs the graphs on a black image and a word, and closes them."""
        self._run_visual(self._black_image())
        self.embed_text(["word"])
        self.close()

    def close(self) -> None:
        """Closes the graphs and frees their memory; they are opened again when needed."""
        for name in ("_visual", "_textual"):
            self.__dict__.pop(name, None)

    def _black_image(self) -> UInt8[np.ndarray, "1 s s 3"]:
        return np.zeros((1, self._side, self._side, 3), np.uint8)

    @functools.cached_property
    def _visual(self) -> Graph:
        return Graph(self._visual_path)

    @functools.cached_property
    def _textual(self) -> Graph:
        return Graph(self._textual_path)

    @functools.cached_property
    def _tokenizer(self) -> TextTokenizer:
        return TextTokenizer(self._tokenizer_path, self._rules)

    @property
    def _visual_input(self) -> Tensor:
        name = "pixel_values" if "pixel_values" in self._visual.inputs else "image"
        return self._visual.require("input", name, (None, 3, None, None), "CLIP's graph of images with its projection")

    def _output(self, graph: Graph, kind: str) -> Tensor:
        """Returns the output (B, E) of a graph of images or texts.

        SigLIP's pooler is the last step and includes the projection; CLIP's lies before it.
        """
        known = "embedding", f"{kind}_embeds", f"{kind}_features", f"{kind}_embedding"
        names = known if self._rules is None else (*known, "pooler_output")
        name = next((name for name in names if name in graph.outputs), "embedding")
        return graph.require("output", name, (None, None), f"CLIP's graph of {kind}s with its projection")

    def _run_visual(self, crops: UInt8[np.ndarray, "b s s 3"]) -> np.ndarray:
        """(B, S, S, 3) RGB to (B, E), not normalised."""
        mean, std = np.asarray(self._mean, np.float32), np.asarray(self._std, np.float32)
        tensor, output = self._visual_input, self._output(self._visual, "image")

        def feed(part):
            return {tensor.name: ((part.astype(np.float32) / 255.0 - mean) / std).transpose(0, 3, 1, 2)}

        return _run_in_batches(self._visual, crops, tensor.fixed(0), feed, output.name)


def _run_in_batches(
    graph: Graph, rows: np.ndarray, fixed: int | None, feed: Callable[[np.ndarray], dict[str, np.ndarray]], output: str
) -> np.ndarray:
    """Runs a graph on rows (N, ...) and returns an output (N, E).

    Args:
      graph: The graph.
      rows: Rows, each for one embedding.
      fixed: Size of a batch if the graph fixes it; the last batch is then padded with zeros.
      feed: Makes the inputs of a batch of rows.
      output: Name of the output.
    """
    size = fixed or 16
    padding = np.zeros((-len(rows) % size if fixed else 0, *rows.shape[1:]), rows.dtype)
    padded = np.concatenate([rows, padding])
    parts = []
    for start in range(0, len(padded), size):
        part = padded[start : start + size]
        parts.append(graph.run(feed(part), [output])[output])
        if parts[-1].ndim != 2 or len(parts[-1]) != len(part):
            where = f"{graph.path}, output {output!r}"
            raise InputError(where, f"shape {parts[-1].shape}", f"{len(part)} embeddings", "Export the graph again.")
    return np.concatenate(parts)[: len(rows)]


def _normalize(rows: np.ndarray, path: Path) -> Float32[np.ndarray, "b e"]:
    """Scales rows to unit length; raises InputError if one is zero or not finite."""
    rows = np.asarray(rows, np.float64)
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    if not (np.isfinite(length).all() and (length > 0).all()):
        remedy = "Export the graph again, best in 32 bit floats."
        raise InputError(path, "an embedding that is zero or not finite", "finite numbers", remedy)
    return (rows / length).astype(np.float32)
