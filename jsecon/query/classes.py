"""Every Gaussian's class, out of a list of names: the question of ScanNet's and Replica's protocols.

A text finds one region, the best; a list of classes divides the scene among them, however many things each class has.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from jsecon.errors import require
from jsecon.language.shares import SHARE_THRESHOLD, ratio, share_of, vote_columns
from jsecon.numerics import safe_norm
from jsecon.query.direct import Number
from jsecon.query.retrieval import answers, apart_from_scene, presence, threshold_of
from jsecon.types import Array, LanguageField
from jsecon.vision.protocols import Logits


def query_classes(
    field: LanguageField,
    texts: Float[Array, "q e"],
    *,
    retrieval: str = "contrast",
    retrieval_threshold: Number | None = None,
    every: bool = False,
    logits: Logits | None = None,
) -> tuple[Int[Array, " n"], Float[Array, "n q"]]:
    """The class of each Gaussian (N,), index of `texts` (Q, E), -1 = none; and how far it answers each text (N, Q).

        sum_r p_nr l_r s_rq / sum_r p_nr l_r

    with s the similarities of regions and texts, `retrieval` as in `query_anchored`, p_nr the region's share of the
    Gaussian (`jsecon.language.shares`), and l_r the length of what sets the region apart from the scene
    (`apart_from_scene`; 1 for "cosine"): so the numerator is what the mean of its regions' embeddings has in common
    with the text. A large surface lies near the scene's mean and says little; at the foot of a thing, where its splats
    reach over the thing's, it has most of the weight. A region is of the class of its best text, and of none where that
    stays below `retrieval_threshold` (default 0.12 for contrast, 0.2 for cosine), such as the wall behind; those are
    left out of the sums. With the embedder's `logits` the threshold is on the probability that this text is true of the
    region (`presence`; default 0.01), as in `query_anchored`. The class is the largest among those whose regions have a
    share of at least 0.5, the threshold of a query by votes: a region that answers a text alone has the same Gaussians
    by either. With `every` it is the largest of all, as the protocols ask, which know no answer "none"; where no other
    region votes on a Gaussian, from those that are left out elsewhere. Gaussians never seen, without votes on a region
    that has an embedding, or with votes that are not finite never have a class, and similarities 0. Pure: jit it or
    vmap it over sets of texts. Raises ValueError on texts of another size, on none, and on another `retrieval`.

    experiments/replica.py measures it at the points of Replica's twin.
    """
    size = field.regions.embeddings.shape[1]
    fit = texts.ndim == 2 and texts.shape[0] >= 1 and texts.shape[1] == size
    remedy = "Embed the names of the classes with the field's embedder."
    require(fit, "query_classes", f"texts {texts.shape}", f"(Q >= 1, {size})", remedy)
    least = threshold_of(retrieval, retrieval_threshold, "query_classes", logits)
    if field.regions.count == 0:
        count, dtype = field.codes.shape[0], jnp.asarray(field.regions.embeddings).dtype
        return jnp.full(count, -1, jnp.int32), jnp.zeros((count, texts.shape[0]), dtype)
    given = field.regions.embeddings, texts, field.canonical, field.regions.pixels, field.votes
    return _classes(*jax.tree.map(jnp.asarray, given), least, logits, retrieval, every)


def _classes_body(embeddings, texts, canonical, pixels, votes, least, logits, retrieval, every):
    ask = lambda text: answers(embeddings, text, canonical, pixels, retrieval)
    similarity, known = jax.vmap(ask)(texts)  # (Q, R) both
    asked = jnp.any(known, axis=1)  # a text that means nothing is nobody's class
    table, known = jnp.where(known, similarity, 0.0).T, jnp.any(known, axis=0)
    clear = jnp.ones(len(embeddings), table.dtype)
    if retrieval == "contrast":
        clear = safe_norm(apart_from_scene(embeddings, pixels)[0])
    of_asked = jnp.where(asked, table, -jnp.inf)
    best, accepted = jnp.argmax(of_asked, axis=1), of_asked
    if logits is not None:
        accepted = jax.vmap(lambda text: presence(embeddings, text, logits), out_axes=1)(texts)
    accepted = jnp.where(asked, accepted, -jnp.inf)
    speaks = known & (jnp.take_along_axis(accepted, best[:, None], axis=1)[:, 0] >= least)
    shape = votes.regions.shape[0], len(texts)

    def vote(allowed):
        whole, heard, found = (jnp.zeros(size, table.dtype) for size in (shape[0], shape[0], shape))
        for region, weight, seen in vote_columns(votes):
            place = jnp.clip(region, 0, len(embeddings) - 1)
            share = jnp.where((region == place) & allowed[place], ratio(weight, seen), 0.0)
            part = share * clear[place]
            whole, heard, found = whole + share, heard + part, found + part[:, None] * table[place]
        return whole, heard, found

    (some, some_heard, among), (_, heard, found) = vote(speaks), vote(known)
    heard, found = jnp.where(some > 0, some_heard, heard), jnp.where((some > 0)[:, None], among, found)
    sound = (votes.views > 0) & (heard > 0) & jnp.isfinite(heard) & jnp.any(asked)
    mean = jnp.where(sound[:, None], found / jnp.where(sound, heard, 1.0)[:, None], 0.0)
    open_to = sound[:, None] & asked
    if not every:
        own = speaks & (best == jnp.arange(len(texts))[:, None])
        open_to &= jax.vmap(lambda chosen: share_of(votes, chosen).share, out_axes=1)(own) >= SHARE_THRESHOLD
    label = jnp.argmax(jnp.where(open_to, mean, -jnp.inf), axis=1)
    return jnp.where(jnp.any(open_to, axis=1), label, -1).astype(jnp.int32), mean


_classes = jax.jit(_classes_body, static_argnames=("retrieval", "every"))
