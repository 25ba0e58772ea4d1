"""CLIP folders for tests: true in format and signature, with the small vocabulary of clip_tokens.json and graphs that
know four colours."""

import functools
import json
from pathlib import Path

import numpy as np
from onnx_files import Sketch
from tokenizers import Regex, Tokenizer, models, normalizers, pre_tokenizers, processors

CLIP_MEAN, CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
COLOURS = {"red": (0.9, 0.1, 0.1), "green": (0.1, 0.8, 0.2), "blue": (0.1, 0.2, 0.9), "yellow": (0.9, 0.8, 0.1)}
SIZE = 32
LENGTH = 77
OTHER_MEAN, OTHER_STD = [0.5, 0.4, 0.3], [0.2, 0.25, 0.3]
START, END = "<|startoftext|>", "<|endoftext|>"


@functools.cache
def fixture() -> dict:
    """Merges, and [text, ids] by open_clip 3.3.0 on them."""
    return json.loads((Path(__file__).parent / "clip_tokens.json").read_text())


def vocabulary() -> dict[str, int]:
    """CLIP's numbering: the bytes in the order of their signs, the same at the end of a word, the merges, the ends."""
    signs, merges = sorted(pre_tokenizers.ByteLevel.alphabet()), fixture()["merges"]
    tokens = [*signs, *(sign + "</w>" for sign in signs), *map("".join, merges), START, END]
    return {token: number for number, token in enumerate(tokens)}


@functools.cache
def clip_tokenizer() -> Tokenizer:
    """CLIP's, as Hugging Face's fast tokenizers make it."""
    vocab, merges = vocabulary(), [tuple(pair) for pair in fixture()["merges"]]
    own = {"unk_token": END, "continuing_subword_prefix": "", "end_of_word_suffix": "</w>"}
    tokenizer = Tokenizer(models.BPE(vocab, merges, **own))
    tokenizer.add_special_tokens([START, END])
    spaces = normalizers.Replace(Regex(r"\s+"), " ")
    tokenizer.normalizer = normalizers.Sequence([normalizers.NFC(), spaces, normalizers.Lowercase()])
    words = Regex(r"'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+")
    split = pre_tokenizers.Split(words, "removed", invert=True)
    as_bytes = pre_tokenizers.ByteLevel(add_prefix_space=False, trim_offsets=True, use_regex=False)
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence([split, as_bytes])
    ends = (END, vocab[END]), (START, vocab[START])
    tokenizer.post_processor = processors.RobertaProcessing(*ends, trim_offsets=False, add_prefix_space=False)
    return tokenizer


def write_tokenizer(path: Path) -> Path:
    """CLIP's tokenizer.json."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(clip_tokenizer().to_str(), encoding="utf-8")
    return path


def write_visual(path: Path, names: tuple[str, str], batch: int | str, mean=CLIP_MEAN, std=CLIP_STD) -> Path:
    """Images -> mean RGB in 0..1, 3 numbers: the normalisation is undone inside, so a wrong one shows."""
    g = Sketch()
    rgb = g("Add", g("Mul", names[0], np.reshape(std, (1, 3, 1, 1))), np.reshape(mean, (1, 3, 1, 1)))
    g("ReduceMean", rgb, axes=[2, 3], keepdims=0, into=names[1])
    return g.save(path, {names[0]: ("float32", [batch, 3, SIZE, SIZE])}, {names[1]: ("float32", [batch, 3])})


def write_textual(path: Path, names: tuple[str, ...], table: np.ndarray, shape: list, kind: str, *, mask=False) -> Path:
    """Texts of a shape -> the sum of the colours of their tokens by a table; with a mask, of those that it leaves in.

    `names` are of the input and of the outputs: before the sum, a graph may give the colour of each token.
    """
    tokens, *each, total = names
    g = Sketch()
    rows = g("Gather", table, tokens, into=each[0] if each else None)
    inputs, outputs = {tokens: (kind, shape)}, {total: ("float32", [shape[0], 3])}
    outputs |= {name: ("float32", [*shape, 3]) for name in each}
    if mask:
        inputs["attention_mask"] = (kind, shape)
        rows = g("Mul", rows, g("Unsqueeze", g("Cast", "attention_mask", to=1), [2]))
    g("ReduceSum", rows, [1], keepdims=0, into=total)
    return g.save(path, inputs, outputs)


def token_colours() -> np.ndarray:
    """The colour of each token: of the last one of a colour's word, else a little grey."""
    vocab = vocabulary()
    table = np.full((len(vocab), 3), 0.001, np.float32)
    for word, colour in COLOURS.items():
        table[clip_tokenizer().encode(word).ids[-2]] = colour  # the others are shared with other words
    table[[vocab[START], vocab[END], 0]] = 0
    return table


def write_clip(folder: Path, layout: str) -> Path:
    """A CLIP folder that knows colours, in the layout of immich or of transformers.js, each with its own signature."""
    if layout == "immich":
        write_visual(folder / "visual" / "model.onnx", ("image", "embedding"), 1)
        textual = folder / "textual"
        write_textual(textual / "model.onnx", ("text", "embedding"), token_colours(), [1, LENGTH], "int32")
        write_tokenizer(textual / "tokenizer.json")
        config = {"size": [SIZE, SIZE], "mode": "RGB", "mean": CLIP_MEAN, "std": CLIP_STD, "interpolation": "bicubic"}
        (folder / "visual" / "preprocess_cfg.json").write_text(json.dumps(config))
    else:
        onnx, shape = folder / "onnx", ["batch", LENGTH]
        write_visual(onnx / "vision_model.onnx", ("pixel_values", "image_embeds"), "batch", OTHER_MEAN, OTHER_STD)
        names = "input_ids", "text_embeds"
        write_textual(onnx / "text_model.onnx", names, token_colours(), shape, "int64", mask=True)
        write_tokenizer(folder / "tokenizer.json")
        config = {"crop_size": {"height": SIZE, "width": SIZE}, "image_mean": OTHER_MEAN, "image_std": OTHER_STD}
        (folder / "preprocessor_config.json").write_text(json.dumps(config))
    return folder
