"""Segmenter by SAM, SlimSAM, EdgeTAM or SAM 2.1 on ONNX Runtime: the automatic mask generator.

Points prompt the frame: one in the middle of each region that differs by colour, then some in what the masks of these
do not explain. Each point gives three masks: subpart, part and whole, the levels s, m and l; the
level `default` pools all three. Masks that the model predicts to be poor or that are not stable are dropped, then
repetitions by box, then small holes and islands are removed, then LangSplat's suppression of masks by masks follows.
These steps are those of facebookresearch/segment-anything (automatic_mask_generator.py) and of minghanqin/LangSplat
(preprocess.py). All of it runs on the host, on NumPy arrays.

A model folder has onnx/vision_encoder.onnx and onnx/prompt_encoder_mask_decoder.onnx, as exported for transformers.js,
and preprocessor_config.json, which states how colours are scaled. The decoder takes input_points (1, B, P, 2) and
input_labels (1, B, P) and gives iou_scores and pred_masks. Each run has one point: 8 prompts in one run of EdgeTAM's
decoder take 42 ms each on two cores, one alone 34 ms. There are two kinds, which differ in its other inputs:
    SAM      image_embeddings of a frame that is scaled by its longer side and padded
    SAM 2    image_embeddings.0, .1 and .2 of a frame that is stretched to a square, as EdgeTAM and SAM 2.1 have;
             input_boxes (1, 0, 4)
"""

import functools
import hashlib
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64, UInt8
from PIL import Image
from scipy import sparse

from jsecon.errors import InputError
from jsecon.networks.clip import read_preprocessing
from jsecon.networks.hub import find_files
from jsecon.networks.session import Graph, content_digest
from jsecon.process import VIEWS_AT_ONCE, cores
from jsecon.vision.classical import ClassicalSegmenter
from jsecon.vision.stores import stored_array

_BOX_IOU = 0.7
"""boxes with a higher IoU repeat each other; this and the thresholds in the code are LangSplat's (preprocess.py)"""
_MAX_PROMPTS, _MAX_ROUNDS = 96, 4
"""guided prompts of an image, a tenth of SAM's grid, and their rounds; later rounds go to what is not explained yet"""

Level = Literal["default", "s", "m", "l"]
TOKENS: dict[str, tuple[int, ...]] = {"default": (0, 1, 2), "s": (0,), "m": (1,), "l": (2,)}
"""level -> which of a point's three masks it takes"""


class _EncodedFrame(NamedTuple):
    """A frame as the decoder needs it."""

    features: dict[str, np.ndarray]
    """by the decoder's names"""
    size: tuple[int, int]
    """(H, W) px of the frame"""
    scaled: tuple[int, int]
    """(H, W) px of the frame within the encoder's square"""


class _SamGraphs:
    """SAM's two graphs, ready to run, or an InputError if one has other tensors than SAM.

    Args:
      encoder: Graph of frames.
      decoder: Graph of prompts.
      config: preprocessor_config.json.

    Attributes:
      side: Side of the encoder's square image in px.
      stretched: Whether frames are stretched to a square (SAM 2), else scaled and padded (SAM).
    """

    def __init__(self, encoder: Path, decoder: Path, config: Path):
        mean, std, side = read_preprocessing(config)
        threads = -(-cores() // VIEWS_AT_ONCE)  # frames are segmented side by side (parallel.map_views)
        self._encoder, self._decoder = Graph(encoder, threads), Graph(decoder, threads)
        image = self._encoder.require("input", "pixel_values", (1, 3, None, None), "SAM's image encoder")
        inputs = self._decoder.inputs
        self.stretched = "image_embeddings.0" in inputs
        what = "SAM's mask decoder"
        self._decoder.require("output", "iou_scores", (1, None, None), what)
        self._decoder.require("output", "pred_masks", (1, None, None, None, None), what)
        self.side = image.fixed(3) or side or 1024
        self._links = [name for name in inputs if name not in ("input_points", "input_labels", "input_boxes")]
        for name in self._links:
            what = f"the encoder that {decoder.name} belongs to"
            self._encoder.require("output", name, inputs[name].shape or (), what)
        self._mean, self._std = 255 * np.asarray((mean, std), np.float32)

    def encode(self, frame: UInt8[np.ndarray, "h w 3"]) -> _EncodedFrame:
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
        return _EncodedFrame(features, (height, width), size)

    def decode(
        self, encoded: _EncodedFrame, point: Float32[np.ndarray, " 2"]
    ) -> tuple[Float32[np.ndarray, "3 l l"], Float32[np.ndarray, " 3"]]:
        """Predicts mask logits from part to whole, and their IoUs, at a point x, y in px of the frame.

        Of four masks the first is left out: it is SAM's one mask for several points.
        """
        scaled = point * np.divide(encoded.scaled[::-1], encoded.size[::-1], dtype=np.float32)
        feeds = dict(encoded.features)
        feeds["input_points"] = scaled.reshape(1, 1, 1, 2)
        feeds["input_labels"] = np.ones((1, 1, 1), np.int64)
        if "input_boxes" in self._decoder.inputs:
            feeds["input_boxes"] = np.zeros((1, 0, 4), np.float32)
        outputs = self._decoder.run(feeds, ["pred_masks", "iou_scores"])
        masks, scores = outputs["pred_masks"][0, 0], outputs["iou_scores"][0, 0]
        if len(masks) != len(scores) or len(masks) not in (3, 4):
            where, problem = f"{self._decoder.path}, output 'pred_masks'", f"{len(masks)} masks, {len(scores)} scores"
            expected = "3 or 4 masks per prompt, from the smallest part to the whole, each with its score"
            raise InputError(where, problem, expected, "Export the decoder with all of its masks.")
        return masks[-3:].astype(np.float32), scores[-3:].astype(np.float32)

    def to_frame(self, logits: Float32[np.ndarray, "l l"], encoded: _EncodedFrame) -> Float32[np.ndarray, "h w"]:
        """Resizes the logits of a mask to the frame, bilinearly, through the encoder's square as SAM does."""
        size = encoded.size[::-1]
        if self.stretched:
            return cv2.resize(logits, size)
        square = cv2.resize(logits, (self.side, self.side))
        return cv2.resize(np.ascontiguousarray(square[: encoded.scaled[0], : encoded.scaled[1]]), size)


class _GuidedPrompts:
    """Chooses points of an image, round by round: where its regions by colour are, then where masks explain too little.

    A pixel is explained at a level if a mask of that level holds it that was prompted within the pixel's own region. A
    mask of the table therefore does not explain the mug that stands on it.

    The regions are fine ones: a region that covers two objects costs a further round, and two regions of one object
    cost a prompt.
    """

    def __init__(self, image: UInt8[np.ndarray, "h w 3"], levels: int):
        self._regions = ClassicalSegmenter(merge_distance=10.0, layers=(1.0,)).partitions(image, 0)[0]
        self._explained = np.zeros((levels, *self._regions.shape), bool)
        self._prompted = np.zeros(self._regions.shape, bool)
        self._rounds = 0
        self._left = _MAX_PROMPTS

    def next_points(self) -> Float32[np.ndarray, "p 2"]:
        """Chooses the points x, y in px of the next round, largest patches first; none when no round is left."""
        patches = np.asarray(self._regions, np.int32)
        min_radius = 0.0
        if self._rounds:
            open_pixels = ~self._explained.all(0) & ~self._prompted
            borders = np.zeros_like(open_pixels)
            borders[:, 1:] |= self._regions[:, 1:] != self._regions[:, :-1]
            borders[1:] |= self._regions[1:] != self._regions[:-1]
            _, patches = cv2.connectedComponents((open_pixels & ~borders).astype(np.uint8), connectivity=4)
            patches = patches - 1
            min_radius = 0.008 * min(patches.shape)  # thinner patches lie along outlines
        remaining = self._left if self._rounds < _MAX_ROUNDS else 0
        pixels = _innermost_pixels(patches, min_radius)[:remaining]
        self._rounds += 1
        self._left -= len(pixels)
        self._prompted[pixels[:, 1], pixels[:, 0]] = True
        return pixels.astype(np.float32) + np.float32(0.5)

    def explain(self, level: int, point: Float32[np.ndarray, " 2"], mask: Bool[np.ndarray, "h w"]) -> None:
        """Takes a mask that a point x, y gave at a level."""
        column, row = point.astype(int)
        self._explained[level] |= mask & (self._regions == self._regions[row, column])


def _innermost_pixels(patches: Int32[np.ndarray, "h w"], min_radius: float = 0.0) -> Int64[np.ndarray, "p 2"]:
    """Finds the pixel (column, row) of each patch that is farthest from its outline, the farthest first.

    Args:
      patches: Numbers of patches, negative outside.
      min_radius: px; a patch whose pixels are all nearer to its outline is left out.
    """
    padded = np.pad(patches, 1, constant_values=-1)
    inner = padded >= 0
    for axis in (0, 1):
        for shift in (-1, 1):
            inner &= padded == np.roll(padded, shift, axis)
    distance = cv2.distanceTransform(inner.astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    order = np.argsort(-distance, axis=None, kind="stable")
    order = order[(patches.ravel()[order] >= 0) & (distance.ravel()[order] >= min_radius)]
    _, first = np.unique(patches.ravel()[order], return_index=True)
    chosen = order[np.sort(first)]
    return np.stack([chosen % patches.shape[1], chosen // patches.shape[1]], -1)


class _Candidate(NamedTuple):
    """A predicted mask on its way through the filters."""

    mask: np.ndarray
    """(H, W) bool"""
    iou: float
    """as the model predicts it"""
    stability: float


class SamSegmenter:
    """Segmenter (jsecon.vision.protocols) that runs a SAM model, or an InputError if a file is no such model's.

    The graphs are opened when first needed and stay open until `close`.

    Args:
      folder: The model folder.
      level: Level of the masks.
      store: Folder that keeps the masks of frames, so that a stopped run goes on; None keeps none. It has a file of the
        bits (M, ceil(H W / 8)) uint8, <digest of model, settings and frame>.safetensors, for each frame.

    Attributes:
      name: Follows from the content of the files and the level.
    """

    prompts: Any = _GuidedPrompts
    """chooses the points: made from a frame and the number of levels, it has `next_points` and `explain`"""

    _store: Path | None = None  # of a subclass without files

    def __init__(self, folder: str | Path, *, level: Level = "l", store: Path | None = None):
        self._store = store
        self._files = find_files(folder, "segmenter")
        encoder, decoder, config = self._files
        self._level = level
        extra = f"{level} {read_preprocessing(config)}"
        self.name = f"sam-{content_digest([encoder, decoder], extra=extra)}"

    def __call__(self, frame: UInt8[np.ndarray, "h w 3"], index: int) -> Bool[np.ndarray, "m h w"]:
        """Returns the masks (M, H, W) of a frame, best score first; they may overlap."""
        if self._store is None:
            return self._segment(frame)[0]
        height, width = frame.shape[:2]
        digest = hashlib.blake2b(f"{self.name} {frame.shape}".encode(), digest_size=16)
        digest.update(np.ascontiguousarray(frame).data)
        path = self._store / f"{digest.hexdigest()}.safetensors"
        bits = stored_array(path, lambda: np.packbits(self._segment(frame)[0].reshape(-1, height * width), axis=1))
        return np.unpackbits(bits, axis=1, count=height * width).reshape(-1, height, width).astype(bool)

    def _segment(
        self, frame: UInt8[np.ndarray, "h w 3"]
    ) -> tuple[Bool[np.ndarray, "m h w"], Float64[np.ndarray, " m"]]:
        """Returns the masks of a frame and their scores, stability times predicted IoU, best first."""
        frame = np.ascontiguousarray(frame)
        tokens = TOKENS[self._level]
        encoded = self._graphs.encode(frame)
        prompts = self.prompts(frame, len(tokens))
        candidates: list[_Candidate] = []
        while len(points := prompts.next_points()):
            for point in points:
                logits, ious = self._graphs.decode(encoded, point)
                for number, token in enumerate(tokens):
                    candidate = self._candidate(encoded, logits[token], float(ious[token]))
                    if candidate is not None:
                        prompts.explain(number, point, candidate.mask)
                        candidates.append(candidate)
        boxes = np.asarray([_box_of(candidate.mask) for candidate in candidates], np.float64).reshape(-1, 4)
        distinct = [candidates[i] for i in _box_nms(boxes, np.asarray([c.iou for c in candidates]), _BOX_IOU)]
        masks, changed = np.zeros((len(distinct), *frame.shape[:2]), bool), np.zeros(len(distinct), bool)
        for n, candidate in enumerate(distinct):
            masks[n], changed[n] = _remove_small_regions(candidate.mask, 100)
        boxes = np.asarray([_box_of(mask) for mask in masks], np.float64).reshape(-1, 4)
        kept = np.sort(_box_nms(boxes, 1.0 - changed, _BOX_IOU))
        masks = masks[kept]
        scores = np.asarray([distinct[i].iou * distinct[i].stability for i in kept], np.float64)
        kept = _langsplat_nms(masks, scores)
        return masks[kept], scores[kept]

    def _candidate(self, encoded: _EncodedFrame, logits: np.ndarray, iou: float) -> _Candidate | None:
        """Returns the mask of logits (L, L) if it is good and stable."""
        if iou <= 0.7:
            return None
        logits = self._graphs.to_frame(logits, encoded)
        # the IoU of the masks at +1 and -1
        stability = np.count_nonzero(logits > 1.0) / max(np.count_nonzero(logits > -1.0), 1)
        mask = logits > 0
        return _Candidate(mask, iou, stability) if stability >= 0.85 and mask.any() else None

    def check(self) -> None:
        """Opens and closes the graphs."""
        _SamGraphs(*self._files)

    def close(self) -> None:
        """Closes the graphs and frees their memory; they are opened again when needed."""
        self.__dict__.pop("_graphs", None)

    @functools.cached_property
    def _graphs(self) -> _SamGraphs:
        return _SamGraphs(*self._files)


def _box_of(mask: Bool[np.ndarray, "h w"]) -> tuple[int, int, int, int]:
    """Finds the outermost pixels (left, top, right, bottom) of a mask, all within it; zeros if it is empty."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return (int(columns[0]), int(rows[0]), int(columns[-1]), int(rows[-1])) if len(rows) else (0, 0, 0, 0)


def _box_nms(
    boxes: Float[np.ndarray, "m 4"], scores: Float[np.ndarray, " m"], threshold: float
) -> Int64[np.ndarray, " k"]:
    """Returns the indices of the boxes that have no higher IoU than `threshold` with a better one, best score first.

    Areas are (right - left) * (bottom - top) of the coordinates as they are; a box without area overlaps no other. Of
    equal scores the earlier goes first.
    """
    order = np.argsort(-scores, kind="stable")
    boxes = boxes[order].astype(np.float64)
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    alive = np.ones(len(boxes), bool)
    kept = []
    for i in range(len(boxes)):
        if alive[i]:
            kept.append(order[i])
            later = boxes[i + 1 :]
            sides = np.minimum(boxes[i, 2:], later[:, 2:]) - np.maximum(boxes[i, :2], later[:, :2])
            common = np.prod(np.maximum(sides, 0.0), axis=1)
            alive[i + 1 :] &= common <= threshold * (area[i] + area[i + 1 :] - common)
    return np.asarray(kept, np.int64)


def _remove_small_regions(mask: Bool[np.ndarray, "h w"], least: int) -> tuple[Bool[np.ndarray, "h w"], bool]:
    """Fills the holes of a mask below `least` px, then removes such islands (8-connected).

    Returns the mask, and whether it changed. If every island is small, the largest stays.
    """
    holes, areas = _components(~mask)
    small = np.flatnonzero(areas < least)
    filled = mask | np.isin(holes, small + 1) if len(small) else mask
    islands, areas = _components(filled)
    kept = np.flatnonzero(areas >= least)
    if len(areas) and not len(kept):
        kept = np.array([areas.argmax()])
    clean = np.isin(islands, kept + 1) if len(kept) < len(areas) else filled
    return clean, bool(len(small)) or len(kept) < len(areas)


def _components(mask: Bool[np.ndarray, "h w"]) -> tuple[np.ndarray, Float64[np.ndarray, " n"]]:
    """Labels (H, W), 0 outside, 1.. for the N components, and their areas."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return labels, stats[1:, cv2.CC_STAT_AREA].astype(np.float64)


def _langsplat_nms(masks: Bool[np.ndarray, "m h w"], scores: Float[np.ndarray, " _"]) -> Int64[np.ndarray, " k"]:
    """Returns the indices of the masks that LangSplat's suppression keeps, best score first.

    A mask is kept if its score (stability times predicted IoU) is above 0.7, no better mask has an IoU above 0.8 with
    it, and it lies inside of no other: at least 0.85 of it in a mask of which that is less than half, with (share of
    it) * (share of the other) below 0.5. A mask that is itself dropped still suppresses. Of equal scores the earlier
    counts as better. Empty masks are dropped.
    """
    order = np.argsort(-scores, kind="stable")
    rows = sparse.csr_matrix(masks[order].reshape(len(masks), masks.shape[1] * masks.shape[2])).astype(np.int32)
    shared = (rows @ rows.T).toarray().astype(np.float64)  # px that any two masks share
    area = np.diagonal(shared)
    union = area[:, None] + area[None, :] - shared
    overlap = np.triu(shared / np.maximum(union, 1.0), k=1)
    share = shared / np.maximum(area[:, None], 1.0)  # [i, j]: share of mask i that lies in mask j
    inside = (share.T >= 0.85) & (share < 0.5)  # [i, j]: j lies in i, and is less than half of it
    inner = np.where(inside, 1.0 - share * share.T, 0.0)
    kept = (
        (overlap.max(0, initial=0.0) <= 0.8) & (scores[order] > 0.7) & (inner.max(0, initial=0.0) <= 0.5) & (area > 0)
    )
    return order[kept]
