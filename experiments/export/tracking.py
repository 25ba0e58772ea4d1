"""A clip tracked by the official SAM 2 video predictor and by jsecon over exported graphs, compared frame by frame."""

import dataclasses
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from jsecon.networks.sam2.graphs import open_sam2
from jsecon.networks.sam2.heads import Prompt
from jsecon.networks.sam2.tracker import at_size, follow


@dataclasses.dataclass(frozen=True)
class Clip:
    """A sequence and what is to be followed in it."""

    frames: np.ndarray
    """(T, H, W, 3) uint8."""
    prompts: Sequence[Sequence[Prompt]]
    """of each object."""


def moving_discs(count: int, *, first: int, seed: int, size: tuple[int, int] = (180, 240)) -> Clip:
    """Three discs that cross a patterned wall, one frame in the dark; prompted in frame `first` by a mask, a box and a
    point, the first disc also four frames later (where there is such a frame)."""
    height, width = size
    rng = np.random.default_rng(seed)
    wall = cv2.resize(rng.integers(0, 256, (9, 12, 3), dtype=np.uint8), (width, height), interpolation=cv2.INTER_CUBIC)
    frames = np.repeat(wall[None], count, 0)
    discs = np.zeros((3, count, height, width), bool)
    for number, colour in enumerate(((230, 40, 30), (40, 200, 60), (30, 60, 220))):
        start, speed = rng.uniform(0.2, 0.8, 2) * (width, height), rng.uniform(-6, 6, 2)
        for t in range(count):
            blank = np.zeros(size, np.uint8)
            cv2.circle(blank, tuple(int(v) for v in start + speed * (t - first)), height // 7, 1, -1)
            discs[number, t] = blank > 0
            frames[t][discs[number, t]] = colour
    if first + 2 < count:
        frames[first + 2] //= 16
    again = [Prompt(t, discs[0, t]) for t in (first, first + 4) if t < count]
    rows, columns = np.nonzero(discs[1, first])
    corners = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]], np.float32)
    middle = np.argwhere(discs[2, first]).mean(0)[None, ::-1].astype(np.float32)
    box = Prompt(first, points=corners, labels=np.array([2, 3], np.int32))
    point = Prompt(first, points=middle, labels=np.array([1], np.int32))
    return Clip(frames, (again, [box], [point]))


def officially(model: torch.nn.Module, clip: Clip) -> tuple[np.ndarray, np.ndarray]:
    """Logits (T, B, H, W) and object scores (T, B) by the official predictor: forward, then backward."""
    count, height, width = clip.frames.shape[:3]
    logits = np.full((count, len(clip.prompts), height, width), np.nan, np.float32)
    with tempfile.TemporaryDirectory() as folder, torch.nn.attention.sdpa_kernel(torch.nn.attention.SDPBackend.MATH):
        for t, frame in enumerate(clip.frames):  # PNG bytes under the one name that it reads: nothing is lost
            written = cv2.imencode(".png", cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))[1]
            (Path(folder) / f"{t:05d}.jpg").write_bytes(written.tobytes())
        state = model.init_state(folder)
    with torch.nn.attention.sdpa_kernel(torch.nn.attention.SDPBackend.MATH):
        for number, own in enumerate(clip.prompts):
            for prompt in own:
                if prompt.mask is not None:
                    model.add_new_mask(state, prompt.frame, number, prompt.mask)
                else:
                    box = prompt.points.reshape(4) if prompt.labels[0] == 2 else None
                    points = {} if box is not None else {"points": prompt.points, "labels": prompt.labels}
                    model.add_new_points_or_box(state, prompt.frame, number, box=box, **points)
        for reverse in (False, True):
            for t, _, found in model.propagate_in_video(state, reverse=reverse):
                logits[t] = found[:, 0].numpy()
    scores = np.zeros(logits.shape[:2], np.float32)
    for number, kept in state["output_dict_per_obj"].items():
        for outputs in kept.values():
            for t, output in outputs.items():
                scores[t, number] = float(output["object_score_logits"])
    return logits, scores


def ours(folder: Path, clip: Clip, *, threads: int) -> np.ndarray:
    """Logits (T, B, H, W) by jsecon over the graphs in `folder`."""
    sam2 = open_sam2(folder, threads=threads)
    logits = np.full((len(clip.frames), len(clip.prompts), *clip.frames.shape[1:3]), np.nan, np.float32)
    for t, found in follow(sam2, clip.frames, clip.prompts, hole_area=0):
        logits[t] = [at_size(low, logits.shape[2:]) for low in found]
    return logits


def compare(model: torch.nn.Module, folder: Path, clip: Clip, *, threads: int) -> dict:
    """Frame by frame: the largest difference of logits and the share of pixels with the same mask."""
    started = time.process_time()
    wanted, scores = officially(model, clip)
    official_seconds = time.process_time() - started
    started = time.process_time()
    found = ours(folder, clip, threads=threads)
    our_seconds = time.process_time() - started
    same = (found > 0) == (wanted > 0)
    return {
        "frames": len(clip.frames),
        "objects": len(clip.prompts),
        "prompted": sorted({prompt.frame for own in clip.prompts for prompt in own}),
        "largest_difference": [float(np.abs(a - b).max()) for a, b in zip(found, wanted)],
        "same_pixels": [float(s.mean()) for s in same],
        "masks_same_pixels_least": float(same.mean((2, 3)).min()),
        "share_of_foreground": float((wanted > 0).mean()),
        "largest_logit_present": float(np.abs(wanted[scores > 0]).max(initial=0.0)),
        "absent": int((scores <= 0).sum()),
        "present": int((scores > 0).sum()),
        "official_cpu_seconds": official_seconds,
        "our_cpu_seconds": our_seconds,
    }
