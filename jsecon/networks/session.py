"""Runs ONNX graphs with ONNX Runtime on the CPU.

A run takes the cores that this process may use, signatures are read from the file, and tensors are passed by name.
Code that needs a graph states which tensors it passes and reads (`Graph.require`). A graph with other tensors raises an
InputError that names the file and the tensor.
"""

import dataclasses
import hashlib
import math
import mmap
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import onnxruntime

from jsecon.errors import InputError
from jsecon.files import describe_substitute
from jsecon.process import cores

_DTYPES = {"tensor(float)": "float32", "tensor(double)": "float64"} | {
    f"tensor({name})": name for name in ("float16", "int64", "int32", "uint8", "int8", "bool")
}
_MAX_INPUT_NUMBERS = 1 << 26
"""size of an input; an image of 4096 x 4096 px has 2^25.6 numbers"""
_HALF_CONSTANT = re.compile(rb"\x08.{1,3}\x10\x0a\x42.[ -~]{2}", re.DOTALL)
"""bytes of a constant of half precision in a file of onnx.proto: its last size, its data type FLOAT16 and its name"""
Shape = Sequence[int | str | None]
"""sizes of the axes: a number if it is fixed, the name of a symbol or None if it is free"""


@dataclasses.dataclass(frozen=True)
class Tensor:
    """An input or output of a graph, as its file declares it."""

    name: str
    dtype: str
    """NumPy's name of the type, or ONNX Runtime's if NumPy has no such type."""
    shape: tuple[int | str | None, ...] | None
    """Sizes of the axes; None if the file does not declare them."""

    def __str__(self) -> str:
        """Returns the name and shape for messages."""
        if self.shape is None:
            return f"{self.name} {self.dtype}".rstrip()
        return f"{self.name} {self.dtype}[{', '.join('?' if size is None else str(size) for size in self.shape)}]"

    def fixed(self, axis: int) -> int | None:
        """Returns the size of an axis if the file fixes it, else None."""
        if self.shape is None or not -len(self.shape) <= axis < len(self.shape):
            return None
        size = self.shape[axis]
        return size if isinstance(size, int) and size > 0 else None

    def _fits(self, shape: Shape | None) -> bool:
        """Whether an array of a shape could be the tensor; None and symbols fit every size."""
        if self.shape is None or shape is None:
            return True
        return len(self.shape) == len(shape) and all(
            not (isinstance(mine, int) and mine > 0 and isinstance(size, int)) or mine == size
            for mine, size in zip(self.shape, shape)
        )


class Graph:
    """An ONNX graph, ready to run. Threads never spin: an idle graph costs no time, only memory.

    InputError is raised if the file is missing, empty, cut short or a Git LFS pointer, lacks its external data, or uses
    what the installed ONNX Runtime does not know.

    Args:
      path: The .onnx file.
      threads: Threads of a run; None takes all cores.

    Attributes:
      inputs: Input tensors by name, in the order of the file.
      outputs: Output tensors by name, in the order of the file.
    """

    def __init__(self, path: str | os.PathLike, threads: int | None = None):
        self.path, self._threads = Path(path), threads or cores()
        _check_bytes(self.path)
        session = self._open(optimise=False)
        self.inputs = {tensor.name: tensor for tensor in map(_tensor, session.get_inputs())}
        self.outputs = {tensor.name: tensor for tensor in map(_tensor, session.get_outputs())}
        for tensor in self.inputs.values():  # before the optimiser allocates constants of such sizes
            sizes = [size for size in tensor.shape or () if isinstance(size, int) and size > 0]
            if math.prod(sizes) > _MAX_INPUT_NUMBERS:
                problem = f"an input {tensor.name!r} of {' x '.join(map(str, sizes))} numbers"
                raise InputError(self.path, problem, f"at most {_MAX_INPUT_NUMBERS}", "Fetch or export the file again.")
        self._session = self._open(optimise=True)
        self._run_options = onnxruntime.RunOptions()
        self._run_options.log_severity_level = 4

    def _open(self, *, optimise: bool) -> onnxruntime.InferenceSession:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = self._threads
        options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 4
        onnxruntime.set_default_logger_severity(4)
        if not optimise:
            options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        try:
            return onnxruntime.InferenceSession(
                str(self.path),
                options,
                providers=["CPUExecutionProvider"],
                enable_fallback=0,
                # It crashes the process on graphs of CLIP, SigLIP 2 and MobileCLIP in half precision (version 1.32).
                disabled_optimizers=["NchwcTransformer"] if optimise and _has_half_precision(self.path) else None,
            )
        except Exception as error:  # ONNX Runtime's exceptions have no common base but this
            problem = f"ONNX Runtime {onnxruntime.__version__} cannot open it ({_reason(error)})"
            expected = "a whole ONNX graph, with its external data files beside it"
            raise InputError(self.path, problem, expected, "Fetch or export the file again.") from error

    def require(self, side: Literal["input", "output"], name: str, shape: Shape | None, what: str) -> Tensor:
        """Returns a tensor of the graph, or raises InputError if it is missing or has another shape.

        Args:
          side: Whether it is an input or an output.
          name: Its name.
          shape: Its shape; None fits any size, and in place of the sizes any shape.
          what: What the graph should be, for the message.
        """
        tensors = self.inputs if side == "input" else self.outputs
        if name not in tensors or not tensors[name]._fits(shape):
            missing = f"no such {side}; the graph has {', '.join(map(str, tensors.values())) or 'no tensor'}"
            problem = str(tensors[name]) if name in tensors else missing
            expected = f"{Tensor(name, '', None if shape is None else tuple(shape))}, as {what} has".replace(" [", "[")
            remedy = "Give the right file."
            raise InputError(f"{self.path}, {side} {name!r}", problem, expected, remedy)
        return tensors[name]

    def run(self, feeds: Mapping[str, np.ndarray], outputs: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Computes the outputs of some names, by default all, or raises InputError if the graph fails.

        Numbers are converted to the declared type if their kind stays the same (float to float, integer to integer).
        """
        names = list(self.outputs) if outputs is None else list(outputs)
        ready = {name: self._converted(name, np.asarray(array)) for name, array in feeds.items()}
        try:
            arrays = self._session.run(names, ready, self._run_options)
        except Exception as error:  # ONNX Runtime's exceptions have no common base but this
            shapes = ", ".join(f"{name} {array.dtype}{list(array.shape)}" for name, array in ready.items())
            problem = f"a graph that fails on {shapes} ({_reason(error)})"
            expected = "one that runs on its declared inputs"
            raise InputError(self.path, problem, expected, "Export the graph again.") from error
        return dict(zip(names, (np.asarray(array) for array in arrays)))

    def _converted(self, name: str, array: np.ndarray) -> np.ndarray:
        tensor = self.inputs.get(name)
        dtype = array.dtype if tensor is None or tensor.dtype not in _DTYPES.values() else np.dtype(tensor.dtype)
        is_same_kind = dtype.kind.replace("u", "i") == array.dtype.kind.replace("u", "i")
        # np.ascontiguousarray makes a row of a scalar
        return np.asarray(array, dtype if is_same_kind else None, order="C")


def _graph_files(path: Path) -> tuple[Path, ...]:
    """Lists the .onnx file of a graph and the external data files that it names beneath its folder."""
    _check_bytes(path)
    content = path.read_bytes()
    beside = (file for file in sorted(path.parent.rglob("*")) if file.is_file() and file.suffix != ".onnx")
    return path, *(file for file in beside if os.fsencode(file.relative_to(path.parent).as_posix()) in content)


def content_digest(graphs: Sequence[Path], files: Sequence[Path] = (), *, extra: str = "") -> str:
    """Hashes the contents of graphs with their external data, of other files and of a text to 32 hex digits.

    Names and times do not count.
    """
    digest = hashlib.blake2b(extra.encode(), digest_size=16)
    for file in (*(part for graph in graphs for part in _graph_files(graph)), *files):
        try:
            with open(file, "rb") as stream:
                digest.update(hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=16)).digest())
        except OSError as error:
            raise _unreadable(file, error.strerror or "an error on reading") from error
    return digest.hexdigest()


def _has_half_precision(path: Path) -> bool:
    """Returns whether a constant of a whole graph is of half precision."""
    with open(path, "rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        return _HALF_CONSTANT.search(data) is not None


def _check_bytes(path: Path) -> None:
    """Checks that a file exists, is not empty, and that nothing else stands in its place."""
    try:
        with open(path, "rb") as stream:
            is_empty = not stream.read(1)
    except OSError as error:
        raise _unreadable(path, error.strerror or "an error on reading") from error
    if is_empty:
        raise _unreadable(path, "an empty file")
    if (substitute := describe_substitute(path)) is not None:
        raise _unreadable(path, *substitute)


def _unreadable(path: Path, problem: str, remedy: str = "Check the path, or fetch the file again.") -> InputError:
    return InputError(path, problem, "a file of a model", remedy)


def _reason(error: Exception) -> str:
    """Returns ONNX Runtime's message on one line, without its preamble."""
    text = " ".join(str(error).split())
    return text.split(" : ", 3)[-1][:400] if text.startswith("[ONNXRuntimeError]") else text[:400]


def _tensor(node: onnxruntime.NodeArg) -> Tensor:
    shape = tuple(node.shape)  # ONNX Runtime shows a scalar and an undeclared shape alike, as no axes
    return Tensor(node.name, _DTYPES.get(str(node.type), str(node.type)), shape or None)
