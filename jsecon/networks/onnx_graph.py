"""ONNX graphs: opened with bounded threads, their signatures read from the file, run by the names of their tensors.

What a file holds is never assumed. A room that needs a graph says which tensors it means to give and to take
(`Graph.require`); what does not fit ends in an InputError that names file and tensor.
"""

import dataclasses
import hashlib
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import onnxruntime

from jsecon.errors import InputError
from jsecon.networks.onnx_bytes import declared_inputs
from jsecon.process import cores

_DTYPES = {
    "tensor(float)": "float32",
    "tensor(float16)": "float16",
    "tensor(double)": "float64",
    "tensor(int64)": "int64",
    "tensor(int32)": "int32",
    "tensor(uint8)": "uint8",
    "tensor(int8)": "int8",
    "tensor(bool)": "bool",
}
_MISUSED = "This graph is of another size or kind than the one it is used as."
MOST_NUMBERS = 1 << 26
"""of an input: an image of 4096 x 4096 px has 2^25.6"""
_LFS = b"version https://git-lfs"
Size = int | str | None
"""of an axis: a number where it is fixed, the name of a symbol or None where it is free"""


@dataclasses.dataclass(frozen=True)
class Tensor:
    """One input or output of a graph, as its file declares it."""

    name: str
    dtype: str
    """NumPy's name of the type, or ONNX Runtime's own where NumPy has none."""
    shape: tuple[Size, ...] | None
    """None where the file does not say."""

    def __str__(self) -> str:
        if self.shape is None:
            return f"{self.name} {self.dtype}"
        return f"{self.name} {self.dtype}[{', '.join('?' if s is None else str(s) for s in self.shape)}]"

    def fixed(self, axis: int) -> int | None:
        """The size of an axis where the file fixes it, else None."""
        if self.shape is None or not -len(self.shape) <= axis < len(self.shape):
            return None
        size = self.shape[axis]
        return size if isinstance(size, int) and size > 0 else None

    def fits(self, shape: Sequence[Size]) -> bool:
        """Whether an array of `shape` could be this tensor; None or a symbol fits every size."""
        if self.shape is None:
            return True
        return len(self.shape) == len(shape) and all(
            not (isinstance(own, int) and own > 0 and isinstance(size, int)) or own == size
            for own, size in zip(self.shape, shape)
        )


class Graph:
    """An ONNX graph ready to run.

    `path` is its .onnx file; `threads` bounds the cores that one run takes (default: all that this process may use).
    `inputs` and `outputs` map names to Tensors in the file's order. `optimise=False` opens faster, for a look at the
    signature. Threads never spin: an idle graph costs no time, only its memory (drop it when its stage is done).

    Raises InputError where the file is missing, empty, cut short, a Git LFS pointer, lacks its external data, or uses
    what the installed ONNX Runtime does not know.
    """

    def __init__(self, path: str | os.PathLike, *, threads: int | None = None, optimise: bool = True):
        self.path = Path(path)
        _check_bytes(self.path)
        _check_inputs(self.path)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads or cores()
        options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 4
        onnxruntime.set_default_logger_severity(4)
        if not optimise:
            options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        try:
            given: dict[str, Any] = {"providers": ["CPUExecutionProvider"], "enable_fallback": 0}
            self._session = onnxruntime.InferenceSession(str(self.path), options, **given)
            self.inputs = {node.name: _tensor(node) for node in self._session.get_inputs()}
            self.outputs = {node.name: _tensor(node) for node in self._session.get_outputs()}
        except Exception as error:  # ONNX Runtime's own kinds have no common base but this
            found = f"ONNX Runtime {onnxruntime.__version__} cannot open it ({_reason(error)})"
            expected = "a whole ONNX graph, with its external data files beside it"
            raise InputError(self.path, found, expected, "Fetch or export the file again.") from error
        self._run_options = onnxruntime.RunOptions()
        self._run_options.log_severity_level = 4

    def require(self, side: Literal["input", "output"], name: str, shape: Sequence[Size], what: str) -> Tensor:
        """The input or output called `name`, which must have `shape` (None = any size). `what` says what the graph
        should be."""
        tensors = self.inputs if side == "input" else self.outputs
        if name not in tensors or not tensors[name].fits(shape):
            missing = f"no such {side}; the graph has {describe(tensors.values())}"
            found = str(tensors[name]) if name in tensors else missing
            expected = f"{Tensor(name, '', tuple(shape))}, as {what} has".replace(" [", "[")
            remedy = "Give the right file; `jsecon models check DIR` lists what each one is."
            raise InputError(f"{self.path}, {side} {name!r}", found, expected, remedy)
        return tensors[name]

    def run(self, feeds: Mapping[str, np.ndarray], outputs: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Outputs by name, all or those named, of inputs by name.

        Numbers are converted to the declared type where no kind is lost (float to float, integer to integer). Raises
        InputError naming the tensor where one is missing, unknown, of another shape or kind, or where the graph fails.
        """
        wanted = list(self.outputs) if outputs is None else list(outputs)
        unknown = [n for n in feeds if n not in self.inputs] + [n for n in wanted if n not in self.outputs]
        missing = [n for n in self.inputs if n not in feeds]
        if unknown or missing:
            found = f"inputs {describe(self.inputs.values())}; outputs {describe(self.outputs.values())}"
            expected = f"inputs {', '.join(feeds)}; outputs {', '.join(wanted)}"
            raise InputError(f"{self.path}, tensor {(unknown + missing)[0]!r}", found, expected, _MISUSED)
        ready = {name: self._converted(self.inputs[name], np.asarray(array)) for name, array in feeds.items()}
        try:
            found = self._session.run(wanted, ready, self._run_options)
        except Exception as error:  # ONNX Runtime's own kinds have no common base but this
            given = ", ".join(f"{name} {array.dtype}{list(array.shape)}" for name, array in ready.items())
            reason = f"a graph that fails on {given} ({_reason(error)})"
            expected = "one that runs on its declared inputs"
            raise InputError(self.path, reason, expected, "Export the graph again.") from error
        return dict(zip(wanted, (np.asarray(array) for array in found)))

    def _converted(self, tensor: Tensor, array: np.ndarray) -> np.ndarray:
        kinds = {"b": "bool", "i": "integer", "u": "integer", "f": "float"}
        wanted = np.dtype(tensor.dtype) if tensor.dtype in _DTYPES.values() else None
        same_kind = wanted is not None and kinds.get(array.dtype.kind) == kinds[wanted.kind]
        if not same_kind or not tensor.fits(array.shape):
            given = f"{array.dtype}{list(array.shape)}"
            raise InputError(f"{self.path}, input {tensor.name!r}", str(tensor), given, _MISUSED)
        return np.asarray(array, wanted, order="C")  # np.ascontiguousarray makes a row of a scalar


def describe(tensors: Iterable[Tensor]) -> str:
    """Tensors in a line: name, type and shape."""
    return ", ".join(map(str, tensors)) or "nothing"


def batches(rows: np.ndarray, fixed: int | None, free: int) -> Iterator[tuple[np.ndarray, int]]:
    """Rows in batches of the size that a graph fixes (the last filled up with zeros), or of at most `free`; and how
    many of each are real."""
    size = fixed or free
    for start in range(0, len(rows), size):
        part = rows[start : start + size]
        count = len(part)
        if fixed and count < fixed:
            part = np.concatenate([part, np.zeros((fixed - count, *rows.shape[1:]), rows.dtype)])
        yield part, count


def graph_files(path: str | os.PathLike) -> tuple[Path, ...]:
    """The .onnx file and the external data files that it names and that lie beneath its folder.

    Raises InputError where the .onnx file cannot be read.
    """
    path = Path(path)
    _check_bytes(path)
    content = path.read_bytes()
    beside = (file for file in sorted(path.parent.rglob("*")) if file.is_file() and file.suffix != ".onnx")
    return path, *(file for file in beside if os.fsencode(file.relative_to(path.parent).as_posix()) in content)


def content_digest(files: Iterable[str | os.PathLike], *, extra: str = "") -> str:
    """32 hex digits of the files' contents in the order given, and of `extra`; names, places and times do not count.

    Raises InputError where one cannot be read.
    """
    whole = hashlib.blake2b(extra.encode(), digest_size=16)
    for file in files:
        try:
            with open(file, "rb") as stream:
                whole.update(hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=16)).digest())
        except OSError as error:
            raise _unreadable(Path(file), error.strerror or "an error on reading") from error
    return whole.hexdigest()


def _check_bytes(path: Path) -> None:
    try:
        with open(path, "rb") as stream:
            head = stream.read(64)
    except OSError as error:
        raise _unreadable(path, error.strerror or "an error on reading") from error
    if not head:
        raise _unreadable(path, "an empty file")
    if head.startswith(_LFS):
        raise _unreadable(path, "a Git LFS pointer in place of the file", "Fetch the content: git lfs pull.")


def _check_inputs(path: Path) -> None:
    for name, sizes in declared_inputs(path).items():
        if math.prod(sizes) > MOST_NUMBERS:
            found = f"an input {name!r} of {' x '.join(map(str, sizes))} numbers"
            raise InputError(path, found, f"at most {MOST_NUMBERS}", "Fetch or export the file again.")


def _unreadable(path: Path, found: str, remedy: str = "Check the path, or fetch the file again.") -> InputError:
    return InputError(path, found, "a file of a model", remedy)


def _reason(error: Exception) -> str:
    """ONNX Runtime's message on one line, without its own preamble."""
    text = " ".join(str(error).split())
    return text.split(" : ", 3)[-1][:400] if text.startswith("[ONNXRuntimeError]") else text[:400]


def _tensor(node: onnxruntime.NodeArg) -> Tensor:
    shape = tuple(node.shape)  # ONNX Runtime shows a scalar and an undeclared shape alike, as no axes
    return Tensor(node.name, _DTYPES.get(str(node.type), str(node.type)), shape or None)
