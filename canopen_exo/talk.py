"""What a process prints: talk on stderr, its result on stdout. Whether anybody reads it changes nothing about the rest.

A reader that is gone (Ctrl-C goes to a whole pipeline and ends its `tee`), a full disk, a terminal that was closed.
"""

import contextlib
import errno
import os
import sys
from typing import TextIO


def put(stream: TextIO | None, text: str) -> OSError | None:
    """Write at once; returns what went wrong. What comes after that goes nowhere, and does not fail again at exit."""
    if stream is None:  # it was closed when the process began
        return OSError(errno.EBADF, "it is closed")
    try:
        stream.write(text)
        stream.flush()
    except BlockingIOError as error:  # a terminal that does not take more now
        return error
    except OSError as error:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
        return error
    return None


def show(text: str) -> None:
    """The result, to stdout. A reader that has left (`| head`) is not worth a word, anything else is."""
    if sys.stdout is not None:
        with contextlib.suppress(OSError, ValueError):  # a result is worth waiting for a reader that is slow
            os.set_blocking(sys.stdout.fileno(), True)
    error = put(sys.stdout, text)
    if error is not None and not isinstance(error, BrokenPipeError):
        tell(f"stdout: {error.strerror or error}; the result could not be printed there")


def tell(text: object) -> None:
    """A line on stderr, if anybody reads it."""
    put(sys.stderr, f"{text}\n")
