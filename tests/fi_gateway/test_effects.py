"""Effects: how long, and whether the injector arms again."""

import copy

import pytest

from canopen_exo.bus.node import NEVER
from fi_gateway.effects import ConstantTime, Effect, Infinite, Once
from fi_gateway.errors import FaultError


@pytest.mark.parametrize(
    ("effect", "duration", "frames", "rearms"),
    [
        (Once(), NEVER, 1, False),
        (ConstantTime(1), 1, 0, True),
        (ConstantTime(300_000_000), 300_000_000, 0, True),
        (Infinite(), NEVER, 0, False),
    ],
)
def test_constant_time_rearms_and_once_and_infinite_are_spent(
    effect: Effect, duration: int, frames: int, rearms: bool
) -> None:
    """faults.md: then the injector re-arms (constant) or is spent (once, infinite)."""
    for one in (effect, copy.deepcopy(effect)):
        assert (one.duration(), one.frames, one.rearms) == (duration, frames, rearms)


@pytest.mark.parametrize("duration_ns", [-1, 0, NEVER])
def test_constant_time_refuses_a_window_without_length(duration_ns: int) -> None:
    """A window [t0, t0) would never end an event at t0."""
    with pytest.raises(FaultError, match=r"allowed 1\.\."):
        ConstantTime(duration_ns)
