"""The space of embeddings that came from files, where the model that made them is not at hand."""

from typing import NoReturn

import numpy as np

from jsecon.errors import InputError

_NAME = "given-"


class GivenSpace:
    """Embedder (jsecon.vision.protocols) of a space of `dim` numbers that no model here knows: it has no texts and no
    canonical phrases, and embeds nothing. Its regions can be asked for by a pixel."""

    def __init__(self, dim: int):
        self.dim, self.name = dim, f"{_NAME}{dim}"
        self.canonical = np.zeros((0, dim), np.float32)

    def embed_regions(self, frame: np.ndarray, masks: np.ndarray) -> NoReturn:
        """Raises InputError."""
        raise missing_model(self.dim)

    def embed_text(self, texts: list[str]) -> NoReturn:
        """Raises InputError."""
        raise missing_model(self.dim)


def given_dim(name: str | None) -> int | None:
    """How many numbers an embedding has in the given space of this name; None for every other space."""
    return int(name.removeprefix(_NAME)) if name is not None and name.startswith(_NAME) else None


def missing_model(dim: int) -> InputError:
    """That the model of a given space is needed."""
    return InputError(
        "field",
        found=f"regions whose embeddings came from files, {dim} numbers each",
        expected="the CLIP model that made them",
        remedy="Give its folder: --embedder DIR. Without it, ask by a pixel (--at).",
    )
