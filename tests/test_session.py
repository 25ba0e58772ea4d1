"""ONNX graphs: signatures as the file has them, and a message that names file or tensor for whatever does not fit."""

import numpy as np
import onnx
import onnxruntime
import pytest
from capture_files import refused
from onnx_files import node, write_graph

from jsecon.networks.session import Graph, Tensor, content_digest


@pytest.fixture
def affine(tmp_path):
    """y = x @ w + b and z = y + y, of x (batch, 3)."""
    nodes = [node("MatMul", ["x", "w"], ["xw"]), node("Add", ["xw", "b"], ["y"]), node("Add", ["y", "y"], ["z"])]
    constants = {"w": np.arange(6, dtype=np.float32).reshape(3, 2), "b": np.ones(2, np.float32)}
    outputs = {"y": ("float32", ["batch", 2]), "z": ("float32", ["batch", 2])}
    return write_graph(tmp_path / "affine.onnx", nodes, {"x": ("float32", ["batch", 3])}, outputs, constants)


def test_it_has_the_files_signature_and_runs_by_name_and_converts_within_a_kind(affine):
    graph = Graph(affine)
    assert graph.inputs == {"x": Tensor("x", "float32", ("batch", 3))}
    assert list(map(str, graph.outputs.values())) == ["y float32[batch, 2]", "z float32[batch, 2]"]
    assert [graph.inputs["x"].fixed(axis) for axis in (0, 1, 5)] == [None, 3, None]
    x = np.asarray([[1.0, 2.0, 3.0]])  # float64
    found = Graph(affine).run({"x": x}, ["z", "y"])
    assert list(found) == ["z", "y"]
    np.testing.assert_allclose(found["y"], x @ np.arange(6).reshape(3, 2) + 1)
    np.testing.assert_array_equal(found["z"], 2 * found["y"])
    assert found["y"].dtype == np.float32
    assert list(Graph(affine).run({"x": x})) == ["y", "z"]


def test_a_scalar_stays_one(tmp_path):
    """SAM 2's memory encoder takes `binarize` so; ONNX Runtime takes no row of one number for it."""
    path = write_graph(tmp_path / "a.onnx", [node("Neg", ["h"], ["y"])], {"h": ("int64", [])}, {"y": ("int64", [])})
    found = Graph(path).run({"h": np.asarray(7, np.int32)})["y"]
    assert (found.shape, int(found)) == ((), -7)


@pytest.mark.parametrize(("feeds", "outputs", "named"), [
    ({"x": np.zeros((1, 4), np.float32)}, None, ["x float32[1, 4]", "Expected: 3"]),
    ({"x": np.zeros((1, 3), np.int64)}, None, ["x int64[1, 3]", "tensor(float)"]),
    ({"image": np.zeros((1, 3), np.float32)}, None, ["image", "Required inputs (['x'])"]),
    ({"x": np.zeros((1, 3), np.float32)}, ["embedding"], ["Invalid output name:embedding"]),
])  # fmt: skip
def test_a_tensor_that_does_not_fit_is_named(affine, feeds, outputs, named):
    with refused("affine.onnx", *named):
        Graph(affine).run(feeds, outputs)


def test_a_graph_that_fails_at_run_time_is_named(tmp_path):
    inputs = {"a": ("float32", ["n"]), "b": ("float32", ["m"])}
    path = write_graph(tmp_path / "sum.onnx", [node("Add", ["a", "b"], ["c"])], inputs, {"c": ("float32", ["k"])})
    with refused("sum.onnx: a graph that fails on a float32[2], b float32[3]"):
        Graph(path).run({"a": np.zeros(2), "b": np.zeros(3)})


def test_external_data_belongs_to_the_graph(tmp_path):
    def write(name, value):
        sides = {"x": ("float32", [64])}, {"y": ("float32", [64])}, {"w": np.full(64, value, np.float32)}
        return write_graph(tmp_path / name / "g.onnx", [node("Add", ["x", "w"], ["y"])], *sides, external="g.bin")

    path, other = write("one", 1.0), write("two", 2.0)
    assert path.read_bytes() == other.read_bytes()
    assert content_digest([path]) != content_digest([other])
    assert content_digest([path]) == content_digest([write("three", 1.0)])
    (path.parent / "g.bin").unlink()
    with refused("g.onnx", "g.bin"):
        Graph(path)


def test_half_precision_is_met_with_half_precision(tmp_path):
    half = {"x": ("float16", ["n"])}, {"y": ("float16", ["n"])}
    path = write_graph(tmp_path / "half.onnx", [node("Add", ["x", "x"], ["y"])], *half)
    found = Graph(path).run({"x": np.ones(3, np.float32)})
    assert found["y"].dtype == np.float16


@pytest.mark.parametrize("place", ["initializer", "external", "constant", None])
def test_the_optimiser_that_half_precision_crashes_is_left_out_of_such_graphs(tmp_path, monkeypatch, place):
    """Their names need not say it."""
    weights = np.ones((8, 3, 3, 3), np.float32 if place is None else np.float16)
    nodes, constants = [node("Conv", ["x" if place is None else "h", "w"], ["y"])], {"w": weights}
    if place is not None:
        nodes.insert(0, node("Cast", ["x"], ["h"], to=onnx.TensorProto.FLOAT16))
    if place == "constant":
        constants, tensor = {}, onnx.numpy_helper.from_array(weights, "w")
        nodes.insert(0, node("Constant", [], ["w"], value=tensor))
    kinds = {"x": ("float32", [1, 3, 8, 8])}, {"y": ("float32" if place is None else "float16", [1, 8, 6, 6])}
    path = write_graph(tmp_path / "model.onnx", nodes, *kinds, constants, external="w" if place == "external" else None)
    disabled, opened = [], onnxruntime.InferenceSession

    def noted(*args, **options):
        disabled.append(options["disabled_optimizers"])
        return opened(*args, **options)

    monkeypatch.setattr(onnxruntime, "InferenceSession", noted)
    found = Graph(path).run({"x": np.ones((1, 3, 8, 8), np.float32)})
    np.testing.assert_array_equal(found["y"], np.full((1, 8, 6, 6), 27))
    assert disabled == [None, None if place is None else ["NchwcTransformer"]]


def test_an_input_of_unheard_of_size_is_refused(tmp_path):
    """The optimiser would allocate what follows from it."""
    sides = ({name: ("float32", ["n", 2])} for name in "xy")
    path = write_graph(tmp_path / "large.onnx", [node("Relu", ["x"], ["y"])], *sides)
    model = onnx.load(str(path))
    model.graph.input[0].type.tensor_type.shape.dim[1].dim_value = 2**31
    onnx.save(model, str(path))
    with refused(f"large.onnx: an input 'x' of {2**31} numbers"):
        Graph(path)
