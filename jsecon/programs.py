"""Programs whose traces stay on disk, so that a new process neither traces nor lowers them again.

jax's folder of compiled programs spares XLA's work alone. To trace and lower the programs of one question takes three
times as long as to read what XLA made of them.
"""

import contextlib
import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import export

import jsecon
from jsecon.errors import InputError
from jsecon.files import atomic_write
from jsecon.numerics import is_traced


def stored_jit(
    function: Callable,
    *,
    static_argnums: tuple[int, ...] = (),
    small_kernels: bool = False,
    compiler_options: dict[str, Any] | None = None,
) -> Callable:
    """Compiles a function like jax.jit, and keeps each trace in jax's folder of compiled programs, if there is one.

    Inside a trace, off the CPU, and for arrays that were put on a device, it is jax.jit.

    Args:
      function: Pure function of positional arguments. Its result holds arrays in tuples and records (`jsecon.types`),
        and named tuples that are registered with jax.export.
      static_argnums: As for jax.jit. A trace belongs to the repr of such an argument.
      small_kernels: Whether the function is made of many small kernels, as tile lists are. Without XLA's fusion
        emitters it then compiles in half of the time and runs as fast. Compositing, of few long ones, would run at a
        third of the speed.
      compiler_options: As for jax.jit, where the kernels are not small.

    Returns:
      The compiled function.
    """
    inlined = jax.jit(function, static_argnums=static_argnums)
    programs: dict[Any, Callable] = {}

    def options() -> dict[str, Any] | None:
        return _without_emitters() if small_kernels else compiler_options

    @functools.cache
    def compiled() -> Callable:
        return jax.jit(function, static_argnums=static_argnums, compiler_options=options())

    @functools.wraps(function)
    def call(*args):
        config: Any = jax.config
        folder = config.jax_compilation_cache_dir
        leaves, tree = jax.tree.flatten([arg for n, arg in enumerate(args) if n not in static_argnums])
        if is_traced(leaves):
            return inlined(*args)
        if folder is None or jax.default_backend() != "cpu" or any(map(_is_placed, leaves)):
            return compiled()(*args)
        types = [jax.typeof(leaf) for leaf in leaves]
        static = {n: repr(args[n]) for n in static_argnums}
        key = tree, str(static), tuple((t.shape, t.dtype, t.weak_type) for t in types), config.jax_enable_x64
        if key not in programs:

            def flat(*leaves):
                dynamic = iter(jax.tree.unflatten(tree, leaves))
                return function(*(arg if n in static_argnums else next(dynamic) for n, arg in enumerate(args)))

            text = f"{jax.__version__} {jax.default_backend()} {_source()} {function.__module__} {key}"
            name = f"{function.__name__}-{hashlib.blake2b(text.encode(), digest_size=16).hexdigest()}.trace"
            traced = _stored(Path(folder) / name, jax.jit(flat), types)

            def program(*leaves):
                return traced.call(*leaves)

            program.__name__ = function.__name__
            programs[key] = jax.jit(program, compiler_options=options())
        # A stored program commits its results to a device: a mesh could not take them. On a CPU this is no copy.
        return jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)), programs[key](*leaves))

    return call


def _stored(file: Path, function: Any, types: list[Any]) -> export.Exported:
    """Reads the trace of a function for arguments of some types, or makes and writes it."""
    with contextlib.suppress(OSError):
        data = file.read_bytes()
        checksum, trace = data[:16], data[16:]
        if _checksum(trace) == checksum:
            return export.deserialize(bytearray(trace))
    shapes = [jax.ShapeDtypeStruct(t.shape, t.dtype, weak_type=t.weak_type) for t in types]
    traced = export.export(function)(*shapes)
    data = bytes(traced.serialize())
    with contextlib.suppress(InputError), atomic_write(file) as temporary:  # a full disk
        temporary.write_bytes(_checksum(data) + data)
    return traced


@functools.cache
def _without_emitters() -> dict[str, bool] | None:
    """Returns the options of a program without fusion emitters; None if this release of XLA has no such option."""
    option = {"xla_cpu_use_fusion_emitters": False}
    try:
        jax.jit(lambda x: x, compiler_options=option).lower(np.float32(0)).compile()
    except jax.errors.JaxRuntimeError:
        return None
    return option


def _is_placed(leaf: Any) -> bool:
    """Whether an array was put on one device, or on several."""
    return isinstance(leaf, jax.Array) and leaf.committed


def _checksum(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=16).digest()


@functools.cache
def _source() -> str:
    """Hashes jsecon's source files."""
    digest = hashlib.blake2b(digest_size=16)
    for file in sorted(Path(jsecon.__file__).parent.rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()
