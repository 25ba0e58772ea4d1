"""SigLIP and SigLIP 2 as folders of both layouts: of open_clip in immich's (immich-app/ml-models,
immich_model_exporter), of transformers in that of transformers.js; each with a small vocabulary of its kind."""

import json
from pathlib import Path
from typing import Any

import torch

from experiments.export.clip import Image, Text, write_half
from experiments.export.embedder import FRAMES, TEXTS, compared
from experiments.export.graph import Wrapped, declare_missing_operators, shake
from experiments.export.vocabulary import write_vocabulary
from jsecon.files import write_text


def export_open_clip(model: torch.nn.Module, name: str, folder: Path, *, seed: int) -> dict:
    """Writes the folder of an open_clip model and compares graphs, tokens and embeddings with open_clip."""
    import open_clip

    settings = open_clip.get_model_config(name)
    rules, size = settings["text_cfg"], settings["vision_cfg"]["image_size"]
    generator = torch.Generator().manual_seed(seed)
    images, kind = torch.randn(3, 3, size, size, generator=generator), "gemma" if "SigLIP2" in name else "t5"
    write_vocabulary(folder / "textual", kind, _corpus(), tokenizer_class="PreTrainedTokenizerFast")
    length, clean = rules["context_length"], rules["tokenizer_kwargs"]["clean"]
    tokenizer = open_clip.tokenizer.HFTokenizer(str(folder / "textual"), context_length=length, clean=clean)
    ids = tokenizer(TEXTS).to(torch.int32)
    rows = [
        write_half(folder / "visual" / "model.onnx", Image(model), "image", images, "image_embedding"),
        write_half(folder / "textual" / "model.onnx", Text(model), "text", ids, "text_embedding"),
    ]
    usual = open_clip.get_pretrained_cfg(name, "webli")
    preprocessing = {"size": [size, size], "mode": "RGB", "mean": list(usual["mean"]), "std": list(usual["std"])}
    preprocessing |= {key: usual[key] for key in ("interpolation", "resize_mode")}
    write_text(folder / "visual" / "preprocess_cfg.json", json.dumps(preprocessing, indent=2) + "\n")
    write_text(folder / "config.json", json.dumps(settings, indent=2) + "\n")

    def encode(pixels):
        return model.encode_image(pixels, normalize=True)

    wanted = model.encode_text(ids.long(), normalize=True)
    return compared(rows, folder, encode, wanted, ids, preprocessing)


def official_transformers(seed: int) -> torch.nn.Module:
    """transformers' SiglipModel at its defaults, which are google/siglip-base-patch16-224, with random weights."""
    declare_missing_operators()
    import transformers

    torch.manual_seed(seed)
    model = transformers.SiglipModel(transformers.SiglipConfig())
    shake(model, seed)
    return model.eval().requires_grad_(False)


def export_transformers(model: Any, folder: Path, *, seed: int) -> dict:
    """Writes the folder of a transformers model, and compares graphs, tokens and embeddings."""
    import transformers

    size, length = model.config.vision_config.image_size, model.config.text_config.max_position_embeddings
    write_vocabulary(folder, "t5", _corpus(), tokenizer_class="SiglipTokenizer")
    read = transformers.PreTrainedTokenizerFast(tokenizer_file=str(folder / "tokenizer.json"), pad_token="</s>")
    from open_clip.tokenizer import get_clean_fn  # the class itself needs SentencePiece's own file

    cleaned = [get_clean_fn("canonicalize")(text) for text in TEXTS]
    ids = read(cleaned, padding="max_length", truncation=True, max_length=length, return_tensors="pt").input_ids
    images = torch.randn(3, 3, size, size, generator=torch.Generator().manual_seed(seed))
    onnx, outputs = folder / "onnx", ("last_hidden_state", "pooler_output")
    rows = [
        write_half(onnx / "vision_model.onnx", Pooled(model.vision_model), "pixel_values", images, outputs),
        write_half(onnx / "text_model.onnx", Pooled(model.text_model), "input_ids", ids, outputs),
    ]
    preprocessing: dict[str, Any] = {"do_normalize": True, "do_rescale": True, "rescale_factor": 1 / 255}
    half = [0.5, 0.5, 0.5]
    preprocessing |= {"image_mean": half, "image_std": half, "size": {"height": size, "width": size}}
    write_text(folder / "preprocessor_config.json", json.dumps(preprocessing, indent=2) + "\n")
    write_text(folder / "config.json", json.dumps(model.config.to_diff_dict(), indent=2) + "\n")
    wanted = torch.nn.functional.normalize(model.text_model(input_ids=ids).pooler_output, dim=-1)

    def encode(pixels):
        return torch.nn.functional.normalize(model.vision_model(pixel_values=pixels).pooler_output, dim=-1)

    numbers = {"mean": half, "std": half, "size": [size, size]}
    return compared(rows, folder, encode, wanted, ids, numbers)


class Pooled(Wrapped):
    """One of transformers' SigLIP encoders: hidden states and what its pooler makes of them."""

    def forward(self, given):
        found = self.model(given)
        return found.last_hidden_state, found.pooler_output


def _corpus() -> list[str]:
    """What the vocabulary is learned from: texts with the words that the comparison asks for, and some about it."""
    here = Path(__file__).resolve().parents[2] / "README.md"
    return [*TEXTS, *FRAMES, *here.read_text(encoding="utf-8").splitlines()]
