"""The tree of a field: parts below its objects, unions above them, and other cuts of it as regions. Pure, NumPy.

Masks vote for regions, the objects of one cut of the tree. The votes of a union are the sum of those of its regions.
A part has the votes of its region on the Gaussians that lie under it.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from jsecon.errors import require
from jsecon.field.membership import SHARE_THRESHOLD, vote_columns, with_overlap
from jsecon.field.regions import unit_rows
from jsecon.types import LanguageField, Regions, Votes

PARTS = -1
"""Level of the parts."""


def node_members(tree: Int[np.ndarray, " m"], leaf: Int[np.ndarray, " n"], node: int) -> Bool[np.ndarray, " n"]:
    """Finds what belongs to a node of `LanguageField.tree`: (N,) of what has the smallest nodes `leaf`, -1 for none."""
    under, fresh = np.zeros(len(tree) + 1, bool), np.array([node])  # the last entry is that of -1
    while len(fresh):
        under[fresh] = True
        fresh = np.flatnonzero(under[tree] & ~under[:-1])
    return under[leaf]


def part_objects(field: LanguageField) -> Int[np.ndarray, " p"]:
    """Finds the region that each part of a field belongs to; none where the parts are not known."""
    return _first_above(field, np.arange(field.regions.count))


def _first_above(field: LanguageField, stops: Int[np.ndarray, " s"]) -> Int[np.ndarray, " p"]:
    """Finds the first node above each part of a field that is one of the stops, which the regions are among."""
    if field.part_nodes is None or field.tree is None:
        return np.zeros(0, int)
    tree = np.asarray(field.tree)
    node = tree[np.asarray(field.part_nodes)]
    while not (done := np.isin(node, stops)).all():
        node = np.where(done, node, tree[node])
    return node


def voted_leaves(field: LanguageField, nodes: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Finds the smallest node of each Gaussian of a field, -1 if less than half of it lies in its strongest region.

    It is the node that has most weight on the Gaussian without its parts, `nodes`, if that belongs to the region, and
    else the region.
    """
    region, weight, seen = map(np.asarray, next(vote_columns(field.votes)))
    top = np.concatenate([np.arange(field.regions.count), part_objects(field), [-1]])
    leaf = np.where(top[nodes] == region, nodes, region)
    return np.where(weight >= SHARE_THRESHOLD * seen, leaf, -1).astype(np.int32)


def cut_field(field: LanguageField, level: int) -> LanguageField:
    """Takes another cut of the tree as the regions of a field: its parts (-1), or unions, each so many joins up.

    Regions have the ids of their nodes, and a row for every node: one that the cut lacks has no votes. What has no
    parts, or no union above it, stays as it is. An object with parts keeps its embedding and the rest of its Gaussians.

    Args:
      field: The field.
      level: -1 for parts, 0 for the regions, 1 and more for unions.

    Returns:
      The field, without tree, codes and history.

    Raises:
      ValueError: There is no such level, or the field has no tree.
    """
    require(level >= PARTS, "level", level, "-1 for parts, 0 for objects, or more for unions", "Give another level.")
    if level == 0:
        return field
    remedy = "Make the field with masks that lie in each other, or with those that jsecon finds (run without --masks)."
    require(field.tree is not None, "level", level, "0, as this field has no tree of objects", remedy)
    tree, count = np.asarray(field.tree), field.regions.count
    pixels = np.zeros((len(tree), field.regions.pixel_counts.shape[1]), np.int32)
    weighted = np.zeros((len(tree), field.regions.embeddings.shape[1]))
    pixel_counts, regions = np.asarray(field.regions.pixel_counts), np.array(field.votes.regions)
    if level == PARTS:
        pixels[:count], weighted[:count] = pixel_counts, field.regions.embeddings
        if field.part_regions is not None:
            nodes = np.asarray(field.part_nodes)
            pixels[nodes], weighted[nodes] = field.part_regions.pixel_counts, field.part_regions.embeddings
            np.subtract.at(pixels, parts_above(field)[nodes], np.asarray(field.part_regions.pixel_counts))
            regions = np.stack([smallest_nodes(field, column) for column in regions.T], axis=1)
    else:
        node = np.arange(count)
        for _ in range(level):
            node = np.where(tree[node] >= 0, tree[node], node)
        np.add.at(pixels, node, pixel_counts)
        np.add.at(weighted, node, pixel_counts.sum(1)[:, None] * np.asarray(field.regions.embeddings, np.float64))
        regions = np.append(node, -1)[regions]
    votes = _merge_votes(field.votes, regions.astype(np.int32), len(tree))
    return dataclasses.replace(
        field,
        votes=with_overlap(votes),
        regions=Regions(unit_rows(weighted), np.maximum(pixels, 0)),
        **dict.fromkeys(("tree", "leaf", "part_regions", "part_nodes", "codes")),
        history=(),
    )


def smallest_nodes(field: LanguageField, regions: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Replaces the region of each Gaussian, -1 for none, by the node of its smallest part in that region, if any."""
    if field.part_nodes is None or field.tree is None:
        return regions
    part_of, tree = np.full(len(field.tree) + 1, -1), np.asarray(field.tree)  # the last entry is that of -1
    part_of[np.asarray(field.part_nodes)] = np.arange(len(field.part_nodes))
    for node in range(len(tree) - 1, field.regions.count - 1, -1):  # parents come after their children
        if part_of[node] < 0 and tree[node] >= field.regions.count:
            part_of[node] = part_of[tree[node]]
    part = part_of[np.asarray(field.leaf)]
    inside = (part >= 0) & (np.append(part_objects(field), -2)[part] == regions)
    return np.where(inside, np.append(np.asarray(field.part_nodes), -1)[part], regions)


def parts_above(field: LanguageField) -> Int[np.ndarray, " m"]:
    """Returns the tree of a field, in which parts have the next larger part or their region as parent."""
    tree = np.array(field.tree)
    if field.part_nodes is not None:
        nodes = np.asarray(field.part_nodes)
        tree[nodes] = _first_above(field, np.concatenate([np.arange(field.regions.count), nodes]))
    return tree


def _merge_votes(votes: Votes, regions: Int[np.ndarray, "n k"], count: int) -> Votes:
    """Gives votes other regions of `count`; those of a Gaussian for one region become one vote, strongest first."""
    weights = np.array(votes.weights)
    visible = votes.weight_where_region_visible
    shown: Float[np.ndarray, "n k"] = np.array(weights if visible is None else visible)
    for j in range(1, regions.shape[1]):
        for i in range(j):
            same = (regions[:, j] >= 0) & (regions[:, i] == regions[:, j])
            weights[same, i] += weights[same, j]
            shown[same, i] = np.maximum(shown[same, i], shown[same, j])
            regions[same, j], weights[same, j], shown[same, j] = -1, 0.0, 0.0
    order = np.argsort(-weights, axis=1, kind="stable")
    regions, weights, shown = (np.take_along_axis(column, order, axis=1) for column in (regions, weights, shown))
    votes = dataclasses.replace(votes, regions=regions, weights=weights, num_regions=count)
    if visible is None:
        return votes
    return dataclasses.replace(votes, weight_where_region_visible=np.maximum(shown, weights))
