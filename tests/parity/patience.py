"""Runs against the clock on a machine that may be busy: a late one is repeated twice at most, the third one skips.

What does not hang on time (nothing lost, order, orderly end) is asserted by the attempt itself, even when it was late.
"""

import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeVar, final

import pytest

from canopen_exo.bus.lateness import Lateness

TRIES: Final = 3
"""Of a run that is late."""

PATIENCE_S: Final = 60.0
"""Of a session, for attempts that were late. Used up, every further test has one."""

BUSY: Final = "this machine is too busy for real time"
"""How the reason of such a skip begins; the count at the end of `make test` goes by it."""

_TIMING: Final = re.compile(
    r"timing: (\d+) of (\d+) cycles late, SYNC off by at most ([\d.]+) ms \(.*\); (\d+) frames not heard"
)

_LATE: Final = (
    "cycles late (",
    "a cycle late by ",
    "the motion was given up without a fault",
    "the controller's deadline",
)
"""In the reasons of an invalid run: what a machine that is too busy does to it."""

_RIG_LATE: Final = "the rig was late: "
"""How `exo-hil up` says so, see Watch.timing_words."""

_TIMED_OUT: Final = ("not ready after ", "no boot-up message within ", "no SDO answer within ")
"""A rig that did not come as far as its first cycle. Whether it can is seen by the tests that were not late."""

_LATE_SHARE: Final = 0.01
"""Of all cycles; fewer make no run invalid either."""

_LATEST: Final = re.compile(r"the latest ([\d.]+) ms")
_COUNTED: Final = re.compile(r": (\d+) frames (?:dropped|not taken|of both buses not heard)")
_LOST: Final = re.compile(r"\((\d+)\)")

T = TypeVar("T")


@final
@dataclass(frozen=True, slots=True)
class Late:
    """An attempt that was late, and why."""

    why: str


@final
class Patience:
    """Repeats what was late: twice, until that did not help once, or all of it together has taken long."""

    def __init__(self, patience_s: float = PATIENCE_S, clock: Callable[[], float] = time.monotonic) -> None:
        self._left_s = patience_s
        self._tries = TRIES
        self._clock: Final = clock

    def until_punctual(self, attempt: Callable[[], T | Late]) -> T:
        """What an attempt gives that is not late; skips when all were."""
        told: list[str] = []
        for _ in range(self._tries):
            begun = self._clock()
            got = attempt()
            if not isinstance(got, Late):
                return got
            told.append(got.why)
            self._left_s -= self._clock() - begun
            if self._left_s <= 0:
                break
        self._tries = 1
        pytest.skip(f"{BUSY}: {'; again: '.join(told)}")


def distributions(lateness: Mapping[str, Lateness]) -> str:
    """By name, in words, for the reason of a skip."""
    return ", ".join(f"{name}: {one.words()}" for name, one in lateness.items() if one.count)


def why_invalid(document: Mapping[str, Any]) -> str:
    """The reasons in a result document, and how late each process served its wake-ups; "" when there is none."""
    if not document:
        return ""
    late = {
        f"{run}, {name}": Lateness.from_document(one)
        for run in ("golden", "faulted")
        for name, one in document["realtime"][run]["lateness"].items()
    }
    return f"{', '.join(document['invalid_reasons'])}; {distributions(late)}"


def is_lateness(reasons: list[str], cycle_ms: float) -> bool:
    """Whether these reasons against a run all say that the machine was too busy; anything else is a defect.

    A process that stands still overruns queues with what it catches up: those count what they drop, and no frame more
    may be missing. A motion that never began, or a plant that ended before it, is due to the machine only where
    wake-ups were served late, by half a cycle at least.
    """
    counted = sum(int(number) for reason in reasons for number in _COUNTED.findall(reason))
    lost = [reason for reason in reasons if "lost: " in reason or "doubled or out of order: " in reason]
    late = [
        reason
        for reason in reasons
        if any(word in reason for word in _LATE)
        or max(map(float, _LATEST.findall(reason)), default=0.0) >= cycle_ms / 2
    ]
    rest = [reason for reason in reasons if reason not in late and reason not in lost and not _COUNTED.search(reason)]
    return bool(late) and not rest and sum(int(one) for reason in lost for one in _LOST.findall(reason)) <= counted


def gave_up_late(said: str) -> bool:
    """Whether a rig that ended by itself says that it was late, or that something was not there in time."""
    return _RIG_LATE in said or any(words in said for words in _TIMED_OUT)


def told_late(output: str, cycle_ms: float) -> list[str]:
    """What a pytest run with the plug-in printed that shows a rig too late for its test; empty for one that kept time.

    Its `timing:` lines say so: more than 1 % of the cycles late, a SYNC off by more than half a cycle, a frame not
    heard. A rig without a single complete cycle was late only if it did not get ready in time.
    """
    found = [line for line in output.splitlines() if any(words in line for words in _TIMED_OUT)]
    for line in output.splitlines():
        told = _TIMING.match(line)
        if told is not None:
            late, cycles, off_ms, missed = (float(one) for one in told.groups())
            if late > _LATE_SHARE * cycles or off_ms > cycle_ms / 2 or missed:
                found.append(line)
    return found
