"""Inspects a folder of models: the signature of every graph, and what jsecon can use the folder for."""

import dataclasses
from pathlib import Path

from jsecon.errors import InputError
from jsecon.networks.clip import LOGITS_REMEDY, ClipEmbedder
from jsecon.networks.sam import SamGraphs, find_sam
from jsecon.networks.sam2 import open_sam2
from jsecon.networks.session import Graph, describe


@dataclasses.dataclass(frozen=True)
class Use:
    """A kind of model that a folder may hold."""

    model: str
    """CLIP, SAM or SAM 2."""
    usable: bool
    """Whether the folder holds one."""
    summary: str
    """How to use it, or what is wrong with the folder."""


@dataclasses.dataclass(frozen=True)
class ModelReport:
    """Content of a folder."""

    folder: Path
    graphs: dict[str, str]
    """Inputs and outputs of each .onnx file by its path within the folder, or why it cannot be opened."""
    uses: tuple[Use, ...]
    """What the folder can be used for."""

    @property
    def lines(self) -> list[str]:
        """The content as lines of text."""
        lines = [f"{self.folder}: {len(self.graphs)} graphs"]
        for path, signature in self.graphs.items():
            lines += [f"  {path}", *(f"    {line}" for line in signature.splitlines())]
        for use in self.uses:
            lines += [f"{use.model}: {'usable' if use.usable else 'not usable'}", f"  {use.summary}"]
        return lines

    @property
    def errors(self) -> list[InputError]:
        """One error if no model of the folder can be used, else an empty list."""
        if any(use.usable for use in self.uses):
            return []
        expected = f"{' or '.join(use.model for use in self.uses)} as ONNX graphs"
        remedy = "See above for what is missing and where such exports are published."
        return [InputError(self.folder, "no model that can be used", expected, remedy)]


def inspect_models(folder: str | Path) -> ModelReport:
    """Opens every graph of a folder, and tries the folder as each kind of model.

    Args:
      folder: The folder; graphs in its subfolders count too.

    Returns:
      What it holds, and what each kind of model lacks.

    Raises:
      InputError: There is no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "a folder of models", "Check the path.")
    graphs = {path.relative_to(folder).as_posix(): _signature(path) for path in sorted(folder.rglob("*.onnx"))}
    uses = []
    for model, examine in (("CLIP", _clip), ("SAM", _sam), ("SAM 2", _sam2)):
        try:
            uses.append(Use(model, True, examine(folder)))
        except InputError as error:
            uses.append(Use(model, False, str(error)))
    return ModelReport(folder, graphs, tuple(uses))


def _signature(path: Path) -> str:
    try:
        graph = Graph(path, optimise=False)
    except InputError as error:
        return f"cannot be opened: {error.sentence}"
    return f"in   {describe(graph.inputs.values())}\nout  {describe(graph.outputs.values())}"


def _clip(folder: Path) -> str:
    embedder = ClipEmbedder(folder)
    embedder.check()
    size, files = embedder.size, embedder.files
    summary = f"images of {size}x{size} px and texts to {embedder.dim} numbers: jsecon run --embedder {folder}"
    embedder.close()
    if files.rules is None:
        return summary
    length, pad, clean = files.rules
    summary = f"{summary}\n  texts of {length} tokens, padded with {pad!r}, cleaned by {clean!r}"
    if embedder.logits is None:
        return f"{summary}; no scale and bias, so that a text is refused by its cosine. {LOGITS_REMEDY}"
    scale, bias = embedder.logits
    return f"{summary}; how likely a text is there: sigmoid({scale:.4f} cosine {bias:+.4f})"


def _sam(folder: Path) -> str:
    graphs = SamGraphs(find_sam(folder))
    many = "one prompt per run" if graphs.batch == 1 else f"{graphs.batch} prompts per run"
    kind = "SAM 2" if graphs.stretched else "SAM"
    made = f"masks of every frame; decoder of {kind}, {many}, images of {graphs.side} px"
    return f"{made}: jsecon run --segmenter {folder}"


def _sam2(folder: Path) -> str:
    side = open_sam2(folder).sizes["S"]
    return f"objects followed through the frames, images of {side} px: jsecon run --tracker {folder}"
