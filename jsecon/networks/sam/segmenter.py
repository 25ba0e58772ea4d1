"""Segmenter by SAM on ONNX Runtime: the automatic mask generator with LangSplat's levels (minghanqin/LangSplat,
preprocess.py).

A grid of points is put to the frame and to crops of it; each point gives three masks: subpart, part and whole, the
levels s, m and l; `default` pools all three. Masks that the model thinks poor, that are not stable, or that a crop cuts
are dropped, then repetitions by box, then small holes and islands, then LangSplat's suppression by masks.
"""

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from jsecon.networks.sam.graphs import SamFiles, SamGraphs, find_sam
from jsecon.networks.sam.masks import (
    Crop,
    box_nms,
    box_of,
    crops_of,
    cut_by_crop,
    langsplat_nms,
    point_grid,
    stability,
    tidied,
)

Level = Literal["default", "s", "m", "l"]
TOKENS: dict[str, tuple[int, ...]] = {"default": (0, 1, 2), "s": (0,), "m": (1,), "l": (2,)}
"""level -> which of a point's three masks it takes"""


class Candidate(NamedTuple):
    """One predicted mask on its way through the filters."""

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
    """Of the automatic mask generator. The defaults are LangSplat's (preprocess.py)."""

    level: Level = "l"
    """what a call returns"""
    points_per_side: int = 32
    """of the grid of points put to each crop"""
    predicted_iou: float = 0.7
    """a mask must be predicted to be better than this"""
    stability: float = 0.85
    """least IoU of the masks at logits of +- `stability_offset`"""
    stability_offset: float = 1.0
    box_iou: float = 0.7
    """boxes of a higher IoU repeat each other"""
    crop_layers: int = 1
    """layers of 4^k crops beside the whole frame. A frame costs 1 + 4 + ... 4^layers encoder runs and as many grids of
    prompts: without crops a fifth of LangSplat's"""
    crop_overlap: float = 512 / 1500
    """of neighbouring crops, as a share of the frame's shorter side"""
    least_area: int = 100
    """px: smaller holes are filled, smaller islands removed"""
    mask_iou: float = 0.8
    """`langsplat_nms`: a mask of a higher IoU with a better one goes"""
    mask_score: float = 0.7
    """`langsplat_nms`: least stability times predicted IoU"""
    mask_inner: float = 0.5
    """`langsplat_nms`: of masks inside of others"""


class SamSegmenter:
    """Segmenter (jsecon.vision.protocols) by a SAM model folder, or its files.

    `batch` prompts go to the decoder at once where it takes more than one; `threads` as for `Graph`. Graphs are opened
    when first needed and kept until `close`. `name` follows from the content of the files and the settings. Raises
    InputError where the folder holds no SAM model, and later where a graph is of another kind, naming the tensor.
    """

    def __init__(
        self,
        model: str | Path | SamFiles,
        settings: SamSettings | None = None,
        *,
        batch: int = 64,
        threads: int | None = None,
    ):
        self.files = model if isinstance(model, SamFiles) else find_sam(model)
        self.settings = settings or SamSettings()
        self._batch, self._threads = batch, threads
        self.name = f"sam-{self.files.digest(extra=repr(self.settings))}"

    def __call__(self, frame: UInt8[np.ndarray, "h w 3"], index: int) -> Bool[np.ndarray, "m h w"]:
        """frame (H, W, 3) uint8 RGB -> masks (M, H, W) bool of the level, best score first; they may overlap."""
        level = self.settings.level
        return self.levels(frame, (level,))[level][0]

    def levels(
        self, frame: UInt8[np.ndarray, "h w 3"], levels: Sequence[Level] = ("default", "s", "m", "l")
    ) -> dict[str, tuple[Bool[np.ndarray, "m h w"], Float64[np.ndarray, " m"]]]:
        """Masks (M, H, W) and scores (M,), stability times predicted IoU, of each level, best first; the points are
        put once for all levels."""
        wanted = sorted({token for level in levels for token in TOKENS[level]})
        height, width = frame.shape[:2]
        crops = crops_of(height, width, self.settings.crop_layers, self.settings.crop_overlap)
        by_crop = [list(self._candidates(frame, crop, wanted)) for crop in crops]
        return {level: self._filtered((height, width), by_crop, TOKENS[level]) for level in levels}

    def check(self) -> None:
        """Opens and closes the graphs. Raises InputError where they are damaged, or no SAM model's."""
        _ = self._graphs
        self.close()

    def close(self) -> None:
        """Drops the graphs and their memory; they are opened again when needed."""
        self.__dict__.pop("_graphs", None)

    @functools.cached_property
    def _graphs(self) -> SamGraphs:
        return SamGraphs(self.files, batch=self._batch, threads=self._threads)

    def _candidates(self, frame: np.ndarray, crop: Crop, tokens: Sequence[int]) -> Iterable[Candidate]:
        """The masks of one crop that are good, stable and not cut off, in the order of the points."""
        height, width = frame.shape[:2]
        part = np.ascontiguousarray(frame[crop.top : crop.bottom, crop.left : crop.right])
        encoded = self._graphs.encode(part)
        points = point_grid(self.settings.points_per_side) * np.array([part.shape[1], part.shape[0]], np.float32)
        for logits, ious in self._graphs.decode(encoded, points):
            for prompt, token in zip(*np.nonzero(ious > self.settings.predicted_iou)):
                if token not in tokens:
                    continue
                mask_logits = self._graphs.to_frame(logits[prompt, token], encoded)
                steady = stability(mask_logits, self.settings.stability_offset)
                if steady < self.settings.stability:
                    continue
                whole = np.zeros((height, width), bool)
                whole[crop.top : crop.bottom, crop.left : crop.right] = mask_logits > 0
                box = box_of(whole)
                if whole.any() and not cut_by_crop(box, crop, width, height):
                    yield Candidate(np.packbits(whole), box, float(ious[prompt, token]), steady, int(token), crop)

    def _filtered(
        self, size: tuple[int, int], by_crop: list[list[Candidate]], tokens: tuple[int, ...]
    ) -> tuple[Bool[np.ndarray, "m h w"], Float64[np.ndarray, " m"]]:
        """What is left of the candidates of some tokens, and the scores."""
        left: list[Candidate] = []
        for candidates in by_crop:
            own = [c for c in candidates if c.token in tokens]
            left += [own[i] for i in box_nms(_boxes(own), np.asarray([c.iou for c in own]), self.settings.box_iou)]
        # Of what several crops show, the smaller crop's is the finer; with one crop this changes nothing.
        fineness = np.asarray([1.0 / c.crop.area for c in left])
        left = [left[i] for i in box_nms(_boxes(left), fineness, self.settings.box_iou)]
        masks, changed = np.zeros((len(left), *size), bool), np.zeros(len(left), bool)
        for n, candidate in enumerate(left):
            whole = np.unpackbits(candidate.bits, count=size[0] * size[1]).reshape(size).astype(bool)
            masks[n], changed[n] = tidied(whole, self.settings.least_area)
        boxes = np.asarray([box_of(mask) for mask in masks], np.float64).reshape(-1, 4)
        kept = np.sort(box_nms(boxes, 1.0 - changed, self.settings.box_iou))
        masks, scores = masks[kept], np.asarray([left[i].iou * left[i].stability for i in kept], np.float64)
        iou, score, inner = self.settings.mask_iou, self.settings.mask_score, self.settings.mask_inner
        kept = langsplat_nms(masks, scores, iou_threshold=iou, score_threshold=score, inner_threshold=inner)
        return masks[kept], scores[kept]


def _boxes(candidates: list[Candidate]) -> Float64[np.ndarray, "m 4"]:
    return np.asarray([c.box for c in candidates], np.float64).reshape(-1, 4)
