"""The files marked `as_shipped` test the machine code that users run, and the others another."""

import hashlib
import os
import struct
import subprocess
import sys
import time

import compiling
import jax
import jax.numpy as jnp
import pytest

pytestmark = pytest.mark.as_shipped


def machine_code(salt: float) -> set[str]:
    """Digests of the object files (64-bit ELF) of a program with a product, a reduction and a fusion; none where it was
    read from the disk. Each `salt` makes a program of its own."""
    program = jax.jit(lambda x: (jnp.exp(salt * x @ x.T).sum(1) / jnp.linalg.norm(x)).sum())
    data = program.lower(jnp.ones((64, 64))).compile().runtime_executable().serialize()
    found, at = set(), data.find(b"\x7fELF")
    while at >= 0:  # to the end of its section headers, which come last: offset, size of one, number
        (headers,), (size, number) = struct.unpack_from("<Q", data, at + 40), struct.unpack_from("<HH", data, at + 58)
        found.add(hashlib.sha256(data[at : at + headers + size * number]).hexdigest())
        at = data.find(b"\x7fELF", at + 1)
    return found


def test_files_as_shipped_run_the_code_of_a_process_without_our_flags():
    salt = time.time() % 1
    environ = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    environ.pop("JAX_COMPILATION_CACHE_DIR")
    code = f"from test_compiling import machine_code; print(*machine_code({salt}))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=os.path.dirname(__file__), env=environ, check=True, capture_output=True
    )
    shipped = machine_code(salt)
    assert len(shipped) > 1
    assert shipped == set(done.stdout.decode().split())
    compiling.choose(shipped=False)
    try:
        fast = machine_code(salt)
    finally:
        compiling.choose(shipped=True)
    assert fast, "what the disk keeps of one way was taken for the other"
    assert not fast & shipped
