"""Effects: how long, and whether the injector arms again."""

import copy
import pickle

import pytest
from numpy.random import PCG64, Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER
from canopen_exo.signal import Signal
from fi_gateway.conditions import Condition, Reading, Within
from fi_gateway.distributions import Binomial, Exponential, Poisson
from fi_gateway.effects import ConstantTime, DrawnTime, Effect, Frames, Infinite, Once, Until
from fi_gateway.errors import FaultError


@pytest.mark.parametrize(
    ("effect", "duration", "frames", "rearms"),
    [
        (Once(), NEVER, 1, False),
        (ConstantTime(1), 1, 0, True),
        (ConstantTime(300_000_000), 300_000_000, 0, True),
        (Frames(1), NEVER, 1, True),
        (Frames(7), NEVER, 7, True),
        (Infinite(), NEVER, 0, False),
    ],
)
def test_constant_time_and_frames_rearm_and_once_and_infinite_are_spent(
    effect: Effect, duration: int, frames: int, rearms: bool
) -> None:
    """faults.md: then the injector re-arms (constant, frames) or is spent (once, infinite)."""
    for one in (effect, copy.deepcopy(effect)):
        assert (one.duration(), one.frames, one.rearms) == (duration, frames, rearms)


@pytest.mark.parametrize("duration_ns", [-1, 0, NEVER])
def test_constant_time_refuses_a_window_without_length(duration_ns: int) -> None:
    """A window [t0, t0) would never end an event at t0."""
    with pytest.raises(FaultError, match=r"allowed 1\.\."):
        ConstantTime(duration_ns)


def test_frames_refuses_none() -> None:
    """0 would be no limit."""
    with pytest.raises(FaultError, match="allowed 1 and more"):
        Frames(0)


def test_a_drawn_time_rearms_and_is_never_without_length() -> None:
    """mttr and distributions re-arm; 0 periods are the shortest window, 1 ns; what is beyond all time has no end."""
    rng = Generator(PCG64(1))
    assert DrawnTime(Exponential(1e6), rng).rearms
    assert DrawnTime(Binomial(3, 0.0, MS), rng).duration() == 1
    assert DrawnTime(Binomial(3, 1.0, MS), rng).duration() == 3 * MS
    assert DrawnTime(Poisson(1e9, NEVER // 2), rng).duration() == NEVER


def below(limit: int) -> Condition:
    """A byte of 0x185 below a number."""
    reading = Reading(1, Signal("level", "knee", "knee_TPDO1", 0x185, 0, 8, False, 1.0, "", 0x2000, 0))
    return Condition(Within(reading, -1, limit - 1), [reading])


def test_until_ends_with_the_frame_that_fulfils_its_condition() -> None:
    """A level: also when it held before; without a time of its own; it re-arms."""
    effect = Until(below(3))
    assert (effect.duration(), effect.frames, effect.rearms) == (NEVER, 0, True)
    assert effect.watches == ((1, 0x185),)
    levels = [9, 3, 2, 2, 5, 0]
    assert [effect.observe(now, Frame(0x185, bytes([level]))) for now, level in enumerate(levels)] == [
        False, False, True, True, False, True,
    ]  # fmt: skip


@pytest.mark.parametrize("effect", [DrawnTime(Exponential(1e6), Generator(PCG64(1))), Until(below(3)), Frames(4)])
def test_a_copied_effect_goes_on_alike(effect: Effect) -> None:
    """Snapshots: interpreted or compiled, in mid-run."""
    for now in range(30):
        effect = pickle.loads(pickle.dumps(effect))
        copied = copy.deepcopy(effect)
        frame = Frame(0x185, bytes([now % 7]))
        assert effect.observe(now, frame) == copied.observe(now, frame)
        assert effect.duration() == copied.duration()
        assert (effect.frames, effect.rearms, effect.watches) == (copied.frames, copied.rearms, copied.watches)
