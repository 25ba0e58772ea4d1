"""Common nouns of all kinds: what the similarity of a text with a scene is measured against.

Few of them are in any one scene. So their best regions say how similar a text is to a scene that does not hold what
it names (jsecon.query.match). The list was written before anything was measured with it.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from jsecon.errors import InputError
from jsecon.vision.protocols import Embedder

UNRELATED_WORDS: tuple[str, ...] = tuple(
    word.strip() for word in Path(__file__).with_name("unrelated_words.txt").read_text().split(",")
)


def embed_unrelated_words(embedder: Embedder) -> Float32[np.ndarray, "w e"]:
    """Embeds texts that have nothing to do with a scene: the embedder's own, or UNRELATED_WORDS if it knows these."""
    rows = getattr(embedder, "unrelated_words", None)
    if rows is None:
        try:
            rows = embedder.embed_text(list(UNRELATED_WORDS))
        except InputError:
            rows = np.zeros((0, embedder.dim))
    return np.asarray(rows, np.float32)
