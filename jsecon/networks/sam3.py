"""SAM 3 prompted by a phrase, on ONNX Runtime: a mask and a score of everything in an image that a noun phrase names.

The layout is that of vietanhdev/samexporter (export_sam3.py, sam3_onnx.py), three graphs:
    *image_encoder.onnx      image (3, 1008, 1008) uint8 RGB, the frame stretched to a square; scaled within the graph
                             -> backbone_fpn_0, _1, _2 and vision_pos_enc_0, _1, _2
    *language_encoder.onnx   tokens (1, 32), CLIP's, filled with 0
                             -> text_attention_mask (true where filled), text_memory, text_embeds
    *decoder.onnx            those, unless its exporter removed them, the size of the frame, and B example boxes:
                             box_coords (B, 1, 4), box_labels (B, 1), box_masks (1, B), true for an unused box
There are two kinds of decoder, which differ in their outputs:
    raw        pred_logits (1, Q, 1), presence_logit_dec (1, 1), pred_masks (1, Q, h, w): logits of Q queries
    filtered   scores (N,), masks (N, 1, h, w) of the N queries above 0.5: of an older samexporter, true or false at the
               frame's size, or of wkentaro/sam3-onnx, probabilities at the decoder's size
The score of a query is sigmoid(pred_logits) sigmoid(presence_logit_dec), as in facebookresearch/sam3.
It is tested on small graphs with these signatures, not on the published weights.
"""

import functools
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from PIL import Image
from scipy.special import expit

from jsecon.errors import InputError, require
from jsecon.networks.sam import shared_areas
from jsecon.networks.session import Graph, Tensor
from jsecon.networks.tokenizer import TextTokenizer

IMAGE_SIDE = 1008
"""px of the square image, if the graph does not fix it"""
PHRASE_LENGTH = 32
"""tokens of a phrase, if the graph does not fix it"""
SCORE_THRESHOLD = 0.5
"""a mask needs a higher score, as in the official processor"""
MASK_IOU = 0.7
"""a mask with a higher IoU with a better one repeats it, as in samexporter"""
PUBLISHED = (
    "vietanhdev/segment-anything-3-onnx-models and nrl-ai/samexporter-onnx-models (its folder sam3) of huggingface.co "
    "have such graphs; put CLIP's tokenizer.json beside them, such as that of Xenova/clip-vit-base-patch16."
)
_GRAPHS = ("image_encoder.onnx", "language_encoder.onnx", "decoder.onnx")
_WORDS = {"language_mask": "text_attention_mask", "language_features": "text_memory", "language_embeds": "text_embeds"}
"""input of the decoder -> output of the language encoder"""
_SIZE = ("original_height", "original_width")
_BOXES: dict[str, tuple[int | None, ...]] = {
    "box_coords": (None, 1, 4),
    "box_labels": (None, 1),
    "box_masks": (1, None),
}
_RAW: dict[str, tuple[int | None, ...]] = {
    "pred_logits": (1, None, 1),
    "presence_logit_dec": (1, 1),
    "pred_masks": (1, None, None, None),
}
_FILTERED: dict[str, tuple[int | None, ...]] = {"scores": (None,), "masks": (None, 1, None, None)}
_TOGETHER = "Take the three graphs from one export."


class Sam3Frame(NamedTuple):
    """A frame as the decoder needs it."""

    features: dict[str, np.ndarray]
    """by name"""
    height: int
    width: int


class PhraseMasks(NamedTuple):
    """What a phrase names in a frame: M objects, best score first."""

    masks: Bool[np.ndarray, "m h w"]
    """they may overlap"""
    scores: Float32[np.ndarray, " m"]
    """SCORE_THRESHOLD to 1"""


class Sam3:
    """SAM 3 prompted by phrases: `sam3(frame, "red mug")`.

    Graphs are opened when first needed and stay open until `close`. With the published weights samexporter reports 24 s
    to encode a frame and 3 s per phrase on eight cores, and 8 to 13 GiB: encode a frame once for all phrases.

    Args:
      folder: The model folder.

    Raises:
      InputError: The folder holds no such model. Methods raise it if a graph has other tensors than SAM 3.
    """

    def __init__(self, folder: str | Path):
        folder = Path(folder)
        graphs = sorted(folder.glob("*.onnx"))
        matches = [[path for path in graphs if path.name.endswith(ending)] for ending in _GRAPHS]
        if any(len(paths) != 1 for paths in matches):
            names = ", ".join(path.name for path in graphs) or (
                "no .onnx file" if folder.is_dir() else "no such folder"
            )
            raise InputError(folder, names, f"SAM 3's graphs, one *{', one *'.join(_GRAPHS)}", PUBLISHED)
        (self._image_path,), (self._language_path,), (self._decoder_path,) = matches
        self._tokenizer_path = folder / "tokenizer.json"
        if not self._tokenizer_path.is_file():
            raise InputError(folder, "SAM 3's graphs without a tokenizer", "CLIP's tokenizer.json", PUBLISHED)

    def __call__(self, frame: UInt8[np.ndarray, "h w 3"], phrase: str) -> PhraseMasks:
        """Returns the masks of what a noun phrase names in a frame (H, W, 3) RGB.

        Raises:
          InputError: As by `read`.
        """
        return self.masks(self.encode(frame), self.read(phrase))

    def read(self, phrase: str) -> dict[str, np.ndarray]:
        """Encodes a noun phrase for the decoder.

        Args:
          phrase: The phrase.

        Returns:
          Inputs of the decoder by name.

        Raises:
          InputError: It is empty or too long.
        """
        if not phrase.strip():
            raise InputError("phrase", repr(phrase), "a noun phrase", 'Say what to find, for example "red mug".')
        length = self._language.inputs["tokens"].fixed(1) or PHRASE_LENGTH
        count = self._tokenizer.count(phrase)
        if count > length:
            problem, expected = f"a phrase of {count} tokens", f"at most {length}, start and end among them"
            raise InputError(phrase, problem, expected, "Say it in fewer words.")
        outputs = self._language.run({"tokens": self._tokenizer([phrase], length)}, list(_WORDS.values()))
        return {name: outputs[output] for name, output in _WORDS.items()}

    def encode(self, frame: UInt8[np.ndarray, "h w 3"]) -> Sam3Frame:
        """Encodes a frame for the decoder.

        It is resized by Pillow, as in SAM 3's training: its kernel widens if an image shrinks.

        Args:
          frame: (H, W, 3) uint8 RGB.

        Returns:
          Its features.

        Raises:
          ValueError: The frame is no such image.
        """
        fits = frame.ndim == 3 and frame.shape[2] == 3 and min(frame.shape) > 0 and frame.dtype == np.uint8
        require(fits, "frame", f"{frame.dtype} {frame.shape}", "uint8 (H, W, 3)", "Give an RGB image.")
        square = Image.fromarray(frame).resize((self.side, self.side), Image.Resampling.BILINEAR)
        image = np.ascontiguousarray(np.asarray(square).transpose(2, 0, 1))
        names = [name for name in self._decoder.inputs if name in self._image.outputs]
        return Sam3Frame(self._image.run({"image": image}, names), frame.shape[0], frame.shape[1])

    def masks(self, frame: Sam3Frame, phrase: dict[str, np.ndarray]) -> PhraseMasks:
        """Predicts the masks of a phrase in a frame.

        Args:
          frame: From `encode`.
          phrase: From `read`.

        Returns:
          M masks with a score above SCORE_THRESHOLD, without those that repeat a better one; M may be 0.

        Raises:
          InputError: The decoder gives numbers that are not finite, or of other shapes than it declares.
        """
        boxes = self._decoder.inputs["box_coords"].fixed(0) or 1
        unused = np.zeros((boxes, 1, 4), np.float32), np.ones((boxes, 1), np.int64), np.ones((1, boxes), bool)
        sizes = (np.asarray(size, np.int64) for size in (frame.height, frame.width))
        feeds = frame.features | phrase | dict(zip(_SIZE, sizes)) | dict(zip(_BOXES, unused))
        outputs = self._decoder.run({name: feeds[name] for name in self._decoder.inputs}, list(self._outputs))
        self._check_outputs(outputs)
        if self._outputs is _RAW:
            logits, presence = (
                outputs[name].astype(np.float64).ravel() for name in ("pred_logits", "presence_logit_dec")
            )
            scores, maps, level = expit(logits) * expit(presence), outputs["pred_masks"][0], 0.0
        else:
            scores, maps, level = outputs["scores"], outputs["masks"][:, 0], 0.5
        order = np.argsort(-scores, kind="stable")
        order = order[scores[order] > SCORE_THRESHOLD]
        size = (frame.width, frame.height)
        masks = [cv2.resize(np.asarray(maps[n], np.float32), size) > level for n in order]
        stack = np.stack(masks) if masks else np.zeros((0, frame.height, frame.width), bool)
        kept = _without_repetitions(stack)
        return PhraseMasks(stack[kept], scores[order][kept].astype(np.float32))

    @property
    def side(self) -> int:
        """Px of the square image."""
        return self._image.inputs["image"].fixed(2) or IMAGE_SIDE

    @property
    def summary(self) -> str:
        """What the model takes and gives, in words. Opens the graphs."""
        kind = "raw" if self._outputs is _RAW else "filtered"
        length = self._language.inputs["tokens"].fixed(1) or PHRASE_LENGTH
        return f"masks of what a phrase of {length} tokens names; {kind} decoder, images of {self.side} px"

    def check(self) -> None:
        """Opens and closes the graphs, and reads the tokenizer.

        Raises:
          InputError: A file is damaged, or not SAM 3's.
        """
        _ = self.summary, self._tokenizer
        self.close()

    def close(self) -> None:
        """Closes the graphs and frees their memory; they are opened again when needed."""
        for name in ("_image", "_language", "_decoder"):
            self.__dict__.pop(name, None)

    @functools.cached_property
    def _tokenizer(self) -> TextTokenizer:
        return TextTokenizer(self._tokenizer_path)

    @functools.cached_property
    def _image(self) -> Graph:
        graph = Graph(self._image_path)
        tensor = graph.require("input", "image", (3, None, None), "SAM 3's image encoder")
        if tensor.dtype != "uint8" or tensor.fixed(1) != tensor.fixed(2):
            where, expected = f"{graph.path}, input 'image'", "image uint8[3, S, S], as SAM 3's image encoder has"
            raise InputError(where, str(tensor), expected, "Export the graph with its scaling of colours.")
        return graph

    @functools.cached_property
    def _language(self) -> Graph:
        graph = Graph(self._language_path)
        graph.require("input", "tokens", (1, None), "SAM 3's language encoder")
        for name, shape in zip(_WORDS.values(), ((1, None), (None, 1, None), (None, 1, None))):
            graph.require("output", name, shape, "SAM 3's language encoder")
        return graph

    @functools.cached_property
    def _decoder(self) -> Graph:
        graph, what = Graph(self._decoder_path), "SAM 3's decoder"
        for name, shape in _BOXES.items():
            graph.require("input", name, shape, what)
        graph.require("input", "language_mask", (1, None), what)
        graph.require("input", "language_features", (None, 1, None), what)
        for name, shape in (_RAW if "pred_logits" in graph.outputs else _FILTERED).items():
            graph.require("output", name, shape, what)
        for name, tensor in graph.inputs.items():
            if name not in _BOXES and name not in _SIZE:
                encoder = self._language if name in _WORDS else self._image
                what = f"the encoder that {graph.path.name} belongs to"
                encoder.require("output", _WORDS.get(name, name), tensor.shape or (), what)
        return graph

    @property
    def _outputs(self) -> dict[str, tuple[int | None, ...]]:
        return _RAW if "pred_logits" in self._decoder.outputs else _FILTERED

    def _check_outputs(self, outputs: dict[str, np.ndarray]) -> None:
        """Raises InputError unless each query has a score and a mask, all finite."""
        counts = set()
        for name, shape in self._outputs.items():
            array, where = outputs[name], f"{self._decoder_path}, output {name!r}"
            if array.ndim != len(shape) or not Tensor(name, "", shape).fits(array.shape):
                raise InputError(where, f"shape {array.shape}", str(Tensor(name, "", shape)), _TOGETHER)
            if not np.isfinite(array).all():
                remedy = "Export the graph again, best in 32 bit floats."
                raise InputError(where, "numbers that are not finite", "finite numbers", remedy)
            counts |= {array.shape[axis] for axis, size in enumerate(shape[:2]) if size is None}
        if len(counts) != 1 or (counts != {0} and not all(array.size for array in outputs.values())):
            shapes = ", ".join(f"{name} {outputs[name].shape}" for name in self._outputs)
            raise InputError(self._decoder_path, shapes, "a score and a mask of each query", _TOGETHER)


def _without_repetitions(masks: Bool[np.ndarray, "m h w"]) -> np.ndarray:
    """Indices (K,) of the masks (M, H, W), best first, that are not empty and repeat no better one."""
    shared = shared_areas(masks)
    area = np.diagonal(shared)
    kept: list[int] = []
    for n in range(len(masks)):
        union = area[n] + area[kept] - shared[n, kept]
        if area[n] > 0 and not (shared[n, kept] > MASK_IOU * union).any():
            kept.append(n)
    return np.asarray(kept, np.int64)
