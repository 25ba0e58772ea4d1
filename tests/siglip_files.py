"""SigLIP folders for tests: true in format and signature, with graphs that know four colours. Texts are all read, the
padding too, which shifts every colour a little towards grey: another padding, or another length, shows."""

import json
from pathlib import Path
from string import ascii_lowercase

import numpy as np
from clip_files import COLOURS, SIZE, write_textual, write_visual

LENGTH = 12
HALF = (0.5, 0.5, 0.5)
TOKENS = ["<pad>", "</s>", "<unk>", *(f"▁{word}" for word in (*COLOURS, "a", "thing", "")), *ascii_lowercase]
PADDING, UNKNOWN = 0.01, 0.002
"""grey that a filled place adds, and a token that is no colour"""


def write_unigram(folder: Path, *, tokenizer_class: str = "SiglipTokenizer", **settings) -> Path:
    """tokenizer.json of SentencePiece's kind with tokenizer_config.json beside it, as SigLIP's are: "</s>" both ends a
    text and fills it."""
    from tokenizers import Tokenizer, models, pre_tokenizers, processors

    scores = [-1.0 if len(token) > 1 else -8.0 for token in TOKENS]
    tokenizer = Tokenizer(models.Unigram(list(zip(TOKENS, scores)), unk_id=2))
    tokenizer.pre_tokenizer = pre_tokenizers.Metaspace()
    tokenizer.post_processor = processors.TemplateProcessing(single="$A </s>", special_tokens=[("</s>", 1)])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "tokenizer.json").write_text(tokenizer.to_str(), encoding="utf-8")
    told = {"tokenizer_class": tokenizer_class, "pad_token": {"content": "</s>"}} | settings
    (folder / "tokenizer_config.json").write_text(json.dumps(told))
    return folder / "tokenizer.json"


def table() -> np.ndarray:
    """The colour of each token."""
    rows = np.full((len(TOKENS), 3), UNKNOWN, np.float32)
    rows[1] = PADDING
    for name, colour in COLOURS.items():
        rows[TOKENS.index(f"▁{name}")] = colour
    return rows


def embedded(texts: list[str], length: int = LENGTH) -> np.ndarray:
    """(Q, 3) unit: what a folder makes of texts of whole words, counted by hand."""
    found = []
    for text in texts:
        tokens = [f"▁{word}" for word in text.split()][: length - 1]
        tokens += ["</s>"] * (length - len(tokens))
        found.append(table()[[TOKENS.index(token) for token in tokens]].sum(0))
    return np.asarray(found) / np.linalg.norm(found, axis=1, keepdims=True)


def write_siglip(folder: Path, layout: str) -> Path:
    """A SigLIP folder of immich's layout or of that of transformers.js."""
    if layout == "immich":
        write_visual(folder / "visual" / "model.onnx", ("image", "image_embedding"), 1, HALF, HALF)
        write_textual(folder / "textual" / "model.onnx", ("text", "text_embedding"), table(), [1, LENGTH], "int32")
        write_unigram(folder / "textual", tokenizer_class="T5TokenizerFast")
        text = {"context_length": LENGTH, "hf_tokenizer_name": "x", "tokenizer_kwargs": {"clean": "canonicalize"}}
        write_json(folder / "config.json", {"init_logit_bias": -10, "text_cfg": text})
        write_json(folder / "visual" / "preprocess_cfg.json", {"size": [SIZE, SIZE], "mean": HALF, "std": HALF})
        return folder
    names, onnx = ("input_ids", "last_hidden_state", "pooler_output"), folder / "onnx"
    write_visual(onnx / "vision_model.onnx", ("pixel_values", "pooler_output"), "batch", HALF, HALF)
    write_textual(onnx / "text_model.onnx", names, table(), ["batch", "length"], "int64")
    write_unigram(folder)
    write_json(folder / "config.json", {"model_type": "siglip", "text_config": {"max_position_embeddings": LENGTH}})
    images = {"do_rescale": True, "rescale_factor": 1 / 255, "image_mean": HALF, "image_std": HALF}
    write_json(folder / "preprocessor_config.json", images | {"size": {"height": SIZE, "width": SIZE}})
    return folder


def write_json(path: Path, content: object) -> None:
    """`content` as a JSON file."""
    path.write_text(json.dumps(content), encoding="utf-8")
