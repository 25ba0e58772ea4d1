"""How XLA compiles the tests' programs: fast, by flags in the environment, which subprocesses have too.

XLA takes most of a test run's time. These flags take a fifth of its CPU time with its defaults, and give slower
programs with the same results up to rounding. Tests of the machine code that users run are marked `as_shipped`;
test_compiling.py runs them in a process without these flags.
"""

import importlib.metadata
import os

FAST = {"xla_backend_optimization_level": "0", "xla_cpu_parallel_codegen_split_count": "1"}
if tuple(map(int, importlib.metadata.version("jaxlib").split(".")[:2])) < (0, 12):  # an unknown flag ends the process
    FAST["xla_cpu_use_fusion_emitters"] = "false"
ENVIRONMENT = " ".join(f"--{name}={value}" for name, value in FAST.items())
"""the part of XLA_FLAGS that makes all processes of a run compile fast"""


def is_shipped() -> bool:
    """Whether this process compiles as a user's does."""
    return "xla_backend_optimization_level" not in os.environ.get("XLA_FLAGS", "")
