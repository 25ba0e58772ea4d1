"""LangSplat-m: each frame's own masks and embeddings, 3-d codes by an autoencoder, 30,000 steps on the rendered L1.

LangSplat (Qin et al. 2024) read at the Gaussians, as OpenGaussian (its issue 9) and the paper measure it. Training
after minghanqin/LangSplat, autoencoder/train.py and train.py.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from experiments.baselines.evidence import Evidence, with_room
from jsecon.paper.autoencoder import decode, encode, train_autoencoder
from jsecon.paper.distill import distill_l1
from jsecon.types import Array, Autoencoder

STEPS = 30_000
LATENT = 3


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class LangSplat:
    """A trained LangSplat of one level."""

    codes: Array
    """(N, 3) unit; zero where no masked pixel ever saw the Gaussian."""
    autoencoder: Autoencoder
    history: Array
    """(steps,) the loss before each step."""

    def features(self) -> Float[Array, "n e"]:
        """(N, E) decoded codes; zero where the code is unknown."""
        decoded = decode(self.autoencoder, self.codes)
        return jnp.where(jnp.any(self.codes != 0, axis=-1, keepdims=True), decoded, 0.0)


def train_langsplat(evidence: Evidence, *, key: Array, steps: int = STEPS, **training: Any) -> LangSplat:
    """Trains the autoencoder on all masks' embeddings, then the Gaussians' codes from random ones.

    LangSplat starts at zero and needs some 18,000 steps to leave it, as the gradient through f / (|f| + 1e-9) at 0
    fills Adam's second moment; random codes get there in hundreds. `training` goes to `train_autoencoder`.
    """
    coder_key, code_key = jax.random.split(key)
    autoencoder = train_autoencoder(jnp.asarray(evidence.embeddings), latent=LATENT, key=coder_key, **training)
    table = encode(autoencoder, jnp.asarray(evidence.embeddings))
    given = with_room(evidence.gaussians), evidence.cameras, jnp.asarray(evidence.masks), table
    codes, history = distill_l1(*given, steps=steps, key=code_key)
    return LangSplat(codes[: evidence.gaussians.count], autoencoder, history)
