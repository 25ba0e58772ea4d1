"""The program `jsecon` (and `python -m jsecon`): the process first, before jax starts; then the command line."""

import os
import signal
import sys

from jsecon.process import MEMBER, mute_libraries, prepare_process


def main() -> int:
    """Entry point: returns the exit code."""
    prepare_process()
    if MEMBER in os.environ:
        mute_libraries()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends as by Ctrl-C: what is half written is removed
    from jsecon.app.command_line import main as run

    return run(sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
