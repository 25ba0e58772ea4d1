"""The program `jsecon` (and `python -m jsecon`): the process first, before jax starts; then the command line."""

import io
import os
import sys
import traceback

from jsecon.process import member, prepare_member, prepare_process, stop_by_signals

STOPPED = 130
"""exit code of a program that the user stopped"""


def main() -> int:
    """Entry point: returns the exit code."""
    several = member() is not None
    if several:
        prepare_member()
    prepare_process()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a letter that the terminal lacks ends nothing
    stop_by_signals()
    code = 1
    try:
        from jsecon.app.command_line import main as run

        code = run(sys.argv[1:])
    except KeyboardInterrupt:  # amid the imports: nothing has begun
        print("\njsecon: interrupted.", file=sys.stderr)
        code = STOPPED
    except Exception:
        if not several:
            raise
        traceback.print_exc()
    finally:
        if several or code == STOPPED:  # jax would wait for the other processes; and end by SIGSEGV, as Python takes
            sys.stdout.flush()  # itself apart, where a stop fell into a compilation
            os._exit(code)
    return code


if __name__ == "__main__":
    sys.exit(main())
