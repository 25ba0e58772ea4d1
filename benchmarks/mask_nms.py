"""LangSplat's mask NMS: time of the sparse matrix product, and whether it keeps what the definition keeps.

    python benchmarks/mask_nms.py [--masks 500] [--height 731] [--width 988] [--repeats 5]

The masks are wavy ellipses of 10 to 250 px of half axis, strewn at random: each pixel lies in about ten of them. The
definition (minghanqin/LangSplat, preprocess.py) is put to every pair, on packed bits. Times are medians in seconds.
"""

import argparse
import statistics
import time

import numpy as np

from jsecon.networks.sam.masks import langsplat_nms


def strewn(count: int, height: int, width: int, seed: int = 0) -> np.ndarray:
    """masks (M, H, W) bool, none of them empty."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    masks = np.zeros((count, height, width), bool)
    for mask in masks:
        cx, cy = rng.uniform(0, width), rng.uniform(0, height)
        a, b = np.exp(rng.uniform(np.log(10), np.log(250), 2))
        wave = 0.1 * np.sin(rng.integers(3, 9) * np.arctan2(y - cy, x - cx))
        mask[:] = ((x - cx) / a) ** 2 + ((y - cy) / b) ** 2 + wave < 1
        mask[int(cy), int(cx)] = True
    return masks


def by_definition(masks: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Kept indices, best first, pair by pair."""
    order = np.argsort(-scores, kind="stable")
    bits = [np.packbits(masks[i]) for i in order]
    area = np.asarray([masks[i].sum() for i in order])
    iou, inner = np.zeros((len(order), len(order))), np.zeros((len(order), len(order)))
    for i in range(len(order)):
        for j in range(i + 1, len(order)):
            common = int(np.bitwise_count(bits[i] & bits[j]).sum())
            iou[i, j] = common / (area[i] + area[j] - common)
            of_i, of_j = common / area[i], common / area[j]
            if of_i < 0.5 and of_j >= 0.85:
                inner[i, j] = 1 - of_i * of_j
            if of_i >= 0.85 and of_j < 0.5:
                inner[j, i] = 1 - of_i * of_j
    return order[(iou.max(0) <= 0.8) & (scores[order] > 0.7) & (inner.max(0) <= 0.5)]


def main() -> None:
    """Prints one line."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("masks", 500), ("height", 731), ("width", 988), ("repeats", 5)):
        arguments.add_argument(f"--{name}", type=int, default=default)
    options = arguments.parse_args()
    masks = strewn(options.masks, options.height, options.width)
    scores = np.random.default_rng(1).uniform(0.5, 1.0, len(masks))
    taken = []
    for _ in range(options.repeats):
        start = time.perf_counter()
        kept = langsplat_nms(masks, scores)
        taken.append(time.perf_counter() - start)
    start = time.perf_counter()
    same = np.array_equal(kept, by_definition(masks, scores))
    print(
        f"{len(masks)} masks of {options.width}x{options.height}: "
        f"{statistics.median(taken):.2f} s, {len(kept)} kept; the definition takes {time.perf_counter() - start:.1f} s "
        f"and keeps {'the same' if same else 'OTHERS'}"
    )


if __name__ == "__main__":
    main()
