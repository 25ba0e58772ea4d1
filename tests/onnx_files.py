"""Writes small ONNX graphs for tests, by the onnx package (a dev extra)."""

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

KINDS = {
    "float32": TensorProto.FLOAT, "float16": TensorProto.FLOAT16, "int64": TensorProto.INT64,
    "int32": TensorProto.INT32, "uint8": TensorProto.UINT8, "bool": TensorProto.BOOL,
}  # fmt: skip


def node(op: str, inputs: list[str], outputs: list[str], **attributes) -> onnx.NodeProto:
    """One operation of the default domain."""
    return helper.make_node(op, inputs, outputs, **attributes)


class Sketch:
    """A graph in the making: a call adds an operation and returns the name of its result. What is no name among its
    inputs becomes a constant."""

    def __init__(self):
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[str, np.ndarray] = {}

    def constant(self, value) -> str:
        array, name = np.asarray(value), f"c{len(self.constants)}"
        self.constants[name] = array.astype(np.float32) if array.dtype == np.float64 else array
        return name

    def __call__(self, op: str, *inputs, into: str | None = None, **attributes) -> str:
        names = [given if isinstance(given, str) else self.constant(given) for given in inputs]
        name = into or f"x{len(self.nodes)}"
        self.nodes.append(node(op, names, [name], **attributes))
        return name

    def save(self, path: Path, inputs: dict, outputs: dict) -> Path:
        return write_graph(path, self.nodes, inputs, outputs, self.constants)


Side = dict[str, tuple[str, list]]


def write_graph(path: Path, nodes: list, inputs: Side, outputs: Side, constants=None, *, external=None) -> Path:
    """Writes a graph of opset 17. Inputs and outputs: name -> (dtype, shape), a text for a free axis. `external` is the
    name of the file beside it that takes the constants."""
    values = [
        [helper.make_tensor_value_info(name, KINDS[kind], shape) for name, (kind, shape) in side.items()]
        for side in (inputs, outputs)
    ]
    stored = [numpy_helper.from_array(np.asarray(array), name) for name, array in (constants or {}).items()]
    graph = helper.make_graph(nodes, path.stem, *values, stored)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    path.parent.mkdir(parents=True, exist_ok=True)
    if external is None:
        onnx.save(model, path)
    else:
        onnx.save(model, path, save_as_external_data=True, location=external, size_threshold=0)
    return path
