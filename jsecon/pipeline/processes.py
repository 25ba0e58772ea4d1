"""A run by several processes, on one machine or on several, over jax.distributed.

The first process runs the stages: it alone reads and writes the cache, holds the lock of the output folder and prints.
For a stage that is `distributed`, it sends the others the results that the stage reads. All compute the stage together,
each its part of the views (`parallel.map_over_processes`, `parallel.accumulate_over_views`). Then the others wait for
the next one. Only the inputs and the models need to be on every machine.

Every command starts its processes as children and watches them: if one dies, the others are stopped, with one message.
"""

import atexit
import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence

import jsecon
from jsecon.errors import InputError
from jsecon.parallel import allgather_tree, cache_worker_programs
from jsecon.pipeline.options import Options
from jsecon.pipeline.results import Checkpoint, Results, RunContext, Stage, StageInput
from jsecon.process import WORKER, cores

START_SECONDS = 300
"""s that processes wait for each other at the start"""
HEARTBEAT_SECONDS = 15
"""s without a heartbeat, after which a process counts as dead"""
GRACE_SECONDS = 3.0
"""s that the others have to end by themselves when one died"""
CONNECTION_LOST = 75
"""exit code of a process that lost the connection to another (EX_TEMPFAIL)"""
_EXPLAINED = (1, 2, 130)
"""exit codes of a process that has printed why"""


def launch(argv: Sequence[str], count: int, coordinator: str | None, index: int | None) -> int:
    """Starts `jsecon` as processes of a run, and waits until they have ended.

    Args:
      argv: Arguments of the command.
      count: Number of processes of the run.
      coordinator: HOST:PORT of the first process; None if all run on this machine.
      index: The process that this machine runs, or None for all, each with its part of the cores.

    Returns:
      The exit code.

    Raises:
      InputError: The numbers do not fit, or a process died.
    """
    if count < 1 or (coordinator is None) != (index is None) or (index is not None and not 0 <= index < count):
        problem = f"--processes {count}, --coordinator {coordinator}, --process {index}"
        expected = "--processes N alone, or with --coordinator HOST:PORT and --process I, 0 <= I < N"
        raise InputError("processes", problem, expected, "Start process 0 on the machine HOST, and each of the others.")
    host, _, port = (coordinator or f"127.0.0.1:{_free_port()}").rpartition(":")
    if not host or not port.isdigit():
        raise InputError("--coordinator", str(coordinator), "HOST:PORT", "For example 10.0.0.1:7733.")
    indices = list(range(count)) if index is None else [index]
    usable = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
    environ = {**os.environ, "XLA_FLAGS": _without_device_count(os.environ.get("XLA_FLAGS", ""))}
    children = []
    with contextlib.ExitStack() as files:
        logs = [None, *(files.enter_context(tempfile.TemporaryFile()) for _ in indices[1:])]
        for place, i in enumerate(indices):
            share = usable[i::count] if index is None and usable[i::count] else usable
            worker = f"{i} {count} {host}:{port} {','.join(map(str, share))}"
            children.append(
                subprocess.Popen(
                    [sys.executable, "-m", "jsecon", *argv],
                    env={**environ, WORKER: worker},
                    stdout=subprocess.DEVNULL if place else None,
                    stderr=logs[place],
                )
            )
        died = _wait(children)
        codes = [child.returncode for child in children]
        if died is None or codes[0] in _EXPLAINED:
            return codes[0]
        for code, log in zip(codes[1:], logs[1:]):
            if code in _EXPLAINED and log is not None:
                log.seek(0)
                sys.stderr.write(log.read().decode(errors="replace"))
                return code
    problem = f"a process that died (process {indices[died]} of {count}, {_cause(codes[died])})"
    remedy = "Run the same command again: it goes on from the finished stages."
    raise InputError("run", problem, f"{count} processes that work to the end", remedy)


def _wait(children: Sequence[subprocess.Popen]) -> int | None:
    """Waits until all have ended, or one has failed; returns the one that failed, after stopping the others."""
    try:
        while any(child.poll() is None for child in children) and not any(child.poll() for child in children):
            time.sleep(0.1)
        failed = next((place for place, child in enumerate(children) if child.poll()), None)
    except KeyboardInterrupt:  # Ctrl-C has reached the children too, which print it; SIGTERM reaches only this process
        _stop(children, subprocess.Popen.terminate)
        raise SystemExit(130) from None
    _stop(children)
    return failed


def _cause(code: int) -> str:
    if code in (-signal.SIGABRT, CONNECTION_LOST):
        return "after it lost touch with another"
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def _stop(children: Sequence[subprocess.Popen], by: Callable[[subprocess.Popen], None] = subprocess.Popen.kill) -> None:
    """Waits GRACE_SECONDS for the children, then signals them, and after as long again kills them."""
    for signal_child in (by, subprocess.Popen.kill):
        until = time.monotonic() + GRACE_SECONDS
        for child in children:
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(max(0.0, until - time.monotonic()))
        for child in children:
            if child.poll() is None:
                signal_child(child)
    for child in children:
        child.wait()


def _without_device_count(flags: str) -> str:
    """XLA's flags without the number of devices that this process chose for itself, with all cores."""
    return " ".join(flag for flag in flags.split() if flag != f"--xla_force_host_platform_device_count={cores()}")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def join(options: Options, index: int, count: int, address: str) -> None:
    """Connects this process, a child of `launch`, with the others; call it before jax makes an array.

    Args:
      options: Options of the run.
      index: Number of this process.
      count: Number of processes.
      address: HOST:PORT that the first process listens at, on that address alone.

    Raises:
      InputError: The processes do not connect, or were started for different runs.
    """
    import jax

    try:
        jax.distributed.initialize(
            address,
            count,
            index,
            coordinator_bind_address=address,
            cluster_detection_method="deactivate",
            initialization_timeout=START_SECONDS,
            heartbeat_timeout_seconds=HEARTBEAT_SECONDS,
        )
    except RuntimeError as error:
        problem = f"no meeting of {count} processes within {START_SECONDS} s ({str(error)[:200]})"
        remedy = "Start all of them, and check that the address is process 0's and can be reached."
        raise InputError(f"--coordinator {address}", problem, "all of them at that address", remedy) from error
    atexit.unregister(jax.distributed.shutdown)  # it waits for the others, also if this process ends in an error
    cache_worker_programs()
    mine = f"jsecon {jsecon.__version__}, {options}"
    first = allgather_tree(mine)[0]
    if first != mine:
        raise InputError(f"process {index}", mine, first, "Give all processes the same options and version.")


@contextlib.contextmanager
def exit_if_disconnected() -> Iterator[None]:
    """Ends the process with CONNECTION_LOST if an exchange with the others fails; the parent process explains it.

    Yields:
      None.
    """
    try:
        yield
    except Exception as error:
        if "Gloo" not in str(error) and "coordination" not in str(error).lower():
            raise
        sys.stderr.flush()
        os._exit(CONNECTION_LOST)  # gloo's threads wait for the others


class Coordinator:
    """Calls the other processes from the first one.

    Args:
      several: Whether there are others; without them the methods have no effect.
    """

    def __init__(self, several: bool):
        self._several = several
        self._sent: set[str] = set()

    def broadcast(self, stage: Stage, results: Results) -> None:
        """Lets all compute a stage with this process, if it is distributed.

        Args:
          stage: The stage.
          results: Results of the stages before it; each is sent once.
        """
        if self._several and stage.distributed:
            news = {name: getattr(results, name) for name in stage.after if name not in self._sent}
            self._sent |= set(news)
            allgather_tree({"stage": stage.name, "results": news})

    def shutdown(self) -> None:
        """Ends the work of the others."""
        if self._several:
            allgather_tree({"stage": ""})
            _disconnect()


def run_worker(context: RunContext, stages: Sequence[Stage]) -> None:
    """Computes each stage that the first process calls for, until it shuts down. It writes no file.

    Args:
      context: The run, with the options of the first process.
      stages: Stages of the run.
    """
    by_name, results = {stage.name: stage for stage in stages}, Results()
    while (call := allgather_tree(None)[0])["stage"]:
        for name, value in call["results"].items():
            setattr(results, name, value)
        checkpoint = Checkpoint(context.out / "worker")
        by_name[call["stage"]].compute(StageInput(context, results, lambda done, total: None, checkpoint))
    _disconnect()


def _disconnect() -> None:
    import jax

    jax.distributed.shutdown()
