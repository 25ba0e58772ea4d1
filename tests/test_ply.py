"""INRIA .ply files come back bit by bit; every variant in the wild is read or refused with a reason."""

import numpy as np
import pytest
from splat_files import C0, PLY_NAMES, gaussians, opacity, ply_columns, scene, spz, write_ply

from jsecon.read.splats.formats import load_gaussians
from jsecon.read.splats.writing import save_gaussians


@pytest.mark.parametrize("basis", [1, 4, 9, 16])
@pytest.mark.parametrize("count", [0, 1, 100])
def test_round_trip_is_exact(tmp_path, basis, count):
    given = gaussians(scene(count, basis))
    save_gaussians(tmp_path / "a.ply", given)
    loaded = load_gaussians(tmp_path / "a.ply")
    for field in vars(given):
        np.testing.assert_array_equal(getattr(loaded, field), getattr(given, field))
        assert getattr(loaded, field).dtype == np.float32


def test_layout_is_inrias(tmp_path):
    """The order of the properties, zero normals and the channel-major rest, by raw bytes."""
    given = gaussians(scene(3, 4))
    save_gaussians(tmp_path / "a.ply", given)
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property float")]
    assert names == PLY_NAMES[:9] + [f"f_rest_{n}" for n in range(9)] + PLY_NAMES[9:]
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n")
    rows = np.frombuffer(body, "<f4").reshape(3, len(names))
    np.testing.assert_array_equal(rows[:, 3:6], 0)
    for gaussian, row in enumerate(rows):
        for channel in range(3):
            for term in range(3):
                assert row[9 + channel * 3 + term] == given.sh[gaussian, 1 + term, channel]


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_variants(tmp_path, form):
    """Any order of properties, extra ones of OpenGaussian and Gaussian Grouping, doubles, further elements behind."""
    given = ply_columns(rest=24)
    mixed = {"ins_feat_r": given["x"], **dict(reversed(given.items())), "obj_dc_0": given["y"], "red": np.full(6, 128)}
    types = {"red": "uchar", "opacity": "double"}
    mixed["opacity"] = np.array([np.inf, -np.inf, 0, 1, 2, 3])
    write_ply(tmp_path / "a.ply", mixed, form, types, extra="element face 0\nproperty list uchar int vertex_indices\n")
    loaded = load_gaussians(tmp_path / "a.ply")
    np.testing.assert_array_equal(loaded.means, np.stack([given[axis] for axis in "xyz"], -1))
    np.testing.assert_array_equal(loaded.quaternions, np.stack([given[f"rot_{n}"] for n in range(4)], -1))
    np.testing.assert_array_equal(loaded.opacity_logits, mixed["opacity"])
    assert loaded.sh.shape == (6, 9, 3)
    np.testing.assert_array_equal(loaded.sh[:, 5, 2], given["f_rest_20"])


def read(tmp_path, *, types=None, **changes):
    """The columns of a .ply after these changes, and the Gaussians in it; None leaves a column out."""
    columns = {name: column for name, column in (ply_columns(40) | changes).items() if column is not None}
    write_ply(tmp_path / "a.PLY", columns, types=types)
    return columns, load_gaussians(tmp_path / "a.PLY")


def test_a_flat_gaussian_has_no_thickness(tmp_path):
    columns, found = read(tmp_path, scale_2=None)
    assert np.isneginf(found.log_scales[:, 2]).all()
    np.testing.assert_array_equal(found.log_scales[:, 0], columns["scale_0"])


def test_colours_of_8_bits_in_place_of_coefficients(tmp_path):
    names = "red", "green", "blue"
    rgb = dict(zip(names, np.random.default_rng(0).integers(0, 256, (3, 40))))
    kinds, without = dict.fromkeys(names, "uchar"), dict.fromkeys(("f_dc_0", "f_dc_1", "f_dc_2"))
    _, found = read(tmp_path, types=kinds, **without, **rgb)
    np.testing.assert_allclose(found.sh[:, 0, 1], (rgb["green"] / 255 - 0.5) / C0, atol=1e-5)
    columns, found = read(tmp_path, types=kinds, **rgb)  # beside coefficients, they are a viewer's
    np.testing.assert_array_equal(found.sh[:, 0, 1], columns["f_dc_1"])


@pytest.mark.parametrize("name", ["filter_3D", "filter_3d"])
def test_mip_splattings_filter_is_fused_as_it_fuses_it(tmp_path, name):
    width = np.random.default_rng(0).uniform(0.001, 0.3, 40)
    width[:2] = 0
    columns, found = read(tmp_path, **{name: width})
    squares = np.exp(np.stack([columns[f"scale_{n}"] for n in range(3)], 1).astype(np.float64)) ** 2
    fused = squares + width[:, None] ** 2
    np.testing.assert_allclose(np.exp(np.asarray(found.log_scales)), np.sqrt(fused), rtol=1e-5)
    alpha = opacity({"opacity_logits": np.asarray(found.opacity_logits, np.float64)})
    expected = opacity({"opacity_logits": columns["opacity"]}) * np.sqrt(squares.prod(1) / fused.prod(1))
    np.testing.assert_allclose(alpha, expected, rtol=1e-4, atol=1e-9)


def test_training_with_antialiasing_is_said(tmp_path):
    for version in (2, 4):
        (tmp_path / "a.spz").write_bytes(spz(scene(30), version, flags=1))
        with pytest.warns(UserWarning, match="antialiasing"):
            load_gaussians(tmp_path / "a.spz")
