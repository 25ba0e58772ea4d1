"""Which masks of objects lie in others, and the labels of things and parts that this makes. Pure, NumPy.

A mask lies in a larger one of its frame if that holds CONTAINED of its pixels. An object is a part of another one if
its mask lies in the other's in CONTAINED of the frames that show both, and its largest mask is the smaller one. Its
parent is the smallest such object.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, Int16
from scipy import sparse

CONTAINED = 0.8
"""Share of a mask's pixels, and of frames: outlines of a thin part stick out by a px, and a tracker slips."""


def lies_in(masks: Bool[np.ndarray, "m h w"]) -> tuple[Bool[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
    """Finds which masks of a frame lie in which larger or earlier equal ones, and counts the pixels of each."""
    pixels = sparse.csr_matrix(masks.reshape(len(masks), masks[:1].size)).astype(float)
    shared = (pixels @ pixels.T).toarray()
    size = np.diagonal(shared)
    larger = (size > size[:, None]) | np.tril(size == size[:, None], -1)
    return (shared >= CONTAINED * size[:, None]) & larger, size


def outermost(masks: Bool[np.ndarray, "m h w"]) -> Bool[np.ndarray, "k h w"]:
    """Leaves out the masks of a frame that lie in others."""
    return masks[~lies_in(masks)[0].any(1)]


def nest_masks(frames: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], count: int) -> Int[np.ndarray, " n"]:
    """Finds the parent of each of `count` objects, -1 for none.

    `frames` have the objects (M,) of their masks, and what `lies_in` finds of these.
    """
    parent, largest = np.full(count, -1), np.zeros(count)
    if not frames:
        return parent
    shown, inside = np.zeros((2, count, count), np.float32)
    for objects, within, size in frames:
        largest[objects] = np.maximum(largest[objects], size)
        shown[np.ix_(objects, objects)] += 1
        inside[np.ix_(objects, objects)] += within
    is_in, by_size = (inside > 0) & (inside >= CONTAINED * shown), np.argsort(-largest, kind="stable")
    for n, part in enumerate(by_size):
        wholes = by_size[:n][is_in[part, by_size[:n]]]
        parent[part] = wholes[-1] if len(wholes) else -1
    return parent


def split_parts(labels: Int16[np.ndarray, "t h w"], parent: Int[np.ndarray, " n"]) -> dict[str, np.ndarray]:
    """Divides objects, of which `labels` show the smallest at each pixel, into things and parts that have pixels.

    Returns:
      labels: (T, H, W) thing 0 .. R-1 at each pixel, -1 for none. The rest is left out if no object lies in another.
      tree: (M,) parent of each node, -1 for a thing, as `LanguageField.tree` has it.
      parts: (L, T, H, W) part 0 .. P-1 at each pixel, -1 for none: parts of things, then parts of these, and so on.
      part_nodes: (P,) node of each part.
    """
    if parent.max(initial=-1) < 0:
        return {"labels": labels}
    parent = parent.astype(np.int16)  # images of labels are large
    depth, above, layers = np.zeros_like(parent), parent, []
    while (above >= 0).any():
        depth, above = depth + (above >= 0), np.where(above >= 0, parent[above], -1)
    for level in range(depth.max(), 0, -1):
        here = (labels >= 0) & (depth[labels] == level)
        layers.append(np.where(here, labels, -1))
        labels = np.where(here, parent[labels], labels)
    shown = [np.flatnonzero(np.isin(np.arange(len(parent)), layer)) for layer in (labels, *layers)]
    order, things = np.concatenate(shown), len(shown[0])  # things, and then parts before their parents
    number = np.full(len(parent) + 1, -1, np.int16)
    number[order] = np.arange(len(order))
    parts, nodes = np.maximum(number[np.stack(layers[::-1])] - np.int16(things), -1), np.arange(things, len(order))
    tree = number[parent[order]].astype(np.int32)
    return {"labels": number[labels], "tree": tree, "parts": parts, "part_nodes": nodes.astype(np.int32)}
