"""Gaussians of other programs' files, against files packed byte by byte here: each number within its format's step."""

import dataclasses
import struct
import sys

import numpy as np
import pytest
import splat_files
from capture_files import refused
from scipy.spatial.transform import Rotation
from splat_files import gaussians, opacity, scene, spz_record

from jsecon import Gaussians, load_gaussians, save_gaussians
from jsecon.read.splats import ply
from jsecon.read.splats.formats import read_gaussians
from jsecon.splat import transform

SCENE = scene(600, 4)
PLAIN = scene(600, 1)
FILES = {
    "a.compressed.ply": (splat_files.compressed_ply, SCENE),
    "two.SPZ": (lambda arrays: splat_files.spz(arrays, 2), SCENE),
    "three.spz": (lambda arrays: splat_files.spz(arrays, 3, fraction=16), SCENE),
    "four.spz": (lambda arrays: splat_files.spz(arrays, 4), SCENE),
    "a.sog": (splat_files.sog, PLAIN),
    "a.splat": (splat_files.splat, PLAIN),
}
STEPS = {  # of places, sizes (logarithm), opacities, constant and other harmonics; least cosine of an axis
    "a.compressed.ply": (8 / 1023, 7 / 1023, 1 / 255, 1.2 / 255 / 0.28, 1 / 32, 0.99999),
    "two.SPZ": (2**-12, 1 / 16, 1 / 255, 1 / 255 / 0.15, 1 / 128, 0.97),
    "three.spz": (2**-16, 1 / 16, 1 / 255, 1 / 255 / 0.15, 1 / 128, 0.99999),
    "four.spz": (2**-12, 1 / 16, 1 / 255, 1 / 255 / 0.15, 1 / 128, 0.99999),
    "a.sog": (6 * 3.2 / 65535, 7 / 255, 1 / 255, 3.4 / 255, 0, 0.9998),
    "a.splat": (1e-6, 1e-5, 1 / 255, 1 / 255 / 0.28, 0, 0.9998),
}


def compare(found: Gaussians, given: dict, steps: tuple) -> None:
    """Each number within half a step, and a little of float32."""
    place, size, alpha, colour, rest, turn = steps

    def near(a, b, step):
        return np.testing.assert_allclose(a, b, rtol=0, atol=0.51 * step + 2e-6)

    near(found.means, given["means"], place)
    near(found.log_scales, given["log_scales"], size)
    near(opacity({"opacity_logits": np.asarray(found.opacity_logits)}), opacity(given), alpha)
    near(found.sh[:, 0], given["sh"][:, 0], colour)
    near(found.sh[:, 1:], given["sh"][:, 1:], rest)
    a, b = (Rotation.from_quat(np.roll(q, -1, axis=1)).as_matrix() for q in (found.quaternions, given["quaternions"]))
    assert np.abs((a * b).sum(1)).min() > turn  # of each axis; its sign is free


@pytest.mark.parametrize("name", FILES)
def test_numbers_come_back_within_the_formats_steps(tmp_path, name):
    write, given = FILES[name]
    (tmp_path / name).write_bytes(write(given))
    found = load_gaussians(tmp_path / name)
    assert found.count == 600
    assert all(getattr(found, field.name).dtype == np.float32 for field in dataclasses.fields(found))
    compare(found, given, STEPS[name])


def test_blocks_of_any_size_give_the_same_bytes_in_another_world(tmp_path, monkeypatch):
    turn = np.diag([-2.0, -2.0, 2.0, 1.0])
    turn[:3, 3] = 1, 2, 3
    given, ids = gaussians(SCENE), {"ids": {"object_id": np.arange(600) % 7 - 1}}
    files = [tmp_path / f"{name}.ply" for name in ("whole", "blocks")]
    save_gaussians(files[0], given, **ids, similarity=turn)
    monkeypatch.setattr(ply, "BLOCK_ROWS", 77)
    save_gaussians(files[1], given, **ids, similarity=turn)
    assert files[0].read_bytes() == files[1].read_bytes()
    assert b"property double" not in files[0].read_bytes()  # as INRIA's readers expect an ordinary scene
    found, expected = load_gaussians(files[1]), transform.transform_gaussians(given, turn)
    for field in dataclasses.fields(found):
        own, other = (getattr(scene, field.name) for scene in (found, expected))
        signs = np.sign((own * other).sum(1, keepdims=True)) if field.name == "quaternions" else 1
        np.testing.assert_allclose(own * signs, other, rtol=1e-5, atol=1e-4)


SYSTEMS = "LDB RDB LUB RUB LDF RDF LUF RUF"


@pytest.mark.parametrize(("number", "name"), [*enumerate(SYSTEMS.split(), 1)])
@pytest.mark.parametrize("version", [3, 4])
def test_a_spz_is_turned_from_the_axes_that_it_names(tmp_path, number, name, version):
    axes = np.array([1 if letter in "RDF" else -1 for letter in name])
    records = spz_record(0xADBE0002, bytes(12)) + spz_record(0xADBE0003, struct.pack("<I", number))
    (tmp_path / "a.spz").write_bytes(splat_files.spz(SCENE, version, axes=axes, records=records))
    if axes.prod() < 0:
        with refused("a.spz", "left-handed"):
            load_gaussians(tmp_path / "a.spz")
    else:
        compare(load_gaussians(tmp_path / "a.spz"), SCENE, STEPS["four.spz"])


def test_flat_gaussians_and_none(tmp_path):
    flat = scene(50, 1) | {"log_scales": np.full((50, 3), -np.inf)}
    (tmp_path / "a.splat").write_bytes(splat_files.splat(flat))
    assert np.isneginf(load_gaussians(tmp_path / "a.splat").log_scales).all()
    with refused("none.usda", "no Gaussians to write"):
        save_gaussians(tmp_path / "none.usda", gaussians(scene(0, 1)))


@pytest.mark.parametrize(("name", "says"), [
    ("scene.ksplat", "npx @playcanvas/splat-transform scene.ksplat scene.ply"),
    ("meta.json", "npx @playcanvas/splat-transform meta.json meta.ply"), ("scene", "ends in no suffix"),
    ("scene.glb", "Export the scene as a .ply"),
])  # fmt: skip
def test_other_formats_say_what_to_run(tmp_path, name, says):
    (tmp_path / name).write_bytes(b"something")
    with refused(name, says, ".sog, .splat"):
        load_gaussians(tmp_path / name)


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "gsply", None)
    for name in ("a.sog", "three.spz", "a.compressed.ply"):
        (tmp_path / name).write_bytes(FILES[name][0](FILES[name][1]))
        with refused(name, "needs the package gsply", "pip install 'jsecon[formats]'"):
            load_gaussians(tmp_path / name)


def test_gaussians_that_cannot_be_drawn_are_left_out_of_compressed_files(tmp_path):
    data = bytearray(splat_files.splat(PLAIN))
    data[32 * 7 : 32 * 7 + 4] = np.float32(np.nan).tobytes()
    data[32 * 9 + 12 : 32 * 9 + 16] = np.float32(-1).tobytes()  # a size
    data[32 * 11 + 28 : 32 * 11 + 32] = bytes([128] * 4)  # a rotation of length 0
    (tmp_path / "a.splat").write_bytes(data)
    read, notes = read_gaussians(tmp_path / "a.splat")
    assert (read.count, "3 of 600 Gaussians" in notes[0]) == (597, True)
    data[: 32 * 300 : 32] = data[3 : 32 * 300 : 32] = b"\xff" * 300  # half of the file
    data[2 : 32 * 300 : 32] = b"\xff" * 300
    (tmp_path / "a.splat").write_bytes(data)
    with refused("a.splat", "not finite"):
        read_gaussians(tmp_path / "a.splat")
    null = splat_files.sog(PLAIN, change=lambda meta: meta["scales"]["codebook"].__setitem__(100, None))
    (tmp_path / "a.sog").write_bytes(null)
    read, notes = read_gaussians(tmp_path / "a.sog")
    assert 540 < read.count < 600
    assert f"{600 - read.count} of 600 Gaussians" in notes[0]
