"""Stops runs by SIGKILL at random moments and by disks that are full, and starts them again by the same command: each
must end in the field of a run that nothing stopped, bit for bit.

    python -m tests.kills --kills 30 --full-disks 10 --seed 1

The capture is the demo's room, small. Moments are drawn evenly from the time that a run takes. Every other run records
how far a stage has come each half second in place of each 20, and so is stopped amid that too; the first --cold of
those killed start without compiled programs, and are stopped amid jax's writing them. A disk is a tmpfs whose size is
drawn evenly from what a run leaves; every other one holds jax's programs as well. A full disk must end in one message
and exit code 2; it is then made larger. Full disks need the right to mount.
"""

import argparse
import collections
import dataclasses
import hashlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

HOME = Path(__file__).resolve().parent.parent
OFTEN = """
from jsecon.process import prepare_process
prepare_process()
from jsecon.__main__ import main
from jsecon.pipeline import stages
stages.CHECKPOINT_SECONDS = 0.5
raise SystemExit(main())
"""
"""`jsecon` that records often how far a stage has come"""
LONGEST = 1200.0
"""s that a run may take, on a machine that others use too"""
ROOM = 64 << 20
"""bytes of a disk that is large enough"""


class NoDisk(Exception):
    """This machine does not let us mount one."""


@dataclasses.dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int | None
    """None where it was killed by us."""
    seconds: float
    stage: str
    """the last that was done, or - ."""
    said: str
    """on standard error, without progress."""


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a run writes."""

    out: Path
    programs: Path
    """jax's compiled programs."""
    often: bool
    """whether it records often how far it has come."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """What came of one run that was stopped."""

    how: str
    wrong: str = ""
    """empty where it ended in the same field."""
    stage: str = "-"
    """the last that was done when it was stopped."""
    seconds: float = 0.0
    """to the stop, and from the start after it to the end."""

    def __str__(self) -> str:
        return f"{self.how}: {self.wrong or 'the same field'} ({self.seconds:.0f} s)"


def ended(room: Path, place: Place, steps: int, kill_at: float | None = None) -> Ended:
    """Runs `jsecon run`, killed with all its processes `kill_at` seconds after its start where that comes first."""
    program = ["-c", OFTEN] if place.often else ["-m", "jsecon"]
    command = [sys.executable, *program, "run", str(room), "--out", str(place.out), "--steps", str(steps)]
    paths = os.pathsep.join(filter(None, (str(HOME), os.environ.get("PYTHONPATH"))))
    environ = {**os.environ, "PYTHONPATH": paths, "XDG_CACHE_HOME": str(place.programs)}
    began = time.monotonic()
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=environ, start_new_session=True, **pipes) as run:
        try:
            told, said = run.communicate(timeout=LONGEST if kill_at is None else kill_at)
            code = run.returncode
        except subprocess.TimeoutExpired:
            os.killpg(run.pid, signal.SIGKILL)
            told, said = run.communicate()
            code = None
    done = re.findall(r"^  (\w+) +done ", told, re.MULTILINE)
    said = "\n".join(line for line in said.splitlines() if not line.startswith("  "))
    return Ended(code, time.monotonic() - began, done[-1] if done else "-", said.strip())


def _digest(out: Path) -> str:
    return hashlib.sha256((out / "field.safetensors").read_bytes()).hexdigest()


def _left(out: Path) -> list[str]:
    """What a finished run must not leave: records of stages in progress."""
    return sorted(path.name for path in out.rglob("*.checkpoint*"))


def _went_on(room: Path, place: Place, steps: int, straight: str) -> tuple[str, float]:
    """(what is wrong with the run that goes on at `place`, the seconds that it took)."""
    again = ended(room, place, steps)
    if again.code != 0:
        return f"then exit code {again.code}: {again.said[-400:]}", again.seconds
    if again.said:
        return f"then said: {again.said[-400:]}", again.seconds
    if _digest(place.out) != straight:
        return "ANOTHER FIELD", again.seconds
    return (f"left {left}" if (left := _left(place.out)) else ""), again.seconds


def killed(
    room: Path,
    work: Path,
    steps: int,
    straight: tuple[str, float, float],
    rng: np.random.Generator,
    kills: int,
    cold: int,
) -> Iterator[Trial]:
    """Runs killed at random moments. straight: the digest of the field, and the seconds of a run with its programs to
    compile and without."""
    digest, slow, quick = straight
    for number in range(kills):
        first = number < cold
        programs = work / f"programs{number}" if first else work / "programs"
        place = Place(work / "killed", programs, often=number % 2 == 1)
        while True:  # where it ended before, which a machine that has grown quieter may do, it was not killed
            shutil.rmtree(place.out, ignore_errors=True)
            if first:
                shutil.rmtree(programs, ignore_errors=True)
            moment = float(rng.uniform(0, slow if first else quick))
            stopped = ended(room, place, steps, moment)
            if stopped.code is None:
                break
        wrong, seconds = _went_on(room, place, steps, digest)
        how = f"kill {number + 1} at {moment:.1f} s, after {stopped.stage}{', no programs' * first}"
        yield Trial(how, wrong, stopped.stage, stopped.seconds + seconds)
        shutil.rmtree(place.out)
        if first:
            shutil.rmtree(programs)


def _mounted(place: Path, *options: str) -> None:
    done = subprocess.run(["mount", *options, "-t", "tmpfs", "tmpfs", str(place)], capture_output=True, text=True)
    if done.returncode:
        raise NoDisk(done.stderr.strip() or f"mount ended with {done.returncode}")


def full(
    room: Path, work: Path, steps: int, digest: str, size: int, rng: np.random.Generator, disks: int
) -> Iterator[Trial]:
    """Runs on disks too small for the `size` bytes that one leaves. Raises NoDisk where none can be mounted."""
    for number in range(disks):
        disk = work / f"disk{number}"
        disk.mkdir()
        own = int(rng.uniform(0, size)) // 4096 * 4096 + 4096
        _mounted(disk, "-o", f"size={own}")
        try:
            programs = disk / "programs" if number % 2 else work / "programs"
            place = Place(disk / "out", programs, often=number % 4 > 1)
            stopped = ended(room, place, steps)
            how = f"disk {number + 1} of {own >> 10} KiB, full after {stopped.stage}{', programs too' * (number % 2)}"
            lines = stopped.said.splitlines()
            if (
                stopped.code != 2
                or len(lines) != 1
                or not re.search("^jsecon: .*No space left.* free some room", lines[0])
            ):
                yield Trial(how, f"exit code {stopped.code}: {stopped.said[-600:]}", stopped.stage, stopped.seconds)
                continue
            partial = sorted(path.name for path in place.out.rglob("*.partial*"))
            _mounted(disk, "-o", f"remount,size={ROOM}")
            wrong, seconds = _went_on(room, place, steps, digest)
            wrong = wrong or (f"left {partial} on the full disk" if partial else "")
            yield Trial(how, wrong, stopped.stage, stopped.seconds + seconds)
        finally:
            subprocess.run(["umount", "-l", str(disk)], check=True)


def _bytes_of(folder: Path) -> int:
    """That a folder takes on a tmpfs."""
    return sum(-(-path.stat().st_size // 4096) * 4096 for path in folder.rglob("*") if path.is_file())


def trials(room: Path, work: Path, *, kills: int, disks: int, cold: int, steps: int, seed: int) -> Iterator[Trial]:
    """What came of each run. `room`: the capture; `work`: an empty folder. Raises NoDisk."""
    if disks:
        (work / "try").mkdir()
        _mounted(work / "try", "-o", "size=1m")
        subprocess.run(["umount", str(work / "try")], check=True)
    rng = np.random.default_rng(seed)
    place = Place(work / "straight", work / "programs", often=False)
    runs = []
    for _ in range(2):  # with its programs to compile, and without
        shutil.rmtree(place.out, ignore_errors=True)
        runs.append(ended(room, place, steps))
        if runs[-1].code != 0 or runs[-1].said:
            yield Trial("the run that nothing stops", f"exit code {runs[-1].code}: {runs[-1].said[-600:]}")
            return
    digest, size = _digest(place.out), _bytes_of(place.out)
    yield Trial("straight, with programs to compile", seconds=runs[0].seconds)
    yield Trial(f"straight, {size / 2**20:.1f} MiB", seconds=runs[1].seconds)
    yield from killed(room, work, steps, (digest, runs[0].seconds, runs[1].seconds), rng, kills, cold)
    yield from full(room, work, steps, digest, size, rng, disks)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=30, metavar="N")
    parser.add_argument("--full-disks", type=int, default=10, metavar="N")
    parser.add_argument("--cold", type=int, default=3, metavar="N", help="of the kills, without compiled programs")
    parser.add_argument("--steps", type=int, default=400, help="of the fit")
    parser.add_argument("--seed", type=int, default=0, metavar="S")
    asked = parser.parse_args(argv)
    from jsecon.demo import write_room

    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)  # the program's own choice, beneath XDG_CACHE_HOME
    after, wrong = {"kill": collections.Counter(), "disk": collections.Counter()}, 0
    with tempfile.TemporaryDirectory() as base:
        room = write_room(Path(base, "room"), 0, views=8, width=160, height=120, holdout=4, points=1200)
        (work := Path(base, "work")).mkdir()
        options = {"kills": asked.kills, "disks": asked.full_disks, "cold": asked.cold, "steps": asked.steps}
        for trial in trials(room, work, seed=asked.seed, **options):
            print(trial, flush=True)
            wrong += bool(trial.wrong)
            if (kind := trial.how.split()[0]) in after:
                after[kind][trial.stage] += 1
    for kind, stages in after.items():
        told = ", ".join(f"{count} after {stage}" for stage, count in stages.most_common())
        print(f"{kind}: {stages.total()} ({told})")
    print(f"{wrong} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
