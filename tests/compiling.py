"""How XLA compiles the tests' programs: fast, and as in a user's process in files marked `as_shipped`.

Most of a test run's time is XLA's. What these options leave out is the speed of the programs, and nothing of what they
compute beyond rounding. It matters to few tests: those whose claim is about the code that is shipped.
"""

import functools
import importlib.metadata

_KNOWN = tuple(map(int, importlib.metadata.version("jaxlib").split(".")[:2])) < (0, 12)
"""whether XLA still knows its old emitters: an unknown flag ends the process"""
EMITTERS = {"xla_cpu_use_fusion_emitters": False} if _KNOWN else {}
FAST = {
    **EMITTERS,
    "xla_backend_optimization_level": 0,
    "xla_cpu_parallel_codegen_split_count": 1,
}
"""for most programs: a fifth of the CPU time that XLA takes as shipped. In XLA_FLAGS, so that the processes which tests
start find on disk what is compiled already."""
SHIPPED = {
    **{name: True for name in EMITTERS},
    "xla_backend_optimization_level": 3,
    "xla_cpu_parallel_codegen_split_count": 32,
}
"""XLA's own defaults"""
LOOPS = {"xla_backend_optimization_level": 1}
"""for programs that are run hundreds of times: three times faster than FAST, for twice the compilation. Not in files
marked `few_steps`"""
RUN_OFTEN = frozenset({"jit_step", "jit__step", "jit__epochs", "jit__descend", "jit__run"})
"""their names: the training loops"""

ENVIRONMENT = " ".join(f"--{name}={str(value).lower()}" for name, value in FAST.items())
"""the part of XLA_FLAGS that makes all processes of a run compile fast"""

_state = {"shipped": False, "loops": True}


@functools.cache
def install() -> None:
    """From now on jax compiles each program of this process by what is chosen below."""
    import jax._src.compiler as compiler

    compile_or_read = compiler.compile_or_get_cached

    def chosen(backend, computation, devices, options, *rest):
        name = str(computation.operation.attributes["sym_name"]).strip('"')
        mine = SHIPPED if _state["shipped"] else LOOPS if name in RUN_OFTEN and _state["loops"] else {}
        if backend.platform == "cpu":  # a GPU's compiler does not know them
            options.env_option_overrides = list((mine | dict(options.env_option_overrides)).items())
        return compile_or_read(backend, computation, devices, options, *rest)

    compiler.compile_or_get_cached = chosen


def choose(*, shipped: bool, loops: bool = True) -> None:
    """Programs compiled from now on are those of a process without our flags, or fast ones, `loops` among them as
    LOOPS says. What was compiled otherwise is forgotten; on disk, jax's own keys tell them apart."""
    import jax

    _state["loops"] = loops
    if _state["shipped"] != shipped:
        _state["shipped"] = shipped
        jax.clear_caches()
