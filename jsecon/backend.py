"""Does this jax compute right numbers here? Some releases do not, silently (jax issue 39103)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsecon.numerics import cosine, cosine_matrix, normalize

_ROWS = 40_000
"""inside the window of row counts where the fused matrix-vector product goes wrong (about 32,769 to 43,000 in
float32)"""

REMEDY = (
    "Set XLA_FLAGS=--xla_cpu_experimental_ynn_fusion_type= (empty value) before jax starts, or use jax 0.11 or newer "
    "(Python 3.12 or newer). Where the device is not a CPU, set JAX_PLATFORMS=cpu."
)
"""measured: issue 39103 is in 0.10.2, the newest for Python 3.11, and in none of 0.11.0 to 0.12.0.1"""


class BackendReport(NamedTuple):
    """What `check_backend` found."""

    platform: str
    """jax's default backend"""
    jax_version: str
    cosine_error: float
    """largest absolute error of jsecon's own cosines at 40,000 rows against NumPy float64"""
    matvec_error: float
    """the same for `max(T @ normalised row)` under jit and vmap: above 1e-3 where jax issue 39103 is present. jsecon
    never uses that form; code that is composed with it may."""

    @property
    def has_jax_39103(self) -> bool:
        return not self.matvec_error < 1e-3


def check_backend(*, strict: bool = False) -> BackendReport:
    """Compares jitted and vmapped cosines at 40,000 rows with NumPy float64; takes about a second.

    Raises RuntimeError where jsecon's own forms are wrong on this backend; with `strict`, also where the form that jax
    issue 39103 breaks is (relevant to code that composes jsecon's functions with its own). The error names the remedy.
    """
    rng = np.random.default_rng(0)
    texts, rows = rng.normal(size=(2, 3)), rng.normal(size=(_ROWS, 3))
    unit_rows, unit_texts = (a / np.linalg.norm(a, axis=1, keepdims=True) for a in (rows, texts))
    expected = (unit_rows @ unit_texts.T).max(1)
    error = lambda found: float(np.abs(np.asarray(found, np.float64) - expected).max())
    f, t = jnp.asarray(rows, jnp.float32), jnp.asarray(texts, jnp.float32)
    ours = [
        jax.jit(lambda f, t: cosine_matrix(f, t).max(1))(f, t),
        jax.jit(jax.vmap(lambda f, t: cosine(f[None], t).max(), in_axes=(0, None)))(f, t),
        jax.jit(lambda f, t: cosine(f[:, None], t[None]).max(1))(f, t),
    ]
    unit = normalize(t)
    broken = jax.jit(jax.vmap(lambda f: jnp.max(unit @ (f / jnp.linalg.norm(f)))))(f)
    report = BackendReport(jax.default_backend(), jax.__version__, max(map(error, ours)), error(broken))
    off, where = "check_backend: {} are off by {:.2g}", f"on {report.platform} with jax {jax.__version__}"
    if not report.cosine_error < 1e-5:
        told = off.format("cosines", report.cosine_error)
        raise RuntimeError(f"{told} {where}, expected at most 1e-5. {REMEDY}")
    if strict and report.has_jax_39103:
        told = off.format("vmapped matrix-vector products (jax issue 39103)", report.matvec_error)
        raise RuntimeError(f"{told} {where}, expected at most 1e-3. {REMEDY}")
    return report
