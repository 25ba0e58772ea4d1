"""CLIP as two ONNX graphs with its vocabulary, in the folder layout `immich` that jsecon.networks.clip reads
(immich-app/ml-models, exporters/onnx/models/openclip.py); batches of any size."""

import dataclasses
import json
from pathlib import Path

import torch

from experiments.export.embedder import TEXTS, compared
from experiments.export.graph import Agreement, Wrapped, declare_missing_operators, shake, write_graph
from jsecon.files import write_text


def official(name: str, weights: str | None, *, seed: int) -> torch.nn.Module:
    """open_clip's model of that name; `weights` is one of its tags or a file, None random numbers."""
    declare_missing_operators()
    import open_clip

    torch.manual_seed(seed)
    torch.backends.mha.set_fastpath_enabled(False)  # one fused operator that ONNX does not have
    model = open_clip.create_model(name, pretrained=weights, precision="fp32", device="cpu")
    if weights is None:
        shake(model, seed)
    return model.eval().requires_grad_(False)


def export(model: torch.nn.Module, name: str, folder: Path, *, seed: int) -> list[Agreement]:
    """Writes both graphs, the preprocessing and the vocabulary into `folder`; each graph is compared on five inputs."""
    import open_clip

    generator = torch.Generator().manual_seed(seed)
    size, length = model.visual.image_size[0], model.context_length
    images = torch.randn(5, 3, size, size, generator=generator)
    tokenizer = open_clip.get_tokenizer(name)
    texts = ["a photo of a red mug", "sofa", "thé à la menthe", "", "the small green plant on the window sill " * 5]
    ids = tokenizer(texts, context_length=length).to(torch.int32)
    rows = [
        write_half(folder / "visual" / "model.onnx", Image(model), "image", images, "embedding"),
        write_half(folder / "textual" / "model.onnx", Text(model), "text", ids, "embedding"),
    ]
    preprocessing = {"size": [size, size], "mode": "RGB", "interpolation": "bicubic", "resize_mode": "shortest"}
    preprocessing |= {"mean": list(model.visual.image_mean), "std": list(model.visual.image_std)}
    write_text(folder / "visual" / "preprocess_cfg.json", json.dumps(preprocessing, indent=2) + "\n")
    merges = [list(pair) for pair, _ in sorted(tokenizer.bpe_ranks.items(), key=lambda item: item[1])]
    pairs = {"type": "BPE", "end_of_word_suffix": "</w>", "vocab": tokenizer.encoder, "merges": merges}
    vocabulary = {"model": pairs}
    write_text(folder / "textual" / "tokenizer.json", json.dumps(vocabulary, ensure_ascii=False) + "\n")
    return rows


def export_mobile(model: torch.nn.Module, name: str, folder: Path, *, seed: int) -> dict:
    """MobileCLIP: `export`, with the means and deviations of its published weights and its config.json, as immich's
    exporter writes it; tokens and embeddings are compared with open_clip's too."""
    import open_clip

    usual = open_clip.get_pretrained_cfg(name, open_clip.list_pretrained_tags_by_model(name)[0])
    model.visual.image_mean, model.visual.image_std = usual["mean"], usual["std"]
    rows = export(model, name, folder, seed=seed)
    write_text(folder / "config.json", json.dumps(open_clip.get_model_config(name), indent=2) + "\n")
    ids = open_clip.get_tokenizer(name)(TEXTS, context_length=model.context_length)

    def encode(pixels):
        return model.encode_image(pixels, normalize=True)

    numbers = {"mean": list(usual["mean"]), "std": list(usual["std"]), "size": list(model.visual.image_size)}
    return compared(rows, folder, encode, model.encode_text(ids, normalize=True), ids, numbers)


def write_half(
    path: Path, module: torch.nn.Module, name: str, given: torch.Tensor, outputs: str | tuple[str, ...]
) -> Agreement:
    """Writes the graph of one encoder for batches of any size; it is compared on all of `given`, the input `name`."""
    names = [outputs] if isinstance(outputs, str) else list(outputs)
    free = {name: {0: "batch"}} | {output: {0: "batch"} for output in names}
    row = write_graph(path, module, {name: given[:2]}, names, free=free, other={name: given})
    return dataclasses.replace(row, graph=f"{path.parent.name}/{path.name}")


class Image(Wrapped):
    """Images to unit embeddings."""

    def forward(self, image):
        return self.model.encode_image(image, normalize=True)


class Text(Wrapped):
    """Token ids to unit embeddings."""

    def forward(self, text):
        return self.model.encode_text(text.long(), normalize=True)
