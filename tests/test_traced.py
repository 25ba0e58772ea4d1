"""Pure functions inside a jit that closes over their arguments: all that they compute there is traced, they are not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_field import REGIONS, make_field

import jsecon


@pytest.fixture(scope="module")
def made(scene, cameras):
    return make_field(scene, cameras)


def calls(field, labels):
    """name -> a call of each pure public function on concrete arrays."""
    scene, cameras, camera = field.gaussians, field.cameras, field.cameras[0]
    text = field.regions.embeddings[0]
    features = jnp.ones((scene.count, 2))

    def by_view():
        return jsecon.region_votes(scene, cameras, labels, REGIONS, by_view=True)

    def autoencoder():
        return jsecon.train_autoencoder(field.regions.embeddings, latent=2, key=jax.random.key(0), epochs=1)

    codes, mask = field.codes.gaussians, np.arange(scene.count) < 9
    boxes = [np.array([[0.0, 0.0, 2.0, 2.0]])]
    descent = {"steps": 1, "key": jax.random.key(0)}
    return {
        "project": lambda: jsecon.project(scene, camera),
        "plan_view": lambda: jsecon.plan_view(scene, camera),
        "render_plan": lambda: jsecon.render_plan(jsecon.plan_view(scene, camera), features),
        "render": lambda: jsecon.render(scene, camera, features, depth=True),
        "render_rgb": lambda: jsecon.render_rgb(scene, camera, background=jnp.ones(3)),
        "render_depth": lambda: jsecon.render_depth(scene, camera),
        "region_votes": by_view,
        "normalise_votes": lambda: jsecon.normalise_votes(by_view(), field.regions),
        "membership_probability": lambda: jsecon.membership_probability(jnp.full(scene.count, 0.5), field.votes),
        "distill_votes": lambda: jsecon.distill_votes(field.votes, field.codes.regions),
        "distill_l1": lambda: jsecon.distill_l1(scene, cameras, labels, field.codes.regions, **descent),
        "match_regions": lambda: jsecon.match_regions(field, field.regions.embeddings[:2]),
        "select_gaussians": lambda: jsecon.select_gaussians(
            field, jsecon.match_regions(field, field.regions.embeddings)
        ),
        "query_anchored": lambda: jsecon.query_anchored(field, text),
        "query_region": lambda: jsecon.query_region(field, 1),
        "query_several": lambda: jsecon.query_several(field, field.regions.embeddings[:2]),
        "query_classes": lambda: jsecon.query_classes(field, field.regions.embeddings[:2]),
        "query_one_step": lambda: jsecon.query_one_step(codes, codes[0], 0.5),
        "query_canonical": lambda: jsecon.query_canonical(codes, codes[0], codes[1:3], 0.5),
        "encode": lambda: jsecon.encode(autoencoder(), field.regions.embeddings),
        "selection_mask": lambda: jsecon.selection_mask(scene, camera, mask),
        "iou": lambda: jsecon.iou(mask, ~mask),
        "mean_iou": lambda: jnp.asarray(jsecon.mean_iou([0.5, None])),
        "accuracy_at": lambda: jnp.asarray(jsecon.accuracy_at([0.5, None])),
        "localization_accuracy": lambda: jnp.asarray(jsecon.localization_accuracy([(1.0, 1.0)], boxes)),
        "train_autoencoder": autoencoder,
    }


HOST = {
    *("to_html", "masklets", "check_backend", "load_capture", "load_gaussians"),
    *("save_gaussians", "check_field", "locate"),
    *("load_field", "save_field", "region_embeddings", "host_mesh", "lift", "remove_outliers"),
    *("region_at", "plan_capacity", "objects", "object_shapes", "open_scene"),
}
"""public functions that read files or need numbers, as they say"""


def test_every_pure_function_can_be_traced_on_arrays_that_are_closed_over(made):
    found = calls(*made)
    types = {name for name in jsecon.__all__ if isinstance(getattr(jsecon, name), type)}
    assert set(found) == set(jsecon.__all__) - HOST - types
    for call in found.values():
        jax.eval_shape(call)  # as jit does, without the compilation


def test_labels_that_are_no_regions_are_refused(made):
    field, labels = made
    given, most = (field.gaussians, field.cameras), REGIONS - 1
    functions = {
        "region_votes": lambda labels, count: jsecon.region_votes(*given, labels, count),
        "distill_l1": lambda labels, count: jsecon.distill_l1(
            *given, labels, field.codes.regions[:count], steps=1, key=jax.random.key(0)
        ),
        "region_embeddings": lambda labels, count: jsecon.region_embeddings(
            np.zeros((*labels.shape, 3), np.uint8), labels, lambda _, masks: np.ones((len(masks), 2)), num_regions=count
        ),
    }
    for call in functions.values():
        with pytest.raises(ValueError, match=f"labels: got a label of {most}, expected labels below {most}"):
            call(labels, most)
        with pytest.raises(ValueError, match="labels: got float32, expected integers"):
            call(labels.astype(np.float32), REGIONS)


def test_a_background_of_another_size_is_refused(made):
    field, _ = made
    scene, camera = field.gaussians, field.cameras[0]
    plan, features = jsecon.plan_view(scene, camera), jnp.ones((scene.count, 2))
    for call, expected in (
        (lambda: jsecon.render(scene, camera, features, background=jnp.ones(3)), r"got \(3,\), expected \(2,\)"),
        (lambda: jsecon.render_plan(plan, features, background=jnp.ones((2, 1))), r"got \(2, 1\), expected \(2,\)"),
        (lambda: jsecon.render_rgb(scene, camera, background=jnp.ones(4)), r"got \(4,\), expected \(3,\)"),
    ):
        with pytest.raises(ValueError, match=f"background: {expected}"):
            call()
