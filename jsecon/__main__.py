"""The program `jsecon` (and `python -m jsecon`): the process first, before jax starts; then the command line."""

import errno
import gc
import io
import os
import sys
import traceback
from typing import Any

from jsecon.process import prepare_process, stop_by_signals

STOPPED = 130
"""exit code of a program that the user stopped"""
UNREAD = 141
"""exit code of a program whose reader went away, such as head: that of a program which SIGPIPE ends"""


class Output:
    """A text stream that may fail, for example where its reader goes away.

    What is written after a failure is dropped, so that files are still written. `failure` is the first error.
    """

    def __init__(self, stream: Any):
        self._stream = stream
        self.failure: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        """Returns an attribute of the stream."""
        return getattr(self._stream, name)

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        return self._stream.isatty()

    def write(self, text: str) -> int:
        """Writes a text, or drops it after a failure."""
        try:
            return self._stream.write(text)
        except OSError as error:
            self._drop(error)
        return len(text)

    def flush(self) -> None:
        """Hands on what is buffered."""
        try:
            self._stream.flush()
        except OSError as error:
            self._drop(error)

    def _drop(self, error: OSError) -> None:
        self.failure = self.failure or error
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())  # what is buffered goes there, at the latest when the interpreter ends
        os.close(nowhere)


def main() -> int:
    """Runs the command line."""
    prepare_process()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # for letters that the terminal lacks
    outputs = Output(sys.stdout), Output(sys.stderr)
    sys.stdout, sys.stderr = outputs  # pyright: ignore[reportAttributeAccessIssue]
    stop_by_signals()
    code = 1
    try:
        from jsecon.app.cli import main as run

        code = run(sys.argv[1:])
    except KeyboardInterrupt:  # during the imports
        print("\njsecon: interrupted.", file=sys.stderr)
        code = STOPPED
    except Exception:
        traceback.print_exc()
    finally:
        for output in outputs:
            output.flush()
        if (failure := outputs[0].failure) is not None and code == 0:
            code = UNREAD
            if failure.errno not in (errno.EPIPE, errno.EINVAL):  # Windows has the second for the first
                code = 2
                print(f"jsecon: cannot write to standard output: {failure.strerror}.", file=sys.stderr)
        jax = sys.modules.get("jax")
        if code == STOPPED or (code and jax is not None and jax.distributed.is_initialized()):
            # jax would wait for the other processes, or end by SIGSEGV if the stop fell into a compilation
            os._exit(code)
        gc.freeze()  # else the interpreter collects three times at its end, for half a second
    return code


if __name__ == "__main__":
    sys.exit(main())
