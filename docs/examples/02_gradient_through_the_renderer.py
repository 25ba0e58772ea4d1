"""Differentiate a rendered image with respect to the scene, and check the gradient by central differences.

Run: python docs/examples/02_gradient_through_the_renderer.py [FIELD]
"""

import dataclasses
import sys

import jax
import jax.numpy as jnp

import jsecon

field = jsecon.load_field(sys.argv[1] if len(sys.argv) > 1 else "jsecon-demo/field.safetensors")
gaussians, camera = field.gaussians, jax.tree.map(jnp.asarray, field.cameras[0])
target = jsecon.render_rgb(gaussians, camera).features


@jax.jit
def loss(change):
    """Mean squared error of a frame of a scene with other colours (3) and another opacity (1)."""
    other = dataclasses.replace(
        gaussians, sh=gaussians.sh.at[:, 0].add(change[:3]), opacity_logits=gaussians.opacity_logits + change[3]
    )
    return jnp.mean(jnp.square(jsecon.render_rgb(other, camera).features - target))


at = jnp.array([0.3, -0.2, 0.1, -1.0])
value_and_gradient = jax.jit(jax.value_and_grad(loss))
value, gradient = value_and_gradient(at)
STEP = 0.01
differences = jnp.stack([(loss(at + row) - loss(at - row)) / (2 * STEP) for row in STEP * jnp.eye(4)])
print(f"loss {value:.5f}, gradient {gradient}, central differences {differences}")

for _ in range(30):  # down to the target again
    at = at - 4.0 * value_and_gradient(at)[1]
print(f"loss after 30 steps {loss(at):.7f}")

assert jnp.abs(gradient - differences).max() < 0.02 * jnp.abs(gradient).max()
assert loss(at) < 0.2 * value
