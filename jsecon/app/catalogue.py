"""The catalogue of a field: its objects with names, boxes, sizes and parts."""

import colorsys
import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import sparse  # loads csgraph on its first use
from scipy.special import softmax

from jsecon.app.records import gaussian_rows, rounded, source_shapes, source_up, world_record
from jsecon.errors import InputError
from jsecon.field.columns import vote_blocks
from jsecon.field.membership import SHARE_THRESHOLD, ratio, vote_columns, vote_shares
from jsecon.programs import stored_jit
from jsecon.query.answer import match_region
from jsecon.query.match import MIN_FRAGMENT_OVERLAP, compare_words, score_text
from jsecon.query.object_shapes import ObjectShapes, gaussian_spreads, object_shapes
from jsecon.query.outliers import MIN_SAMPLES
from jsecon.query.rules import ABSENT, RULES, QueryRules
from jsecon.splat.visible import points_in_view
from jsecon.types import Array, LanguageField, Votes
from jsecon.views.frame import field_up, inner_scene
from jsecon.vision.unrelated_words import UNRELATED_WORDS, embed_unrelated_words

SURE_SHARE = 0.4
"""Share of the frames which see an object that must show it, or it is unsure. On replica_apartment_0, 4 of 78 regions
below it have an IoU of 0.4 with an instance, and 61 of 163 others."""
PART_CONTAINMENT = 0.4
"""Share of a region inside another one from which it is a part of it. A handle that half of the views take for a part
of its mug lies in the mug by one half."""
SOFTMAX_SCALE = 100.0
"""Scale of cosines in CLIP's softmax over texts, to which its training is clipped (arXiv 2103.00020)."""
SMALL_SHARE = 0.22
"""Share of the scene's second longest side below which the longest side of something makes it no background. In six
fields what virtual views called so in error has less than 0.2, and the least true background, a table top, 0.22."""
# fmt: off
SURROUNDINGS = frozenset((
    "wall", "walls", "floor", "ceiling", "ground", "background", "sky", "lawn", "grass", "road", "pavement", "carpet",
    "rug", "room", "forest", "desert", "beach", "sand", "mud", "sea", "water", "river", "mountain",
))
# fmt: on
"""words of names that tell surroundings from things"""


@dataclasses.dataclass(frozen=True)
class Catalogue:
    """K objects of a field of N Gaussians and R regions, in the world of the capture and its unit.

    An object's id is its row. What most frames show whole comes first, each followed by its parts; then what is unsure,
    then surroundings.
    """

    names: np.ndarray
    """(K,) str: the most probable name of the vocabulary."""
    class_ids: np.ndarray
    """(K,) int32 number of each object's name among all names, sorted."""
    probability: np.ndarray
    """(K,) its probability if exactly one of the vocabulary is right; 0 of a name that a query finds absent."""
    surroundings: np.ndarray
    """(K,) bool: the name is one of walls, floors and the like."""
    sure: np.ndarray
    """(K,) bool: enough of the frames that see it show it; what is unsure may be a fragment."""
    parent: np.ndarray
    """(K,) int id of the object that this one is a part of, or -1. A parent has none."""
    pixels: np.ndarray
    """(K, T) number of pixels that show it in each frame."""
    shapes: ObjectShapes
    """its boxes, points and number of Gaussians; boxes stand upright along `up`."""
    labels: np.ndarray
    """(N,) int32 id of the object of each Gaussian that is no part of another, or -1."""
    part_labels: np.ndarray
    """(N,) int32 id of the part of each Gaussian, or -1."""
    regions: np.ndarray
    """(R,) int32 id of the object that each region belongs to, or -1."""
    up: np.ndarray
    """(3,) up axis in the world of the capture."""
    up_evidence: str
    """what the up axis was taken from, and whether that is sure."""
    frame_names: tuple[str, ...]
    """names of the field's frames."""
    world: Mapping[str, Any]
    """the unit of that world, and its reference system if it has one."""

    def __len__(self) -> int:
        """K."""
        return len(self.parent)

    def mask(self, index: int | np.integer) -> Bool[np.ndarray, " n"]:
        """Selects the Gaussians of an object.

        Args:
          index: Id of the object.

        Returns:
          (N,) bool; of a whole also the Gaussians of its parts.
        """
        return self.labels == index if self.parent[index] < 0 else self.part_labels == index

    def records(self) -> list[dict[str, Any]]:
        """Plain values of each object for JSON; the columns of a box's "axes" are its axes.

        "views" is the number of frames that show it, and "frames" has the three that show most of it, best first.
        `pandas.json_normalize` makes a table of them.
        """
        return [self._record(n) for n in range(len(self))]

    def as_dict(self) -> dict[str, Any]:
        """Plain values of the objects and of their world for JSON: the same at every door."""
        up = {"up": self.up.round(6).tolist(), "up_evidence": self.up_evidence}
        return {"frame": "the capture's world", **self.world, **up, "objects": self.records()}

    def _record(self, n: int) -> dict[str, Any]:
        """Plain values of one object."""
        shape, shown = self.shapes[n], self.pixels[n]
        best = np.argsort(-shown, kind="stable")[:3]
        length = float(np.linalg.norm(shape.high - shape.low))
        box = {"center": rounded(shape.center, length), "size": rounded(2 * shape.half_size, length)}
        return {
            "id": n,
            "name": self.names[n],
            "probability": round(float(self.probability[n]), 4),
            "class_id": int(self.class_ids[n]),
            "colour": palette(n + 1)[n].tolist(),
            "surroundings": bool(self.surroundings[n]),
            "sure": bool(self.sure[n]),
            "parent": int(self.parent[n]) if self.parent[n] >= 0 else None,
            "gaussians": int(shape.count),
            "views": int(np.count_nonzero(shown)),
            "frames": [self.frame_names[t] for t in best if shown[t] > 0],
            "box": box | {"axes": np.round(shape.axes, 6).tolist()},
            "low": rounded(shape.low, length),
            "high": rounded(shape.high, length),
        }


def objects(
    field: LanguageField,
    vocabulary: Sequence[str] | None = None,
    embedder: Any = None,
) -> Catalogue:
    """Lists the objects of a field.

    Regions that show one object are joined by the rules that queries use for pieces and duplicates (`regions_with`). So
    are two of like size that look the same, touch, and fill a common box: the ends of a beam whose middle is hidden. An
    object most of which lies in another one's masks is a part of it. Every Gaussian belongs to one whole at most.

    Args:
      field: The field.
      vocabulary: Names to choose from. None takes those of the embedder: of colours their names, of things and of the
        background; of others common nouns.
      embedder: Embedder of the field; None opens it if names need it.

    Returns:
      The catalogue. It is empty if the field has no regions.

    Raises:
      InputError: The vocabulary is empty, or the embedder cannot represent a name.
    """
    axis = field_up(field)
    upright = np.array(axis.axis)
    texts, embeddings, scale = _vocabulary(field, vocabulary, embedder)
    size, main = _sizes(field)
    groups = _region_objects(field, main, upright)
    members = np.arange(groups.max(initial=-1) + 1)[:, None] == groups  # (G, R)
    pixels = np.asarray(field.regions.pixel_counts, np.float64)
    weighted = pixels.sum(1)[:, None] * np.asarray(field.regions.embeddings, np.float64)
    present = np.zeros(len(texts), bool)
    if len(members):
        regions, words = jax.tree.map(np.asarray, (field.regions, field.unrelated_words))
        with np.errstate(invalid="ignore"):  # as a query does, without a program
            words = compare_words(regions.embeddings, words, RULES.retrieval)
            scores = [score_text(regions.embeddings, row, regions.pixel_counts, words, RULES) for row in embeddings]
        present = np.array([score.state for score in scores]) > ABSENT
    text = np.asarray(texts, object)
    is_background = np.array(["background" in name.lower().split() for name in texts], bool)
    allowed = present & ~(_is_small(field, groups, main)[:, None] & is_background)
    best, probability = _name(members @ weighted, embeddings, scale, allowed)
    surroundings = np.array([bool(SURROUNDINGS & set(name.lower().split())) for name in text[best]], bool)
    whole = _wholes(field, groups, members, size, surroundings)
    labels, part_labels = _assign(field, groups, whole)
    groups_of = zip(whole, _places(labels, len(whole)), _places(part_labels, len(whole)))
    rows_of = [parts if above >= 0 else wholes for above, wholes, parts in groups_of]
    gaussians = np.array([len(group) for group in rows_of], int)
    shown, views = members @ pixels, np.asarray(field.votes.views)
    counts = np.count_nonzero(shown, axis=1)
    sure = np.array([len(r) and n >= SURE_SHARE * np.median(views[r]) for n, r in zip(counts, rows_of)], bool)
    complete = np.array([_frames_around(field, group)[row > 0].sum() for row, group in zip(shown, rows_of)], int)
    top, listed = np.where(whole < 0, np.arange(len(whole)), whole), gaussians >= MIN_SAMPLES
    order_of_wholes = (top, -gaussians[top], -complete[top], ~sure[top], surroundings[top])
    rows = np.lexsort((-gaussians, whole >= 0, *order_of_wholes))  # each part behind its whole
    rows = rows[listed[rows] & listed[top[rows]]]

    renumber = np.full(len(whole) + 1, -1, np.int32)  # the last entry is that of -1
    renumber[rows] = np.arange(len(rows))
    labels, part_labels = renumber[labels], renumber[part_labels]
    wholes, parts = np.flatnonzero(labels >= 0), np.flatnonzero(part_labels >= 0)
    ids = np.concatenate([labels[wholes], part_labels[parts]])
    source_axis = np.array(source_up(field, axis).axis)
    return Catalogue(
        names=text[best[rows]],
        class_ids=np.unique(text[best[rows]].astype(str), return_inverse=True)[1].astype(np.int32),
        probability=probability[rows],
        surroundings=surroundings[rows],
        sure=sure[rows],
        parent=renumber[whole[rows]],
        pixels=shown[rows],
        shapes=source_shapes(field, np.concatenate([wholes, parts]), ids, source_axis),
        labels=labels,
        part_labels=part_labels,
        regions=renumber[groups],
        up=source_axis,
        up_evidence=str(axis),
        frame_names=field.names,
        world=world_record(field),
    )


def _frames_around(field: LanguageField, rows: Int[np.ndarray, " m"]) -> Bool[np.ndarray, " t"]:
    """Finds the frames in which the box of some Gaussians lies whole."""
    if not len(rows):
        return np.zeros(len(field.names), bool)
    means = np.asarray(field.gaussians.means)[rows]
    corners = np.stack(np.meshgrid(*np.stack([means.min(0), means.max(0)], 1)), -1).reshape(-1, 3)
    return np.all(points_in_view(field.cameras, corners), axis=1)


def _vocabulary(
    field: LanguageField, vocabulary: Sequence[str] | None, embedder: Any
) -> tuple[tuple[str, ...], np.ndarray, float]:
    """Returns the names to choose from, their embeddings (V, E), and the scale of cosines in the softmax."""
    words_known = field.unrelated_words is not None and len(field.unrelated_words) == len(UNRELATED_WORDS)
    if vocabulary is None and embedder is None and words_known and not field.embedder.startswith("colours"):
        # Without the model.
        return UNRELATED_WORDS, np.asarray(field.unrelated_words, np.float32), SOFTMAX_SCALE
    if embedder is None:
        from jsecon.pipeline.model_loading import field_embedder

        embedder = field_embedder(field)
    texts = tuple(getattr(embedder, "vocabulary", UNRELATED_WORDS) if vocabulary is None else vocabulary)
    if not texts:
        raise InputError("vocabulary", "it has no names", remedy="Give at least one name.")
    rows = embed_unrelated_words(embedder) if texts == UNRELATED_WORDS else np.asarray(embedder.embed_text(list(texts)))
    return texts, rows, getattr(embedder, "softmax_scale", SOFTMAX_SCALE)


def _name(
    embeddings: np.ndarray, names: np.ndarray, scale: float, allowed: Bool[np.ndarray, "k v"]
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Returns the most probable of V names (V, E) of each of K embeddings (K, E) of any length, and its probability.

    A name that is not `allowed`, because a query finds it absent, has probability 0: the catalogue and queries have one
    judgement.
    """
    rows, columns = np.asarray(embeddings, np.float64), np.asarray(names, np.float64)
    lengths = np.linalg.norm(rows, axis=1)[:, None] * np.linalg.norm(columns, axis=1)
    cosines = rows @ columns.T / np.where(lengths > 0, lengths, 1.0)
    raw = softmax(scale * cosines, axis=1)
    probability = np.where(allowed, raw, 0.0)
    best = np.lexsort((-raw, -probability), axis=1)[:, 0]  # stable
    return best, probability[np.arange(len(best)), best]


def palette(count: int) -> UInt8[np.ndarray, "n 3"]:
    """Chooses RGB of regions 0 .. count-1, none of which depends on `count`: golden angles apart."""
    hues = (0.11 + 0.61803398875 * np.arange(count)) % 1.0
    colours = [colorsys.hls_to_rgb(h, (0.62, 0.42, 0.72)[i % 3], 0.85) for i, h in enumerate(hues)]
    return (np.asarray(colours, np.float64).reshape(count, 3) * 255).astype(np.uint8)


def main_regions(field: LanguageField) -> Int[np.ndarray, " n"]:
    """Finds the region that has at least half of each Gaussian's weight, or -1. The votes are read in blocks."""
    return _sizes(field)[1]


def _sizes(field: LanguageField) -> tuple[Float[np.ndarray, " r"], Int[np.ndarray, " n"]]:
    """Returns the sum of each region's shares, and the region that has at least half of each Gaussian, or -1."""
    size = np.zeros(field.regions.count)
    main = [np.zeros(0, np.int32)]
    for votes in vote_blocks(field.votes):
        shares, regions = np.nan_to_num(np.asarray(vote_shares(votes))), np.asarray(votes.regions)
        size += np.bincount(regions[regions >= 0], shares[regions >= 0], len(size))[: len(size)]
        best = shares.argmax(1)
        rows = np.arange(len(best))
        main.append(np.where(shares[rows, best] >= SHARE_THRESHOLD, regions[rows, best], -1))
    return size, np.concatenate(main)


def _is_small(
    field: LanguageField, groups: Int[np.ndarray, " r"], main: Int[np.ndarray, " n"]
) -> Bool[np.ndarray, " k"]:
    """Whether groups of regions are too small to be background, however much of near frames they fill."""
    means = np.asarray(field.gaussians.means, np.float64)

    def sides(rows: np.ndarray) -> np.ndarray:
        finite = means[rows][np.isfinite(means[rows]).all(1)]
        return np.ptp(np.quantile(finite, (0.05, 0.95), axis=0), axis=0) if len(finite) else np.full(3, np.inf)

    limit = SMALL_SHARE * np.median(sides(inner_scene(field.gaussians)))
    owned = _places(np.append(groups, -1)[main], int(groups.max(initial=-1)) + 1)
    return np.array([sides(rows).max() < limit for rows in owned], bool)


def _same_object(field: LanguageField) -> tuple[Bool[np.ndarray, "r r"], Bool[np.ndarray, "r r"]]:
    """Finds the pairs of regions that show one object, and those that look as if they did (`duplicate_cosine`).

    A question for either region of the first pairs adds the other, and they overlap; without `Votes.overlap` no two
    regions are joined. Both relations are symmetric.
    """
    itself = np.eye(field.regions.count, dtype=bool)

    def matched(regions: Iterable[int], rules: QueryRules) -> np.ndarray:
        chosen = itself.copy()
        for region in regions:
            chosen[region] = match_region(field, region, rules).chosen
        return chosen & chosen.T

    alike = matched(range(len(itself)), QueryRules(fragment_score=None))
    if field.votes.overlap is None:
        return itself, alike
    overlaps = itself | (np.asarray(field.votes.overlap) >= MIN_FRAGMENT_OVERLAP)
    several = np.flatnonzero(overlaps.sum(axis=1) > 1).tolist()
    return overlaps & matched(several, QueryRules()), alike


def _region_objects(field: LanguageField, main: np.ndarray, up: np.ndarray) -> Int[np.ndarray, " r"]:
    """Returns the group of each region, by the rules of `objects`: those that show one object have the same one.

    `main` are the `main_regions`, and `up` is the unit up axis in the field's world.
    """
    if field.regions.count == 0:
        return np.zeros(0, int)
    joined, alike = _same_object(field)
    plain = dataclasses.replace(field.gaussians, sh=None)

    @functools.cache
    def shape(*regions: int) -> ObjectShapes:
        chosen = gaussian_rows(plain, np.concatenate([np.flatnonzero(main == region) for region in regions]))
        return object_shapes(chosen.means, np.zeros(chosen.count, int), up, spreads=gaussian_spreads(chosen))

    large = _counts(main, len(joined)) >= MIN_SAMPLES
    for first, second in np.argwhere(np.triu(alike & ~joined & large & large[:, None], 1)).tolist():
        joined[first, second] = _is_continued(shape(first), shape(second), functools.partial(shape, first, second))
    return sparse.csgraph.connected_components(joined, directed=False)[1]


def _is_continued(first: ObjectShapes, second: ObjectShapes, common: Callable[[], ObjectShapes]) -> bool:
    """Whether two objects touch, are of like size and fill the box of their `common` shape, which costs the most.

    The gap is at most 0.1 diagonals of the smaller box: two mugs side by side are farther apart. The larger one has at
    most three times the volume of the other, for a large thing alone fills its box and that of a small thing at its
    side. The two fill 0.7 of their common box at least.
    """
    pair = jax.tree.map(lambda *columns: np.concatenate(columns), first, second)
    local = [np.abs((pair.points[1 - k] - pair.center[k]) @ pair.axes[k]) for k in (0, 1)]
    gap = min(np.linalg.norm(np.maximum(local[k] - pair.half_size[k], 0), axis=1).min() for k in (0, 1))
    volume = np.prod(pair.half_size, axis=1)
    size = 2 * np.linalg.norm(pair.half_size, axis=1).min()
    comparable = volume.max() <= 3 * volume.min()
    return bool(comparable and gap <= 0.1 * size and volume.sum() >= 0.7 * np.prod(common().half_size))


def _wholes(
    field: LanguageField, groups: np.ndarray, members: np.ndarray, size: np.ndarray, surroundings: np.ndarray
) -> Int[np.ndarray, " g"]:
    """Returns the group of which each of G groups is a part, or -1. The tree has two levels."""
    whole = np.full(len(members), -1)
    if field.votes.overlap is None or not len(groups):
        return whole
    # How much of region r lies in region s: sum_n min(p_nr, p_ns) / sum_n p_nr, with p the shares.
    overlap = np.asarray(field.votes.overlap, np.float64)
    both = overlap * (size[:, None] + size) / (1 + overlap)
    inside = both / np.where(size > 0, size, np.inf)[:, None]
    sizes = members @ size
    for group in np.argsort(-sizes, kind="stable"):  # wholes before their parts
        largest = int(np.argmax(np.where(members[group], size, -1)))
        larger = (sizes[groups] > sizes[group]) & ~surroundings[groups]
        region = int(np.argmax(np.where(larger, inside[largest], -1)))
        if larger[region] and inside[largest, region] >= PART_CONTAINMENT and not surroundings[group]:
            whole[group] = groups[region] if whole[groups[region]] < 0 else whole[groups[region]]
    return whole


@stored_jit
def _objects_of_gaussians(votes: Votes, objects: Int[Array, " r_and_1"]) -> Int[Array, " n"]:
    """Assigns each Gaussian to the object with the largest share in it.

    The share is that of all regions of the object together (`inside_fraction`), so a query for exactly these regions
    selects the same Gaussians, and those that belong to another object even more. -1 is no object: of a region, and of
    a Gaussian with a share below SHARE_THRESHOLD. Each row stands for itself. `objects` ends with -1, for no region.
    """
    columns = list(vote_columns(votes))
    owners = [objects[region] for region, _, _ in columns]
    best_share = jnp.zeros(votes.total.shape, votes.weights.dtype)
    best = jnp.full(votes.total.shape, -1, jnp.int32)
    for owner in owners:
        weights = [jnp.where(other == owner, weight, 0.0) for other, (_, weight, _) in zip(owners, columns)]
        seen = [jnp.where(other == owner, seen, 0.0) for other, (_, _, seen) in zip(owners, columns)]
        share = ratio(functools.reduce(jnp.add, weights), functools.reduce(jnp.maximum, seen))
        share = jnp.nan_to_num(share)
        better = (owner >= 0) & (votes.views > 0) & (share > best_share)
        best, best_share = jnp.where(better, owner, best), jnp.where(better, share, best_share)
    return jnp.where(best_share >= SHARE_THRESHOLD, best, -1).astype(jnp.int32)


def _assign(field: LanguageField, groups: np.ndarray, whole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the whole (N,) and the part (N,) of each Gaussian."""
    ids, above = np.arange(len(whole)), np.append(whole, -1)  # the last entry is that of -1
    columns = np.where(whole < 0, ids, whole)[groups], np.where(whole < 0, -1, ids)[groups]
    tops, parts = (jnp.asarray(np.append(column, -1).astype(np.int32)) for column in columns)
    labels, part_labels = [], []
    for votes in vote_blocks(field.votes):
        top, part = (np.asarray(_objects_of_gaussians(votes, objects)) for objects in (tops, parts))
        labels.append(top)
        part_labels.append(np.where(above[part] == top, part, -1))
    return np.concatenate(labels), np.concatenate(part_labels)


def _places(labels: np.ndarray, count: int) -> list[np.ndarray]:
    """Lists the places of each of `count` labels, rising."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.searchsorted(labels[order], np.arange(count + 1)))[1:-1]


def _counts(labels: np.ndarray, count: int) -> np.ndarray:
    """Returns how many labels each of `count` groups has."""
    return np.bincount(labels[labels >= 0], minlength=count)
