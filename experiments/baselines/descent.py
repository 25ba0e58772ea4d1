"""Adam on one view per step, all views before any repeats: how every trained baseline is trained."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from jsecon.types import Array

_LEAST = 256
"""steps that the history has room for at least, powers of two above: schedules share their compiled programs"""


def descend(
    loss: Callable[[Any, Any, Array, Array, Array], Array],
    params: Any,
    data: Any,
    *,
    views: int,
    steps: int,
    optimizer: optax.GradientTransformation,
    scale: float = 1.0,
    key: Array,
) -> tuple[Any, Array]:
    """`steps` steps on loss(params, data, view, step, key); returns the parameters and the loss before each step.

    `loss` must be a module's function or a partial of one with hashable options: it is compiled once for each. `data`
    is passed through, never baked in, and so is `scale`, a factor on what `optimizer` makes of the gradient: stages of
    different rates share a program.
    """
    order_key, step_key = jax.random.split(key)
    rounds = jax.random.split(order_key, -(-steps // views)) if steps else jax.random.split(order_key, 1)
    order = jax.vmap(lambda k: jax.random.permutation(k, views))(rounds).reshape(-1)[:steps].astype(jnp.int32)
    room = max(_LEAST, 1 << (steps - 1).bit_length())
    order = jnp.pad(order, (0, room - steps))
    state = params, optimizer.init(params), jnp.zeros(room)
    state = _run(loss, optimizer, state, data, order, step_key, steps, scale)
    return state[0], state[2][:steps]


@functools.partial(jax.jit, static_argnums=(0, 1))
def _run(loss, optimizer, state, data, order, key, steps, scale):
    def step(index, state):
        params, moments, history = state
        value, gradient = jax.value_and_grad(loss)(params, data, order[index], index, jax.random.fold_in(key, index))
        updates, moments = optimizer.update(gradient, moments, params)
        updates = jax.tree.map(lambda update: scale * update, updates)
        return optax.apply_updates(params, updates), moments, history.at[index].set(value)

    return jax.lax.fori_loop(0, steps, step, state)
