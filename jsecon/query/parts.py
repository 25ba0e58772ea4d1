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
    field: LanguageField, texts: Float[Array, "q e"], wholes: Collection[int], rules: QueryRules
) -> tuple[Int[np.ndarray, " m"], int]:
    """Finds the parts of regions that a text names for certain, unless it names the regions better.

    Returns:
      Nodes of the tree, and an index of `rules.STATES`: ABSENT if there are none.
    """
    own = np.flatnonzero(np.isin(part_objects(field), list(wholes)))
    if field.part_regions is None or not len(own):
        return np.zeros(0, int), ABSENT
    rows, whole = np.asarray(field.part_regions.embeddings)[own], np.asarray(field.regions.embeddings)[list(wholes)]
    pixels = np.asarray(field.part_regions.pixel_counts)[own], np.asarray(field.regions.pixel_counts)[list(wholes)]
    regions = Regions(np.concatenate([rows, whole]), np.concatenate(pixels))
    votes = dataclasses.replace(field.votes, overlap=None)
    match = match_regions(dataclasses.replace(field, regions=regions, votes=votes), texts, rules)
    if not 0 <= int(match.region) < len(own) or int(match.state) < FOUND:
        return np.zeros(0, int), ABSENT
    return np.asarray(field.part_nodes)[own[np.asarray(match.chosen)[: len(own)]]], int(match.state)


def match_lone_parts(
    field: LanguageField, texts: Float[Array, "q e"], region: int, rules: QueryRules
) -> tuple[Int[np.ndarray, " m"], int]:
    """Finds the parts of any region that a text names, as `match_parts` does, if no region has that name for certain.

    There are none where one of them is most of `region`, which may be what the text names, or -1: the larger is meant.
    """
    nodes, state = match_parts(field, texts, range(field.regions.count), rules)
    if len(nodes) and region >= 0:
        inside = np.asarray(field.leaf)[node_members(np.asarray(field.tree), np.asarray(field.leaf), region)]
        if any(node_members(np.asarray(field.tree), inside, int(node)).mean() > 0.5 for node in nodes):
            return np.zeros(0, int), ABSENT
    return nodes, state
