"""The fuzz harness tells what is wrong, and finds nothing wrong in any reader for as long as CI may take."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from fuzz_readers import READERS

ROOT = Path(__file__).resolve().parent.parent
pytestmark = pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="counts memory as Linux tells it")

ILL = """
import os, sys, time, warnings
from pathlib import Path
sys.path[:0] = ["tests"]
import numpy as np
from tests import fuzz
from jsecon.errors import InputError

fuzz.SECONDS, fuzz.SILENCE = 0.2, 5.0

def ill(act):
    def cases(folder):
        (folder / "a.bin").write_bytes(bytes(range(256)))

        class Case:
            files = [folder / "a.bin"]
            def read(self):
                return (folder / "a.bin").read_bytes() == bytes(range(256)) or act()
            def whole(self, found):
                assert found, "damage that was read"
        yield Case()
    return cases

def refuse():
    raise InputError("a.bin", "damage", "none", "Write it again.")

def work():
    until = time.process_time() + 0.3
    while time.process_time() < until:
        pass
    refuse()

readers = {
    "fine": refuse,
    "crash": lambda: os.kill(os.getpid(), 11),
    "hang": lambda: time.sleep(60),
    "slow": work,
    "large": lambda: np.zeros(1 << 40, np.uint8),
    "resident": lambda: (np.ones((3 << 29,), np.uint8), refuse()),
    "warning": lambda: (warnings.warn("of mine"), refuse()),
    "stderr": lambda: (os.write(2, b"libpng"), refuse()),
    "value": lambda: int("x"),
    "silent": lambda: False,
    "copied": lambda: (_ for _ in ()).throw(InputError("a.bin", "x", "y" * 9000, "z")),
}
sys.exit(fuzz.fuzzed({name: ill(act) for name, act in readers.items()}, fuzz.parsed(["--mutations", "1"])))
"""
FOUND = {
    "crash": "crash (signal 11)",
    "hang": "no end",
    "slow": "too long",
    "large": "memory",
    "resident": "memory",
    "warning": "a warning",
    "stderr": "said to stderr",
    "value": "another exception",
    "silent": "not whole",
    "copied": "an unreadable message",
}


def test_each_kind_of_ill_is_told():
    done = subprocess.run([sys.executable, "-c", ILL], capture_output=True, text=True, cwd=ROOT)
    told = dict(re.findall(r"^(\w+): 1 mutations: 1 (.*?);", done.stdout, re.MULTILINE))
    assert told == FOUND | {"fine": "refused"}, done.stdout + done.stderr
    assert done.returncode == 0, "fuzzed says that not all was fine, which is 0 to exit"


@pytest.mark.parametrize(
    "length", [("--mutations", "20"), pytest.param(("--seconds", "5", "--seed", "1"), marks=pytest.mark.long)]
)
def test_every_reader_stands_damage(length):
    """Longer, and by other seeds: python -m tests.fuzz."""
    done = subprocess.run([sys.executable, "-m", "tests.fuzz", *length], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    counts = re.findall(r"^\w+: (\d+) mutations", done.stdout, re.MULTILINE)
    assert len(counts) == len(READERS)
    assert min(map(int, counts)) >= 20, done.stdout
