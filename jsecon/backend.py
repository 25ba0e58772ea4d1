"""Starts jax's devices, and checks that jax computes right numbers on them: some releases do not (jax issue 39103)."""

from typing import Any

import jax
import jax.extend.backend
import jax.numpy as jnp
import numpy as np

from jsecon.errors import InputError, describe_error
from jsecon.numerics import cosine, cosine_matrix

REMEDY = (
    "Set XLA_FLAGS=--xla_cpu_experimental_ynn_fusion_type= (empty value) before jax starts, or use jax 0.11 or newer "
    "(Python 3.12 or newer). Where the device is not a CPU, set JAX_PLATFORMS=cpu."
)
"""measured: jax 0.10.2, the newest for Python 3.11, has issue 39103; 0.11.0 to 0.12.0.1 do not"""


def start_backend() -> None:
    """Starts jax's devices, or raises InputError with the variable that asks for devices which this jax lacks."""
    try:
        jax.devices()
    except Exception as error:  # jax raises RuntimeError, and AssertionError for a platform whose plugin is missing
        jax.extend.backend.clear_backends()  # else the next call takes the ones that did start
        config: Any = jax.config
        for name in ("jax_platforms", "jax_platform_name"):
            if (value := config.values[name]) not in (None, "", "cpu"):
                problem = f"it asks for {value!r}, which this jax does not have"
                raise InputError(name.upper(), problem, remedy=f"Unset it, or set {name.upper()}=cpu.") from error
        raise InputError("jax", f"it cannot start ({describe_error(error)})", remedy="Run jsecon doctor.") from error


def check_backend() -> float:
    """Compares jitted and vmapped cosines at 40,000 rows with NumPy float64, in about a second.

    Returns:
      The largest absolute error of jsecon's cosines.

    Raises:
      RuntimeError: The numbers are wrong on this backend. The message names the remedy.
    """
    rng = np.random.default_rng(0)
    texts, rows = rng.normal(size=(2, 3)), rng.normal(size=(40_000, 3))  # wrong at about 32,769 to 43,000
    unit_rows, unit_texts = (a / np.linalg.norm(a, axis=1, keepdims=True) for a in (rows, texts))
    expected = (unit_rows @ unit_texts.T).max(1)

    def error(values):
        return float(np.abs(np.asarray(values, np.float64) - expected).max())

    f, t = jnp.asarray(rows, jnp.float32), jnp.asarray(texts, jnp.float32)
    ours = [
        jax.jit(lambda f, t: cosine_matrix(f, t).max(1))(f, t),
        jax.jit(jax.vmap(lambda f, t: cosine(f[None], t).max(), in_axes=(0, None)))(f, t),
        jax.jit(lambda f, t: cosine(f[:, None], t[None]).max(1))(f, t),
    ]
    largest = max(map(error, ours))
    if not largest < 1e-5:
        problem = f"cosines are off by {largest:.2g} on {jax.default_backend()} with jax {jax.__version__}"
        raise RuntimeError(f"check_backend: {problem}, expected at most 1e-5. {REMEDY}")
    return largest
