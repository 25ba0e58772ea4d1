"""A field as one HTML page that opens by double click: its Gaussians, regions and the answers to given texts.

No server and no outside resource. A Gaussian takes 19 bytes, before base64: places in 16 bits along each side of the
scene's box, turns in 8, sizes and colours in 8 (the colour of spherical harmonics of degree 0), its region in 16.
"""

import base64
import html
import json
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jsecon.app.ask import Answer
from jsecon.files import write_text
from jsecon.language.membership import SHARE_THRESHOLD, vote_blocks, vote_shares
from jsecon.numerics import sigmoid
from jsecon.splat.sh import C0
from jsecon.types import Gaussians, LanguageField

NOWHERE = 65535
"""the region of a Gaussian that has none"""
FAR = 0.002
"""part of the Gaussians at each end of an axis that the box of places leaves out: they would take its digits"""
LARGEST = 0.25
"""of a Gaussian drawn, in the box's diagonal"""
FAINT = 4
"""opacity, of 255, below which a Gaussian is left out"""


def write_page(field: LanguageField, answers: Sequence[Answer], file: Path, *, title: str) -> int:
    """Writes the page of a field with the answers to texts; returns its bytes."""
    text = page(field, answers, title=title)
    write_text(file, text)
    return len(text.encode())


def page(field: LanguageField, answers: Sequence[Answer], *, title: str) -> str:
    """The page."""
    gaussians = field.gaussians
    means, opacity = np.asarray(gaussians.means, np.float64), np.asarray(sigmoid(np.asarray(gaussians.opacity_logits)))
    low, high = np.quantile(means[np.isfinite(means).all(1)], (FAR, 1 - FAR), axis=0)
    low, high = low - 0.05 * (high - low), high + 0.05 * (high - low)
    sizes = np.asarray(gaussians.log_scales, np.float64)
    kept = np.isfinite(means).all(1) & ((means >= low) & (means <= high)).all(1) & (opacity * 255 >= FAINT)
    kept &= sizes.max(1) < np.log(LARGEST * np.linalg.norm(high - low))
    told = {
        "count": int(kept.sum()),
        "regions": field.regions.count,
        "low": low.tolist(),
        "span": (high - low).tolist(),
        "texts": [_told(answer, kept) for answer in answers],
        **_camera(field, means[kept]),
    }
    splats, ends = _packed(gaussians, main_regions(field), opacity, kept, low, high)
    template = resources.files("jsecon.app").joinpath("splat_page.html").read_text(encoding="utf-8")
    written = json.dumps(told | ends).replace("</", "<\\/")
    filled = template.replace("__TITLE__", html.escape(title)).replace("__TOLD__", written)
    return filled.replace("__SPLATS__", base64.b64encode(splats).decode())


def main_regions(field: LanguageField) -> Int[np.ndarray, " n"]:
    """The region that has most of each Gaussian, and at least half; NOWHERE where none has. Read in blocks."""
    parts = [np.zeros(0, np.int32)]
    for votes in vote_blocks(field.votes):
        share, found = np.nan_to_num(np.asarray(vote_shares(votes))), np.asarray(votes.regions)
        best = share.argmax(1)
        rows = np.arange(len(best))
        parts.append(np.where(share[rows, best] >= SHARE_THRESHOLD, found[rows, best], NOWHERE))
    return np.concatenate(parts)


def _told(answer: Answer, kept: Bool[np.ndarray, " n"]) -> dict[str, Any]:
    bits = np.packbits(np.asarray(answer.mask)[kept], bitorder="little")
    mask = base64.b64encode(bits.tobytes()).decode()
    return {"text": answer.question, "score": float(answer.selection.score), "mask": mask}


def _camera(field: LanguageField, means: Float[np.ndarray, "n 3"]) -> dict[str, Any]:
    """Where the page begins: at the first frame, looking at what lies in its middle; up is the mean of all frames'."""
    poses = np.asarray(field.cameras.world_to_camera, np.float64)
    eye, forward = -poses[0, :3, :3].T @ poses[0, :3, 3], poses[0, 2, :3]
    depth = (means - eye) @ forward
    aside = np.linalg.norm(means - eye - depth[:, None] * forward, axis=1)
    ahead = depth[(depth > 0) & (aside < 0.2 * np.maximum(depth, 1e-9))]
    away = float(np.median(ahead)) if len(ahead) else float(np.linalg.norm(np.ptp(means, axis=0)))
    return {
        "eye": eye.tolist(),
        "target": (eye + away * forward).tolist(),
        "up": (-poses[:, 1, :3].mean(0)).tolist(),
        "focal": float(np.asarray(field.cameras.fx)[0]),
        "size": [field.cameras.width, field.cameras.height],
    }


def _packed(
    gaussians: Gaussians, regions: np.ndarray, opacity: np.ndarray, kept: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[bytes, dict[str, float]]:
    """The columns that the page reads, and the ends of the logarithms of sizes."""
    means = (np.asarray(gaussians.means, np.float64)[kept] - low) / np.maximum(high - low, 1e-12)
    sizes = np.asarray(gaussians.log_scales, np.float64)[kept]
    there = sizes[np.isfinite(sizes)]  # a flat Gaussian, of size 0, is packed as the least of them
    least, most = (float(np.quantile(there, q)) for q in (0.001, 1.0)) if len(there) else (0.0, 1.0)
    span = max(most - least, 1e-6)
    turns = np.asarray(gaussians.quaternions, np.float64)[kept]
    turns = turns / np.maximum(np.linalg.norm(turns, axis=1, keepdims=True), 1e-12)
    colours = 0.5 + C0 * np.asarray(gaussians.sh, np.float64)[kept, 0]
    columns = (
        np.rint(65535 * np.clip(means, 0, 1)).astype("<u2"),
        regions[kept].astype("<u2"),
        np.rint(127 * turns).astype(np.int8),
        np.rint(255 * np.clip((sizes - least) / span, 0, 1)).astype(np.uint8),
        np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8),
        np.rint(255 * opacity[kept]).astype(np.uint8),
    )
    return b"".join(column.tobytes() for column in columns), {"size_low": least, "size_span": span}
