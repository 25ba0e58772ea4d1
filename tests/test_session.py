"""ONNX graphs: signatures as the file has them, and a message that names file or tensor for whatever does not fit."""

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from capture_files import refused
from onnx_files import node, write_graph

from jsecon.errors import InputError
from jsecon.networks.session import Graph, Tensor, content_digest, describe


@pytest.fixture
def affine(tmp_path):
    """y = x @ w + b and z = y + y, of x (batch, 3)."""
    nodes = [node("MatMul", ["x", "w"], ["xw"]), node("Add", ["xw", "b"], ["y"]), node("Add", ["y", "y"], ["z"])]
    constants = {"w": np.arange(6, dtype=np.float32).reshape(3, 2), "b": np.ones(2, np.float32)}
    outputs = {"y": ("float32", ["batch", 2]), "z": ("float32", ["batch", 2])}
    return write_graph(tmp_path / "affine.onnx", nodes, {"x": ("float32", ["batch", 3])}, outputs, constants)


def test_the_signature_is_that_of_the_file(affine):
    graph = Graph(affine, optimise=False)
    assert graph.inputs == {"x": Tensor("x", "float32", ("batch", 3))}
    assert list(graph.outputs) == ["y", "z"]
    assert describe(graph.outputs.values()) == "y float32[batch, 2], z float32[batch, 2]"
    assert graph.inputs["x"].fixed(1) == 3
    assert graph.inputs["x"].fixed(0) is None
    assert graph.inputs["x"].fixed(5) is None


def test_it_runs_by_name_and_converts_within_a_kind(affine):
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
    ({}, None, ["Required inputs (['x'])"]),
    ({"x": np.zeros((1, 3), np.float32)}, ["embedding"], ["Invalid output name:embedding"]),
])  # fmt: skip
def test_a_tensor_that_does_not_fit_is_named(affine, feeds, outputs, named):
    with refused("affine.onnx", *named):
        Graph(affine).run(feeds, outputs)


def test_requirements_name_the_tensor_and_what_was_wanted(affine):
    graph = Graph(affine)
    assert graph.require("input", "x", (None, 3), "a test").dtype == "float32"
    assert graph.require("output", "y", (4, 2), "a test").name == "y"
    with pytest.raises(InputError, match=r"input 'image'.*no such input.*x float32\[batch, 3\].*CLIP's image encoder"):
        graph.require("input", "image", (1, 3, 224, 224), "CLIP's image encoder")
    with pytest.raises(InputError, match=r"output 'y': y float32\[batch, 2\].*\[\?, 512\]"):
        graph.require("output", "y", (None, 512), "CLIP's image encoder")


@pytest.mark.parametrize(("damage", "words"), [
    (Path.unlink, "No such file"), (lambda path: path.write_bytes(b""), "an empty file"),
    (lambda path: path.write_bytes(path.read_bytes()[:100]), "cannot open"),
    (lambda path: path.write_bytes(b"<!DOCTYPE html><html>not found</html>"), "cannot open"),
    (lambda path: path.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n"), "Git LFS pointer"),
    (lambda path: path.write_bytes(b"PK\x03\x04" + bytes(200)), "cannot open"),
], ids=["missing", "empty", "cut", "page", "pointer", "torch"])  # fmt: skip
def test_a_file_that_is_no_graph_is_refused_by_name(affine, damage, words):
    damage(affine)
    with pytest.raises(InputError, match=words) as caught:
        Graph(affine)
    assert str(affine) in caught.value.where


def test_a_graph_that_fails_at_run_time_is_named(tmp_path):
    inputs = {"a": ("float32", ["n"]), "b": ("float32", ["m"])}
    path = write_graph(tmp_path / "sum.onnx", [node("Add", ["a", "b"], ["c"])], inputs, {"c": ("float32", ["k"])})
    with pytest.raises(InputError, match=r"sum.onnx: a graph that fails on a float32\[2\], b float32\[3\]"):
        Graph(path).run({"a": np.zeros(2), "b": np.zeros(3)})


def test_external_data_belongs_to_the_graph(tmp_path):
    def write(name, value):
        constants = {"w": np.full(64, value, np.float32)}
        shape = {"x": ("float32", [64])}, {"y": ("float32", [64])}
        return write_graph(
            tmp_path / name / "g.onnx", [node("Add", ["x", "w"], ["y"])], *shape, constants, external="g.bin"
        )

    path, other = write("one", 1.0), write("two", 2.0)
    (path.parent / "notes.txt").write_text("nothing to do with it")
    assert path.read_bytes() == other.read_bytes()
    assert content_digest([path]) != content_digest([other])
    assert content_digest([path]) == content_digest([write("three", 1.0)])
    (path.parent / "g.bin").unlink()
    with pytest.raises(InputError, match=r"g\.onnx.*g\.bin"):
        Graph(path)


def test_half_precision_is_met_with_half_precision(tmp_path):
    half = {"x": ("float16", ["n"])}, {"y": ("float16", ["n"])}
    path = write_graph(tmp_path / "half.onnx", [node("Add", ["x", "x"], ["y"])], *half)
    found = Graph(path).run({"x": np.ones(3, np.float32)})
    assert found["y"].dtype == np.float16


@pytest.mark.parametrize("place", ["initializer", "external", "constant", "branch", None])
def test_the_optimiser_that_half_precision_crashes_is_left_out_of_such_graphs(tmp_path, monkeypatch, place):
    """Their names need not say it."""
    weights = np.ones((8, 3, 3, 3), np.float32 if place is None else np.float16)
    cast = [] if place is None else [node("Cast", ["x"], ["h"], to=onnx.TensorProto.FLOAT16)]
    nodes = [*cast, node("Conv", ["h" if cast else "x", "w"], ["y"])]
    constants, tensor = {"w": weights}, onnx.numpy_helper.from_array(weights, "w")
    if place in ("constant", "branch"):
        constants, made = {}, node("Constant", [], ["w"], value=tensor)
        if place == "branch":
            constants, out = {"yes": np.array(True)}, onnx.helper.make_tensor_value_info("w", 10, weights.shape)
            branch = onnx.helper.make_graph([made], "branch", [], [out])
            made = node("If", ["yes"], ["w"], then_branch=branch, else_branch=branch)
        nodes.insert(0, made)
    kinds = {"x": ("float32", [1, 3, 8, 8])}, {"y": ("float16" if cast else "float32", [1, 8, 6, 6])}
    path = write_graph(tmp_path / "model.onnx", nodes, *kinds, constants, external="w" if place == "external" else None)
    disabled = []
    opened = onnxruntime.InferenceSession

    def noted(*args, **options):
        disabled.append(options["disabled_optimizers"])
        return opened(*args, **options)

    monkeypatch.setattr(onnxruntime, "InferenceSession", noted)
    found = Graph(path).run({"x": np.ones((1, 3, 8, 8), np.float32)})
    np.testing.assert_array_equal(found["y"], np.full((1, 8, 6, 6), 27))
    assert disabled == [None, None if place is None else ["NchwcTransformer"]]


@pytest.mark.parametrize("size", [2**31, 2**40])
def test_an_input_of_unheard_of_size_is_refused(tmp_path, size):
    """The optimiser would allocate what follows from it."""
    path = write_graph(
        tmp_path / "large.onnx", [node("Relu", ["x"], ["y"])], *({k: ("float32", ["n", 2])} for k in "xy")
    )
    model = onnx.load(str(path))
    model.graph.input[0].type.tensor_type.shape.dim[1].dim_value = size
    onnx.save(model, str(path))
    with pytest.raises(InputError, match=rf"large.onnx: an input 'x' of {size} numbers"):
        Graph(path)
