"""Every reader in a folder of an odd name, on whole, empty and damaged files: it refuses each with an InputError, or
returns a well-formed result.

Longer, with other seeds:

    FUZZ_MUTATIONS=10000 FUZZ_SEED=1 pytest -m long tests/test_fuzz.py
"""

import os
import re
import time
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
from fuzz_readers import READERS, cases, check_result
from mutations import damaged

from jsecon.errors import InputError

resource = pytest.importorskip("resource")
SEED = int(os.environ.get("FUZZ_SEED", 0))
MUTATIONS = int(os.environ.get("FUZZ_MUTATIONS", 200))
SECONDS = 30.0
"""CPU time that a reader's own thread may take for one file: tenths of a second, but minutes where it believes the
counts of a damaged header. The process as a whole may spend more, for instance on threads that other tests left."""
TIMES, MORE = 10, 1 << 30
"""memory that a reader may take: a multiple of the file's size, plus bytes"""
LONGEST_MESSAGE = 2500
HIDDEN = ResourceWarning, DeprecationWarning, PendingDeprecationWarning, ImportWarning
ODD_NAME = "Gr\xf6\xdfe [1] * 50%, \u6e2c\u8a66 'x'"
"""with signs of patterns, of lists and of other alphabets; names that are not UTF-8: test_names"""


def read_and_check(case, size, capfd):
    """Reads the files of a case within the limits of time and memory, without a warning or a line on stderr. True if
    they are refused."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + TIMES * size + MORE, hard))
    began, refused = time.thread_time(), False
    try:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            for category in HIDDEN:
                warnings.simplefilter("ignore", category)
            warnings.filterwarnings("ignore", module=r"PIL\.")  # of odd entries of a TIFF or an EXIF
            check_result(case.read())
    except InputError as error:
        refused, text, remedy = True, str(error), error.remedy
        assert remedy
        assert len(text) <= LONGEST_MESSAGE
        assert not re.search("nsufficient memory|bad.alloc|MemoryError|nable to allocate", text), text
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    assert time.thread_time() - began <= SECONDS
    assert not warned, warned[0]
    err = capfd.readouterr().err
    # libtiff writes there, whoever calls it, and so does the Rust of tokenizers when it panics.
    assert err == "" or case.files[0].suffix == ".tif" or "tokenizers/src" in err
    return refused


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads the address space from /proc")
@pytest.mark.parametrize("mutations", [10, pytest.param(MUTATIONS, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_refused_or_read_whole(name, mutations, tmp_path, capfd):
    made = list(cases(name, tmp_path / ODD_NAME))
    capfd.readouterr()
    for case in made:
        assert not read_and_check(case, MORE, capfd)
    places = [(case, file) for case in made for file in case.files]
    for number in range(-len(places), mutations):
        rng = np.random.default_rng([SEED, zlib.crc32(name.encode()), abs(number)])
        case, file = places[number if number < 0 else int(rng.integers(len(places)))]
        intact = file.read_bytes()
        way, data = ("empty", b"") if number < 0 else damaged(rng, intact, file.suffix)
        file.write_bytes(data)
        try:
            read_and_check(case, len(data), capfd)
        except BaseException as error:
            error.add_note(f"mutation {number} of seed {SEED}: {way} of {file.parent.name}/{file.name}")
            raise
        file.write_bytes(intact)
