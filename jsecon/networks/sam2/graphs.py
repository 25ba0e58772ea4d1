"""SAM 2's networks as ONNX files in a folder, their signatures checked, and the constants that lie outside them.

One file a network, named `<role>*.onnx` (`memory_attention.onnx`, `memory_attention_hiera_t.onnx`), and `constants.npz`
with the learned arrays that the memory bank adds by hand. Names and layouts of the tensors are those of the
complete split of axinc-ai/segment-anything-2; experiments/export_models.py writes such a folder. SAM 2.1 is told from
SAM 2 by what only it has: `obj_ptr_tpos_proj.onnx` and the constant `no_obj_embed_spatial`.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jsecon.errors import InputError
from jsecon.files import READ_ERRORS
from jsecon.networks.onnx_graph import Graph, Tensor, content_digest, graph_files

STRIDE = 16
"""px of the network's image to one cell of its top features."""
MEAN = np.array([0.485, 0.456, 0.406], np.float32)
STD = np.array([0.229, 0.224, 0.225], np.float32)

Shape = tuple[int | str | None, ...]

# Letters stand for sizes that must agree across the files: S image, G grid (S/16), L mask logits (4 G), T tokens (G^2),
# C channels, M channels of a memory; None is free.
SIGNATURES: Mapping[str, tuple[Mapping[str, Shape], Mapping[str, Shape]]] = {
    "image_encoder": (
        {"input_image": (1, 3, "S", "S")},
        {
            "backbone_fpn_0": (1, None, "L", "L"),
            "backbone_fpn_1": (1, None, None, None),
            "backbone_fpn_2": (1, "C", "G", "G"),
            "vision_pos_enc_2": (1, "C", "G", "G"),
        },
    ),
    "prompt_encoder": (
        {"coords": (1, None, 2), "labels": (1, None), "masks": (1, "L", "L"), "masks_enable": (1,)},
        {"sparse_embeddings": (1, None, "C"), "dense_embeddings": (1, "C", "G", "G"), "dense_pe": (1, "C", "G", "G")},
    ),
    "mask_decoder": (
        {
            "image_embeddings": (1, "C", "G", "G"),
            "image_pe": (1, "C", "G", "G"),
            "sparse_prompt_embeddings": (1, None, "C"),
            "dense_prompt_embeddings": (1, "C", "G", "G"),
            "high_res_features1": (1, None, "L", "L"),
            "high_res_features2": (1, None, None, None),
        },
        {"masks": (1, 4, "L", "L"), "iou_pred": (1, 4), "sam_tokens_out": (1, 4, "C"), "object_score_logits": (1, 1)},
    ),
    "mlp": ({"x": (None, "C")}, {"x_out": (None, "C")}),
    "memory_attention": (
        {
            "curr": ("T", 1, "C"),
            "memory_1": (None, 1, "M"),
            "memory_2": (None, 1, "M"),
            "curr_pos": ("T", 1, "C"),
            "memory_pos_1": (None, 1, "M"),
            "memory_pos_2": (None, 1, "M"),
        },
        {"pix_feat": ("T", 1, "C")},
    ),
    "memory_encoder": (
        {"pix_feat": (1, "C", "G", "G"), "masks": (1, 1, "S", "S")},
        {"vision_features": (1, "M", "G", "G"), "vision_pos_enc": (1, "M", "G", "G")},
    ),
    "obj_ptr_tpos_proj": ({"x": (None, "C")}, {"x_out": (None, "M")}),
}
"""role -> inputs and outputs that are used; a file may have more outputs."""

CONSTANTS: Mapping[str, Shape] = {
    "no_mem_embed": (1, 1, "C"),
    "no_obj_ptr": (1, "C"),
    "maskmem_tpos_enc": (None, 1, 1, "M"),
    "mask_downsample_weight": (1, 1, 4, 4),
    "mask_downsample_bias": (1,),
}
"""name -> shape in constants.npz."""

_REMEDY = "Export the model again: python -m experiments.export_models."
ONLY_SAM2_1 = ("obj_ptr_tpos_proj", "no_obj_embed_spatial")


def _bad(where: object, found: str, expected: str, remedy: str = _REMEDY) -> InputError:
    return InputError(where, found, expected, remedy)


@dataclasses.dataclass(frozen=True)
class Sam2Graphs:
    """The networks of one SAM 2 model."""

    folder: Path
    graphs: Mapping[str, Graph]
    """by role."""
    constants: Mapping[str, np.ndarray]
    """float32, by name."""
    sizes: Mapping[str, int]
    """S, G, L, T, C, M as in SIGNATURES; N: memories of a full bank, the prompted one among them."""

    @property
    def version(self) -> str:
        """2.0 or 2.1."""
        return "2.1" if ONLY_SAM2_1[0] in self.graphs else "2.0"

    def run(self, role: str, feeds: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The outputs that SIGNATURES names of the network of that role."""
        outputs, graph = SIGNATURES[role][1], self.graphs[role]
        found = graph.run(feeds, list(outputs))
        for name, shape in outputs.items():
            if not Tensor(name, "", _with_sizes(shape, self.sizes)).fits(found[name].shape):
                raise _bad(f"{graph.path}, output {name!r}", f"shape {found[name].shape}", str(shape))
        return found


def open_sam2(folder: Path, *, threads: int | None = None) -> Sam2Graphs:
    """Opens the SAM 2 model in `folder`, at most `threads` cores for each run.

    Raises InputError where a file is missing, twice there, damaged, or has tensors of other names or sizes than the
    rest of the folder, naming the file and the tensor.
    """
    folder = Path(folder)
    files = sam2_files(folder)
    constants = _read_constants(folder / "constants.npz")
    present = [name for name in ONLY_SAM2_1 if name in files or name in constants]
    if len(present) == 1:
        missing = next(name for name in ONLY_SAM2_1 if name not in present)
        raise _bad(folder, f"{present[0]} without {missing}", "both (SAM 2.1) or neither (SAM 2)")
    graphs = {role: Graph(path, threads=threads) for role, path in files.items()}
    return Sam2Graphs(folder, graphs, constants, _agreed_sizes(folder, graphs, constants))


def sam2_files(folder: Path) -> dict[str, Path]:
    """role -> file, of the networks in `folder`. Raises InputError where one is missing or there are several."""
    folder, files = Path(folder), {}
    for role in SIGNATURES:
        found = sorted(folder.glob(f"{role}*.onnx"))
        if len(found) > 1 or (not found and role not in ONLY_SAM2_1):
            there, wanted = ", ".join(path.name for path in found), f"one file with SAM 2's {role.replace('_', ' ')}"
            remedy = "Keep one model a folder; python -m experiments.export_models writes one from a checkpoint."
            raise _bad(folder / f"{role}*.onnx", there or "no such file", wanted, remedy)
        if found:
            files[role] = found[0]
    return files


def sam2_digest(folder: Path, *, extra: str = "") -> str:
    """32 hex digits of the contents of the model's files, and of `extra`. Raises InputError where one is missing."""
    graphs = [part for path in sam2_files(folder).values() for part in graph_files(path)]
    return content_digest([*graphs, Path(folder) / "constants.npz"], extra=extra)


def _read_constants(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.errstate(over="ignore", invalid="ignore"), np.load(path, allow_pickle=False) as file:
            constants = {name: file[name].astype(np.float32) for name in file.files}
        if not all(np.isfinite(array).all() and array.size for array in constants.values()):
            raise ValueError("arrays without numbers, or numbers that are not finite")
    except (*READ_ERRORS, MemoryError) as error:
        found = "no such file" if isinstance(error, FileNotFoundError) else f"it cannot be read ({error})"
        raise _bad(path, found, f"the arrays {', '.join(CONSTANTS)}") from error
    return constants


def _agreed_sizes(folder: Path, graphs: Mapping[str, Graph], constants: Mapping[str, np.ndarray]) -> dict[str, int]:
    encoder = graphs["image_encoder"]
    size = encoder.require("input", "input_image", (1, 3, None, None), "SAM 2's image encoder").fixed(2) or 1024
    if size % STRIDE:
        raise _bad(encoder.path, f"an image of {size} px a side", f"a multiple of {STRIDE}")
    grid = size // STRIDE
    sizes = {"S": size, "G": grid, "L": 4 * grid, "T": grid * grid}
    shapes: dict[str, Shape] = dict(CONSTANTS)
    if ONLY_SAM2_1[0] in graphs:
        shapes[ONLY_SAM2_1[1]] = (1, "M")
    for name, letter in (("no_mem_embed", "C"), ("maskmem_tpos_enc", "M")):
        if name in constants and constants[name].ndim == len(shapes[name]):
            sizes[letter] = constants[name].shape[-1]
    for name, shape in shapes.items():
        wanted = _with_sizes(shape, sizes)
        found = constants[name].shape if name in constants else None
        if found is None or len(found) != len(wanted) or any(w not in (None, f) for w, f in zip(wanted, found)):
            there = "no such array" if found is None else f"shape {found}"
            raise _bad(f"{folder / 'constants.npz'}, {name!r}", there, f"shape {wanted} (None: any)")
    for role, graph in graphs.items():
        for side, tensors in zip(("input", "output"), SIGNATURES[role]):
            for name, shape in tensors.items():
                graph.require(side, name, _with_sizes(shape, sizes), f"SAM 2's {role.replace('_', ' ')}")
    return sizes | {"N": len(constants["maskmem_tpos_enc"])}


def _with_sizes(shape: Shape, sizes: Mapping[str, int]) -> tuple[int | None, ...]:
    return tuple(sizes.get(size) if isinstance(size, str) else size for size in shape)
