"""CLIP folders for tests: true in format and signature, with the small vocabulary of clip_tokens.json and graphs that
know four colours."""

import functools
import json
import tempfile
from pathlib import Path

import numpy as np
from onnx_files import Sketch
from tokenizers import pre_tokenizers

from jsecon.networks.tokenizer import TextTokenizer


@functools.cache
def fixture() -> dict:
    """Merges, and [text, ids] by open_clip 3.3.0 on them."""
    return json.loads((Path(__file__).parent / "clip_tokens.json").read_text())


def vocabulary() -> dict[str, int]:
    """CLIP's numbering: the bytes in the order of their signs, the same at the end of a word, the merges, the ends."""
    signs, merges = sorted(pre_tokenizers.ByteLevel.alphabet()), fixture()["merges"]
    tokens = [*signs, *(sign + "</w>" for sign in signs), *map("".join, merges), "<|startoftext|>", "<|endoftext|>"]
    return {token: number for number, token in enumerate(tokens)}


def write_tokenizer(path: Path) -> Path:
    """tokenizer.json as Hugging Face's fast tokenizers write CLIP's."""
    vocab = vocabulary()
    ends = [
        {
            "id": vocab[name],
            "content": name,
            "special": True,
            **dict.fromkeys(("normalized", "single_word", "lstrip", "rstrip"), False),
        }
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
    words = r"'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+"
    steps = [
        {"type": "Split", "pattern": {"Regex": words}, "behavior": "Removed", "invert": True},
        {"type": "ByteLevel", "add_prefix_space": False, "trim_offsets": True, "use_regex": False},
    ]
    spaces = {"type": "Replace", "pattern": {"Regex": r"\s+"}, "content": " "}
    frame = {"sep": ["<|endoftext|>", vocab["<|endoftext|>"]], "cls": ["<|startoftext|>", vocab["<|startoftext|>"]]}
    content = {
        "version": "1.0",
        "added_tokens": ends,
        "normalizer": {"type": "Sequence", "normalizers": [{"type": "NFC"}, spaces, {"type": "Lowercase"}]},
        "pre_tokenizer": {"type": "Sequence", "pretokenizers": steps},
        "post_processor": {"type": "RobertaProcessing", "trim_offsets": False, "add_prefix_space": False} | frame,
        "model": model,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


CLIP_MEAN, CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
COLOURS = {"red": (0.9, 0.1, 0.1), "green": (0.1, 0.8, 0.2), "blue": (0.1, 0.2, 0.9), "yellow": (0.9, 0.8, 0.1)}
SIZE = 32
LENGTH = 77
OTHER_MEAN, OTHER_STD = [0.5, 0.4, 0.3], [0.2, 0.25, 0.3]


def write_visual(path: Path, names: tuple[str, str], batch: int | str, mean=CLIP_MEAN, std=CLIP_STD) -> Path:
    """Images -> mean RGB in 0..1, 3 numbers: the normalisation is undone inside, so a wrong one shows."""
    g = Sketch()
    rgb = g("Add", g("Mul", names[0], np.reshape(std, (1, 3, 1, 1))), np.reshape(mean, (1, 3, 1, 1)))
    g("ReduceMean", rgb, axes=[2, 3], keepdims=0, into=names[1])
    return g.save(path, {names[0]: ("float32", [batch, 3, SIZE, SIZE])}, {names[1]: ("float32", [batch, 3])})


def write_textual(path: Path, names: tuple[str, str], batch: int | str, kind: str, *, mask: bool = False) -> Path:
    """Texts -> the sum of the colours that they name, by a table of one row a token; a little grey for other tokens.

    With a mask, of the tokens that it leaves in.
    """
    vocab = vocabulary()
    table = np.full((len(vocab), 3), 0.001, np.float32)
    for word, colour in COLOURS.items():
        table[load_tokens([word])[0]] = colour
    table[[vocab["<|startoftext|>"], vocab["<|endoftext|>"], 0]] = 0
    g = Sketch()
    rows = g("Gather", table, names[0])
    inputs = {names[0]: (kind, [batch, LENGTH])}
    if mask:
        inputs["attention_mask"] = (kind, [batch, LENGTH])
        rows = g("Mul", rows, g("Unsqueeze", g("Cast", "attention_mask", to=1), [2]))
    g("ReduceSum", rows, [1], keepdims=0, into=names[1])
    return g.save(path, inputs, {names[1]: ("float32", [batch, 3])})


def load_tokens(texts: list[str]) -> list[int]:
    """The last id of each word: where the small vocabulary splits it, the others are shared with other words."""
    with tempfile.TemporaryDirectory() as folder:
        tokenizer = TextTokenizer(write_tokenizer(Path(folder) / "tokenizer.json"), None)
    return [row[used.sum() - 2] for row, used in zip(*tokenizer(texts, LENGTH))]


def write_clip(folder: Path, layout: str) -> Path:
    """A CLIP folder that knows colours, in the layout of immich or of transformers.js, each with its own signature."""
    if layout == "immich":
        write_visual(folder / "visual" / "model.onnx", ("image", "embedding"), 1)
        write_textual(folder / "textual" / "model.onnx", ("text", "embedding"), 1, "int32")
        write_tokenizer(folder / "textual" / "tokenizer.json")
        config = {"size": [SIZE, SIZE], "mode": "RGB", "mean": CLIP_MEAN, "std": CLIP_STD, "interpolation": "bicubic"}
        (folder / "visual" / "preprocess_cfg.json").write_text(json.dumps(config))
    else:
        write_visual(
            folder / "onnx" / "vision_model.onnx", ("pixel_values", "image_embeds"), "batch", OTHER_MEAN, OTHER_STD
        )
        write_textual(folder / "onnx" / "text_model.onnx", ("input_ids", "text_embeds"), "batch", "int64", mask=True)
        write_tokenizer(folder / "tokenizer.json")
        config = {"crop_size": {"height": SIZE, "width": SIZE}, "image_mean": OTHER_MEAN, "image_std": OTHER_STD}
        (folder / "preprocessor_config.json").write_text(json.dumps(config))
    return folder
