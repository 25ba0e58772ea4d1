"""What a folder of models holds: every graph's signature, and what jsecon can use it for."""

import dataclasses
from collections.abc import Callable, Iterable
from pathlib import Path

from jsecon.errors import InputError
from jsecon.networks.clip import LOGITS_REMEDY, ClipEmbedder
from jsecon.networks.sam import SamGraphs, find_sam
from jsecon.networks.sam2 import open_sam2
from jsecon.networks.sam3 import Sam3
from jsecon.networks.session import Graph, describe


@dataclasses.dataclass(frozen=True)
class Use:
    """One thing that a folder could be used for."""

    model: str
    """CLIP, SAM, SAM 2, SAM 3."""
    usable: bool
    told: str
    """how to use it, or what was found instead of what."""


@dataclasses.dataclass(frozen=True)
class ModelReport:
    """What lies in a folder."""

    folder: Path
    graphs: dict[str, str]
    """path of each .onnx file within the folder -> its inputs and outputs, or why it cannot be opened."""
    uses: tuple[Use, ...]


def inspect_models(folder: str | Path) -> ModelReport:
    """Opens every graph of a folder, and puts each kind of model in it to the test.

    Raises InputError where there is no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "a folder of models", "Check the path.")
    graphs = {path.relative_to(folder).as_posix(): _signature(path) for path in sorted(folder.rglob("*.onnx"))}
    return ModelReport(folder, graphs, tuple(_tried(model, use, folder) for model, use in _KINDS.items()))


def report_lines(findings: ModelReport) -> Iterable[str]:
    """The findings as lines of text."""
    yield f"{findings.folder}: {len(findings.graphs)} graphs"
    for path, signature in findings.graphs.items():
        yield f"  {path}"
        yield from (f"    {line}" for line in signature.splitlines())
    for use in findings.uses:
        yield f"{use.model}: {'usable' if use.usable else 'not usable'}"
        yield f"  {use.told}"


def unusable(findings: ModelReport) -> list[InputError]:
    """That the folder can be used for nothing, where that is so."""
    if any(use.usable for use in findings.uses):
        return []
    expected = f"{' or '.join(use.model for use in findings.uses)} as ONNX graphs"
    remedy = "See above for what is missing and where such exports are published."
    return [InputError(findings.folder, "nothing that can be used", expected, remedy)]


def _signature(path: Path) -> str:
    try:
        graph = Graph(path, threads=1, optimise=False)
    except InputError as error:
        return f"cannot be opened: {error.sentence}"
    return f"in   {describe(graph.inputs.values())}\nout  {describe(graph.outputs.values())}"


def _tried(model: str, use: Callable[[Path], str], folder: Path) -> Use:
    try:
        return Use(model, True, use(folder))
    except InputError as error:
        return Use(model, False, str(error))


def _clip(folder: Path) -> str:
    embedder = ClipEmbedder(folder)
    embedder.check()
    size, files = embedder.size, embedder.files
    told = f"images of {size}x{size} px and texts to {embedder.dim} numbers; layout {files.layout}"
    embedder.close()
    told = f"{told}, tokenizer {files.tokenizer.relative_to(folder)}: jsecon run --embedder {folder}"
    if files.rules is None:
        return told
    length, pad, clean = files.rules
    return f"{told}\n  texts of {length} ids, filled by {pad!r}, cleaned by {clean!r}; {_sigmoid(embedder)}"


def _sigmoid(embedder: ClipEmbedder) -> str:
    """What tells how likely a text is there: the scale and bias, or what takes their place."""
    found, where = embedder.logits, embedder.files.logits
    if found is None or where is None:
        return f"no scale and bias, so that a text is refused by its contrast. {LOGITS_REMEDY}"
    return f"how likely a text is there: sigmoid({found.scale:.4f} cosine {found.bias:+.4f}), from {where.name}"


def _sam(folder: Path) -> str:
    graphs = SamGraphs(find_sam(folder))
    many = "one prompt per run" if graphs.batch == 1 else f"{graphs.batch} prompts per run"
    kind = "SAM 2" if graphs.stretched else "SAM"
    made = f"masks of every frame; decoder of {kind}, {many}, images of {graphs.side} px"
    return f"{made}: jsecon run --segmenter {folder}"


def _sam2(folder: Path) -> str:
    side = open_sam2(folder).sizes["S"]
    return f"objects followed through the frames, images of {side} px: jsecon run --tracker {folder}"


def _sam3(folder: Path) -> str:
    sam3 = Sam3(folder)
    summary = sam3.summary
    sam3.check()
    return f"{summary}: jsecon query FIELD TEXT --phrases {folder}"


_KINDS: dict[str, Callable[[Path], str]] = {"CLIP": _clip, "SAM": _sam, "SAM 2": _sam2, "SAM 3": _sam3}
