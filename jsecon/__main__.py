"""The program `jsecon` (and `python -m jsecon`): the process first, before jax starts; then the command line."""

import io
import os
import signal
import sys
import traceback

from jsecon.process import member, prepare_member, prepare_process


def main() -> int:
    """Entry point: returns the exit code."""
    several = member() is not None
    if several:
        prepare_member()
    prepare_process()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a letter that the terminal lacks ends nothing
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends as by Ctrl-C: what is half written is removed
    from jsecon.app.command_line import main as run

    if not several:
        return run(sys.argv[1:])
    code = 1
    try:
        code = run(sys.argv[1:])
    except Exception:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(code)  # jax would wait for the other processes


if __name__ == "__main__":
    sys.exit(main())
