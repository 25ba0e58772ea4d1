"""Every Gaussian's class, out of a list of names: the question of ScanNet's and Replica's protocols.

A text finds one region, the best; a list of classes divides the scene among them, however many things each class has.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from jsecon.errors import require
from jsecon.query.retrieval import answers, require_retrieval
from jsecon.types import Array, LanguageField


def query_classes(
    field: LanguageField, texts: Float[Array, "q e"], *, retrieval: str = "contrast"
) -> tuple[Int[Array, " n"], Float[Array, "n q"]]:
    """The class of each Gaussian (N,), index of `texts` (Q, E), -1 = none; and how far it answers each text (N, Q).

    That is the mean of its regions' similarities with the text, `retrieval` as in `query_anchored`, weighted by the
    votes that each region casts on the Gaussian: sum_r w_r s(r, q) / sum_r w_r over the regions with an embedding. The
    class is the largest; which one it is does not depend on a threshold, and something that is none of the classes gets
    the one it is nearest to. Gaussians never seen, with votes that are not finite, or without votes on a region that
    has an embedding have no class and similarities 0. Pure: jit it or vmap it over sets of texts. Raises ValueError on
    texts of another size, on none, and on another `retrieval`.
    """
    size = field.regions.embeddings.shape[1]
    require(
        texts.ndim == 2 and texts.shape[0] >= 1 and texts.shape[1] == size,
        "query_classes",
        got=f"texts {texts.shape}",
        expected=f"(Q >= 1, {size})",
        remedy="Embed the names of the classes with the field's embedder.",
    )
    require_retrieval(retrieval, "query_classes")
    known = (field.regions.embeddings, texts, field.canonical, field.regions.pixels)
    votes = (field.votes.regions, field.votes.weights, field.votes.views)
    return _classes(*map(jnp.asarray, (*known, *votes)), retrieval)


def _classes_body(embeddings, texts, canonical, pixels, regions, weights, views, retrieval):
    count = embeddings.shape[0]
    shape = regions.shape[0], texts.shape[0]
    if count == 0:
        return jnp.full(shape[0], -1, jnp.int32), jnp.zeros(shape, embeddings.dtype)
    ask = lambda text: answers(embeddings, text, canonical, pixels, retrieval)
    similarity, known = jax.vmap(ask)(texts)  # (Q, R) both
    asked = jnp.any(known, axis=1)  # a text that means nothing is nobody's class
    table, known = jnp.where(known, similarity, 0.0).T, jnp.any(known, axis=0)
    total, found = jnp.zeros(shape[0], weights.dtype), jnp.zeros(shape, weights.dtype)
    for k in range(regions.shape[1]):
        place = jnp.clip(regions[:, k], 0, count - 1)
        weight = jnp.where((regions[:, k] == place) & known[place], weights[:, k], 0.0)
        total, found = total + weight, found + weight[:, None] * table[place]
    sound = (views > 0) & (total > 0) & jnp.isfinite(total) & jnp.any(asked)
    mean = jnp.where(sound[:, None], found / jnp.where(sound, total, 1.0)[:, None], 0.0)
    best = jnp.argmax(jnp.where(asked, mean, -jnp.inf), axis=1)
    return jnp.where(sound, best, -1).astype(jnp.int32), mean


_classes = jax.jit(_classes_body, static_argnames="retrieval")
