"""A run by several processes, on one machine or on several, which the user's own launcher starts.

    mpirun -n 2 jsecon run my_capture --out my_field --distributed          Open MPI
    srun --ntasks 2 jsecon run my_capture --out my_field --distributed      SLURM

jax.distributed connects them: it reads number, index and address from what the launcher sets. The first process runs
the stages: it alone reads and writes the cache, holds the lock of the output folder and prints. For a stage that is
`distributed`, it sends the others (`run.run_worker`) the results that the stage reads. All compute the stage together,
each its part of the views (`parallel.map_over_processes`). Then the others wait for the next one. Only the inputs and
the models need to be on every machine.

A process that fails prints why, and the launcher ends the others.
"""

import atexit
import contextlib
import os
import sys
from collections.abc import Iterator

import jax

import jsecon
from jsecon.errors import InputError
from jsecon.parallel import allgather_tree
from jsecon.pipeline.options import Options


@contextlib.contextmanager
def connection(options: Options) -> Iterator[int]:
    """Connects this process with the others of a run, for the body of a `with`, and yields its index.

    Call it before jax makes an array. Raises InputError if the processes do not connect or have other options.
    """
    try:
        jax.distributed.initialize(heartbeat_timeout_seconds=15)
    except (RuntimeError, ValueError) as error:
        problem = f"the processes do not find each other ({str(error).rstrip('.')[:200]})"
        remedy = "Start the command by mpirun or srun, for example: mpirun -n 2 jsecon run ..."
        raise InputError("--distributed", problem, remedy=remedy) from error
    atexit.unregister(jax.distributed.shutdown)  # it waits for the others, also if this process ends in an error
    index = jax.process_index()
    try:
        settings = f"jsecon {jsecon.__version__}, {options}"
        first = allgather_tree(settings)[0]
        if first != settings:
            raise InputError(f"process {index}", settings, first, "Give all processes the same options and version.")
        yield index
    except KeyboardInterrupt:
        if index == 0:
            raise
        os._exit(130)  # the first process says so
    except Exception as error:
        if "Gloo" not in str(error) and "coordination" not in str(error).lower():
            raise
        if index == 0:
            remedy = "Look at its own message. The same command goes on from the finished stages."
            print(f"jsecon: {InputError('', 'another process of the run has ended', remedy=remedy)}", file=sys.stderr)
        sys.stderr.flush()
        os._exit(2)  # gloo's threads wait for the others
    jax.distributed.shutdown()
