"""Folders of models: what they are good for, and one sentence that names the file for each kind of damage."""

import json
import shutil

import numpy as np
import pytest
from capture_files import refused
from clip_files import token_colours, write_clip, write_textual
from onnx_files import node, write_graph
from sam2_files import write_sam2
from sam_files import write_decoder, write_encoder, write_sam
from siglip_files import LENGTH, write_siglip

from jsecon.networks.clip import ClipEmbedder
from jsecon.networks.sam import SamSegmenter
from jsecon.networks.sam2 import Sam2Tracker

MODELS = {
    "clip": (ClipEmbedder, lambda folder: write_clip(folder, "immich")),
    "clip.js": (ClipEmbedder, lambda folder: write_clip(folder, "transformers.js")),
    "siglip": (ClipEmbedder, lambda folder: write_siglip(folder, "immich")),
    "siglip.js": (ClipEmbedder, lambda folder: write_siglip(folder, "transformers.js")),
    "sam": (SamSegmenter, write_sam),
    "sam2": (Sam2Tracker, write_sam2),
}
IMAGES, TEXTS, TOKENS = "visual/model.onnx", "textual/model.onnx", "textual/tokenizer.json"
ENCODER, DECODER = "onnx/vision_encoder.onnx", "onnx/prompt_encoder_mask_decoder.onnx"
RULES = {"context_length": LENGTH, "hf_tokenizer_name": "x"}
"""of open_clip's configuration"""


def casts(output):
    """Writes a graph of texts that only casts its tokens."""
    given, result = {"text": ("int64", [1, 77])}, {output: ("float32", [1, 77])}
    return lambda path: write_graph(path, [node("Cast", ["text"], [output], to=1)], given, result)


def not_finite(path):
    write_textual(path, ("text", "embedding"), np.nan * token_colours(), [1, 77], "int32")


def wider_memory(path):
    shutil.copy(write_sam2(path.parents[2] / "other", memory=6) / "onnx" / path.name, path)


def damage(path, change):
    """Removes a file (None), cuts it (a number), replaces it (bytes, a list, the name of another file), changes entries
    (a dictionary) or writes it anew (a function)."""
    if change is None:
        path.unlink()
    elif isinstance(change, int):
        path.write_bytes(path.read_bytes()[:change])
    elif isinstance(change, bytes):
        path.write_bytes(change)
    elif isinstance(change, str):
        shutil.copy(path.parents[change.count("/")] / change, path)
    elif callable(change):
        change(path)
    else:
        content = json.loads(path.read_text()) | change if isinstance(change, dict) else change
        path.write_text(json.dumps(content))


@pytest.mark.parametrize(("model", "name", "change", "words"), [
    ("clip", TEXTS, None, (f"lacks {TEXTS}", "huggingface.co")),
    ("clip.js", "preprocessor_config.json", None, "lacks preprocessor_config.json"),
    ("clip", IMAGES, TEXTS, "input 'image': no such input; the graph has text int32[1, 77]"),
    ("clip", TEXTS, b"", (TEXTS, "an empty file")), ("clip", TEXTS, 100, (TEXTS, "cannot open")),
    ("clip", TEXTS, b"PK\x03\x04 of torch", (TEXTS, "a zip archive")),
    ("clip", TEXTS, casts("pooler_output"), "output 'embedding': no such output; the graph has pooler_output"),
    ("clip", TEXTS, casts("embedding"), "texts of 77 numbers, expected 3"),
    ("clip", TEXTS, not_finite, "model.onnx: an embedding that is zero or not finite"),
    ("clip", "visual/preprocess_cfg.json", {"size": 48}, ("image float32[1, 3, 48, 48]", "Expected: 32")),
    ("clip", TOKENS, {"model": {"type": "BPE", "vocab": {"a": "b"}, "merges": []}}, "no tokenizer of this model"),
    ("clip", TOKENS, {"post_processor": None}, "a start and an end around a word"),
    ("siglip", "textual/tokenizer_config.json", None, "tokenizer_config.json: No such file"),
    ("siglip", "textual/tokenizer_config.json", {"pad_token": None}, ("pad_token None", "pads short texts")),
    ("siglip", "textual/tokenizer_config.json", {"pad_token": "<none>"}, "without '<none>'"),
    ("siglip", "config.json", [], "JSON of list"), ("siglip", "config.json", {"text_cfg": {}}, "no tokenizer of this"),
    ("siglip", "config.json", {"text_cfg": RULES | {"tokenizer_kwargs": {"clean": "upper"}}}, "cleaned by 'upper'"),
    ("siglip", "config.json", {"text_cfg": RULES | {"tokenizer_kwargs": {"strip": True}}}, "tokenizer_kwargs"),
    ("siglip.js", "config.json", {"text_config": {"max_position_embeddings": "x"}}, "texts of 'x' tokens"),
    ("siglip.js", "preprocessor_config.json", {"rescale_factor": 1}, "pixels times 1, not 1/255"),
    ("siglip.js", "tokenizer_config.json", {"tokenizer_class": "BertTokenizer"}, ("'BertTokenizer'", "Siglip")),
    ("sam", "preprocessor_config.json", {"image_mean": None}, ("preprocessor_config.json", "cannot be read")),
    ("sam", ENCODER, lambda path: write_encoder(path, 128, ("image_embeddings", "image_positional_embeddings")),
     ("vision_encoder.onnx, output 'image_embeddings'", "8, 8], expected ", "16, 16]")),
    ("sam", ENCODER, lambda path: write_encoder(path, 256), "output 'image_positional_embeddings': no such output"),
    ("sam", DECODER, lambda path: write_decoder(path, 256, "sam", "batch", masks=1), ("'pred_masks'", "3 or 4 masks")),
    ("sam2", "constants.json", None, "constants.json"), ("sam2", "constants.json", b"PK\x03\x04 cut", "a zip archive"),
    ("sam2", "constants.json", {"memory_temporal_positional_encoding": [[0.0] * 4] * 3}, "(3, 4)"),
    ("sam2", "constants.json", {"image_mean": ["a"] * 3}, "cannot be read"),
    ("sam2", "onnx/mask_decoder.onnx", "onnx/pointer_tpos.onnx", "feats2_cond"),
    ("sam2", "onnx/memory_encoder.onnx", wider_memory, "tokens"),
])  # fmt: skip
def test_a_damaged_folder_is_named(tmp_path, model, name, change, words):
    open_model, write = MODELS[model]
    folder = write(tmp_path / "model")
    damage(folder / name, change)
    with refused(*([words] if isinstance(words, str) else words)):
        opened = open_model(folder)
        opened.check()
        if isinstance(opened, SamSegmenter):
            opened(np.full((16, 16, 3), 99, np.uint8), 0)
