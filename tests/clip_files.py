"""A CLIP tokenizer's files for tests: true in format, with the small vocabulary of clip_tokens.json."""

import functools
import json
from pathlib import Path

from jsecon.vision.tokenizer import byte_symbols


@functools.cache
def fixture() -> dict:
    """Merges, and [text, ids] by open_clip on them: written by experiments/clip_tokenizer.py."""
    return json.loads((Path(__file__).parent / "clip_tokens.json").read_text())


def vocabulary() -> dict[str, int]:
    """CLIP's numbering: the bytes in the order of their signs, the same at the end of a word, the merges, the ends."""
    signs, merges = sorted(byte_symbols()), fixture()["merges"]
    tokens = [*signs, *(sign + "</w>" for sign in signs), *map("".join, merges), "<|startoftext|>", "<|endoftext|>"]
    return {token: number for number, token in enumerate(tokens)}


def write_tokenizer(path: Path) -> Path:
    """tokenizer.json as Hugging Face's fast tokenizers write CLIP's."""
    vocab = vocabulary()
    ends = [
        {"id": vocab[name], "content": name, "special": True, "normalized": False}
        for name in ("<|startoftext|>", "<|endoftext|>")
    ]
    model = {
        "type": "BPE",
        "unk_token": "<|endoftext|>",
        "continuing_subword_prefix": "",
        "end_of_word_suffix": "</w>",
        "vocab": vocab,
        "merges": [" ".join(pair) for pair in fixture()["merges"]],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"version": "1.0", "added_tokens": ends, "model": model}), encoding="utf-8")
    return path
