"""Damages files of the true format and reads them: each is refused by an InputError, or gives a result that is whole.

    python -m tests.fuzz --reader field --mutations 10000 --seed 1 --keep found

Each reader runs in a process of its own, which may take 10 times the file and 1 GiB more memory than before, and 5 s a
mutation. What ends the process or never comes back is reported with the mutation that did it, and a new process goes on
behind it. So is every other exception, every warning, and whatever is written to stderr. A seed and a number name a
mutation: --first 1234 --mutations 1 makes it again.
"""

import argparse
import collections
import dataclasses
import json
import math
import os
import re
import resource
import select
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from jsecon.errors import InputError

SECONDS = 5.0
"""that a mutation may take, on the clock and of this process's own time"""
SILENCE = 30.0
"""s without a word from the child after which it is ended: on a machine that others use too"""
TIMES, MORE = 10, 1 << 30
"""memory that a mutation may take: so many times the file, and bytes"""
LONGEST_MESSAGE = 2500
"""characters of an InputError: what was found is quoted, not copied"""
FINE = ("read", "refused")
Readers = Mapping[str, Callable[[Path], Iterator[Any]]]
"""name -> cases (fuzz_readers.Case) in a folder"""


@dataclasses.dataclass(frozen=True)
class Trial:
    """What came of one mutation."""

    number: int
    outcome: str
    """one of FINE, or what is wrong."""
    told: str = ""
    """where it went wrong."""
    seconds: float = 0.0
    mib: float = 0.0
    how: str = ""
    """file, and what was done to it."""


def _status(key: str) -> int:
    """Bytes, of this process's memory."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(key))
    return int(line.split()[1]) * 1024


def _place(error: BaseException) -> str:
    """Where in jsecon an exception came from, and what it says."""
    frames = traceback.extract_tb(error.__traceback__)
    last = [frame for frame in frames if "/jsecon/" in frame.filename] or frames
    return f"{Path(last[-1].filename).name}:{last[-1].lineno} {type(error).__name__}: {str(error)[:300]}"


def _outcome(case: Any) -> tuple[str, str]:
    """(outcome, told) of reading a case's files as they lie there."""
    try:
        case.whole(case.read())
    except InputError as error:
        text = str(error)
        if not (error.problem and error.expected and error.remedy) or len(text) > LONGEST_MESSAGE:
            return "an unreadable message", f"{len(text)} characters: {text[:200]}"
        out_of_memory = re.search("nsufficient memory|bad.alloc|MemoryError|nable to allocate", text)
        return ("memory", text[:200]) if out_of_memory else ("refused", "")
    except AssertionError as error:
        return "not whole", f"{traceback.extract_tb(error.__traceback__)[-1].line} {error}"
    except MemoryError as error:
        return "memory", _place(error)
    except Exception as error:
        return "another exception", _place(error)
    return "read", ""


def _tried(case: Any, size: int, stderr: IO[str]) -> Trial:
    """What comes of files of `size` bytes, watched."""
    stderr.truncate(0)
    Path("/proc/self/clear_refs").write_text("5")  # the largest memory is counted from here
    before, allowed = _status("VmRSS"), TIMES * size + MORE
    own, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_status("VmSize") + allowed, hard))
    began, worked = time.perf_counter(), time.process_time()
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        for hidden in (ResourceWarning, DeprecationWarning, PendingDeprecationWarning, ImportWarning):
            warnings.simplefilter("ignore", hidden)
        outcome, told = _outcome(case)
    resource.setrlimit(resource.RLIMIT_AS, (own, hard))
    seconds = min(time.perf_counter() - began, time.process_time() - worked)
    taken, said = max(0, _status("VmHWM") - before), Path(stderr.name).read_bytes().decode(errors="replace")
    if outcome in FINE:
        if warned:
            place = f"{Path(warned[0].filename).name}:{warned[0].lineno}"
            outcome, told = "a warning", f"{place} {str(warned[0].message)[:160]}"
        elif said:
            outcome, told = "said to stderr", said[:160]
        elif taken > allowed:
            outcome, told = "memory", f"{taken / 2**20:.0f} MiB"
        elif seconds > SECONDS:
            outcome, told = "too long", f"{seconds:.1f} s"
    return Trial(-1, outcome, told, seconds, taken / 2**20)


def _work(name: str, readers: Readers, base: Path, seed: int, numbers: range, keep: Path | None, pipe: int) -> None:
    """In the child: reads the true files, then the damaged ones, and tells of each through the pipe."""
    from mutations import damaged

    def tell(trial: Trial) -> None:
        os.write(pipe, (json.dumps(dataclasses.asdict(trial)) + "\n").encode())

    with open(base / "stderr", "a+") as stderr:
        os.dup2(stderr.fileno(), 2)
        (base / "files").mkdir()
        cases = list(readers[name](base / "files"))
        for case in cases:
            true = _tried(case, MORE, stderr)
            if true.outcome != "read":
                return tell(Trial(-1, f"true files: {true.outcome}", true.told))
        for number in numbers:
            rng = np.random.default_rng([seed, zlib.crc32(name.encode()), number])
            case = cases[int(rng.integers(len(cases)))]
            file = case.files[int(rng.integers(len(case.files)))]
            true = file.read_bytes()
            way, data = damaged(rng, true, file.suffix)
            how = f"{way} of {file.parent.name}/{file.name}"
            tell(Trial(number, "begun", how=how))
            file.write_bytes(data)
            kept = keep and keep / f"{name}-{seed}-{number}{file.suffix}"
            if kept:
                kept.write_bytes(data)
            trial = dataclasses.replace(_tried(case, len(data), stderr), number=number, how=how)
            file.write_bytes(true)
            if kept and trial.outcome in FINE:
                kept.unlink()
            tell(trial)


def _heard(pipe: int) -> Iterator[Trial]:
    """What a child tells, until it ends or falls silent."""
    rest = b""
    while select.select([pipe], [], [], SILENCE)[0] and (got := os.read(pipe, 1 << 16)):
        *lines, rest = (rest + got).split(b"\n")
        yield from (Trial(**json.loads(line)) for line in lines)


def trials(
    name: str, readers: Readers, *, seed: int, numbers: range, seconds: float = math.inf, keep: Path | None = None
) -> Iterator[Trial]:
    """What came of the mutations `numbers` of a reader, as many as `seconds` allow once its files are made."""
    end, at = None, numbers.start
    while at < numbers.stop:
        with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as base:
            out, into = os.pipe()
            child, last = os.fork(), None
            if child == 0:
                try:
                    _work(name, readers, Path(base), seed, range(at, numbers.stop), keep, into)
                except BaseException:
                    failed = Trial(-1, "the harness failed", traceback.format_exc()[-500:])
                    os.write(into, (json.dumps(dataclasses.asdict(failed)) + "\n").encode())
                os._exit(0)
            os.close(into)
            try:
                for last in _heard(out):
                    end = end or time.monotonic() + seconds
                    if last.outcome != "begun":
                        yield last
                    if time.monotonic() > end:
                        return
                code = _ended(child)
            finally:
                os.close(out)
                _ended(child)
            if last is None or last.number < 0:
                return
            if last.outcome == "begun":
                outcome = "no end" if code is None else f"crash (signal {os.WTERMSIG(code)})"
                yield dataclasses.replace(last, outcome=outcome)
            at = last.number + 1


def _ended(child: int) -> int | None:
    """How a child has ended; None where it had to be ended, or had been."""
    try:
        for _ in range(10):
            if (found := os.waitpid(child, os.WNOHANG))[0]:
                return found[1]
            time.sleep(0.05)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    except ChildProcessError:
        pass
    return None


@dataclasses.dataclass
class Report:
    """What came of a reader's mutations."""

    name: str
    outcomes: collections.Counter = dataclasses.field(default_factory=collections.Counter)
    seconds: float = 0.0
    mib: float = 0.0
    findings: dict[str, list[Trial]] = dataclasses.field(default_factory=dict)

    def add(self, trial: Trial) -> None:
        self.outcomes[trial.outcome] += 1
        self.seconds, self.mib = max(self.seconds, trial.seconds), max(self.mib, trial.mib)
        if trial.outcome not in FINE:
            kind = re.sub(r"/\S*/|0x\w+|\d{5,}|\d+ characters|@[\d.]+", "", trial.told)[:110]
            self.findings.setdefault(f"{trial.outcome}: {kind}", []).append(trial)

    def lines(self) -> Iterator[str]:
        told = ", ".join(f"{count} {outcome}" for outcome, count in self.outcomes.most_common())
        most = f"at most {self.seconds:.2f} s, {self.mib:.0f} MiB"
        yield f"{self.name}: {self.outcomes.total()} mutations: {told}; {most}"
        for what, found in sorted(self.findings.items(), key=lambda item: -len(item[1])):
            yield f"    {len(found)} x {what!r}, first {found[0].number}: {found[0].how}"


def fuzzed(readers: Readers, asked: argparse.Namespace) -> bool:
    """Prints what came of each reader's mutations; whether all was fine."""
    fine = True
    for name in asked.reader or readers:
        report, numbers = Report(name), range(asked.first, asked.first + asked.mutations)
        given = {"seed": asked.seed, "numbers": numbers, "seconds": asked.seconds, "keep": asked.keep}
        for trial in trials(name, readers, **given):
            report.add(trial)
        print(*report.lines(), sep="\n", flush=True)
        fine &= not report.findings
    return fine


def parsed(argv: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reader", nargs="*", metavar="NAME", help="default: all, see tests/fuzz_readers.py")
    parser.add_argument("--mutations", type=int, default=10_000, metavar="N")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="the number of the first")
    parser.add_argument("--seed", type=int, default=0, metavar="S")
    parser.add_argument("--seconds", type=float, default=math.inf, metavar="S", help="of each reader, at most")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="write each offending file there")
    asked = parser.parse_args(argv)
    if asked.keep:
        asked.keep.mkdir(parents=True, exist_ok=True)
    return asked


def main() -> int:
    from jsecon.process import prepare_process

    sys.path.insert(0, str(Path(__file__).parent))
    prepare_process()  # as the program does, before OpenCV is imported
    from fuzz_readers import READERS

    return 0 if fuzzed(READERS, parsed()) else 1


if __name__ == "__main__":
    sys.exit(main())
