"""Whatever can be drawn can be stored, and nothing else: one check for the renderer, for files and for fields."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsecon
from jsecon.splat.project import check_gaussians


@pytest.fixture(scope="module")
def field(field):
    return jax.tree.map(np.asarray, field)


def changed(scene, **columns):
    """The scene with the first Gaussian's numbers replaced."""
    scene = jax.tree.map(np.array, scene)
    for name, value in columns.items():
        getattr(scene, name)[0] = value
    return scene


@pytest.mark.parametrize("count", [0, 2, 3, 5, 25])
def test_harmonics_of_no_whole_degree_are_refused_everywhere(scene, camera, field, tmp_path, count):
    odd = dataclasses.replace(scene, sh=np.resize(scene.sh, (scene.count, count, 3)))
    ways = [
        lambda: check_gaussians(odd, camera),
        lambda: jsecon.render_rgb(odd, camera),
        lambda: jax.jit(jsecon.render_rgb)(odd, camera),
        lambda: jsecon.save_field(tmp_path / "f.safetensors", dataclasses.replace(field, gaussians=odd)),
        lambda: jsecon.save_gaussians(tmp_path / "a.ply", odd),
    ]
    for way in ways:
        with pytest.raises(ValueError, match=r"sh|harmonics"):
            way()
    assert not list(tmp_path.iterdir())


FLAT = {"log_scales": [-1.5, -1.0, -np.inf]}
HELD = {
    "flat": FLAT,
    "a point": {"log_scales": -np.inf},
    "opaque": {"opacity_logits": np.inf},
    "transparent": {"opacity_logits": -np.inf},
}
REFUSED = [
    *(("means", np.nan), ("means", np.inf), ("log_scales", np.inf), ("log_scales", np.nan)),
    *(("quaternions", 0.0), ("quaternions", np.nan), ("opacity_logits", np.nan), ("sh", np.nan)),
]


@pytest.mark.parametrize("how", HELD)
def test_what_can_be_drawn_comes_back_from_fields_and_files(scene, camera, field, tmp_path, how):
    odd = changed(scene, **HELD[how])
    drawn = jsecon.render_rgb(odd, camera).features
    assert np.isfinite(np.asarray(drawn)).all()
    jsecon.save_field(tmp_path / "f.safetensors", dataclasses.replace(field, gaussians=odd))
    jsecon.check_field(tmp_path / "f.safetensors")
    jsecon.save_gaussians(tmp_path / "a.ply", odd)
    for found in (jsecon.load_field(tmp_path / "f.safetensors").gaussians, jsecon.load_gaussians(tmp_path / "a.ply")):
        jax.tree.map(np.testing.assert_array_equal, found, odd)


@pytest.mark.parametrize(("name", "value"), REFUSED)
def test_what_load_refuses_is_not_written(scene, field, tmp_path, name, value):
    odd = changed(scene, **{name: value})
    with pytest.raises(ValueError, match=name):
        jsecon.save_field(tmp_path / "f.safetensors", dataclasses.replace(field, gaussians=odd))
    for ending in ("ply", "usda"):
        with pytest.raises(jsecon.InputError, match=name):
            jsecon.save_gaussians(tmp_path / f"a.{ending}", odd)
    assert not list(tmp_path.iterdir())


def test_a_batch_of_cameras_is_gone_over_and_a_single_one_is_not(cameras):
    views = list(jax.tree.map(jnp.asarray, cameras))
    assert len(cameras) == len(views) == 4
    for t, view in enumerate(views):
        np.testing.assert_array_equal(view.world_to_camera, cameras.world_to_camera[t])
    for act in (iter, len):
        with pytest.raises(TypeError, match="single camera"):
            act(cameras[0])
