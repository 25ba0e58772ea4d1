"""Segmenter by SAM, SlimSAM, EdgeTAM or SAM 2.1 on ONNX Runtime: the automatic mask generator.

Points prompt the frame and crops of it: one in the middle of each region that differs by colour, then some in what the
masks of these do not explain (guided prompts), or the 1,024 points of SAM's grid. Each point gives three masks:
subpart, part and whole, the levels s, m and l; the level `default` pools all three. Masks that the model predicts to be
poor, that are not stable or that a crop cuts off are dropped, then repetitions by box, then small holes and islands are
removed, then LangSplat's suppression of masks by masks follows (minghanqin/LangSplat, preprocess.py). The steps are
those of facebookresearch/segment-anything, automatic_mask_generator.py. All of it runs on the host, on NumPy arrays.

A model folder has onnx/vision_encoder.onnx and onnx/prompt_encoder_mask_decoder.onnx, as exported for transformers.js,
and preprocessor_config.json, which states how colours are scaled. The decoder takes input_points (1, B, P, 2) and
input_labels (1, B, P) and gives iou_scores and pred_masks. There are two kinds, which differ in its other inputs:
    SAM      image_embeddings of a frame that is scaled by its longer side and padded; a batch of prompts in one run
    SAM 2    image_embeddings.0, .1 and .2 of a frame that is stretched to a square, as EdgeTAM and SAM 2.1 have;
             input_boxes (1, 0, 4), so one prompt a run
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8
from PIL import Image
from scipy import sparse

from jsecon.errors import InputError, require
from jsecon.networks.clip import read_preprocessing
from jsecon.networks.hub import NoSuchFilesError, Precision, find_files
from jsecon.networks.prompts import GuidedPrompts
from jsecon.networks.session import Graph, batches, content_digest, graph_files

IMAGE_SIDE = 1024
"""px of the encoder's square image, if neither its file nor the configuration fixes it"""
EDGE = 20.0
"""px: a box this close to the edge of a crop was probably cut off by it"""
BATCH = 4
"""prompts of one run, if the decoder does not fix it: of EdgeTAM's decoder on two cores, 8 take 42 ms each, one alone
34 ms; 64 of SAM's take more than 1 GiB"""

Level = Literal["default", "s", "m", "l"]
Prompts = Literal["guided", "grid"]
TOKENS: dict[str, tuple[int, ...]] = {"default": (0, 1, 2), "s": (0,), "m": (1,), "l": (2,)}
"""level -> which of a point's three masks it takes"""


class SamFiles(NamedTuple):
    """Files and settings of a SAM model."""

    encoder: Path
    """graph of frames"""
    decoder: Path
    """graph of prompts"""
    mean: tuple[float, ...]
    """mean of RGB in 0..1"""
    std: tuple[float, ...]
    """standard deviation of RGB in 0..1"""
    side: int | None = None
    """side of the square image in px, or None"""


def find_sam(folder: str | Path, precision: Precision | None = None) -> SamFiles:
    """Finds the files of the SAM model in a folder.

    Args:
      folder: The folder.
      precision: Precision of its graphs, if the folder has such ones; else the highest that is there.

    Returns:
      The files, and how the model takes colours.

    Raises:
      InputError: A file is missing, or the configuration cannot be read.
    """
    try:
        encoder, decoder, config = find_files(folder, "segmenter", precision)
    except NoSuchFilesError:
        encoder, decoder, config = find_files(folder, "segmenter")
    return SamFiles(encoder, decoder, *read_preprocessing(config))


class EncodedFrame(NamedTuple):
    """A frame as the decoder needs it."""

    features: dict[str, np.ndarray]
    """by the decoder's names"""
    size: tuple[int, int]
    """(H, W) px of the frame"""
    scaled: tuple[int, int]
    """(H, W) px of the frame within the encoder's square"""


class SamGraphs:
    """SAM's two graphs, ready to run.

    Args:
      files: The model's files.
      batch: Number of prompts of one run of the decoder, if it does not fix it.

    Attributes:
      batch: Number of prompts of one run.
      side: Side of the encoder's square image in px.
      stretched: Whether frames are stretched to a square (SAM 2), else scaled and padded (SAM).

    Raises:
      InputError: A graph has other tensors than SAM.
    """

    def __init__(self, files: SamFiles, *, batch: int = BATCH):
        self.files = files
        self._encoder = Graph(files.encoder)
        self._decoder = Graph(files.decoder)
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
        self.batch = self._fixed_batch or batch
        self.side = image.fixed(3) or files.side or IMAGE_SIDE
        self._links = [name for name in inputs if name not in ("input_points", "input_labels", "input_boxes")]
        for name in self._links:
            what = f"the encoder that {files.decoder.name} belongs to"
            self._encoder.require("output", name, inputs[name].shape or (), what)
        self._mean, self._std = 255 * np.asarray((files.mean, files.std), np.float32)

    def _not_three_masks(self, problem: str) -> InputError:
        expected = "3 or 4 masks per prompt, from the smallest part to the whole, each with its score"
        where = f"{self.files.decoder}, output 'pred_masks'"
        return InputError(where, problem, expected, "Export the decoder with all of its masks.")

    def encode(self, frame: UInt8[np.ndarray, "h w 3"]) -> EncodedFrame:
        """Encodes a frame.

        It is resized by Pillow, as in SAM's training: its kernel widens if an image shrinks, OpenCV's does not.

        Args:
          frame: (H, W, 3) RGB.

        Returns:
          Its features, for `decode`.
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
        """Predicts the masks of prompts, batch by batch.

        Args:
          encoded: The frame.
          points: (P, 2) points x, y in px of the frame.

        Yields:
          Mask logits (B, 3, L, L) from part to whole, and predicted IoUs (B, 3). Of four masks the first is left out:
          it is SAM's one mask for several points.
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
        """Resizes the logits of a mask to the frame, bilinearly, through the encoder's square as SAM does.

        Args:
          logits: (L, L) from `decode`.
          encoded: The frame.

        Returns:
          (H, W) logits.
        """
        size = encoded.size[::-1]
        if self.stretched:
            return cv2.resize(logits, size)
        square = cv2.resize(logits, (self.side, self.side))
        return cv2.resize(np.ascontiguousarray(square[: encoded.scaled[0], : encoded.scaled[1]]), size)


class Crop(NamedTuple):
    """A part of the frame in px, half open."""

    left: int
    top: int
    right: int
    bottom: int
    layer: int
    """0: the whole frame; k: one of 4^k crops"""

    @property
    def area(self) -> int:
        """Area in px^2."""
        return (self.right - self.left) * (self.bottom - self.top)


class _Candidate(NamedTuple):
    """A predicted mask on its way through the filters."""

    bits: np.ndarray
    """the frame's pixels, packed"""
    box: tuple[int, int, int, int]
    iou: float
    """as the model predicts it"""
    stability: float
    token: int
    crop: Crop


@dataclasses.dataclass(frozen=True)
class SamSettings:
    """Settings of the mask generator. The defaults are LangSplat's (preprocess.py), except for the prompts."""

    level: Level = "l"
    """Level of the masks that a call returns."""
    prompts: Prompts = "guided"
    """Where the points are: "guided", in regions by colour and in what their masks leave unexplained (`GuidedPrompts`),
    or "grid", SAM's own."""
    points_per_side: int = 32
    """Points along each side of the grid of a crop."""
    predicted_iou: float = 0.7
    """A mask must be predicted to be better than this."""
    stability: float = 0.85
    """Least IoU of the masks at logits of +- `stability_offset`."""
    stability_offset: float = 1.0
    """Offset in logits."""
    box_iou: float = 0.7
    """Boxes with a higher IoU repeat each other."""
    crop_layers: int = 1
    """Layers of 4^k crops beside the whole frame. A frame takes 1 + 4 + ... 4^layers runs of the encoder and as many
    grids of prompts: without crops a fifth of LangSplat's time."""
    crop_overlap: float = 512 / 1500
    """Overlap of neighbouring crops, as a share of the frame's shorter side."""
    least_area: int = 100
    """px; smaller holes are filled, smaller islands removed."""


class SamSegmenter:
    """Segmenter (jsecon.vision.protocols) that runs a SAM model.

    The graphs are opened when first needed and stay open until `close`.

    Args:
      files: The model's files.
      settings: Settings of the mask generator.
      batch: Number of prompts of one run, as for `SamGraphs`.

    Attributes:
      name: Follows from the content of the files and the settings.

    Raises:
      InputError: A file cannot be read. Methods raise it if a graph has other tensors than SAM.
    """

    def __init__(self, files: SamFiles, settings: SamSettings | None = None, *, batch: int = BATCH):
        self.files = files
        self.settings = settings or SamSettings()
        graphs = [*graph_files(files.encoder), *graph_files(files.decoder)]
        self.name = f"sam-{content_digest(graphs, extra=f'{self.settings}{files.mean}{files.std}')}"
        self._batch = batch

    def __call__(self, frame: UInt8[np.ndarray, "h w 3"], index: int) -> Bool[np.ndarray, "m h w"]:
        """Segments a frame.

        Args:
          frame: (H, W, 3) RGB.
          index: Index of the frame; not used.

        Returns:
          (M, H, W) masks of the level, best score first; they may overlap.
        """
        return self.segment(frame)[0]

    def segment(self, frame: UInt8[np.ndarray, "h w 3"]) -> tuple[Bool[np.ndarray, "m h w"], Float64[np.ndarray, " m"]]:
        """Segments a frame.

        Args:
          frame: (H, W, 3) RGB.

        Returns:
          Masks (M, H, W) and their scores (M,), stability times predicted IoU, best first.
        """
        settings = self.settings
        height, width = frame.shape[:2]
        left: list[_Candidate] = []
        for crop in crops_of(height, width, settings.crop_layers, settings.crop_overlap):
            of_crop = list(self._candidates(frame, crop))
            left += self._without_repetitions(of_crop, [c.iou for c in of_crop])
        # Of what several crops show, the smaller crop's is the finer; one crop stays as it is.
        left = self._without_repetitions(left, [1.0 / c.crop.area for c in left])
        masks, changed = np.zeros((len(left), height, width), bool), np.zeros(len(left), bool)
        for n, candidate in enumerate(left):
            masks[n], changed[n] = remove_small_regions(_unpacked(candidate.bits, height, width), settings.least_area)
        boxes = np.asarray([box_of(mask) for mask in masks], np.float64).reshape(-1, 4)
        kept = np.sort(box_nms(boxes, 1.0 - changed, settings.box_iou))
        masks = masks[kept]
        scores = np.asarray([left[i].iou * left[i].stability for i in kept], np.float64)
        kept = langsplat_nms(masks, scores)
        return masks[kept], scores[kept]

    def check(self) -> None:
        """Opens and closes the graphs.

        Raises:
          InputError: A graph is damaged, or not a SAM model's.
        """
        _ = self._graphs
        self.close()

    def close(self) -> None:
        """Closes the graphs and frees their memory; they are opened again when needed."""
        self.__dict__.pop("_graphs", None)

    @functools.cached_property
    def _graphs(self) -> SamGraphs:
        return SamGraphs(self.files, batch=self._batch)

    def _without_repetitions(self, candidates: list[_Candidate], scores: list[float]) -> list[_Candidate]:
        """Returns the candidates whose boxes do not repeat one of a higher score, best first."""
        boxes = np.asarray([c.box for c in candidates], np.float64).reshape(-1, 4)
        return [candidates[i] for i in box_nms(boxes, np.asarray(scores), self.settings.box_iou)]

    def _candidates(self, frame: np.ndarray, crop: Crop) -> Iterator[_Candidate]:
        """Yields the masks of one crop that are good, stable and not cut off, in the order of the points."""
        part = np.ascontiguousarray(frame[crop.top : crop.bottom, crop.left : crop.right])
        encoded = self._graphs.encode(part)
        if self.settings.prompts == "grid":
            points = point_grid(self.settings.points_per_side) * np.array([part.shape[1], part.shape[0]], np.float32)
            yield from (candidate for _, candidate in self._predicted(frame, crop, encoded, points))
            return
        tokens = TOKENS[self.settings.level]
        prompts = GuidedPrompts(part, len(tokens))
        while len(points := prompts.next_points()):
            for number, candidate in self._predicted(frame, crop, encoded, points):
                mask = _unpacked(candidate.bits, *frame.shape[:2])[crop.top : crop.bottom, crop.left : crop.right]
                prompts.explain(tokens.index(candidate.token), points[number], mask)
                yield candidate

    def _predicted(
        self, frame: np.ndarray, crop: Crop, encoded: EncodedFrame, points: np.ndarray
    ) -> Iterator[tuple[int, _Candidate]]:
        """Yields the masks of points (P, 2) in px of a crop, each with the number of its point."""
        height, width = frame.shape[:2]
        start = 0
        for logits, ious in self._graphs.decode(encoded, points):
            for prompt, token in zip(*np.nonzero(ious > self.settings.predicted_iou)):
                if token not in TOKENS[self.settings.level]:
                    continue
                mask_logits = self._graphs.to_frame(logits[prompt, token], encoded)
                steady = stability(mask_logits, self.settings.stability_offset)
                if steady < self.settings.stability:
                    continue
                mask = np.zeros((height, width), bool)
                mask[crop.top : crop.bottom, crop.left : crop.right] = mask_logits > 0
                box = box_of(mask)
                if mask.any() and not cut_by_crop(box, crop, width, height):
                    iou = float(ious[prompt, token])
                    yield start + prompt, _Candidate(np.packbits(mask), box, iou, steady, int(token), crop)
            start += len(ious)


def _unpacked(bits: np.ndarray, height: int, width: int) -> Bool[np.ndarray, "h w"]:
    return np.unpackbits(bits, count=height * width).reshape(height, width).astype(bool)


def point_grid(side: int) -> Float32[np.ndarray, "p 2"]:
    """Makes SAM's grid of points.

    Args:
      side: Points a side, at least 1.

    Returns:
      (side^2, 2) x, y in 0..1, the centres of side x side cells, x fastest.

    Raises:
      ValueError: side is below 1.
    """
    require(side >= 1, "side", side, "at least 1", "SAM's default is 32.")
    line = np.linspace(1 / (2 * side), 1 - 1 / (2 * side), side)
    return np.stack(np.meshgrid(line, line), -1).reshape(-1, 2).astype(np.float32)


def crops_of(height: int, width: int, layers: int, overlap: float) -> list[Crop]:
    """Cuts a frame into crops: 2^k x 2^k in layer k.

    Args:
      height: px of the frame.
      width: px of the frame.
      layers: Number of layers of crops.
      overlap: Neighbours overlap by this share of the frame's shorter side, times 2 / 2^k.

    Returns:
      The whole frame, then the crops layer by layer, column by column.
    """
    crops = [Crop(0, 0, width, height, 0)]
    for layer in range(1, layers + 1):
        number = 2**layer
        common = int(overlap * min(height, width) * 2 / number)
        long = [math.ceil((common * (number - 1) + length) / number) for length in (width, height)]
        starts = [[(size - common) * i for i in range(number)] for size in long]
        for left, top in itertools.product(*starts):
            crops.append(Crop(left, top, min(left + long[0], width), min(top + long[1], height), layer))
    return crops


def langsplat_nms(masks: Bool[np.ndarray, "m h w"], scores: Float[np.ndarray, " _"]) -> Int64[np.ndarray, " k"]:
    """LangSplat's suppression of masks by masks.

    A mask is kept if its score is above 0.7, no better mask has an IoU above 0.8 with it, and it lies inside of no
    other: at least 0.85 of it in a mask of which that is less than half, with (share of it) * (share of the other)
    below 0.5. A mask that is itself dropped still suppresses. Of equal scores the earlier counts as better. Empty masks
    are dropped.

    Args:
      masks: (M, H, W).
      scores: (M,), stability times predicted IoU.

    Returns:
      (K,) indices of the masks that are kept, best score first.

    Raises:
      ValueError: The numbers of masks and scores differ.
    """
    require(len(scores) == len(masks), "scores", len(scores), str(len(masks)), "One score per mask.")
    order = np.argsort(-scores, kind="stable")
    shared = shared_areas(masks[order])
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


def shared_areas(masks: Bool[np.ndarray, "m h w"]) -> Float64[np.ndarray, "m m"]:
    """Counts the pixels that any two masks share.

    Args:
      masks: (M, H, W) bool.

    Returns:
      (M, M) numbers of pixels; the diagonal has the areas.
    """
    rows = sparse.csr_matrix(masks.reshape(len(masks), masks.shape[1] * masks.shape[2])).astype(np.int32)
    return (rows @ rows.T).toarray().astype(np.float64)


def stability(logits: Float[np.ndarray, "h w"], offset: float) -> float:
    """Compares the masks of logits at two thresholds.

    Args:
      logits: (H, W).
      offset: The thresholds are +offset and -offset.

    Returns:
      IoU of the two masks; 0 if the wider one is empty.
    """
    wide = int(np.count_nonzero(logits > -offset))
    return int(np.count_nonzero(logits > offset)) / wide if wide else 0.0


def box_of(mask: Bool[np.ndarray, "h w"]) -> tuple[int, int, int, int]:
    """Finds the outermost pixels of a mask.

    Args:
      mask: (H, W) bool.

    Returns:
      (left, top, right, bottom), all within the mask; zeros if it is empty.
    """
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return (int(columns[0]), int(rows[0]), int(columns[-1]), int(rows[-1])) if len(rows) else (0, 0, 0, 0)


def cut_by_crop(box: tuple[int, int, int, int], crop: Crop, width: int, height: int) -> bool:
    """Whether the edge of a crop probably cuts off a thing.

    Args:
      box: (left, top, right, bottom) of its mask, px of the frame.
      crop: The crop.
      width: px of the frame.
      height: px of the frame.

    Returns:
      True if the box lies within EDGE of an edge of the crop that is no edge of the frame.
    """
    pairs = zip(box, (crop.left, crop.top, crop.right, crop.bottom), (0, 0, width, height))
    return any(abs(side - edge) <= EDGE and abs(side - frame) > EDGE for side, edge, frame in pairs)


def box_nms(
    boxes: Float[np.ndarray, "m 4"], scores: Float[np.ndarray, " m"], threshold: float
) -> Int64[np.ndarray, " k"]:
    """Non-maximum suppression of boxes.

    Areas are (right - left) * (bottom - top) of the coordinates as they are; a box without area overlaps no other. Of
    equal scores the earlier goes first.

    Args:
      boxes: (M, 4) left, top, right, bottom.
      scores: (M,).
      threshold: A box with a higher IoU with a better one is dropped.

    Returns:
      (K,) indices of the boxes that are kept, best score first.
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


def remove_small_regions(mask: Bool[np.ndarray, "h w"], least: int) -> tuple[Bool[np.ndarray, "h w"], bool]:
    """Fills small holes of a mask, then removes small islands (8-connected).

    Args:
      mask: (H, W) bool.
      least: Pixels from which a hole or island is not small.

    Returns:
      The mask (H, W), and whether it changed. If every island is small, the largest stays.
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
