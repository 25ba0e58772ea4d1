"""Segmenter by SAM, SlimSAM, EdgeTAM or SAM 2.1 on ONNX Runtime: the automatic mask generator.

Points prompt the frame: one in the middle of each region that differs by colour, then some in what the masks of these
do not explain (networks/prompts.py). Each point gives three masks: subpart, part and whole, the levels s, m and l; the
level `default` pools all three. Masks that the model predicts to be poor or that are not stable are dropped, then
repetitions by box, then small holes and islands are removed, then LangSplat's suppression of masks by masks follows
(networks/sam_masks.py). All of it runs on the host, on NumPy arrays.

A model folder has onnx/vision_encoder.onnx and onnx/prompt_encoder_mask_decoder.onnx, as exported for transformers.js,
and preprocessor_config.json, which states how colours are scaled. The decoder takes input_points (1, B, P, 2) and
input_labels (1, B, P) and gives iou_scores and pred_masks. There are two kinds, which differ in its other inputs:
    SAM      image_embeddings of a frame that is scaled by its longer side and padded; a batch of prompts in one run
    SAM 2    image_embeddings.0, .1 and .2 of a frame that is stretched to a square, as EdgeTAM and SAM 2.1 have;
             input_boxes (1, 0, 4), so one prompt a run
"""

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from PIL import Image

from jsecon.errors import InputError
from jsecon.networks.clip import read_preprocessing
from jsecon.networks.hub import Precision, find_files
from jsecon.networks.prompts import GuidedPrompts
from jsecon.networks.sam_masks import box_nms, box_of, langsplat_nms, remove_small_regions, stability
from jsecon.networks.session import Graph, batches, content_digest

BATCH = 4
"""prompts of one run, if the decoder does not fix it: of EdgeTAM's decoder on two cores, 8 take 42 ms each, one alone
34 ms; 64 of SAM's take more than 1 GiB"""
BOX_IOU = 0.7
"""boxes with a higher IoU repeat each other; this and the thresholds in the code are LangSplat's (preprocess.py)"""

Level = Literal["default", "s", "m", "l"]
TOKENS: dict[str, tuple[int, ...]] = {"default": (0, 1, 2), "s": (0,), "m": (1,), "l": (2,)}
"""level -> which of a point's three masks it takes"""


class EncodedFrame(NamedTuple):
    """A frame as the decoder needs it."""

    features: dict[str, np.ndarray]
    """by the decoder's names"""
    size: tuple[int, int]
    """(H, W) px of the frame"""
    scaled: tuple[int, int]
    """(H, W) px of the frame within the encoder's square"""


class SamGraphs:
    """SAM's two graphs, ready to run, or an InputError if one has other tensors than SAM.

    Args:
      encoder: Graph of frames.
      decoder: Graph of prompts.
      config: preprocessor_config.json.

    Attributes:
      batch: Number of prompts of one run.
      side: Side of the encoder's square image in px.
      stretched: Whether frames are stretched to a square (SAM 2), else scaled and padded (SAM).
    """

    def __init__(self, encoder: Path, decoder: Path, config: Path):
        mean, std, side = read_preprocessing(config)
        self._encoder = Graph(encoder)
        self._decoder = Graph(decoder)
        image = self._encoder.require("input", "pixel_values", (1, 3, None, None), "SAM's image encoder")
        inputs = self._decoder.inputs
        self.stretched = "image_embeddings.0" in inputs
        what = "SAM's mask decoder"
        points = self._decoder.require("input", "input_points", (1, None, None, 2), what)
        self._decoder.require("input", "input_labels", (1, None, None), what)
        self._decoder.require("output", "iou_scores", (1, None, None), what)
        masks = self._decoder.require("output", "pred_masks", (1, None, None, None, None), what)
        if masks.fixed(2) not in (None, 3, 4):
            raise self._not_three_masks(str(masks))
        self._fixed_batch = 1 if "input_boxes" in inputs else points.fixed(1)
        self.batch = self._fixed_batch or BATCH
        self.side = image.fixed(3) or side or 1024
        self._links = [name for name in inputs if name not in ("input_points", "input_labels", "input_boxes")]
        for name in self._links:
            what = f"the encoder that {decoder.name} belongs to"
            self._encoder.require("output", name, inputs[name].shape or (), what)
        self._mean, self._std = 255 * np.asarray((mean, std), np.float32)

    def _not_three_masks(self, problem: str) -> InputError:
        expected = "3 or 4 masks per prompt, from the smallest part to the whole, each with its score"
        where = f"{self._decoder.path}, output 'pred_masks'"
        return InputError(where, problem, expected, "Export the decoder with all of its masks.")

    def encode(self, frame: UInt8[np.ndarray, "h w 3"]) -> EncodedFrame:
        """Encodes an RGB frame for `decode`.

        It is resized by Pillow, as in SAM's training: its kernel widens if an image shrinks, OpenCV's does not.
        """
        height, width = frame.shape[:2]
        scale = self.side / max(height, width)
        size = (self.side, self.side) if self.stretched else (int(height * scale + 0.5), int(width * scale + 0.5))
        image = np.asarray(Image.fromarray(frame).resize((size[1], size[0]), Image.Resampling.BILINEAR), np.float32)
        square = np.zeros((self.side, self.side, 3), np.float32)
        square[: size[0], : size[1]] = (image - self._mean) / self._std
        features = self._encoder.run({"pixel_values": square.transpose(2, 0, 1)[None]}, self._links)
        return EncodedFrame(features, (height, width), size)

    def decode(
        self, encoded: EncodedFrame, points: Float32[np.ndarray, "p 2"]
    ) -> Iterator[tuple[Float32[np.ndarray, "b 3 l l"], Float32[np.ndarray, "b 3"]]]:
        """Yields mask logits from part to whole, and predicted IoUs, of points x, y in px of the frame, by batches.

        Of four masks the first is left out: it is SAM's one mask for several points.
        """
        scaled = points * np.divide(encoded.scaled[::-1], encoded.size[::-1], dtype=np.float32)
        feeds = dict(encoded.features)
        if "input_boxes" in self._decoder.inputs:
            feeds["input_boxes"] = np.zeros((1, 0, 4), np.float32)
        for part, count in batches(scaled, self._fixed_batch, self.batch):
            prompts = {"input_points": part[None, :, None], "input_labels": np.ones((1, len(part), 1), np.int64)}
            outputs = self._decoder.run(feeds | prompts, ["pred_masks", "iou_scores"])
            masks, scores = outputs["pred_masks"][0], outputs["iou_scores"][0]
            if masks.shape[:2] != scores.shape or masks.shape[1] not in (3, 4):
                raise self._not_three_masks(f"{list(masks.shape)} with scores {list(scores.shape)}")
            yield masks[:count, -3:].astype(np.float32), scores[:count, -3:].astype(np.float32)

    def to_frame(self, logits: Float32[np.ndarray, "l l"], encoded: EncodedFrame) -> Float32[np.ndarray, "h w"]:
        """Resizes the logits of a mask to the frame, bilinearly, through the encoder's square as SAM does."""
        size = encoded.size[::-1]
        if self.stretched:
            return cv2.resize(logits, size)
        square = cv2.resize(logits, (self.side, self.side))
        return cv2.resize(np.ascontiguousarray(square[: encoded.scaled[0], : encoded.scaled[1]]), size)


class _Candidate(NamedTuple):
    """A predicted mask on its way through the filters."""

    mask: np.ndarray
    """(H, W) bool"""
    iou: float
    """as the model predicts it"""
    stability: float
    token: int
    prompt: int
    """index of its point"""


class SamSegmenter:
    """Segmenter (jsecon.vision.protocols) that runs a SAM model, or an InputError if a file is no such model's.

    The graphs are opened when first needed and stay open until `close`.

    Args:
      folder: The model folder.
      level: Level of the masks.
      precision: Precision of its graphs, if the folder has such ones; else the highest that is there.

    Attributes:
      name: Follows from the content of the files and the level.
    """

    prompts: Any = GuidedPrompts
    """chooses the points: made from a frame and the number of levels, it has `next_points` and `explain`"""

    def __init__(self, folder: str | Path, *, level: Level = "l", precision: Precision | None = None):
        self._files = find_files(folder, "segmenter", precision)
        encoder, decoder, config = self._files
        self._level = level
        extra = f"{level} {read_preprocessing(config)}"
        self.name = f"sam-{content_digest([encoder, decoder], extra=extra)}"

    def __call__(self, frame: UInt8[np.ndarray, "h w 3"], index: int) -> Bool[np.ndarray, "m h w"]:
        """Returns the masks (M, H, W) of a frame, best score first; they may overlap."""
        return self.segment(frame)[0]

    def segment(self, frame: UInt8[np.ndarray, "h w 3"]) -> tuple[Bool[np.ndarray, "m h w"], Float64[np.ndarray, " m"]]:
        """Returns the masks of a frame and their scores, stability times predicted IoU, best first."""
        frame = np.ascontiguousarray(frame)
        tokens = TOKENS[self._level]
        encoded = self._graphs.encode(frame)
        prompts = self.prompts(frame, len(tokens))
        candidates: list[_Candidate] = []
        while len(points := prompts.next_points()):
            for candidate in self._predict(encoded, points):
                prompts.explain(tokens.index(candidate.token), points[candidate.prompt], candidate.mask)
                candidates.append(candidate)
        boxes = np.asarray([box_of(candidate.mask) for candidate in candidates], np.float64).reshape(-1, 4)
        distinct = [candidates[i] for i in box_nms(boxes, np.asarray([c.iou for c in candidates]), BOX_IOU)]
        masks, changed = np.zeros((len(distinct), *frame.shape[:2]), bool), np.zeros(len(distinct), bool)
        for n, candidate in enumerate(distinct):
            masks[n], changed[n] = remove_small_regions(candidate.mask, 100)
        boxes = np.asarray([box_of(mask) for mask in masks], np.float64).reshape(-1, 4)
        kept = np.sort(box_nms(boxes, 1.0 - changed, BOX_IOU))
        masks = masks[kept]
        scores = np.asarray([distinct[i].iou * distinct[i].stability for i in kept], np.float64)
        kept = langsplat_nms(masks, scores)
        return masks[kept], scores[kept]

    def _predict(self, encoded: EncodedFrame, points: np.ndarray) -> Iterator[_Candidate]:
        """Yields the masks of points (P, 2) in px that are good and stable, in the order of the points."""
        start = 0
        for logits, ious in self._graphs.decode(encoded, points):
            for row, token in zip(*np.nonzero(ious > 0.7)):
                if token not in TOKENS[self._level]:
                    continue
                mask_logits = self._graphs.to_frame(logits[row, token], encoded)
                steady = stability(mask_logits, 1.0)
                mask = mask_logits > 0
                if steady >= 0.85 and mask.any():
                    yield _Candidate(mask, float(ious[row, token]), steady, int(token), start + int(row))
            start += len(ious)

    def check(self) -> str:
        """Opens and closes the graphs, and describes the model in a sentence."""
        graphs = self._graphs
        self.close()
        many = "one prompt per run" if graphs.batch == 1 else f"{graphs.batch} prompts per run"
        kind = "SAM 2" if graphs.stretched else "SAM"
        return f"masks of every frame; decoder of {kind}, {many}, images of {graphs.side} px"

    def close(self) -> None:
        """Closes the graphs and frees their memory; they are opened again when needed."""
        self.__dict__.pop("_graphs", None)

    @functools.cached_property
    def _graphs(self) -> SamGraphs:
        return SamGraphs(*self._files)
