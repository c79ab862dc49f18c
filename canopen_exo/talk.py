"""Talk of a process: lines on stderr. Whether anybody reads them changes nothing about what the process does.

A reader that is gone (Ctrl-C goes to a whole pipeline and ends its `tee`), a full disk, a terminal that was closed.
"""

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


def tell(text: object) -> None:
    """A line on stderr, if anybody reads it."""
    put(sys.stderr, f"{text}\n")
