"""One frame of SAM 2 for one object: features, prompts, decoding with its choice of mask, occlusion, new memories.

Everything here follows the video predictor of the official package (facebookresearch/sam2), as its SAM 2 and SAM 2.1
configurations set it up. Logits are kept at a quarter of the network's image, L = S/4; above 0 is the object.
"""

import dataclasses

import cv2
import numpy as np
from PIL import Image

from jsecon.errors import require
from jsecon.networks.sam2.bank import Bank, from_bfloat16, pointers, reach, spatial_memories, to_bfloat16
from jsecon.networks.sam2.graphs import MEAN, STD, Sam2Graphs

ABSENT = -1024.0
"""logit of every pixel of an object that is not in the frame."""
MASK_LOGIT = 10.0
"""of a pixel of a mask that is given, not predicted; -10 outside it."""
STABILITY_DELTA = 0.05
STABILITY_LEAST = 0.98
"""a single mask whose area above +delta is a smaller share of that above -delta gives way to the best of three"""


@dataclasses.dataclass(frozen=True)
class Features:
    """What the image encoder says of a frame; shared by all objects."""

    top: np.ndarray
    """(1, C, G, G)."""
    fine: tuple[np.ndarray, np.ndarray]
    """(1, C/8, L, L) and (1, C/4, L/2, L/2)."""
    position: np.ndarray
    """(1, C, G, G), the same in every frame."""


@dataclasses.dataclass(frozen=True)
class Prompt:
    """What points out an object in a frame: a mask, or points."""

    frame: int
    mask: np.ndarray | None = None
    """(H, W) bool, or None."""
    points: np.ndarray | None = None
    """(P, 2) x, y in px of the frame, or None."""
    labels: np.ndarray | None = None
    """(P,) 1 inside, 0 outside, 2 and 3 the corners of a box (top left, bottom right)."""

    def __post_init__(self):
        given = [value is not None for value in (self.mask, self.points, self.labels)]
        fits, got = given in ([True, False, False], [False, True, True]), f"mask, points, labels given: {given}"
        require(fits, "Prompt", got, "a mask, or points with labels", "Give one of the two.")


@dataclasses.dataclass(frozen=True)
class Prediction:
    """An object in a frame."""

    logits: np.ndarray
    """(L, L) float32."""
    pointer: np.ndarray
    """(C,) float32."""
    score: float
    """logit of the object being in the frame."""


@dataclasses.dataclass(frozen=True)
class Standing:
    """What is the same in every tracked frame of every object."""

    place: np.ndarray
    """(T, M) float32: the spatial code that every memory gets."""
    no_prompt: dict[str, np.ndarray]
    """the prompt encoder's outputs without a prompt."""


def image_features(sam2: Sam2Graphs, frame: np.ndarray) -> Features:
    """frame (H, W, 3) uint8 RGB -> its features. The frame is brought to S x S without keeping its aspect."""
    size = sam2.sizes["S"]
    small = Image.fromarray(frame).resize((size, size), Image.Resampling.BICUBIC)
    image = ((np.asarray(small) / 255.0).astype(np.float32) - MEAN) / STD
    found = sam2.run("image_encoder", {"input_image": image.transpose(2, 0, 1)[None]})
    fine = found["backbone_fpn_0"], found["backbone_fpn_1"]
    return Features(found["backbone_fpn_2"], fine, found["vision_pos_enc_2"])


def prompted(sam2: Sam2Graphs, features: Features, prompt: Prompt, size: tuple[int, int]) -> Prediction:
    """The object that `prompt` points out in a frame of `size` (height, width), from that frame alone."""
    if prompt.mask is not None:
        return _mask_as_output(sam2, features, prompt.mask)
    points = np.asarray(prompt.points, np.float32) / np.array([size[1], size[0]], np.float32) * sam2.sizes["S"]
    image = features.top + sam2.constants["no_mem_embed"].reshape(1, -1, 1, 1)
    sparse = _prompt(sam2, points, np.asarray(prompt.labels, np.int32))
    return _decode(sam2, features, image, sparse, multimask=len(points) <= 1)


def tracked(
    sam2: Sam2Graphs, features: Features, bank: Bank, t: int, *, step: int, count: int, standing: Standing
) -> Prediction:
    """The object of `bank` in frame `t` of `count`, tracked in direction `step`, from what the bank remembers."""
    image = _with_memory(sam2, features, bank, t, step, count, standing.place)
    return _decode(sam2, features, image, standing.no_prompt, multimask=True)


def standing(sam2: Sam2Graphs, features: Features) -> Standing:
    """The model's standing inputs; the features may be of any frame."""
    size = sam2.sizes["S"]
    blank = np.zeros((1, 1, size, size), np.float32)
    place = sam2.run("memory_encoder", {"pix_feat": features.top, "masks": blank})["vision_pos_enc"]
    return Standing(_tokens(place)[:, 0], _prompt(sam2))


def spatial_memory(sam2: Sam2Graphs, features: Features, prediction: Prediction, *, given: bool) -> np.ndarray:
    """(T, M) uint16 (bfloat16): the memory of an object in a frame, binary where its mask was prompted (`given`)."""
    size = sam2.sizes["S"]
    logits = cv2.resize(prediction.logits, (size, size), interpolation=cv2.INTER_LINEAR)
    mask = (logits > 0).astype(np.float32) if given else _sigmoid(logits)
    found = sam2.run("memory_encoder", {"pix_feat": features.top, "masks": (20 * mask - 10)[None, None]})
    memory = found["vision_features"]
    if "no_obj_embed_spatial" in sam2.constants and prediction.score <= 0:
        memory = memory + sam2.constants["no_obj_embed_spatial"][..., None, None]
    return to_bfloat16(_tokens(memory)[:, 0])


def fill_holes(logits: np.ndarray, area: int) -> np.ndarray:
    """logits (L, L) with holes of at most `area` pixels (8-connected, at or below 0) raised to 0.1."""
    if area <= 0:
        return logits
    number, labels, stats, _ = cv2.connectedComponentsWithStats((logits <= 0).astype(np.uint8), connectivity=8)
    small = stats[:, cv2.CC_STAT_AREA] <= area
    small[0] = False  # label 0 is the object itself
    return np.where(small[np.asarray(labels, np.intp)], np.float32(0.1), logits) if number > 1 else logits


def _mask_as_output(sam2: Sam2Graphs, features: Features, mask: np.ndarray) -> Prediction:
    """A given mask is the answer; the decoder is run for the object pointer alone."""
    size, low = sam2.sizes["S"], sam2.sizes["L"]
    whole = (_resized(mask.astype(np.float32), size) >= 0.5).astype(np.float32)
    logits = _resized(2 * MASK_LOGIT * whole - MASK_LOGIT, low)
    patches = whole.reshape(low, 4, low, 4)
    hint = np.einsum("ipjq,pq->ij", patches, sam2.constants["mask_downsample_weight"][0, 0])
    hint = (hint + sam2.constants["mask_downsample_bias"]).astype(np.float32)
    decoded = _decode(sam2, features, features.top, _prompt(sam2, hint=hint), multimask=False)
    if whole.any():
        return Prediction(logits, decoded.pointer, MASK_LOGIT)
    return Prediction(logits, sam2.constants["no_obj_ptr"][0], -MASK_LOGIT)


def _resized(image: np.ndarray, side: int) -> np.ndarray:
    """(H, W) float32 -> (side, side), bilinear with the kernel widened where it shrinks, as PyTorch's antialias."""
    return np.asarray(Image.fromarray(image).resize((side, side), Image.Resampling.BILINEAR))


def _prompt(
    sam2: Sam2Graphs, points: np.ndarray | None = None, labels: np.ndarray | None = None, hint: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """The prompt encoder's outputs for points (P, 2) in px of the network's image, and mask logits `hint` (L, L)."""
    low = sam2.sizes["L"]
    if points is None or labels is None:
        points, labels = np.zeros((1, 2), np.float32), np.full(1, -1, np.int32)
    feeds = {
        "coords": points[None],
        "labels": labels[None],
        "masks": (np.zeros((low, low), np.float32) if hint is None else hint)[None],
        "masks_enable": np.array([hint is not None], np.int32),
    }
    return sam2.run("prompt_encoder", feeds)


def _decode(
    sam2: Sam2Graphs, features: Features, image: np.ndarray, prompt: dict[str, np.ndarray], *, multimask: bool
) -> Prediction:
    found = sam2.run(
        "mask_decoder",
        {
            "image_embeddings": image,
            "image_pe": prompt["dense_pe"],
            "sparse_prompt_embeddings": prompt["sparse_embeddings"],
            "dense_prompt_embeddings": prompt["dense_embeddings"],
            "high_res_features1": features.fine[0],
            "high_res_features2": features.fine[1],
        },
    )
    masks, score = found["masks"][0], float(found["object_score_logits"].item())
    best = 1 + int(found["iou_pred"][0, 1:].argmax())
    chosen = best if multimask or _stability(masks[0]) < STABILITY_LEAST else 0
    token = found["sam_tokens_out"][:, best if multimask else 0]
    if score <= 0:
        return Prediction(np.full_like(masks[0], ABSENT), sam2.constants["no_obj_ptr"][0], score)
    return Prediction(masks[chosen], sam2.run("mlp", {"x": token})["x_out"][0], score)


def _stability(logits: np.ndarray) -> float:
    wide = np.count_nonzero(logits > -STABILITY_DELTA)
    return np.count_nonzero(logits > STABILITY_DELTA) / wide if wide else 1.0


def _with_memory(
    sam2: Sam2Graphs, features: Features, bank: Bank, t: int, step: int, count: int, place: np.ndarray
) -> np.ndarray:
    """(1, C, G, G): the frame's top features after attending to the bank."""
    channels, memory_channels, grid = sam2.sizes["C"], sam2.sizes["M"], sam2.sizes["G"]
    code = sam2.constants["maskmem_tpos_enc"].reshape(-1, memory_channels)
    seen = spatial_memories(bank, t, step, slots=sam2.sizes["N"])
    known = pointers(bank, t, step, count=count)
    split = channels // memory_channels  # a pointer is so many tokens
    tokens = np.array([pointer for _, pointer in known], np.float32).reshape(-1, 1, memory_channels)
    found = sam2.run(
        "memory_attention",
        {
            "curr": _tokens(features.top),
            "curr_pos": _tokens(features.position),
            "memory_1": np.concatenate([from_bfloat16(spatial) for _, spatial in seen])[:, None],
            "memory_pos_1": np.concatenate([place + code[row] for row, _ in seen])[:, None],
            "memory_2": tokens,
            "memory_pos_2": np.repeat(_ages(sam2, [d for d, _ in known], count), split, 0)[:, None],
        },
    )
    return found["pix_feat"][:, 0].T.reshape(1, channels, grid, grid)


def _ages(sam2: Sam2Graphs, distances: list[int], count: int) -> np.ndarray:
    """(len(distances), M): the temporal codes of object pointers; zero before SAM 2.1."""
    if "obj_ptr_tpos_proj" not in sam2.graphs or not distances:
        return np.zeros((len(distances), sam2.sizes["M"]), np.float32)
    half = sam2.sizes["C"] // 2
    period = np.float32(10000) ** (2 * (np.arange(half) // 2) / np.float32(half)).astype(np.float32)
    angle = (np.array(distances, np.float32) / np.float32(reach(count)))[:, None] / period
    return sam2.run("obj_ptr_tpos_proj", {"x": np.concatenate([np.sin(angle), np.cos(angle)], 1)})["x_out"]


def _tokens(grid: np.ndarray) -> np.ndarray:
    """(1, C, G, G) -> (G^2, 1, C)."""
    return np.ascontiguousarray(grid.reshape(grid.shape[1], -1).T[:, None])


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 * (1 + np.tanh(0.5 * x))
