"""Common nouns of all kinds: what the similarity of a text with a scene is measured against.

Few of them are in any one scene. So their best regions say how similar a text is to a scene that does not hold what
it names (jsecon.query.match). The list was written before anything was measured with it.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from jsecon.errors import InputError
from jsecon.process import cache_home
from jsecon.vision.protocols import Embedder
from jsecon.vision.stores import stored_array

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


def cached_unrelated_words(
    space: str, embed_text: Callable[[list[str]], Float32[np.ndarray, "w e"]]
) -> Float32[np.ndarray, "w e"]:
    """Embeds UNRELATED_WORDS, or reads them from the user's cache folder, where they are kept for each space."""
    home = cache_home(os.environ)
    if home is None:
        return embed_text(list(UNRELATED_WORDS))
    digest = hashlib.blake2b(repr((space, UNRELATED_WORDS)).encode(), digest_size=12).hexdigest()
    path = home / "jsecon" / f"words-{digest}.safetensors"
    return stored_array(path, lambda: embed_text(list(UNRELATED_WORDS)))
