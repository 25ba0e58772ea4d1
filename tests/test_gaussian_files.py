"""Gaussians of other programs' files, against files packed byte by byte here: each number within its format's step."""

import dataclasses
import json
import sys
import zipfile

import jax
import numpy as np
import pytest
import splat_files
from capture_files import refused
from scipy.spatial.transform import Rotation
from splat_files import RUB, opacity, scene

from jsecon import Camera, Gaussians, load_gaussians, render_rgb, save_gaussians
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


def gaussians(arrays: dict) -> Gaussians:
    return Gaussians(**{name: array.astype(np.float32) for name, array in arrays.items()})


def image(scene: Gaussians) -> np.ndarray:
    pose = np.eye(4, dtype=np.float32)
    pose[:3, 3] = -1, -1, 9
    camera = Camera(pose, *(np.float32(v) for v in (60, 60, 40, 30)), width=80, height=60)
    return np.asarray(jax.jit(render_rgb)(scene, camera).features)


def psnr(a: Gaussians, b: Gaussians) -> float:
    return float(-10 * np.log10(np.mean((image(a) - image(b)) ** 2)))


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
    assert psnr(found, gaussians(given)) > 35


def test_a_spz_is_turned_from_its_makers_axes_and_back(tmp_path):
    """Niantic's words: right, up, back, where a .ply is right, down, front: y and z change their signs."""
    import gsply

    save_gaussians(tmp_path / "a.spz", gaussians(SCENE))
    stored = gsply.read_spz(tmp_path / "a.spz")
    np.testing.assert_allclose(stored.means, SCENE["means"] * RUB, atol=2**-16)
    compare(load_gaussians(tmp_path / "a.spz"), SCENE, STEPS["three.spz"])


@pytest.mark.parametrize("ending", ["ply", "glb"])
def test_blocks_of_any_size_give_the_same_bytes_in_another_world(tmp_path, monkeypatch, ending):
    turn = np.diag([-2.0, -2.0, 2.0, 1.0])
    turn[:3, 3] = 1, 2, 3
    given, ids = gaussians(SCENE), {"object_ids": np.arange(600) % 7 - 1}
    files = [tmp_path / f"{name}.{ending}" for name in ("whole", "blocks")]
    save_gaussians(files[0], given, **ids, similarity=turn)
    monkeypatch.setattr(transform, "BLOCK_ROWS", 77)
    save_gaussians(files[1], given, **ids, similarity=turn)
    assert files[0].read_bytes() == files[1].read_bytes()
    found, expected = load_gaussians(files[1]), transform.transform_gaussians(given, turn)
    for field in dataclasses.fields(found):
        own, other = (getattr(scene, field.name) for scene in (found, expected))
        signs = np.sign((own * other).sum(1, keepdims=True)) if field.name == "quaternions" else 1
        np.testing.assert_allclose(own * signs, other, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("basis", [1, 4, 9, 16])
def test_a_spz_holds_harmonics_of_every_degree(tmp_path, basis):
    given = scene(600, basis)
    save_gaussians(tmp_path / "a.spz", gaussians(given))
    found = load_gaussians(tmp_path / "a.spz")
    compare(found, given, STEPS["three.spz"])
    assert basis == 9 or psnr(found, gaussians(given)) > 35


def test_a_spz_of_sure_opacities_and_of_nothing(tmp_path):
    sure = scene(50, 1) | {"opacity_logits": np.repeat([-np.inf, np.inf], 25)}
    save_gaussians(tmp_path / "a.spz", gaussians(sure))
    alpha = opacity({"opacity_logits": np.asarray(load_gaussians(tmp_path / "a.spz").opacity_logits)})
    np.testing.assert_allclose(alpha, [0] * 25 + [1] * 25, atol=2e-6)
    with refused("none.spz", "no Gaussians to write"):
        save_gaussians(tmp_path / "none.spz", gaussians(scene(0, 1)))


def test_too_few_chunks_of_a_compressed_ply_and_a_short_codebook_of_a_sog(tmp_path):
    few = splat_files.compressed_ply(SCENE).replace(b"element chunk 3", b"element chunk 2")
    (tmp_path / "a.ply").write_bytes(few)
    with refused("a.ply", "damaged"):
        load_gaussians(tmp_path / "a.ply")
    (tmp_path / "whole.sog").write_bytes(splat_files.sog(PLAIN))
    with zipfile.ZipFile(tmp_path / "whole.sog") as whole, zipfile.ZipFile(tmp_path / "a.sog", "w") as short:
        for name in whole.namelist():
            data = whole.read(name)
            if name == "meta.json":
                told = json.loads(data)
                told["scales"]["codebook"] = told["scales"]["codebook"][:9]
                data = json.dumps(told)
            short.writestr(name, data)
    with refused("a.sog", "fewer than 256"):
        load_gaussians(tmp_path / "a.sog")


@pytest.mark.parametrize(("name", "says"), [
    ("scene.ksplat", "npx @playcanvas/splat-transform scene.ksplat scene.ply"),
    ("meta.json", "npx @playcanvas/splat-transform meta.json meta.ply"), ("scene", "ends in no suffix"),
    ("scene.gltf", "one .glb file"), ("scene.obj", "Export the scene as a .ply"),
])  # fmt: skip
def test_other_formats_say_what_to_run(tmp_path, name, says):
    (tmp_path / name).write_bytes(b"something")
    with refused(name, says, ".spz, .sog or .splat"):
        load_gaussians(tmp_path / name)


def test_missing_files_endings_and_packages(tmp_path, monkeypatch):
    for name in ("none.ply", "none.spz", "none.splat", "none.glb"):
        with refused(name, "no such file"):
            load_gaussians(tmp_path / name)
    with refused("scene.sog", ".ply or .spz or .glb", "splat-transform"):
        save_gaussians(tmp_path / "scene.sog", gaussians(SCENE))
    (tmp_path / "a.sog").write_bytes(splat_files.sog(PLAIN))
    monkeypatch.setitem(sys.modules, "gsply", None)
    for name in ("a.sog", "three.spz", "a.compressed.ply"):
        (tmp_path / name).write_bytes(FILES[name][0](FILES[name][1]))
        with refused(name, "needs the package gsply", "pip install 'jsecon[formats]'"):
            load_gaussians(tmp_path / name)
    with refused("b.spz", "pip install 'jsecon[formats]'"):
        save_gaussians(tmp_path / "b.spz", gaussians(SCENE))
    (tmp_path / "a.splat").write_bytes(FILES["a.splat"][0](PLAIN))
    assert load_gaussians(tmp_path / "a.splat").count == 600
    save_gaussians(tmp_path / "a.ply", gaussians(SCENE))
    assert load_gaussians(tmp_path / "a.ply").count == 600


def test_a_splat_without_size_or_turn(tmp_path):
    whole = bytearray(splat_files.splat(PLAIN))
    whole[12:16] = bytes(4)
    (tmp_path / "a.splat").write_bytes(whole)
    assert np.isneginf(load_gaussians(tmp_path / "a.splat").log_scales[0, 0])  # flat
    whole[12:16] = np.float32(-1).tobytes()
    (tmp_path / "a.splat").write_bytes(whole)
    with refused("log_scales of 1 of 600"):
        load_gaussians(tmp_path / "a.splat")
    whole = bytearray(splat_files.splat(PLAIN))
    whole[28:32] = bytes([128] * 4)
    (tmp_path / "a.splat").write_bytes(whole)
    with refused("quaternions of 1 of 600", "zero"):
        load_gaussians(tmp_path / "a.splat")
