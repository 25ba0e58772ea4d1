"""A .glb read byte by byte: the container, the extension's attributes, the axes, and what belongs to a field."""

import json
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from splat_files import C0, GLTF as NAME, gaussians, opacity, rewrite_glb, scene
from test_gaussian_files import compare

from jsecon import Gaussians, load_gaussians, save_gaussians
from jsecon.splat.transform import transform_gaussians

COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def read_glb(path) -> tuple[dict, dict[str, np.ndarray]]:
    """(JSON, attribute -> array), by glTF 2.0 and apart from the writer."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    told = json.loads(data[20 : 20 + size])
    behind, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert (kind, size % 4, behind % 4, 28 + size + behind) == (b"BIN\0", 0, 0, len(data))
    assert told["buffers"] == [{"byteLength": behind}]
    body, arrays = data[28 + size :], {}
    for name, index in told["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = told["accessors"][index]
        view = told["bufferViews"][accessor["bufferView"]]
        dtype = np.dtype({5126: "<f4", 5121: "u1"}[accessor["componentType"]])
        shape = accessor["count"], COMPONENTS[accessor["type"]]
        assert view["byteLength"] == dtype.itemsize * shape[0] * shape[1]
        assert view["byteOffset"] % 4 == 0
        arrays[name] = np.frombuffer(body, dtype, shape[0] * shape[1], view["byteOffset"]).reshape(shape)
    return told, arrays


@pytest.mark.parametrize("basis", [1, 4, 9, 16])
def test_attributes_are_the_extensions(tmp_path, basis):
    given = scene(101, basis)
    save_gaussians(tmp_path / "a.glb", gaussians(given | {"quaternions": 3 * given["quaternions"]}))
    told, found = read_glb(tmp_path / "a.glb")
    degrees = range({1: 1, 4: 2, 9: 3, 16: 4}[basis])
    harmonics = [f"{NAME}:SH_DEGREE_{degree}_COEF_{n}" for degree in degrees for n in range(2 * degree + 1)]
    own = [f"{NAME}:{kind}" for kind in ("ROTATION", "SCALE", "OPACITY")]
    assert list(found) == ["POSITION", "COLOR_0", *own, *harmonics]
    primitive = told["meshes"][0]["primitives"][0]
    assert primitive["extensions"] == {NAME: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    np.testing.assert_allclose(found["POSITION"], given["means"] * [-1, -1, 1], atol=1e-6)
    bounds = told["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(bounds["min"], found["POSITION"].min(0))
    np.testing.assert_array_equal(bounds["max"], found["POSITION"].max(0))
    np.testing.assert_allclose(found[own[1]], np.exp(given["log_scales"]), rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(found[own[0]], axis=1), 1, atol=1e-6)
    alpha, turns = found[own[2]][:, 0], np.roll(found[own[0]], 1, axis=1)
    sh = np.stack([found[name] for name in harmonics], axis=1)
    stored = Gaussians(found["POSITION"], np.log(found[own[1]]), turns, np.log(alpha / (1 - alpha)), sh)
    compare(transform_gaussians(stored, np.diag([-1.0, -1.0, 1.0, 1.0])), given, (*[1e-5] * 5, 0.99999))
    assert told["accessors"][primitive["attributes"]["COLOR_0"]]["normalized"] is True
    linear = found["COLOR_0"][:, :3] / 255.0
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(shown, np.clip(0.5 + C0 * given["sh"][:, 0], 0, 1), atol=0.03)
    np.testing.assert_allclose(found["COLOR_0"][:, 3] / 255, opacity(given), atol=0.002)


def test_other_writers_ways(tmp_path):
    """Two primitives, under nodes of which one turns and the other is a matrix; rows apart; opacities of 8 bits."""
    given, turn = gaussians(scene(30, 4)), Rotation.from_rotvec([0.1, -0.5, 0.3])
    save_gaussians(tmp_path / "a.glb", given)

    def change(told):
        outer = {"rotation": turn.as_quat().tolist(), "translation": [1, 2, 3], "scale": [2, 2, 2], "children": [1, 2]}
        shift = np.eye(4)
        shift[:3, 3] = 5, 0, 0
        told["nodes"] = [outer, {"mesh": 0}, {"mesh": 0, "matrix": shift.T.ravel().tolist()}]
        names = told["meshes"][0]["primitives"][0]["attributes"]
        alpha = told["accessors"][names[f"{NAME}:OPACITY"]]
        colour = told["accessors"][names["COLOR_0"]]
        alpha |= {"bufferView": colour["bufferView"], "byteOffset": 3, "componentType": 5121, "normalized": True}
        told["bufferViews"][colour["bufferView"]]["byteStride"] = 4

    rewrite_glb(tmp_path / "a.glb", change)
    found, axes = load_gaussians(tmp_path / "a.glb"), np.diag([-1.0, -1.0, 1.0])
    inner = np.asarray(given.means) @ axes
    both = np.concatenate([inner, inner + np.array([5, 0, 0])])
    np.testing.assert_allclose(found.means, (turn.apply(2 * both) + np.array([1, 2, 3])) @ axes, atol=1e-5)
    np.testing.assert_allclose(found.log_scales, np.tile(given.log_scales, (2, 1)) + np.log(2), atol=1e-5)
    alpha = 1 / (1 + np.exp(-np.asarray(found.opacity_logits)))
    np.testing.assert_allclose(alpha[:30], opacity(scene(30, 4)), atol=0.51 / 255)


@pytest.mark.parametrize(("name", "code", "kind", "normalised"), [
    ("POSITION", 5122, "<i2", False), ("POSITION", 5120, "i1", True), (f"{NAME}:SCALE", 5121, "u1", True),
    (f"{NAME}:OPACITY", 5123, "<u2", True),
])  # fmt: skip
def test_whole_numbers_of_a_glb_are_read_as_its_accessor_says(tmp_path, name, code, kind, normalised):
    save_gaussians(tmp_path / "a.glb", gaussians(scene(30, 4)))
    numbers = np.random.default_rng(0).integers(1, 100, (30, 1 if "OPACITY" in name else 3)).astype(kind)

    def change(told):
        told["extensionsRequired"] = ["KHR_mesh_quantization"]
        offset = told["buffers"][0]["byteLength"]
        told["bufferViews"].append({"buffer": 0, "byteOffset": offset, "byteLength": numbers.nbytes})
        accessor = told["accessors"][told["meshes"][0]["primitives"][0]["attributes"][name]]
        accessor |= {"bufferView": len(told["bufferViews"]) - 1, "componentType": code, "normalized": normalised}

    rewrite_glb(tmp_path / "a.glb", change, numbers.tobytes() + bytes(-numbers.nbytes % 4))
    found = load_gaussians(tmp_path / "a.glb")
    got = {
        "POSITION": np.asarray(found.means) * [-1, -1, 1],
        f"{NAME}:SCALE": np.exp(found.log_scales),
        f"{NAME}:OPACITY": opacity({"opacity_logits": np.asarray(found.opacity_logits, np.float64)})[:, None],
    }
    np.testing.assert_allclose(got[name], numbers / (np.iinfo(kind).max if normalised else 1), rtol=1e-5)
