"""How XLA compiles the tests' programs: fast by default, as in a user's process in files marked `as_shipped`.

XLA takes most of a test run's time. The fast options give slower programs with the same results up to rounding. Only
tests of the machine code that users run need the options of a user's process.
"""

import functools
import importlib.metadata
import threading

_KNOWN = tuple(map(int, importlib.metadata.version("jaxlib").split(".")[:2])) < (0, 12)
"""whether XLA knows the flag of its old emitters; an unknown flag ends the process"""
EMITTERS = {"xla_cpu_use_fusion_emitters": False} if _KNOWN else {}
FAST = {**EMITTERS, "xla_backend_optimization_level": 0, "xla_cpu_parallel_codegen_split_count": 1}
"""options of most programs: a fifth of XLA's CPU time with its defaults. They stand in XLA_FLAGS, so that subprocesses
compile fast too."""
SHIPPED = {
    **{name: True for name in EMITTERS},
    "xla_backend_optimization_level": 3,
    "xla_cpu_parallel_codegen_split_count": 32,
}
"""XLA's own defaults"""
LOOPS = {"xla_backend_optimization_level": 1}
"""options of programs that run hundreds of times: three times faster than FAST, for twice the compilation time"""
RUN_OFTEN = frozenset({"jit__step", "jit__epochs", "jit__descend"})
"""their names: the loops of alignment.py, autoencoder.py and distill.py. The fits of the tests take tens of steps."""
LOWERED = 200
"""programs that share a context of MLIR, which keeps their constants"""

ENVIRONMENT = " ".join(f"--{name}={str(value).lower()}" for name, value in FAST.items())
"""the part of XLA_FLAGS that makes all processes of a run compile fast"""

_state = {"shipped": False}


@functools.cache
def install() -> None:
    """Makes jax compile each further program of this process with the options of `choose`.

    MLIR's dialects are loaded once for LOWERED programs of a thread, which takes a tenth of a small program's time.
    jnp.asarray copies NumPy's arrays itself, in place of a program for each shape. And `stored_jit` stores one program
    of each function, see `_store_one`. Call it before modules are imported that use it.
    """
    import jax
    import jax._src.compiler as compiler
    import numpy as np
    from jax._src.interpreters import mlir
    from jax._src.lax import lax

    from jsecon import programs

    programs.stored_jit = _store_one(programs.stored_jit)

    if hasattr(lax, "stage_p"):  # of some versions of jax
        lax.stage_p.def_impl(lambda value: jax.device_put(value.copy() if isinstance(value, np.ndarray) else value))

    make_context, kept = mlir.make_ir_context, threading.local()

    def shared_context():
        kept.lowered = getattr(kept, "lowered", -1) + 1
        if kept.lowered % LOWERED == 0:
            kept.context = make_context()
        return kept.context

    mlir.make_ir_context = shared_context

    compile_or_read = compiler.compile_or_get_cached

    def chosen(backend, computation, devices, options, *rest):
        name = str(computation.operation.attributes["sym_name"]).strip('"')
        mine = SHIPPED if _state["shipped"] else LOOPS if name in RUN_OFTEN else {}
        if backend.platform == "cpu":  # a GPU's compiler does not know them
            options.env_option_overrides = list((mine | dict(options.env_option_overrides)).items())
        return compile_or_read(backend, computation, devices, options, *rest)

    compiler.compile_or_get_cached = chosen


def _store_one(stored_jit):
    """`stored_jit` that stores the trace of a function for the first shapes alone, and all of them if `shipped`.

    A stored program is lowered twice, a tenth of the time that it takes to be ready. For other shapes it is jax.jit.
    """
    import jax
    import numpy as np

    @functools.wraps(stored_jit)
    def store_one(function, *, static_argnums=()):
        stored, plain = (jitted(function, static_argnums=static_argnums) for jitted in (stored_jit, jax.jit))
        first = []

        @functools.wraps(function)
        def call(*args):
            shapes = [np.shape(leaf) for leaf in jax.tree.leaves(args)]
            first.extend([shapes] * (not first))
            return (stored if _state["shipped"] or shapes == first[0] else plain)(*args)

        return call

    return store_one


def choose(*, shipped: bool) -> None:
    """Sets the options of further programs: XLA's defaults if `shipped`, else FAST, with LOOPS for training loops.

    A change of `shipped` clears the compiled programs.
    """
    import jax

    if _state["shipped"] != shipped:
        _state["shipped"] = shipped
        jax.clear_caches()
