"""Every Gaussian's class, out of a list of names: the question of ScanNet's and Replica's protocols.

A text finds one region, the best; a list of classes divides the scene among them, however many things each class has.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from jsecon.errors import require
from jsecon.numerics import safe_norm
from jsecon.query.one_step import Number
from jsecon.query.retrieval import answers, apart_from_scene, threshold_of
from jsecon.types import Array, LanguageField


def query_classes(
    field: LanguageField,
    texts: Float[Array, "q e"],
    *,
    retrieval: str = "contrast",
    retrieval_threshold: Number | None = None,
    every: bool = False,
) -> tuple[Int[Array, " n"], Float[Array, "n q"]]:
    """The class of each Gaussian (N,), index of `texts` (Q, E), -1 = none; and how far it answers each text (N, Q).

        sum_r p_nr l_r s_rq / sum_r p_nr l_r

    with s the similarities of regions and texts, `retrieval` as in `query_anchored`, p_nr the region's share of the
    weight with which the Gaussian was seen in the views that show the region (of all weight, where the votes do not
    know), and l_r the length of what sets the region apart from the scene (`apart_from_scene`; 1 for "cosine"): so the
    numerator is what the mean of its regions' embeddings has in common with the text. A large surface lies near the
    scene's mean and says little; at the foot of a thing, where its splats reach over the thing's, it has most of the
    weight. The class is the largest. A region whose best text stays below `retrieval_threshold` (default 0.12 for
    contrast, 0.2 for cosine) is none of the classes, such as the wall behind, and left out of the sums; a Gaussian with
    most of its share in such regions has no class. With `every` it has one all the same, as the protocols ask, which
    know no answer "none"; where no other region votes on it, from those that are left out elsewhere. Gaussians never
    seen, without votes on a region that has an embedding, or with votes that are not finite never have a class, and
    similarities 0. Pure: jit it or vmap it over sets of texts. Raises ValueError on texts of another size, on none, and
    on another `retrieval`.

    experiments/replica.py measures it at the points of Replica's twin.
    """
    size = field.regions.embeddings.shape[1]
    require(
        texts.ndim == 2 and texts.shape[0] >= 1 and texts.shape[1] == size,
        "query_classes",
        got=f"texts {texts.shape}",
        expected=f"(Q >= 1, {size})",
        remedy="Embed the names of the classes with the field's embedder.",
    )
    least = threshold_of(retrieval, retrieval_threshold, "query_classes")
    votes = field.votes
    known = (field.regions.embeddings, texts, field.canonical, field.regions.pixels)
    given = (*known, votes.regions, votes.weights, votes.total, votes.views)
    shown = None if votes.shown is None else jnp.asarray(votes.shown)
    return _classes(*map(jnp.asarray, given), shown, least, retrieval, every)


def _classes_body(embeddings, texts, canonical, pixels, regions, weights, total, views, shown, least, retrieval, every):
    count = embeddings.shape[0]
    shape = regions.shape[0], texts.shape[0]
    if count == 0:
        return jnp.full(shape[0], -1, jnp.int32), jnp.zeros(shape, embeddings.dtype)
    ask = lambda text: answers(embeddings, text, canonical, pixels, retrieval)
    similarity, known = jax.vmap(ask)(texts)  # (Q, R) both
    asked = jnp.any(known, axis=1)  # a text that means nothing is nobody's class
    table, known = jnp.where(known, similarity, 0.0).T, jnp.any(known, axis=0)
    clear = jnp.ones(count, table.dtype)
    if retrieval == "contrast":
        clear = safe_norm(apart_from_scene(embeddings, pixels)[0])
    speaks = known & (jnp.max(jnp.where(asked, table, -jnp.inf), axis=1) >= least)

    def vote(allowed):
        whole, heard, found = (jnp.zeros(size, weights.dtype) for size in (shape[0], shape[0], shape))
        for k in range(regions.shape[1]):
            place = jnp.clip(regions[:, k], 0, count - 1)
            seen = total if shown is None else shown[:, k]
            share = jnp.where(seen > 0, weights[:, k] / jnp.where(seen > 0, seen, 1.0), 0.0)
            share = jnp.where((regions[:, k] == place) & allowed[place], share, 0.0)
            part = share * clear[place]
            whole, heard, found = whole + share, heard + part, found + part[:, None] * table[place]
        return whole, heard, found

    (some, some_heard, among), (share_of_all, heard, found) = vote(speaks), vote(known)
    heard, found = jnp.where(some > 0, some_heard, heard), jnp.where((some > 0)[:, None], among, found)
    sound = (views > 0) & (heard > 0) & jnp.isfinite(heard) & jnp.isfinite(total) & jnp.any(asked)
    mean = jnp.where(sound[:, None], found / jnp.where(sound, heard, 1.0)[:, None], 0.0)
    best = jnp.argmax(jnp.where(asked, mean, -jnp.inf), axis=1)
    decided = sound if every else sound & (some >= 0.5 * share_of_all)
    return jnp.where(decided, best, -1).astype(jnp.int32), mean


_classes = jax.jit(_classes_body, static_argnames=("retrieval", "every"))
