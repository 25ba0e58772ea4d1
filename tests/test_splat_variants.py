"""Gaussians as many programs write them: each variant gives the right numbers, or one sentence that names it."""

import itertools
import struct

import numpy as np
import pytest
import splat_files
from capture_files import refused
from splat_files import C0, opacity, ply_columns, scene, write_ply
from test_gaussian_files import STEPS, compare, gaussians
from test_gltf import NAME, rewritten

import jsecon

SCENE = scene(300, 4)


# --- places in .spz: the bits behind the point


# --- .spz: versions, axes, flags


def record(kind, body):
    return struct.pack("<II", kind, len(body)) + body


SYSTEMS = "LDB RDB LUB RUB LDF RDF LUF RUF"
TOWARDS = {"R": (0, 1), "L": (0, -1), "D": (1, 1), "U": (1, -1), "F": (2, 1), "B": (2, -1)}
"""a direction -> the axis of a .ply that it lies along, and its sign there"""


# --- places in .spz: the bits behind the point


@pytest.mark.parametrize("reach", [*(10.0**n for n in range(-6, 7)), 127.99999, 128, 256, 512, 2**22 - 0.5])
def test_a_spz_places_gaussians_within_half_a_step_at_any_magnitude(tmp_path, reach):
    given = scene(60, 1)
    rng = np.random.default_rng(0)
    given["means"] = rng.uniform(-reach, reach, (60, 3)) * 10 ** rng.uniform(-3, 0, (60, 1))
    given["means"][:3] = np.diag([reach, -reach, reach])
    given["log_scales"] = np.full((60, 3), np.clip(np.log(reach / 50), -9, 5.5))  # as large as its scene asks
    written = gaussians(given)
    jsecon.save_gaussians(tmp_path / "a.spz", written)
    found = jsecon.load_gaussians(tmp_path / "a.spz")
    most = float(np.abs(written.means).max())
    step = 2.0**-16 if most > 1 else 2.0**-24
    while most / step > 2**23 - 1:
        step *= 2
    error = np.abs(np.asarray(found.means, np.float64) - np.asarray(written.means, np.float64))
    assert error.max() <= step / 2
    if reach >= 1e-2:
        assert error.max() < reach / 2**16


@pytest.mark.parametrize(("changes", "says"), [
    ({"means": 1e7}, ("10,000,000 units from the origin", "Write a .ply")),
    ({"log_scales": 6.5}, ("665 units large", "379")), ({"log_scales": -12.0}, ("many are tiny",)),
])  # fmt: skip
def test_a_spz_refuses_what_it_cannot_hold(tmp_path, changes, says):
    given = scene(60, 1)
    for name, value in changes.items():
        given[name] = np.full_like(given[name], value)
    with refused("a.spz", *says):
        jsecon.save_gaussians(tmp_path / "a.spz", gaussians(given))
    assert not list(tmp_path.iterdir())
    jsecon.save_gaussians(tmp_path / "a.ply", gaussians(given))
    if "means" in changes:
        jsecon.save_gaussians(tmp_path / "a.glb", gaussians(given))
        np.testing.assert_array_equal(jsecon.load_gaussians(tmp_path / "a.glb").means, gaussians(given).means)


# --- .spz: versions, axes, flags


@pytest.mark.parametrize(("number", "name"), [*enumerate(SYSTEMS.split(), 1)])
@pytest.mark.parametrize("version", [3, 4])
def test_a_spz_is_turned_from_the_axes_that_it_names(tmp_path, number, name, version):
    """Left-handed ones too, in which the scene stands mirrored."""
    axes = np.array([TOWARDS[letter][1] for letter in name])
    records = record(0xADBE0002, bytes(12)) + record(0xADBE0003, struct.pack("<I", number))
    (tmp_path / "a.spz").write_bytes(splat_files.spz(SCENE, version, axes=axes, records=records))
    found = jsecon.load_gaussians(tmp_path / "a.spz")
    compare(found, SCENE, STEPS["four.spz"])


def test_what_a_spz_says_and_is_not_done_is_told(tmp_path):
    for version, flags in itertools.product((2, 4), (0, 1)):
        (tmp_path / "a.spz").write_bytes(splat_files.spz(SCENE, version, flags=flags))
        if flags:
            with pytest.warns(UserWarning, match="antialiasing"):
                jsecon.load_gaussians(tmp_path / "a.spz")
        else:
            jsecon.load_gaussians(tmp_path / "a.spz")


@pytest.mark.parametrize(("how", "says"), [
    ({"degree": 4}, ("degree 4",)), ({"version": 5}, ("version 5",)),
    ({"records": record(0xADBE0003, struct.pack("<I", 17))}, ("unknown number 17",)),
    ({"records": record(0xADBE0003, b"")[:-1] + b"\1"}, ("damaged",)), ({"fraction": 31}, ("fractional_bits",)),
])  # fmt: skip
def test_a_spz_of_another_kind_is_refused_by_name(tmp_path, how, says):
    how = {"version": 4, **how}
    data = splat_files.spz(SCENE | {"means": 0 * SCENE["means"]}, how.pop("version"), **how)
    (tmp_path / "a.spz").write_bytes(data)
    with refused("a.spz", *says):
        jsecon.load_gaussians(tmp_path / "a.spz")


# --- .ply


def plys(given, **more):
    """Columns of a .ply out of arrays, and `more` of them; None leaves a column out."""
    own = {axis: given["means"][:, n] for n, axis in enumerate("xyz")}
    own |= {f"scale_{n}": given["log_scales"][:, n] for n in range(3)}
    own |= {f"rot_{n}": given["quaternions"][:, n] for n in range(4)}
    own |= {f"f_dc_{n}": given["sh"][:, 0, n] for n in range(3)} | {"opacity": given["opacity_logits"]}
    own |= more
    return {name: column for name, column in own.items() if column is not None}


PLAIN = scene(40, 1)


@pytest.mark.parametrize("third", [None, np.full(40, -np.inf)])
def test_a_flat_gaussian_has_no_thickness(tmp_path, third):
    write_ply(tmp_path / "a.PLY", plys(PLAIN, scale_2=third))
    found = jsecon.load_gaussians(tmp_path / "a.PLY")
    assert np.isneginf(found.log_scales[:, 2]).all()
    np.testing.assert_array_equal(found.log_scales[:, :2], PLAIN["log_scales"][:, :2].astype(np.float32))


def test_colours_of_8_bits_in_place_of_coefficients(tmp_path):
    rgb = np.random.default_rng(0).integers(0, 256, (40, 3))
    numbers = {name: rgb[:, n] for n, name in enumerate(("red", "green", "blue"))}
    kinds = dict.fromkeys(numbers, "uchar")
    without = dict.fromkeys(("f_dc_0", "f_dc_1", "f_dc_2"))
    write_ply(tmp_path / "a.ply", plys(PLAIN, **without, **numbers), types=kinds)
    found = jsecon.load_gaussians(tmp_path / "a.ply")
    np.testing.assert_allclose(found.sh[:, 0], (rgb / 255 - 0.5) / C0, atol=1e-5)
    write_ply(tmp_path / "a.ply", plys(PLAIN, **numbers), types=kinds)  # beside coefficients, they are a viewer's
    np.testing.assert_array_equal(jsecon.load_gaussians(tmp_path / "a.ply").sh, PLAIN["sh"].astype(np.float32))


@pytest.mark.parametrize("name", ["filter_3D", "filter_3d"])
def test_mip_splattings_filter_is_fused_as_it_fuses_it(tmp_path, name):
    width = np.random.default_rng(0).uniform(0.001, 0.3, 40)
    width[:2] = 0
    given = PLAIN | {"log_scales": PLAIN["log_scales"].copy()}
    given["log_scales"][:2, 2] = -np.inf
    write_ply(tmp_path / "a.ply", plys(given, **{name: width}))
    found = jsecon.load_gaussians(tmp_path / "a.ply")
    squares = np.exp(given["log_scales"]) ** 2
    fused = squares + width[:, None] ** 2
    np.testing.assert_allclose(np.exp(np.asarray(found.log_scales)), np.sqrt(fused), rtol=1e-5)
    ratio = np.where(width > 0, np.sqrt(squares.prod(1) / np.where(width > 0, fused.prod(1), 1)), 1)
    alpha = opacity({"opacity_logits": np.asarray(found.opacity_logits, np.float64)})
    np.testing.assert_allclose(alpha, opacity(PLAIN) * ratio, rtol=1e-4, atol=1e-9)
    write_ply(tmp_path / "a.ply", plys(PLAIN, filter_3D=np.where(np.arange(40) == 3, -1, width)))
    with refused("a.ply", "filter_3D are negative"):
        jsecon.load_gaussians(tmp_path / "a.ply")


@pytest.mark.parametrize("rest", [1, 3, 6, 12, 44, 48, 72])
def test_numbers_of_harmonics_of_no_whole_degree_are_named(tmp_path, rest):
    write_ply(tmp_path / "a.ply", ply_columns(rest=rest))
    with refused("a.ply", f"{rest} properties f_rest", "degree"):
        jsecon.load_gaussians(tmp_path / "a.ply")


@pytest.mark.parametrize("comment", ["SplatRenderMode: mip", "antialiased 1"])
def test_a_ply_that_was_trained_with_antialiasing_says_so(tmp_path, comment):
    write_ply(tmp_path / "a.ply", plys(PLAIN))
    plain = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(plain.replace(b"comment of mine", b"comment " + comment.encode()))
    with pytest.warns(UserWarning, match="antialiasing"):
        jsecon.load_gaussians(tmp_path / "a.ply")


# --- SuperSplat's compressed .ply


def test_a_compressed_ply_needs_the_bounds_of_colours(tmp_path):
    given = scene(600, 1)
    (tmp_path / "a.ply").write_bytes(splat_files.compressed_ply(given))
    compare(jsecon.load_gaussians(tmp_path / "a.ply"), given, STEPS["a.compressed.ply"])
    (tmp_path / "a.ply").write_bytes(splat_files.compressed_ply(given, colours=False))  # as SuperSplat 1 wrote it
    with refused("a.ply", "SuperSplat 2", "splat-transform"):
        jsecon.load_gaussians(tmp_path / "a.ply")


@pytest.mark.parametrize(("old", "new", "says"), [
    (b"float min_scale_x", b"float odd_scale_x", "SuperSplat 2"),
    (b"uint packed_color", b"ushort packed_color", "SuperSplat 2"),
    (b"element sh 600", b"element sh 599", "599 rows of harmonics for 600 Gaussians"),
    (b"uchar f_rest_8\n", b"uchar odd\n", "SuperSplat 2"), (b"binary_little_endian", b"ascii", "SuperSplat 2"),
])  # fmt: skip
def test_a_compressed_ply_of_another_kind_is_refused_by_name(tmp_path, old, new, says):
    whole = splat_files.compressed_ply(scene(600, 4))
    assert old in whole
    (tmp_path / "a.ply").write_bytes(whole.replace(old, new) + bytes(4000))
    with refused("a.ply", says):
        jsecon.load_gaussians(tmp_path / "a.ply")


# --- .glb


@pytest.mark.parametrize(("name", "code", "kind", "normalised"), [
    ("POSITION", 5122, "<i2", False), ("POSITION", 5120, "i1", True), (f"{NAME}:SCALE", 5121, "u1", True),
    (f"{NAME}:OPACITY", 5123, "<u2", True),
])  # fmt: skip
def test_whole_numbers_of_a_glb_are_read_as_its_accessor_says(tmp_path, name, code, kind, normalised):
    given = gaussians(scene(30, 4))
    jsecon.save_gaussians(tmp_path / "a.glb", given)
    columns = 1 if "OPACITY" in name else 3
    numbers = np.random.default_rng(0).integers(1, 100, (30, columns)).astype(kind)
    attach(tmp_path / "a.glb", name, code, numbers, normalised)
    found = jsecon.load_gaussians(tmp_path / "a.glb")
    shown = numbers / (np.iinfo(kind).max if normalised else 1)
    got = {
        "POSITION": np.asarray(found.means) * [-1, -1, 1],
        f"{NAME}:SCALE": np.exp(found.log_scales),
        f"{NAME}:OPACITY": opacity({"opacity_logits": np.asarray(found.opacity_logits, np.float64)})[:, None],
    }
    np.testing.assert_allclose(got[name], shown, rtol=1e-5)


def attach(path, name, code, numbers, normalised):
    """Puts an attribute's numbers behind all others of a .glb."""
    data = path.read_bytes()
    start = 28 + struct.unpack_from("<I", data, 12)[0]
    body = numbers.tobytes() + bytes(-numbers.nbytes % 4)
    path.write_bytes(data[: start - 8] + struct.pack("<I", len(data) - start + len(body)) + data[start - 4 :] + body)

    def change(told):
        told["extensionsRequired"] = ["KHR_mesh_quantization"]
        told["bufferViews"].append({"buffer": 0, "byteOffset": len(data) - start, "byteLength": len(body)})
        accessor = told["accessors"][told["meshes"][0]["primitives"][0]["attributes"][name]]
        accessor |= {"bufferView": len(told["bufferViews"]) - 1, "componentType": code, "normalized": normalised}

    rewritten(path, change)
