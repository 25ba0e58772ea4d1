"""INRIA .ply files come back bit by bit; every variant in the wild is read or refused with a reason."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from capture_files import refused
from splat_files import PLY_NAMES, ply_columns, write_ply

from experiments.datasets.mesh_files import read_faces, write_mesh
from jsecon import Gaussians
from jsecon.read.splats.files import load_gaussians, save_gaussians
from jsecon.read.splats.ply import load_point_cloud

FIELDS = tuple(field.name for field in dataclasses.fields(Gaussians))


def random_gaussians(count: int, basis: int = 4) -> Gaussians:
    rng = np.random.default_rng(count + basis)
    shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, basis, 3)]
    return Gaussians(*(jnp.asarray(rng.normal(size=shape) * 10, jnp.float32) for shape in shapes))


@pytest.mark.parametrize("basis", [1, 4, 9, 16])
@pytest.mark.parametrize("count", [0, 1, 100])
def test_round_trip_is_exact(tmp_path, basis, count):
    gaussians = random_gaussians(count, basis)
    save_gaussians(tmp_path / "a.ply", gaussians)
    loaded = load_gaussians(tmp_path / "a.ply")
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(loaded, field), getattr(gaussians, field))
        assert getattr(loaded, field).dtype == jnp.float32
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_layout_is_inrias(tmp_path):
    """The order of the properties, zero normals and the channel-major rest, by raw bytes."""
    gaussians = random_gaussians(3, 4)
    save_gaussians(tmp_path / "a.ply", gaussians)
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property float")]
    assert names == PLY_NAMES[:9] + [f"f_rest_{n}" for n in range(9)] + PLY_NAMES[9:]
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n")
    rows = np.frombuffer(body, "<f4").reshape(3, len(names))
    np.testing.assert_array_equal(rows[:, 3:6], 0)
    for gaussian, row in enumerate(rows):
        for channel in range(3):
            for term in range(3):
                assert row[9 + channel * 3 + term] == gaussians.sh[gaussian, 1 + term, channel]


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_variants(tmp_path, form):
    """Any order of properties, extra ones of OpenGaussian and Gaussian Grouping, doubles, further elements behind."""
    given = ply_columns(rest=24)
    mixed = {"ins_feat_r": given["x"], **dict(reversed(given.items())), "obj_dc_0": given["y"], "red": np.full(6, 128)}
    types = {"red": "uchar", "opacity": "double"}
    write_ply(tmp_path / "a.ply", mixed, form, types, extra="element face 0\nproperty list uchar int vertex_indices\n")
    loaded = load_gaussians(tmp_path / "a.ply")
    np.testing.assert_array_equal(loaded.means, np.stack([given[axis] for axis in "xyz"], -1))
    np.testing.assert_array_equal(loaded.quaternions, np.stack([given[f"rot_{n}"] for n in range(4)], -1))
    np.testing.assert_array_equal(loaded.opacity_logits, given["opacity"])
    assert loaded.sh.shape == (6, 9, 3)
    np.testing.assert_array_equal(loaded.sh[:, 5, 2], given["f_rest_20"])


@pytest.mark.parametrize("missing", ["opacity", "rot_3", "f_dc_0", "x"])
def test_missing_properties(tmp_path, missing):
    given = ply_columns()
    del given[missing]
    write_ply(tmp_path / "a.ply", given)
    with refused("a.ply", f"no {missing}"):
        load_gaussians(tmp_path / "a.ply")


@pytest.mark.parametrize(("name", "value", "field"), [
    ("y", np.nan, "means"), ("scale_1", np.inf, "log_scales"), ("rot_0", np.nan, "quaternions"),
    ("opacity", np.nan, "opacity_logits"), ("f_dc_2", -np.inf, "sh"),
])  # fmt: skip
def test_numbers_that_are_none(tmp_path, name, value, field):
    given = ply_columns()
    given[name][4] = value
    write_ply(tmp_path / "a.ply", given)
    with refused(f"{field} of 1 of 6 Gaussians", "the first: 4"):
        load_gaussians(tmp_path / "a.ply")


def test_opacity_of_one_and_no_rotation(tmp_path):
    given = ply_columns()
    given["opacity"][:2] = np.inf, -np.inf
    write_ply(tmp_path / "a.ply", given)
    np.testing.assert_array_equal(load_gaussians(tmp_path / "a.ply").opacity_logits[:2], [np.inf, -np.inf])
    for axis in range(4):
        given[f"rot_{axis}"][3] = 0
    write_ply(tmp_path / "a.ply", given)
    with refused("quaternions of 1 of 6", "zero", "the first: 3"):
        load_gaussians(tmp_path / "a.ply")


EMPTY = "format ascii 1.0\nelement vertex 0"


@pytest.mark.parametrize(("header", "said"), [
    ("format ascii 1.0\nelement face 0", "elements are face"),
    ("format ascii 1.0\nelement vertex many", "element vertex many"),
    ("format ascii 1.0\nelement vertex -1\nproperty float x", "element vertex -1"),
    ("format ascii 1.0\nelement vertex 999999999999999\nproperty float x", "cut short"),
    (f"{EMPTY}\nproperty quad x", "property quad x"),
    (f"{EMPTY}\nproperty list uchar int x", "has lists"),
    (f"{EMPTY}\nproperty float x\nproperty float x", "more than once"),
])  # fmt: skip
def test_headers_that_are_none(tmp_path, header, said):
    (tmp_path / "a.ply").write_text(f"ply\n{header}\nend_header\n\n\n")
    with refused("a.ply", said):
        load_gaussians(tmp_path / "a.ply")


def test_plain_points(tmp_path):
    given = {
        "x": np.arange(3.0),
        "y": np.ones(3),
        "z": -np.arange(3.0),
        **dict.fromkeys(("red", "green", "blue"), np.array([0, 51, 255])),
    }
    write_ply(tmp_path / "p.ply", given, types={**dict.fromkeys(("red", "green", "blue"), "uchar"), "x": "double"})
    points, colours = load_point_cloud(tmp_path / "p.ply")
    np.testing.assert_array_equal(points, np.stack([given[axis] for axis in "xyz"], -1).astype(np.float32))
    np.testing.assert_array_equal(colours, np.repeat([[0], [51], [255]], 3, 1))


def test_points_without_colour_or_place(tmp_path):
    write_ply(tmp_path / "p.ply", {axis: np.zeros(2) for axis in "xyz"})
    np.testing.assert_array_equal(load_point_cloud(tmp_path / "p.ply")[1], 128)
    write_ply(tmp_path / "p.ply", {axis: np.zeros(2) for axis in "xy"})
    with refused("p.ply", "no z"):
        load_point_cloud(tmp_path / "p.ply")
    write_ply(tmp_path / "p.ply", {axis: np.full(2, np.nan) for axis in "xyz"})
    with refused("p.ply", "NaN"):
        load_point_cloud(tmp_path / "p.ply")


def test_faces_round_trip_and_damage(tmp_path):
    rng = np.random.default_rng(0)
    vertices = np.zeros(9, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
    vertices["y"] = rng.normal(size=9)
    for corners in (3, 4):
        faces, owners = rng.integers(0, 9, (5, corners)), rng.integers(0, 70000, 5).astype(np.int32)
        write_mesh(tmp_path / "mesh.ply", vertices, faces, {"object_id": owners})
        found, properties = read_faces(tmp_path / "mesh.ply")
        np.testing.assert_array_equal(found, faces)
        np.testing.assert_array_equal(properties["object_id"], owners)
        np.testing.assert_array_equal(load_point_cloud(tmp_path / "mesh.ply")[0][:, 1], vertices["y"])
    data = (tmp_path / "mesh.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(data[:-3])
    with refused("fewer than 5 faces"):
        read_faces(tmp_path / "cut.ply")
    write_mesh(tmp_path / "wrong.ply", vertices, np.full((1, 3), 9))
    with refused("a face with vertex 9"):
        read_faces(tmp_path / "wrong.ply")
    write_mesh(tmp_path / "points.ply", vertices)
    with refused("elements vertex"):
        read_faces(tmp_path / "points.ply")
