"""Traces on disk: a new process runs the stored program, to the same bits, and nothing else is taken for it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import NamedSharding, PartitionSpec

from jsecon import host_mesh
from jsecon.programs import stored_jit


@pytest.fixture
def folder(tmp_path):
    """An empty folder of compiled programs."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


def counted(small_kernels=False):
    """A stored program, and the list that its traces grow."""
    traces = []

    def scaled(x, factor, power):
        traces.append(power)
        return {"y": factor * x**power}

    return stored_jit(scaled, static_argnums=(2,), small_kernels=small_kernels), traces


@pytest.mark.parametrize("small_kernels", [False, True])
def test_the_next_process_does_not_trace(folder, small_kernels):
    x = np.linspace(0, 1, 5, dtype=np.float32)
    for repeat in range(2):  # each `counted` has programs of its own, like a process
        run, traces = counted(small_kernels)
        np.testing.assert_array_equal(run(x, 2.0, 3)["y"], jax.jit(lambda x: 2.0 * x**3)(x))
        np.testing.assert_array_equal(run(x, 3.0, 3)["y"], jax.jit(lambda x: 3.0 * x**3)(x))
        assert traces == ([] if repeat else [3])
    assert len(list(folder.glob("scaled-*.trace"))) == 1


def test_other_types_and_options_are_other_programs(folder):
    run, traces = counted()
    x = jnp.ones(4, jnp.bfloat16)
    assert run(x, 2.0, 2)["y"].dtype == jnp.bfloat16  # 2.0 has no type of its own
    assert run(x, np.float32(2), 2)["y"].dtype == jnp.float32
    run(jnp.ones(5), 2.0, 3)
    with jax.enable_x64(True):
        assert run(np.ones(5), 2.0, 3)["y"].dtype == np.float64
    assert traces == [2, 2, 3, 3]


@pytest.mark.parametrize("small_kernels", [False, True])
def test_inside_of_a_trace_it_is_an_ordinary_function(folder, small_kernels):
    run, _ = counted(small_kernels)
    slope = jax.vmap(jax.grad(lambda x: run(x, 2.0, 2)["y"]))(jnp.arange(3.0))
    np.testing.assert_array_equal(slope, [0, 4, 8])
    assert not list(folder.glob("*.trace"))


@pytest.mark.parametrize("cut", [0, 20, -1])
def test_a_damaged_trace_is_made_again(folder, cut):
    x = np.ones(3, np.float32)
    run, _ = counted()
    run(x, 2.0, 2)
    (file,) = folder.glob("*.trace")
    file.write_bytes(file.read_bytes()[:cut])
    for expected in ([2], []):
        run, traces = counted()
        np.testing.assert_array_equal(run(x, 2.0, 2)["y"], 2 * x)
        assert traces == expected


def test_a_folder_that_cannot_be_written_costs_only_time(folder):
    jax.config.update("jax_compilation_cache_dir", str(folder / "file"))
    (folder / "file").write_text("in the way")
    run, traces = counted()
    for _ in range(2):
        run(np.ones(3, np.float32), 2.0, 2)
    assert traces == [2]


def test_a_result_goes_on_to_several_devices_and_a_placed_array_stays_where_it_is(folder):
    run, _ = counted()
    x = np.arange(4, dtype=np.float32)
    spread = jax.device_put(x, NamedSharding(host_mesh(), PartitionSpec()))
    np.testing.assert_array_equal(jnp.add(run(x, 2.0, 2)["y"], spread), 2 * x**2 + x)
    last = jax.devices()[-1]
    assert run(jax.device_put(x, last), 2.0, 2)["y"].devices() == {last}
