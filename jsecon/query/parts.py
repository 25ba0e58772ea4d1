"""Which part of a thing a text names, such as the handle of a mug. Pure."""

import dataclasses
from collections.abc import Collection

import numpy as np
from jaxtyping import Float, Int

from jsecon.field.tree import node_members, part_objects
from jsecon.query.answer import match_regions
from jsecon.query.rules import ABSENT, FOUND, QueryRules
from jsecon.types import Array, LanguageField, Regions


def match_parts(
    field: LanguageField,
    texts: Float[Array, "q e"],
    rules: QueryRules,
    wholes: Collection[int] | None = None,
    *,
    unless: int = -1,
) -> tuple[Int[np.ndarray, " m"], int]:
    """Finds the parts of regions that a text names for certain, unless it names the regions better.

    Args:
      field: The field.
      texts: Embeddings of the text.
      rules: How texts match.
      wholes: The regions; None takes all.
      unless: A region that may be what the text names, or -1. Where one of the parts is most of it, there are none: the
        larger is meant.

    Returns:
      Nodes of the tree, and an index of `rules.STATES`: ABSENT if there are none.
    """
    wholes = range(field.regions.count) if wholes is None else wholes
    parts = np.flatnonzero(np.isin(part_objects(field), list(wholes)))
    if field.part_regions is None or not len(parts):
        return np.zeros(0, int), ABSENT
    rows, whole = np.asarray(field.part_regions.embeddings)[parts], np.asarray(field.regions.embeddings)[list(wholes)]
    pixels = np.asarray(field.part_regions.pixel_counts)[parts], np.asarray(field.regions.pixel_counts)[list(wholes)]
    regions = Regions(np.concatenate([rows, whole]), np.concatenate(pixels))
    votes = dataclasses.replace(field.votes, overlap=None)
    match = match_regions(dataclasses.replace(field, regions=regions, votes=votes), texts, rules)
    if not 0 <= int(match.region) < len(parts) or int(match.state) < FOUND:
        return np.zeros(0, int), ABSENT
    nodes = np.asarray(field.part_nodes)[parts[np.asarray(match.chosen)[: len(parts)]]]
    if unless >= 0:
        tree, leaf = np.asarray(field.tree), np.asarray(field.leaf)
        inside = leaf[node_members(tree, leaf, unless)]
        if any(node_members(tree, inside, int(node)).mean() > 0.5 for node in nodes):
            return np.zeros(0, int), ABSENT
    return nodes, int(match.state)
