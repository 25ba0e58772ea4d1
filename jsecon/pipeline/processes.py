"""A run by several processes, on one machine or on several, over jax.distributed.

The first process runs the stages as always: it alone reads and writes the cache, holds the output folder's lock and
tells the user. When it comes to a stage that is `shared`, it sends the others what the stage reads, all compute it
together (`parallel.map_over_processes`, `parallel.accumulate_over_views`), and the others wait for the next one. So
nothing but the inputs and the models needs to lie on every machine.

Every command starts its processes as children and watches them: one that dies ends the others, with one message.
"""

import atexit
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import jsecon
from jsecon.errors import InputError
from jsecon.parallel import allgather_bytes, cache_worker_programs, deserialize_tree, serialize_tree
from jsecon.pipeline import cache
from jsecon.pipeline.options import Options
from jsecon.pipeline.stages import Checkpoint, Results, Stage
from jsecon.process import WORKER, cores

MEET_SECONDS = 300
"""that processes wait for each other at the start"""
SILENT_SECONDS = 15
"""without a sign of life, after which a process counts as dead"""
LAST_WORDS_SECONDS = 3.0
"""that the others have to end by themselves when one of them died"""
LOST = 75
"""exit code of a process that lost touch with another (EX_TEMPFAIL)"""
_TOLD = (1, 2, 130)
"""exit codes of a process that has said why"""
AGAIN = "What is done is kept: give the same command again and it goes on."


def launch(argv: Sequence[str], count: int, coordinator: str | None, index: int | None) -> int:
    """Starts `jsecon` with `argv` as all of `count` processes of this machine, each with its part of the cores, or as
    the one of `index`; returns the exit code when all have ended.

    Raises InputError for numbers that do not fit, and where a process died.
    """
    if count < 1 or (coordinator is None) != (index is None) or (index is not None and not 0 <= index < count):
        found = f"--processes {count}, --coordinator {coordinator}, --process {index}"
        expected = "--processes N alone, or with --coordinator HOST:PORT and --process I, 0 <= I < N"
        raise InputError("processes", found, expected, "Start process 0 on the machine HOST, and each of the others.")
    host, _, port = (coordinator or f"127.0.0.1:{_free_port()}").rpartition(":")
    if not host or not port.isdigit():
        raise InputError("--coordinator", str(coordinator), "HOST:PORT", "For example 10.0.0.1:7733.")
    own = list(range(count)) if index is None else [index]
    usable = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
    children, environ = [], {**os.environ, "XLA_FLAGS": _without_devices(os.environ.get("XLA_FLAGS", ""))}
    with contextlib.ExitStack() as files:
        said = [None, *(files.enter_context(tempfile.TemporaryFile()) for _ in own[1:])]
        for place, i in enumerate(own):
            share = usable[i::count] if index is None and usable[i::count] else usable
            given = {
                "env": {**environ, WORKER: f"{i} {count} {host}:{port} {','.join(map(str, share))}"},
                "stdout": subprocess.DEVNULL if place else None,
                "stderr": said[place],
            }
            children.append(subprocess.Popen([sys.executable, "-m", "jsecon", *argv], **given))
        died = _awaited(children)
        codes = [child.returncode for child in children]
        if died is None or codes[0] in _TOLD:
            return codes[0]
        for code, words in zip(codes[1:], said[1:]):
            if code in _TOLD and words is not None:
                words.seek(0)
                sys.stderr.write(words.read().decode(errors="replace"))
                return code
    how = f"a process that died (process {own[died]} of {count}, {_cause(codes[died])})"
    raise InputError("run", how, f"{count} processes that work to the end", AGAIN)


def _awaited(children: Sequence[subprocess.Popen]) -> int | None:
    """Waits until all have ended, or one has failed, which it returns; then none is left."""
    try:
        while any(child.poll() is None for child in children) and not any(child.poll() for child in children):
            time.sleep(0.1)
        died = next((place for place, child in enumerate(children) if child.poll()), None)
    except KeyboardInterrupt:  # Ctrl-C has reached the children too, who say so; SIGTERM only this process
        _end(children, subprocess.Popen.terminate)
        raise SystemExit(130) from None
    _end(children)
    return died


def _cause(code: int) -> str:
    if code in (-signal.SIGABRT, LOST):
        return "after it lost touch with another"
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def _end(children: Sequence[subprocess.Popen], by: Callable[[subprocess.Popen], None] = subprocess.Popen.kill) -> None:
    """Waits for the children, for LAST_WORDS_SECONDS at most; then stops them `by` a signal, and after as long again
    kills them."""
    for stop in (by, subprocess.Popen.kill):
        until = time.monotonic() + LAST_WORDS_SECONDS
        for child in children:
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(max(0.0, until - time.monotonic()))
        for child in children:
            if child.poll() is None:
                stop(child)
    for child in children:
        child.wait()


def _without_devices(flags: str) -> str:
    """XLA's flags without the number of devices that this process, with all cores, chose for itself."""
    return " ".join(flag for flag in flags.split() if flag != f"--xla_force_host_platform_device_count={cores()}")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def join(options: Options, index: int, count: int, address: str) -> None:
    """Joins the processes of the run, in a child of `launch`; before jax makes an array.

    The coordinator listens at its own address alone, loopback where no other was given. Raises InputError where the
    processes don't meet, or were not started for the same run.
    """
    import jax

    try:
        jax.distributed.initialize(
            address,
            count,
            index,
            coordinator_bind_address=address,
            cluster_detection_method="deactivate",
            initialization_timeout=MEET_SECONDS,
            heartbeat_timeout_seconds=SILENT_SECONDS,
        )
    except RuntimeError as error:
        found = f"no meeting of {count} processes within {MEET_SECONDS} s ({str(error)[:200]})"
        remedy = "Start all of them, and see that the address is process 0's own and can be reached."
        raise InputError(f"--coordinator {address}", found, "all of them at that address", remedy) from error
    atexit.unregister(jax.distributed.shutdown)  # it waits for the others, also where this one ends in an error
    cache_worker_programs()
    mine = f"jsecon {jsecon.__version__}, {options}"
    first = allgather_bytes(mine.encode())[0].decode()
    if first != mine:
        raise InputError(f"process {index}", mine, first, "Give all processes the same options and version.")


def leave() -> None:
    """Ends what `join` began, when all processes have done their work."""
    import jax

    jax.distributed.shutdown()


@contextlib.contextmanager
def lost_touch() -> Iterator[None]:
    """Ends the process with LOST, which whoever started it puts in words, where an exchange with the others fails."""
    try:
        yield
    except Exception as error:
        if "Gloo" not in str(error) and "coordination" not in str(error).lower():
            raise
        sys.stderr.flush()
        os._exit(LOST)  # gloo's threads wait for the others


class Coordinator:
    """What the first process tells the others; alone, nothing."""

    def __init__(self, several: bool):
        self.several = several
        self._sent: set[str] = set()

    def broadcast(self, stage: Stage, results: Results) -> None:
        """All compute this stage, now."""
        if self.several and stage.shared:
            news = {name: results[name] for name in stage.after if name not in self._sent}
            self._sent |= set(news)
            tree, arrays = cache.pack(news)
            allgather_bytes(serialize_tree({"stage": stage.name, "tree": json.dumps(tree), "arrays": arrays}))

    def shutdown(self) -> None:
        """No more stages: all leave."""
        if self.several:
            allgather_bytes(serialize_tree({"stage": ""}))
            leave()


def run_worker(stages: Sequence[Stage], out: Path) -> None:
    """What every process but the first does: computes each stage that it is called for, until it is dismissed. `out`:
    the run's folder, where it leaves nothing of its own."""
    by_name, results = {stage.name: stage for stage in stages}, {}
    while (called := deserialize_tree(allgather_bytes(b"")[0]))["stage"]:
        results |= cache.unpack(json.loads(called["tree"]), called["arrays"])
        by_name[called["stage"]].compute(results, lambda done, total: None, Checkpoint(out / "assist"))
    leave()
