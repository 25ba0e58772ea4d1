"""Faults of the machine end in one message: no room, no memory, another run in the same folder, a request to stop."""

import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from capture_files import refused, small_capture, write_transforms
from fuzz_readers import _field

from jsecon.data.images import write_image
from jsecon.data.ply import save_ply
from jsecon.files import alone, write_text
from jsecon.language.field import save_field
from jsecon.pipeline import cache, pipeline

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def no_room():
    """Files end after 1000 bytes, as on a full disk."""
    own = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, own[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, own)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("a.npz", lambda path: save_field(path, _field())),
        ("a.npz", lambda path: cache.save(path, np.zeros(9999))),
        ("a.ply", lambda path: save_ply(path, _field().gaussians)),
        ("a.png", lambda path: write_image(path, np.random.default_rng(0).integers(0, 255, (99, 99, 3), np.uint8))),
        ("a.txt", lambda path: write_text(path, "x" * 5000)),
    ],
)
def test_a_full_disk_is_told_and_leaves_nothing(tmp_path, no_room, name, write):
    with refused(name, f"on writing to {tmp_path}", "free some room"):
        write(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "Fotos aus Köln 日本 #1 %20"
    write_transforms(small_capture(), folder)
    return folder


def test_want_of_memory_names_the_stage_and_what_helps(capture, tmp_path):
    with refused("stage load", "Unable to allocate", "--long-side"):
        pipeline.run(pipeline.Options(capture), tmp_path / "out", load=lambda: np.ones(1 << 50))


def test_two_runs_in_one_folder_are_told_apart(capture, tmp_path):
    (tmp_path / "out").mkdir()
    with alone(tmp_path / "out"), refused(tmp_path / "out", "another run"):
        pipeline.run(pipeline.Options(capture), tmp_path / "out")
    with alone(tmp_path / "out"):
        pass


def test_a_program_that_is_told_to_end_says_how_to_go_on(capture, tmp_path):
    out = tmp_path / "Ausgabe für Ä"
    command = [sys.executable, "-m", "jsecon", "run", str(capture), "--out", str(out), "--steps", "100000"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as run:
        assert run.stdout is not None
        for line in run.stdout:
            if "load " in line:
                break
        run.send_signal(signal.SIGTERM)
        _, told = run.communicate(timeout=60)
    assert run.returncode == 130
    assert "goes on where it stopped" in told
    assert not list(out.rglob("*.partial*"))
