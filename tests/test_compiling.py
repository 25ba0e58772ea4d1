"""Tests of the machine code that users run pass in a process that compiles as theirs does."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from compiling import is_shipped

TESTS = Path(__file__).parent
FILES = [path.name for path in sorted(TESTS.glob("test_*.py")) if re.search("as_shipped|MANY\\b", path.read_text())]


@pytest.mark.skipif(is_shipped(), reason="this process compiles as shipped itself")
@pytest.mark.parametrize("length", ["not long", pytest.param("long", marks=pytest.mark.long)])
def test_tests_as_shipped_pass_with_xlas_own_options(length):
    environ = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    line = [sys.executable, "-m", "pytest", "-n", "0", "-m", f"as_shipped and {length}", *FILES]
    done = subprocess.run(line, cwd=TESTS, env=environ, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-4000:]
