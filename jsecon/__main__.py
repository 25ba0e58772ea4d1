"""The program `jsecon` (and `python -m jsecon`): the process first, before jax starts; then the command line."""

import errno
import gc
import io
import os
import signal
import sys
import traceback

from jsecon.process import prepare_process

STOPPED = 130
"""exit code of a program that the user stopped"""
UNREAD = 141
"""exit code of a program whose reader went away, such as head: that of a program which SIGPIPE ends"""


def main() -> int:
    """Runs the command line, and returns the exit code."""
    prepare_process()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # for letters that the terminal lacks
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C, so that half-written files are removed
    code = 1
    try:
        from jsecon.app.cli import main as run

        code = run(sys.argv[1:])
        sys.stdout.flush()
    except KeyboardInterrupt:  # during the imports
        print("\njsecon: interrupted.", file=sys.stderr)
        code = STOPPED
    except OSError as error:
        code = _describe_unwritten_output(error)
    except Exception:
        traceback.print_exc()
    jax = sys.modules.get("jax")
    if code == STOPPED or (code and jax is not None and jax.distributed.is_initialized()):
        # jax would wait for the other processes, or end by SIGSEGV if the stop fell into a compilation
        os._exit(code)
    gc.freeze()  # else the interpreter collects three times at its end, for half a second
    return code


def _describe_unwritten_output(error: OSError) -> int:
    """Explains an output that cannot be written, unless its reader just went away; returns the exit code."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # where the rest goes when the interpreter ends
    if error.errno in (errno.EPIPE, errno.EINVAL):  # Windows has the second for the first
        return UNREAD
    if error.errno == errno.ENOSPC:
        print(f"jsecon: cannot write to standard output: {error.strerror}.", file=sys.stderr)
        return 2
    traceback.print_exception(error)
    return 1


if __name__ == "__main__":
    sys.exit(main())
